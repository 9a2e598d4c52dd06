"""Home Assistant: what a drive is, told by its discovery messages (homeassistant/device/ID/config). Pure."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from typing import Any

from multidrop import Drive, Register
from multidrop.gateway.describe import digits_of

DISCOVERY = "homeassistant"
CLASSES = {  # device_class of a unit
    "Hz": "frequency",
    "A": "current",
    "V": "voltage",
    "kW": "power",
    "W": "power",
    "kWh": "energy",
    "°C": "temperature",
    "h": "duration",
    "s": "duration",
}
LEAST_STEP = 0.001  # that Home Assistant takes
STALE_PERIODS = 3  # after which a sensor is unavailable
# Home Assistant's own clock dates a command: one that a broker held up is refused.
COMMAND = '{"value": {{ value }}, "time": {{ (now().timestamp() * 1000) | int }}}'


def discovery_topic(prefix: str, drive: str) -> str:
    """Return the topic of a drive's configuration."""
    return f"{DISCOVERY}/device/{object_id(prefix, drive)}/config"


def object_id(*names: str) -> str:
    """Return an id of the signs that Home Assistant takes; others are told by their code points."""
    return re.sub(r"[^A-Za-z0-9-]", lambda sign: f"_{ord(sign[0]):x}_", "-".join(names))


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
) -> bytes:
    """Return the configuration of one drive: a sensor for each polled register, its state, and commands."""
    name = object_id(prefix, drive.name)
    parts: dict[str, Any] = {"state": _state(name, every_s)}
    for register in polled:
        parts[register.name] = _sensor(name, register, every_s)
    if takes_commands:
        for written in writable:
            parts[f"{written}_set"] = _number(name, drive.register(written), topics["set"])
        parts["stop"] = {
            "p": "button",
            "unique_id": f"{name}-stop",
            "name": "Stop",
            "command_topic": topics["stop"],
            "payload_press": "stop",
        }
    return json.dumps(
        {
            "dev": {
                "ids": name,
                "name": drive.name,
                "mdl": drive.title or type(drive).__name__,
            },
            "o": {"name": "multidrop", "sw": version},
            "state_topic": topics["state"],
            "availability": [{"topic": topics["gateway"]}, {"topic": topics["available"]}],
            "availability_mode": "all",
            "cmps": parts,
        },
        ensure_ascii=False,
    ).encode()


def _expiry(every_s: float) -> int:
    """Return the seconds after which a sensor that nothing more came for is unavailable."""
    return max(2, round(STALE_PERIODS * every_s))


def _state(name: str, every_s: float) -> dict[str, Any]:
    return {
        "p": "sensor",
        "unique_id": f"{name}-state",
        "name": "State",
        "value_template": "{{ value_json.state }}",
        "expire_after": _expiry(every_s),
    }


def _sensor(name: str, register: Register[Any], every_s: float) -> dict[str, Any]:
    found: dict[str, Any] = {
        "p": "sensor",
        "unique_id": f"{name}-{register.name}",
        "name": register.name.replace("_", " "),
        "value_template": f"{{{{ value_json['values']['{register.name}'] }}}}",
        "expire_after": _expiry(every_s),
    }
    if register.values is None and register.unit and register.step is not None:
        found["unit_of_measurement"] = register.unit
        if register.unit in CLASSES:
            found["device_class"] = CLASSES[register.unit]
        found["state_class"] = "total_increasing" if register.unit == "kWh" else "measurement"
        if (digits := digits_of(register)) is not None:
            found["suggested_display_precision"] = digits
    return found


def _number(name: str, register: Register[Any], topic: str) -> dict[str, Any]:
    found: dict[str, Any] = {
        "p": "number",
        "unique_id": f"{name}-{register.name}-set",
        "name": f"{register.name.replace('_', ' ')} (set)",
        "command_topic": f"{topic}/{register.name}",
        "command_template": COMMAND,
        "retain": False,
        "step": LEAST_STEP if register.is_float else max(LEAST_STEP, abs(float(register.scale))),
    }
    if register.value_unit:
        found["unit_of_measurement"] = register.value_unit
    if register.span is not None:
        found["min"], found["max"] = register.span
    return found
