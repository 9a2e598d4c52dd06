"""Text on a terminal's whole screen: cut to columns, and spelt in what the terminal can show."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from rich.cells import cell_len, set_cell_size
from rich.text import Text

from multidrop.printable import printable


def cut(text: str, width: int) -> str:
    """Cut to so many columns, of which some characters take two and some none; a ~ ends what was cut."""
    text = printable(text)
    return text if cell_len(text) <= width else set_cell_size(text, max(0, width - 1)) + "~"


def joined(lines: Iterable[Text], encoding: str) -> Any:
    """Return the lines as one picture; a ? stands for each column of what the encoding lacks.

    Else such a character would be written as an escape, which is longer, and every column behind it move.
    """
    shown = [Text(_encodable(line.plain, encoding), style=line.style) for line in lines]
    return Text("\n", no_wrap=True, end="").join(shown)


def _encodable(text: str, encoding: str) -> str:
    try:
        text.encode(encoding)
    except UnicodeEncodeError:
        return "".join(_mark(mark, encoding) for mark in text)
    return text


def _mark(mark: str, encoding: str) -> str:
    try:
        mark.encode(encoding)
    except UnicodeEncodeError:
        return "?" * cell_len(mark)
    return mark
