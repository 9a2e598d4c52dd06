"""Commands: check and carry out the writes and verbs, such as start, that the gateway receives.

A command is allowed only if the caller's role, the plant file's lists and the library's own rules allow it. A
stop needs only the role, and does not wait for other commands.
"""

from __future__ import annotations

import asyncio
import logging
import re
from collections import Counter
from collections.abc import Callable, Coroutine, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from math import inf
from typing import Any, NamedTuple, Protocol

from multidrop import Bus, BusError, Drive, Plant, WriteForbidden
from multidrop.control import CommandOutcome, CommandResult, noted_first, result_of_failure, written_by
from multidrop.control.commands import (
    LineStop,
    RepeatedStops,
    begin_command,
    carry_out_verb,
    stop_drive,
    stop_line,
    write_register,
)
from multidrop.core import boottime_ns, now_ns
from multidrop.drive import verb_arguments
from multidrop.gateway.http.rights import NEVER_THIS_WAY, NOT_ALLOWED, NOT_LISTED, Caller, May, Right
from multidrop.plant import drive_meant
from multidrop.supervisor import supervisor

MOST_AGE_S = 5.0  # age limit, in s, of writes and verbs when they arrive; stops have none
LOOK_S = 0.02  # interval, in s, of checks whether a reload has changed a drive that is being stopped
MOST_WRITES = 8  # limit of concurrent writes on one line; stops are not counted
# Values of the field `rule` of WriteForbidden.
BUSY = "too many writes are under way"
STOOD_STILL = "the gateway was suspended"
UNAUDITED = "the audit log cannot be written"
OVERTAKEN = "a stop was called"

WAYS_WITHOUT_VERBS = frozenset({"modbus", "tool"})

# A function that takes a command's text and returns the deadline for sending the command (CLOCK_BOOTTIME,
# ns). It raises WriteForbidden if the command must not be sent.
Admit = Callable[[str], float]

_CALL = re.compile(r"(?P<how>call |run `multidrop )?\b(?P<verb>[a-z_-]+)(?P<end>\(\)|`)?")
_log = logging.getLogger("multidrop.gateway")


class UnknownDrive(ValueError):
    """The plant has no drive of this name."""

    def __init__(self, drive: str) -> None:
        super().__init__(f"there is no drive {drive!r}")


class VerbRule(NamedTuple):
    """The role that a verb needs."""

    role: Right
    is_listed: bool  # True if the plant file must list the verb: the key `verbs` of [serve.may]


VERBS: Mapping[str, VerbRule] = {
    "start": VerbRule(Right.WRITE, True),
    "jog": VerbRule(Right.WRITE, True),
    "reset_fault": VerbRule(Right.WRITE, True),
    "set_frequency": VerbRule(Right.WRITE, True),
    "coast": VerbRule(Right.STOP, True),
    "emergency_stop": VerbRule(Right.STOP, True),
    "stop": VerbRule(Right.STOP, False),
}
STOPPING = frozenset(verb for verb, rule in VERBS.items() if rule.role is Right.STOP)


class PolledLines(Protocol):
    """The polled lines of the gateway. A reload may change them at any moment."""

    @property
    def plant(self) -> Plant: ...
    @property
    def plant_now(self) -> Plant: ...
    @property
    def plant_coming(self) -> Plant | None:
        """The new plant of a reload in progress; None if no reload is in progress."""

    def bus(self, line: str) -> Bus: ...


