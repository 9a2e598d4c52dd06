"""SunSpec models as JSON: a block of registers whose place in a device is found by walking its models."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

from multidrop.importers.device import ImportedDevice, ImportedRegister, number_format

# Counts that mean "not implemented" (SunSpec information model specification, data types).
_INVALID = {
    **{"int16": 0x8000, "uint16": 0xFFFF, "acc16": 0, "enum16": 0xFFFF, "bitfield16": 0xFFFF},
    **{"int32": 0x80000000, "uint32": 0xFFFFFFFF, "acc32": 0, "enum32": 0xFFFFFFFF, "bitfield32": 0xFFFFFFFF},
    **{"float32": math.nan, "float64": math.nan, "sunssf": 0x8000},
}


def is_sunspec(document: Any) -> bool:
    return (
        isinstance(document, dict)
        and isinstance(document.get("group"), dict)
        and "points" in document["group"]
    )


def read_sunspec(document: Mapping[str, Any]) -> list[ImportedDevice]:
    """Return the model as a device whose block begins at the address 40000, which is to be mended."""
    group = document["group"]
    title = f"SunSpec model {document.get('id', '')} {group.get('label', group.get('name', ''))}".strip()
    device = ImportedDevice(title)
    device.lost.append(
        "the model's place in the device is not in its file: 40000 is assumed, so mend every `at`"
    )
    address = 40000
    for point in group["points"]:
        _add(device, point, address, _names(group))
        address += int(point["size"])
    for repeated in group.get("groups", []):
        device.lost.append(
            f"the group {repeated.get('name')} repeats as often as the device says, and was left out"
        )
    return [device]


def _names(group: Mapping[str, Any]) -> set[str]:
    return {point["name"] for point in group["points"] if point["type"] == "sunssf"}


def _add(device: ImportedDevice, point: Mapping[str, Any], address: int, scales: set[str]) -> None:
    kind, name = str(point["type"]), str(point["name"])
    register = ImportedRegister(name.lower(), address)
    if label := point.get("label"):
        register.details["note"] = str(label)
    if kind == "string":
        register.details["length"] = int(point["size"])
        register.details.pop("note", None)
        device.add(register, is_text=True)
        return
    found = number_format(kind)
    if found is None or kind == "pad":
        if kind != "pad":
            device.lost.append(f"{name}: its type {kind} has no number format")
        return
    if found != "U16":
        register.details["number_format"] = found
    if kind in _INVALID:
        invalid = _INVALID[kind]
        register.details["invalid"] = "NaN" if invalid != invalid else invalid
    if "units" in point:
        register.details["unit"] = str(point["units"])
    _scale(register, point.get("sf"), scales)
    if symbols := point.get("symbols"):
        register.details["bits" if kind.startswith("bitfield") else "values"] = dict(_symbols(symbols))
        register.details.pop("unit", None)
    if point.get("access") == "RW":
        register.gaps.append("it is written there; what a write does is not known here")
    device.add(register)


def _scale(register: ImportedRegister, scale: Any, scales: set[str]) -> None:
    if isinstance(scale, int):
        register.details["step"] = 10**scale if scale >= 0 else float(f"1e{scale}")
    elif scale in scales:
        register.details["scale_register"] = str(scale).lower()
    elif scale:
        register.gaps.append(f"its scale register {scale} is not in this model")


def _symbols(symbols: list[Mapping[str, Any]]) -> Iterator[tuple[str, int]]:
    for symbol in symbols:
        yield str(symbol["name"]).lower(), int(symbol["value"])
