"""Home Assistant's `modbus:` in configuration.yaml (its integration's documentation). Needs PyYAML."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from importlib import import_module
from typing import Any

from multidrop.importers.device import (
    ImportedDevice,
    ImportedRegister,
    number,
    number_format,
    scaled,
    words_of,
)

_SWAPS = {"byte": "BADC", "word": "CDAB", "word_byte": "DCBA", "none": "", "": ""}
_TABLES = {"holding": "holding", "input": "input", "coil": "coil", "discrete_input": "discrete"}
_KINDS = ("sensors", "binary_sensors", "switches", "lights", "fans")
_NOT_READ = ("climates", "covers")
_LOST = ("zero_suppress", "slave_count", "virtual_count", "structure")


def read_home_assistant(text: str) -> list[ImportedDevice]:
    """Return a device for each slave. Raises ImportError without PyYAML."""
    try:
        yaml = import_module("yaml")
    except ImportError as failure:
        raise ImportError("YAML is read with PyYAML: pip install 'multidrop[yaml]'") from failure

    class Loader(yaml.SafeLoader):  # type: ignore[misc, name-defined]
        """Takes tags such as !secret for nothing."""

    Loader.add_multi_constructor("!", lambda loader, suffix, node: None)
    try:
        document = yaml.load(text, Loader)
    except yaml.YAMLError as failure:
        raise ValueError(f"is not YAML: {' '.join(str(failure).split())}") from failure
    hubs = document.get("modbus", []) if isinstance(document, dict) else document
    found: dict[int | None, ImportedDevice] = {}
    for hub in hubs if isinstance(hubs, list) else [hubs]:
        for kind, entry in _entries(hub):
            slave = entry.get("slave", entry.get("device_address"))
            device = found.setdefault(slave, ImportedDevice(str(hub.get("name", "")), slave))
            if kind in _NOT_READ:
                device.lost.append(f"{entry.get('name')}: a {kind[:-1]} has no counterpart")
            else:
                _add(device, kind, entry)
    return list(found.values())


def _entries(hub: Mapping[str, Any]) -> Iterator[tuple[str, Mapping[str, Any]]]:
    for kind in (*_KINDS, *_NOT_READ):
        for entry in hub.get(kind, None) or []:
            yield kind, entry


def _add(device: ImportedDevice, kind: str, entry: Mapping[str, Any]) -> None:
    name = str(entry.get("name", "register"))
    given = entry.get("input_type", entry.get("write_type", "holding" if kind == "sensors" else "coil"))
    table = _TABLES.get(str(given))
    if table is None:
        device.lost.append(f"{name}: its table {given!r} is not known")
        return
    register = ImportedRegister(name, int(entry.get("address", -1)), table)
    if kind in ("switches", "lights", "fans"):
        register.gaps.append("it is written there; what a write does is not known here")
    kind_of_number = str(entry.get("data_type", "int16"))
    if table in ("holding", "input") and kind_of_number == "string":
        register.details["length"] = int(entry.get("count", 1))
        device.add(register, is_text=True)
        return
    if table in ("holding", "input"):
        if kind != "sensors":
            kind_of_number = "uint16"
        found = number_format(kind_of_number)
        if found is None:
            device.lost.append(f"{name}: its type {kind_of_number} has no number format")
            return
        if found != "U16":
            register.details["number_format"] = found
        if order := _SWAPS.get(str(entry.get("swap", "none")), ""):
            register.details["order"] = "BA" if words_of(found) == 1 else order
        scaled(register.details, entry.get("scale"), entry.get("offset"))
        if "nan_value" in entry:
            register.details["invalid"] = int(str(entry["nan_value"]), 0)
    if unit := entry.get("unit_of_measurement"):
        register.details["unit"] = str(unit)
    register.gaps += [f"{key} was not carried over" for key in _LOST if entry.get(key)]
    if number(entry.get("scan_interval"), 0):
        register.gaps.append(f"it was read every {entry['scan_interval']} s: `every` in the plant file")
    device.add(register)
