"""Import Home Assistant's `modbus:` from configuration.yaml and packages, in current and former layouts.

The key tables follow the documentation and schemas of the integration, including former versions.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

from multidrop.importers.device import (
    UNKNOWN_LINE,
    ImportedDevice,
    ImportedRegister,
    LineSettings,
    key_table,
    network_settings,
    serial_settings,
    unimported_keys,
    unit_address,
)
from multidrop.importers.parsing import YamlTag, count, put_number, scaled, whole, words_of

_SWAPS = {"byte": "BADC", "word": "CDAB", "word_byte": "DCBA", "none": "", "": ""}
_TABLES = {
    **{"holding": "holding", "holdings": "holding", "input": "input"},
    **{"coil": "coil", "coils": "coil", "discrete_input": "discrete"},
}
_TYPES = {
    **{"int16": "I16", "int32": "I32", "int64": "I64", "uint16": "U16", "uint32": "U32", "uint64": "U64"},
    **{"float16": "F16", "float32": "F32", "float64": "F64"},
}
_LEGACY_TYPES = {  # types before 2022; `count` stated the number of registers then
    "int": {1: "I16", 2: "I32", 4: "I64"},
    "uint": {1: "U16", 2: "U32", 4: "U64"},
    "float": {1: "F16", 2: "F32", 4: "F64"},
}
_STRUCTURES = {"h": "I16", "H": "U16", "i": "I32", "I": "U32", "l": "I32", "L": "U32", "q": "I64", "Q": "U64"}
_STRUCTURES |= {"e": "F16", "f": "F32", "d": "F64"}
# keys that are read for every kind of entity
_ENTITY = "name slave device_address address scan_interval"
_SHOWN = "unique_id device_class lazy_error_count entity_category icon friendly_name hub"
_SWITCH = key_table(
    imported=f"{_ENTITY} write_type command_on command_off verify", irrelevant=f"{_SHOWN} optimistic"
)
KEYS = {  # how to treat each key, by kind of entity, such as sensor
    "sensors": key_table(
        imported=f"{_ENTITY} unit_of_measurement input_type data_type count structure scale offset swap "
        "reverse_order nan_value slave_count virtual_count",
        irrelevant=f"{_SHOWN} state_class",
        gap="zero_suppress min_value max_value precision",
    ),
    "binary_sensors": key_table(
        imported=f"{_ENTITY} input_type slave_count virtual_count", irrelevant=_SHOWN
    ),
    "switches": _SWITCH,
    "lights": {**_SWITCH, **key_table(gap="brightness_address color_temp_address min_temp max_temp")},
    "fans": _SWITCH,
}
HUB_KEYS = key_table(
    imported=f"name type host port method baudrate bytesize parity stopbits climates covers {' '.join(KEYS)}",
    irrelevant="timeout retries retry_on_empty close_comm_on_error unique_id",
    gap="delay message_wait_milliseconds",
)
VERIFY_KEYS = key_table(imported="address input_type state_on state_off", irrelevant="delay")
_DEFAULT_TABLES = {"sensors": "holding", "binary_sensors": "coil"}
_NOT_READ = ("climates", "covers")
_LEGACY_KINDS = {"sensor": "sensors", "binary_sensor": "binary_sensors", "switch": "switches"}
# Modbus table of each list's entities; "": each entity states it
_LEGACY_LISTS = {"registers": "", "inputs": "", "coils": "coil"}
MOST_REPEATED = 1000  # limit of the key virtual_count
_DEEPEST = 4  # limit of packages within packages


def read_home_assistant(document: Any) -> list[ImportedDevice]:
    """Return a device for each slave of each hub. Raises ValueError if the document has no Modbus entity."""
    found: dict[tuple[int, int | None], ImportedDevice] = {}
    hubs = list(_hubs(document, "", 0))
    for which, hub in enumerate(hubs):
        line, title = _line(hub), str(hub.get("name") or "")
        whole_hub = ImportedDevice(title, line=line)
        for kind, entry in _entries(hub, whole_hub):
            name = str(entry.get("name", "register"))
            with whole_hub.entry(name):
                slave = entry.get("slave", entry.get("device_address"))
                address = None if isinstance(slave, YamlTag) else unit_address(slave, "slave")
                device = found.setdefault((which, address), ImportedDevice(title, address, line=line))
                with device.entry(name):
                    if kind in _NOT_READ:
                        device.lose(name, f"a {kind[:-1]} has no counterpart")
                    else:
                        _add(device, kind, name, entry)
        devices = [device for (at, _), device in found.items() if at == which]
        whole_hub.lose_keys("the hub", hub, HUB_KEYS)
        if str(hub.get("type")) == "udp":
            whole_hub.lose("the hub", "its type udp is not spoken here", is_entry=False)
        if devices:
            devices[0].lost += whole_hub.lost
        elif any(lost.is_entry for lost in whole_hub.lost):
            found[which, None] = whole_hub
    if not found:
        raise ValueError(_lack(document, hubs))
    return list(found.values())


def _lack(document: Any, hubs: list[Mapping[str, Any]]) -> str:
    if hubs:
        return f"`modbus:` has no {', '.join(KEYS)} with entries"
    keys = ", ".join(str(key)[:40] for key in list(document)[:8]) if isinstance(document, dict) else ""
    what = f"its keys are {keys}" if keys else f"it is {type(document).__name__}"
    if isinstance(document, dict) and isinstance(elsewhere := document.get("modbus"), YamlTag):
        return f"`modbus:` stands in another file: {elsewhere}"
    return (
        "has no `modbus:` (Home Assistant), no entity of the platform modbus_controller (ESPHome), and is no "
        f"hub and no list of sensors: {what}"
    )


# ---- hubs ----


def _hubs(found: Any, place: str, depth: int) -> Iterator[Mapping[str, Any]]:
    """Yield each hub (Modbus connection) that a document contains."""
    if isinstance(found, dict):
        if (place == "modbus" and "type" in found) or any(kind in found for kind in (*KEYS, *_NOT_READ)):
            yield found
            return
        for key, value in found.items():
            label = str(key).split(" ")[0]
            if label in _LEGACY_KINDS:
                yield from _legacy_hubs(_LEGACY_KINDS[label], value, found.get("modbus"))
            elif depth < _DEEPEST and isinstance(value, (dict, list)):
                yield from _hubs(value, label, depth + 1)
    elif isinstance(found, list):
        sensors = [each for each in found if isinstance(each, dict) and "address" in each]
        if sensors and place in ("", "sensors"):
            kinds = {_kind_of(each) for each in sensors}
            yield {kind: [each for each in sensors if _kind_of(each) == kind] for kind in kinds}
        elif depth < _DEEPEST:
            for each in found:
                yield from _hubs(each, place, depth + 1) if isinstance(each, dict) else ()


def _kind_of(entry: Mapping[str, Any]) -> str:
    if {"write_type", "command_on", "command_off"} & entry.keys():
        return "switches"
    is_bit = str(entry.get("input_type")) in ("coil", "discrete_input")
    return "binary_sensors" if is_bit else "sensors"


def _legacy_hubs(kind: str, listed: Any, hubs: Any) -> Iterator[Mapping[str, Any]]:
    """Yield a hub for each `platform: modbus` of a configuration from before 2021.

    Its keys are renamed to those that Home Assistant uses now.
    """
    known = {
        str(hub.get("name", "modbus_hub")): hub
        for hub in (hubs if isinstance(hubs, list) else [hubs])
        if isinstance(hub, dict)
    }
    for platform in listed if isinstance(listed, list) else ():
        if not isinstance(platform, dict) or platform.get("platform") != "modbus":
            continue
        for key, table in _LEGACY_LISTS.items():
            entries = platform.get(key)
            for entry in entries if isinstance(entries, list) else ():
                if isinstance(entry, dict):
                    name = str(entry.get("hub", "modbus_hub"))
                    hub = {one: value for one, value in known.get(name, {}).items() if one not in KEYS}
                    yield {"name": name, **hub, kind: [_modern(kind, entry, table)]}


def _modern(kind: str, entry: Mapping[str, Any], table: str) -> dict[str, Any]:
    kept = "write_type" if kind == "switches" else "input_type"
    names = {"register": "address", "coil": "address", "register_type": kept}
    found = {names.get(str(key), str(key)): value for key, value in entry.items()}
    if table:
        found[kept] = table
    if kind == "switches" and {"verify_register", "state_on", "state_off"} & found.keys():
        verify = {"address": found.pop("verify_register", None)}
        verify |= {key: found.pop(key) for key in ("state_on", "state_off") if key in found}
        found["verify"] = {key: value for key, value in verify.items() if value is not None}
    found.pop("verify_state", None)
    return found


def _line(hub: Mapping[str, Any]) -> LineSettings:
    """Return the line settings of a hub whose type is serial, tcp, udp or rtuovertcp."""
    kind = str(hub.get("type", ""))
    if kind in ("tcp", "udp", "rtuovertcp"):
        return network_settings(hub.get("host"), hub.get("port", 502), is_serial_frames=kind == "rtuovertcp")
    if kind != "serial":
        return UNKNOWN_LINE if "host" not in hub else network_settings(hub["host"], hub.get("port", 502))
    keys = ("baudrate", "bytesize", "parity", "stopbits")
    return serial_settings(hub, port=hub.get("port", ""), framing=hub.get("method", "rtu"), keys=keys)


def _entries(hub: Mapping[str, Any], lost: ImportedDevice) -> Iterator[tuple[str, Mapping[str, Any]]]:
    for kind in (*KEYS, *_NOT_READ):
        listed = hub.get(kind)
        for entry in listed if isinstance(listed, list) else [listed] if listed is not None else ():
            if isinstance(entry, dict):
                yield kind, entry
            else:
                where = "stands in another file" if isinstance(entry, YamlTag) else "is no entity"
                lost.lose(kind, f"{str(entry)[:60]!r} {where}")


# ---- entities ----


def _add(device: ImportedDevice, kind: str, name: str, entry: Mapping[str, Any]) -> None:
    is_written = kind in ("switches", "lights", "fans")
    given = entry.get("write_type" if is_written else "input_type", _DEFAULT_TABLES.get(kind, "holding"))
    table = _TABLES.get(str(given))
    if table is None:
        device.lose(name, f"its table {str(given)[:40]!r} is not known")
        return
    register = ImportedRegister(name, whole(entry, "address"), table)
    register.note_write(is_written=is_written)
    if isinstance(unit := entry.get("unit_of_measurement"), YamlTag):
        register.gaps.append(f"its unit is {unit}")
    elif unit:
        register.details["unit"] = str(unit)
    register.gaps += unimported_keys(entry, KEYS[kind])
    if (interval := entry.get("scan_interval")) not in (None, 0):
        register.gaps.append(f"it was read every {str(interval)[:20]} s: `every` in the plant file")
    if is_written:
        _verify(register, entry)
    if register.table in ("holding", "input") and kind == "sensors":
        _sensor(device, register, entry)
        return
    if register.table in ("holding", "input") and kind == "binary_sensors":
        register.details["part"] = "0"  # Home Assistant uses only bit 0 of the word
    _repeat(device, register, entry, 1)


def _verify(register: ImportedRegister, entry: Mapping[str, Any]) -> None:
    """Read the state of a switch from its state register, if it has one.

    Values for on and off other than 1 and 0 are added to the register's `gaps`.
    """
    on, off = entry.get("command_on", 1), entry.get("command_off", 0)
    verify = entry.get("verify")
    if isinstance(verify, dict):
        written, table = register.address, str(verify.get("input_type", register.table))
        register.address = whole(verify, "address", written)
        if table not in _TABLES:
            raise ValueError(f"verify: input_type = {table[:40]!r} is not a known table")
        register.table = _TABLES[table]
        if register.address != written:
            register.gaps.append(f"it is written at another address, {written:04X}H")
        on, off = verify.get("state_on", on), verify.get("state_off", off)
        register.gaps += [f"verify: {each}" for each in unimported_keys(verify, VERIFY_KEYS)]
    elif verify is not None:
        register.gaps.append("verify was not carried over")
    if (on, off) != (1, 0):
        register.gaps.append(f"it is on if its count is {str(on)[:40]}, and off if it is {str(off)[:40]}")


def _sensor(device: ImportedDevice, register: ImportedRegister, entry: Mapping[str, Any]) -> None:
    kind = str(entry.get("data_type", "int16"))
    swap = _swap(register, entry)
    if kind == "string":
        register.details = {"length": whole(entry, "count")}
        if swap == "BADC":
            register.details["order"] = "BA"
        elif swap:
            device.lose(register.name, f"a text whose swap is {entry.get('swap', 'word')}")
            return
        device.add(register, is_text=True)
        return
    found = _format(register, kind, entry)
    if found is None:
        structure = f" of the structure {str(entry['structure'])[:40]!r}" if "structure" in entry else ""
        device.lose(register.name, f"its type {kind[:40]}{structure} has no number format")
        return
    put_number(register.details, found, swap)
    scaled(register.details, entry.get("scale"), entry.get("offset"))
    if entry.get("nan_value") is not None:
        register.details["invalid"] = _nan(entry["nan_value"])
    _repeat(device, register, entry, words_of(found))


def _swap(register: ImportedRegister, entry: Mapping[str, Any]) -> str:
    """Return the byte order that `swap` states, or `reverse_order` in files from before 2021."""
    given = str(entry.get("swap") or "none")
    if given not in _SWAPS:
        register.lacks = f"its swap {given[:40]}"
        return ""
    if entry.get("reverse_order"):
        if given != "none":
            register.lacks = f"it has both swap {given} and reverse_order"
        return "CDAB"
    return _SWAPS[given]


def _format(register: ImportedRegister, kind: str, entry: Mapping[str, Any]) -> str | None:
    """Return the number format of a data type, or None. Add a doubtful width to the register's `gaps`."""
    registers = whole(entry, "count", 1)
    if kind in _LEGACY_TYPES:
        # applies only to floats, because an int has 16 bits in every version
        if kind == "float" and "count" not in entry:
            width = "one register was assumed, as Home Assistant did"
            register.gaps.append(f"the width of its type {kind} is not stated; {width}")
        return _LEGACY_TYPES[kind].get(registers)
    if kind == "custom":
        structure = re.fullmatch(r"[>!]1?([a-zA-Z])", str(entry.get("structure", "")))
        return _STRUCTURES.get(structure[1]) if structure else None
    found = _TYPES.get(kind)
    words = words_of(found) if found else 0
    if found and "count" in entry and registers not in (words, words * (1 + _more(entry))):
        register.gaps.append(f"its count {registers} is not that of {kind}, which takes {words}")
    return found


def _nan(given: Any) -> int | str:
    """Return the raw count in `nan_value`, which may be hex text without 0x."""
    text = str(given).strip()
    return int(text, 16) if re.fullmatch(r"[0-9]*[a-fA-F][0-9a-fA-F]*", text) else count(given, "nan_value")


def _more(entry: Mapping[str, Any]) -> int:
    key = "slave_count" if entry.get("slave_count") else "virtual_count"
    more = whole(entry, key, 0)
    if not 0 <= more <= MOST_REPEATED:
        raise ValueError(f"{key} = {more} is outside 0 to {MOST_REPEATED}")
    return more


def _repeat(device: ImportedDevice, register: ImportedRegister, entry: Mapping[str, Any], words: int) -> None:
    """Add the register, and `slave_count` or `virtual_count` further registers after it."""
    for at in range(_more(entry) + 1):
        name, address = f"{register.name}_{at}" if at else register.name, register.address + at * words
        details, gaps = dict(register.details), list(register.gaps)
        device.add(replace(register, name=name, address=address, details=details, gaps=gaps))
