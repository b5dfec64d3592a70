"""TOML: the standard library's reader, or tomli where Python is older than it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

__all__ = ["TomlError", "parse_toml", "read_toml"]


class TomlError(ValueError):
    """A text that is not TOML: names file, line and column."""


def parse_toml(name: str, text: str) -> dict[str, Any]:
    """``name`` is for the error's message alone. Raises TomlError."""
    try:
        data: dict[str, Any] = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise TomlError(f"{name}: {error}") from None
    return data


def read_toml(path: Path) -> dict[str, Any]:
    """The file's table. Raises TomlError, OSError."""
    return parse_toml(str(path), path.read_text(encoding="utf-8"))
