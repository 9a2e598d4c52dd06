"""Import SunSpec models from JSON. A model is a block of registers; its address depends on the device."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from multidrop.importers.device import ImportedDevice, ImportedRegister, key_table, unimported_keys
from multidrop.importers.parsing import number_format, put_number, whole, words_of

POINT_KEYS = key_table(
    imported="name type size count sf units access symbols label",
    irrelevant="value mandatory static desc detail notes comments standards",
)
GROUP_KEYS = key_table(
    imported="name label points groups", irrelevant="type count desc detail notes comments standards"
)
MODEL_KEYS = key_table(imported="id group", irrelevant="label desc detail notes comments standards")
MOST_REPEATED = 1000  # limit of registers of one point, SunSpec's word for a value
FIRST = 40000  # assumed start address of a model, which its file does not state
# Raw counts that mean "not implemented", by type (SunSpec information model specification, data types).
_INVALID = {
    **{"int16": 0x8000, "uint16": 0xFFFF, "acc16": 0, "enum16": 0xFFFF, "bitfield16": 0xFFFF},
    **{"int32": 0x80000000, "uint32": 0xFFFFFFFF, "acc32": 0, "enum32": 0xFFFFFFFF, "bitfield32": 0xFFFFFFFF},
    # 64-bit counts are signed here, because TOML has no unsigned 64-bit numbers
    **{"int64": -(1 << 63), "uint64": -1, "acc64": 0, "bitfield64": -1},
    **{"float32": math.nan, "float64": math.nan, "sunssf": 0x8000},
}


def is_sunspec(document: Any) -> bool:
    return (
        isinstance(document, dict)
        and isinstance(document.get("group"), dict)
        and "points" in document["group"]
    )


def read_sunspec(document: Mapping[str, Any]) -> list[ImportedDevice]:
    """Return the model as a device whose block starts at the assumed address 40000."""
    group = document["group"]
    title = f"SunSpec model {document.get('id', '')} {group.get('label', group.get('name', ''))}".strip()
    device = ImportedDevice(title)
    reason = f"its place in the device is not in its file: {FIRST} is assumed, so mend every `at`"
    device.lose("the model", reason, is_entry=False)
    names: dict[str, str] = {}  # register names of points that are scale factors
    address = FIRST
    for point in group["points"]:
        size, count = _size(point), whole(point, "count", 1)
        for at in range(min(count, MOST_REPEATED)):
            name = f"{point['name']}_{at}" if at else str(point["name"])
            with device.entry(name):
                _add(device, point, name, address + at * size, names)
        address += size * count
    if FIRST < address <= 0x10000:
        # All addresses of a SunSpec model have registers, so one read may include any addresses.
        device.readable = range(FIRST, address)
    for register in device.registers:
        _tie(register, names)
    device.lose_keys("the model", document, MODEL_KEYS)
    device.lose_keys("the group", group, GROUP_KEYS)
    for repeated in group.get("groups", []):
        _lose_group(device, repeated)
    return [device]


def _size(point: Mapping[str, Any]) -> int:
    try:
        return whole(point, "size")
    except KeyError:
        raise ValueError(f"the point {str(point.get('name'))[:40]!r} has no size") from None


def _lose_group(device: ImportedDevice, group: Mapping[str, Any]) -> None:
    """Record the points of a group, and of the groups in it, as not imported."""
    for point in group.get("points", []):
        with device.entry(str(group.get("name"))):
            device.lose(
                f"{group.get('name')}.{point['name']}", "its group repeats as often as the device says"
            )
    for inner in group.get("groups", []):
        _lose_group(device, inner)


def _add(
    device: ImportedDevice, point: Mapping[str, Any], name: str, address: int, names: dict[str, str]
) -> None:
    kind = str(point["type"])
    register = ImportedRegister(name, address)
    register.gaps += unimported_keys(point, POINT_KEYS)
    if kind == "string":
        register.details["length"] = whole(point, "size")
        device.add(register, is_text=True)
        return
    if kind == "pad":
        return
    found = number_format(kind)
    if found is None:
        device.lose(name, f"its type {kind} has no number format")
        return
    if words_of(found) != whole(point, "size"):
        device.lose(name, f"its size {point['size']} is not that of {kind}, which takes {words_of(found)}")
        return
    if label := point.get("label"):
        register.details["note"] = str(label)
    put_number(register.details, found)
    if kind in _INVALID:
        invalid = _INVALID[kind]
        register.details["invalid"] = "NaN" if invalid != invalid else invalid
    if "units" in point:
        register.details["unit"] = str(point["units"])
    if point.get("sf"):
        register.details["scale_register"] = point["sf"]
    symbols = {str(symbol["name"]): symbol["value"] for symbol in point.get("symbols") or ()}
    if symbols:
        register.put_names("bits" if kind.startswith("bitfield") else "values", symbols)
    register.note_write(is_written=point.get("access") == "RW")
    device.add(register)
    if kind == "sunssf":
        names[name] = register.name
        for key in ("unit", "invalid"):
            register.details.pop(key, None)


def _tie(register: ImportedRegister, names: Mapping[str, str]) -> None:
    """Set the step if the scale factor is a number; if it is a register, set the scale register."""
    scale = register.details.pop("scale_register", None)
    if isinstance(scale, int):
        register.details["step"] = 10**scale if 0 <= scale <= 10 else float(f"1e{scale}")
    elif scale in names:
        register.details["scale_register"] = names[scale]
    elif scale:
        register.lacks = f"its scale register {scale} is not in this model"
