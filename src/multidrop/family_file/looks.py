"""Looks: what a drive shows, as named conditions on its registers that a family's file declares.

A look holds when all of its criteria do. It can be held against another one without any drive: two looks may
contradict each other, or one may imply the other; the checks of hazards are made of that.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

from multidrop.drive.family import Drive
from multidrop.drive.register import Register
from multidrop.drive.script import Script, read
from multidrop.family_file.places import number
from multidrop.family_file.words import bits_of, is_flags
from multidrop.toml_check import TomlPlace

MOST_CRITERIA = 8
_CRITERIA = ("has", "lacks", "is", "below", "above")
_RIGHT = '{ register = "status", has = ["tripped"] }'


@dataclass(frozen=True)
class Criterion:
    """A condition on one register: bits set or clear, values it may have, a range without its ends."""

    register: str
    has: int = 0
    lacks: int = 0
    values: frozenset[float] | None = None
    below: float = math.inf
    above: float = -math.inf

    def holds(self, value: float) -> bool:
        """Return True where the register's value satisfies this. Not a number satisfies nothing."""
        if self.has | self.lacks:
            bits = int(value)
            if bits & self.has != self.has or bits & self.lacks:
                return False
        if self.values is not None and value not in self.values:
            return False
        return self.above < value < self.below

    def contradicts(self, other: Criterion) -> bool:
        """Return True where no value satisfies both."""
        if self.register != other.register:
            return False
        both = Criterion(
            self.register,
            self.has | other.has,
            self.lacks | other.lacks,
            below=min(self.below, other.below),
            above=max(self.above, other.above),
        )
        if both.has & both.lacks or both.above >= both.below:
            return True
        for given, against in ((self, other), (other, self)):
            if given.values is not None and not any(
                both.holds(value) and (against.values is None or value in against.values)
                for value in given.values
            ):
                return True
        return False

    def implies(self, other: Criterion) -> bool:
        """Return True where every value that satisfies this one satisfies the other too."""
        if self.register != other.register:
            return False
        if self.values is not None:
            return all(other.holds(value) for value in self.values if self.holds(value))
        return (
            other.values is None
            and not other.has & ~self.has
            and not other.lacks & ~self.lacks
            and self.below <= other.below
            and self.above >= other.above
        )


@dataclass(frozen=True)
class Look:
    """A name for what a drive shows: all of the criteria."""

    name: str
    criteria: tuple[Criterion, ...]

    def __str__(self) -> str:
        return self.name

    def holds(self, values: Mapping[str, float]) -> bool:
        """Return True where these values of registers satisfy it; one that is not given does not."""
        return all(
            criterion.register in values and criterion.holds(values[criterion.register])
            for criterion in self.criteria
        )

    def contradicts(self, other: Look) -> bool:
        """Return True where a drive cannot show both."""
        return any(one.contradicts(two) for one in self.criteria for two in other.criteria)

    def implies(self, other: Look) -> bool:
        """Return True where a drive that shows this shows the other too."""
        return all(any(own.implies(criterion) for own in self.criteria) for criterion in other.criteria)

    def looser(self) -> Iterator[tuple[Look, str]]:
        """Yield the look without each of its conditions, and the condition in words."""
        for at, criterion in enumerate(self.criteria):
            rest = (*self.criteria[:at], *self.criteria[at + 1 :])
            yield Look(self.name, rest), criterion.register
            for bit in (1 << place for place in range(64)):
                if (criterion.has | criterion.lacks) & bit:
                    less = replace(criterion, has=criterion.has & ~bit, lacks=criterion.lacks & ~bit)
                    yield (
                        Look(self.name, (*rest, less)),
                        f"bit {bit.bit_length() - 1} of {criterion.register}",
                    )

    def registers(self) -> list[str]:
        """Return the names of the registers it reads, each once."""
        return list(dict.fromkeys(criterion.register for criterion in self.criteria))

    def seen(self, drive: Drive, values: dict[str, Any] | None = None) -> Script[bool]:
        """Read until a criterion fails, or all hold. `values` keeps what was read for the next look."""
        values = {} if values is None else values
        for criterion in self.criteria:
            if criterion.register not in values:
                values[criterion.register] = yield from read(drive.register(criterion.register))
            if not criterion.holds(values[criterion.register]):
                return False
        return True


# ---- from a document ----


def parse_looks(
    document: Mapping[str, Any], registers: Mapping[str, Register[Any]], place: TomlPlace
) -> dict[str, Look]:
    """Return the looks of [look] that are right; what is wrong with the others is told."""
    found: dict[str, Look] = {}
    tables = document.get("look", {})
    if not isinstance(tables, Mapping):
        place.wrong(f"look = {tables!r} is not right; write [look], and under it stands = {_RIGHT}")
        return found
    for name, table in tables.items():
        look = parse_look(name, table, registers, place.within(f"[look] {name}"))
        if look is not None:
            found[name] = look
    return found


