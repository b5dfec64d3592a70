"""What ``upbeam estimate --all --report`` hands to the report: the model's facts and the machine."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from upbeam.power.estimate import Estimate, Knowledge, Load
from upbeam.power.estimate_report import write_report
from upbeam.runtime.upsampler import Model

from .doctor import environment

__all__ = ["write_estimate_report"]


def write_estimate_report(
    folder: Path, model: Model, load: Load, known: Knowledge, estimates: Sequence[Estimate]
) -> Path:
    facts = {
        "name": model.name,
        "crc32": f"{model.crc32:08x}",
        "sensor": model.rules.sensor,
        "quantisation": model.file.metrics.get("quantisation", {}),
    }
    return write_report(folder, estimates, load, known, facts, environment())
