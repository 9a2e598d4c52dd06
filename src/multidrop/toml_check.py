"""Check a TOML file against the keys it may have; every error becomes a sentence with its place."""

from __future__ import annotations

import re
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from ipaddress import ip_address
from pathlib import Path
from typing import Any, TypeVar

from multidrop.printable import did_you_mean, is_number, masked, nearest_names, printable

T = TypeVar("T")

MOST_PARTS = 100  # limit of parts in a dotted key


def read_document(path: Path, what: str) -> dict[str, Any]:
    """Return the tables of a TOML file. If that fails, raises ValueError; its text does not name the path.

    A byte order mark before the text is skipped, because some editors write one. A device is refused: reading
    a serial port would block forever, and would take bytes from its drives.
    """
    try:
        if path.is_char_device():
            raise ValueError(f"is a device, not a {what}")
        data = path.read_bytes()
    except OSError as failure:
        raise ValueError(f"the {what} cannot be read: {failure.strerror}") from failure
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
    """Return the tables of a TOML file's bytes. Raises ValueError if the bytes are not valid TOML."""
    try:
        text = data.decode("utf-8-sig")
        _check_keys(text)
        document = tomllib.loads(text)
        fits = _fits(document)
    except UnicodeDecodeError as failure:
        raise ValueError(f"is not text in UTF-8, from byte {failure.start} on") from failure
    except RecursionError as failure:
        raise ValueError("is nested too deeply") from failure
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
            raise ValueError(f"a key or a text has more than {MOST_PARTS} dots")


def _fits(value: Any) -> bool:
    """Return True if every integer fits into 64 bits, as TOML requires."""
    if isinstance(value, dict):
        return all(map(_fits, value.values()))
    if isinstance(value, list):
        return all(map(_fits, value))
    return not isinstance(value, int) or -(2**63) <= value < 2**63


@dataclass(frozen=True)
class Key:
    """A key that a table may have: the type of its value, an example, and keywords for its JSON Schema.

    `keywords` of a table may be the result of `json_schema`.
    """

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


DRAFT = "http://json-schema.org/draft-07/schema#"  # the version of JSON Schema


def json_schema(keys: Mapping[str, Key], **more: Any) -> dict[str, Any]:
    """Return the JSON Schema (draft 7) of a table with these keys, for editors; `more` are more keywords."""
    return {
        "type": "object",
        "properties": {name: _key_schema(key) for name, key in keys.items()},
        "required": [name for name, key in keys.items() if key.needed],
        "additionalProperties": False,
        **more,
    }


def _key_schema(key: Key) -> dict[str, Any]:
    kinds = [_TYPES[kind] for kind in (key.kind if isinstance(key.kind, tuple) else (key.kind,))]
    alternatives = dict(kinds[0]) if len(kinds) == 1 else {"anyOf": kinds}
    return {**alternatives, **key.keywords, "description": key.example}


# a table's path: for each level, the name of the array, and the table's number in it
Steps = tuple[tuple[str, int], ...]


class ConfigError(str):
    """An error as text, with its place first; `sentence` lacks the place, `line` is the file's line or 0."""

    sentence: str
    line: int


def line_numbers(path: Path) -> dict[tuple[Steps, str], int]:
    """Return the line numbers of keys, by their table's path and their name; "" is the table's header."""
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
    """Return the errors, but merge those with the same sentence if there are more than SHOWN_ALIKE.

    The merged error states their number.
    """
    alike = Counter(getattr(error, "sentence", error) for error in errors)
    found: dict[str, str] = {}
    for error in errors:
        sentence = getattr(error, "sentence", error)
        if alike[sentence] <= SHOWN_ALIKE:
            found[error] = error
        elif sentence not in found:
            found[sentence] = f"{error}; the same in {alike[sentence] - 1} more places"
    return tuple(found.values())