def parse_look(
    name: str, given: Any, registers: Mapping[str, Register[Any]], place: TomlPlace
) -> Look | None:
    """Return a look of one table or of a list of them; None where anything in it is wrong."""
    before = len(place.config_errors)
    tables = given if isinstance(given, list) else [given]
    if not 1 <= len(tables) <= MOST_CRITERIA:
        place.wrong(f"is a list of {len(tables)}; write 1 to {MOST_CRITERIA} of {_RIGHT}")
        return None
    criteria = [_criterion(table, registers, place) for table in tables]
    if len(place.config_errors) > before:
        return None
    look = Look(name, tuple(criterion for criterion in criteria if criterion is not None))
    if look.contradicts(look):
        place.wrong("can never hold: its conditions contradict each other")
        return None
    return look


def _criterion(given: Any, registers: Mapping[str, Register[Any]], place: TomlPlace) -> Criterion | None:
    if not isinstance(given, Mapping):
        place.wrong(f"{given!r} is not right; write {_RIGHT}")
        return None
    for key in given:
        if key not in ("register", *_CRITERIA):
            place.wrong(f"unknown key {key!r}; the keys here are register, {', '.join(_CRITERIA)}")
    name = given.get("register")
    register = registers.get(name) if isinstance(name, str) else None
    if register is None:
        place.wrong(f"register = {name!r} is no register of this file")
        return None
    if not register.readable:
        place.wrong(f"{name} can only be written: a look reads")
        return None
    if not any(key in given for key in _CRITERIA):
        place.wrong(f"says nothing about {name}: add {', '.join(_CRITERIA[:-1])} or {_CRITERIA[-1]}")
        return None
    criterion = Criterion(str(name))
    for key in _CRITERIA:
        if key in given:
            changed = _PARSERS[key](criterion, key, given[key], register, place)
            if changed is None:
                return None
            criterion = changed
    if criterion.contradicts(criterion):
        place.wrong(f"can never hold: its conditions on {name} contradict each other")
        return None
    return criterion


def _bits(
    criterion: Criterion, key: str, given: Any, register: Register[Any], place: TomlPlace
) -> Criterion | None:
    if not is_flags(register):
        place.wrong(f'{key} is about bits, and {criterion.register} names none; write is = ["name"] or below')
        return None
    if not isinstance(given, list) or not given:
        place.wrong(f'{key} = {given!r} is not right: an empty look is always true; write {key} = ["name"]')
        return None
    mask = place.attempt(bits_of, register, criterion.register, given)
    if mask is None:
        return None
    return replace(criterion, has=mask) if key == "has" else replace(criterion, lacks=mask)


def _values(
    criterion: Criterion, key: str, given: Any, register: Register[Any], place: TomlPlace
) -> Criterion | None:
    if is_flags(register):
        place.wrong(
            f"is = {given!r} asks {criterion.register} for one value, and it has bits: write has or lacks"
        )
        return None
    if not isinstance(given, list) or not given:
        place.wrong(f'{key} = {given!r} is not right; write is = ["stopped"], or numbers')
        return None
    values: Any = register.values
    names = {} if values is None else {member.name.lower(): member.value for member in values}
    found: set[float] = set()
    for value in given:
        if isinstance(value, str) and value.lower() in names:
            found.add(names[value.lower()])
        elif values is None and number(value):
            found.add(value)
        else:
            right = ", ".join(names) or "numbers"
            place.wrong(f"{value!r} is no value of {criterion.register}; it has {right}")
            return None
    if values is not None and found >= set(names.values()):
        place.wrong(f"names all values of {criterion.register}: it would always hold")
        return None
    return replace(criterion, values=frozenset(found))


def _bound(
    criterion: Criterion, key: str, given: Any, register: Register[Any], place: TomlPlace
) -> Criterion | None:
    if register.values is not None:
        place.wrong(f"{key} compares numbers, and {criterion.register} has names: write has, lacks or is")
        return None
    if not number(given):
        place.wrong(f"{key} = {given!r} is no number; write {key} = 0.1")
        return None
    least, most = limits_of(register)
    if not least < given < most:
        place.wrong(
            f"{key} = {given:g} would always or never hold: {criterion.register} is {least:g} to {most:g}"
        )
        return None
    return replace(criterion, below=given) if key == "below" else replace(criterion, above=given)


_PARSERS = {"has": _bits, "lacks": _bits, "is": _values, "below": _bound, "above": _bound}


def limits_of(register: Register[Any]) -> tuple[float, float]:
    """Return the least and the greatest value that the register can show."""
    ends = sorted(float(register.decode(_raw(raw))) for raw in register.coding.raw_span)
    return ends[0], ends[1]


def _raw(raw: Fraction) -> float:
    return int(raw) if raw.denominator == 1 else float(raw)


def shown_by(look: Look, values: Mapping[str, float]) -> dict[str, float]:
    """Return these values, changed so that the look holds where bits and names can make it hold."""
    shown = dict(values)
    for criterion in look.criteria:
        value = shown.get(criterion.register, 0)
        if criterion.has | criterion.lacks:
            shown[criterion.register] = int(value) & ~criterion.lacks | criterion.has
        elif criterion.values is not None and value not in criterion.values:
            shown[criterion.register] = min(criterion.values)
        elif not criterion.holds(value):
            shown[criterion.register] = (
                criterion.above + 1 if value <= criterion.above else criterion.below - 1
            )
    return shown
