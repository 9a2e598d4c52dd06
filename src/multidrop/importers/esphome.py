"""ESPHome's `modbus_controller`: entities of that platform in a node's YAML (its documentation)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from multidrop.importers.device import ImportedDevice, ImportedRegister, names_of, unit_address
from multidrop.importers.line_settings import UNKNOWN_LINE, LineSettings, serial_settings
from multidrop.importers.numbers import put_number, scaled

_KINDS = ("sensor", "binary_sensor", "text_sensor", "switch", "number", "select", "output")
_WRITTEN = ("switch", "number", "select", "output")
_TABLES = {"coil": "coil", "discrete_input": "discrete", "holding": "holding", "read": "input"}
_DEFAULT_TABLES = {"output": "holding", "number": "holding", "select": "holding"}
_FORMATS = {
    **{"U_WORD": "U16", "U_DWORD": "U32", "U_QWORD": "U64", "S_WORD": "I16", "S_DWORD": "I32"},
    **{"S_QWORD": "I64", "FP32": "F32"},
}
_LOST = ("skip_updates", "write_lambda", "custom_command", "multiply")


def is_esphome(document: Any) -> bool:
    return isinstance(document, dict) and "modbus_controller" in document


def read_esphome(document: Mapping[str, Any]) -> list[ImportedDevice]:
    """Return a device for each controller of a document."""
    title = str((document.get("esphome") or {}).get("name", ""))
    listed = document["modbus_controller"]
    addresses = {
        str(controller.get("id")): unit_address(controller.get("address"))
        for controller in (listed if isinstance(listed, list) else [listed])
    }
    line = _line(document.get("uart"))
    only = next(iter(addresses.values())) if len(addresses) == 1 else None
    found: dict[str, ImportedDevice] = {}
    for kind, entry in _entries(document):
        controller = str(entry.get("modbus_controller_id"))
        address = addresses.get(controller, only)
        device = found.setdefault(controller, ImportedDevice(title, address, line=line))
        name = str(entry.get("name") or entry.get("id") or "register")
        with device.entry(name):
            _add(device, kind, name, entry)
    return list(found.values())


def _line(uart: Any) -> LineSettings:
    """Return the settings of the node's only UART; where it has several, they are not known."""
    ports = [uart] if isinstance(uart, dict) else uart
    if not isinstance(ports, list) or len(ports) != 1 or not isinstance(ports[0], dict):
        return UNKNOWN_LINE
    keys = {"baudrate": "baud_rate", "bits": "data_bits", "parity": "parity", "stop": "stop_bits"}
    return serial_settings({key: ports[0][theirs] for key, theirs in keys.items() if theirs in ports[0]})


def _entries(document: Mapping[str, Any]) -> Iterator[tuple[str, Mapping[str, Any]]]:
    for kind in _KINDS:
        listed = document.get(kind) or []
        for entry in listed if isinstance(listed, list) else [listed]:
            if isinstance(entry, dict) and entry.get("platform") == "modbus_controller":
                yield kind, entry


def _add(device: ImportedDevice, kind: str, name: str, entry: Mapping[str, Any]) -> None:
    table = _TABLES.get(str(entry.get("register_type", _DEFAULT_TABLES.get(kind))))
    if table is None:
        device.lose(name, "its register type is not known")
        return
    is_words = table in ("holding", "input")
    address = _whole(entry["address"]) + _whole(entry.get("offset", 0)) // (2 if is_words else 1)
    register = ImportedRegister(name, address, table, is_read=kind != "output")
    register.note_write(is_written=kind in _WRITTEN)
    if entry.get("use_write_multiple"):
        register.of_writes["write"] = "multiple"
    register.gaps += [f"{key} was not carried over" for key in _LOST if entry.get(key)]
    if kind == "text_sensor":
        _text(device, register, entry)
        return
    if unit := entry.get("unit_of_measurement"):
        register.details["unit"] = str(unit)
    if is_words and not _number(device, register, kind, entry):
        return
    if entry.get("lambda"):
        register.lacks = "its lambda is a program"
    if entry.get("filters"):
        _filters(register, entry["filters"])
    device.add(register)


def _filters(register: ImportedRegister, filters: Any) -> None:
    """Make a factor among the filters a step; what the others do is not carried over."""
    listed = [each for each in filters if isinstance(each, dict)] if isinstance(filters, list) else []
    factors = [each["multiply"] for each in listed if "multiply" in each]
    if len(factors) == 1 and register.table in ("holding", "input"):
        scaled(register.details, factors[0])
    others = sorted({str(key)[:40] for each in listed for key in each if key != "multiply"})
    if others or len(factors) > 1 or len(listed) != len(filters):
        register.gaps.append(f"not all of its filters were carried over: {', '.join(others)}")


def _text(device: ImportedDevice, register: ImportedRegister, entry: Mapping[str, Any]) -> None:
    if entry.get("raw_encode", "NONE") != "NONE" or entry.get("lambda"):
        register.gaps.append("raw_encode and lambda were not carried over: the characters are shown")
    size = _whole(entry.get("response_size", 2 * _whole(entry.get("register_count", 1))))
    register.details["length"] = (size + 1) // 2
    device.add(register, is_text=True)


def _number(device: ImportedDevice, register: ImportedRegister, kind: str, entry: Mapping[str, Any]) -> bool:
    """Give the register its number; False where it is lost."""
    given = str(entry.get("value_type", "U_WORD"))
    found = _FORMATS.get(given.removesuffix("_R"))
    if found is None:
        device.lose(register.name, f"its value type {given[:40]} has no number format")
        return False
    put_number(register.details, found, "CDAB" if given.endswith("_R") else "")
    if _whole(entry.get("offset", 0)) % 2:
        register.lacks = "its offset is half a register"
    mask = _whole(entry.get("bitmask", 0xFFFFFFFF))
    bits = [bit for bit in range(32) if mask >> bit & 1]
    if mask not in (0xFFFF, 0xFFFFFFFF) and "bitmask" in entry:
        if not bits or bits[-1] - bits[0] + 1 != len(bits):
            register.lacks = f"bits that are not side by side: {mask:#x}"
        else:
            register.details["part"] = f"{bits[0]}-{bits[-1]}"
    elif kind in ("binary_sensor", "switch"):
        register.gaps.append("it is true where its count is not 0")
    if isinstance(options := entry.get("optionsmap"), dict) and (named := names_of(options)):
        register.details["values"] = named
        register.details.pop("unit", None)
    return True


def _whole(given: Any) -> int:
    return int(given, 0) if isinstance(given, str) else int(given)
