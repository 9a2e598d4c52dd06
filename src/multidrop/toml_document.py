"""Read TOML files, find the line numbers of their keys, and explain why a text is not TOML."""

from __future__ import annotations

import re
import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

MOST_PARTS = 100  # most parts that a dotted key may have


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
            raise DocumentError(f"the path is a device, not a {what}")
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
        raise DocumentError("the file is nested too deeply") from failure
    except tomllib.TOMLDecodeError as failure:
        line, sentence = syntax_mistake(text, str(failure))
        raise DocumentError(f"the file is not TOML: {sentence}", line) from failure
    except ValueError as failure:
        raise DocumentError(f"the file is not TOML: {failure}") from failure
    if not fits:
        raise DocumentError("the file is not TOML: a number does not fit into 64 bits")
    return document


def _decoded(data: bytes) -> str:
    if data.startswith((b"\xff\xfe", b"\xfe\xff")) or data[:4].count(0) == 2:
        raise DocumentError("the file is not text in UTF-8, but in UTF-16; save it as UTF-8")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as failure:
        at = failure.start
        sentence = f"the file is not text in UTF-8, from byte {at} on (0x{data[at]:02X}); save it as UTF-8"
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


# ---- explanations of mistakes ----


MOST_SHOWN = 40  # limit of the shown characters of a line
MOST_MATCHED = 1000  # limit of a line's characters: the time of some patterns grows with their square


class _Cause(NamedTuple):
    """A frequent mistake in TOML files, and its explanation."""

    message: str  # regular expression for tomllib's message
    line: str  # regular expression for the whole wrong line
    # The explanation. It may contain {first} (", first in line 5", if line 5 has the same key or header), and
    # {rest} (the part of the line from the wrong column on), and the names of groups in the pattern `line`.
    sentence: str


