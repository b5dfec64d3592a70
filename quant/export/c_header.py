"""One C header that holds a whole model, for firmware without a file system."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from textwrap import wrap

import numpy as np
from numpy.typing import ArrayLike

from upbeam.quant.integer import IntegerNetwork, Precision
from upbeam.quant.sizes import weight_bytes

from .source import NETWORKS, Source

__all__ = ["ALIGN", "c_header"]

ALIGN = 64
"""``UPB_ALIGN`` of the C library."""
_WIDTH = 116

_ALIGNMENT = f"""\
#ifndef UPB_EXPORT_ALIGN
#if defined(__cplusplus) && __cplusplus >= 201103L
#define UPB_EXPORT_ALIGN alignas({ALIGN})
#elif defined(__STDC_VERSION__) && __STDC_VERSION__ >= 201112L
#define UPB_EXPORT_ALIGN _Alignas({ALIGN})
#elif defined(__GNUC__)
#define UPB_EXPORT_ALIGN __attribute__((aligned({ALIGN})))
#else
#define UPB_EXPORT_ALIGN /* the loader reads bytes and needs none */
#endif
#endif
"""


def c_header(source: Source, precisions: Sequence[Precision] | None = None) -> str:
    """The header's text, ASCII. ``precisions``: whose networks stand in it as arrays; all of the file if None.

    The file's bytes stand in it whole. Raises ExportError for a precision that the model does not have."""
    wanted = source.precisions if precisions is None else precisions
    models = [source.integer(precision) for precision in wanted]
    macro, name = f"UPB_{source.identifier.upper()}", f"upb_{source.identifier}"
    sizes = weight_bytes(source.data)
    lines = [_comment(source, name, wanted), f"#ifndef {macro}_H", f"#define {macro}_H", "", "#include <stdint.h>", ""]
    lines += [_ALIGNMENT, *_file(source, macro, name), *_rules(source, macro, name)]
    for model in models:
        prefix = f"{macro}_{model.precision.upper()}"
        lines += ["", f"/* {model.contract} */", f'#define {prefix}_CONTRACT "{model.contract}"']
        lines += [
            f"#define {prefix}_WEIGHT_BYTES {sizes[model.precision]}u /* both networks, as the file holds them */"
        ]
        for which, network in zip(NETWORKS, model, strict=True):
            lines += _network(
                network, model.precision, f"{prefix}_{which.upper()}", f"{name}_{model.precision}_{which}"
            )
    return "\n".join([*lines, "", f"#endif /* {macro}_H */", ""])


def _comment(source: Source, name: str, precisions: Sequence[Precision]) -> str:
    networks = (
        f"and its integer networks ({', '.join(precisions)}) as arrays" if precisions else "(no integer networks)"
    )
    facts = [line for key, text in source.describe() for line in wrap(f"{key}: {text}", _WIDTH, subsequent_indent="  ")]
    text = [
        f"A model of upbeam as C: the model file {networks}. Do not edit; export again.",
        "",
        *facts,
        "",
        f"{name}_ubm is what upb_model_load() takes. The arrays are for implementations of their own; their letters",
        "are those of docs/numeric-contract.md. Everything is static: include this in one source file only.",
    ]
    return "\n".join(["/*", *(f" * {line}".rstrip() for line in text), " */"])


def _file(source: Source, macro: str, name: str) -> list[str]:
    return [
        f"#define {macro}_CRC32 0x{source.crc32:08x}u /* of the model file: its last four bytes, little-endian */",
        f"#define {macro}_UBM_BYTES {len(source.data)}u",
        f"UPB_EXPORT_ALIGN static const unsigned char {name}_ubm[{macro}_UBM_BYTES] = {{",
        *_values(np.frombuffer(source.data, np.uint8)),
        "};",
    ]


def _rules(source: Source, macro: str, name: str) -> list[str]:
    rules = source.file.rules
    return [
        "",
        "/* Rules around the networks: docs/model-format.md */",
        f"#define {macro}_COLUMNS {rules.columns}u /* per turn */",
        f"#define {macro}_DISTANCE_UNIT_UM {round(rules.distance_unit_m * 1e6)}u",
        f"#define {macro}_MIN_COUNT {rules.min_count}u",
        f"#define {macro}_MAX_COUNT {rules.max_count}u",
        f"#define {macro}_EDGE_SEAM {int(rules.edge == 'seam')}",
        f"#define {macro}_LAST_ROW_EMPTY {int(rules.last_row == 'empty')}",
        f"#define {macro}_EMPTY_FILL {int(rules.empty == 'fill')}",
        *_array("uint16_t", f"{name}_row_max_count", rules.row_max_count),
    ]


def _network(n: IntegerNetwork, precision: Precision, macro: str, name: str) -> list[str]:
    narrow = "int8_t" if precision == "int8" else "int16_t"
    scalars = (
        ("H", n.hidden),
        ("SKIP", n.skip),
        ("SLOPE", n.slope),
        ("K", n.k),
        ("J", n.j),
        ("T", n.t),
        ("C", n.offset),
    )
    return [
        "",
        *(f"#define {macro}_{letter} {_literal(value)}" for letter, value in scalars),
        *_array("int32_t", f"{name}_B", n.bias),
        *_array("int16_t", f"{name}_M", n.minimum),
        *_array(narrow, f"{name}_V", n.output),
        *_array(narrow, f"{name}_W", n.weight),
    ]


def _array(kind: str, name: str, values: ArrayLike) -> list[str]:
    array = np.asarray(values)
    shape = "".join(f"[{size}]" for size in array.shape)
    if array.ndim == 1:
        body = list(_values(array))
    else:
        body = [f"    {{{', '.join(map(_literal, row))}}}," for row in array.tolist()]
    return [f"static const {kind} {name}{shape} = {{", *body, "};"]


def _values(values: Iterable[int]) -> Iterator[str]:
    line = "   "
    for value in values:
        text = f" {_literal(int(value))},"
        if len(line) + len(text) > _WIDTH:
            yield line
            line = "   "
        line += text
    yield line


def _literal(value: int) -> str:
    """C has no literal for -2^31."""
    return str(value) if value > -(2**31) else f"({value + 1} - 1)"
