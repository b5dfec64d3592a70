"""What is proved of the FPGA core's modules; and that each property fails when the module is broken."""

from __future__ import annotations

import re
from concurrent.futures import ThreadPoolExecutor

import pytest

from upbeam.hw_sim.fpga import ToolError, simulators, tools
from upbeam.hw_sim.fpga.formal import CHECKS, main, prove


def _missing() -> str:
    """Why nothing can be proved here; empty if it can."""
    try:
        tools.find_yosys(), tools.find_z3()
    except ToolError as error:
        return str(error)
    return ""


pytestmark = pytest.mark.skipif(bool(_missing()), reason=_missing() or "-")

# What a solver finds hard and these properties do not need, made simple in the copies.
SIMPLER = {
    "registers": [
        ("crc_of = {1'b0, crc_of[31:1]} ^ (crc_of[0] ^ word[n] ? 32'hedb88320 : 32'd0);", "crc_of = crc ^ word;")
    ],
    "destagger": [
        ("memory[{slot, beam}] <= arriving;", "memory[0] <= arriving;"),
        ("memory[{from, beam}]", "memory[0]"),
    ],
}
# A check; clocks to look ahead; what is broken in a copy of the module; the properties that must fail then.
MUTANTS = [
    (
        "axil",
        8,
        [
            ("s_axil_bvalid <= write || (s_axil_bvalid && !s_axil_bready)", "s_axil_bvalid <= write"),
            ("s_axil_rvalid <= read || (s_axil_rvalid && !s_axil_rready)", "s_axil_rvalid <= read"),
        ],
        "b_holds r_holds b_after_address b_after_data r_after_address",
    ),
    (
        "axil",
        10,
        [
            ("if (write) s_axil_bresp <= write_error ? SLVERR", "if (has_data) s_axil_bresp <= !write_error ? SLVERR"),
            (
                "if (read) begin\n            s_axil_rresp <= read_error ? SLVERR",
                "if (has_read) begin\n            s_axil_rresp <= !read_error ? SLVERR",
            ),
            ("awake && !has_address", "awake && !has_address && !has_data"),
        ],
        "b_stable r_stable b_follows r_follows ready_again",
    ),
    (
        "axil",
        6,
        [
            ("has_data && !s_axil_bvalid", "has_data"),
            ("if (write) {has_address, has_data} <= 2'b00;", ""),
            ("s_axil_bvalid <= 1'b0;", ""),
        ],
        "one_write reset_quiet",
    ),
    (
        "skid",
        6,
        [
            ("if (!extra) spare <= in_data;", "spare <= in_data;"),
            ("awake <= 1'b0;", "awake <= 1'b1;"),
            ("if (free) full <= extra || accepted;", "full <= accepted;"),
        ],
        "in_order valid_holds reset_quiet counted spare_behind_head",
    ),
    (
        "skid",
        6,
        [
            ("if (free) head <= extra", "head <= extra"),
            ("extra <= !free && (extra || accepted)", "extra <= !free && !extra"),
        ],
        "data_holds ready_holds counted",
    ),
    (
        "fifo",
        18,
        [
            ("room <= level <= DEPTH - SLACK", "room <= level <= DEPTH - SLACK + 3"),
            ("wire push = write && !full", "wire push = write"),
        ],
        "room_is_true enough_room no_overrun within",
    ),
    (
        "fifo",
        11,
        [
            ("memory[written[BITS-1:0]] <= in_data", "memory[written[BITS-1:0]] <= in_data ^ written[0]"),
            ("wire pop = !empty && (!out_valid || out_ready)", "wire pop = !empty"),
            ("if (pop) out_valid <= 1'b1;", "if (pop || write) out_valid <= 1'b1;"),
        ],
        "in_order out_in_order data_holds no_underflow",
    ),
    ("fifo", 11, [("else if (out_ready) out_valid", "else out_valid")], "valid_holds"),
    (
        "receiver",
        8,
        [
            ("beam <= next_beam;", "beam <= next_beam + (next_beam == 5'd1);"),
            ("wire        go = slot && room;", "wire        go = slot;"),
            ("ev_dropped <= drop;", "ev_dropped <= drop && !in_data[24];"),
            ("(take && last && !bottom);", "(take && last && !bottom && !starts);"),
        ],
        "beams_in_order no_beat_without_room no_ready_without_room dropped_is_told short_is_told",
    ),
    (
        "receiver",
        9,
        [
            ("next_beam <= 5'd0;\n                    done", "next_beam <= 5'd29;\n                    done"),
            ("ev_long_column <= closes && !last;", "ev_long_column <= closes && !last && !ends;"),
            ("ev_column <= closes;", "ev_column <= closes && last;"),
            ("data <= take ? in_data[23:0] : 24'd0;", "data <= in_data[23:0];"),
            ("else if (state != RUN) marked <= 1'b0;", "else if (state == EDGE) marked <= 1'b1;"),
        ],
        "long_is_told column_is_counted edge_is_empty mark_is_a_columns none_lost",
    ),
    ("receiver", 6, [("if (bottom) state <= EDGE;", "state <= SYNC;")], "between_columns"),
    (
        "destagger",
        8,
        [
            ("beam <= 5'd0;\n                    taken", "beam <= 5'd30;\n                    taken"),
            ("wire cut_column = starts && !top;", "wire cut_column = 1'b0;"),
            ("waiting <= DELAY;", "waiting <= 0;"),
            ("last1 <= bottom;", "last1 <= last;"),
            ("starts1 <= top && given == 16'd0;", "starts1 <= given == 16'd0;"),
            ("ev_dropped <= drop;", "ev_dropped <= drop && !last;"),
            ("(take && last && !bottom);", "(take && last && !bottom && !ends);"),
            ("slot == SLOTS - 1 ?", "slot == SLOTS ?"),
            ("else if (ending) state", "else if (ending && last) state"),
        ],
        "last_with_beam_31 whole_columns starts_on_top dropped_is_told short_is_told flushes",
    ),
    (
        "destagger",
        11,
        [
            ("waiting <= DELAY;", "waiting <= 0;"),
            ("state <= PAD;", "state <= SYNC;"),
            ("assign move = !full1 || back_ready;", "assign move = 1'b1;"),
        ],
        "between_columns stage_holds",
    ),
    (
        "destagger",
        9,
        [
            ("slot <= {BITS{1'b0}};", "slot <= {BITS{1'b1}} - 1'b1;"),
            ("slot == SLOTS - 1 ?", "slot == SLOTS ?"),
            ("beam <= 5'd0;\n                    taken", "beam <= 5'd30;\n                    taken"),
        ],
        "slot_within",
    ),
    (
        "registers",
        5,
        [
            ("running <= enable && reset_count[RESET_BITS];", "running <= ev_column;"),
            ("enable <= 1'b0;", "enable <= ev_frame;"),
            ("else if (!reset_count[RESET_BITS]) reset_count", "else reset_count"),
            (
                "events <= (events & ~cleared) | set;",
                "events <= (events | {set[9:0], set[10]}) & ~{11{ev_long_frame}};",
            ),
            ("irq <= |(events & irq_enable);", "irq <= |events;"),
            ("dropped <= dropped + ev_dropped;", "dropped <= dropped + 2 * ev_dropped;"),
            ("columns_out <= columns_out + (out_beat && out_last);", "columns_out <= columns_out + out_beat;"),
            ("errors <= errors + error;", "errors <= errors + ev_short_column + ev_long_column;"),
            ("misses <= misses + miss;", "misses <= misses + 1;"),
        ],
        "long_reset stops_at_once flags_stay flags_come flags_only_so interrupt "
        "counts_dropped counts_columns counts_errors counts_misses",
    ),
    (
        "registers",
        7,
        [
            (
                "else if (!reset_count[RESET_BITS]) reset_count <= reset_count + 1'b1;",
                "else reset_count <= reset_count + 2'd2;",
            ),
            ("enable <= 1'b0;", "enable <= 1'b1;"),
            ("if (rst || clear) {frames_in", "if (rst) {frames_in"),
            ("enable || write_data[31:16] != 16'd0 || write_data[15:2] == 14'd0", "1'b0"),
        ],
        "reset_counts clears columns_fixed columns_within",
    ),
    (
        "registers",
        5,
        [
            ("if (ev_swapped) begin", "if (ev_swapped || ev_frame) begin"),
            ("{second, refused, swap, bank} <= 4'b0000;", "{second, refused, swap, bank} <= 4'b0010;"),
            ("{count, length_r, expected_r, model_r} <= {4{32'd0}};", "{count, length_r, expected_r} <= {3{32'd1}};"),
            ("weights <= {load,", "weights <= {load || ev_column,"),
            ("if (asked && sound) swap", "if (ev_dropped) swap"),
        ],
        "bank_with_swap swap_waits no_write_while_waiting sound_swap",
    ),
    (
        "registers",
        7,
        [
            ("running <= enable && reset_count[RESET_BITS];", "running <= 1'b1;"),
            ("deadline <= 32'd0;", "deadline <= 32'd1;"),
            ("in_columns + 16'd1 == columns;\n    wire [2:0]", "in_columns == 16'd0;\n    wire [2:0]"),
            ("assign set[EVENTS_DEADLINE] = miss;", "assign set[EVENTS_DEADLINE] = 1'b0;"),
        ],
        "deadline_told",
    ),
]


