"""Make text from files and arguments safe for a terminal, a page or a log; parse numbers in it."""

from __future__ import annotations

import re

# Stricter than int() and float(), which also accept `1_0` for 10, and digits of all scripts.
_WHOLE = re.compile(r"[+-]?[0-9]+")
_NUMBER = re.compile(
    r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?|[+-]?(nan|inf)", re.IGNORECASE | re.ASCII
)
MOST_DIGITS = 100  # Python's own limit is 4300, and its error message advises to change it
_LOGIN = re.compile(r"(?<=://)[^\s\"]*@")  # up to the last @, because a password may contain one


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


def plain_whole(text: str) -> int:
    """Return the whole number that a text has in decimal digits. Raises ValueError for any other text."""
    if not _WHOLE.fullmatch(text.strip(" ")):
        raise ValueError(f"{text!r} is no whole number in decimal digits, such as 10")
    if len(text) > MOST_DIGITS:
        raise ValueError(f"a whole number has {MOST_DIGITS} digits at most, and this one has {len(text)}")
    return int(text)


def plain_number(text: str) -> float:
    """Return the number that a text such as "42.5", "nan" or "inf" has. Raises ValueError for other texts."""
    if not _NUMBER.fullmatch(text.strip(" ")):
        raise ValueError(f"{text!r} is no number in decimal digits, such as 42.5")
    return float(text)