class Commands:
    """Carries out commands on the lines of a poller.

    `on_reset` is called with the name of a drive whose fault was reset.
    """

    def __init__(
        self, lines: PolledLines, may: May, on_reset: Callable[[str], object] = lambda drive: None
    ) -> None:
        self.may = may
        self.withheld = ""  # why all commands except stops are refused now; "" if commands are accepted
        self._on_reset = on_reset
        # number of commands, other than stops, that can end a motor's run, by drive
        self._halts: Counter[str] = Counter()
        self._jogging: Counter[str] = Counter()  # jogs in progress, by drive
        self._lines = lines
        self.called = 0  # number of commands accepted so far
        self._under_way: Counter[str] = Counter()  # writes in progress, by line
        self.stops: Counter[str] = Counter()  # number of stops called, by drive
        # time at which a drive's latest stop was called (CLOCK_BOOTTIME, ns), by drive
        self._stopped_ns: dict[str, int] = {}
        self._repeated = {verb: RepeatedStops(partial(stop_drive, verb=verb)) for verb in STOPPING}
        self._repeated["stop"] = RepeatedStops()
        # time at which a drive's latest command or stop ended (CLOCK_MONOTONIC, ns), by drive
        self._ended_ns: dict[str, int] = {}
        self.plant_ns: int | None = None  # when the plant file was last reloaded (CLOCK_BOOTTIME, ns)

    def note_reload(self) -> None:
        """Record the time of a reload, after which a drive's name may mean another drive."""
        self.plant_ns = boottime_ns()

    def ended_ns(self, drive: str) -> int:
        """Return when the latest command of a drive ended (CLOCK_MONOTONIC, ns); 0 if there was none.

        Values polled before that time may not show the command's effect.
        """
        return self._ended_ns.get(drive, 0)

    def stopped_ns(self, drive: str) -> int | None:
        """Return when the latest stop of a drive was called (CLOCK_BOOTTIME, ns); None if there was none."""
        return self._stopped_ns.get(drive)

    def halts(self, drive: str) -> int | None:
        """Return the number of commands so far that can end a run of this motor, stops included.

        Return None while the motor jogs.
        """
        return None if self._jogging[drive] else self.stops[drive] + self._halts[drive]

    def _note_stop(self, drives: Iterable[str]) -> None:
        drives = [*drives]
        self.stops.update(drives)
        self._stopped_ns |= dict.fromkeys(drives, boottime_ns())

    def _note_end(self, drives: Iterable[str], future: object = None) -> None:
        self._ended_ns |= dict.fromkeys(drives, now_ns())

    # ---- stops ----

    async def stop(self, drives: Sequence[str] | None, caller: Caller) -> dict[str, CommandResult]:
        """Stop these drives, or all drives if `drives` is None; return the result of each.

        All stops run concurrently, and a failed stop does not end the others. Only the caller's role is
        checked. If a reload changes a drive while it is being stopped, the drive is stopped again under
        its new configuration.
        """
        if caller.role < Right.STOP:
            wanted = drives_of(self._lines.plant) if drives is None else drives
            return dict.fromkeys(wanted, denied(caller, Right.STOP, "stop"))
        self.called += 1
        caller = caller.commanding()
        _log.warning("stop of %s, asked for by %s", "all drives" if drives is None else drives, caller.by)
        return await stop_meant(self._lines, drives, partial(self._stop, caller=caller))

    async def _stop(self, plant: Plant, wanted: Iterable[str], caller: Caller) -> dict[str, CommandResult]:
        wanted = dict.fromkeys(wanted)
        lines: list[LineStop] = []
        for line in plant.lines:
            here = {polled.drive.name: polled.drive for polled in line.drives if polled.drive.name in wanted}
            whole = partial(stop_line, partial(self._lines.bus, line.name), [*here])
            lines.append(LineStop([*here.values()], whole if len(here) == len(line.drives) else None))
        return await self._stop_by("stop", lines, wanted, caller)

    async def _stop_by(
        self, verb: str, lines: Sequence[LineStop], wanted: Iterable[str], caller: Caller
    ) -> dict[str, CommandResult]:
        """Stop the drives on these lines with this verb; return a result for each name in `wanted`."""
        names = [drive.name for line in lines for drive in line.drives]
        self._note_stop(names)
        with _written_by(caller):
            begun = self._repeated[verb].begin(lines)
        for future in begun:
            future.add_done_callback(partial(self._note_end, names))
        results = {name: result_of_failure(UnknownDrive(name)) for name in wanted if name not in names}
        for found in await asyncio.gather(*begun):
            results |= found
        return {name: _for_users(results[name]) for name in wanted}

    # ---- writes and verbs ----

    async def write(
        self, drive: str, register: str, value: float, caller: Caller, admit: Admit = lambda what: inf
    ) -> CommandResult:
        """Write a register once. The plant file must list the register as writable."""
        what = f"{drive}.{register}"
        if caller.role < Right.WRITE:
            return denied(caller, Right.WRITE, f"a write of {what}")
        if (unsupported := self._unsupported("write")) is not None:
            return unsupported
        if drive not in drives_of(self._lines.plant):
            return _refused(UnknownDrive(drive))
        if what not in self.may.write:
            return _refused(not_listed(what, "write"))
        if self._moves(drive, register):
            self._halts[drive] += 1
        work = partial(write_register, name=register, value=value)
        return await self._carry_out(drive, caller, f"{what} = {value!r}", work, admit)

    async def act(
        self,
        drive: str,
        verb: str,
        options: Mapping[str, object],
        caller: Caller,
        admit: Admit = lambda what: inf,
    ) -> CommandResult:
        """Carry out a verb once. Every verb except "stop" must be listed in the plant file.

        Modbus clients and vendors' PC tools are always refused here; their stops call `stop` directly.
        """
        if (unsupported := self._unsupported(verb)) is not None:
            return unsupported
        drive = drive_meant(drive, names_of(self._lines)) if verb in STOPPING else drive
        what = f"{drive}.{verb}"
        rule = VERBS.get(verb)
        if rule is None:
            return _refused(ValueError(f"there is no verb {verb!r}; there are {', '.join(VERBS)}"))
        if caller.way in WAYS_WITHOUT_VERBS:
            refusal = f"{verb} is never carried out by way of {caller.way}"
            return _refused(WriteForbidden(refusal, rule=NEVER_THIS_WAY))
        if caller.role < rule.role:
            return denied(caller, rule.role, what)
        if drive not in names_of(self._lines):
            return _refused(UnknownDrive(drive))
        if rule.is_listed and what not in self.may.verbs:
            return _refused(not_listed(what, "verbs"))
        if verb == "stop":
            return (await self.stop([drive], caller))[drive]
        try:
            arguments = verb_arguments(verb, options)
        except ValueError as mistake:
            return _refused(mistake)
        if verb in STOPPING:
            return await self._carry_out_stop(drive, verb, caller)
        work = partial(carry_out_verb, verb=verb, arguments=arguments)
        is_jog = verb == "jog"
        self._jogging[drive] += is_jog
        try:
            result = await self._carry_out(drive, caller, what, work, admit)
        finally:
            self._jogging[drive] -= is_jog
            self._halts[drive] += is_jog
        if verb == "reset_fault" and result.ok:
            self._on_reset(drive)
        return result

    def note_refused(self, line: str, drive: str, what: str, why: str, caller: Caller) -> None:
        """Record a refused write in the audit log."""
        _log.warning("%s: %s, asked for by %s: %s", drive, what, caller.by, why)
        with _written_by(caller), suppress(ValueError):  # raised if a reload has removed the line
            self._lines.bus(line).note_refused(drive, what, why)

    def _unsupported(self, verb: str) -> CommandResult | None:
        """Return the refusal of a command that this gateway never carries out; None for other commands."""
        return None

    def _moves(self, drive: str, register: str) -> bool:
        """Return True for a register whose writes may start or stop the motor."""
        known = drives_of(self._lines.plant).get(drive)
        found = known.registers.get(register) if known is not None else None
        return found is not None and found.commands

    async def _carry_out_stop(self, drive: str, verb: str, caller: Caller) -> CommandResult:
        """Carry out a stop verb, such as "coast", without waiting for writes in progress or other stops."""
        self.called += 1
        caller = caller.commanding()
        _log.warning("%s.%s, asked for by %s", drive, verb, caller.by)

        async def stop(plant: Plant, names: list[str]) -> dict[str, CommandResult]:
            here = [known for name, known in drives_of(plant).items() if name in names]
            return await self._stop_by(verb, [LineStop(here)], names, caller)

        return (await stop_meant(self._lines, [drive], stop))[drive]

    async def _carry_out(
        self, drive: str, caller: Caller, what: str, work: Callable[[Drive], CommandResult], admit: Admit
    ) -> CommandResult:
        try:
            line, known = self._lines.plant.find_drive(drive)
        except ValueError:  # the drive exists only in the new plant of a reload, which is not in effect yet
            return _refused(UnknownDrive(drive))
        if self.withheld:
            return _refused(WriteForbidden(f"{what} was not sent: {self.withheld}", rule=UNAUDITED))
        if self._under_way[line.name] >= MOST_WRITES:
            reason = f"{what} was not sent: {MOST_WRITES} other commands are under way on line {line.name}"
            return _refused(WriteForbidden(reason, rule=BUSY))
        try:
            until_ns = admit(what)
        except WriteForbidden as refusal:
            return _refused(refusal)
        self.called += 1
        stops = self.stops[drive]

        def limit_ns() -> float:
            """Return the deadline for sending the command (CLOCK_MONOTONIC, ns).

            The deadline is 0, so the command is not sent, if the drive was stopped after this call.
            """
            # now_ns() is called first, so that a pause between the two calls never makes the deadline later
            return now_ns() + until_ns - boottime_ns() if self.stops[drive] == stops else 0

        def why_not() -> CommandResult | None:
            if self.stops[drive] == stops:
                return None
            return _refused(WriteForbidden(f"{what} was not sent: {OVERTAKEN}", rule=OVERTAKEN))

        caller = caller.commanding()
        self._under_way[line.name] += 1
        with _written_by(caller):
            future = begin_command(partial(work, known), limit_ns, why_not)
        future.add_done_callback(lambda _: self._end(line.name, drive))
        result = _for_users(await asyncio.shield(future))
        _log.info("%s, asked for by %s: %s", what, caller.by, result.text)
        return result

    def _end(self, line: str, drive: str) -> None:
        self._under_way[line] -= 1
        self._note_end([drive])


