"""Description of a plant for the page: lines, drives, registers and the caller's rights."""

from __future__ import annotations

from enum import Flag
from typing import TYPE_CHECKING, Any, cast

from multidrop import Drive, PlantLine, PolledDrive, Register
from multidrop.drive import verbs_of
from multidrop.gateway.http.rights import Right
from multidrop.gateway.live.hub import FREQUENCIES, Hub

if TYPE_CHECKING:
    from multidrop.gateway.gateway import Gateway

CURRENTS = ("output_current",)


def describe(gateway: Gateway, right: Right | None, language: str) -> dict[str, Any]:
    """Return the answer to GET /api/plant for a caller with this right, with titles in this language."""
    is_writer = right is Right.WRITE
    may, fleet = gateway.settings.may, gateway.feeds.get("fleet")
    return {
        "revision": gateway.revision,
        "version": gateway.version,
        "name": gateway.hub.plant.path.name,
        "demo": gateway.settings.is_demo,
        "file": gateway.reload.has_file,  # True: a reload is possible
        "history": "history" in {**gateway.feeds, **gateway.parts.pending},  # True: /api/history is available
        "fleet": fleet is not None,  # True: /api/fleet is available
        "fleet_stop": getattr(fleet, "can_stop", False),  # True: /api/fleet/stop is available
        # mistakes in the plant file that the latest reload found; empty if it succeeded
        "mistakes": gateway.reload.mistakes,
        "may": {
            "role": None if right is None else right.name.lower(),
            "write": sorted(may.write) if is_writer else [],
            "verbs": sorted(may.verbs) if is_writer else [],
        },
        "lines": [describe_line(gateway.hub, line, language) for line in gateway.hub.plant.lines],
    }


def describe_line(hub: Hub, line: PlantLine, language: str) -> dict[str, Any]:
    """Return a line's part of the description."""
    speeds = dict.fromkeys(str(polled.drive.settings) for polled in line.drives)
    return {
        "name": line.name,
        "port": line.port,
        "speed": ", ".join(speeds),
        "drives": [_drive(hub, polled, language) for polled in line.drives],
    }


def _drive(hub: Hub, polled: PolledDrive, language: str) -> dict[str, Any]:
    drive = polled.drive
    periods = {poll.register.name: poll.every or 0.0 for poll in polled.series}
    return {
        "name": drive.name,
        "family": drive.model or type(drive).__name__,
        "title": drive.title,
        "address": drive.address,
        "speed": str(drive.settings),
        "key": _key_registers(drive, periods),
        "registers": [
            _register(register, language)
            | {"period_s": periods.get(register.name), "holds_s": hub.holds_s(drive.name, register.name)}
            for register in (*drive.registers.values(), *(one.register for one in polled.channels))
        ],
        "verbs": verbs_of(drive),
    }


def _key_registers(drive: Drive, periods: dict[str, float]) -> dict[str, str | None]:
    """Return the names of the registers for frequency, electric current and setpoint.

    If several registers fit, a polled one is preferred. The name is None if the drive has no such register.
    """
    wanted = {"frequency": FREQUENCIES, "current": CURRENTS, "setpoint": (drive.setpoint_name,)}
    found: dict[str, str | None] = {}
    for name, registers in wanted.items():
        there = [one for one in registers if one in drive.registers]
        found[name] = next((one for one in there if one in periods), next(iter(there), None))
    return found


def digits_of(register: Register[Any]) -> int | None:
    """Return the number of digits after the decimal point; None if it varies, as for a float."""
    return None if register.is_float or register.scale_register else register.decimals


def _register(register: Register[Any], language: str) -> dict[str, Any]:
    values = register.values
    least, most = _span(register)
    kind = "number" if values is None else "bits" if issubclass(values, Flag) else "words"
    members: list[Any] = [] if values is None else list(cast(Any, values))
    words = {str(int(member)): register.in_words(member) for member in members}
    return {
        "name": register.name,
        "title": register.title_in(language),
        "unit": register.value_unit,
        "digits": digits_of(register),
        "kind": kind,
        "words": words,
        "access": register.access.value,
        "place": register.place,
        "note": register.note,
        "least": least,
        "most": most,
        "at_least": register.at_least,  # name of the register that holds the least allowed value
        "at_most": register.at_most,
        "step": None if register.is_float else register.step,
    }


def _span(register: Register[Any]) -> tuple[float | None, float | None]:
    """Return the least and largest writable value: the manual's range, or else that of the number format.

    Both are None for a float without a range, for named values, and if the register cannot be written.
    """
    if register.span is not None:
        return register.span
    if register.values is not None or register.is_float or not register.writable:
        return None, None
    ends = (register.coding.value_of(float(raw)) for raw in register.coding.raw_span)
    least, most = sorted(ends)
    return least, most