_KEY = r"\s*(?P<key>[\w.\"'-]+)\s*"
_END = r"\s*(#.*)?"
_ITEM = r"(\"[^\"]*\"|[\w.-]+)"
_WORD = r"(?P<value>[A-Za-z][\w .:/-]*?)\s*"
_TWICE = "twice|overwrite|mutate"
_VALUE = "Invalid value|Expected newline"
_HEADER = "write [{key}] or [[{key}]]"
_CAUSES = (
    _Cause("", r".*\r.*", "a line ends with CR alone; save the file with the line ends LF or CRLF"),
    _Cause(
        _TWICE,
        rf"\s*\[(?P<key>[^][]+)\]{_END}",
        "[{key}] is there twice{first}; write its keys below one header, or write each header as [[{key}]]",
    ),
    _Cause(
        _TWICE,
        rf"\s*\[\[(?P<key>[^][]+)\]\]{_END}",
        "[[{key}]] is also a single table{first}; write each of its headers in two brackets",
    ),
    _Cause(
        _TWICE, rf"{_KEY}=.*", "{key} is there twice{first}; keep one, or start a new table with its header"
    ),
    _Cause(
        r"character '\\n'|Expected '\"|Expected \"'|Unterminated", "", "a text is not closed; add a quote"
    ),
    _Cause("Illegal character", "", "a text has an invisible character; remove it"),
    _Cause("", ".*[\u00a0\u200b\u2028\ufeff].*", "the line has an invisible character; write the line again"),
    _Cause(
        "[Uu]nescaped|escape|hex value", "", "a backslash in a text starts a code; write / or two of them"
    ),
    _Cause(
        "",
        r"[^=]*[=[,]\s*[\u201c\u201d\u201e\u201f\u2018\u2019\u201a\u00ab\u00bb].*",
        'the line has typographic quotes; write them as in "text"',
    ),
    _Cause("Unclosed array", "", "a comma or a bracket is missing before {rest}"),
    _Cause("Unclosed inline", "", "a comma or a brace is missing before {rest}"),
    _Cause("initial", r"[^{]*\{[^}]*", "a table in braces is not closed; write the whole table in one line"),
    _Cause("Invalid value", r".*,\s*,.*", "a comma is there twice; keep one"),
    _Cause("", rf"{_KEY}:\s*(?P<value>.+)", "{key} has a colon; write {key} = {value}"),
    _Cause("Invalid value", rf"{_KEY}={_END}", "{key} has no value; write one after the ="),
    _Cause("", rf"\s*\[\[?\s*\]?{_END}", "a header has no name; write one in its brackets"),
    _Cause(
        "",
        rf"\s*\[(\[)?\s*(?P<key>[^][#]*?)\s*(?(1)\]?){_END}",
        f"a header lacks a bracket; {_HEADER}",
    ),
    _Cause(
        "",
        r"\s*(?=\[[^]]*\]\]|\[{3})\[+\s*(?P<key>[^][]*?)\s*(\].*)?",
        f"a header has too many brackets; {_HEADER}",
    ),
    _Cause(
        _VALUE,
        rf"{_KEY}=\s*(?P<value>True|False|TRUE|FALSE){_END}",
        "{value} is not a value; write {key} = true or {key} = false",
    ),
    _Cause(
        _VALUE,
        rf"{_KEY}=\s*(?P<whole>\d+),(?P<more>\d+){_END}",
        "{whole},{more} has a decimal comma; write {key} = {whole}.{more}",
    ),
    _Cause(_VALUE, rf"{_KEY}=\s*0+(?P<value>\d+){_END}", "the number starts with 0; write {key} = {value}"),
    _Cause(
        _VALUE,
        rf"{_KEY}=\s*[+-]?(\.\d+|\d+\.){_END}",
        "the number has no digit on one side of its point; write {key} = 0.5 or {key} = 5.0",
    ),
    _Cause(
        _VALUE,
        rf"{_KEY}=\s*(?P<value>{_ITEM}(\s*,\s*{_ITEM})+),?{_END}",
        "a list has no brackets; write {key} = [{value}]",
    ),
    _Cause(
        _VALUE,
        rf"{_KEY}=\s*(?P<value>yes|no|on|off|Yes|No|On|Off){_END}",
        '{value} is not a value; write {key} = true, {key} = false or {key} = "{value}"',
    ),
    _Cause(
        _VALUE,
        rf"{_KEY}=\s*(?P<value>(?!\d+(\.\d+)?\s*(us|ms|s|min|h|days?)\b)\d[^\"'#=\[\]{{}}]*?){_END}",
        '{value} is neither a number nor a text in quotes; write a number, or {key} = "{value}"',
    ),
    _Cause(
        _VALUE,
        rf"{_KEY}=\s*(?P<value>[^\"'\[{{\s#=][^\"'#=\[\]{{}}]*?){_END}",
        '{value} has no quotes; write {key} = "{value}"',
    ),
    _Cause("Invalid value", rf".*[=[,]\s*{_WORD}[],}}].*", '{value} has no quotes; write "{value}"'),
    _Cause("Expected newline", "", "{rest} does not belong here; write each key in its own line"),
    _Cause(
        "Expected '='|Invalid statement|initial",
        r"(?:.*[{,])?\s*(?P<key>[^\s\"'=]*[^\x00-\x7f\s\"'=][^\s\"'=]*)\s*=.*",
        'the key {key} has a letter other than a to z; write it in quotes: "{key}"',
    ),
    _Cause("Expected '='|Invalid statement", "", "the line is neither KEY = VALUE nor a [header]"),
)


def syntax_mistake(text: str, message: str) -> tuple[int, str]:
    """Return the number of the wrong line, and a sentence about it; `message` is that of tomllib."""
    lines = text.removesuffix("\n").split("\n")
    # split at the last " (at ", because a key may have this text too
    message, _, place = message.rpartition(" (at ")
    number, column = map(int, re.findall(r"\d+", place) or (len(lines) + 1, 1))
    rest = "the end of the file" if number > len(lines) else lines[number - 1][column - 1 :].strip()
    number = min(number, len(lines))
    wrong = lines[number - 1].rstrip("\r")[:MOST_MATCHED]
    for cause in _CAUSES:
        match = re.fullmatch(cause.line or ".*", wrong)
        if match and re.search(cause.message, message):
            facts = {name: _shown(part or "") for name, part in {**match.groupdict(), "rest": rest}.items()}
            return number, cause.sentence.format(**facts, first=_first(lines[: number - 1], wrong))
    return number, message


def _shown(text: str) -> str:
    return text if len(text) <= MOST_SHOWN else f"{text[:MOST_SHOWN]}..."


def _first(above: Sequence[str], wrong: str) -> str:
    """Return words that name the earlier line with the same key or header; "" if it is unknown."""
    is_header = wrong.lstrip().startswith("[")
    name = re.split("[]=]", wrong.strip(" \t["))[0].strip()
    same = re.compile((r"\s*\[+\s*" if is_header else r"\s*") + re.escape(name) + r"\s*[]=]")
    found = [number for number, line in enumerate(above, 1) if same.match(line)]
    return f", first in line {found[0 if is_header else -1]}" if found else ""


# ---- line numbers of keys, which tomllib does not report ----


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
