"""Commands: everything that is written, by whichever way it is asked for.

The caller's role, the plant file's lists and the library's own rules must allow it. Each command has a thread
of its own, so that a stop waits for nothing of the gateway; a write that comes while many are under way is
refused.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from math import isfinite
from typing import Any, NamedTuple, Protocol

from multidrop import (
    Bus,
    BusError,
    Drive,
    Effect,
    Plant,
    Refused,
    Register,
    Seen,
    Stopped,
    verb_arguments,
)
from multidrop.gateway.command_threads import begin_stop, in_thread
from multidrop.gateway.rights import NEVER_THIS_WAY, NOT_ALLOWED, NOT_LISTED, Caller, May, Right
from multidrop.gateway.stops_amid_reload import ChangingLines, drives_of, stop_as_changed
from multidrop.gateway.verb_rules import STOPPING, VERBS

MOST_WRITES = 8  # under way on a line, without stops
BUSY = "too many writes are under way"  # a rule
WAYS_WITHOUT_VERBS = frozenset({"modbus"})

_log = logging.getLogger("multidrop.gateway")


class Told(NamedTuple):
    """The end of a command: what became of it, in the library's words."""

    is_done: bool
    text: str  # one sentence for a person
    error: BusError | ValueError | None = None  # that the library raised


class PolledLines(ChangingLines, Protocol):
    """The part of a Poller that commands need."""

    @property
    def plant(self) -> Plant: ...
    def bus(self, line: str) -> Bus: ...


class Commands:
    """Carries commands out on the lines of a poller."""

    def __init__(self, lines: PolledLines, may: May) -> None:
        self.may = may
        self._lines = lines
        self.called = 0  # commands that passed all rights, so far
        self._under_way: dict[str, int] = {}  # writes, by line
        self._stopped_ns: dict[str, int] = {}  # when the latest stop was called, by drive
        self._ended_ns: dict[str, int] = {}  # by drive

    def ended_ns(self, drive: str) -> int:
        """Return when the latest command of a drive ended (CLOCK_MONOTONIC); 0 without one.

        What was polled before may be old.
        """
        return self._ended_ns.get(drive, 0)

    def stopped_ns(self, drive: str) -> int | None:
        """Return when the latest stop of a drive was called (CLOCK_MONOTONIC); None without one."""
        return self._stopped_ns.get(drive)

    def _note_stop(self, drives: Iterable[str]) -> None:
        self._stopped_ns |= dict.fromkeys(drives, time.monotonic_ns())

    def _note_end(self, drives: Iterable[str]) -> None:
        self._ended_ns |= dict.fromkeys(drives, time.monotonic_ns())

    # ---- stops ----

    async def stop(self, drives: Sequence[str] | None, caller: Caller) -> dict[str, Told]:
        """Stop these drives, or all with None; by drive's name what is known of each.

        The stops of all lines and drives go side by side. Never raises for one drive: the others go on.
        Nothing but the role is looked at, and nothing is waited for before it is sent. What a reload of the
        plant changed meanwhile is stopped again as it is now.
        """
        if caller.role < Right.STOP:
            wanted = drives_of(self._lines.plant) if drives is None else drives
            return dict.fromkeys(wanted, _denied(caller, Right.STOP, "stop"))
        self.called += 1
        _log.warning("stop of %s, asked for by %s", "all drives" if drives is None else drives, caller.by)
        return await stop_as_changed(self._lines, drives, partial(self._stop, caller=caller))

    async def _stop(self, plant: Plant, wanted: Iterable[str], caller: Caller) -> dict[str, Told]:
        """Stop these drives of a plant."""
        there, wanted = drives_of(plant), dict.fromkeys(wanted)
        told: dict[str, Told] = {}
        waited: list[asyncio.Future[dict[str, Told]]] = []
        for line in plant.lines:
            here = {polled.drive.name: polled.drive for polled in line.drives if polled.drive.name in wanted}
            self._note_stop(here)
            if here and len(here) == len(line.drives):
                waited.append(self._begin_stop(partial(self._stop_line, line.name, list(here)), here, caller))
            else:
                waited += [
                    self._begin_stop(partial(_stop_one, drive), [name], caller)
                    for name, drive in here.items()
                ]
        for name in wanted:
            if name not in there:
                told[name] = _failed(ValueError(f"there is no drive {name!r}"))
        for found in await asyncio.gather(*waited):
            told |= found
        return {name: told[name] for name in wanted if name in told}

    def _begin_stop(
        self, work: Callable[[], dict[str, Told]], drives: Iterable[str], caller: Caller
    ) -> asyncio.Future[dict[str, Told]]:
        future = begin_stop(work, caller)
        future.add_done_callback(lambda _: self._note_end(drives))
        return future

    def _stop_line(self, line: str, names: list[str]) -> dict[str, Told]:
        try:
            found = self._lines.bus(line).stop_all()
        except Exception as failure:  # whatever it is: everybody must see it
            _log.exception("stop_all of line %s", line)
            return dict.fromkeys(names, _failed(failure))
        left = _failed(ValueError(f"it is no longer on line {line}"))
        return {name: _of_stop(found[name]) if name in found else left for name in names}

    # ---- writes and verbs ----

    async def write(self, drive: str, register: str, value: float, caller: Caller) -> Told:
        """Write a register that the plant file lists, once; never raises for what becomes of it."""
        what = f"{drive}.{register}"
        if caller.role < Right.WRITE:
            return _denied(caller, Right.WRITE, f"a write of {what}")
        if what not in self.may.write:
            return _failed(_not_listed(what, "write"))
        return await self._carry_out(
            drive, caller, f"{what} = {value!r}", lambda known: _write(known, register, value)
        )

    async def act(self, drive: str, verb: str, options: Mapping[str, object], caller: Caller) -> Told:
        """Carry out a verb that the plant file lists, once; refused by a way that cannot ask a person."""
        what = f"{drive}.{verb}"
        rule = VERBS.get(verb)
        if rule is None:
            return _failed(ValueError(f"there is no verb {verb!r}; there are {', '.join(VERBS)}"))
        if caller.way in WAYS_WITHOUT_VERBS:
            refusal = f"{verb} is never carried out by way of {caller.way}"
            return _failed(Refused(refusal, rule=NEVER_THIS_WAY))
        if caller.role < rule.role:
            return _denied(caller, rule.role, what)
        if rule.is_listed and what not in self.may.verbs:
            return _failed(_not_listed(what, "verbs"))
        if verb == "stop":
            return (await self.stop([drive], caller))[drive]
        try:
            arguments = verb_arguments(verb, options)
        except ValueError as mistake:
            return _failed(mistake)
        carry_out = self._carry_out_stop if verb in STOPPING else self._carry_out
        return await carry_out(drive, caller, what, partial(_act, verb=verb, arguments=arguments))

    async def _carry_out_stop(
        self, drive: str, caller: Caller, what: str, work: Callable[[Drive], Told]
    ) -> Told:
        """Carry out a verb that stops the motor: neither writes under way nor other stops keep it back."""
        self.called += 1
        _log.warning("%s, asked for by %s", what, caller.by)

        async def stop(plant: Plant, names: list[str]) -> dict[str, Told]:
            try:
                _, known = plant.find_drive(drive)
            except ValueError as mistake:
                return {drive: _failed(mistake)}
            self._note_stop([drive])
            return await asyncio.shield(self._begin_stop(lambda: {drive: work(known)}, [drive], caller))

        return (await stop_as_changed(self._lines, [drive], stop))[drive]

    async def _carry_out(self, drive: str, caller: Caller, what: str, work: Callable[[Drive], Told]) -> Told:
        try:
            line, known = self._lines.plant.find_drive(drive)
        except ValueError as mistake:
            return _failed(mistake)
        if self._under_way.get(line.name, 0) >= MOST_WRITES:
            reason = f"{what} was not sent: {MOST_WRITES} others are under way on line {line.name}"
            return _failed(Refused(reason, rule=BUSY))
        self.called += 1
        stopped_ns = self.stopped_ns(drive)

        def checked() -> Told:
            if self.stopped_ns(drive) != stopped_ns:
                return _failed(Refused(f"{what} was not sent: a stop was called", rule="a stop was called"))
            return work(known)

        self._under_way[line.name] = self._under_way.get(line.name, 0) + 1
        try:
            future = in_thread(checked, caller)
        except RuntimeError as failure:
            self._end(line.name, drive)
            return _failed(failure)
        future.add_done_callback(lambda _: self._end(line.name, drive))
        told = await asyncio.shield(future)
        _log.info("%s, asked for by %s: %s", what, caller.by, told.text)
        return told

    def _end(self, line: str, drive: str) -> None:
        self._under_way[line] -= 1
        self._note_end([drive])


