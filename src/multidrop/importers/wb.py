"""Templates of wb-mqtt-serial as JSON: of one's own, since most published ones are not free to copy."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from multidrop.importers.device import ImportedDevice, ImportedRegister, number_format, scaled, words_of

_TABLES = {
    **{"holding": "holding", "holding_single": "holding", "holding_multi": "holding"},
    **{"input": "input", "coil": "coil", "discrete": "discrete"},
}
_ORDERS = {
    ("big_endian", "big_endian"): "",
    ("little_endian", "big_endian"): "CDAB",
    ("big_endian", "little_endian"): "BADC",
    ("little_endian", "little_endian"): "DCBA",
}
_INVALID = ("error_value", "unsupported_value")
_LOST = ("write_address", "condition", "round_to", "sporadic")


def read_wb(document: Any) -> list[ImportedDevice]:
    """Return the template's device, with its channels and parameters."""
    template = document.get("device", document)
    device = ImportedDevice(str(document.get("title", template.get("name", ""))))
    parameters = template.get("parameters", [])
    named = parameters.items() if isinstance(parameters, dict) else ((p.get("id"), p) for p in parameters)
    for channel in template.get("channels", []):
        _add(device, str(channel.get("name", "channel")), channel, template)
    for name, parameter in named:
        _add(device, str(name), parameter, template)
    if template.get("setup"):
        device.lost.append("setup: writes at every start are never sent, for they wear the EEPROM")
    return [device]


def _add(device: ImportedDevice, name: str, channel: Mapping[str, Any], template: Mapping[str, Any]) -> None:
    table = _TABLES.get(str(channel.get("reg_type", "holding")))
    first, *rest = str(channel.get("address", "")).split(":")
    if table is None or not first:
        device.lost.append(f"{name}: it has no table or address that can be read")
        return
    register = ImportedRegister(name, int(first, 0), table)
    kind = str(channel.get("format", "u16"))
    if table in ("holding", "input"):
        if kind in ("string", "string8"):
            device.lost.append(f"{name}: a text; declare it under [text] with its length")
            return
        if not _number(device, register, kind, rest, channel, template):
            return
    if channel.get("units"):
        register.details["unit"] = str(channel["units"])
    if not channel.get("readonly", table in ("input", "discrete")):
        register.gaps.append("it is written there; what a write does is not known here")
    register.gaps += [f"{key} was not carried over" for key in _LOST if channel.get(key) not in (None, False)]
    device.add(register)


def _number(
    device: ImportedDevice,
    register: ImportedRegister,
    kind: str,
    rest: list[str],
    channel: Mapping[str, Any],
    template: Mapping[str, Any],
) -> bool:
    bcd = {"bcd8": "BCD16", "bcd16": "BCD16", "bcd32": "BCD32"}
    found = bcd.get(kind) or number_format({"u8": "u16", "char8": "u16"}.get(kind, kind))
    if found is None:
        device.lost.append(f"{register.name}: its format {kind} has no number format")
        return False
    if found != "U16":
        register.details["number_format"] = found
    if kind in ("u8", "char8", "bcd8"):
        register.details["part"] = "0-7"
    if len(rest) == 2:
        low, width = int(rest[0]), int(rest[1])
        register.details["part"] = f"{low}-{low + width - 1}" if width > 1 else str(low)
    word = str(channel.get("word_order", template.get("word_order", "big_endian")))
    byte = str(channel.get("byte_order", template.get("byte_order", "big_endian")))
    order = _ORDERS.get((word, byte), "")
    if order and words_of(found) == 1:
        order = "BA" if byte == "little_endian" else ""
    if order:
        register.details["order"] = order
    scaled(register.details, channel.get("scale"), channel.get("offset"))
    invalid = [int(str(channel[key]), 0) for key in _INVALID if key in channel]
    if invalid:
        register.details["invalid"] = invalid[0] if len(invalid) == 1 else invalid
    return True
