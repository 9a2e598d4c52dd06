"""Home Assistant's `modbus:` in configuration.yaml (its integration's documentation)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

from multidrop.importers.device import ImportedDevice, ImportedRegister, unit_address
from multidrop.importers.line_settings import UNKNOWN_LINE, LineSettings, network_settings, serial_settings
from multidrop.importers.numbers import count, number, number_format, put_number, scaled, words_of

_SWAPS = {"byte": "BADC", "word": "CDAB", "word_byte": "DCBA", "none": "", "": ""}
_TABLES = {"holding": "holding", "input": "input", "coil": "coil", "discrete_input": "discrete"}
_KINDS = ("sensors", "binary_sensors", "switches", "lights", "fans")
_DEFAULT_TABLES = {"sensors": "holding", "switches": "holding", "lights": "holding", "fans": "holding"}
_NOT_READ = ("climates", "covers")
_LOST = ("zero_suppress", "structure", "min_value", "max_value")
MOST_REPEATED = 1000  # of virtual_count


def read_home_assistant(document: Any) -> list[ImportedDevice]:
    """Return a device for each slave of each hub of a document."""
    hubs = document.get("modbus") or [] if isinstance(document, dict) else document
    found: dict[tuple[int, int | None], ImportedDevice] = {}
    for which, hub in enumerate(hubs if isinstance(hubs, list) else [hubs]):
        line, title = _line(hub), str(hub.get("name", ""))
        for kind, entry in _entries(hub):
            slave = unit_address(entry.get("slave", entry.get("device_address")))
            device = found.setdefault((which, slave), ImportedDevice(title, slave, line=line))
            name = str(entry.get("name", "register"))
            with device.entry(name):
                if kind in _NOT_READ:
                    device.lose(name, f"a {kind[:-1]} has no counterpart")
                else:
                    _add(device, kind, name, entry)
    return list(found.values())


def _line(hub: Mapping[str, Any]) -> LineSettings:
    """Return the line of a hub: of type serial, tcp, or rtuovertcp."""
    kind = str(hub.get("type", ""))
    if kind in ("tcp", "rtuovertcp"):
        return network_settings(hub.get("host"), hub.get("port", 502), is_rtu=kind == "rtuovertcp")
    if kind != "serial":
        return UNKNOWN_LINE
    keys = {"baudrate": "baudrate", "bits": "bytesize", "parity": "parity", "stop": "stopbits"}
    given = {key: hub[theirs] for key, theirs in keys.items() if theirs in hub}
    return serial_settings(given, port=hub.get("port", ""), framing=hub.get("method", "rtu"))


def _entries(hub: Mapping[str, Any]) -> Iterator[tuple[str, Mapping[str, Any]]]:
    for kind in (*_KINDS, *_NOT_READ):
        for entry in hub.get(kind, None) or []:
            yield kind, entry


def _add(device: ImportedDevice, kind: str, name: str, entry: Mapping[str, Any]) -> None:
    given = entry.get("input_type", entry.get("write_type", _DEFAULT_TABLES.get(kind, "coil")))
    table = _TABLES.get(str(given))
    if table is None:
        device.lose(name, f"its table {str(given)[:40]!r} is not known")
        return
    register = ImportedRegister(name, int(entry["address"]), table)
    register.note_write(is_written=kind in ("switches", "lights", "fans"))
    if unit := entry.get("unit_of_measurement"):
        register.details["unit"] = str(unit)
    register.gaps += [f"{key} was not carried over" for key in _LOST if entry.get(key)]
    if number(entry.get("scan_interval"), 0):
        register.gaps.append(f"it was read every {entry['scan_interval']} s: `every` in the plant file")
    if table in ("holding", "input") and kind == "sensors":
        _sensor(device, register, entry)
        return
    if table in ("holding", "input") and kind == "binary_sensors":
        register.details["part"] = "0"  # the others of its bits are never looked at
    _repeat(device, register, entry, 1)


def _sensor(device: ImportedDevice, register: ImportedRegister, entry: Mapping[str, Any]) -> None:
    kind = str(entry.get("data_type", "int16"))
    swap = _SWAPS.get(str(entry.get("swap", "none")))
    if swap is None:
        register.lacks, swap = f"its swap {str(entry['swap'])[:40]}", ""
    if kind == "string":
        register.details = {"length": int(entry.get("count", 1))}
        if swap == "BADC":
            register.details["order"] = "BA"
        elif swap:
            device.lose(register.name, f"a text whose swap is {entry['swap']}")
            return
        device.add(register, is_text=True)
        return
    found = number_format(kind)
    if found is None:
        device.lose(register.name, f"its type {kind[:40]} has no number format")
        return
    put_number(register.details, found, swap)
    scaled(register.details, entry.get("scale"), entry.get("offset"))
    if "nan_value" in entry:
        register.details["invalid"] = count(entry["nan_value"])
    _repeat(device, register, entry, words_of(found))


def _repeat(device: ImportedDevice, register: ImportedRegister, entry: Mapping[str, Any], words: int) -> None:
    """Add the register, and as many behind it as `slave_count` or `virtual_count` says."""
    more = int(entry.get("slave_count") or entry.get("virtual_count") or 0)
    if not 0 <= more <= MOST_REPEATED:
        raise ValueError(f"virtual_count = {more} is not 0 to {MOST_REPEATED}")
    first = replace(register, details=dict(register.details), gaps=list(register.gaps))
    for at in range(more + 1):
        name = f"{first.name}_{at}" if at else first.name
        details, gaps = dict(first.details), list(first.gaps)
        device.add(replace(first, name=name, address=first.address + at * words, details=details, gaps=gaps))
