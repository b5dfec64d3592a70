"""TOML, from Python 3.10 on, and the files that come with this package."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

__all__ = ["TomlError", "packaged", "parse_toml"]

_HERE = Path(__file__).parent


class TomlError(ValueError):
    """A text that is not TOML: names file, line and column."""


def packaged(*parts: str) -> Path:
    """A file or folder below ``power/``."""
    return _HERE.joinpath(*parts)


def parse_toml(name: str, text: str) -> dict[str, Any]:
    """``name`` is for the error's message alone."""
    try:
        data: dict[str, Any] = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise TomlError(f"{name}: {error}") from None
    return data
