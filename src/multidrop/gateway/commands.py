"""Commands: everything that is written, by whichever way it is asked for.

The caller's role, the plant file's lists and the library's own rules must allow it. Each command has a thread
of its own, so that a stop waits for nothing of the gateway; a write that comes while many are under way is
refused.
"""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from math import inf
from typing import Protocol

from multidrop import Bus, Drive, Plant, WriteForbidden
from multidrop.control import RepeatedStops, written_before
from multidrop.drive import verb_arguments
from multidrop.gateway.clock import boottime_ns, monotonic_ns
from multidrop.gateway.command_results import Told as Told
from multidrop.gateway.command_results import as_one, denied, failed, not_listed, of_stop
from multidrop.gateway.command_threads import begin_stop, begin_stops, in_thread
from multidrop.gateway.drive_commands import act_one, stop_by, stop_one, write_one
from multidrop.gateway.http.rights import NEVER_THIS_WAY, Caller, May, Right
from multidrop.gateway.stops_amid_reload import ChangingLines, drives_of, names_of, stop_meant
from multidrop.gateway.verb_rules import STOPPING, VERBS
from multidrop.plant import drive_meant

MOST_AGE_S = 5.0  # of a write or a verb that a network held up; a stop is never too old
MOST_WRITES = 8  # under way on a line, without stops
BUSY = "too many writes are under way"  # a rule
UNAUDITED = "the audit log cannot be written"  # a rule
WAYS_WITHOUT_VERBS = frozenset({"modbus"})

# Returns until when a command may be sent (CLOCK_BOOTTIME, ns), as it is called in words, or raises
# WriteForbidden.
Admit = Callable[[str], float]

StopWork = Callable[[float | None], dict[str, Told]]  # takes for how long a stop is repeated

_log = logging.getLogger("multidrop.gateway")


class PolledLines(ChangingLines, Protocol):
    """The part of a Poller that commands need."""

    @property
    def plant(self) -> Plant: ...
    def bus(self, line: str) -> Bus: ...


