"""The report: complete, self-contained, honest about what is measured."""

from __future__ import annotations

import base64
import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from upbeam.power.report import (
    Panel,
    Picture,
    ReportError,
    plot_birds_eye,
    plot_close_up,
    plot_latency_histogram,
    plot_range_images,
    plot_timeline,
    verdict_line,
    write_report,
)

PNG = b"\x89PNG\r\n\x1a\n"


def _record(frame: int, latency_ms: float, **other: Any) -> dict[str, Any]:
    return {
        "frame": frame,
        "first_input_ns": frame * 50_000_000,
        "last_input_ns": (frame + 1) * 50_000_000,
        "output_ns": (frame + 1) * 50_000_000 + round(latency_ms * 1e6),
        "latency_ns": round(latency_ms * 1e6),
        "verdict": "missed" if latency_ms > 50 else "met",
        "missing_columns": 0,
        "mode": "network",
        "wait_ns": 10_000,
        "columns_received": 2048,
        "flushed": False,
        "explained": False,
    } | other


def _live(**other: Any) -> dict[str, Any]:
    ledger = [_record(k, 0.3 + 0.001 * k) for k in range(20)]
    ledger[7] = _record(7, 61.5, explained=True)
    ledger[9] = _record(9, 0.4, missing_columns=12, columns_received=2036)
    times = {"p50": 0.25, "p99": 0.5, "p999": 0.5, "max": 12345.678}
    counts = dict.fromkeys(
        ("frames_partial", "frames_empty", "packets_dropped_overflow", "columns_refused", "columns_incomplete"), 0
    )
    counts |= {"frames_begun": 20, "frames_met": 19, "frames_missed": 1, "packets_played": 3414, "packets_taken": 3413}
    counts |= {"packets_dropped_fault": 1, "columns_played": 40960, "columns_taken": 40948, "columns_missing": 12}
    return {
        "clock": "real",
        "rate_hz": 20.0,
        "columns": 2048,
        "columns_per_packet": 12,
        "deadline_ms": 50.0,
        "frames": 20,
        "misses": 1,
        "misses_unexplained": 0,
        "stopped": False,
        "latency_ms": {"p50": 0.31, "p90": 0.32, "p99": 61.5, "p999": 61.5, "max": 61.5, "mean": 3.4},
        "latency_histogram_ms": {},
        "pacer_lateness_us": times,
        "column_compute_us": times,
        "packet_compute_us": times,
        "counts": counts,
        "ledger": ledger,
        "drops": [{"packet": 1600, "at_ns": 5, "columns": 12, "cause": "fault"}],
        "stalls": [{"start_ns": 380_000_000, "duration_ns": 60_000_000, "cpu": 0}],
        "stalls_unlisted": 0,
        "witnesses": 2,
        "witnesses_bound": 2,
        "cpu": "avx2",
        "config": {"stall_threshold_ms": 2.0},
    } | other


