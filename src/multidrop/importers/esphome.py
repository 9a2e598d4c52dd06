"""Import ESPHome's `modbus_controller` entities from the YAML file of a node, or from one of its packages.

The key tables follow ESPHome's documentation and its components' schemas.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from fractions import Fraction
from typing import Any

from multidrop.importers.device import (
    UNKNOWN_LINE,
    ImportedDevice,
    ImportedRegister,
    LineSettings,
    key_table,
    serial_settings,
    unimported_keys,
    unit_address,
)
from multidrop.importers.parsing import YamlTag, bits_text, number, put_number, scaled, whole, words_of

PLATFORM = "modbus_controller"
_TABLES = {"coil": "coil", "discrete_input": "discrete", "holding": "holding", "read": "input"}
_DEFAULT_TABLES = {"output": "holding", "number": "holding", "select": "holding"}
_FORMATS = {
    **{"U_WORD": "U16", "U_DWORD": "U32", "U_QWORD": "U64", "S_WORD": "I16", "S_DWORD": "I32"},
    **{"S_QWORD": "I64", "FP32": "F32"},
}
_ITEM = "platform modbus_controller_id id name address register_type offset byte_offset bitmask lambda"
_SHOWN = (
    "internal disabled_by_default icon entity_category device_class web_server web_server_id "
    "web_server_sorting_weight mqtt_id setup_priority update_interval device_id force_new_range "
    "response_size on_value on_state qos retain discovery availability state_topic command_topic"
)
_TIMES = "skip_updates custom_command"  # entries with custom_command, which sends raw bytes, are not imported
_WRITES = "write_lambda"
KEYS = {  # how to treat each key, by kind of entity, such as sensor
    "sensor": key_table(
        imported=f"{_ITEM} value_type unit_of_measurement filters",
        irrelevant=f"{_SHOWN} register_count accuracy_decimals state_class force_update expire_after "
        "on_raw_value on_value_range last_reset_type",
        gap=_TIMES,
    ),
    "binary_sensor": key_table(
        imported=f"{_ITEM} filters",
        irrelevant=f"{_SHOWN} register_count publish_initial_state trigger_on_initial_state on_press "
        "on_release on_click on_double_click on_multi_click on_state_change",
        gap=f"{_TIMES} inverted",
    ),
    "text_sensor": key_table(
        imported=f"{_ITEM} register_count response_size raw_encode filters",
        irrelevant=f"{_SHOWN} on_raw_value",
        gap=_TIMES,
    ),
    "switch": key_table(
        imported=f"{_ITEM} use_write_multiple",
        irrelevant=f"{_SHOWN} register_count restore_mode assumed_state on_turn_on on_turn_off",
        gap=f"{_TIMES} {_WRITES} inverted",
    ),
    "number": key_table(
        imported=f"{_ITEM} value_type unit_of_measurement multiply use_write_multiple",
        irrelevant=f"{_SHOWN} register_count min_value max_value step mode on_value_range",
        gap=f"{_TIMES} {_WRITES}",
    ),
    "select": key_table(
        imported=f"{_ITEM} value_type optionsmap use_write_multiple",
        irrelevant=f"{_SHOWN} register_count optimistic",
        gap=f"{_TIMES} {_WRITES}",
    ),
    "output": key_table(
        imported=f"{_ITEM} value_type use_write_multiple",
        irrelevant=f"{_SHOWN} power_supply min_power max_power zero_means_zero",
        gap=f"{_TIMES} {_WRITES} multiply inverted",
    ),
}
CONTROLLER_KEYS = key_table(
    imported="id address modbus_id",
    irrelevant="update_interval setup_priority allow_duplicate_commands max_cmd_retries on_command_sent "
    "on_online on_offline offline_skip_updates",
    gap="command_throttle server_registers server_courtesy_response",
)
_WRITTEN = ("switch", "number", "select", "output")


def is_esphome(document: Any) -> bool:
    """Return True if the document has a `modbus_controller`, or an entity with this platform."""
    return any(PLATFORM in part or any(_entries(part)) for part in _parts(document))


def read_esphome(document: Any) -> list[ImportedDevice]:
    """Return a device for each address on each bus. Raises ValueError if the document has no entity."""
    parts = [_substituted(part, _substitutions(document), 0) for part in _parts(document)]
    nodes = [part["esphome"] for part in parts if isinstance(part.get("esphome"), dict)]
    devices = _Devices(str(nodes[0].get("name") or "") if nodes else "", parts)
    for part in parts:
        for kind, entry in _entries(part):
            devices.add(kind, entry)
    if not (found := devices.found):
        raise ValueError(f"the file has no entity with `platform: {PLATFORM}` in {', '.join(KEYS)}")
    return found


def _parts(document: Any) -> Iterator[dict[str, Any]]:
    """Yield the document and its packages. For a list of entities, yield each entity by itself."""
    if isinstance(document, list):
        entities = [each for each in document if isinstance(each, dict) and each.get("platform") == PLATFORM]
        yield from ({_kind_of(entity): entity} for entity in entities)
    elif isinstance(document, dict):
        yield document
        packages = document.get("packages")
        for package in packages.values() if isinstance(packages, dict) else packages or ():
            if isinstance(package, dict):
                yield package


def _kind_of(entity: Mapping[str, Any]) -> str:
    """Return the kind of an entity that does not state it: the first kind that has all of its keys."""
    return next((kind for kind, table in KEYS.items() if entity.keys() <= table.keys()), "sensor")


def _substitutions(document: Any) -> dict[str, str]:
    found: dict[str, str] = {}
    for part in _parts(document):
        given = part.get("substitutions")
        for key, value in given.items() if isinstance(given, dict) else ():
            if isinstance(value, (str, int, float)):
                found.setdefault(str(key), str(value)[:200])
    return found


def _substituted(value: Any, known: Mapping[str, str], depth: int) -> Any:
    """Replace $name and ${name} in the value by the text in `known`, if it has this name."""
    if isinstance(value, str) and "$" in value and not isinstance(value, YamlTag):
        return re.sub(r"\$(?:\{(\w+)\}|(\w+))", lambda name: known.get(name[1] or name[2], name[0]), value)
    if depth < 5 and known:
        if isinstance(value, dict):
            return {key: _substituted(each, known, depth + 1) for key, each in value.items()}
        if isinstance(value, list):
            return [_substituted(each, known, depth + 1) for each in value]
    return value


def _listed(given: Any) -> list[Any]:
    return given if isinstance(given, list) else [] if given is None else [given]


def _entries(part: Mapping[str, Any]) -> Iterator[tuple[str, Mapping[str, Any]]]:
    for kind in KEYS:
        for entry in _listed(part.get(kind)):
            if isinstance(entry, dict) and entry.get("platform") == PLATFORM:
                yield kind, entry


class _Devices:
    """The devices of an ESPHome node. Controllers with the same address on the same bus are one device."""

    def __init__(self, title: str, parts: list[dict[str, Any]]) -> None:
        self._title = title
        self._parts = parts
        self._by_place: dict[Any, ImportedDevice] = {}
        self._by_controller: dict[str, ImportedDevice] = {}
        for part in parts:
            for controller in _listed(part.get(PLATFORM)):
                if isinstance(controller, dict):
                    self._add_controller(controller)

    def _add_controller(self, controller: Mapping[str, Any]) -> None:
        given, name = controller.get("address", 1), str(controller.get("id"))
        is_elsewhere = isinstance(given, YamlTag) or "$" in str(given)
        address = None if is_elsewhere else unit_address(given, f"{PLATFORM}: address")
        bus = str(controller.get("modbus_id"))
        place = (bus, name if address is None else address)
        line = _line(self._parts, bus)
        device = self._by_place.setdefault(place, ImportedDevice(self._title, address, line=line))
        label = PLATFORM if name == "None" else f"the controller {name}"
        device.lose_keys(label, controller, CONTROLLER_KEYS)
        self._by_controller[name] = device

    @property
    def found(self) -> list[ImportedDevice]:
        return [
            device
            for device in {id(each): each for each in self._by_controller.values()}.values()
            if device.registers or device.texts or device.commands or any(one.is_entry for one in device.lost)
        ]

    def add(self, kind: str, entry: Mapping[str, Any]) -> None:
        name = str(entry.get("name") or entry.get("id") or "register")
        device = self._device_of(entry.get("modbus_controller_id"))
        with device.entry(name):
            if len(self._by_place) > 1 and "modbus_controller_id" not in entry:
                raise ValueError("modbus_controller_id is missing, and there are several controllers")
            _add(device, kind, name, entry)

    def _device_of(self, given: Any) -> ImportedDevice:
        """Return the device of this controller.

        Its address is unknown if another file declares the controller.
        """
        if given is None and self._by_controller:
            return next(iter(self._by_controller.values()))
        return self._by_controller.setdefault(
            str(given), ImportedDevice(self._title or (str(given) if given else ""))
        )


def _line(parts: list[dict[str, Any]], bus: str) -> LineSettings:
    """Return the settings of the UART that the bus names, or of the only UART."""
    uarts = [each for part in parts for each in _listed(part.get("uart")) if isinstance(each, dict)]
    buses = [each for part in parts for each in _listed(part.get("modbus")) if isinstance(each, dict)]
    named = [each.get("uart_id") for each in buses if len(buses) == 1 or str(each.get("id")) == bus]
    chosen = [uart for uart in uarts if len(uarts) == 1 or (named and uart.get("id") == named[0])]
    if len(chosen) != 1:
        return UNKNOWN_LINE
    return serial_settings(chosen[0])


# ---- entities ----


def _add(device: ImportedDevice, kind: str, name: str, entry: Mapping[str, Any]) -> None:
    if "custom_command" in entry:
        device.lose(name, "it is read by a custom_command, which is no read of registers")
        return
    given = str(entry.get("register_type", _DEFAULT_TABLES.get(kind)))
    if given not in _TABLES:
        device.lose(name, f"its register_type {given[:40]} is not known")
        return
    table = _TABLES[given]
    is_words = table in ("holding", "input")
    offset = whole(entry, "byte_offset" if "byte_offset" in entry else "offset", 0)
    address = whole(entry, "address") + offset // (2 if is_words else 1)
    register = ImportedRegister(name, address, table, is_read=kind != "output")
    register.note_write(is_written=kind in _WRITTEN)
    if entry.get("use_write_multiple"):
        register.of_writes["write"] = "multiple"
    register.gaps += unimported_keys(entry, KEYS[kind])
    if kind == "text_sensor":
        _text(device, register, entry, offset)
        return
    if (unit := entry.get("unit_of_measurement")) and (isinstance(unit, YamlTag) or "${" in str(unit)):
        register.gaps.append(f"its unit is {unit}")
    elif unit:
        register.details["unit"] = str(unit)
    if is_words and not _number(device, register, kind, entry):
        return
    if is_words and offset % 2:
        register.lacks = "its offset is half a register"
    if "lambda" in entry:
        register.lacks = "its lambda is a program"
    if entry.get("filters") is not None:
        _filters(register, entry["filters"])
    device.add(register)


def _filters(register: ImportedRegister, filters: Any) -> None:
    """Combine the filters "multiply" and "offset", in their order, into a step and an offset.

    Other filters are added to the register's `gaps`.
    """
    step, offset = Fraction(1), Fraction(0)
    others: list[str] = []
    for each in _listed(filters):
        pairs = list(each.items()) if isinstance(each, dict) and each else [(each, None)]
        key, given = pairs[0]
        if key in ("multiply", "offset") and not others and register.table in ("holding", "input"):
            try:
                amount = Fraction(str(number(_required(given), 0)))
            except ValueError:
                others.append(str(key))
                continue
            step, offset = (step * amount, offset * amount) if key == "multiply" else (step, offset + amount)
        else:
            others.append(str(key)[:40])
    scaled(register.details, float(step), float(offset))
    if others:
        listed = ", ".join(sorted(set(others)))
        register.gaps.append(f"not all of its filters were carried over: {listed}")


def _required(given: Any) -> Any:
    if given is None:
        raise ValueError("it is empty")
    return given


def _text(device: ImportedDevice, register: ImportedRegister, entry: Mapping[str, Any], offset: int) -> None:
    if offset % 2:
        device.lose(register.name, "a text whose offset is half a register")
        return
    if str(entry.get("raw_encode", "ANSI")) not in ("NONE", "ANSI"):
        register.gaps.append("raw_encode was not carried over: the characters are shown")
    register.gaps += [f"{key} was not carried over" for key in ("lambda", "filters") if key in entry]
    registers = whole(entry, "register_count", 0)
    if "response_size" not in entry:
        register.gaps.append(f"its response_size is not stated; {2 * registers or 2} bytes were assumed")
    size = whole(entry, "response_size", 2 * registers or 2)
    register.details["length"] = (min(size, 2 * registers or size) + 1) // 2
    device.add(register, is_text=True)


def _number(device: ImportedDevice, register: ImportedRegister, kind: str, entry: Mapping[str, Any]) -> bool:
    """Set the register's number format; return False if the register cannot be imported."""
    # flags are read from one 16-bit word, even if other keys state another width
    is_flag = kind in ("binary_sensor", "switch")
    given = "U_WORD" if is_flag else str(entry.get("value_type", "U_WORD"))
    found = _FORMATS.get(given.removesuffix("_R"))
    if found is None:
        device.lose(register.name, f"its value_type {given[:40]} has no number format")
        return False
    registers = whole(entry, "register_count", 0)
    if 0 < registers < words_of(found):
        register.gaps.append(f"{given} needs more than register_count = {registers}: is a register wider?")
    every = (1 << 16 * words_of(found)) - 1
    mask = whole(entry, "bitmask", every) & every
    if words_of(found) < 4 and mask != every:  # ESPHome ignores the bit mask of 64-bit numbers
        found = found.replace("I", "U")  # in ESPHome a masked number is unsigned
        _part(register, found, mask)
    elif is_flag:
        register.gaps.append("it is true where its count is not 0")
    put_number(register.details, found, "CDAB" if given.endswith("_R") else "")
    if is_flag and mask.bit_count() > 1 and mask != every:
        register.gaps.append("it is true where one of its bits is")
    if entry.get("multiply") is not None:
        factor = Fraction(str(number(entry["multiply"], 1, "multiply"))) or Fraction(1)
        scaled(register.details, float(1 / factor))  # ESPHome divides the raw count by `multiply`
    if (options := entry.get("optionsmap")) is not None:
        if isinstance(options, dict):
            register.put_names("values", options)
        else:
            register.gaps.append("optionsmap was not carried over")
    return True


def _part(register: ImportedRegister, found: str, mask: int) -> None:
    bits = [bit for bit in range(32) if mask >> bit & 1]
    if found == "F32":
        register.lacks = f"its bitmask {mask:#x} is of a float"
    elif not bits or bits[-1] - bits[0] + 1 != len(bits):
        register.lacks = f"bits that are not side by side: {mask:#x}"
    else:
        register.details["part"] = bits_text(bits[0], bits[-1])
