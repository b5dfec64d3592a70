"""Do all implementations give the same bits? Vector sets, the comparison, and where a difference begins.

A backend is named callables handed in, so that this module knows no implementation but the reference. A mismatch is
followed through the steps of the contract to the first that differs.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from upbeam.model.rules import BEAMS, PAIRS, ROWS, Rules, extract_windows

from .integer import IntegerModel, Trace, network, upsample_integer
from .ubm import ModelFile

__all__ = [
    "GOLDEN",
    "STAGES",
    "Backend",
    "BackendResult",
    "Count",
    "Image",
    "Mismatch",
    "VectorSet",
    "extreme_set",
    "firing_set",
    "golden_digests",
    "golden_image",
    "golden_mismatch",
    "golden_set",
    "image_set",
    "random_set",
    "reference_backend",
    "stream_set",
    "verify",
]

U16 = NDArray[np.uint16]
U8 = NDArray[np.uint8]
I64 = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
Image = tuple[U16, U8]
"""Distances (counts) and intensities: ``[32, W]`` in, ``[64, W]`` out."""
NetworkName = Literal["distance", "intensity"]
NETWORKS: tuple[NetworkName, NetworkName] = ("distance", "intensity")
RunImage = Callable[[Image], Image]
RunStream = Callable[[Image, BoolArray], Image]
"""Aligned columns ``[32, N]`` of consecutive turns, and which of them arrived ``[N]`` -> ``[64, N]``."""
RunTrace = Callable[[NetworkName, I64], Mapping[str, NDArray[Any]]]
"""A network and windows ``[N, 6]`` -> the steps by the names of ``integer.Trace``, those that the backend can tell."""

STAGES: Mapping[str, str] = {
    "m": "step 1, minimum m",
    "d": "step 2, differences d",
    "s": "step 3, shift s of the block code",
    "q": "step 3, codes q",
    "S": "step 4, sums S",
    "a": "step 5, hidden values a",
    "z": "step 6, rectified z",
    "Y": "step 7, output Y",
    "r": "step 8, rounded output r",
    "y": "step 9, y",
}
"""The contract's steps, in order."""
KERNEL = "no step of its trace; the window alone differs too: the kernel's arithmetic or its limits"
AROUND = "no step of its trace; the window alone agrees: edges, empty pixels or neighbours"
GOLDEN = "golden"
RANDOM_COLUMNS = 10_000
_GOLDEN_VERSION = 1
_GAP_EVERY, _GAP_LONGEST = 211, 7


# ---------------------------------------------------------------------------------------------------- backends


@dataclass(frozen=True)
class Backend:
    """One implementation of one precision."""

    name: str
    image: RunImage
    """an image of its own: both ends are edges. ``[32, W]``, W the model's columns"""
    stream: RunStream | None = None
    """from the start of a turn; columns are azimuth aligned"""
    firing: RunStream | None = None
    """the same of columns as the lasers fire, through the destagger ring"""
    trace: RunTrace | None = None


def reference_backend(model: IntegerModel, rules: Rules, name: str = "reference") -> Backend:
    """The NumPy reference."""

    def image(given: Image) -> Image:
        return upsample_integer(*given, model, rules)

    def stream(strip: Image, arrived: BoolArray) -> Image:
        return stream_by_images(image, rules, strip, arrived)

    def trace(which: NetworkName, windows: I64) -> Mapping[str, I64]:
        return _steps(network(getattr(model, which), model.precision, windows))

    def firing(strip: Image, arrived: BoolArray) -> Image:
        aligned = destaggered(_holed(strip, arrived), rules)
        return stream(aligned, np.ones_like(arrived))

    return Backend(name, image, stream, firing, trace)


def stream_by_images(image: RunImage, rules: Rules, strip: Image, arrived: BoolArray) -> Image:
    """What a stream must give: columns that never arrived are empty; under ``seam`` turns are one image, under
    ``zero`` each its own."""
    holed = _holed(strip, arrived)
    length = strip[0].shape[1]
    turn = length if rules.edge == "seam" else rules.columns
    parts = [image((holed[0][:, at : at + turn], holed[1][:, at : at + turn])) for at in range(0, length, turn)]
    return np.concatenate([p[0] for p in parts], axis=1), np.concatenate([p[1] for p in parts], axis=1)


def destaggered(strip: Image, rules: Rules) -> Image:
    """Firing columns ``[32, N]`` -> azimuth columns 0 to N - 1; where a beam's firing lies outside, it is empty."""
    return _destaggered(strip[0], rules), _destaggered(strip[1], rules)


def _destaggered(part: NDArray[Any], rules: Rules) -> NDArray[Any]:
    offsets = np.floor(rules.azimuth_offset_deg * rules.columns / 360.0 + 0.5).astype(np.int64)
    source = np.arange(part.shape[1]) - offsets[:, None]
    inside = (source >= 0) & (source < part.shape[1])
    shifted = np.take_along_axis(part, np.clip(source, 0, part.shape[1] - 1), axis=1)
    return np.where(inside, shifted, 0).astype(part.dtype)


