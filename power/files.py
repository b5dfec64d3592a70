"""The files that come with this package."""

from __future__ import annotations

from pathlib import Path

__all__ = ["packaged"]

_HERE = Path(__file__).parent


def packaged(*parts: str) -> Path:
    """A file or folder below ``power/``."""
    return _HERE.joinpath(*parts)
