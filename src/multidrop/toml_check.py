"""Check a TOML file against the keys it may have; every error becomes a sentence with its place."""

from __future__ import annotations

import difflib
import re
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

from multidrop.printable import masked, printable

T = TypeVar("T")

MOST_PARTS = 100  # limit of parts in a dotted key


def read_document(path: Path, what: str) -> dict[str, Any]:
    """Return the tables of a TOML file. Raises ValueError, whose text lacks the path, if it cannot be read.

    A byte order mark before the text is skipped, because some editors write one. A device is refused: reading
    a serial port would block forever, and would take bytes from its drives.
    """
    try:
        if path.is_char_device():
            raise ValueError(f"is a device, and no {what}")
        data = path.read_bytes()
    except OSError as failure:
        raise ValueError(f"the {what} cannot be read: {failure.strerror}") from failure
    return parse_document(data)


def read_bounded(path: Path, most: int, what: str) -> bytes:
    """Return a file's bytes, at most `most`. Raises ValueError, whose text lacks the path, if that fails."""
    try:
        with path.open("rb") as file:
            data = file.read(most + 1)
    except OSError as failure:
        raise ValueError(f"the {what} cannot be read: {failure.strerror}") from failure
    if len(data) > most:
        raise ValueError(f"the {what} has more than {most} bytes")
    return data


def parse_document(data: bytes) -> dict[str, Any]:
    """Return the tables of a TOML file's bytes. Raises ValueError if they are not valid TOML."""
    try:
        text = data.decode("utf-8-sig")
        _check_keys(text)
        document = tomllib.loads(text)
        fits = _fits(document)
    except UnicodeDecodeError as failure:
        raise ValueError(f"is not text in UTF-8, from byte {failure.start} on") from failure
    except RecursionError as failure:
        raise ValueError("is not TOML of ours: it is nested too deeply") from failure
    except ValueError as failure:
        raise ValueError(f"is not TOML: {failure}") from failure
    if not fits:
        raise ValueError("is not TOML: a number does not fit into 64 bits")
    return document


def _check_keys(text: str) -> None:
    """Raise ValueError for a key with very many parts: tomllib's time grows with their number squared."""
    if text.count(".") > MOST_PARTS:
        pieces = re.split(r"[=,{}\[\]\n]+", text)
        if any(piece.count(".") > MOST_PARTS for piece in pieces):
            raise ValueError(f"a key or a text has more than {MOST_PARTS} points")


def _fits(value: Any) -> bool:
    """Return True if every integer fits into 64 bits, as TOML requires."""
    if isinstance(value, dict):
        return all(map(_fits, value.values()))
    if isinstance(value, list):
        return all(map(_fits, value))
    return not isinstance(value, int) or -(2**63) <= value < 2**63


@dataclass(frozen=True)
class Key:
    """A key that a table may have: the type of its value, an example, and keywords for its JSON Schema."""

    kind: type | tuple[type, ...]
    example: str
    needed: bool = False
    keywords: Mapping[str, Any] = field(default_factory=dict)

    def takes(self, value: Any) -> bool:
        """Return True for a non-empty value of the key's type. true and false are not numbers."""
        if isinstance(value, bool):
            return self.kind is bool
        return isinstance(value, self.kind) and value not in ("", [])


_TYPES: Mapping[type, Mapping[str, Any]] = {
    str: {"type": "string", "minLength": 1},
    int: {"type": "integer"},
    float: {"type": "number"},
    bool: {"type": "boolean"},
    list: {"type": "array", "minItems": 1},
    dict: {"type": "object"},
}


def json_schema(keys: Mapping[str, Key]) -> dict[str, Any]:
    """Return the JSON Schema of a table with these keys, for editors."""
    return {
        "type": "object",
        "properties": {name: _key_schema(key) for name, key in keys.items()},
        "required": [name for name, key in keys.items() if key.needed],
        "additionalProperties": False,
    }


