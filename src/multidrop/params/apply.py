"""Plan the writes of parameters, and make them one by one with a journal that survives a killed process."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field
from enum import Flag
from hashlib import sha256
from typing import Any, NamedTuple

from multidrop.control.call import Call
from multidrop.control.eeprom_ledger import Ledger
from multidrop.control.outcome import Effect, Outcome
from multidrop.control.records import commissioning as commissioning_block
from multidrop.control.rules import check_plain, raw_count
from multidrop.drive.family import Drive
from multidrop.drive.parameters import Parameter, parameters_of
from multidrop.drive.register import Register
from multidrop.drive.verbs import Condition
from multidrop.errors import Advice, BusError, CancelledByStop, Unsupported, WriteForbidden
from multidrop.params.values import ParameterSet, Progress, check_same_model, parameter_of, read, text_of
from multidrop.printable import format_time
from multidrop.transport import clock

# ---- the plan ----


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
    """Return the writes that `apply` would make. Reads from the drive, but does not write.

    `also` lists codes of communication parameters (address, baud rate) to write as well; by default these are
    left out. Raises WriteForbidden if the motor runs or the drive is of another family. Raises ValueError for
    another model's values, an unknown code, or a value out of range.
    """
    given = values if isinstance(values, ParameterSet) else ParameterSet("", values, source="values")
    family: Any = type(drive)
    check_same_model(ParameterSet(drive.model, {}, source=drive.name), given)
    # This call raises Unsupported for a family without parameter addresses.
    parameters_of(family)
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
                "only these parameters need --also"
            )
        if code not in given.values:
            raise ValueError(f"--also {code}: {given.source} has no parameter {code}")


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
            f"{source.format(held)}, so the panel or a terminal may start the motor. First set "
            f"{source.name} to {int(line)} (the line) on the panel"
        )


def _member(register: Register[Any] | None, name: str) -> Any:
    """Return the named value of a register; None if it has none of this name. `name` is in lower case."""
    if register is None or register.values is None or not register.readable:
        return None
    members: Any = register.values
    return next((one for one in members if one.name.lower() == name), None)


def _runs(drive: Drive, why: str) -> WriteForbidden:
    return WriteForbidden(
        f"nothing is written to {drive.name}: {why}, and parameters are written only while the motor stands; "
        f"{_STOP.program} first",
        advice=_STOP,
    )


def _not_known(drive: Drive, why: str) -> WriteForbidden:
    return WriteForbidden(
        f"nothing is written to {drive.name}: it is not known whether the motor stands, because {why}. Set "
        "the parameters on the drive's panel"
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


# ---- the writes ----


NotWritten = BusError | OSError | Outcome  # why a parameter was not written; str() gives a sentence
# Called after each write with its number from 1, the number of all writes, the change, and the reason of a
# failure (None if the write succeeded).
Report = Callable[[int, int, ParameterChange, NotWritten | None], None]


@dataclass
class Applied:
    """The result of applying parameters: the writes that were made, and the parameters that were refused.

    `earlier` has a sentence for each write of a previous, interrupted call. `failure` is the error that
    ended this call early, or None; call `apply` again to continue. An OSError comes from the journal or the
    EEPROM ledger, for example on a full disk.
    """

    plan: ApplyPlan
    written: list[ParameterChange] = field(default_factory=list)
    refused: dict[str, NotWritten] = field(default_factory=dict)  # parameter code: why it was not written
    earlier: list[str] = field(default_factory=list)
    failure: BusError | OSError | None = None

    @property
    def ok(self) -> bool:
        """True if the drive now holds every value of the plan's writes."""
        return not self.refused and self.failure is None


def apply(
    drive: Drive,
    values: ParameterSet | Mapping[str, int],
    *,
    also: Collection[str] = (),
    commissioning: bool = False,
    report: Report | None = None,
) -> Applied:
    """Write to a stopped drive all parameters that differ; return the result.

    Each parameter is written once, counted in the EEPROM ledger and read back. The drive's state is read
    before each write; if the motor turns, nothing more is written. A stop of the drive cancels the remaining
    writes too. If the process is killed, a second call writes the remaining parameters and reports the first
    call's writes. With `commissioning`, a register may be written again within a minute. Raises the errors
    that `plan` raises.
    """
    stops = drive.stops_called[0]
    return _apply(plan(drive, values, also=also), stops, commissioning=commissioning, report=report)


def apply_plan(made: ApplyPlan, *, commissioning: bool = False, report: Report | None = None) -> Applied:
    """Write the parameters of a plan as `apply` does; return the result.

    If the only evidence of standstill is an output frequency of 0, a stop is sent first.
    """
    return _apply(made, made.drive.stops_called[0], commissioning=commissioning, report=report)