SHOWN_ALIKE = 3  # limit up to which errors with the same sentence are shown separately


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
        """Return a place inside this place, with these labels appended."""
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
        """Add the error `sentence` if `what` was seen before.

        `{first}` in the sentence becomes the first place of `what`.
        """
        if what in self.seen:
            self.wrong(sentence.format(first=self.seen[what]))
        self.seen.setdefault(what, ", ".join(self.labels))

    def attempt(self, make: Callable[..., T], *arguments: Any, hint: str = "", key: str = "") -> T | None:
        """Return make(*arguments). If that raises ValueError or TypeError, add the error and return None.

        `hint` is appended to the error's text; `key` is the key whose value is wrong.
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
            hint = did_you_mean(name, keys, f"the keys here are {', '.join(keys)}", 1)
            meant.update(nearest_names(name, keys, 1))
            self.wrong(f"unknown key {name!r}; {hint}", name)
        return meant


_SHORTEST, _LONGEST = 100e-6, 86400.0  # limits of a duration in s
_DURATION = r"(\d+(?:\.\d+)?)\s*(us|ms|s|min|h)"
_TOO_SHORT = r"0*\d{0,2}(\.\d+)?\s*us"
_TOO_LONG = r"0*(2[5-9]|[3-9]\d|[1-9]\d{2,})(\.\d+)?\s*h"

# JSON Schema keywords for `Key.keywords`. Several keys share each of these.
DURATION: Mapping[str, Any] = {
    "pattern": rf"^\s*(?=[^a-z]*[1-9])(?!{_TOO_SHORT})(?!{_TOO_LONG}){_DURATION}\s*$"
}
SIZE: Mapping[str, Any] = {"pattern": r"^\s*\d+(\.\d+)?\s*(kB|MB|GB|TB)\s*$"}
ASCENDING: Mapping[str, Any] = {"allOf": [{"$ref": "#/definitions/ascending"}]}  # see `ascending`
PORT_NUMBER = r"([0-9]{1,4}|[1-5][0-9]{4}|6[0-4][0-9]{3}|65[0-4][0-9]{2}|655[0-2][0-9]|6553[0-5])"
_IPV6 = r"\[?[0-9A-Fa-f.]*:[0-9A-Fa-f:.]*(%[^\s\]]+)?\]?"
_HOST_NAME = r"([A-Za-z0-9_-]+\.)*[0-9]*[A-Za-z_-][A-Za-z0-9_-]*\.?"  # its last label is not only digits
_IPV4 = r"[0-9]{1,3}(\.[0-9]{1,3}){3}"
ADDRESS: Mapping[str, Any] = {"pattern": f"^({_IPV6}|{_HOST_NAME}|{_IPV4}):{PORT_NUMBER}$"}


def ascending() -> dict[str, Any]:
    """Return the JSON Schema of two numbers in ascending order.

    A JSON Schema cannot compare two numbers. It can only compare both with some limits: if the first number
    is at least a limit, so is the second.
    """
    powers = [sign * digit * 10**power for power in range(7) for digit in (1, 2, 5) for sign in (-1, 1)]
    limits = sorted({0, *powers, *(power / 1000 for power in powers)})
    return {
        "allOf": [
            {
                "if": {"items": [{"type": "number", "minimum": limit}]},
                "then": {"items": [{}, {"minimum": limit}]},
            }
            for limit in limits
        ]
    }


def parse_address(text: str, example: str) -> tuple[str, int]:
    """Return host and port of a text such as "127.0.0.1:8750" or "[::1]:8750".

    Raises ValueError for any other text; `example` is a valid setting, such as 'listen = "127.0.0.1:8750"'.
    """
    host, _, port = text.rpartition(":")
    host = host[1:-1] if host.startswith("[") and host.endswith("]") else host
    if not _is_host(host) or not re.fullmatch(r"[0-9]{1,5}", port) or int(port) > 65535:
        raise ValueError(f'"{text}" is not an address and port; write {example}')
    return host, int(port)


def _is_host(text: str) -> bool:
    try:
        return bool(re.fullmatch(_HOST_NAME, text) or ip_address(text))
    except ValueError:
        return False


def duration_up_to(digits: int) -> dict[str, Any]:
    """Return the JSON Schema keywords of a duration of at most 10 to the power of `digits` seconds."""
    more = rf"[1-9]\d{{{digits + 1},}}|[2-9]\d{{{digits}}}|1(?!0{{{digits}}})\d{{{digits}}}"
    longer = rf"^\s*(0*({more})(\.\d+)?\s*s|\d*[1-9]\d*(\.\d+)?\s*(min|h))\s*$"
    return {**DURATION, "not": {"pattern": longer}}


def parse_duration(text: str) -> float:
    """Return the seconds of a duration such as "50 ms". Raises ValueError if the duration is invalid."""
    match = re.fullmatch(_DURATION, str(text).strip(), re.ASCII)
    units = {"us": 1e-6, "ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0}
    seconds = float(match[1]) * units[match[2]] if match else 0
    if not _SHORTEST <= seconds <= _LONGEST:
        raise ValueError(f'{text!r} is not a duration from 100 us to 24 h, such as "50 ms", "2 s" or "1 min"')
    return seconds


def check_period(seconds: float) -> None:
    """Raise ValueError unless this is a valid period in s for a plant file."""
    if not is_number(seconds) or not _SHORTEST <= seconds <= _LONGEST:
        raise ValueError(f"every = {seconds!r} is not a number of seconds from 0.0001 to 86400, or None")


def duration_of(given: Mapping[str, Any], key: str, place: TomlPlace) -> float | None:
    """Return the duration under this key in s; None if it is missing or invalid. Add an error if invalid."""
    return place.attempt(_duration_under, key, given[key], key=key) if key in given else None


def _duration_under(key: str, text: str) -> float:
    try:
        return parse_duration(text)
    except ValueError as mistake:
        raise ValueError(f"{key} = {mistake}") from mistake