@contextmanager
def _written_by(caller: Caller) -> Iterator[None]:
    """Within the `with` block, put the caller's name into the audit log's entries.

    The first entry of each command, except a stop, is written before the command is sent.
    """
    name, way = _printable(caller.name), _printable(f"{caller.way} from {caller.address}")
    with written_by(name or "anyone", way, caller.command), noted_first():
        yield


def _printable(text: str) -> str:
    return "".join(sign if sign.isprintable() else "?" for sign in text)[:200].strip()


# ---- stops during a reload ----


def drives_of(plant: Plant) -> dict[str, Drive]:
    return {polled.drive.name: polled.drive for polled in plant.drives}


def names_of(lines: PolledLines) -> set[str]:
    """Return the names of all drives of the present plant and, during a reload, of the new plant."""
    return {*drives_of(lines.plant_now), *drives_of(lines.plant_coming or lines.plant_now)}


async def stop_meant(
    lines: PolledLines,
    drives: Iterable[str] | None,
    stop: Callable[[Plant, list[str]], Coroutine[Any, Any, dict[str, CommandResult]]],
) -> dict[str, CommandResult]:
    """Stop the drives with these names, or all drives if None. Return the newest result of each drive.

    A name may be spelled differently from the plant file (see `drive_meant`). `stop` is called with the
    present plant and the names.

    A reload may change a drive while stops are in progress. The changed drive is stopped again as soon as it
    is attached. A reload may also change the plant's lines. Failed stops are then sent once more, after all
    other stops.
    """
    known = names_of(lines)
    meant = {name: drive_meant(name, known) for name in drives or ()}
    before = lines.plant_now.lines
    sent: dict[str, Drive | None] = {}
    begun: list[asyncio.Task[dict[str, CommandResult]]] = []
    while True:
        is_reloading, plant = lines.plant_coming is not None, lines.plant_now
        there = drives_of(plant)
        wanted = there if drives is None else dict.fromkeys(meant.values())
        left = [one for one in wanted if one not in sent or there.get(one, sent[one]) is not sent[one]]
        pending = [stopping for stopping in begun if not stopping.done()]
        if left:
            sent |= {name: there.get(name) for name in left}
            begun.append(supervisor().start("stop", stop(plant, left)))
        elif pending:
            await asyncio.wait(pending, timeout=LOOK_S, return_when=asyncio.FIRST_COMPLETED)
        elif is_reloading:
            await asyncio.sleep(LOOK_S)
        else:
            break
    results = {name: end for stopping in begun for name, end in stopping.result().items()}
    failed = [name for name, end in results.items() if not end.ok]
    if failed and plant.lines != before:
        results |= await stop(plant, failed)
    return results if drives is None else {name: results[one] for name, one in meant.items()}


