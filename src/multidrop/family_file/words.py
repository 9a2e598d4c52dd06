"""Words: raw counts that a verb writes to a register, as numbers, names of bits or names of values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntFlag
from typing import Any

from multidrop.drive.register import Register
from multidrop.drive.state import Direction
from multidrop.drive.table import Carrier
from multidrop.family_file.places import whole
from multidrop.toml_check import TomlPlace

WITHOUT = ("forward", "refuse", "as it turns")
_DIRECTIONS = '{ forward = 0x047C, reverse = 0x847C, without = "refuse" }'


@dataclass(frozen=True)
class Words:
    """The word of a step; or one for each direction, and what `without` one is done."""

    by_direction: Mapping[Direction | None, int]
    without: str = ""

    @property
    def all(self) -> tuple[int, ...]:
        return tuple(self.by_direction.values())

    @property
    def is_directed(self) -> bool:
        return None not in self.by_direction


def is_flags(register: Register[Any]) -> bool:
    """Return True where the register's values are bits with names, or it is one bit."""
    values = register.values
    return isinstance(values, type) and issubclass(values, IntFlag)


def is_bits(register: Register[Any]) -> bool:
    """Return True where a word of the register is made of bits, each with a meaning of its own."""
    return is_flags(register) or register.table.carrier is Carrier.BIT


def bits_of(register: Register[Any], name: str, given: list[Any]) -> int:
    """Return the mask of bits by name; ValueError with those that there are."""
    values: Any = register.values
    names = {str(member.name).lower(): int(member.value) for member in values}
    mask = 0
    for bit in given:
        found = names.get(bit.lower().replace("-", "_")) if isinstance(bit, str) else None
        if found is None:
            raise ValueError(f"{name} has no bit {bit!r}; it has {', '.join(names)}")
        if mask & found:
            raise ValueError(f"names {bit!r} twice; once is enough")
        mask |= found
    return mask


def word_of(register: Register[Any], name: str, given: Any) -> int:
    """Return the raw count of a number, a name, or a list of bits; ValueError where it cannot be written."""
    if whole(given):
        return _checked(register, name, given)
    if is_flags(register):
        names = given if isinstance(given, list) else [given]
        return _checked(register, name, bits_of(register, name, names))
    values: Any = register.values
    known = {} if values is None else {str(member.name).lower(): int(member.value) for member in values}
    if isinstance(given, str) and given.lower() in known:
        return _checked(register, name, known[given.lower()])
    right = f"one of {', '.join(known)}" if known else "a whole number, such as 0x0476"
    raise ValueError(f"{name} takes {right}, not {given!r}")


def _checked(register: Register[Any], name: str, word: int) -> int:
    """Return the word; ValueError where the register cannot hold it or does not allow it."""
    try:
        value: Any = register.decode(word)
        raw = register.encode(value)
    except (ValueError, TypeError, OverflowError) as mistake:
        reason = str(mistake).removeprefix(register.name).removeprefix(" ").removeprefix(": ")
        raise ValueError(f"{name} does not take {shown(register, word)}: {reason}") from None
    top = 1 if register.table.carrier is Carrier.BIT else 0xFFFF
    if raw != word or not 0 <= word <= top:
        raise ValueError(f"{name} does not take {word}: it takes 0 to {top:X}H")
    for mask in register.never_together:
        if word & mask == mask:
            raise ValueError(
                f"{shown(register, word)} sets bits of {mask:04X}H that are never_together in {name}"
            )
    return word


def shown(register: Register[Any], word: int) -> str:
    """Return a word as sentences of errors print it."""
    return f"{word:X}H" if register.table.carrier is Carrier.BIT else f"{word & 0xFFFFFFFF:04X}H"


def parse_words(register: Register[Any], name: str, given: Any, place: TomlPlace) -> Words | None:
    """Return the words of a step's value; None where they are wrong, which is told."""
    if not isinstance(given, Mapping):
        word = place.attempt(word_of, register, name, given)
        return None if word is None else Words({None: word})
    unknown = [key for key in given if key not in ("forward", "reverse", "without")]
    missing = [key for key in ("forward", "reverse", "without") if key not in given]
    if unknown or missing:
        wrong = f"has {unknown[0]!r}" if unknown else f"lacks {missing[0]!r}"
        place.wrong(f"value {wrong}; write {_DIRECTIONS}, with without = {' or '.join(map(repr, WITHOUT))}")
        return None
    if given["without"] not in WITHOUT:
        place.wrong(f"without = {given['without']!r} is none of {', '.join(map(repr, WITHOUT))}")
        return None
    forward = place.attempt(word_of, register, name, given["forward"])
    reverse = place.attempt(word_of, register, name, given["reverse"])
    if forward is None or reverse is None:
        return None
    if forward == reverse:
        place.wrong(
            f"forward and reverse are both {shown(register, forward)}; for one word write value = WORD"
        )
        return None
    return Words({Direction.FORWARD: forward, Direction.REVERSE: reverse}, given["without"])
