"""Tables in the CSV of modpoll: lines `device`, `poll` and `ref`."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from pathlib import Path

from bench.support.templates import Quantity, Template

TABLES = {
    "coil": "coil",
    "discrete_input": "discrete",
    "holding_register": "holding",
    "input_register": "input",
}
ORDERS = {"BE_BE": "ABCD", "LE_BE": "BADC", "BE_LE": "CDAB", "LE_LE": "DCBA"}  # bytes, words
FORMATS = {
    **{f"uint{bits}": f"u{bits}" for bits in (16, 32, 64)},
    **{f"int{bits}": f"s{bits}" for bits in (16, 32, 64)},
    **{f"float{bits}": f"f{bits}" for bits in (32, 64)},
}
FLAGS = re.compile(r"bool(8|16)?")
TEXT = re.compile(r"string(\d+)")


def templates(path: Path) -> Iterator[Template]:
    """Yield the file's devices. Raises ValueError for a file that is no such table."""
    found: Template | None = None
    table = order = ""
    with path.open(newline="", encoding="utf-8-sig") as file:
        for number, row in enumerate(csv.reader(file), 1):
            kind, *cells = [cell.strip() for cell in row] or [""]
            if not kind or kind.startswith("#"):
                continue
            if kind == "device" and cells:
                if found:
                    yield found
                found = Template(f"{path}: {cells[0]}")
            elif kind == "poll" and found and len(cells) > 2:
                table, order = cells[0], (cells[3] if len(cells) > 3 else "") or "BE_BE"
            elif kind == "ref" and found and table and len(cells) > 2:
                found.quantities.append(_quantity(table, order, cells))
            else:
                raise ValueError(f"no modpoll table: line {number} is {','.join(row)[:40]!r}")
    if not found:
        raise ValueError("no modpoll table: it has no device")
    yield found


def _quantity(table: str, order: str, cells: list[str]) -> Quantity:
    name, place, dtype, access, _, scale = [*cells, "", "", ""][:6]
    register, _, bit = place.partition(":")
    is_written, at = "w" in access, int(register, 0)
    text, lacks = TEXT.fullmatch(dtype), ""
    kind = TABLES.get(table, table)
    if kind not in TABLES.values():
        lacks = f"table {table}"
    elif order not in ORDERS:
        lacks = f"order {order}"
    elif not (FLAGS.fullmatch(dtype) or text or dtype in FORMATS):
        lacks = f"format {dtype}"
    return Quantity(
        name,
        kind,
        at,
        "text" if text else FORMATS.get(dtype, "u16"),
        order=_order(order, dtype),
        step=float(scale or 1),
        part=(int(bit), int(bit)) if bit else None,
        length=(int(text[1]) + 1) // 2 if text else 0,
        is_read="r" in access,
        is_written=is_written and kind in ("coil", "holding"),
        lacks=lacks,
    )


def _order(order: str, dtype: str) -> str:
    """Return the order of bytes; the words of a text are never swapped, and flags have no order."""
    if TEXT.fullmatch(dtype) or dtype in ("uint16", "int16"):
        return "BADC" if order.startswith("LE_") else "ABCD"
    return ORDERS.get(order, "ABCD") if dtype in FORMATS else "ABCD"
