"""The power model against the measured rows: leave-one-out errors, kept in a baseline; what it must never do."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from upbeam.power.energy import fit, leave_one_out, measured_rows, skill, worst_factors

BASELINE = Path(__file__).parent / "baselines" / "leave_one_out.json"
WHATS = ("power", "latency", "energy")


@pytest.fixture(scope="module")
def results():
    return leave_one_out(measured_rows())


def boards(results):
    """Boards with two or more measured workloads."""
    work = [x.row.device for x in results if not x.row.is_idle and x.row.boundary == "board"]
    return sorted({name for name in work if work.count(name) > 1})


def test_published_energies_are_power_times_latency():
    for row in measured_rows():
        if row.energy_uj is not None and not row.note:
            assert row.energy_mj * 1e3 == pytest.approx(row.energy_uj, rel=0.02), row


def test_leave_one_out_errors_are_those_of_the_baseline(results):
    baseline = {x["row"]: x for x in json.loads(BASELINE.read_text())["rows"]}
    assert set(baseline) == {f"{x.row.device}: {x.row.workload}" for x in results}
    for x in results:
        kept = baseline[f"{x.row.device}: {x.row.workload}"]
        for what in WHATS:
            if kept[what] is None:
                assert x.factor(what) is None
            else:
                assert x.factor(what) == pytest.approx(kept[what], rel=1e-3), (x.row, what)


def test_power_of_boards_with_two_rows_is_within_1_15(results):
    assert boards(results) == ["xc7a100t", "xc7z020"]
    for name in boards(results):
        own = [x for x in results if x.row.device == name]
        print(f"{name}: worst factor {worst_factors(results, name)}, skill {[skill(own, w) for w in WHATS]}")
        assert worst_factors(results, name)["power"] <= 1.15


def test_energy_with_the_latency_given_is_within_1_4_at_work(results):
    """Power times the given latency: the same factor. Every device at work, chips too; devices at rest are printed."""
    worst = max((x for x in results if x.power_w is not None and not x.row.is_idle), key=lambda x: x.factor("power"))
    rest = max((x for x in results if x.power_w is not None and x.row.is_idle), key=lambda x: x.factor("power"))
    print(f"at work: {worst.row.device} {worst.row.workload} {worst.factor('power'):.3f}")
    print(f"at rest: {rest.row.device} {rest.factor('power'):.3f}")
    assert worst.factor("power") <= 1.4


def test_from_macs_alone_the_error_is_large_and_printed(results):
    for what in ("latency", "energy"):
        worst = max((x for x in results if x.factor(what) is not None), key=lambda x: x.factor(what))
        print(f"{what} from MACs alone: {worst.row.device} {worst.row.workload}: factor {worst.factor(what):.1f}")
    assert max(x.factor("energy") for x in results if x.factor("energy")) > 10


def test_a_row_left_out_has_no_say(results):
    rows = measured_rows()
    for k, row in enumerate(rows):
        changed = [*rows]
        changed[k] = replace(row, power_w=100 * row.power_w)
        again = leave_one_out(changed)[k]
        assert (again.power_w, again.latency_ms) == (results[k].power_w, results[k].latency_ms)


def test_perfect_data_is_recovered():
    """Rows made by the model are found again, and leaving one out costs nothing."""
    base = [r for r in measured_rows() if r.family == "fpga-board"]
    static = {"xc7z020": 1.5, "xc7a100t": 2.5}
    rows = [replace(r, power_w=static[r.device] + 3e-12 * r.scaled_rate) for r in base]
    model = fit(rows)
    assert model.dynamic_j["fpga-board"] == pytest.approx(3e-12)
    assert model.static_w == pytest.approx(static)
    assert all(x.factor("power") == pytest.approx(1.0) for x in leave_one_out(rows))


@given(st.sampled_from(measured_rows()), st.floats(1.0, 1e3), st.floats(1.0, 1e3))
def test_more_work_never_costs_less(row, more, slower):
    """More multiply-accumulates in the same time, or the same for longer."""
    model = fit(measured_rows())
    assert model.power_w(replace(row, macs=row.macs * more)) >= model.power_w(row)
    longer = replace(row, latency_ms=row.latency_ms * slower)
    assert model.power_w(longer) * longer.latency_ms >= model.power_w(row) * row.latency_ms * (1 - 1e-12)
