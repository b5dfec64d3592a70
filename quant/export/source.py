"""What every exporter starts from."""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from upbeam.model.network import FoldedNetwork, WindowNetwork
from upbeam.quant.integer import IntegerModel, Precision
from upbeam.quant.ubm import ModelFile, read_ubm

__all__ = ["NETWORKS", "ExportError", "MissingPackageError", "NetworkName", "Source", "new_folder"]

NetworkName = Literal["distance", "intensity"]
NETWORKS: tuple[NetworkName, NetworkName] = ("distance", "intensity")


class ExportError(ValueError):
    """What cannot be exported, or where to: one line, with what is missing."""


class MissingPackageError(ExportError, ImportError):
    """An optional package is not installed."""


@dataclass(frozen=True)
class Source:
    """The bytes of a model file, and what they say."""

    data: bytes
    name: str
    """For comments and identifiers; not empty."""
    file: ModelFile
    """Parsed from ``data``, never from elsewhere."""

    @classmethod
    def of(cls, data: bytes, name: str) -> Source:
        """Raises UbmError for bytes that are not a sound model."""
        return cls(data, _short(name), read_ubm(data))

    @property
    def crc32(self) -> int:
        """The file's last four bytes: its identity."""
        return int(struct.unpack("<I", self.data[-4:])[0])

    @property
    def identifier(self) -> str:
        """The name as part of a C or SystemVerilog identifier, lower case."""
        return re.sub(r"[^a-z0-9]+", "_", self.name.lower()).strip("_") or "model"

    @property
    def precisions(self) -> list[Precision]:
        """Integer precisions in the file."""
        found = (self.file.int16, self.file.int8)
        return [model.precision for model in found if model is not None]

    def integer(self, precision: Precision) -> IntegerModel:
        """Raises ExportError where the file does not have it."""
        model = self.file.integer(precision)
        if model is None:
            raise ExportError(
                f"{self.name}: no {precision} networks in this model, it has {', '.join(self.file.precisions)}; "
                "upbeam quantize adds them"
            )
        return model

    def folded(self, network: NetworkName) -> FoldedNetwork:
        return self.file.folded[NETWORKS.index(network)]

    def dense(self, network: NetworkName) -> WindowNetwork:
        """Raises ExportError where the file does not have the section."""
        if self.file.dense is None:
            raise ExportError(f"{self.name}: no section DENS in this model: the dense networks are not in it")
        return self.file.dense[NETWORKS.index(network)]

    def unit(self, network: NetworkName) -> float:
        """Size of a count in what the network sees: metres, or 1 for intensities."""
        return self.file.rules.distance_unit_m if network == "distance" else 1.0

    def describe(self) -> list[tuple[str, str]]:
        """What a reader of an exported file must know of where it comes from."""
        rules, provenance = self.file.rules, self.file.provenance
        return [
            ("model", f"{self.name}, {len(self.data)} bytes, CRC-32 {self.crc32:08x}"),
            ("sensor", f"{rules.sensor}, {rules.columns} columns, counts of {rules.distance_unit_m * 1e3:g} mm"),
            ("provenance", "; ".join(f"{key}: {_short(value)}" for key, value in provenance.items()) or "none given"),
        ]


def _short(value: Any, limit: int = 200) -> str:
    """On one line of ASCII, so that any compiler takes it in a comment."""
    text = " ".join(str(value).split()).encode("ascii", "replace").decode().replace("*/", "* /").replace("/*", "/ *")
    return text if len(text) <= limit else text[: limit - 3] + "..."


def new_folder(path: Path) -> Path:
    """A folder that is empty, made if need be. Raises ExportError: nothing is overwritten or mixed."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        if any(path.iterdir()):
            raise ExportError(f"{path}: the folder is not empty; remove it, or name another with -o")
    except OSError as error:
        raise ExportError(f"{path}: cannot be made into a folder: {error.strerror}") from None
    return path
