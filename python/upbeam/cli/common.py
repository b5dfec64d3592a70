"""What every command shares: output for people and machines, errors, progress."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Annotated, Any

import typer
from rich import box
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

__all__ = ["JsonOption", "UserError", "binary_bytes", "emit_json", "message", "progress_bar", "show", "table"]

out = Console()
err = Console(stderr=True)

JsonOption = Annotated[
    bool, typer.Option("--json", help="One JSON object on standard output, messages on standard error.")
]


class UserError(ValueError):
    """Bad input or usage: one line for the user, exit status 2."""


def emit_json(data: dict[str, Any]) -> None:
    """Standard output holds this object and nothing else."""
    sys.stdout.write(json.dumps(data, indent=2, allow_nan=False) + "\n")


def message(text: str) -> None:
    """For people, on standard error: never mixed into results."""
    err.print(text, highlight=False, markup=False, soft_wrap=True)


def show(renderable: Any) -> None:
    out.print(renderable, highlight=False)


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    """A table: first column left, others right."""
    result = Table(
        title=title, title_justify="left", title_style="bold", header_style="bold", box=box.SIMPLE_HEAD, pad_edge=False
    )
    for k, column in enumerate(columns):
        result.add_column(column, justify="left" if k == 0 else "right", no_wrap=k == 0)
    for row in rows:
        result.add_row(*row)
    return result


@contextmanager
def progress_bar(what: str, total: int, *, quiet: bool = False) -> Iterator[Any]:
    """Yields ``advance(n=1, note="")``. On standard error; silent where that is not a terminal, but for a closing
    line."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=16),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
    )
    with Progress(*columns, console=err, disable=quiet or not err.is_terminal) as progress:
        task = progress.add_task(what, total=total, note="")

        def advance(n: int = 1, note: str = "") -> None:
            progress.update(task, advance=n, note=note)

        if not (quiet or err.is_terminal):
            message(f"{what} ({total}) ...")
        yield advance


def binary_bytes(count: float) -> str:
    """``count`` bytes as B, KiB, MiB or GiB."""
    size, unit = next(((s, u) for s, u in _BINARY if count >= s), (1, "B"))
    return f"{count / size:.4g} {unit}" if unit == "B" else f"{count / size:.3g} {unit}"


_BINARY = ((1 << 30, "GiB"), (1 << 20, "MiB"), (1 << 10, "KiB"))
