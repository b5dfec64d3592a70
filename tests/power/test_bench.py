"""The benchmark: nothing is timed before its output was compared; ratios are what they say; no time is asserted."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from upbeam.power.bench import _native, plain
from upbeam.power.bench.bench import Benchmark, Settings, benchmark, make_work, ratios
from upbeam.power.bench.contest import Candidate, Entry, alternate
from upbeam.power.bench.machine import Bound, Peak, Peaks, measure_peaks
from upbeam.power.bench.ours import kernel_candidates, make_job, usable_cpus
from upbeam.power.bench.peers import PEERS, PeerPool, missing_peers, pool
from upbeam.power.bench.peers.formulation import Formulation
from upbeam.power.bench.plain import COMPILERS, FLAGS, Built, CompileError, build_all, plain_candidate
from upbeam.power.bench.plot import plot_times
from upbeam.power.bench.tables import tables
from upbeam.power.bench.work import DifferenceError, Work, check_image, check_windows, synthetic_frame
from upbeam.runtime.upsampler import load_model

COLUMNS = 96


@pytest.fixture(scope="module")
def work() -> Work:
    file = load_model().file
    made, notes = make_work(file, synthetic_frame(COLUMNS, file.rules.distance_unit_m))
    assert made.file.precisions == ["fp32", "int16", "int8"]
    assert (len(notes) == 0) == (file.precisions == made.file.precisions)
    return made


@pytest.fixture(scope="module")
def run(work: Work) -> Benchmark:
    settings = Settings(threads=(1, 2), peers=("numpy", "onnxruntime"), columns=(64, 128), quick=True)
    return benchmark(work.file, (work.distance, work.intensity), settings)


def _times(*ms: float) -> Callable[[int], Any]:
    taken = iter(list(ms) * 1000)
    return lambda repeats: np.array([round(next(taken) * 1e6) for _ in range(repeats)], np.uint64)


def _candidate(name: str, ms: float, group: str = "ours", precision: str = "fp32", **detail: Any) -> Candidate:
    return Candidate(name, precision, 1, "all", _times(ms), lambda: None, group, detail)


# ---------------------------------------------------------------------------------------------------------- checking


def test_a_wrong_candidate_is_refused_and_never_timed() -> None:
    timed: list[str] = []

    def time(repeats: int) -> Any:
        timed.append("wrong")
        return np.full(repeats, 1000, np.uint64)

    def check() -> None:
        raise DifferenceError("distance of window 7: 5, ours 4")

    wrong = replace(_candidate("wrong", 1.0), time=time, check=check)
    entries, refused = alternate([wrong, _candidate("right", 2.0)], 3)
    assert [e.candidate.name for e in entries] == ["right"]
    assert refused == ["wrong: refused, not timed: distance of window 7: 5, ours 4"]
    assert not timed


def test_candidates_take_turns() -> None:
    order: list[str] = []

    def named(name: str) -> Candidate:
        def time(repeats: int) -> Any:
            order.append(name)
            return np.full(repeats, 5_000_000, np.uint64)

        return replace(_candidate(name, 1.0), time=time)

    entries, _ = alternate([named("a"), named("b")], 3)
    assert order == ["a", "b", *["a", "b"] * 3]
    assert [len(e.ns) for e in entries] == [3, 3]  # of each turn the first repetition warms up


def test_an_entry_has_minimum_and_median() -> None:
    entry = Entry(_candidate("x", 1.0), [3e6, 1e6, 2e6])
    assert (entry.ms_min, entry.ms_median) == (1.0, 2.0)


@pytest.mark.parametrize("precision", ["fp32", "int16", "int8"])
def test_an_image_is_compared_point_by_point(work: Work, precision: str) -> None:
    distance, intensity = (x.copy() for x in work.generated(precision))
    check_image(work, precision, distance, intensity)
    if precision != "fp32":
        distance[3, 5] += 1
        with pytest.raises(DifferenceError, match=r"1 of .* points differ, the first at window 3, column 5"):
            check_image(work, precision, distance, intensity)
    distance[:, :10] += 1
    with pytest.raises(DifferenceError, match="distance"):
        check_image(work, precision, distance, intensity)
    with pytest.raises(DifferenceError, match="expected"):
        check_image(work, precision, distance[:-1], intensity[:-1])


def test_network_outputs_are_compared_up_to_rounding(work: Work) -> None:
    distance, intensity = (x.copy() for x in work.raw)
    check_windows(work, distance * (1 + 1e-8), intensity)
    distance[11] += 1.0
    with pytest.raises(DifferenceError, match="distance of window 11"):
        check_windows(work, distance, intensity)
    distance[11] = np.nan
    with pytest.raises(DifferenceError, match="distance of window 11"):
        check_windows(work, distance, intensity)


def test_windows_given_to_peers_make_our_outputs(work: Work) -> None:
    unit = work.file.rules.distance_unit_m
    outputs = [net(x) for net, x in zip(work.file.folded, work.window_inputs, strict=True)]
    check_windows(work, outputs[0] / unit, outputs[1])


# --------------------------------------------------------------------------------------------------------- C parts


@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize("precision", ["fp32", "int16", "int8"])
def test_kernels_give_the_reference_for_any_number_of_threads(work: Work, precision: str, threads: int) -> None:
    for cpu in usable_cpus(load_model()):
        for candidate in kernel_candidates(work, precision, cpu, (threads,)):
            candidate.check()
            assert len(candidate.time(3)) == 3


def test_a_latency_counts_every_column(work: Work) -> None:
    found = make_job(work, "fp32", "scalar", "push").latency(500, 0)
    assert found["columns"] == 499  # the first push finishes nothing
    assert 0 < found["p50_ns"] <= found["p999_ns"] <= found["max_ns"]


def test_a_job_refuses_what_cannot_be(work: Work) -> None:
    with pytest.raises(ValueError, match=r"instruction set|CPU|machine"):
        make_job(work, "fp32", next(c for c in ("neon", "avx2") if c not in usable_cpus(load_model())), "kernels")
    with pytest.raises(ValueError, match=r"argument|range"):
        make_job(work, "fp32", "scalar", "push", threads=2)


def test_loops_count_what_they_run() -> None:
    for mix in _native.mixes():
        assert mix["windows"] in (8, 16, 32)
        assert mix["pair"]["multiply_add"] >= 16
        assert set(mix["leaky"]) == {"multiply"}
        assert set(mix["rest"]) <= {
            "multiply_add", "add", "minmax", "compare", "blend", "logic", "shift", "convert", "shuffle", "load",
            "store",
        }  # fmt: skip
        for pairs in [((2, 0), (200, 0)), ((0, 2), (0, 200))]:
            few, many = (min(_native.mix_ns(mix["isa"], mix["precision"], *n, 1) for _ in range(3)) for n in pairs)
            assert 0 < few < many
    with pytest.raises(ValueError, match="no loop"):
        _native.loop_ns("avx2", "nonsense")
    with pytest.raises(ValueError, match="no mix"):
        _native.mix_ns("nonsense", "fp32", 4, 0)


def test_peaks_have_a_clock_and_all_precisions() -> None:
    peaks = measure_peaks((12, 0), repeats=1)
    assert peaks.clock_ghz > 0
    if _native.loop_names():
        for precision in ("fp32", "int16", "int8"):
            assert peaks.peak(precision, "no such instruction set") == max(
                p.macs_per_ns for p in peaks.peaks if p.kind == ("fma_f32" if precision == "fp32" else "dot_int16")
            )
    json.dumps(peaks.as_dict(), allow_nan=False)


# ------------------------------------------------------------------------------------------------------- compilers


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory, work: Work) -> list[Built]:
    found, notes = build_all(work.file.folded[0].hidden, tmp_path_factory.mktemp("plain"), quick=True)
    absent = [compiler for compiler in ("gcc", "clang") if shutil.which(compiler) is None]
    assert len(found) + len(notes) == 2
    assert [note.split(":")[0] for note in notes if "not on this machine" in note] == absent
    return found


@pytest.mark.parametrize("precision", ["fp32", "int16", "int8"])
def test_plain_c_is_the_same_network(built: list[Built], work: Work, precision: str) -> None:
    for one in built:
        plain_candidate(one, work, precision).check()


def test_plain_c_that_computes_something_else_is_refused(built: list[Built], work: Work) -> None:
    """The job of another frame: compiled code is held against ours, not against itself."""
    other = Work(work.ubm, *synthetic_frame(COLUMNS, work.file.rules.distance_unit_m, seed=1))
    for one in built:
        candidate, stranger = plain_candidate(one, work, "int16"), plain_candidate(one, other, "int16")
        swapped = replace(stranger, check=lambda c=candidate, s=stranger: (s.time(1), _checked_as(c, s, work)))  # type: ignore[misc]
        entries, refused = alternate([swapped], 1)
        assert not entries
        assert "refused, not timed" in refused[0]


FLUSHING = """
__attribute__((constructor)) static void flush_subnormals(void) {
#if defined(__x86_64__)
    __builtin_ia32_ldmxcsr(__builtin_ia32_stmxcsr() | 0x8040);
#elif defined(__aarch64__)
    unsigned long fpcr;
    __asm__ volatile("mrs %0, fpcr" : "=r"(fpcr));
    __asm__ volatile("msr fpcr, %0" : : "r"(fpcr | 1ul << 24));
#else
#error "no mode that flushes subnormals is known here"
#endif
}
"""


def _available_compilers() -> list[tuple[str, str]]:
    found = [(name, path) for name in COMPILERS if (path := shutil.which(name)) is not None]
    return found or pytest.skip(f"none of {', '.join(COMPILERS)} on this machine")


def _in_a_thread(function: Callable[..., Any], *arguments: Any) -> Any:
    """The floating-point mode belongs to the thread: what a library does to it ends with this one."""
    with ThreadPoolExecutor(1) as threads:
        return threads.submit(function, *arguments).result()


def test_plain_c_leaves_the_floating_point_mode_alone(tmp_path: Path) -> None:
    """Loaded libraries must not flush subnormals: SciPy's k-d tree then recurses until the stack is used up."""
    tried = 0

    def keeps(*arguments: Any) -> bool:
        plain._build(*arguments)
        return float(np.finfo(float).tiny) / 2 > 0

    for name, path in _available_compilers():
        for flags in FLAGS:
            try:
                assert _in_a_thread(keeps, name, path, flags, 0, 1, tmp_path), f"{name} {' '.join(flags)}"
                tried += 1
            except CompileError as error:
                print(f"{name} {' '.join(flags)}: not known ({error})")
    assert tried


