"""Plan the writes of a parameter set: which parameters, in which order, and why the others are left out."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from enum import Flag
from typing import Any, NamedTuple

from multidrop.control.rules import check_plain, raw_count
from multidrop.drive.family import Drive
from multidrop.drive.parameters import Parameter, parameters_of
from multidrop.drive.register import Register
from multidrop.drive.state import Condition
from multidrop.errors import Advice, Unsupported, WriteForbidden
from multidrop.params.values import ParameterSet, Progress, check_same_model, parameter_of, read, text_of

MOST_MISTAKES = 5  # limit of mistakes listed in one error


class ParameterChange(NamedTuple):
    """One parameter to write, with the raw counts before and after."""

    parameter: Parameter
    before: int
    after: int

    def __str__(self) -> str:
        one = self.parameter
        name = f" {one.name}" if one.is_declared else ""
        return f"{one.code}{name}: {one.text(self.before)} -> {one.text(self.after)}"


@dataclass(frozen=True)
class ApplyPlan:
    """The writes, in order, that set a drive's parameters to the wanted values.

    `left` gives, by code, the reason why a parameter is not written. `notes` are sentences to show to the
    user who confirms the plan.
    """

    drive: Drive
    source: str
    writes: tuple[ParameterChange, ...]
    left: Mapping[str, str]
    notes: tuple[str, ...] = ()

    def lines(self) -> list[str]:
        """Return the plan as text, one line for each parameter that differs."""
        left = [f"{code}: not written: {why}" for code, why in self.left.items()]
        return [*map(str, self.writes), *left, *self.notes]


def plan(
    drive: Drive,
    values: ParameterSet | Mapping[str, int],
    *,
    also: Collection[str] = (),
    progress: Progress | None = None,
) -> ApplyPlan:
    """Return the writes that `apply` would make. Reads from the drive, but writes nothing.

    `also` lists codes of communication parameters (address, baud rate) to write as well; by default these are
    left out. Raises WriteForbidden if the motor runs or the drive is of another family. Raises ValueError for
    another model's values, an unknown code, or a value out of range.
    """
    given = values if isinstance(values, ParameterSet) else ParameterSet("", values, source="values")
    family: Any = type(drive)
    check_same_model(ParameterSet(drive.model, {}, source=drive.name), given)
    parameters_of(family)  # called because it raises Unsupported for a family without parameter addresses
    space = family.parameter_space
    known = {code: parameter_of(family, code) for code in given.values if not space.is_monitor(code)}
    _check_also(family, also, given)
    check_stands(drive)
    bounds = _bounds(family, known)
    present = read(drive, {*known, *bounds.values()}, progress=progress)
    left: dict[str, str] = {}
    changes: list[ParameterChange] = []
    mistakes: list[str] = []
    for code, parameter in known.items():
        raw, held = given.values[code], present.values.get(code)
        if raw == held:
            continue
        if held is None:
            left[code] = "the drive does not have it"
        elif parameter.never and not (parameter.is_line and code in also):
            way = f"; add --also {code} to write it" if parameter.is_line else ""
            left[code] = f"{parameter.never}{way} ({parameter.text(held)} -> {text_of(family, code, raw)})"
        else:
            one = parameter.changed(never="") if parameter.is_line else parameter
            try:
                check_plain(drive, one, raw_count(drive, one, one.decode(raw)))
                changes.append(ParameterChange(one, held, raw))
            except TypeError as mistake:
                mistakes.append(f"{code}: {mistake}")
            except WriteForbidden as mistake:
                if not mistake.rule.startswith(one.name):  # the error is not about this parameter's value
                    raise
                mistakes.append(f"{code}: {mistake.rule}")
    if mistakes:
        more = len(mistakes) - MOST_MISTAKES
        shown = "; ".join(mistakes[:MOST_MISTAKES]) + (f"; and {more} more" if more > 0 else "")
        raise ValueError(f"nothing was written: {given.source} has values that may not be written: {shown}")
    ordered, blocked = _ordered(drive, changes, present.values, bounds)
    left |= {change.parameter.code: _blocked(drive, change) for change in blocked}
    notes = _notes(given, present)
    return ApplyPlan(drive, given.source, tuple(ordered), left, notes)


def _check_also(family: Any, also: Collection[str], given: ParameterSet) -> None:
    for code in also:
        if not parameter_of(family, code).is_line:
            raise ValueError(
                f"--also {code}: {code} is not the drive's address, baud rate, format or protocol; "
                "only those need --also"
            )
        if code not in given.values:
            raise ValueError(f"--also {code}: {given.source} has no {code}")


def _notes(given: ParameterSet, present: ParameterSet) -> tuple[str, ...]:
    if given.firmware and present.firmware and given.firmware != present.firmware:
        return (f"note: saved from firmware {given.firmware}, and the drive has {present.firmware}",)
    return ()


# ---- the motor ----


def check_stands(drive: Drive) -> bool:
    """Raise WriteForbidden unless the motor is at rest and only the serial line can start it.

    Return False if the only evidence is an output frequency of 0: the motor may run at a setpoint of 0 Hz.
    """
    try:
        state = drive.state()
    except Unsupported:
        raise _not_known(drive, "its family has no state") from None
    if state.condition is Condition.UNKNOWN:
        frequency = drive.registers.get("output_frequency")
        if frequency is None or not frequency.readable:
            raise _not_known(drive, f"its state is {state}")
        if drive.read(frequency) != 0:
            raise _runs(drive, "its output frequency is not 0")
    elif state.condition not in (Condition.STOPPED, Condition.FAULT):
        raise _runs(drive, f"its state is {state}")
    _check_no_run_command(drive)
    return state.condition is not Condition.UNKNOWN


def _check_no_run_command(drive: Drive) -> None:
    """Raise WriteForbidden if a run command is active at 0 Hz, or if the panel or a terminal may give one."""
    status = drive.registers.get("status")
    run = _member(status, "run")
    if status is not None and isinstance(run, Flag) and run in drive.read(status):
        raise _runs(drive, "its status shows a run command")
    source = drive.registers.get("run_source")
    line = _member(source, "line")
    if source is not None and line is not None and (held := drive.read(source)) != line:
        raise WriteForbidden(
            f"nothing is written to {drive.name}: its {source.name} ({source.place}) is "
            f"{source.format(held)}, so its panel or a terminal may start the motor while parameters change; "
            f"set it to {int(line)} (the line) on the panel first"
        )


def _member(register: Register[Any] | None, name: str) -> Any:
    """Return the named value of a register; None if it has none of this name. `name` is in lower case."""
    if register is None or register.values is None or not register.readable:
        return None
    members: Any = register.values
    return next((one for one in members if one.name.lower() == name), None)


def _runs(drive: Drive, why: str) -> WriteForbidden:
    return WriteForbidden(
        f"nothing is written to {drive.name}: {why}, and parameters are only written while its motor stands; "
        f"{_STOP.program} first",
        advice=_STOP,
    )


def _not_known(drive: Drive, why: str) -> WriteForbidden:
    return WriteForbidden(
        f"nothing is written to {drive.name}: it is not known whether its motor stands: {why}; set its "
        "parameters on its panel"
    )


_STOP = Advice.call("stop")


# ---- the order ----


def _bounds(family: Any, known: Mapping[str, Parameter]) -> dict[str, str]:
    """Return the codes of all parameters that limit one of the `known` parameters, by register name."""
    names = {name for one in known.values() for name in (one.at_least, one.at_most) if name}
    return {one.name: code for code, one in parameters_of(family).items() if one.name in names}


def _ordered(
    drive: Drive, changes: list[ParameterChange], present: Mapping[str, int], bounds: Mapping[str, str]
) -> tuple[list[ParameterChange], list[ParameterChange]]:
    """Sort the changes so that each value is within its limits when it is written.

    Return the sorted changes, and the changes whose values would never be within their limits. Communication
    parameters come last, because the drive may not answer after they are written.
    """
    held = dict(present)
    last = drive.parameter_space.line if drive.parameter_space else ()
    pending = [change for change in changes if not change.parameter.is_line]
    ordered: list[ParameterChange] = []
    while pending:
        ready = [change for change in pending if _is_within(drive, change, held, bounds)]
        if not ready:
            break
        first = ready[0]
        ordered.append(first)
        held[first.parameter.code] = first.after
        pending.remove(first)
    own = [change for change in changes if change.parameter.is_line]
    return [*ordered, *sorted(own, key=lambda change: last.index(change.parameter.code))], pending


def _is_within(
    drive: Drive, change: ParameterChange, held: Mapping[str, int], bounds: Mapping[str, str]
) -> bool:
    one = change.parameter
    value = one.decode(change.after)
    for name, sign in ((one.at_least, 1), (one.at_most, -1)):
        if not name:
            continue
        if name in drive.options:
            bound = drive.option.get(name)
        else:
            raw = held.get(bounds.get(name, ""))
            bound = None if raw is None else drive.register(name).decode(raw)
        if bound is not None and (value - bound) * sign < 0:
            return False
    return True


def _blocked(drive: Drive, change: ParameterChange) -> str:
    one = change.parameter
    limits = " and ".join(filter(None, (one.at_least, one.at_most)))
    return f"{one.text(change.after)} is outside its limits, which are {limits} of {drive.name}"
