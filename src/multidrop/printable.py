"""Text from files and arguments as it may reach a terminal or a page."""

from __future__ import annotations


def printable(text: str) -> str:
    r"""Return the text with all that does not print as it stands spelt out: an escape is `\x1b`.

    Control characters can move the cursor, change the title or the clipboard of a terminal; marks of
    direction make a name look like another one.
    """
    if text.isprintable():
        return text
    return "".join(mark if mark.isprintable() else repr(mark)[1:-1] for mark in text)