def labels(name: str) -> set[str]:
    return set(re.findall(r"(\w+): assert", simulators.sources()[CHECKS[name].files[-1]]))


@pytest.mark.parametrize("name", CHECKS)
def test_the_properties_hold(name):
    proof = prove(CHECKS[name])
    assert proof.holds, (proof.failed, proof.log)
    assert len(labels(name)) >= 7


def test_each_property_fails_in_a_broken_module():
    """Two solvers at a time."""

    def broken(mutant):
        name, clocks, edits, _ = mutant
        file = CHECKS[name].files[-1]
        text = simulators.sources()[file]
        for old, new in [*SIMPLER.get(name, []), *edits]:
            assert text.count(old) == 1, (file, old, text.count(old))
            text = text.replace(old, new)
        return prove(CHECKS[name], bounded=clocks, changed={file: text})

    with ThreadPoolExecutor(2) as pool:
        proofs = list(pool.map(broken, MUTANTS))
    for (name, _, edits, wanted), proof in zip(MUTANTS, proofs, strict=True):
        assert not proof.holds
        missed = set(wanted.split()) - set(proof.failed)
        assert not missed, (name, edits, missed, proof.failed)
    for name in CHECKS:
        shown = {label for other, _, _, wanted in MUTANTS if other == name for label in wanted.split()}
        assert shown == labels(name), (name, labels(name) - shown)


def test_sources_that_cannot_be_read_are_no_proof():
    with pytest.raises(ToolError, match="could not check upb_skid"):
        prove(CHECKS["skid"], changed={"upb_skid.sv": "module upb_skid"})


def test_a_missing_solver_is_named(monkeypatch, capsys):
    monkeypatch.setattr(tools, "_package", lambda name: None)
    monkeypatch.setattr(tools.shutil, "which", lambda name: None)
    assert main() == 2
    assert "z3-solver" in capsys.readouterr().err