def _holed(strip: Image, arrived: BoolArray) -> Image:
    return np.where(arrived, strip[0], 0).astype(np.uint16), np.where(arrived, strip[1], 0).astype(np.uint8)


def _steps(trace: Trace) -> dict[str, I64]:
    return {name: getattr(trace, name) for name in STAGES}


# ------------------------------------------------------------------------------------------------- vector sets


@dataclass(frozen=True)
class VectorSet:
    """Inputs by name: images one by one, or (``arrived`` given) as the turns of one stream."""

    name: str
    images: Sequence[Image]
    arrived: BoolArray | None = None
    """``[columns of all images]``"""
    firing: bool = False
    """columns are as the lasers fire, not azimuth aligned"""

    @property
    def windows(self) -> int:
        return sum(PAIRS * image[0].shape[1] for image in self.images)

    @property
    def strip(self) -> Image:
        return tuple(np.concatenate([image[k] for image in self.images], axis=1) for k in (0, 1))  # type: ignore[return-value]


def golden_image(rules: Rules) -> Image:
    """One turn by integer arithmetic alone, the same on every machine for ever: patches of every spread, holes,
    returns beyond the limits."""
    beam, column = np.meshgrid(np.arange(BEAMS), np.arange(rules.columns), indexing="ij")
    patch = _hash((beam // 4) * 65_536 + column // 16)
    pixel = _hash(beam * 65_536 + column + (1 << 24))
    base = rules.min_count // 2 + patch % (rules.max_count + rules.max_count // 16)
    spread = (pixel & 0xFFFF) >> (patch >> 28)
    hole = (pixel >> 16) % 16 < ((patch >> 20) % 4) ** 2
    distance = np.where(hole, 0, np.minimum(base + spread, 65_535)).astype(np.uint16)
    return distance, ((patch >> 8) + (pixel >> 24 >> (patch % 8)) & 255).astype(np.uint8)


def _hash(values: NDArray[Any]) -> I64:
    """32 bits of each whole number, mixed (multiply, fold, twice)."""
    x = (values.astype(np.uint64) * np.uint64(2_654_435_761) + np.uint64(97)) & np.uint64(0xFFFFFFFF)
    for factor in (2_246_822_519, 3_266_489_917):
        x = ((x ^ (x >> np.uint64(15))) * np.uint64(factor)) & np.uint64(0xFFFFFFFF)
    return np.asarray(x ^ (x >> np.uint64(16)), dtype=np.int64)


def golden_set(rules: Rules) -> VectorSet:
    return VectorSet(GOLDEN, [golden_image(rules)])


def image_set(name: str, images: Iterable[Image]) -> VectorSet:
    """Images ``[32, W]`` one by one."""
    return VectorSet(name, list(images))


def stream_set(name: str, images: Iterable[Image]) -> VectorSet:
    """The images as consecutive turns, with gaps of 1 to 7 columns: also over the border of two turns, where there is
    one."""
    turns = list(images)
    widths = [image[0].shape[1] for image in turns]
    arrived = np.ones(sum(widths), bool)
    for k, at in enumerate(range(50, len(arrived), _GAP_EVERY)):
        arrived[at : at + 1 + k % _GAP_LONGEST] = False
    for border in np.cumsum(widths)[:-1:2]:
        arrived[border - 2 : border + 1] = False
    arrived[-1] = True
    return VectorSet(name, turns, arrived)


def firing_set(name: str, images: Iterable[Image]) -> VectorSet:
    """As ``stream_set``, of columns as the lasers fire."""
    return replace(stream_set(name, images), firing=True)


def random_set(rules: Rules, columns: int = RANDOM_COLUMNS, seed: int = 0) -> VectorSet:
    """At least so many columns, in whole turns: any counts, mostly within the limits, with runs of small differences
    and holes."""
    rng = np.random.default_rng(seed)
    turns = [_random_image(rng, rules) for _ in range(-(-columns // rules.columns))]
    return VectorSet("random", turns)


def _random_image(rng: np.random.Generator, rules: Rules) -> Image:
    shape = BEAMS, rules.columns
    distance = rng.integers(0, 65_536, shape)
    within = rng.random(shape) < 0.8
    distance[within] = rng.integers(rules.min_count, rules.max_count + 1, shape)[within]
    smooth = np.repeat(rng.random((1, rules.columns // 64 + 1)) < 0.7, 64, axis=1)[:, : rules.columns]
    level = np.repeat(rng.integers(rules.min_count, rules.max_count, (1, rules.columns // 8 + 1)), 8, axis=1)
    spread = 1 << rng.integers(0, 15, (1, rules.columns))
    near = np.minimum(level[:, : rules.columns] + rng.integers(0, spread, shape), 65_535)
    distance = np.where(smooth, near, distance)
    distance[rng.random(shape) < rng.random((1, rules.columns)) ** 3] = 0
    return distance.astype(np.uint16), rng.integers(0, 256, shape).astype(np.uint8)


def extreme_set(rules: Rules) -> VectorSet:
    """All zero, all maximum (of the type, of the limits, and at the lower one), alternating, a single return."""
    shape = BEAMS, rules.columns
    beam, column = np.indices(shape)
    odd = (beam + column) % 2 == 1
    single = np.zeros(shape, int)
    single[BEAMS // 2, rules.columns // 2] = rules.min_count
    flat = [np.full(shape, count) for count in (0, 65_535, rules.max_count, rules.min_count)]
    checkers = [np.where(odd, rules.max_count, low) for low in (0, rules.min_count)]
    stripes = [np.where(axis % 2 == 1, rules.max_count, rules.min_count) for axis in (beam, column)]
    greys = [np.zeros(shape), np.full(shape, 255), np.where(odd, 255, 0)]
    images = [
        (distance.astype(np.uint16), grey.astype(np.uint8))
        for distance in (*flat, *checkers, *stripes, single)
        for grey in greys
    ]
    return VectorSet("extremes", images)


# ------------------------------------------------------------------------------------------------------- golden


def golden_digests(file: ModelFile) -> dict[str, Any]:
    """CRC-32 of what the reference makes of ``golden_image``, for each integer precision of the file: kept in the
    file, so that a later reference can be held against this one."""
    models = {name: file.integer(name) for name in ("int16", "int8")}
    found = {name: _digest(model, file.rules) for name, model in models.items() if model is not None}
    return {"version": _GOLDEN_VERSION, **found}


def _digest(model: IntegerModel, rules: Rules) -> str:
    distance, intensity = upsample_integer(*golden_image(rules), model, rules)
    return f"{zlib.crc32(distance.astype('<u2').tobytes() + intensity.tobytes()):08x}"


def golden_mismatch(file: ModelFile, precision: Literal["int16", "int8"]) -> Mismatch | None:
    """The reference against the digest in the file. Raises KeyError where the file has none."""
    stored = file.metrics[GOLDEN]
    if stored["version"] != _GOLDEN_VERSION:
        raise KeyError(f"golden vectors of version {stored['version']}")
    model = file.integer(precision)
    assert model is not None
    made = _digest(model, file.rules)
    if made == stored[precision]:
        return None
    return Mismatch(GOLDEN, 0, 0, 0, "digest in the model file", str(stored[precision]), made)


# --------------------------------------------------------------------------------------------------- comparison


@dataclass(frozen=True)
class Mismatch:
    """The first window of a vector set that differs, and the first stage of it that does."""

    vectors: str
    frame: int
    column: int
    row: int
    """of the 64 output rows"""
    stage: str
    expected: str
    got: str
    window: str = ""
    """the six distances and intensities"""

    def text(self) -> str:
        where = f"{self.vectors}: frame {self.frame}, column {self.column}, row {self.row}"
        inputs = f"; window {self.window}" if self.window else ""
        return f"{where}: first differs at {self.stage}: expected {self.expected}, got {self.got}{inputs}"


@dataclass(frozen=True)
class Count:
    windows: int
    differing: int


@dataclass
class BackendResult:
    """Of one backend: windows compared and differing by vector set; None where it cannot run the set."""

    sets: dict[str, Count | None] = field(default_factory=dict)
    first: Mismatch | None = None

    @property
    def exact(self) -> bool:
        return self.first is None


def verify(
    reference: Backend,
    backends: Sequence[Backend],
    sets: Iterable[VectorSet],
    rules: Rules,
    on_set: Callable[[str], None] = lambda name: None,
) -> dict[str, BackendResult]:
    """Each backend against the reference on each vector set: every output row, distance and intensity."""
    results = {backend.name: BackendResult() for backend in backends}
    for vectors in sets:
        expected = _run(reference, vectors)
        if expected is None:
            raise ValueError(f"the reference {reference.name} cannot run the vector set {vectors.name}")
        for backend in backends:
            result = results[backend.name]
            got = _run(backend, vectors)
            result.sets[vectors.name] = None if got is None else _compare(vectors, expected, got)
            if got is not None and result.first is None:
                result.first = _first_mismatch(reference, backend, vectors, expected, got, rules)
            on_set(f"{vectors.name}, {backend.name}")
    return results


def _run(backend: Backend, vectors: VectorSet) -> list[Image] | None:
    """Outputs image by image; None where the backend has no stream."""
    if vectors.arrived is None:
        return [backend.image(image) for image in vectors.images]
    stream = backend.firing if vectors.firing else backend.stream
    if stream is None:
        return None
    distance, intensity = stream(vectors.strip, vectors.arrived)
    ends = np.cumsum([image[0].shape[1] for image in vectors.images])[:-1]
    return list(zip(np.split(distance, ends, axis=1), np.split(intensity, ends, axis=1), strict=True))


def _compare(vectors: VectorSet, expected: list[Image], got: list[Image]) -> Count:
    differing = sum(int(_differs(a, b).sum()) for a, b in zip(expected, got, strict=True))
    return Count(vectors.windows, differing)


def _differs(expected: Image, got: Image) -> BoolArray:
    """``[64, W]``. Another shape differs everywhere."""
    if not _same_shape(expected, got):
        return np.ones(expected[0].shape, bool)
    return np.asarray((expected[0] != got[0]) | (expected[1] != got[1]))


def _same_shape(a: Image, b: Image) -> bool:
    return a[0].shape == b[0].shape and a[1].shape == b[1].shape


def _first_mismatch(
    reference: Backend, backend: Backend, vectors: VectorSet, expected: list[Image], got: list[Image], rules: Rules
) -> Mismatch | None:
    for frame, (a, b) in enumerate(zip(expected, got, strict=True)):
        differs = _differs(a, b)
        if differs.any():
            column = int(np.argmax(differs.any(axis=0)))
            row = int(np.argmax(differs[:, column]))
            if not _same_shape(a, b):
                return Mismatch(vectors.name, frame, 0, 0, "shape", str(a[0].shape), str(b[0].shape))
            values = [f"{int(x[0][row, column])} and {int(x[1][row, column])}" for x in (a, b)]
            stage = _stage(reference, backend, vectors, frame, column, row, rules, values)
            return Mismatch(vectors.name, frame, column, row, *stage)
    return None


def _stage(
    reference: Backend,
    backend: Backend,
    vectors: VectorSet,
    frame: int,
    column: int,
    row: int,
    rules: Rules,
    values: list[str],
) -> tuple[str, str, str, str]:
    """Stage, expected, got, window."""
    if row % 2 == 0 or row == ROWS - 1:
        return ("last row" if row == ROWS - 1 else "sensor row"), values[0], values[1], ""
    windows = _window(vectors, frame, column, row // 2, rules)
    text = ", ".join(str(window.tolist()) for window in windows)
    if reference.trace is None or backend.trace is None:
        return "outputs (distance and intensity; no trace of the steps)", values[0], values[1], text
    for which, window in zip(NETWORKS, windows, strict=True):
        wanted, made = reference.trace(which, window[None]), backend.trace(which, window[None])
        for name, stage in STAGES.items():
            if name in made and not _same_step(wanted[name], made[name]):
                return f"{which} network, {stage}", _list(wanted[name]), _list(made[name]), text
    columns = vectors.images[frame][0].shape[1]
    alone = _alone(*windows, row // 2, columns)
    inside = _differs(reference.image(alone), backend.image(alone))[row, columns // 2]
    return (KERNEL if inside else AROUND), values[0], values[1], text


def _same_step(wanted: NDArray[Any], made: NDArray[Any]) -> bool:
    """A backend may pad its hidden units."""
    a, b = np.ravel(wanted), np.ravel(made)
    return np.array_equal(a, b[: len(a)])


def _alone(distance: I64, intensity: I64, pair: int, columns: int) -> Image:
    """An image that holds nothing but one window, so that limits, edges and neighbours have no say in it."""
    place = slice(pair, pair + 2), slice(columns // 2 - 1, columns // 2 + 2)
    image = np.zeros((BEAMS, columns), np.uint16), np.zeros((BEAMS, columns), np.uint8)
    image[0][place], image[1][place] = distance.reshape(2, 3), intensity.reshape(2, 3)
    return image


def _list(values: NDArray[Any]) -> str:
    flat = np.ravel(values).tolist()
    return str(flat[0] if len(flat) == 1 else flat)


def _window(vectors: VectorSet, frame: int, column: int, pair: int, rules: Rules) -> tuple[I64, I64]:
    """Distances and intensities of one window after the rules, ``[6]`` each."""
    distance, intensity = vectors.images[frame]
    if vectors.arrived is not None:
        start = sum(image[0].shape[1] for image in vectors.images[:frame])
        distance, intensity = _holed(vectors.strip, vectors.arrived)
        if vectors.firing:
            distance, intensity = destaggered((distance, intensity), rules)
        if rules.edge == "seam":
            column += start
        else:
            stop = start + vectors.images[frame][0].shape[1]
            distance, intensity = distance[:, start:stop], intensity[:, start:stop]
    windows = extract_windows(distance, intensity, rules)
    return windows.distance[pair, column].astype(np.int64), windows.intensity[pair, column].astype(np.int64)
