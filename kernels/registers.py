"""The FPGA core's register map, from ``kernels/rtl/registers.toml`` into documentation, C and SystemVerilog.

``python -m upbeam.kernels.registers`` writes all three; with ``--check`` it compares them and ends with 1 where one is
not what the map says."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from upbeam.model.toml_file import parse_toml

__all__ = [
    "Field",
    "Register",
    "RegisterMap",
    "RegisterMapError",
    "c_header",
    "main",
    "outputs",
    "read_map",
    "sv_header",
]

ACCESS = ("ro", "rw", "w1c", "wo")
_HERE = Path(__file__).resolve().parent
SOURCE = _HERE / "rtl" / "registers.toml"
BEGIN, END = "<!-- register table: begin -->", "<!-- register table: end -->"
_NOTE = "Generated from kernels/rtl/registers.toml; do not edit."


class RegisterMapError(ValueError):
    """A map that cannot be: names the register and what was expected."""


@dataclass(frozen=True)
class Field:
    name: str
    low: int
    bits: int
    text: str

    @property
    def mask(self) -> int:
        return ((1 << self.bits) - 1) << self.low


@dataclass(frozen=True)
class Register:
    name: str
    address: int
    access: str
    text: str
    reset: int | None
    """value after reset where it is a constant"""
    fields: tuple[Field, ...]


@dataclass(frozen=True)
class RegisterMap:
    version: tuple[int, int, int]
    id: int
    address_bits: int
    weights: int
    weights_bytes: int
    registers: tuple[Register, ...]

    def __getitem__(self, name: str) -> Register:
        for register in self.registers:
            if register.name == name:
                return register
        raise KeyError(name)

    @property
    def version_word(self) -> int:
        major, minor, patch = self.version
        return major << 16 | minor << 8 | patch


def read_map(text: str | None = None) -> RegisterMap:
    """The packaged map, or one in TOML. Raises RegisterMapError, TomlError."""
    data = parse_toml(SOURCE.name, SOURCE.read_text(encoding="utf-8") if text is None else text)
    head = data["map"]
    registers = tuple(_register(item) for item in data["register"])
    found = RegisterMap(
        tuple(head["version"]), head["id"], head["address_bits"], head["weights"], head["weights_bytes"], registers
    )
    _check(found)
    return found


def _register(item: dict[str, Any]) -> Register:
    fields = tuple(Field(name, *value) for name, value in item.get("fields", {}).items())
    return Register(item["name"], item["address"], item["access"], item["text"], item.get("reset"), fields)


def _check(m: RegisterMap) -> None:
    addresses: dict[int, str] = {}
    for r in m.registers:
        if r.access not in ACCESS:
            raise RegisterMapError(f"{r.name}: access {r.access!r}, expected one of {', '.join(ACCESS)}")
        if r.address % 4 or not 0 <= r.address < m.weights:
            raise RegisterMapError(f"{r.name}: address {r.address:#x}, expected a multiple of 4 below {m.weights:#x}")
        if r.address in addresses:
            raise RegisterMapError(f"{r.name}: address {r.address:#x} is that of {addresses[r.address]}")
        addresses[r.address] = r.name
        taken = 0
        for f in r.fields:
            if f.bits < 1 or f.low + f.bits > 32 or taken & f.mask:
                raise RegisterMapError(
                    f"{r.name}.{f.name}: bits {f.low} to {f.low + f.bits - 1} are taken or not there"
                )
            taken |= f.mask
    if len({r.name for r in m.registers}) != len(m.registers):
        raise RegisterMapError("a name stands twice")
    if m.weights + m.weights_bytes != 1 << m.address_bits:
        raise RegisterMapError(f"the weights must end where {m.address_bits} address bits do")


# --------------------------------------------------------------------------------------------------- SystemVerilog


def sv_header(m: RegisterMap) -> str:
    """``upb_regs.svh``: local parameters for a module."""
    lines = [
        f"// Register map of upb_registers. {_NOTE}",
        f"localparam integer ADDRESS_BITS = {m.address_bits};",
        f"localparam [31:0] ID_VALUE = 32'h{m.id:08x};",
        f"localparam [31:0] VERSION_VALUE = 32'h{m.version_word:08x};",
        *(f"localparam [ADDRESS_BITS-1:0] AT_{r.name} = {m.address_bits}'h{r.address:04x};" for r in m.registers),
        *(
            f"localparam integer {r.name}_{f.name} = {f.low};"
            for r in m.registers
            if r.access != "ro" or r.name == "STATUS"
            for f in r.fields
        ),
        f"localparam integer EVENT_BITS = {max(f.low + f.bits for f in m['EVENTS'].fields)};",
    ]
    return "\n".join([*lines, ""])


# --------------------------------------------------------------------------------------------------------------- C


def c_header(m: RegisterMap) -> str:
    """``upb_regs.h``."""
    lines = [
        f"/* Register map of the upbeam FPGA core. {_NOTE} */",
        "/* clang-format off */",
        "#ifndef UPB_REGS_H",
        "#define UPB_REGS_H",
        "",
        f"#define UPB_REGS_ID 0x{m.id:08x}u",
        *(f"#define UPB_REGS_VERSION_{n} {v}u" for n, v in zip(("MAJOR", "MINOR", "PATCH"), m.version, strict=True)),
        f"#define UPB_REGS_BYTES 0x{1 << m.address_bits:x}u",
        f"#define UPB_REGS_WEIGHTS 0x{m.weights:x}u",
        f"#define UPB_REGS_WEIGHTS_BYTES 0x{m.weights_bytes:x}u",
    ]
    for r in m.registers:
        lines += ["", f"/* {r.access}: {r.text} */", f"#define UPB_REG_{r.name} 0x{r.address:03x}u"]
        for f in r.fields:
            lines.append(f"#define UPB_{r.name}_{f.name} 0x{f.mask:08x}u /* {f.text} */")
            if f.bits > 1:
                lines.append(f"#define UPB_{r.name}_{f.name}_SHIFT {f.low}u")
    return "\n".join([*lines, "", "#endif", ""])


# --------------------------------------------------------------------------------------------------- documentation


def table(m: RegisterMap) -> str:
    """Markdown between the two marks, marks included."""
    major, minor, patch = m.version
    lines = [
        BEGIN,
        f"Register map {major}.{minor}.{patch}. {_NOTE}",
        "",
        "| address | register | access | reset | meaning |",
        "| --- | --- | --- | --- | --- |",
    ]
    for r in m.registers:
        reset = "" if r.reset is None else f"{r.reset:#x}"
        lines.append(f"| {r.address:#05x} | `{r.name}` | {r.access} | {reset} | {r.text} |")
        lines += [f"| | {_bits(f)} `{f.name}` | | | {f.text} |" for f in r.fields]
    lines.append(
        f"| {m.weights:#06x} to {m.weights + m.weights_bytes - 4:#06x} | weights | wo | | see below; SLVERR where they "
        "cannot be written |"
    )
    return "\n".join([*lines, END])


def _bits(f: Field) -> str:
    return f"bit {f.low}" if f.bits == 1 else f"bits {f.low + f.bits - 1}..{f.low}"


def _into(page: str, m: RegisterMap) -> str:
    before, found, rest = page.partition(BEGIN)
    _, closed, after = rest.partition(END)
    if not found or not closed:
        raise RegisterMapError(f"the page has no {BEGIN} ... {END}")
    return before + table(m) + after


# ---------------------------------------------------------------------------------------------------------- files


def outputs(root: Path) -> Iterator[tuple[Path, str]]:
    """Every generated file of a source tree, and what belongs into it."""
    m = read_map()
    page = root / "docs" / "fpga-registers.md"
    yield root / "kernels" / "rtl" / "upb_regs.svh", sv_header(m)
    yield root / "runtime" / "fpga" / "upb_regs.h", c_header(m)
    yield page, _into(page.read_text(encoding="utf-8"), m)


def main(arguments: list[str]) -> int:
    check = arguments == ["--check"]
    if arguments and not check:
        print(f"arguments {arguments}, expected none or --check", file=sys.stderr)
        return 2
    stale = 0
    for path, text in outputs(_HERE.parent):
        if check and path.read_text(encoding="utf-8") != text:
            print(f"{path} is not what kernels/rtl/registers.toml says", file=sys.stderr)
            stale = 1
        elif not check:
            path.write_text(text, encoding="utf-8")
    return stale


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
