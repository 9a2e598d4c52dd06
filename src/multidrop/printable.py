"""Text from files and arguments, made harmless for a terminal or a page."""

from __future__ import annotations

import re

_LOGIN = re.compile(r"(?<=://)\S*@")  # to the last @: a password may have one


def masked(text: str) -> str:
    """Return the text without the users and passwords of its URLs: nats://***@host:4222."""
    return _LOGIN.sub("***@", text)


def printable(text: str) -> str:
    r"""Return the text with all unprintable characters spelt out: an escape is `\x1b`.

    Control characters can move a terminal's cursor, and change its title or clipboard; marks of direction
    make a name look like another one.
    """
    if text.isprintable():
        return text
    return "".join(mark if mark.isprintable() else repr(mark)[1:-1] for mark in text)
