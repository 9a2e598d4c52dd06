"""Write a plan's parameters, one by one, with a journal that survives a killed process."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field
from hashlib import sha256
from typing import Any

from multidrop.control.call import Call
from multidrop.control.eeprom_ledger import Ledger
from multidrop.control.outcome import Effect, Outcome
from multidrop.control.records import commissioning as commissioning_block
from multidrop.drive.family import Drive
from multidrop.errors import BusError, CancelledByStop, WriteForbidden
from multidrop.iso_time import format_time
from multidrop.params.plan import ApplyPlan, ParameterChange, check_stands, plan
from multidrop.params.values import ParameterSet
from multidrop.transport import clock

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
        if not check_stands(drive):  # the output frequency is 0 Hz, but the motor may have a run command
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
        call.check(parameter.code)  # again, because the journal's disk may be slow
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
