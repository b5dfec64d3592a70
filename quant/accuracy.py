"""How far quantised networks are from the float ones, and from the truth, behind the same rules.

A ``Variant`` is a pair of networks to compare: integer ones, another tool's, an experiment's. ``compare`` runs them
all on the same windows of the same frames.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from upbeam.model.baselines import Method
from upbeam.model.evaluate import Evaluation
from upbeam.model.frames import Frame
from upbeam.model.metrics import BANDS_M, GHOST_DISTANCE_M, Prediction, Truth
from upbeam.model.network import FoldedNetwork
from upbeam.model.rules import Rules, Windows, extract_windows
from upbeam.model.rules import generated_counts as rounded_counts

from .integer import CODE_BITS, IntegerModel, block_code, network, round_shift
from .ubm import ModelFile

__all__ = [
    "FLOAT",
    "MOVED_M",
    "Comparison",
    "Errors",
    "GhostChange",
    "Summary",
    "Variant",
    "compare",
    "float_variant",
    "generate",
    "integer_variant",
]

FLOAT = "float"
"""Name of the float networks among the methods of a comparison."""
MOVED_M = 0.1
"""A generated point farther than this from where the float network puts it has moved."""

U16 = NDArray[np.uint16]
U8 = NDArray[np.uint8]
I64 = NDArray[np.int64]
FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
Network = Callable[[I64], NDArray[Any]]
"""Windows ``[..., 6]`` of counts or intensities -> outputs ``[...]`` in counts or 8-bit steps, whole or not."""
WindowCode = Callable[[I64], tuple[BoolArray, BoolArray]]
"""Windows ``[..., 6]`` -> which are coarse (their differences are not exact) and which are cut (a code was limited)."""


@dataclass(frozen=True)
class Variant:
    distance: Network
    intensity: Network
    code: WindowCode | None = None
    """Of the distance network's inputs, where they are coded."""


def float_variant(folded: tuple[FoldedNetwork, FoldedNetwork], unit_m: float) -> Variant:
    """The float networks, in float64. ``unit_m``: size of a count."""
    return Variant(lambda windows: folded[0](windows * unit_m) / unit_m, folded[1])


def integer_variant(model: IntegerModel) -> Variant:
    """The integer networks, by the reference."""
    return Variant(
        lambda windows: network(model.distance, model.precision, windows).y,
        lambda windows: network(model.intensity, model.precision, windows).y,
        _block_losses if model.precision == "int8" else None,
    )


def _block_losses(windows: I64) -> tuple[BoolArray, BoolArray]:
    d = windows - windows.min(axis=-1, keepdims=True)
    s, _ = block_code(d)
    cut = round_shift(d, s[..., None]).max(axis=-1) >= 2**CODE_BITS
    return s > 0, np.asarray(cut)


def generate(variant: Variant, windows: Windows, rules: Rules) -> tuple[U16, U8]:
    """Generated rows ``[31, W]``, counts and intensities."""
    made = rounded_counts(variant.distance(_whole(windows.distance)), windows, rules)
    grey = np.clip(np.floor(variant.intensity(_whole(windows.intensity)) + 0.5), 0, 255)
    return made, np.where(made > 0, grey, 0).astype(np.uint8)


def _whole(windows: FloatArray) -> I64:
    return windows.astype(np.int64)


# ------------------------------------------------------------------------------------------------------- errors


@dataclass(frozen=True)
class Summary:
    """Errors of a variant against the float networks, over windows that hold a return. Millimetres and 8-bit steps;
    NaN where there is nothing to judge."""

    windows: int
    points: int
    """both generate"""
    mean_mm: float
    p99_mm: float
    p999_mm: float
    max_mm: float
    moved_share: float
    """of the points, those more than 10 cm away"""
    coarse_share: float
    """of the windows, those whose differences are not exact in their code"""
    cut_share: float
    """of the windows, those with a difference that its code limited"""
    added: int
    """points that float does not generate"""
    removed: int
    """points that only float generates"""
    intensity_mean: float
    intensity_max: float

    def as_dict(self) -> dict[str, float]:
        return asdict(self)