# ---- results ----


def denied(caller: Caller, role: Right, what: str) -> CommandResult:
    """Return the result for a command that is refused because its caller lacks this role."""
    needed = role.name.lower()
    sentence = f"{what} needs the role {needed}, and {caller.name} has {caller.role.name.lower()}"
    return _refused(WriteForbidden(sentence, rule=NOT_ALLOWED))


def not_listed(what: str, key: str) -> WriteForbidden:
    """Return the error for a write or a verb that is not in the plant file's lists of allowed commands."""
    return WriteForbidden(
        f'{what} is not in the plant file\'s list; add it to {key} = ["{what}"] of [serve.may]',
        rule=NOT_LISTED,
    )


def _refused(error: BusError | ValueError) -> CommandResult:
    return CommandResult(CommandOutcome.REFUSED, in_words(str(error), error), error)


def _for_users(result: CommandResult) -> CommandResult:
    return result._replace(text=in_words(result.text, result.error))


def in_words(text: str, error: BusError | ValueError | None) -> str:
    """Rephrase an error message for users of the gateway: "call stop()" becomes 'use "stop"'."""
    advice = error.advice if isinstance(error, WriteForbidden) else None
    if advice is not None and advice.plant:
        text = text.replace(advice.program, advice.plant)
    return text if error is None else _CALL.sub(_used, text)