class Commands:
    """Carries commands out on the lines of a poller.

    `on_reset` is called with the name of a drive whose fault was reset.
    """

    def __init__(
        self, lines: PolledLines, may: May, on_reset: Callable[[str], object] = lambda drive: None
    ) -> None:
        self.may = may
        self.withheld = ""  # why nothing but stops is written
        self._on_reset = on_reset
        self._halts: Counter[str] = Counter()  # commands besides stops that end a run, by drive
        self._jogging: Counter[str] = Counter()  # jogs under way
        self._lines = lines
        self.called = 0  # commands that passed all rights, so far
        self._under_way: dict[str, int] = {}  # writes, by line
        self.stops: Counter[str] = Counter()  # that were called, by drive
        self._stopped_ns: dict[str, int] = {}  # when the latest one was
        self._repeated = {verb: RepeatedStops(partial(stop_by, verb)) for verb in STOPPING}
        self._repeated["stop"] = RepeatedStops(stop_one)
        self._ended_ns: dict[str, int] = {}  # by drive
        self.plant_ns: int | None = None  # when the plant was read anew (CLOCK_BOOTTIME)

    def begin_anew(self) -> None:
        """Note that there is another plant, in which a name may be another drive's."""
        self.plant_ns = boottime_ns()

    def ended_ns(self, drive: str) -> int:
        """Return when the latest command of a drive ended (CLOCK_MONOTONIC); 0 without one.

        What was polled before may be old.
        """
        return self._ended_ns.get(drive, 0)

    def stopped_ns(self, drive: str) -> int | None:
        """Return when the latest stop of a drive was called (CLOCK_BOOTTIME); None without one."""
        return self._stopped_ns.get(drive)

    def halts(self, drive: str) -> int | None:
        """Return how many commands that end a run of a drive's motor were called; None while it jogs."""
        return None if self._jogging[drive] else self.stops[drive] + self._halts[drive]

    def _note_stop(self, drives: Iterable[str]) -> None:
        drives = [*drives]
        self.stops.update(drives)
        self._stopped_ns |= dict.fromkeys(drives, boottime_ns())

    def _note_end(self, drives: Iterable[str], future: object = None) -> None:
        self._ended_ns |= dict.fromkeys(drives, monotonic_ns())

    # ---- stops ----

    async def stop(self, drives: Sequence[str] | None, caller: Caller) -> dict[str, Told]:
        """Stop these drives, or all with None; by drive's name what is known of each.

        The stops of all lines and drives go side by side. Never raises for one drive: the others go on.
        Nothing but the role is looked at, and nothing is waited for before it is sent. What a reload of the
        plant changed meanwhile is stopped again as it is now.
        """
        if caller.role < Right.STOP:
            wanted = drives_of(self._lines.plant) if drives is None else drives
            return dict.fromkeys(wanted, denied(caller, Right.STOP, "stop"))
        self.called += 1
        _log.warning("stop of %s, asked for by %s", "all drives" if drives is None else drives, caller.by)
        return await stop_meant(self._lines, drives, partial(self._stop, caller=caller))

    async def _stop(self, plant: Plant, wanted: Iterable[str], caller: Caller) -> dict[str, Told]:
        """Stop these drives of a plant."""
        there, wanted, repeated = drives_of(plant), dict.fromkeys(wanted), self._repeated["stop"]
        told: dict[str, Told] = {}
        works: list[tuple[StopWork, list[Drive]]] = []
        once: list[Drive] = []
        for line in plant.lines:
            here = {polled.drive.name: polled.drive for polled in line.drives if polled.drive.name in wanted}
            self._note_stop(here)
            new, others = repeated.divided(here.values())
            once += others
            if new and len(new) == len(line.drives):
                works.append((partial(self._stop_line, line.name, list(here)), new))
            else:
                works += [(partial(stop_one, drive), [drive]) for drive in new]
        for name in wanted:
            if name not in there:
                told[name] = failed(ValueError(f"there is no drive {name!r}"))
        begun = self._begin_stops(works, caller, repeated)
        again = [repeated.send_once(drive, partial(begin_stop, caller=caller)) for drive in once]
        for found in await asyncio.gather(*begun, *again):
            told |= found
        return {name: told[name] for name in wanted if name in told}

    def _begin_stops(
        self, works: Sequence[tuple[StopWork, list[Drive]]], caller: Caller, repeated: RepeatedStops[Told]
    ) -> list[asyncio.Future[dict[str, Told]]]:
        begun = begin_stops([work for work, _ in works], caller)
        for future, (_, drives) in zip(begun, works, strict=True):
            future.add_done_callback(partial(self._note_end, [drive.name for drive in drives]))
            repeated.note(drives, future)
        return begun

    def _stop_line(self, line: str, names: list[str], seconds: float | None) -> dict[str, Told]:
        try:
            found = self._lines.bus(line).stop_all(seconds=seconds)
        except Exception as failure:  # whatever it is: everybody must see it
            _log.exception("stop_all of line %s", line)
            return dict.fromkeys(names, failed(failure))
        left = failed(ValueError(f"it is no longer on line {line}"))
        return {name: of_stop(found[name]) if name in found else left for name in names}

    # ---- writes and verbs ----

    async def write(
        self, drive: str, register: str, value: float, caller: Caller, admit: Admit = lambda what: inf
    ) -> Told:
        """Write a register that the plant file lists, once; never raises for what becomes of it."""
        what = f"{drive}.{register}"
        if caller.role < Right.WRITE:
            return denied(caller, Right.WRITE, f"a write of {what}")
        if what not in self.may.write:
            return failed(not_listed(what, "write"))
        if self._moves(drive, register):
            self._halts[drive] += 1
        work = partial(write_one, register=register, value=value)
        return await self._carry_out(drive, caller, f"{what} = {value!r}", work, admit)

    async def act(
        self,
        drive: str,
        verb: str,
        options: Mapping[str, object],
        caller: Caller,
        admit: Admit = lambda what: inf,
    ) -> Told:
        """Carry out a verb that the plant file lists, once; refused by a way that cannot ask a person."""
        drive = drive_meant(drive, names_of(self._lines)) if verb in STOPPING else drive
        what = f"{drive}.{verb}"
        rule = VERBS.get(verb)
        if rule is None:
            return failed(ValueError(f"there is no verb {verb!r}; there are {', '.join(VERBS)}"))
        if caller.way in WAYS_WITHOUT_VERBS:
            refusal = f"{verb} is never carried out by way of {caller.way}"
            return failed(WriteForbidden(refusal, rule=NEVER_THIS_WAY))
        if caller.role < rule.role:
            return denied(caller, rule.role, what)
        if rule.is_listed and what not in self.may.verbs:
            return failed(not_listed(what, "verbs"))
        if verb == "stop":
            return as_one(await self.stop([drive], caller))
        try:
            arguments = verb_arguments(verb, options)
        except ValueError as mistake:
            return failed(mistake)
        if verb in STOPPING:
            return await self._carry_out_stop(drive, verb, caller)
        work = partial(act_one, verb=verb, arguments=arguments)
        is_jog = verb == "jog"
        self._jogging[drive] += is_jog
        try:
            told = await self._carry_out(drive, caller, what, work, admit)
        finally:
            self._jogging[drive] -= is_jog
            self._halts[drive] += is_jog
        if verb == "reset_fault" and told.is_done:
            self._on_reset(drive)
        return told

    def _moves(self, drive: str, register: str) -> bool:
        """Return True for a register whose writes may start or stop the motor."""
        known = drives_of(self._lines.plant).get(drive)
        found = known.registers.get(register) if known is not None else None
        return found is not None and found.commands

    async def _carry_out_stop(self, drive: str, verb: str, caller: Caller) -> Told:
        """Carry out a verb that stops the motor: neither writes under way nor other stops keep it back.

        Another drive that a reload makes it mean as well is stopped on its ramp, unless its verb is listed.
        """
        self.called += 1
        _log.warning("%s.%s, asked for by %s", drive, verb, caller.by)
        repeated = self._repeated[verb]

        async def stop(plant: Plant, names: list[str]) -> dict[str, Told]:
            there = drives_of(plant)
            listed = {drive} | {name for name in names if f"{name}.{verb}" in self.may.verbs}
            here = [name for name in names if name in there and name in listed]
            self._note_stop(here)
            new, once = repeated.divided(there[name] for name in here)
            works = [(partial(stop_by, verb, drive), [drive]) for drive in new]
            begun = self._begin_stops(works, caller, repeated)
            again = [repeated.send_once(drive, partial(begin_stop, caller=caller)) for drive in once]
            rest = self._stop(plant, [name for name in names if name not in here], caller)
            ends = await asyncio.gather(*begun, *again, rest)
            return {name: told for end in ends for name, told in end.items()}

        return as_one(await stop_meant(self._lines, [drive], stop))

    async def _carry_out(
        self, drive: str, caller: Caller, what: str, work: Callable[[Drive], Told], admit: Admit
    ) -> Told:
        try:
            line, known = self._lines.plant.find_drive(drive)
        except ValueError as mistake:
            return failed(mistake)
        if self.withheld:
            return failed(WriteForbidden(f"{what} was not sent: {self.withheld}", rule=UNAUDITED))
        if self._under_way.get(line.name, 0) >= MOST_WRITES:
            reason = f"{what} was not sent: {MOST_WRITES} others are under way on line {line.name}"
            return failed(WriteForbidden(reason, rule=BUSY))
        try:
            until_ns = admit(what)
        except WriteForbidden as refusal:
            return failed(refusal)
        self.called += 1
        stops = self.stops[drive]

        def limit_ns() -> float:
            """Return until when it may be sent, as rows have times; 0 once a stop was called."""
            return until_ns - boottime_ns() + monotonic_ns() if self.stops[drive] == stops else 0

        def checked() -> Told:
            if self.stops[drive] != stops:
                return failed(
                    WriteForbidden(f"{what} was not sent: a stop was called", rule="a stop was called")
                )
            with written_before(limit_ns):
                return work(known)

        self._under_way[line.name] = self._under_way.get(line.name, 0) + 1
        try:
            future = in_thread(checked, caller)
        except RuntimeError as failure:
            self._end(line.name, drive)
            return failed(failure)
        future.add_done_callback(lambda _: self._end(line.name, drive))
        told = await asyncio.shield(future)
        _log.info("%s, asked for by %s: %s", what, caller.by, told.text)
        return told

    def _end(self, line: str, drive: str) -> None:
        self._under_way[line] -= 1
        self._note_end([drive])
