"""Discovery messages: they describe a drive to Home Assistant (topic homeassistant/device/ID/config).

There is one message for each drive. Each component, such as a sensor or a button, has its own state topic,
because a state topic of the whole device would also apply to numbers and buttons.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from enum import Flag
from typing import Any

from multidrop import Drive, Register
from multidrop.drive import SIGNED, Access
from multidrop.gateway.live.hub import FAULT, RUNS, STANDS, STATES, digits_of

DISCOVERY = "homeassistant"
CLASSES = {  # device_class of a sensor in Home Assistant, by unit
    "Hz": "frequency",
    "A": "current",
    "V": "voltage",
    "kW": "power",
    "W": "power",
    **dict.fromkeys(("Wh", "kWh", "MWh", "J", "kJ", "MJ"), "energy"),
    "°C": "temperature",
    "h": "duration",
    "s": "duration",
}
# ids of the other components end with these words, so a register with such a name gets another id
OWN = ("problem", "running", "set", "value")
MOST = 1e12  # limit of `min` and `max` of a component of the kind "number"
LEAST_STEP = 0.001  # smallest step of a number that Home Assistant accepts
STALE_PERIODS = 3  # a sensor becomes unavailable if no value is published for this many publishing periods
# Template of the commands that Home Assistant sends. They contain the time of its clock, so that the gateway
# can refuse delayed commands.
COMMAND = '{{"value": {{{{ {} }}}}, "time": {{{{ (now().timestamp() * 1000) | int }}}}}}'


def discovery_topic(prefix: str, drive: str) -> str:
    return f"{DISCOVERY}/device/{object_id(prefix, drive)}/config"


def object_id(prefix: str, drive: str) -> str:
    """Return an id with only the characters that Home Assistant allows.

    Other characters are replaced by their code points. The first "-" ends the prefix, so that ids of
    different prefixes and drives differ.
    """
    return f"{_escaped(r'[^A-Za-z0-9]', prefix)}-{_escaped(r'[^A-Za-z0-9-]', drive)}"


def _escaped(signs: str, name: str) -> str:
    return re.sub(signs, lambda sign: f"_{ord(sign[0]):x}_", name)


def discovery(
    drive: Drive,
    polled: Iterable[Register[Any]],
    topics: Mapping[str, str],
    *,
    prefix: str,
    version: str,
    every_s: float,
    writable: Iterable[str],
    takes_commands: bool,
    page: str = "",
) -> bytes:
    """Return the discovery message of a drive: its state, a sensor for each polled register, and commands.

    `topics` has the drive's topics by purpose, and `page` is the address of the gateway's page.
    """
    name = object_id(prefix, drive.name)
    polled = list(polled)
    from_state = {"state_topic": topics["state"]}
    fresh = from_state | {"expire_after": max(2, round(STALE_PERIODS * every_s))}  # s
    parts: dict[str, Any] = {"state": _state(name) | fresh}
    parts |= {end: _binary(name, end, truth) | fresh for end, truth in BINARY.items()}
    for register in polled:
        parts[_unused(register.name, parts)] = _sensor(name, register) | fresh
    if takes_commands:
        for written in writable:
            part = _written(name, drive.register(written), topics["set"])
            if any(register.name == written for register in polled):
                part |= from_state | {"value_template": _value_template(drive.register(written))}
            parts[_unused(f"{written}_set", parts)] = part
        parts[_unused("stop", parts)] = {
            "p": "button",
            "unique_id": f"{name}-stop",
            "name": "Stop",
            "command_topic": topics["stop"],
            "payload_press": "stop",
            # the stop button is available even while the drive is silent
            "availability": [{"topic": topics["gateway"]}],
        }
    maker, space, _ = drive.title.partition(" ")
    device = {"ids": name, "name": drive.name, "mdl": drive.title or type(drive).__name__}
    device |= {"mf": maker} if space else {}
    device |= {"cu": page} if page else {}
    return json.dumps(
        {
            "dev": device,
            "o": {"name": "multidrop", "sw": version},
            "availability": [{"topic": topics["gateway"]}, {"topic": topics["available"]}],
            "availability_mode": "all",
            "cmps": parts,
        },
        ensure_ascii=False,
    ).encode()


# By name of a binary sensor: its value in each state of the drive. In other states the value is unknown.
BINARY = {"problem": {RUNS: "OFF", STANDS: "OFF", FAULT: "ON"}, "running": {RUNS: "ON", STANDS: "OFF"}}


def _unused(key: str, parts: Mapping[str, Any]) -> str:
    """Return `key`, with "_" appended if a component has this key, as when a register is named "running"."""
    return _unused(f"{key}_", parts) if key in parts else key


def _state(name: str) -> dict[str, Any]:
    return {
        "p": "sensor",
        "unique_id": f"{name}-state",
        "name": "State",
        "device_class": "enum",
        "options": list(STATES),
        "value_template": "{{ value_json.state }}",
    }


def _binary(name: str, end: str, truth: Mapping[str, str]) -> dict[str, Any]:
    return {
        "p": "binary_sensor",
        "unique_id": f"{name}-{end}",
        "name": end.capitalize(),
        "device_class": end,
        "value_template": f"{{{{ {json.dumps(truth)}.get(value_json.state, 'None') }}}}",
    }


def _sensor(name: str, register: Register[Any]) -> dict[str, Any]:
    found: dict[str, Any] = {
        "p": "sensor",
        "unique_id": f"{name}-{register.name}" + ("-value" if register.name in OWN else ""),
        "name": register.name.replace("_", " "),
        "value_template": _value_template(register),
    }
    if register.access is not Access.READING or register.values is not None:
        found["entity_category"] = "diagnostic"
    if options := _choices(register):
        found |= {"device_class": "enum", "options": list(options)}
    if register.values is None and register.unit and register.step is not None:
        found["unit_of_measurement"] = register.unit
        if register.unit in CLASSES:
            found["device_class"] = CLASSES[register.unit]
        is_energy = found.get("device_class") == "energy"
        found["state_class"] = _total(register) if is_energy else "measurement"
        if (digits := digits_of(register)) is not None:
            found["suggested_display_precision"] = digits
    return found


def _total(register: Register[Any]) -> str:
    """Return the state class of an energy. Home Assistant takes a fall of "total_increasing" for a reset.

    An energy with a sign may be a net energy, which falls. So may a float, and a channel.
    """
    may_fall = register.is_float or register.number_format in SIGNED
    return "total" if may_fall else "total_increasing"


def _written(name: str, register: Register[Any], topic: str) -> dict[str, Any]:
    """Return the Home Assistant component that writes a register: a list of names, or a number in a range."""
    found: dict[str, Any] = {
        "unique_id": f"{name}-{register.name}-set",
        "name": f"{register.name.replace('_', ' ')} (set)",
        "command_topic": f"{topic}/{register.name}",
        "retain": False,
    }
    if register.access is not Access.COMMAND:
        found["entity_category"] = "config"
    if options := _choices(register):
        raw = f"{json.dumps(options)}[value]"
        return found | {"p": "select", "options": list(options), "command_template": COMMAND.format(raw)}
    found |= {"p": "number", "mode": "box", "command_template": COMMAND.format("value")}
    found["min"], found["max"] = _span(register)
    found["step"] = LEAST_STEP if register.is_float else max(LEAST_STEP, abs(float(register.scale)))
    if register.value_unit:
        found["unit_of_measurement"] = register.value_unit
    return found


def _choices(register: Register[Any]) -> dict[str, int]:
    """Return the raw count of each named value of the register; empty for numbers and bits."""
    if register.values is None or issubclass(register.values, Flag):
        return {}
    return {member.name: member.value for member in register.values}


def _value_template(register: Register[Any]) -> str:
    """Return the template by which Home Assistant reads a polled register's value.

    If the register's values have names, the template returns "None" for any other value. Home Assistant then
    shows the state `unknown`.
    """
    value = f"value_json['values']['{register.name}']"
    if names := list(_choices(register)):
        return f"{{{{ {value} if {value} in {json.dumps(names)} else 'None' }}}}"
    return f"{{{{ {value} }}}}"


def _span(register: Register[Any]) -> tuple[float, float]:
    """Return the range of values that may be written to a register.

    Home Assistant assumes 1 to 100 for a number without a range.
    """
    if register.span is not None:
        return register.span
    coding = register.coding
    least, most = sorted(float(end * register.scale + coding.offset) for end in coding.raw_span)
    return max(least, -MOST), min(most, MOST)