def _key_schema(key: Key) -> dict[str, Any]:
    kinds = [_TYPES[kind] for kind in (key.kind if isinstance(key.kind, tuple) else (key.kind,))]
    alternatives = dict(kinds[0]) if len(kinds) == 1 else {"anyOf": kinds}
    return {**alternatives, **key.keywords, "description": key.example}


Steps = tuple[tuple[str, int], ...]  # a table's path: for each level, the array's name and the table's number


class ConfigError(str):
    """An error with its place at the start; `sentence` is the rest, `line` the file's line or 0."""

    sentence: str
    line: int


def line_numbers(path: Path) -> dict[tuple[Steps, str], int]:
    """Return the line number of each key by its table's path and its name; "" means the table's header."""
    if not path.is_file():  # reading a serial port would block
        return {}
    found: dict[tuple[Steps, str], int] = {}
    counts: Counter[tuple[Steps, str]] = Counter()
    steps: Steps = ()
    for number, line in enumerate(path.read_text("utf-8-sig", "replace").splitlines(), 1):
        if header := _HEADER.match(line):
            *above, last = header[1].split(".")
            outer = tuple(step for name, step in zip(above, steps, strict=False) if name == step[0])
            counts[outer, last] += 1
            steps = (*outer, (last, counts[outer, last]))
            found[steps, ""] = number
        elif entry := _ENTRY.match(line):
            found.setdefault((steps, entry[1]), number)
    return found


_HEADER = re.compile(r"\s*\[\[?\s*([\w.-]+)\s*\]")
_ENTRY = re.compile(r"\s*([\w-]+)\s*=")


def grouped(errors: Sequence[str]) -> tuple[str, ...]:
    """Return the errors; of more than SHOWN_ALIKE with the same sentence, only one, with their number."""

    alike = Counter(getattr(error, "sentence", error) for error in errors)
    found: dict[str, str] = {}
    for error in errors:
        sentence = getattr(error, "sentence", error)
        if alike[sentence] <= SHOWN_ALIKE:
            found[error] = error
        elif sentence not in found:
            found[sentence] = f"{error}; the same in {alike[sentence] - 1} more places"
    return tuple(found.values())


SHOWN_ALIKE = 3  # limit of errors with the same sentence that are shown separately


