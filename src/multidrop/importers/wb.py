"""Templates of wb-mqtt-serial as JSON: of one's own, since most published ones are not free to copy."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

from multidrop.importers.device import ImportedDevice, ImportedRegister, names_of
from multidrop.importers.numbers import count, put_number, scaled

# Comments, and a comma before the end of a list: what JSON does not have. Strings are left as they are; what
# has no end goes to the text's end, so that each character is looked at once.
_NOT_JSON = re.compile(r'("(?:\\.|[^"\\])*+(?:"|\\?\Z))|//[^\n]*|/\*.*?(?:\*/|\Z)|,(?=\s*[\]}])', re.DOTALL)
MOST_READ = 125
_TABLES = {
    **{"holding": "holding", "holding_single": "holding", "holding_multi": "holding"},
    **{"input": "input", "coil": "coil", "discrete": "discrete"},
}
_FORMATS = {
    **{"u8": "U16", "u16": "U16", "u24": "U32", "u32": "U32", "u64": "U64"},
    **{"s8": "I8", "s16": "I16", "s32": "I32", "s64": "I64"},
    **{"float": "F32", "double": "F64"},
    **{"bcd8": "BCD16", "bcd16": "BCD16", "bcd24": "BCD32", "bcd32": "BCD32"},
}
_WIDTHS = {"u8": 8, "u24": 24}  # bits of a format that is the lowest part of a larger one
_TEXTS = {"string": "B", "char8": "B", "string8": ""}  # B: one character a register, in its low byte
_ORDERS = {(False, False): "", (True, False): "CDAB", (False, True): "BADC", (True, True): "DCBA"}
_LOST = ("condition", "fw", "sporadic", "semi-sporadic", "round_to", "on_value", "consists_of")
_LOST_OF_DEVICES = ("subdevices", "min_request_interval", "guard_interval_us", "frame_timeout_ms")


def json_without_comments(text: str) -> str:
    """Return JSON without the comments, and the commas before a list's end, that such templates have."""
    return _NOT_JSON.sub(lambda found: found[1] or "", text)


def read_wb(document: Any) -> list[ImportedDevice]:
    """Return the template's device, with its channels and parameters, also those of devices within it."""
    template = document.get("device", document)
    if not str(template.get("protocol", "modbus")).startswith("modbus"):
        raise ValueError(f"is a template of another protocol than Modbus: {template['protocol']!r}")
    device = ImportedDevice(str(document.get("title", template.get("name", ""))))
    most = template.get("max_read_registers")
    device.together = most if isinstance(most, int) and 1 <= most <= MOST_READ else 0
    for name, entry in _entries(template):
        with device.entry(name):
            _add(device, name, entry)
    if template.get("setup"):
        reason = "writes at every start are never sent, for they wear the EEPROM"
        device.lose("setup", reason, is_entry=False)
    for key in _LOST_OF_DEVICES:
        if template.get(key):
            device.lose(key, "was not carried over", is_entry=False)
    return [device]


def _entries(found: Any) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield all channels and parameters that have an address, with their names."""
    for inner in found if isinstance(found, list) else ():
        yield from _entries(inner)
    for key, inner in found.items() if isinstance(found, dict) else ():
        if key in ("channels", "parameters"):
            listed = list(inner.items()) if isinstance(inner, dict) else [("", entry) for entry in inner]
            yield from _flat(listed)
        elif isinstance(inner, (dict, list)):
            yield from _entries(inner)


def _flat(listed: list[tuple[str, Any]]) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield entries, and those of which one consists."""
    for key, entry in listed:
        if isinstance(entry, dict):
            name = str(entry.get("name") or key or entry.get("id") or entry.get("title") or "channel")
            if {"address", "write_address"} & entry.keys():
                yield name, entry
            parts = entry.get("consists_of")
            yield from _flat([(name, part) for part in parts] if isinstance(parts, list) else [])


def _add(device: ImportedDevice, name: str, entry: Mapping[str, Any]) -> None:
    kind, format = str(entry.get("reg_type", "holding")), str(entry.get("format", "u16"))
    table = _TABLES.get(kind)
    if table is None:
        device.lose(name, f"its register type {kind} has no table")
        return
    elsewhere = entry.get("write_address")
    address, part = _place(entry.get("address", elsewhere))
    register = ImportedRegister(name, address, table, is_read="address" in entry)
    is_number = table in ("holding", "input")
    if is_number and format in _TEXTS:
        _text(device, register, format, entry)
        return
    if is_number and format not in _FORMATS:
        device.lose(name, f"its format {format} has no number format")
        return
    if entry.get("units"):
        register.details["unit"] = str(entry["units"])
    register.note_write(is_written=table in ("holding", "coil") and not entry.get("readonly"))
    if is_number:
        _number(register, format, part, entry)
    if kind == "holding_multi":
        register.of_writes["write"] = "multiple"
    if elsewhere is not None and register.is_read:
        register.of_writes["ram_address"] = _place(elsewhere)[0]
        register.gaps.append(f"it is written at another address, {register.of_writes['ram_address']:04X}H")
    register.gaps += [f"{key} was not carried over" for key in _LOST if entry.get(key) not in (None, False)]
    device.add(register)


def _number(
    register: ImportedRegister, format: str, part: tuple[int, int] | None, entry: Mapping[str, Any]
) -> None:
    put_number(register.details, _FORMATS[format], _order(entry))
    if part is None and format in _WIDTHS and not register.is_written:
        part = (0, _WIDTHS[format] - 1)
    if part is not None:
        register.details["part"] = f"{part[0]}-{part[1]}"
    scaled(register.details, entry.get("scale") or 1, entry.get("offset"))
    invalid = [count(entry[key]) for key in ("error_value", "unsupported_value") if key in entry]
    if not register.details.get("number_format", "").startswith("F"):
        invalid = [each for each in invalid if each != "NaN"]
    if invalid:
        register.details["invalid"] = invalid if len(invalid) > 1 else invalid[0]
    values, titles = entry.get("enum"), entry.get("enum_titles")
    if isinstance(values, list) and isinstance(titles, list) and _is_plain(register):
        named = names_of(dict(zip(map(str, titles), values, strict=False)))
        if named:
            register.details["values"] = named
            register.details.pop("unit", None)


def _is_plain(register: ImportedRegister) -> bool:
    """Return True for a number that names can stand for."""
    is_float = str(register.details.get("number_format", "")).startswith("F")
    return not is_float and not {"step", "offset"} & register.details.keys()


def _text(device: ImportedDevice, register: ImportedRegister, format: str, entry: Mapping[str, Any]) -> None:
    characters = int(entry.get("string_data_size", 1))
    register.details["length"] = characters if _TEXTS[format] else (characters + 1) // 2
    order = _TEXTS[format] or ("BA" if entry.get("byte_order") == "little_endian" else "")
    if order:
        register.details["order"] = order
    device.add(register, is_text=True)


def _place(address: Any) -> tuple[int, tuple[int, int] | None]:
    """Return the address, and the lowest and highest bit of "register:shift:width"."""
    register, *bits = str(address).split(":")
    at = int(register, 0)
    if not bits:
        return at, None
    shift, width = int(bits[0]), int(bits[1]) if len(bits) > 1 else 1
    return at, (shift, shift + width - 1)


def _order(entry: Mapping[str, Any]) -> str:
    return _ORDERS[entry.get("word_order") == "little_endian", entry.get("byte_order") == "little_endian"]
