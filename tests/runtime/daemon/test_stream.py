"""The column stream carries the bits of ``upb_stream`` fed directly, and what belongs to each column."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from daemon_feed import SENSORS, Feed, Packet, finish, model_file, run

from upbeam.runtime import _native
from upbeam.runtime.daemon import Column, ColumnStreamError, Daemon, Outputs, frames, read_columns
from upbeam.runtime.daemon.column_stream import INCOMPLETE, INSERTED, LAST, SECOND

PRECISIONS = {"fp32": 0, "int16": 1, "int8": 2}


def daemon_for(feed: Feed, **settings: Any) -> Daemon:
    return Daemon(model_file(feed.sensor), {"sensor": SENSORS[feed.sensor], **settings})


def columns_of(out: Outputs) -> list[Column]:
    return [column for _, data in out.columns for column in read_columns(data)]


def played(feed: Feed, packets: list[Packet], **settings: Any) -> tuple[Daemon, Outputs]:
    daemon = daemon_for(feed, **settings)
    last = run(daemon, packets)
    return daemon, finish(daemon, last)


def direct(feed: Feed, precision: str, columns: int) -> Any:
    """The feed's firings through the stream alone: [n, 64] distances and intensities."""
    assert feed.firings is not None
    model = _native.Model(model_file(feed.sensor))
    stream = _native.Stream(model, precision=precision, columns=columns, any_sensor=True)
    parts = [stream.push(feed.firings.distance, feed.firings.intensity, 0), stream.flush()]
    return [np.concatenate([part[i] for part in parts]) for i in (0, 1)]


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("sensor", SENSORS)
def test_bits_are_the_streams(sensor: str, precision: str) -> None:
    feed = Feed(sensor)
    daemon, out = played(feed, feed.make(2.2), precision=PRECISIONS[precision])
    columns = columns_of(out)
    distance, intensity = direct(feed, precision, daemon.status["columns"])
    assert feed.firings is not None
    assert len(columns) == len(feed.firings) == len(distance)
    np.testing.assert_array_equal(np.stack([c.distance for c in columns]), distance)
    np.testing.assert_array_equal(np.stack([c.intensity for c in columns]), intensity)
    assert np.count_nonzero(distance[:, 1::2]) > 1000, "nothing was generated: the test says nothing"


@pytest.mark.parametrize("sensor", SENSORS)
def test_columns_keep_azimuth_time_and_frame(sensor: str) -> None:
    feed = Feed(sensor, rpm=1200)
    daemon, out = played(feed, feed.make(3.3))
    columns = columns_of(out)
    firings = feed.firings
    assert firings is not None
    np.testing.assert_array_equal([c.azimuth_mdeg for c in columns], firings.azimuth_mdeg)
    period = 3_600 * 10**9
    times = np.array([c.time_ns for c in columns], np.int64) % period
    behind = firings.time_ns.astype(np.int64) % period - times
    assert 0 <= behind.min() <= behind.max() < 1000, "packets carry whole microseconds"
    cut = 180_000  # of the model: frames begin where the azimuth passes it
    crossed = np.concatenate([[0], np.cumsum(np.diff((firings.azimuth_mdeg.astype(int) - cut) % 360_000) < 0)])
    np.testing.assert_array_equal([c.frame for c in columns], crossed)
    for frame in range(int(crossed[-1]) + 1):
        own = [c for c in columns if c.frame == frame]
        assert [c.column for c in own] == list(range(len(own)))
        assert [bool(c.flags & LAST) for c in own] == [False] * (len(own) - 1) + [True]
    sequence = [read_columns(data)[0].sequence for _, data in out.columns]
    assert sequence == list(range(len(sequence)))
    assert daemon.counters["columns_out"] == len(columns)


def test_frames_reads_images() -> None:
    feed = Feed()
    _, out = played(feed, feed.make(2.5))
    images = list(frames(data for _, data in out.columns))
    assert [image.frame for image in images] == [0, 1, 2]
    assert images[1].distance.shape == (64, len(images[1].azimuth_mdeg))
    assert abs(images[1].distance.shape[1] - feed.columns) <= 1
    assert images[1].complete