@dataclass(frozen=True)
class TomlPlace:
    """A place in the file. All places share the errors found so far, and the names seen so far."""

    path: Path
    labels: tuple[str, ...] = ()
    config_errors: list[str] = field(default_factory=list)
    seen: dict[tuple[object, ...], str] = field(default_factory=dict)
    lines: Callable[[], Mapping[tuple[Steps, str], int]] = dict  # see `line_numbers`
    steps: Steps = ()

    def inside(self, kind: str, tables: list[Any]) -> Iterator[tuple[Any, TomlPlace]]:
        """Yield each table with its place, which is labelled with the table's name or else its number."""
        for number, table in enumerate(tables, 1):
            name = table.get("name") if isinstance(table, dict) else None
            label = f'{kind} "{name}"' if name and isinstance(name, str) else f"{kind} number {number}"
            yield table, replace(self, labels=(*self.labels, label), steps=(*self.steps, (kind, number)))

    def within(self, *labels: str) -> TomlPlace:
        """Return a place inside this one."""
        return replace(self, labels=(*self.labels, *labels))

    def of_file(self, path: Path, *labels: str) -> TomlPlace:
        """Return a place in another file that this file refers to; its errors are added to the same list."""
        return TomlPlace(path, labels, self.config_errors, self.seen)

    def wrong(self, sentence: object, key: str = "") -> None:
        """Add an error at this place, or at one of its keys.

        Unprintable characters are escaped, and passwords in URLs removed.
        """
        line = self._line(key)
        text = ": ".join(filter(None, (", ".join(self.labels), str(sentence))))
        error = ConfigError(f"{self.path}{f':{line}' if line else ''}: {printable(masked(text))}")
        error.sentence, error.line = str(sentence), line
        self.config_errors.append(error)

    def _line(self, key: str) -> int:
        """Return the line of a key or its table, or of the key that holds this place; 0 if it is unknown."""
        places = [(self.steps, key), (self.steps, "")]
        if self.steps:
            *outer, (name, _) = self.steps
            places += [(tuple(outer), name), (tuple(outer), "")]
        lines = self.lines()
        return next((lines[place] for place in places if place in lines), 0)

    def once(self, *what: object, sentence: str) -> None:
        """Add an error if `what` was seen before; `{first}` in the sentence becomes the first place."""
        if what in self.seen:
            self.wrong(sentence.format(first=self.seen[what]))
        self.seen.setdefault(what, ", ".join(self.labels))

    def attempt(self, make: Callable[..., T], *arguments: Any, hint: str = "", key: str = "") -> T | None:
        """Return make(*arguments). If that raises ValueError or TypeError, add the error and return None.

        `hint` is appended to the error's text; `key` is the key with the error.
        """
        try:
            return make(*arguments)
        except (ValueError, TypeError) as mistake:
            self.wrong(f"{mistake}{hint}", key)
            return None

    def check(self, table: Any, keys: Mapping[str, Key]) -> dict[str, Any]:
        """Return the entries with a known key and a valid value; add an error for every other entry."""
        if not isinstance(table, dict):
            self.wrong(f"{table!r} is not a table with {', '.join(keys)}")
            return {}
        meant = self.unknown(table, keys)
        good = {}
        for name, key in keys.items():
            value = table.get(name)
            if value is None:
                if key.needed and name not in meant:
                    self.wrong(f"{name!r} is missing; add {key.example}")
            elif not key.takes(value):
                self.wrong(f"{name} = {value!r} is not right; write {key.example}", name)
            elif isinstance(value, str) and not value.isprintable():
                self.wrong(f"{name} = {value!r} has characters that do not print; leave them out", name)
            else:
                good[name] = value
        return good

    def unknown(self, table: Mapping[str, Any], keys: Mapping[str, object]) -> set[str]:
        """Add an error for each unknown key; return the known keys that were probably meant."""
        meant: set[str] = set()
        for name in [name for name in table if name not in keys]:
            near = difflib.get_close_matches(name, keys, n=1)
            meant.update(near)
            hint = f"did you mean {near[0]!r}?" if near else f"the keys here are {', '.join(keys)}"
            self.wrong(f"unknown key {name!r}; {hint}", name)
        return meant


_DURATION = r"(\d+(?:\.\d+)?)\s*(us|ms|s|min|h)"
DURATION: Mapping[str, Any] = {"pattern": rf"^\s*(?=.*[1-9]){_DURATION}\s*$"}  # JSON Schema


def parse_duration(text: str) -> float:
    """Return the seconds of a duration such as "50 ms". Raises ValueError if it is not a valid one."""
    match = re.fullmatch(_DURATION, str(text).strip(), re.ASCII)
    units = {"us": 1e-6, "ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0}
    seconds = float(match[1]) * units[match[2]] if match else 0
    if not _SHORTEST <= seconds <= _LONGEST:
        raise ValueError(f'{text!r} is not a duration from 100 us to 24 h, such as "50 ms", "2 s" or "1 min"')
    return seconds


def check_period(seconds: float) -> None:
    """Raise ValueError unless this is a valid period in s for a plant file."""
    is_number = isinstance(seconds, (int, float)) and not isinstance(seconds, bool)
    if not is_number or not _SHORTEST <= seconds <= _LONGEST:
        raise ValueError(f"every = {seconds!r} is not a number of seconds from 0.0001 to 86400, or None")


def duration_of(given: Mapping[str, Any], key: str, place: TomlPlace) -> float | None:
    """Return the duration under this key in s; None if it is missing or invalid. Add an error if invalid."""

    return place.attempt(_duration_under, key, given[key], key=key) if key in given else None


def _duration_under(key: str, text: str) -> float:
    try:
        return parse_duration(text)
    except ValueError as mistake:
        raise ValueError(f"{key} = {mistake}") from mistake


_SHORTEST, _LONGEST = 100e-6, 86400.0  # s
