"""Every method beside every other on the same frames."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields

import numpy as np

from .baselines import Method
from .frames import Frame
from .metrics import GENERATED, FrameMetrics, compare_rows
from .rules import Rules

__all__ = ["Evaluation", "evaluate"]


@dataclass(frozen=True)
class Evaluation:
    """Results per frame: ``per_frame[method][k]`` belongs to ``frames[k]``."""

    frames: list[str]
    per_frame: dict[str, list[FrameMetrics]]

    def means(self) -> dict[str, dict[str, float]]:
        """Plain means over frames, per method and metric."""
        return {
            name: {f.name: float(np.mean([getattr(m, f.name) for m in rows])) for f in fields(FrameMetrics)}
            for name, rows in self.per_frame.items()
        }


def evaluate(
    frames: Iterable[Frame],
    methods: Mapping[str, Method],
    rules: Rules,
    on_frame: Callable[[Frame], None] = lambda frame: None,
) -> Evaluation:
    """Even rows in, odd rows 1..61 judged (row 63 never is). Raises ValueError for frames of another unit or without
    rows."""
    names: list[str] = []
    per_frame: dict[str, list[FrameMetrics]] = {name: [] for name in methods}
    for frame in frames:
        if frame.distance_unit_m != rules.distance_unit_m:
            raise ValueError(
                f"frame {frame.name}: counts of {frame.distance_unit_m} m, the model's are {rules.distance_unit_m} m"
            )
        truth = frame.distance[GENERATED], frame.intensity[GENERATED]
        for name, method in methods.items():
            made = method(frame.distance[0::2], frame.intensity[0::2], rules)
            per_frame[name].append(compare_rows(made, truth, rules))
        names.append(frame.name)
        on_frame(frame)
    if not names:
        raise ValueError("no frames to evaluate")
    return Evaluation(names, per_frame)
