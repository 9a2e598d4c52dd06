"""Write a plan's parameters, one by one, with a journal that survives a killed process."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field
from hashlib import sha256
from typing import Any

from multidrop.control.eeprom_ledger import Ledger
from multidrop.control.outcome import Effect, Outcome
from multidrop.control.records import commissioning as commissioning_block
from multidrop.drive.family import Drive
from multidrop.errors import BusError, WriteForbidden
from multidrop.iso_time import format_time
from multidrop.params.plan import ApplyPlan, ParameterChange, check_stands, plan
from multidrop.params.values import ParameterSet
from multidrop.transport import clock

Report = Callable[
    [int, int, ParameterChange, str], None
]  # called with the write's number, the total, the change and its outcome in words


@dataclass
class Applied:
    """The result of applying parameters: the writes made, and the parameters refused.

    `earlier` has a sentence for each write of a previous, interrupted application. `failure` is the error
    that ended this application early; call `apply` again to continue.
    """

    plan: ApplyPlan
    written: list[ParameterChange] = field(default_factory=list)
    refused: dict[str, str] = field(default_factory=dict)  # reasons by parameter code
    earlier: list[str] = field(default_factory=list)
    failure: BusError | None = None

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
    """Write the parameters that differ to a stopped drive; return the result.

    Each parameter is written once, counted in the EEPROM ledger and read back. The drive's state is read
    before each write; if the motor turns, the application ends. If the process is killed, a second call
    writes the remaining parameters and reports the first call's writes. With `commissioning`, a register may
    be written again within a minute. Raises as `plan` does.
    """
    return apply_plan(plan(drive, values, also=also), commissioning=commissioning, report=report)


def apply_plan(made: ApplyPlan, *, commissioning: bool = False, report: Report | None = None) -> Applied:
    """Write the parameters of a plan as `apply` does; return the result.

    If the only evidence of standstill is an output frequency of 0, a stop is sent first.
    """
    journal = _Journal(made.drive)
    result = Applied(made, earlier=journal.earlier())
    if made.writes:
        if not check_stands(made.drive):  # the motor may have a run command at 0 Hz
            made.drive.stop()
        journal.begin(made)
    with commissioning_block() if commissioning else nullcontext():
        for number, change in enumerate(made.writes, 1):
            said = _write(change, made.drive, result, journal)
            if report:
                report(number, len(made.writes), change, said)
            if result.failure:
                return result
    journal.end()
    return result


def _write(change: ParameterChange, drive: Drive, result: Applied, journal: _Journal) -> str:
    """Write one parameter; record the outcome in `result`, and return it in words."""
    parameter = change.parameter
    try:
        check_stands(drive)
        journal.note(code=parameter.code, before=change.before, after=change.after)
        outcome: Outcome = drive.try_write(parameter, parameter.decode(change.after))
    except WriteForbidden as refusal:
        if not refusal.is_budget:
            result.failure = refusal
            return str(refusal)
        return _refused(change, str(refusal), result, journal)
    except BusError as failure:
        result.failure = failure
        return str(failure)
    if outcome.effect is Effect.DONE:
        journal.note(code=parameter.code, outcome="written")
        result.written.append(change)
        return "written"
    if outcome.effect is Effect.UNCONFIRMED:
        result.failure = outcome.failure
        return str(outcome.failure)
    return _refused(change, str(outcome.failure or outcome), result, journal)


def _refused(change: ParameterChange, why: str, result: Applied, journal: _Journal) -> str:
    code = change.parameter.code
    journal.note(code=code, outcome="not written")
    result.refused[code] = why
    return f"not written: {why}"


class _Journal:
    """A file beside the EEPROM ledger that lists the writes of an application until the application ends.

    If the file exists at the start, it lists the writes of an interrupted application.
    """

    def __init__(self, drive: Drive) -> None:
        identity = drive.bus.line.identity
        name = sha256(f"{identity}\n{drive.address}".encode(errors="replace")).hexdigest()[:16]
        self._path = Ledger().at(identity).path.parent / "applications" / f"{name}.jsonl"

    def earlier(self) -> list[str]:
        """Return a sentence for an interrupted application, and one for each of its writes; else []."""
        try:
            lines = self._path.read_text("utf-8", errors="replace").splitlines()
        except FileNotFoundError:
            return []
        outcomes: dict[str, str] = {}
        for record in _records(lines):
            if "began" in record:
                found = f"{record.get('source')}, begun {str(record['began'])[:19]}Z"
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
        """Append a record with one system call, so that a killed process leaves only whole records."""
        with self._path.open("ab", buffering=0) as file:
            file.write(json.dumps(record).encode() + b"\n")

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
