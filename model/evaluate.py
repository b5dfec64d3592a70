"""Every method beside every other on the same frames, with confidence intervals over the frames."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from .baselines import Method
from .frames import Frame
from .metrics import CloudMetrics, FrameMetrics, PartMetrics, Prediction, Truth
from .rules import Rules

__all__ = [
    "BASE",
    "RESAMPLES",
    "Evaluation",
    "Interval",
    "evaluate",
    "in_unit",
    "paired_ratio",
    "rules_for",
    "with_limits",
]

BASE = "valid-mean"
"""The method that ratios are taken to."""
RESAMPLES = 2000
SEED = 20
FloatArray = NDArray[np.float64]
Metrics = dict[str, float]
OnFrame = Callable[[Frame], None]


@dataclass(frozen=True)
class Interval:
    """A value and its 95 % confidence interval; without one (None) where a single frame was judged."""

    value: float
    low: float | None
    high: float | None

    @property
    def half_width(self) -> float | None:
        return None if self.low is None or self.high is None else (self.high - self.low) / 2


@dataclass(frozen=True)
class Evaluation:
    """Results per frame: ``per_frame[method][k]`` belongs to ``frames[k]``; so do ``clouds`` (empty unless asked for)
    and ``parts[part][method][k]`` (None where frame k has no such part)."""

    frames: list[str]
    per_frame: dict[str, list[FrameMetrics]]
    clouds: dict[str, list[CloudMetrics]] = field(default_factory=dict)
    parts: dict[str, dict[str, list[PartMetrics | None]]] = field(default_factory=dict)

    def values(self) -> dict[str, dict[str, FloatArray]]:
        """Each metric of each method, ``float64[frames]``. A metric that a frame does not define is NaN."""
        return {name: _columns(self._rows(name)) for name in self.per_frame}

    def _rows(self, name: str) -> list[Metrics]:
        rows = [asdict(m) for m in self.per_frame[name]]
        for row, cloud in zip(rows, self.clouds.get(name, ()), strict=False):
            row.update(asdict(cloud))
        return rows

    def means(self) -> dict[str, Metrics]:
        """Plain means over frames, per method and metric; NaN where no frame defines it."""
        return {name: {k: _mean(v) for k, v in metrics.items()} for name, metrics in self.values().items()}

    def ratios(self, base: str = BASE) -> dict[str, dict[str, Interval]]:
        """Ratios of the means to a base method's, with paired intervals. The order of the frames does not matter."""
        values = self.values()
        order = np.argsort(np.asarray(self.frames), kind="stable")
        return {
            name: {key: paired_ratio(metrics[key][order], values[base][key][order]) for key in metrics}
            for name, metrics in values.items()
        }

    def part_means(self) -> dict[str, dict[str, Metrics]]:
        """Per part, method and metric: means over the frames that define the metric; ``real_points`` is a mean too."""
        return {
            part: {
                name: {k: _mean(v) for k, v in _columns([asdict(m) for m in rows if m is not None]).items()}
                for name, rows in methods.items()
            }
            for part, methods in self.parts.items()
        }


def rules_for(frame: Frame, rules: Rules) -> Rules:
    """The rules with their range limits in the frame's counts (a VLP-32C counts in 4 mm, an HDL-64E in 2 mm)."""
    return in_unit(rules, frame.distance_unit_m)


def in_unit(rules: Rules, distance_unit_m: float) -> Rules:
    """The same limits in metres, as near as the unit allows, in counts of another unit."""
    if distance_unit_m == rules.distance_unit_m:
        return rules
    scale = rules.distance_unit_m / distance_unit_m
    low, high = (int(np.floor(limit * scale + 0.5)) for limit in (rules.min_count, rules.max_count))
    rows = np.floor(rules.row_max_count * scale + 0.5).astype(np.int64)
    low, high = max(1, low), min(65535, high)
    return replace(
        rules,
        distance_unit_m=distance_unit_m,
        min_count=low,
        max_count=high,
        row_max_count=np.clip(rows, low, high),
    )


