"""Entry point of ``upbeam``. Exit status: 0 done, 1 the checked condition failed, 2 bad input or usage."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

import upbeam
from upbeam.kernels.opencl import OpenClError

from . import (
    bench,
    doctor,
    estimate,
    evaluate,
    export,
    hil,
    inspect,
    ops,
    quantize,
    simulate,
    stream,
    train,
    upsample,
    verify,
)
from .common import message

__all__ = ["app", "run"]

app = typer.Typer(
    name="upbeam",
    help="Turns a 32-beam LiDAR into a 64-beam one. Every command takes --json.",
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
app.command("stream")(stream.stream)
app.command("upsample")(upsample.upsample)
app.command("ops")(ops.ops)
app.command("evaluate")(evaluate.evaluate)
app.command("train")(train.train)
app.command("simulate")(simulate.simulate)
app.command("quantize")(quantize.quantize)
app.command("verify")(verify.verify)
app.command("export")(export.export)
app.command("inspect")(inspect.inspect)
app.command("bench")(bench.bench)
app.command("estimate")(estimate.estimate)
app.command("doctor")(doctor.doctor)
app.add_typer(hil.app, name="hil")


def _print_version(value: bool) -> None:
    if value:
        typer.echo(f"upbeam {upbeam.__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


# Typer has its own copy of click in some versions: take the base class of all usage errors from what it exports.
_UsageError: type[Exception] = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "ClickException")


def run() -> None:
    """The console script: every error a user can cause becomes one line and status 2."""
    arguments = sys.argv[1:]
    try:
        status = app(arguments or ["--help"], standalone_mode=False)
    except _UsageError as error:
        message(f"upbeam: {_one_line(error.format_message())}")  # type: ignore[attr-defined]
        sys.exit(2)
    except (KeyboardInterrupt, typer.Abort):
        message("upbeam: interrupted")
        sys.exit(130)
    except OSError as error:
        message(f"upbeam: {error.filename or ''}{': ' if error.filename else ''}{error.strerror or error}")
        sys.exit(2)
    except OpenClError as error:
        message(f"upbeam: {error}")  # a build failure has its log below the line
        sys.exit(2)
    except ValueError as error:
        message(f"upbeam: {_one_line(str(error))}")
        sys.exit(2)
    sys.exit(status if arguments else 2)


def _one_line(text: str) -> str:
    return " ".join(text.split())
