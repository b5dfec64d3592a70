"""Latency models: operation counts against the code that runs them, prediction against a recorded run, properties."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from upbeam.power.bench import _native
from upbeam.power.catalogue import cpu_core
from upbeam.power.cycles.cpu import cpu_time
from upbeam.power.cycles.fpga import FpgaCore, FpgaCoreError, smallest_core
from upbeam.power.cycles.gpu import gpu_latency, window_work
from upbeam.power.cycles.host import HostRun, core_of, measure_host, predictions, worst_error
from upbeam.power.cycles.kernel_ops import ISAS, kernel_ops
from upbeam.power.figures import Figure
from upbeam.power.ops import count_operations
from upbeam.quant.export.rtl_schedule import folds
from upbeam.runtime.upsampler import load_model

RUN = Path(__file__).parent / "baselines" / "cpu_kernels.json"
GOAL = 0.20


@pytest.fixture(scope="module")
def run():
    return HostRun.from_dict(json.loads(RUN.read_text())["run"])


def test_counts_are_those_of_the_loops_that_run_them():
    """Every instruction set this machine has; on others than x86 there are no such loops."""
    for mix in _native.mixes():
        ops = kernel_ops(mix["isa"], mix["precision"])
        for part in ("pair", "leaky", "rest"):
            counted = {k: v for k, v in mix[part].items() if v}
            assert {k: v for k, v in getattr(ops, part).items() if v} == counted, (mix["isa"], mix["precision"], part)
    print(f"{len(_native.mixes())} kernels compared")


def test_a_recorded_run_is_predicted_within_20_percent(run):
    """Calibrated on plain C and AVX2 float at two widths; AVX-512, integers and other widths are predicted."""
    found = predictions(run)
    assert {case.isa for case, _ in found} >= {"avx2", "avx512", "avx512-vnni"}
    assert {case.precision for case, _ in found} == {"fp32", "int16", "int8"}
    assert len({case.hidden for case, _ in found}) >= 5
    case, error = worst_error(run)
    print(f"worst of {len(found)}: {case.isa} {case.precision} {case.work}, {case.hidden} units: {100 * error:+.1f} %")
    for case, ns in found:
        assert abs(ns / case.ns - 1) <= GOAL, case


def test_the_calibration_sees_only_what_it_may(run):
    """Times of every other kernel can be anything: the core stays the same."""
    others = [c for c in run.cases if not c.is_calibration]
    assert all(c.isa not in ("scalar", "avx2") or c.precision != "fp32" or c.hidden not in (4, 24) or c.work == "push"
               for c in others)  # fmt: skip
    wild = tuple(replace(c, ns=c.ns if c.is_calibration else 9 * c.ns) for c in run.cases)
    assert core_of(replace(run, cases=wild)) == core_of(run)


@pytest.mark.skipif(not _native.loop_names(), reason="no micro-benchmarks for this machine's instruction set")
def test_a_run_on_this_machine():
    """One short round: the calibration works; errors are printed, never asserted, since wall-clock is shared."""
    file = load_model().file
    live = measure_host(file, rounds=1, widths=(8,))
    core, found = core_of(live), predictions(live)
    assert core.mixed_per_cycle > 0
    assert core.scalar is not None
    assert all(ns > 0 for _, ns in found)
    assert HostRun.from_dict(json.loads(json.dumps(live.as_dict()))) == live
    case, error = worst_error(live)
    print(f"worst of {len(found)}: {case.isa} {case.precision} {case.work}: {100 * error:+.1f} %")


CORES = ("cortex-a57", "carmel", "cortex-a78ae")
ISA_OF = {"cortex-a57": "neon", "carmel": "neon", "cortex-a78ae": "neon-dot"}
PRECISION = st.sampled_from(("fp32", "int16", "int8"))


@given(st.sampled_from(CORES), PRECISION, st.integers(1, 32), st.floats(0.1, 6.0), st.floats(1.0, 4.0))
def test_a_faster_clock_never_raises_latency(name, precision, pairs, clock, faster):
    core = cpu_core(name)
    slow, fast = (cpu_time(core, ISA_OF[name], precision, (pairs, 0), c) for c in (clock, clock * faster))
    for a, b in ((slow.kernels, fast.kernels), (slow.push, fast.push)):
        assert all(y <= x * (1 + 1e-12) for x, y in zip(a.span("ns"), b.span("ns"), strict=True))
        assert a.low <= a.value <= a.high


@given(st.sampled_from(CORES), PRECISION, st.integers(0, 31), st.integers(0, 31), st.integers(0, 8))
def test_more_units_never_take_less(name, precision, plain, leaky, more):
    core = cpu_core(name)

    def of(a, b):
        return cpu_time(core, ISA_OF[name], precision, (a, b), 1.5).kernels.value

    assert of(plain + more, leaky) >= of(plain, leaky)
    assert of(plain, leaky + more) >= of(plain, leaky)
    assert of(plain, leaky + 1) >= of(plain + 1, leaky)


def test_the_pair_cycles_of_docs_performance():
    """12 units, both networks: 58 cycles a window for the loops alone on the Cortex-A57 model, float."""
    core = replace(cpu_core("cortex-a57"), mixed_per_cycle=1e12, exposed_cycles=0.0)
    cycles = cpu_time(core, "neon", "fp32", (12, 0), 1.0).kernels.value
    assert cycles / 32 == pytest.approx(58, rel=0.01)


def test_memory_bounds_the_time_from_below():
    core = cpu_core("cortex-a57")
    fast, slow = (cpu_time(core, "neon", "int8", (12, 0), 1.5, gb_per_s=x).push.value for x in (25.6, 0.01))
    assert fast == cpu_time(core, "neon", "int8", (12, 0), 1.5).push.value
    assert slow == pytest.approx(288 / 0.01)


def test_unknown_instruction_sets_and_precisions():
    with pytest.raises(ValueError, match="no operation counts for 'sse'"):
        kernel_ops("sse", "fp32")
    with pytest.raises(ValueError, match="precision 'fp16'"):
        kernel_ops("avx2", "fp16")
    assert all(isa.blocks * isa.windows == 32 for isa in ISAS.values())


# ------------------------------------------------------------------------------------------------------------- FPGA


CORES = [FpgaCore(lanes, fold) for fold in folds(12) for lanes in range(1, fold + 1) if fold % lanes == 0]


@given(st.sampled_from(CORES), st.integers(1, 300))
def test_frames_are_columns_and_a_latency(core, columns):
    """That the clocks are the simulated core's: tests/hw_sim/test_fpga_cycles.py."""
    assert core.column_cycles == 32 * core.fold // core.lanes
    assert core.frame_cycles(columns + 1) - core.frame_cycles(columns) == core.column_cycles
    assert 0 < core.column_latency_cycles < core.frame_cycles(columns)


