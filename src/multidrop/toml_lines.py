"""Find the line numbers of the keys in a TOML file, which tomllib does not report."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

# a table's path: for each level, the name of the table or array, and the table's number in the array
Steps = tuple[tuple[str, int], ...]
Lines = Mapping[tuple[Steps, str], int]


def line_numbers(path: Path) -> Lines:
    """Return the line numbers of a TOML file's keys, by table path and key name.

    The name "" stands for a table's header or an element of a list. A file that cannot be read has none.
    """
    try:
        # reading a serial port would block
        text = path.read_text("utf-8-sig", "replace") if path.is_file() else ""
    except OSError:
        return {}
    return _LineScan(text).lines


class _Unclosed(NamedTuple):
    """A list or an inline table whose closing bracket is still to come."""

    is_list: bool
    steps: Steps  # path of the inline table, or of the table that has the list
    name: str = ""  # name of the list; "" for an inline table
    number: int = 0  # number of the list's current element


_TOKEN = re.compile(
    r"""
    (?P<skipped>[ \t\r]+|\#[^\n]*)
    |(?P<mark>[][{}=,.\n])
    |(?P<quoted>\"{3}(?:\\.|[^\\])*?\"{3}|'{3}.*?'{3}|"(?:\\.|[^"\\\n])*"|'[^'\n]*')
    |(?P<bare>[^][{}=,.\s\#"']+|.)
    """,
    re.VERBOSE | re.DOTALL,
)


class _LineScan:
    """Finds the lines of keys, headers and elements in one pass. The text is assumed to be valid TOML."""

    def __init__(self, text: str) -> None:
        self.lines: dict[tuple[Steps, str], int] = {}
        self._counts: Counter[tuple[Steps, str]] = Counter()  # number of [[ARRAY]] headers so far
        self._table: Steps = ()  # the table of the latest header
        self._open: list[_Unclosed] = []
        self._parts: list[str] = []  # parts of the latest key or header
        self._brackets = 0  # number of open brackets in the header that is being read
        self._is_value = False  # inside the value of a key, not in a key
        self._number = 1
        for kind, token in self._tokens(text):
            self._take(kind, token)

    def _tokens(self, text: str) -> Iterator[tuple[str, str]]:
        for match in _TOKEN.finditer(text):
            kind = match.lastgroup or ""
            if kind != "skipped":
                yield kind, match[0]
            self._number += match[0].count("\n")

    def _take(self, kind: str, token: str) -> None:
        if kind != "mark":
            self._take_text(token.strip("\"'") if kind == "quoted" else token)
        elif self._brackets or (token == "[" and not (self._is_value or self._parts)):
            self._take_header(token)
        elif token == "=":
            self._end_key()
        elif token in "[{" and self._is_value:
            self._begin(is_list=token == "[")
        elif token in "]}" and self._open:
            self._open.pop()
            self._is_value = True
        elif token == "," and self._open:
            self._next_element()
        elif token == "\n" and not self._open:
            self._is_value = False
            self._parts = []

    def _take_text(self, text: str) -> None:
        if self._is_value:
            self._place()
        else:
            self._parts.append(text)

    def _take_header(self, token: str) -> None:
        self._brackets += token == "["
        if token != "]" or not self._parts:
            return
        *above, last = self._parts
        outer: Steps = ()
        for name in above:
            self.lines.setdefault((outer, name), self._number)
            outer = (*outer, (name, max(1, self._counts[outer, name])))
            self.lines.setdefault((outer, ""), self._number)
        self._counts[outer, last] += self._brackets == 2
        self._table = (*outer, (last, max(1, self._counts[outer, last])))
        self.lines.setdefault((outer, last), self._number)
        self.lines[self._table, ""] = self._number
        self._brackets, self._parts = 0, []

    def _end_key(self) -> None:
        steps = self._open[-1].steps if self._open else self._table
        for name in self._parts[:-1]:
            self.lines.setdefault((steps, name), self._number)
            steps = (*steps, (name, 1))
        for name in self._parts[-1:]:
            self.lines.setdefault((steps, name), self._number)
        self._key = steps, (self._parts or [""])[-1]
        self._is_value, self._parts = True, []

    def _place(self) -> Steps:
        """Return the path that a table has if it starts here. In a list, record the element's line number."""
        if not (self._open and self._open[-1].is_list):
            steps, name = self._key
            return (*steps, (name, 1))
        _, outer, name, number = self._open[-1]
        place = (*outer, (name, number))
        self.lines.setdefault((place, ""), self._number)
        return place

    def _begin(self, is_list: bool) -> None:
        place = self._place()
        if is_list:
            *outer, (name, _) = place
            self._open.append(_Unclosed(True, tuple(outer), name, 1))
        else:
            self._open.append(_Unclosed(False, place))
            self._is_value = False

    def _next_element(self) -> None:
        inner = self._open[-1]
        if inner.is_list:
            self._open[-1] = inner._replace(number=inner.number + 1)
        self._is_value = inner.is_list