def test_a_library_that_flushes_subnormals_is_refused(tmp_path: Path) -> None:
    library = tmp_path / "flushing.so"
    command = [_available_compilers()[0][1], "-x", "c", "-", "-shared", "-fPIC", "-o", str(library)]
    subprocess.run(command, input=FLUSHING, text=True, check=True)
    with pytest.raises(RuntimeError, match=r"flushing\.so: loading it made .* subnormal numbers as zero"):
        _in_a_thread(plain._load, library)


def _checked_as(_: Candidate, stranger: Candidate, work: Work) -> None:
    job: Any = stranger.time.__self__  # type: ignore[attr-defined]
    check_image(work, "int16", job.out_distance, job.out_intensity)


# ----------------------------------------------------------------------------------------------------------- peers


def test_missing_peers_say_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pool.importlib.util, "find_spec", lambda name: None if name == "openvino" else object())
    assert missing_peers(("numpy", "openvino")) == {
        "openvino": "openvino not installed: pip install 'upbeam[bench]'",
    }


def test_a_sabotaged_peer_is_refused(work: Work) -> None:
    """Its server compares what it computes with ours before any time is taken."""
    server = pool._Server("numpy_peer", 1, work, True)
    assert server.answer("next")["name"].startswith("NumPy")
    server.answer("check", 0)
    good = server._made[0]
    assert isinstance(good, Formulation)

    def sabotaged() -> tuple[Any, Any]:
        distance, intensity = good.output()
        distance[len(distance) // 2] += 3.0
        return distance, intensity

    server._made[0] = replace(good, output=sabotaged)
    with pytest.raises(DifferenceError, match="distance of window"):
        server.answer("check", 0)


@pytest.mark.parametrize("name", [name for name in PEERS if name not in ("torch", "opencl")])
def test_peers_do_the_same_work(work: Work, name: str) -> None:
    """In processes of their own; all but the slow graphs of the long run."""
    if missing_peers((name,)):
        pytest.skip(missing_peers((name,))[name])
    with PeerPool(work, quick=True) as peers:
        found = peers.candidates(name, 1)
        assert found
        assert not peers.notes
        assert {c.group for c in found} == {name}
        assert all(len(c.time(2)) == 2 for c in found)


def test_a_peer_that_breaks_is_named(work: Work, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(pool.PEERS, "numpy", replace(PEERS["numpy"], module="no_such_module"))
    with PeerPool(work, quick=True) as peers:
        assert peers.candidates("numpy", 1) == []
        assert "NumPy, 1 threads: ModuleNotFoundError" in peers.notes[0]


# ---------------------------------------------------------------------------------------------------------- a run


def test_a_quick_run_has_all_that_others_rely_on(run: Benchmark) -> None:
    data = json.loads(json.dumps(run.as_dict(), allow_nan=False))
    assert {"results", "ratios", "machine", "column_latency", "widths", "missing", "notes"} <= set(data)
    for result in data["results"]:
        assert {"name", "precision", "threads", "ms_min", "ms_median", "share_of_peak"} <= set(result)
        assert 0 < result["ms_min"] <= result["ms_median"]
    assert {
        "fp32_vs_best_runtime", "fp32_vs_gcc", "int16_vs_gcc", "int8_vs_gcc", "opencl_vs_fp32", "share_of_bound",
    } <= set(data["ratios"])  # fmt: skip
    names = [r["name"] for r in data["results"]]
    assert f"upbeam int8 {run.cpu}" in names
    assert any(name.startswith("NumPy") for name in names)
    assert {r["threads"] for r in data["results"] if r["group"] == "numpy"} == {1, 2}
    assert data["notes"] == run.notes
    assert {w["columns"] for w in data["widths"]} == {64, 128}


def test_a_run_has_tables_and_a_picture(run: Benchmark) -> None:
    found = tables(run)
    assert all(len(row) == len(part.columns) for part in found for row in part.rows)
    assert plot_times(run).startswith(b"\x89PNG")


def test_results_are_relative_to_peak_and_clock(run: Benchmark) -> None:
    peaks = Peaks(
        2.0, (Peak(run.cpu, "fma_f32", 100.0),), (Bound(run.cpu, "fp32", 50.0, {"multiply_add": 1.0}),), {}, 1.0
    )
    ms = 0.2
    entry = Entry(_candidate("upbeam", ms, kind="kernels", cpu=run.cpu), [ms * 1e6])
    made = Benchmark(run.work, run.cpu, run.settings, peaks, [entry])
    result = made.results()[0]
    macs = 2 * 31 * COLUMNS * 8 * run.work.file.folded[0].hidden
    assert result["macs_per_cycle"] == pytest.approx(macs / (ms * 1e6) / 2.0)
    assert result["share_of_peak"] == pytest.approx(macs / (ms * 1e6) / 100.0)
    assert result["share_of_bound"] == pytest.approx(50.0 * COLUMNS / (ms * 1e6))
    assert ratios(made)["share_of_bound"] == result["share_of_bound"]


def test_ratios_tell_how_many_times_faster_the_first_is(run: Benchmark) -> None:
    ours = {"kind": "kernels", "cpu": run.cpu}
    candidates = [
        _candidate("fp32", 0.2, **ours),
        _candidate("slower set", 0.1, kind="kernels", cpu="another"),
        _candidate("push", 0.3, kind="push", cpu=run.cpu),
        _candidate("int16", 0.1, precision="int16", **ours),
        _candidate("gcc", 0.3, "compiler", compiler="gcc"),
        _candidate("gcc int16", 0.5, "compiler", "int16", compiler="gcc"),
        _candidate("ort", 1.0, "onnxruntime", family="products"),
        _candidate("ov", 0.8, "openvino", family="image"),
        _candidate("paper", 20.0, "openvino", family="paper"),
        _candidate("jax", 0.4, "jax", family="image"),
        _candidate("cl", 0.25, "opencl", part="kernel"),
    ]
    found = ratios(replace(run, entries=[Entry(c, [c.time(1)[0]]) for c in candidates]))
    expected = {
        "fp32_vs_best_runtime": 4.0, "fp32_vs_best_runtime_all_rules": 4.0, "fp32_vs_paper_graph": 100.0,
        "fp32_vs_jax": 2.0, "fp32_vs_gcc": 1.5, "int16_vs_gcc": 5.0, "int8_vs_gcc": None, "fp32_vs_clang": None,
        "fp32_kernels_vs_push": 1.5, "int16_vs_fp32": 2.0, "opencl_vs_fp32": 0.8, "opencl_call_vs_fp32": None,
    }  # fmt: skip
    assert {key: found[key] for key in expected} == pytest.approx(expected)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"peers": ("nonsense",)}, "no peer 'nonsense', known: numpy"),
        ({"threads": (2,)}, "expected 1"),
        ({"threads": ()}, "expected 1"),
        ({"columns": (4,)}, "expected 8 to 65535"),
    ],
)
def test_settings_refuse_what_cannot_be(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Settings(**wrong)


def test_the_command_takes_its_options(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from upbeam.cli.bench import bench

    bench(threads="1", peers="none", columns="64", quick=True, report=tmp_path / "out", as_json=True)
    data = json.loads(capsys.readouterr().out)
    assert data["ratios"]["fp32_vs_best_runtime"] is None
    assert (tmp_path / "out" / "bench.html").read_text(encoding="utf-8").count("<table>") == 9
    assert json.loads((tmp_path / "out" / "bench.json").read_text(encoding="utf-8")) == data
    assert (tmp_path / "out" / "bench.png").stat().st_size > 10_000
    with pytest.raises(ValueError, match="--threads 'x': expected whole numbers"):
        bench(threads="x")
