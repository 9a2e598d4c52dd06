"""Read TOML files: their tables, and the line numbers of their keys."""

from __future__ import annotations

import re
import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from multidrop.toml_syntax import syntax_mistake

MOST_PARTS = 100  # limit of parts in a dotted key

# a table's path: for each level, the name of the table or array, and the table's number in the array
Steps = tuple[tuple[str, int], ...]
Lines = Mapping[tuple[Steps, str], int]


class DocumentError(ValueError):
    """Raised for a file that is not TOML.

    Its text does not name the file. `line` is the number of the line with the mistake; 0 if unknown.
    """

    def __init__(self, sentence: str, line: int = 0) -> None:
        super().__init__(sentence)
        self.line = line

    def in_file(self, path: Path) -> str:
        """Return the sentence with the file's path and the line in front."""
        return f"{path}{f':{self.line}' if self.line else ''}: {self}"


def read_document(path: Path, what: str) -> dict[str, Any]:
    """Return the tables of a TOML file. If that fails, raises ValueError; its text does not name the path.

    A byte order mark before the text is skipped, because some editors write one. A device is refused: reading
    a serial port would block forever, and would take bytes from its drives.
    """
    try:
        if path.is_char_device():
            raise DocumentError(f"is a device, not a {what}")
        data = path.read_bytes()
    except OSError as failure:
        raise DocumentError(f"the {what} cannot be read: {failure.strerror}") from failure
    return parse_document(data)


def read_bounded(path: Path, most: int, what: str) -> bytes:
    """Return a file's bytes, at most `most`. If that fails, raises ValueError; its text lacks the path."""
    try:
        with path.open("rb") as file:
            data = file.read(most + 1)
    except OSError as failure:
        raise ValueError(f"the {what} cannot be read: {failure.strerror}") from failure
    if len(data) > most:
        raise ValueError(f"the {what} has more than {most} bytes")
    return data


def parse_document(data: bytes) -> dict[str, Any]:
    """Return the tables of a TOML file's bytes. Raises DocumentError if the bytes are not valid TOML."""
    text = _decoded(data)
    try:
        _check_keys(text)
        document = tomllib.loads(f"{text}\n")
        fits = _fits(document)
    except RecursionError as failure:
        raise DocumentError("is nested too deeply") from failure
    except tomllib.TOMLDecodeError as failure:
        line, sentence = syntax_mistake(text, str(failure))
        raise DocumentError(f"is not TOML: {sentence}", line) from failure
    except ValueError as failure:
        raise DocumentError(f"is not TOML: {failure}") from failure
    if not fits:
        raise DocumentError("is not TOML: a number does not fit into 64 bits")
    return document


def _decoded(data: bytes) -> str:
    if data.startswith((b"\xff\xfe", b"\xfe\xff")) or data[:4].count(0) == 2:
        raise DocumentError("is not text in UTF-8, but in UTF-16; save it as UTF-8")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as failure:
        at = failure.start
        sentence = f"is not text in UTF-8, from byte {at} on (0x{data[at]:02X}); save it as UTF-8"
        raise DocumentError(sentence, 1 + data[:at].count(b"\n")) from failure


def _check_keys(text: str) -> None:
    """Raise ValueError for a key with very many parts: tomllib's time grows with their number squared."""
    if text.count(".") > MOST_PARTS:
        pieces = re.split(r"[=,{}\[\]\n]+", text)
        if any(piece.count(".") > MOST_PARTS for piece in pieces):
            raise ValueError(f"a key or a text has more than {MOST_PARTS} dots")


def _fits(value: Any) -> bool:
    """Return True if every integer fits into 64 bits, as TOML requires."""
    if isinstance(value, dict):
        return all(map(_fits, value.values()))
    if isinstance(value, list):
        return all(map(_fits, value))
    return not isinstance(value, int) or -(2**63) <= value < 2**63


# ---- line numbers ----


def line_numbers(path: Path) -> Lines:
    """Return the line numbers of a TOML file's keys, by their table's path and their name.

    The name "" stands for a table's header or an element of a list. A file that cannot be read has none.
    """
    try:
        text = path.read_text("utf-8-sig", "replace") if path.is_file() else ""  # a port would block
    except OSError:
        return {}
    return _LineScan(text).lines


class _Unclosed(NamedTuple):
    """A list or an inline table that is not closed yet."""

    is_list: bool
    steps: Steps  # of an inline table; of a list: of the table that has the list
    name: str = ""  # of a list
    number: int = 0  # of a list's current element


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
        self._counts: Counter[tuple[Steps, str]] = Counter()  # of [[ARRAY]] headers
        self._table: Steps = ()  # the table of the latest header
        self._open: list[_Unclosed] = []
        self._parts: list[str] = []  # parts of the latest key or header
        self._brackets = 0  # of the header that is being read
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
        """Record the line of a list's element; return the path that a table has here."""
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
