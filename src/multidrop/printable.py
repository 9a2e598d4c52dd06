"""Write values as text and parse them: safe texts, numbers, times; hints: similar names, install commands."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterable
from datetime import datetime, timedelta
from functools import lru_cache
from typing import TypeGuard

# Stricter than int() and float(), which also accept `1_0` for 10, and digits of all scripts.
_WHOLE = re.compile(r"[+-]?[0-9]+")
_NUMBER = re.compile(
    r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?|[+-]?(nan|inf)", re.IGNORECASE | re.ASCII
)
# limit of a number's digits, below Python's limit of 4300, whose error message would confuse users
MOST_DIGITS = 100
_FORMULA = re.compile(r"'*[=+\-@\t\r\n]")
_EPOCH = datetime(1970, 1, 1)
_SECOND_NS = 1_000_000_000
_LOGIN = re.compile(r"(?<=://)[^\s\"]*@")  # up to the last @, because a password may contain an @


def masked(text: str) -> str:
    """Return the text without the users and passwords in its URLs: nats://me:pw@host becomes nats://host."""
    return _LOGIN.sub("", text)


def printable(text: str) -> str:
    r"""Return the text with all unprintable characters escaped, such as `\x1b`.

    Control characters can move a terminal's cursor, and change its title or clipboard. Direction marks can
    make a name look like another one.
    """
    if text.isprintable():
        return text
    return "".join(mark if mark.isprintable() else repr(mark)[1:-1] for mark in text)


def spreadsheet_text(text: str) -> str:
    """Return the text for a cell of a CSV file.

    A text that a spreadsheet could evaluate as a formula gets an apostrophe in front, even if it already
    starts with apostrophes.
    """
    return f"'{text}" if _FORMULA.match(text) else text


def plain_whole(text: str) -> int:
    """Parse a whole number in decimal digits. Raises ValueError for any other text."""
    if not _WHOLE.fullmatch(text.strip(" ")):
        raise ValueError(f"{text!r} is not a whole number in decimal digits, such as 10")
    if len(text) > MOST_DIGITS:
        raise ValueError(f"a whole number has {MOST_DIGITS} digits at most, and this one has {len(text)}")
    return int(text)


def plain_number(text: str) -> float:
    """Parse a number such as "42.5", "nan" or "inf". Raises ValueError for any other text."""
    if not _NUMBER.fullmatch(text.strip(" ")):
        raise ValueError(f"{text!r} is not a number in decimal digits, such as 42.5")
    return float(text)


def is_number(value: object) -> TypeGuard[float]:
    """Return True for an int or a float. True and False do not count as numbers, although bool is an int."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def is_whole(value: object) -> TypeGuard[int]:
    """Return True for an int that is not a bool."""
    return isinstance(value, int) and not isinstance(value, bool)


def format_time(time_ns: int) -> str:
    """Return ns since 1970 (UTC) as ISO 8601 text, such as 2026-11-21T09:30:00.123456789Z."""
    second, rest = divmod(time_ns, _SECOND_NS)
    return f"{_format_second(second)}.{rest:09d}Z"


def iso_time(ms: int) -> str:
    """Return a time in ms since 1970 (UTC) as text, such as 2026-11-22T09:30:00.123Z."""
    second, rest = divmod(ms, 1000)
    return f"{_format_second(second)}.{rest:03d}Z"


def parse_time(text: str) -> int:
    """Return the ns since 1970 (UTC). Raises ValueError unless the text has the form of `format_time`."""
    second, dot, rest = text.partition(".")
    if not dot or len(rest) != 10 or rest[-1] != "Z":
        raise ValueError(text)
    return _parse_second(second) * _SECOND_NS + int(rest[:-1])


@lru_cache(maxsize=1024)
def _format_second(second: int) -> str:
    return (_EPOCH + timedelta(seconds=second)).isoformat()


@lru_cache(maxsize=1024)
def _parse_second(text: str) -> int:
    return (datetime.fromisoformat(text).replace(tzinfo=None) - _EPOCH) // timedelta(seconds=1)


def nearest_names(name: str, known: Iterable[str], most: int) -> list[str]:
    """Return the known names that are most like a wrong name, the most similar first."""
    from difflib import get_close_matches  # imported here: only mistakes need it

    return get_close_matches(name, [*known], n=most)


def did_you_mean(name: str, known: Iterable[str], otherwise: str = "", most: int = 2) -> str:
    """Return a hint with the known names that are most like a wrong name.

    If no known name is similar, return `otherwise`; if that is empty, list all known names.
    """
    known = [*known]
    if near := nearest_names(name, known, most):
        return f"did you mean {' or '.join(near)}?"
    return otherwise or f"there are {', '.join(known) or 'none'}"


def install_command(*extras: str) -> str:
    """Return the pip command for the libraries of the extras.

    The command names each library, because pip finds `multidrop[extra]` only in the directory of the sources.
    The names of the extras follow as a shell comment.
    """
    # imported here, because most programs never need it
    from importlib.metadata import PackageNotFoundError, requires

    try:
        found = [one.partition(";") for one in requires("multidrop") or ()]
    except PackageNotFoundError:
        found = []
    markers = [f'extra == "{extra}"' for extra in extras]
    wanted = [
        name.strip()
        for name, _, given in found
        if any(marker in given.replace("'", '"') for marker in markers)
    ]
    named = f"multidrop[{','.join(extras)}]"
    return f"pip install {shlex.join(wanted)}  # {named}" if wanted else f"pip install '{named}'"