def _stop_one(drive: Drive) -> dict[str, Told]:
    try:
        drive.stop()
    except Exception as failure:  # whatever it is: everybody must see it
        return {drive.name: _failed(failure)}
    return {drive.name: Told(True, "stopped: seen to stand")}


def _of_stop(stopped: Stopped) -> Told:
    if stopped.seen is Seen.STOPPED:
        return Told(True, f"stopped: seen to stand after {stopped.seconds:.1f} s")
    return Told(False, f"{stopped.seen.value}: {stopped.why}", BusError(stopped.why))


def _write(drive: Drive, register: str, value: float) -> Told:
    bus: Bus | None = drive.bus
    if bus is None:
        return _failed(ValueError(f"{drive.name} is on no line any more"))
    try:
        known = drive.register(register)
        outcome = bus.try_write(drive, known, _typed(known, value))
    except Exception as failure:  # whatever it is: its caller must see it
        return _failed(failure)
    if outcome.effect is Effect.DONE:
        return Told(True, str(outcome))
    return Told(False, str(outcome), outcome.failure or BusError(str(outcome)))


def _typed(register: Register[Any], value: float) -> Any:
    """Return a number as the register takes it: a choice by its raw count, which is never rounded."""
    if register.values is None:
        return value
    if isinstance(value, float) and (not isfinite(value) or value != int(value)):
        raise ValueError(f"{register.name} takes the number of a choice, not {value!r}")
    return register.decode(value)


def _act(drive: Drive, verb: str, arguments: Mapping[str, Any]) -> Told:
    try:
        getattr(drive, verb)(**arguments)
    except Exception as failure:  # whatever it is: its caller must see it
        return _failed(failure)
    return Told(True, f"{drive.name}: {verb} is done")


def _failed(failure: BaseException) -> Told:
    if not isinstance(failure, (BusError, ValueError)):
        failure = ValueError(str(failure) or type(failure).__name__)
    return Told(False, str(failure), failure)


def _denied(caller: Caller, role: Right, what: str) -> Told:
    needed = role.name.lower()
    sentence = f"{what} needs the role {needed}, and {caller.name} has {caller.role.name.lower()}"
    return _failed(Refused(sentence, rule=NOT_ALLOWED))


def _not_listed(what: str, key: str) -> Refused:
    return Refused(
        f'{what} is not in the plant file\'s list; add it to {key} = ["{what}"] of [serve.may]',
        rule=NOT_LISTED,
    )