def with_limits(rules: Rules, min_count: int, max_count: int) -> Rules:
    """Other range limits, in counts of the rules' unit; a row's own limit stays where it lies within them.

    A row without one keeps none."""
    rows = np.where(rules.row_max_count == rules.max_count, max_count, rules.row_max_count)
    return replace(rules, min_count=min_count, max_count=max_count, row_max_count=np.clip(rows, min_count, max_count))


def evaluate(
    frames: Iterable[Frame],
    methods: Mapping[str, Method],
    rules: Rules,
    on_frame: OnFrame = lambda frame: None,
    *,
    full: bool = False,
    parts: bool = False,
    surfaces: Mapping[int, str] | None = None,
) -> Evaluation:
    """Even rows in, the odd rows between two of them judged; range limits are those of ``rules``, in metres.

    ``full``: voxels and whole clouds as well. ``parts``: by range band, and by surface where frames have labels, named
    by ``surfaces``. Raises ValueError naming the frame, and the method, where nothing can be compared.
    """
    result = Evaluation([], {name: [] for name in methods})
    for frame in frames:
        limits = rules_for(frame, rules)
        truth = Truth(frame, limits)
        for name, method in methods.items():
            prediction = _predict(name, method, truth, limits)
            result.per_frame[name].append(prediction.metrics())
            if full:
                result.clouds.setdefault(name, []).append(prediction.cloud_metrics())
            if parts:
                _add_parts(result, name, prediction, surfaces or {})
        result.frames.append(frame.name)
        on_frame(frame)
    if not result.frames:
        raise ValueError("no frames to evaluate")
    for per_method in result.parts.values():
        for name in methods:
            _pad(per_method.setdefault(name, []), len(result.frames))
    return result


def _predict(name: str, method: Method, truth: Truth, limits: Rules) -> Prediction:
    frame = truth.frame
    try:
        return Prediction(truth, *method(frame.distance[frame.given], frame.intensity[frame.given], limits))
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None


def _add_parts(result: Evaluation, name: str, prediction: Prediction, surfaces: Mapping[int, str]) -> None:
    found = prediction.by_band()
    found.update({surfaces.get(k, f"surface {k}"): part for k, part in prediction.by_surface().items()})
    for key, part in found.items():
        rows = result.parts.setdefault(key, {}).setdefault(name, [])
        _pad(rows, len(result.frames))
        rows.append(part)


def _pad(rows: list[PartMetrics | None], length: int) -> None:
    """Frames without this part."""
    rows.extend([None] * (length - len(rows)))


def paired_ratio(
    values: FloatArray, base: FloatArray, *, resamples: int = RESAMPLES, seed: int = SEED, share: float = 0.95
) -> Interval:
    """Ratio of means over the same frames, ``float64[frames]`` each, with a percentile bootstrap over frames.

    Frames are drawn with replacement, the same ones for both, so that what makes a frame hard cancels. Frames whose
    value is NaN in either are left out. Frames of one drive are alike: an interval over them is too narrow for other
    drives. A ratio to a mean of 0 is NaN, without an interval.
    """
    defined = np.isfinite(values) & np.isfinite(base)
    values, base = values[defined], base[defined]
    if not len(values) or base.mean() == 0:
        return Interval(float("nan"), None, None)
    value = float(values.mean() / base.mean())
    if len(values) < 2:
        return Interval(value, None, None)
    drawn = np.random.default_rng(seed).integers(0, len(values), (resamples, len(values)))
    sums = base[drawn].sum(axis=1)
    if not np.all(sums):
        return Interval(value, None, None)
    low, high = np.quantile(values[drawn].sum(axis=1) / sums, [(1 - share) / 2, (1 + share) / 2])
    return Interval(value, float(low), float(high))


def _columns(rows: list[Metrics]) -> dict[str, FloatArray]:
    return {key: np.asarray([row[key] for row in rows], dtype=np.float64) for key in (rows[0] if rows else ())}


def _mean(values: FloatArray) -> float:
    defined = values[np.isfinite(values)]
    return float(defined.mean()) if len(defined) else float("nan")