def _used(call: re.Match[str]) -> str:
    verb = call["verb"].replace("-", "_")
    how = "use " if call["how"] else ""
    is_call = verb in VERBS and (call["how"] or call["end"])
    return f'{how}"{verb.replace("_", " ")}"' if is_call else call[0]


# ---- the commands of a gateway whose lines are polled by a fleet ----

NOT_STARTED = "the stop was NOT sent: the fleet's part has not started; use the hard-wired stop"
WHOLE = "the fleet"  # key of a stop's result that concerns all drives


class FleetStops(Commands):
    """Stops the drives of a fleet of gateways; refuses all other commands.

    `part` returns the sender of the stops: the gateway's part `fleet`, or None if it has not started.
    """

    def __init__(self, lines: PolledLines, may: May, part: Callable[[], Any]) -> None:
        super().__init__(lines, may)
        self._part = part

    def halts(self, drive: str) -> int | None:
        """Return None: the number of stops is unknown, because other programs stop these motors too.

        Without this number, the gateway raises no alarm when a motor stops.
        """
        return None

    async def stop(self, drives: Sequence[str] | None, caller: Caller) -> dict[str, CommandResult]:
        """Stop these drives.

        If `drives` is None, stop the whole fleet, including drives that the page does not show.
        """
        if drives is not None or caller.role < Right.STOP:
            return await super().stop(drives, caller)
        self.called += 1
        self._note_stop(drives_of(self._lines.plant))
        results = await self._stop_by_fleet(None, caller.commanding())
        self._note_end(drives_of(self._lines.plant))
        return results

    async def _stop(self, plant: Plant, wanted: Iterable[str], caller: Caller) -> dict[str, CommandResult]:
        names = list(dict.fromkeys(wanted))
        self._note_stop(names)
        found = await self._stop_by_fleet(names, caller)
        self._note_end(names)
        missing = found.get(WHOLE)
        # the whole fleet's result does not say whether this drive is stopped
        if missing is None or missing.ok:
            missing = CommandResult(CommandOutcome.UNKNOWN, "the fleet gives no answer for this drive")
        return {name: found.get(name, missing) for name in names}

    async def _stop_by_fleet(self, drives: Sequence[str] | None, caller: Caller) -> dict[str, CommandResult]:
        part = self._part()
        if part is None:
            return {WHOLE: CommandResult(CommandOutcome.FAILED, NOT_STARTED)}
        answers: Mapping[str, tuple[bool, str]] = await part.stop(caller.by, drives)
        return {
            name: CommandResult(CommandOutcome.DONE if is_done else CommandOutcome.FAILED, text)
            for name, (is_done, text) in answers.items()
        }

    def _unsupported(self, verb: str) -> CommandResult | None:
        if verb == "stop":
            return None
        command = verb.replace("_", "-")
        sentence = f"this page only stops a fleet's drives; use `multidrop fleet {command}`"
        return CommandResult(CommandOutcome.REFUSED, sentence, WriteForbidden(sentence, rule=NOT_LISTED))
