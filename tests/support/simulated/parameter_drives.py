"""Simulated drives with parameters that their class does not declare, and their factory reset."""

from __future__ import annotations

from collections.abc import Iterable
from random import Random

from multidrop.drive import Drive
from multidrop.drive.parameters import Parameter, parameters_of
from multidrop.sim import MotorDrive, simulated


def with_parameters(drive: Drive, codes: Iterable[str] = ()) -> MotorDrive:
    """Return the drive's simulation, to which parameters with these codes of its family are added."""
    sim = simulated(drive)
    assert isinstance(sim, MotorDrive)
    for code in codes:
        sim.memory.declare(parameters_of(type(drive))[code])
    return sim


def writable(drive: Drive, codes: Iterable[str]) -> list[Parameter]:
    return [one for code, one in parameters_of(type(drive)).items() if _is_there(code, one, codes)]


def _is_there(code: str, one: Parameter, codes: Iterable[str]) -> bool:
    return not one.never and (one.is_declared or code in codes)


def raw_of(sim: MotorDrive, one: Parameter) -> int:
    return sim.memory.of(one)[0].raw


def factory_reset(sim: MotorDrive, parameters: Iterable[Parameter]) -> None:
    """Set parameters to their factory values; if none is printed, to 0 or their least value."""
    for one in parameters:
        low = one.span[0] if one.span else 0
        sim.memory.set(one, one.default if one.default is not None else low)
    sim.set_up()


def set_at_random(sim: MotorDrive, parameters: list[Parameter], random: Random) -> None:
    """Set parameters to random values within their limits."""
    for one in parameters:
        if one.values is None and not (one.at_least or one.at_most):
            low, high = one.coding.raw_span if one.span is None else map(one.coding.count_of, one.span)
            sim.memory.set_raw(one, random.randint(int(low), min(int(high), 0xFFFF)))
    sim.set_up()


def obey_the_line(sim: MotorDrive) -> None:
    """Let the line command the motor, if the drive's run source is a register."""
    source = sim.drive.registers.get("run_source")
    if source is not None and source.values is not None:
        sim["run_source"] = next(one for one in source.values if one.name.lower() == "line")
