"""Steps of a verb, as a family's file declares them: a list of tables, of which each does one thing.

There are no loops, no expressions and no calls: a verb ends within the sum of its limits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from multidrop.drive.register import Register
from multidrop.family_file.looks import Look
from multidrop.family_file.places import sentence
from multidrop.family_file.words import Words, parse_words
from multidrop.toml_check import TomlPlace, parse_duration

MOST_STEPS = 20  # of one list
LONGEST_WAIT = 10.0  # s
LONGEST_AWAIT = 600.0  # s, of a stop: a ramp may take so long
SHORTEST_AWAIT = 0.1  # s


@dataclass(frozen=True)
class VerbStep:
    """A step of a verb; where `when` is a look, it is done if that holds."""

    when: Look | None


@dataclass(frozen=True)
class Writes(VerbStep):
    """Write a word once."""

    register: str
    words: Words


@dataclass(frozen=True)
class Insists(Writes):
    """Write a harmless word, and again when the reply is lost."""


@dataclass(frozen=True)
class Waits(VerbStep):
    seconds: float


@dataclass(frozen=True)
class Awaits(VerbStep):
    """Look until it holds; after `limit` seconds do `otherwise`, and without that the verb has failed."""

    look: Look
    limit: float  # s
    otherwise: tuple[VerbStep, ...]


@dataclass(frozen=True)
class RefusesWhen(VerbStep):
    """Refuse the call where a look holds."""

    look: Look
    because: str


@dataclass(frozen=True)
class NeedsSetpoint(VerbStep):
    """Refuse the call unless the setpoint is known, is not 0, and is the one that was written."""


@dataclass(frozen=True)
class AwaitsRunning(VerbStep):
    """Wait until the motor is seen to run."""


def every_step(steps: Sequence[VerbStep]) -> Iterator[VerbStep]:
    """Yield the steps in their order, with those of an `else` after their await."""
    for step in steps:
        yield step
        if isinstance(step, Awaits):
            yield from every_step(step.otherwise)


def longest(steps: Sequence[VerbStep], start_time: float) -> float:
    """Return the sum of the limits in s: no call waits longer, beyond the time of its exchanges."""
    total = 0.0
    for step in every_step(steps):
        if isinstance(step, Waits):
            total += step.seconds
        elif isinstance(step, Awaits):
            total += step.limit
        elif isinstance(step, AwaitsRunning):
            total += start_time
    return total


# ---- from a document ----


@dataclass(frozen=True)
class StepParser:
    """Makes steps of tables; what is wrong with one is told at its place."""

    registers: Mapping[str, Register[Any]]
    looks: Mapping[str, Look]

    def steps(self, given: Any, place: TomlPlace, *, is_else: bool = False) -> tuple[VerbStep, ...] | None:
        """Return the steps; None where any of them is wrong."""
        if not isinstance(given, list) or not 1 <= len(given) <= MOST_STEPS:
            place.wrong(
                f"{'else' if is_else else 'steps'} is not a list of 1 to {MOST_STEPS} steps; {_EXAMPLE}"
            )
            return None
        found = [self._step(table, place.within(f"step {at}"), is_else) for at, table in enumerate(given, 1)]
        good = tuple(step for step in found if step is not None)
        return good if len(good) == len(given) else None

    def _step(self, table: Any, place: TomlPlace, is_else: bool) -> VerbStep | None:
        kinds = [kind for kind in _KEYS if isinstance(table, Mapping) and kind in table]
        if len(kinds) != 1:
            how = f"does {' and '.join(kinds)} at once" if kinds else f"{table!r} is no step"
            place.wrong(f"{how}; each has one of {', '.join(_KEYS)}")
            return None
        kind, before = kinds[0], len(place.config_errors)
        needed, allowed = _KEYS[kind]
        for key in table:
            if key not in (kind, "when", *needed, *allowed):
                place.wrong(f"{kind} has no {key!r}; it takes {', '.join((*needed, *allowed, 'when'))}")
        for key in needed:
            if key not in table:
                place.wrong(f"{kind} lacks {key!r}")
        if is_else and "else" in table:
            place.wrong("an else within an else; leave the inner one out")
        when = self._look("when", table["when"], place) if "when" in table else None
        if len(place.config_errors) > before:
            return None
        step = _MAKERS[kind](self, table, when, place)
        return step if len(place.config_errors) == before else None

    def _look(self, key: str, name: Any, place: TomlPlace) -> Look | None:
        look = self.looks.get(name) if isinstance(name, str) else None
        if look is None:
            known = ", ".join(self.looks) or "none that is right"
            place.wrong(f"{key} = {name!r} is no look of [look]; there are {known}")
        return look

    def _sends(
        self, kind: type[Writes], key: str, table: Any, when: Look | None, place: TomlPlace
    ) -> Writes | None:
        name = table[key]
        register = self.registers.get(name) if isinstance(name, str) else None
        if register is None:
            place.wrong(f"{key} = {name!r} is no register of this file")
            return None
        if not register.writable:
            place.wrong(f"{key} = {name!r}: {name} is a {register.access.value}, which is never written")
            return None
        words = parse_words(register, name, table["value"], place)
        return None if words is None else kind(when, name, words)

    def writes(self, table: Any, when: Look | None, place: TomlPlace) -> VerbStep | None:
        return self._sends(Writes, "write", table, when, place)

    def insists(self, table: Any, when: Look | None, place: TomlPlace) -> VerbStep | None:
        return self._sends(Insists, "insist", table, when, place)

    def waits(self, table: Any, when: Look | None, place: TomlPlace) -> VerbStep | None:
        seconds = _seconds("wait", table["wait"], 0.001, LONGEST_WAIT, place)
        return None if seconds is None else Waits(when, seconds)

    def awaits(self, table: Any, when: Look | None, place: TomlPlace) -> VerbStep | None:
        look = self._look("await", table["await"], place)
        limit = _seconds("limit", table["limit"], SHORTEST_AWAIT, LONGEST_AWAIT, place)
        otherwise = self.steps(table["else"], place.within("else"), is_else=True) if "else" in table else ()
        if look is None or limit is None or otherwise is None:
            return None
        return Awaits(when, look, limit, otherwise)

    def refuses(self, table: Any, when: Look | None, place: TomlPlace) -> VerbStep | None:
        look = self._look("refuse", table["refuse"], place)
        if not sentence(table["because"]):
            place.wrong(f'because = {table["because"]!r} is no reason; write because = "it has a fault"')
        return None if look is None else RefusesWhen(when, look, str(table["because"]))

    def needs_setpoint(self, table: Any, when: Look | None, place: TomlPlace) -> VerbStep | None:
        if table["setpoint"] != "in force":
            place.wrong(f'setpoint = {table["setpoint"]!r} is not right; write setpoint = "in force"')
        return NeedsSetpoint(when)

    def awaits_running(self, table: Any, when: Look | None, place: TomlPlace) -> VerbStep | None:
        if table["started"] is not True:
            place.wrong(f"started = {table['started']!r} is not right; write started = true")
        return AwaitsRunning(when)


def _seconds(key: str, given: Any, least: float, most: float, place: TomlPlace) -> float | None:
    seconds = place.attempt(parse_duration, given) if isinstance(given, str) else None
    if not isinstance(given, str):
        place.wrong(f'{key} = {given!r} is no duration; write {key} = "1 s"')
    elif seconds is not None and not least <= seconds <= most:
        place.wrong(f'{key} = "{given}" is outside {least * 1000:g} ms to {most:g} s')
        return None
    return seconds


_EXAMPLE = 'write steps = [{ insist = "control", value = 0 }, { await = "stands", limit = "60 s" }]'
_KEYS: Mapping[str, tuple[tuple[str, ...], tuple[str, ...]]] = {  # by kind: further keys, and optional ones
    "write": (("value",), ()),
    "insist": (("value",), ()),
    "wait": ((), ()),
    "await": (("limit",), ("else",)),
    "refuse": (("because",), ()),
    "setpoint": ((), ()),
    "started": ((), ()),
}
_MAKERS: Mapping[str, Callable[[StepParser, Any, Look | None, TomlPlace], VerbStep | None]] = {
    "write": StepParser.writes,
    "insist": StepParser.insists,
    "wait": StepParser.waits,
    "await": StepParser.awaits,
    "refuse": StepParser.refuses,
    "setpoint": StepParser.needs_setpoint,
    "started": StepParser.awaits_running,
}
