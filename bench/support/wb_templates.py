"""Templates in the JSON of wb-mqtt-serial, as its README describes it."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from bench.support.templates import Quantity, Template

# Comments, and a comma before the end of a list: what JSON does not have. Strings are left as they are.
EXTRA = re.compile(r'("(?:\\.|[^"\\])*")|//[^\n]*|/\*.*?\*/|,(?=\s*[\]}])', re.DOTALL)
TABLES = {
    **{"coil": "coil", "discrete": "discrete", "input": "input"},
    **{"holding": "holding", "holding_single": "holding", "holding_multi": "holding by 16"},
}
FORMATS = {
    **{"u8": "u16", "u16": "u16", "u24": "u32", "u32": "u32", "u64": "u64"},
    **{"s8": "s8", "s16": "s16", "s32": "s32", "s64": "s64"},
    **{"float": "f32", "double": "f64"},
    **{"bcd8": "bcd16", "bcd16": "bcd16", "bcd24": "bcd32", "bcd32": "bcd32"},
    **{"string": "text", "string8": "text", "char8": "text"},
}
WIDTHS = {"u8": 8, "u24": 24}  # bits of a format that is the lowest part of a larger one
ONE_WORD = ("u8", "s8", "u16", "s16", "bcd8", "bcd16", "string8")
LACKS = {"s24": "signed 24 bit"}
ONE_CHARACTER = ("string", "char8")  # a register, in its low byte
BESIDES = ("condition", "fw", "sporadic", "semi-sporadic", "consists_of", "enum", "on_value")
OF_DEVICES = ("setup", "subdevices", "min_request_interval", "guard_interval_us", "frame_timeout_ms")


def templates(path: Path) -> Iterator[Template]:
    """Yield the file's device, if it speaks Modbus. Raises ValueError for a file that is no template."""
    document = json.loads(EXTRA.sub(lambda found: found[1] or "", path.read_text("utf-8-sig")))
    device = document.get("device") if isinstance(document, dict) else None
    if not isinstance(device, dict):
        raise ValueError("no template: it has no device")  # noqa: TRY004 (of the file, not of a caller)
    if not str(device.get("protocol", "modbus")).startswith("modbus"):
        return
    template = Template(str(path), besides=[key for key in OF_DEVICES if device.get(key)])
    template.quantities += map(_quantity, _entries(device))
    yield template


def _entries(found: Any) -> Iterator[Mapping[str, Any]]:
    """Yield all channels and parameters, also those of devices within devices."""
    if isinstance(found, list):
        for each in found:
            yield from _entries(each)
    elif isinstance(found, dict):
        for key, inner in found.items():
            if key in ("channels", "parameters"):
                listed = inner.values() if isinstance(inner, dict) else inner
                yield from (entry for entry in _flat(listed) if {"address", "write_address"} & entry.keys())
            elif isinstance(inner, (dict, list)):
                yield from _entries(inner)


def _flat(entries: Any) -> Iterator[Mapping[str, Any]]:
    """Yield entries, and those of which one consists."""
    for entry in entries:
        if isinstance(entry, dict):
            yield entry
            yield from _flat(entry.get("consists_of", ()))


def _quantity(entry: Mapping[str, Any]) -> Quantity:
    name = str(entry.get("name") or entry.get("title") or entry.get("id") or "")
    kind, format = str(entry.get("reg_type", "holding")), str(entry.get("format", "u16"))
    besides = tuple(key for key in BESIDES if key in entry)
    lacks = LACKS.get(format, "")
    if kind not in TABLES:
        lacks = f"register type {kind}"
    elif format not in FORMATS and not lacks:
        lacks = f"format {format}"
    if lacks:
        return Quantity(name, kind, 0, lacks=lacks, besides=besides)
    elsewhere = entry.get("write_address")
    at, part = _place(entry.get("address", elsewhere))
    is_written = not entry.get("readonly", False) and kind not in ("discrete", "input")
    if part is None and format in WIDTHS and not is_written:
        part = (0, WIDTHS[format] - 1)
    return Quantity(
        name,
        TABLES[kind],
        at,
        FORMATS[format],
        order=_order(entry, format),
        step=float(entry.get("scale", 1) or 1),
        offset=float(entry.get("offset", 0)),
        invalid=tuple(_number(entry[key]) for key in ("error_value", "unsupported_value") if key in entry),
        part=part,
        length=_length(entry, format),
        is_written=is_written,
        is_read="address" in entry,
        write_address=None if elsewhere is None or "address" not in entry else _place(elsewhere)[0],
        besides=besides,
    )


def _place(address: Any) -> tuple[int, tuple[int, int] | None]:
    """Return the address, and the lowest and highest bit of "register:shift:width"."""
    register, *bits = str(address).split(":")
    at = int(register, 0)
    if not bits:
        return at, None
    shift, width = int(bits[0]), int(bits[1]) if len(bits) > 1 else 1
    return at, (shift, shift + width - 1)


def _length(entry: Mapping[str, Any], format: str) -> int:
    """Return the registers of a text, 0 for a number."""
    if FORMATS[format] != "text":
        return 0
    characters = int(entry.get("string_data_size", 1))
    return characters if format in ONE_CHARACTER else (characters + 1) // 2


def _order(entry: Mapping[str, Any], format: str) -> str:
    if format in ONE_CHARACTER:
        return "B"
    words = format not in ONE_WORD and entry.get("word_order", "big_endian") == "little_endian"
    swapped = entry.get("byte_order", "big_endian") == "little_endian"
    return {(False, False): "ABCD", (True, False): "CDAB", (False, True): "BADC", (True, True): "DCBA"}[
        words, swapped
    ]


def _number(count: Any) -> float:
    """Return a count: a number, or one in a string, also in hexadecimal."""
    text = str(count)
    try:
        return int(text, 0)
    except ValueError:
        return float(text)