def test_lost_packets_become_inserted_columns() -> None:
    feed = Feed()
    packets = feed.make(2.5)
    lost = set(range(100, 103)) | {150}
    daemon, out = played(feed, [p for i, p in enumerate(packets) if i not in lost])
    columns = columns_of(out)
    firings = feed.firings
    assert firings is not None
    assert len(columns) == len(firings)
    inserted = np.array([bool(c.flags & INSERTED) for c in columns])
    expected = np.isin(np.arange(len(firings)) // 12, list(lost))
    np.testing.assert_array_equal(inserted, expected)
    assert all(c.flags & INCOMPLETE and not c.distance[::2].any() for c, i in zip(columns, inserted, strict=True) if i)
    azimuths = np.array([c.azimuth_mdeg for c in columns]).astype(int)
    apart = (azimuths - firings.azimuth_mdeg.astype(int) + 180_000) % 360_000 - 180_000
    assert np.abs(apart).max() <= 10, "an inserted column lies where its firing was"
    counters = daemon.counters
    assert counters["firings_inserted"] == 12 * len(lost)
    assert sum(record["missing_columns"] for record in out.ledger) == 12 * len(lost)


@pytest.mark.parametrize("sensor", SENSORS)
def test_second_returns_pass_through_beside_their_column(sensor: str) -> None:
    feed = Feed(sensor, dual=True)
    daemon, out = played(feed, feed.make(1.5))
    columns = columns_of(out)
    primary = [c for c in columns if not c.second]
    second = [c for c in columns if c.second]
    firings = feed.firings
    assert firings is not None
    assert len(primary) == len(second) == len(firings)
    assert daemon.counters["second_returns"] == len(second)
    distance, _ = direct(feed, "int16", daemon.status["columns"])
    np.testing.assert_array_equal(np.stack([c.distance for c in primary]), distance)
    # Destaggered alike: 500 counts behind its primary where that has a return, nothing in generated rows.
    first = np.stack([c.distance for c in primary]).astype(int)
    other = np.stack([c.distance for c in second]).astype(int)
    np.testing.assert_array_equal(other[:, ::2], np.where(first[:, ::2] > 0, first[:, ::2] + 500, 0))
    assert not other[:, 1::2].any()
    assert [(c.frame, c.column, c.azimuth_mdeg) for c in second] == [
        (c.frame, c.column, c.azimuth_mdeg) for c in primary
    ]
    assert columns[-1].second
    assert columns[-1].flags & LAST
    assert not columns[-2].flags & LAST
    assert columns[1].flags & SECOND


def test_long_gap_begins_anew_and_is_counted() -> None:
    feed = Feed()
    packets = feed.make(6)
    kept = packets[:200] + packets[-300:]  # two and a half turns are missing
    daemon, out = played(feed, kept)
    counters = daemon.counters
    missing = 12 * (len(packets) - len(kept))
    assert counters["firings_inserted"] == 0
    assert counters["firings_skipped"] == missing
    assert counters["columns_out"] == counters["firings_processed"] == 12 * len(kept)
    numbers = [record["frame"] for record in out.ledger]
    assert numbers == sorted(set(numbers))
    verdicts = {record["frame"]: record["verdict"] for record in out.ledger}
    last_before, first_after = numbers[1], numbers[2]
    assert first_after - last_before > 1, "turns that were lost keep their numbers"
    assert verdicts[last_before] == verdicts[first_after] == "partial"
    assert counters["frames_skipped"] == first_after - last_before - 1


def test_silence_hands_out_what_is_pending() -> None:
    feed = Feed("vlp-32c")
    packets = feed.make(1.2)
    daemon = daemon_for(feed)
    last = run(daemon, packets)
    before = len(columns_of(daemon.take()))
    assert before < 12 * len(packets), "the destagger ring holds some back"
    for ms in range(10, 60, 10):
        daemon.tick(last + ms * 10**6)
    assert before + len(columns_of(daemon.take())) == 12 * len(packets)
    assert "SENSOR_TIMEOUT" in daemon.faults


def test_reader_refuses_what_is_no_datagram() -> None:
    feed = Feed()
    _, out = played(feed, feed.make(0.2))
    good = out.columns[3][1]
    for bad in (good[:-1], good + b"\0", b"UPCX" + good[4:], good[:4] + b"\2" + good[5:], good[:20], b""):
        with pytest.raises(ColumnStreamError):
            read_columns(bad)


def test_the_hour_passes_unnoticed() -> None:
    """The sensor's clock begins anew every hour; times on the wire go on."""
    feed = Feed(start_ns=3_599_900_000_000)
    daemon, out = played(feed, feed.make(3))
    columns = columns_of(out)
    assert len(columns) == daemon.counters["firings_processed"]
    assert daemon.counters["resyncs"] == 0
    assert daemon.status["faults_ever"] == []
    steps = np.diff([c.time_ns for c in columns])
    assert abs(steps - feed.cycle_ns).max() <= 1000, "packets carry whole microseconds"
    assert [r["verdict"] for r in out.ledger] == ["partial", "met", "partial"]
