"""Names of registers and of their values, and the enumerations made of these."""

from __future__ import annotations

import keyword
import re
from collections.abc import Iterator, Mapping
from enum import IntEnum, IntFlag
from typing import Any, cast

LONGEST_NAME = 60
MOST_VALUES = 500
MOST_BITS = 64
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
OF_ENUMERATIONS = frozenset({*dir(IntEnum), *dir(IntFlag), *dir(int), "mro", "name", "value"})


def unusable(name: str) -> str:
    """Return why a name cannot be an attribute in Python, with one that can; "" where it can."""
    if len(name) > LONGEST_NAME:
        return f"it has more than {LONGEST_NAME} characters; give it a shorter one"
    if keyword.iskeyword(name):
        return f"it is a word of Python; write {name}_ or another one"
    if _NAME.fullmatch(name):
        return ""
    words = re.sub(r"\W+|_+", "_", name, flags=re.ASCII).strip("_").lower()
    right = words if _NAME.fullmatch(words) else f"r_{words}".rstrip("_")
    return f"it is not letters of a to z, digits and _, after a letter; write {right}"


def enumeration(owner: str, given: Mapping[str, Any]) -> type[IntEnum]:
    """Return the enumeration of a register's values. Raises ValueError with all that is wrong with it."""
    _check("values", given, MOST_VALUES, range(-(1 << 63), 1 << 64), "a whole number")
    make: Any = IntEnum
    return cast(type[IntEnum], make(owner, given))


def flags(owner: str, given: Mapping[str, Any]) -> type[IntFlag]:
    """Return the flags of a register, of the number of each bit. Raises ValueError for all that is wrong."""
    _check("bits", given, MOST_BITS, range(MOST_BITS), f"a bit's number, 0 to {MOST_BITS - 1}")
    make: Any = IntFlag
    return cast(type[IntFlag], make(owner, {name: 1 << bit for name, bit in given.items()}))


def _check(key: str, given: Mapping[str, Any], most: int, allowed: range, right: str) -> None:
    if wrong := list(_mistakes(key, given, most, allowed, right)):
        raise ValueError("; ".join(wrong))


def _mistakes(key: str, given: Mapping[str, Any], most: int, allowed: range, right: str) -> Iterator[str]:
    if not given:
        yield f"{key} is empty; leave it out, or write {key} = {{ off = 0, on = 1 }}"
    if len(given) > most:
        yield f"{key} has {len(given)} names, and {most} are the most"
        return
    spelt: dict[str, str] = {}
    numbered: dict[int, str] = {}
    for name, number in given.items():
        if why := unusable(name):
            yield f"{key}: {name!r} is no name: {why}"
        elif name in OF_ENUMERATIONS:
            yield f"{key}: {name!r} is a name that all enumerations have; write {name}_"
        elif name.lower() in spelt:
            yield f"{key}: {name} and {spelt[name.lower()]} differ in capitals alone; call one otherwise"
        spelt[name.lower()] = name
        if isinstance(number, bool) or not isinstance(number, int) or number not in allowed:
            yield f"{key}: {name} = {number!r} is not {right}"
        elif number in numbered:
            yield f"{key}: {name} and {numbered[number]} are both {number}; each has its own"
        else:
            numbered[number] = name