def _apply(made: ApplyPlan, stops: int, *, commissioning: bool, report: Report | None) -> Applied:
    """Write a plan's parameters. `stops` is the number of stops so far: a further stop ends the writes."""
    drive = made.drive
    journal = _Journal(drive)
    result = Applied(made, earlier=journal.earlier())
    call = drive.begin_call("application of parameters", stops)
    if made.writes:
        # At 0 Hz the motor may still have a run command, so it is stopped first.
        if not check_stands(drive):
            call.check("the first parameter")
            drive.stop()
            call = drive.begin_call("application of parameters", stops + 1)
        try:
            journal.begin(made)
        except OSError as failure:
            result.failure = failure
            return result
    with commissioning_block() if commissioning else nullcontext():
        for number, change in enumerate(made.writes, 1):
            not_written = _write(change, call, result, journal)
            if report:
                report(number, len(made.writes), change, not_written)
            if result.failure:
                return result
    try:
        journal.end()
    except OSError as failure:
        result.failure = failure
    return result


def _write(change: ParameterChange, call: Call, result: Applied, journal: _Journal) -> NotWritten | None:
    """Write one parameter, and record the outcome in `result`. Return why it was not written, or None."""
    drive, parameter = call.drive, change.parameter
    try:
        check_stands(drive)
        call.check(parameter.code)
        journal.note(code=parameter.code, before=change.before, after=change.after)
        call.check(parameter.code)  # checked again after a possible delay by a slow disk
        outcome: Outcome = drive.try_write(parameter, parameter.decode(change.after))
    except (BusError, OSError) as failure:
        if isinstance(failure, WriteForbidden) and failure.is_budget:
            return _refused(change, failure, result, journal)
        if isinstance(failure, CancelledByStop):
            _note_outcome(change, "not written", result, journal)
        result.failure = failure
        return failure
    if outcome.effect is Effect.DONE:
        result.written.append(change)
        _note_outcome(change, "written", result, journal)
        return None
    if outcome.effect is Effect.UNCONFIRMED:
        result.failure = outcome.failure
        return outcome.failure
    return _refused(change, outcome.failure or outcome, result, journal)


def _refused(change: ParameterChange, why: NotWritten, result: Applied, journal: _Journal) -> NotWritten:
    result.refused[change.parameter.code] = why
    _note_outcome(change, "not written", result, journal)
    return why


def _note_outcome(change: ParameterChange, outcome: str, result: Applied, journal: _Journal) -> None:
    try:
        journal.note(code=change.parameter.code, outcome=outcome)
    except OSError as failure:
        result.failure = failure


class _Journal:
    """A file that lists the writes of a call of `apply`, and that is removed at the end of the call.

    So a file that exists at the start lists the writes of an interrupted call.
    """

    def __init__(self, drive: Drive) -> None:
        identity = drive.bus.line.identity
        name = sha256(f"{identity}\n{drive.address}".encode(errors="replace")).hexdigest()[:16]
        self._path = Ledger().at(identity).path.parent / "applications" / f"{name}.jsonl"

    def earlier(self) -> list[str]:
        """Return a sentence about an interrupted call of `apply`, and a sentence for each of its writes.

        Return [] if no call was interrupted.
        """
        try:
            lines = self._path.read_text("utf-8", errors="replace").splitlines()
        except FileNotFoundError:
            return []
        outcomes: dict[str, str] = {}
        for record in _records(lines):
            if "began" in record:
                found = f"{record.get('source')}, started {str(record['began'])[:19]}Z"
                outcomes.setdefault("", f"an application of {found}, was interrupted")
            elif "after" in record:
                write = f"{record.get('code')}: {record.get('before')} -> {record['after']}"
                outcomes[str(record.get("code"))] = f"{write}: may have been sent"
            elif str(record.get("code")) in outcomes:
                code = str(record.get("code"))
                outcomes[code] = f"{outcomes[code].rpartition(': ')[0]}: {record.get('outcome')}"
        return [*outcomes.values()]

    def begin(self, made: ApplyPlan) -> None:
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self.note(began=format_time(clock.utc_ns()), source=made.source, drive=made.drive.name)

    def note(self, **record: Any) -> None:
        """Append a record with one system call, so that a killed process leaves only whole records.

        A line feed before the record separates it from an earlier record that a full disk has cut short.
        Raises OSError if the record cannot be written.
        """
        data = b"\n" + json.dumps(record).encode()
        with self._path.open("ab", buffering=0) as file:
            if file.write(data) != len(data):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self._path))
            os.fsync(file.fileno())  # the record must survive a power failure

    def end(self) -> None:
        self._path.unlink(missing_ok=True)


def _records(lines: Iterable[str]) -> Iterable[dict[str, Any]]:
    for line in lines:
        try:
            record = json.loads(line)
        except ValueError:
            continue
        if isinstance(record, dict):
            yield record
