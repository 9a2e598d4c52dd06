"""Drive works: what commands do to a drive on their threads. None raises: what became of it is told."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from typing import Any

from multidrop import Bus, BusError, Drive, Register
from multidrop.control import Effect
from multidrop.gateway.command_results import Told, failed, in_words


def stop_one(drive: Drive, seconds: float | None) -> dict[str, Told]:
    """Stop a drive; return what became of it, whatever that is."""
    try:
        drive.stop(seconds=seconds)
    except Exception as failure:  # whatever it is: everybody must see it
        return {drive.name: failed(failure)}
    return {drive.name: Told(True, "stopped: seen to stand")}


def stop_by(verb: str, drive: Drive, seconds: float | None) -> dict[str, Told]:
    """Stop a drive by another verb than `stop`, such as `coast`; they have no options."""
    return {drive.name: act_one(drive, verb, {"seconds": seconds})}


def write_one(drive: Drive, register: str, value: float) -> Told:
    bus: Bus | None = drive.bus
    if bus is None:
        return failed(ValueError(f"{drive.name} is on no line any more"))
    try:
        known = drive.register(register)
        outcome = bus.try_write(drive, known, _typed(known, value))
    except Exception as failure:  # whatever it is: its caller must see it
        return failed(failure)
    if outcome.effect is Effect.DONE:
        return Told(True, str(outcome))
    text = str(outcome)
    if outcome.failure is not None:
        text = text.replace(str(outcome.failure), in_words(outcome.failure))
    return Told(False, text, outcome.failure or BusError(text))


def _typed(register: Register[Any], value: float) -> Any:
    """Return a number as the register takes it: a choice by its raw count, which is never rounded."""
    if register.values is None:
        return value
    if isinstance(value, float) and (not isfinite(value) or value != int(value)):
        raise ValueError(f"{register.name} takes the number of a choice, not {value!r}")
    return register.decode(value)


def act_one(drive: Drive, verb: str, arguments: Mapping[str, Any]) -> Told:
    try:
        getattr(drive, verb)(**arguments)
    except Exception as failure:  # whatever it is: its caller must see it
        return failed(failure)
    return Told(True, f"{drive.name}: {verb} is done")