def test_one_window_per_clock():
    """Both networks side by side: one input beat per clock decides."""
    assert FpgaCore(1, 1).frame_cycles(2048) <= 65_536 * 1.01 + 200
    assert FpgaCore(1, 1).multipliers == 0
    assert FpgaCore(1, 12).multipliers == 16
    assert FpgaCore(2, 24).multipliers == 16
    assert FpgaCore(1, 96).multipliers == 2


@given(st.integers(2, 2000), st.integers(1, 32))
def test_the_smallest_core_fits_and_no_smaller_fold_does(multipliers, hidden):
    core = smallest_core(multipliers, hidden)
    usable = max(min(multipliers, 8), int(multipliers * 0.8))
    assert core.multipliers <= usable
    assert all(FpgaCore(1, f, hidden).multipliers > usable for f in folds(hidden) if 1 < f < core.fold)


def test_impossible_cores():
    for bad in ({"lanes": 0}, {"lanes": 2}, {"fold": 0}, {"fold": 97}, {"hidden": 0}, {"hidden": 33}):
        with pytest.raises(FpgaCoreError):
            FpgaCore(**bad)
    with pytest.raises(FpgaCoreError, match="at least 2"):
        smallest_core(1, 12)
    with pytest.raises(FpgaCoreError, match="columns 0"):
        FpgaCore().frame_cycles(0)


@given(st.floats(1, 500), st.floats(1, 5), st.sampled_from(CORES))
def test_fpga_latency_falls_with_the_clock(mhz, faster, core):
    slow, fast = (core.latency(Figure.within(f, 1.2, "MHz", "assumption", "x"), 100) for f in (mhz, mhz * faster))
    assert slow.low <= slow.value <= slow.high
    assert fast.value <= slow.value * (1 + 1e-12)


# -------------------------------------------------------------------------------------------------------------- GPU


@given(st.floats(1e9, 1e15), st.floats(1e9, 1e12), st.floats(1.0, 10.0), st.integers(1, 32))
def test_gpu_latency_holds_its_value_and_falls_with_the_peak(peak, bandwidth, faster, hidden):
    work = window_work(count_operations((8, 2, hidden)))
    share = Figure(0.11, 0.09, 0.13, "1", "modelled", "x")
    launch = Figure(10.0, 4.0, 30.0, "us", "assumption", "x")

    def at(macs, byte_rate):
        return gpu_latency(work, Figure.exact(macs, "MAC/s", "data sheet", "x"), share,
                           Figure.exact(byte_rate, "B/s", "data sheet", "x"), launch)  # fmt: skip

    base = at(peak, bandwidth)
    assert base.low <= base.value <= base.high
    assert at(peak * faster, bandwidth).value <= base.value
    assert at(peak, bandwidth * faster).value <= base.value
    assert base.low >= 2 * 0.004