@dataclass(frozen=True)
class Errors:
    """A variant against the float networks: one value a window that holds a return, ``[N]``, frames in order."""

    unit_m: float
    range_counts: U16
    """float's generated count, 0: none"""
    spread_counts: U16
    """the largest difference within the window"""
    error_counts: NDArray[np.int32]
    """variant - float where both generate, else 0"""
    both: BoolArray
    added: BoolArray
    removed: BoolArray
    coarse: BoolArray
    cut: BoolArray
    intensity_error: NDArray[np.int16]

    def summary(self, chosen: BoolArray | None = None) -> Summary:
        """Of the ``chosen`` windows ``[N]``, or of all."""
        pick = np.ones(len(self.both), bool) if chosen is None else chosen
        both = self.both & pick
        error = np.abs(self.error_counts[both]) * (self.unit_m * 1000)
        grey = np.abs(self.intensity_error[both])
        p99, p999 = np.percentile(error, [99, 99.9]) if error.size else (np.nan, np.nan)
        return Summary(
            windows=int(pick.sum()),
            points=int(both.sum()),
            mean_mm=_mean(error),
            p99_mm=float(p99),
            p999_mm=float(p999),
            max_mm=float(error.max()) if error.size else float("nan"),
            moved_share=_mean(error > 1000 * MOVED_M),
            coarse_share=_mean(self.coarse[pick]),
            cut_share=_mean(self.cut[pick]),
            added=int((self.added & pick).sum()),
            removed=int((self.removed & pick).sum()),
            intensity_mean=_mean(grey),
            intensity_max=float(grey.max()) if grey.size else float("nan"),
        )

    def by_band(self) -> dict[str, Summary]:
        """By the range of float's point (of windows without one nothing is judged here). Keys ``0-10 m`` and so on."""
        metres = self.range_counts * self.unit_m
        last = BANDS_M[-1][1]
        return {
            f"{low:g}-{high:g} m": self.summary(
                (self.range_counts > 0) & (metres >= low) & ((metres < high) | (high == last))
            )
            for low, high in BANDS_M
        }


@dataclass(frozen=True)
class GhostChange:
    """Generated points farther than 0.5 m from every real one: those that float does not make there, and the
    reverse."""

    added: int
    removed: int
    float_ghosts: int


@dataclass
class Comparison:
    """Results of ``compare``, by the variants' names."""

    unit_m: float
    errors: dict[str, Errors] = field(default_factory=dict)
    evaluation: Evaluation | None = None
    """Against the truth, with ``float`` and the baselines among the methods; None where it was not asked for."""
    ghosts: dict[str, GhostChange] = field(default_factory=dict)
    frames: list[str] = field(default_factory=list)

    def summaries(self) -> dict[str, Summary]:
        return {name: errors.summary() for name, errors in self.errors.items()}


def compare(
    file: ModelFile,
    frames: Iterable[Frame],
    variants: Mapping[str, Variant],
    *,
    baselines: Mapping[str, Method] | None = None,
    truth: bool = True,
    on_frame: Callable[[Frame], None] = lambda frame: None,
) -> Comparison:
    """Runs the float networks of ``file``, ``variants`` and ``baselines`` on the given rows of the frames.

    ``truth``: judge them against the rows between, too. Raises ValueError for no frames, and for a frame whose counts
    are not of the model's size: integer networks know one size of count.
    """
    parts: dict[str, list[tuple[NDArray[Any], ...]]] = {name: [] for name in variants}
    common: list[tuple[NDArray[Any], ...]] = []
    judged = _Judged()
    reference = float_variant(file.folded, file.rules.distance_unit_m)
    result = Comparison(file.rules.distance_unit_m)
    for frame in frames:
        _check_unit(frame, file.rules)
        given = frame.distance[frame.given], frame.intensity[frame.given]
        windows = extract_windows(*given, file.rules)
        exact = generate(reference, windows, file.rules)
        common.append(_common(windows, exact))
        made = {name: generate(variant, windows, file.rules) for name, variant in variants.items()}
        for name, image in made.items():
            parts[name].append(_pixel_errors(windows, exact, image, variants[name].code))
        if truth:
            others = {name: method(*given, file.rules) for name, method in (baselines or {}).items()}
            judged.add(Truth(frame, file.rules), {**others, FLOAT: exact, **made}, list(variants))
        result.frames.append(frame.name)
        on_frame(frame)
    if not result.frames:
        raise ValueError("no frames to compare on")
    shared = _joined(common)
    result.errors = {name: Errors(result.unit_m, *shared, *_joined(found)) for name, found in parts.items()}
    if truth:
        result.evaluation, result.ghosts = judged.evaluation, judged.changes()
    return result