class _Page(HTMLParser):
    """Collects what the page would fetch, its text, and whether its tags close."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.sources: list[str] = []
        self.open: list[str] = []
        self.text = ""
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.sources += [value or "" for name, value in attrs if name in ("src", "href", "srcset", "data", "poster")]
        if tag not in ("meta", "img", "br", "link"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def _write(folder: Path, pictures: tuple[Picture, ...] = (), **data: Any) -> tuple[_Page, str]:
    path = write_report(folder, {"live": _live()} | data, pictures)
    html = path.read_text(encoding="utf-8")
    page = _Page(html)
    assert page.open == []
    return page, html


def test_html_needs_nothing_else(tmp_path: Path) -> None:
    picture = Picture("A picture", plot_latency_histogram([0.3, 0.4], 50.0), "What it shows")
    page, html = _write(tmp_path / "new" / "folder", (picture,), source={"kind": "simulator"})
    assert len(page.sources) == 3
    for source in page.sources:
        prefix, content = source.split(",", 1)
        assert prefix == "data:image/png;base64"
        png = base64.b64decode(content, validate=True)
        assert png.startswith(PNG)
        assert b"http" not in png
    without_pictures = re.sub(r'src="data:[^"]*"', "", html)
    assert not re.search(r"https?:|//[a-z]|url\(|@import|<script|<link", without_pictures)
    assert "What it shows" in page.text


def test_page_tells_what_happened(tmp_path: Path) -> None:
    page, html = _write(
        tmp_path,
        operations={"macs_per_frame_executed": 12189696, "layers": [{"name": "conv1"}, {"name": "linear_2"}]},
        environment={"cpu": {"name": "a <fast> one", "flags": ["avx2", "fma"]}, "threads": None},
        notes=["Other work ran on the machine."],
    )
    for part in (
        "20 frames, 1 missed 50 ms, p99 61.5 ms (measured)",
        "1 missed, 0 of them not explained",
        "3414 packets sent",
        "3413 taken + 1 dropped by an ordered fault + 0 by overflow",
        "40948 taken + 12 never arrived",
        "12\u202f189\u202f696",
        "cpu.name",
        "layers.2.name",
        "linear_2",
        "a <fast> one",
        "avx2, fma",
        "Other work ran on the machine.",
        "2 witness threads, one bound to each core,",
        "the longest 60.0 ms",
        "12346",
    ):
        assert part in " ".join(page.text.split()) or part in page.text, part
    assert "<fast>" not in html  # escaped
    assert 'class="bad"' in html


def test_virtual_times_are_called_modelled(tmp_path: Path) -> None:
    live = _live(clock="virtual", misses=0, stalls=[], witnesses=0, witnesses_bound=0)
    live["ledger"] = [r for r in live["ledger"] if r["verdict"] == "met"]
    page, html = _write(tmp_path, live=live)
    assert "measured" not in page.text.replace("as measured", "")
    assert "modelled" in page.text
    assert "No frame missed its deadline of 50.0 ms." in page.text
    assert 'class="bad"' not in html


def test_json_round_trips(tmp_path: Path) -> None:
    data = {"live": _live(), "operations": {"macs": 12}, "notes": ["ä"]}
    write_report(tmp_path, data)
    assert json.loads((tmp_path / "report.json").read_text(encoding="utf-8")) == data


def test_long_lists_are_cut_in_the_page_alone(tmp_path: Path) -> None:
    live = _live(ledger=[_record(k, 70.0) for k in range(80)], misses=80, misses_unexplained=80)
    page, _ = _write(tmp_path, live=live)
    assert "30 more in report.json" in page.text
    assert len(json.loads((tmp_path / "report.json").read_text())["live"]["ledger"]) == 80


def test_a_run_without_frames(tmp_path: Path) -> None:
    live = _live(ledger=[], latency_ms={}, misses=0, frames=0, stopped=True, stalls=[])
    live |= {"pacer_lateness_us": {}, "column_compute_us": {}, "packet_compute_us": {}}
    page, _ = _write(tmp_path, live=live)
    assert "0 frames, 0 missed 50 ms, stopped early" in page.text


@pytest.mark.parametrize("data", [{}, {"live": _live(), "notes": [float("nan")]}, {"live": _live(), "notes": [b"x"]}])
def test_nothing_is_written_for_bad_data(tmp_path: Path, data: dict[str, Any]) -> None:
    with pytest.raises(ReportError):
        write_report(tmp_path / "out", data)
    assert not (tmp_path / "out").exists()


def test_verdict_line_of_one_frame() -> None:
    live = _live(frames=1, misses=0, latency_ms={"p99": 0.3412}, clock="virtual")
    assert verdict_line(live) == "1 frame, 0 missed 50 ms, p99 0.341 ms (modelled)"


def test_pictures_of_every_kind(rng: np.random.Generator) -> None:
    image = rng.uniform(0, 90, (64, 360)) * (rng.random((64, 360)) > 0.2)
    cloud = rng.normal(0, 15, (500, 3))
    drawn = [
        plot_range_images([Panel("before", image[0::2]), Panel("after", image)]),
        plot_range_images([Panel("grey", np.where(image > 0, image, np.nan))], "intensity"),
        plot_birds_eye(cloud, cloud + 0.2),
        plot_birds_eye(cloud[:0], cloud[:0]),
        plot_close_up(cloud, cloud[:0]),
        plot_timeline(_live()["ledger"], 50.0, _live()["stalls"]),
        plot_latency_histogram([0.0, 200.0], 50.0),
        plot_latency_histogram([], 50.0),
        plot_timeline([], 50.0, []),
    ]
    assert all(png.startswith(PNG) and len(png) > 2000 for png in drawn)


def test_pictures_are_the_same_every_time() -> None:
    assert plot_latency_histogram([0.3, 0.31], 50.0) == plot_latency_histogram([0.3, 0.31], 50.0)


def test_unknown_kind_of_image() -> None:
    with pytest.raises(ValueError, match="expected 'distance' or 'intensity'"):
        plot_range_images([Panel("?", np.ones((2, 8)))], "colour")
