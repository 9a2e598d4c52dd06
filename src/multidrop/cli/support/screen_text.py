"""Text on a full-screen terminal: cut to columns, and limited to the terminal's characters."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from rich.cells import cell_len, set_cell_size
from rich.text import Text

from multidrop.printable import printable


def cut(text: str, width: int) -> str:
    """Cut a text to a width in columns; a ~ marks the cut. Some characters take two columns, some none."""
    text = printable(text)
    return text if cell_len(text) <= width else set_cell_size(text, max(0, width - 1)) + "~"


def joined(lines: Iterable[Text], encoding: str) -> Any:
    """Return the lines as one picture, with a ? for each column of a character that the encoding lacks.

    An escape instead would be longer, and would move every column behind it.
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