def _check_unit(frame: Frame, rules: Rules) -> None:
    if frame.distance_unit_m != rules.distance_unit_m:
        raise ValueError(
            f"frame {frame.name} counts in {frame.distance_unit_m * 1000:g} mm, the model in "
            f"{rules.distance_unit_m * 1000:g} mm: integer networks know one size of count"
        )


def _common(windows: Windows, exact: tuple[U16, U8]) -> tuple[NDArray[Any], ...]:
    chosen = windows.any_return
    x = windows.distance[chosen]
    return exact[0][chosen], (x.max(axis=-1) - x.min(axis=-1)).astype(np.uint16)


def _pixel_errors(
    windows: Windows, exact: tuple[U16, U8], made: tuple[U16, U8], code: WindowCode | None
) -> tuple[NDArray[Any], ...]:
    """The remaining fields of ``Errors``, in their order."""
    chosen = windows.any_return
    a, b = exact[0][chosen].astype(np.int32), made[0][chosen].astype(np.int32)
    both = (a > 0) & (b > 0)
    grey = made[1][chosen].astype(np.int16) - exact[1][chosen].astype(np.int16)
    nothing = np.zeros(len(a), bool)
    coarse, cut = (nothing, nothing) if code is None else code(_whole(windows.distance[chosen]))
    error = np.where(both, b - a, 0).astype(np.int32)
    return error, both, (b > 0) & (a == 0), (a > 0) & (b == 0), coarse, cut, np.where(both, grey, 0).astype(np.int16)


def _joined(parts: list[tuple[NDArray[Any], ...]]) -> list[NDArray[Any]]:
    return [np.concatenate(column) for column in zip(*parts, strict=True)]


class _Judged:
    """Metrics against the truth, and the ghosts of each variant that float does not make."""

    def __init__(self) -> None:
        self.evaluation = Evaluation([], {})
        self.counts: dict[str, list[tuple[int, int, int]]] = {}

    def add(self, truth: Truth, images: Mapping[str, tuple[U16, U8]], variants: list[str]) -> None:
        predictions = {name: Prediction(truth, *image) for name, image in images.items()}
        for name, prediction in predictions.items():
            self.evaluation.per_frame.setdefault(name, []).append(prediction.metrics())
        exact = _ghosts(predictions[FLOAT])
        for name in variants:
            made = _ghosts(predictions[name])
            counts = int((made & ~exact).sum()), int((exact & ~made).sum()), int(exact.sum())
            self.counts.setdefault(name, []).append(counts)
        self.evaluation.frames.append(truth.frame.name)

    def changes(self) -> dict[str, GhostChange]:
        return {name: GhostChange(*map(sum, zip(*counts, strict=True))) for name, counts in self.counts.items()}


def _ghosts(prediction: Prediction) -> BoolArray:
    """Pixels ``[31, W]`` with a ghost point."""
    image = np.zeros(prediction.made.shape, bool)
    image[prediction.made] = prediction.to_real > GHOST_DISTANCE_M
    return image


def _mean(values: NDArray[Any]) -> float:
    """NaN of nothing, without numpy's warning."""
    return float(np.mean(values)) if values.size else float("nan")
