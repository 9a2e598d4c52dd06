"""Check a TOML file against the keys it may have; every error becomes a sentence with its place."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from ipaddress import ip_address
from pathlib import Path
from string import ascii_lowercase, digits
from typing import Any, TypeVar

from multidrop.printable import did_you_mean, is_number, masked, nearest_names, printable
from multidrop.toml_document import DocumentError, Lines, Steps, line_numbers

T = TypeVar("T")


@dataclass(frozen=True)
class Key:
    """A key that a table may have: the type of its value, an example, and keywords for its JSON Schema.

    If the value is a table, `keywords` may be the result of `json_schema`.
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


DRAFT = "http://json-schema.org/draft-07/schema#"  # the JSON Schema version that the schemas use


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


class ConfigError(str):
    """An error as text, with its place first; `sentence` lacks the place, `line` is the file's line or 0."""

    sentence: str
    line: int


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


SHOWN_ALIKE = 3  # up to this many errors with the same sentence are listed separately


@dataclass(frozen=True)
class TomlPlace:
    """A place in the file. All places share the errors found so far, and the names seen so far."""

    path: Path
    labels: tuple[str, ...] = ()
    config_errors: list[str] = field(default_factory=list)
    seen: dict[tuple[object, ...], str] = field(default_factory=dict)
    lines: Callable[[], Lines] = dict  # see `line_numbers`
    steps: Steps = ()

    @classmethod
    def in_file(cls, path: Path) -> TomlPlace:
        """Return the place of a whole file. For line numbers, the file is read at the first error."""
        return cls(path, lines=cache(partial(line_numbers, path)))

    def inside(self, kind: str, tables: list[Any], key: str = "") -> Iterator[tuple[Any, TomlPlace]]:
        """Yield each table of an array with its place. The label is `kind` and the table's name or number.

        `key` is the array's key in the file if it differs from `kind`.
        """
        for number, table in enumerate(tables, 1):
            name = table.get("name") if isinstance(table, dict) else None
            label = f'{kind} "{name}"' if name and isinstance(name, str) else f"{kind} number {number}"
            steps = (*self.steps, (key or kind, number))
            yield table, replace(self, labels=(*self.labels, label), steps=steps)

    def within(self, label: str, *tables: str) -> TomlPlace:
        """Return the place of a subtable at this path of keys. Error sentences call it `label`."""
        steps = (*self.steps, *((table, 1) for table in tables))
        return replace(self, labels=(*self.labels, label), steps=steps)

    def of_file(self, path: Path) -> TomlPlace:
        """Return the place of a whole other file, whose errors are added to the same list."""
        return TomlPlace(path, (), self.config_errors, self.seen)

    def wrong(self, sentence: object, key: str = "") -> None:
        """Add an error at this place, or at one of its keys.

        Unprintable characters are escaped, and passwords in URLs removed.
        """
        self._add(str(sentence), self._line(key or self._first_word(str(sentence))))

    def _add(self, sentence: str, line: int) -> None:
        text = ": ".join(filter(None, (", ".join(self.labels), sentence)))
        error = ConfigError(f"{self.path}{f':{line}' if line else ''}: {printable(masked(text))}")
        error.sentence, error.line = sentence, line
        self.config_errors.append(error)

    def _first_word(self, sentence: str) -> str:
        """Return the key with which a sentence such as "every = 5 is not right" starts; "" if none."""
        word = re.split(r"[^\w-]", sentence, maxsplit=1)[0]
        return word if (self.steps, word) in self.lines() else ""

    def _line(self, key: str) -> int:
        """Return the line number of a key, or else of the innermost table around it; 0 if unknown."""
        lines, steps = self.lines(), self.steps
        while True:
            for name in (key, ""):
                if (steps, name) in lines:
                    return lines[steps, name]
            if not steps:
                return 0
            *outer, (key, _) = steps
            steps = tuple(outer)

    def once(self, *what: object, sentence: str, key: str = "") -> None:
        """Add the error `sentence` if an earlier call had the same `what`.

        `{first}` in the sentence becomes the place of the first such call.
        """
        if what in self.seen:
            self.wrong(sentence.format(first=self.seen[what]), key)
        self.seen.setdefault(what, ", ".join(self.labels))

    def attempt(self, make: Callable[..., T], *arguments: Any, hint: str = "", key: str = "") -> T | None:
        """Return make(*arguments). If that raises ValueError or TypeError, add the error and return None.

        `hint` is appended to the error's text; `key` is the key whose value is wrong.
        """
        try:
            return make(*arguments)
        except DocumentError as mistake:
            self._add(str(mistake), mistake.line)
        except (ValueError, TypeError) as mistake:
            self.wrong(f"{mistake}{hint}", key)
        return None

    def check(self, table: Any, keys: Mapping[str, Key]) -> dict[str, Any]:
        """Return the entries with a known key and a valid value; add an error for every other entry."""
        if not isinstance(table, dict):
            self.wrong(f"{_shown(table)} is not a table with {', '.join(keys)}")
            return {}
        meant = self.unknown(table, keys)
        good = {}
        for name, key in keys.items():
            value = table.get(name)
            if value is None:
                if key.needed and name not in meant:
                    self.wrong(f"{name!r} is missing; add {key.example}")
            elif not key.takes(value):
                if name not in meant:
                    self.wrong(
                        f"{name} = {_shown(value)} is not right; write {_example(name, key, value)}", name
                    )
            elif isinstance(value, str) and not value.isprintable():
                self.wrong(f"{name} = {value!r} has unprintable characters; remove them", name)
            else:
                good[name] = value
        return good

    def unknown(self, table: Mapping[str, Any], keys: Mapping[str, object]) -> set[str]:
        """Add an error for each unknown key; return the known keys that were probably meant."""
        meant: set[str] = set()
        for name in [name for name in table if name not in keys]:
            synonyms = [known for known in _SYNONYMS.get(name.lower(), ()) if known in keys]
            hint = did_you_mean(name, keys, f"the keys here are {', '.join(keys)}", 1)
            if synonyms:
                hint = f"did you mean {synonyms[0]}?"
            meant.update(synonyms or nearest_names(name, keys, 1))
            self.wrong(f"unknown key {name!r}; {hint}", name)
        return meant


def _example(name: str, key: Key, value: Any) -> str:
    """Return what to write instead of an invalid value: the same number without quotes, or the example."""
    is_quoted = isinstance(value, str) and value.isascii() and value.isdecimal() and key.takes(int(value))
    return f"{name} = {int(value)}, without quotes" if is_quoted else key.example


# the words of pymodbus, minimalmodbus and other programs for keys of multidrop's files
_SYNONYMS: Mapping[str, tuple[str, ...]] = {
    **dict.fromkeys(("parity", "stopbits", "bytesize"), ("format",)),
    "baud": ("baudrate",),
    **dict.fromkeys(("slave", "slave_id", "unit", "unit_id", "device_id", "id"), ("address",)),
    **dict.fromkeys(("address", "addr", "register"), ("at",)),
    **dict.fromkeys(("type", "data_type", "datatype"), ("number_format", "model")),
    **dict.fromkeys(("scale", "factor", "multiplier"), ("step",)),
    **dict.fromkeys(("byte_order", "word_order"), ("order",)),
    **dict.fromkeys(("interval", "period"), ("every",)),
}


def _shown(value: Any) -> str:
    """Return a value as text for an error, without the end of a long table or list."""
    text = repr(value)
    return text if len(text) <= MOST_SHOWN or isinstance(value, str) else f"{text[:MOST_SHOWN]}..."


MOST_SHOWN = 60  # limit of a table's or a list's characters in an error
_SHORTEST, _LONGEST = 100e-6, 86400.0  # shortest and longest duration, in s
_DURATION = r"(\d+(?:\.\d+)?)\s*(us|ms|s|min|h)"
_TOO_SHORT = r"0*\d{0,2}(\.\d+)?\s*us"
_TOO_LONG = r"0*(2[5-9]|[3-9]\d|[1-9]\d{2,})(\.\d+)?\s*h"

# JSON Schema keywords for `Key.keywords`, each used by several keys.
DURATION: Mapping[str, Any] = {
    "pattern": rf"^\s*(?=[^a-z]*[1-9])(?!{_TOO_SHORT})(?!{_TOO_LONG}){_DURATION}\s*$"
}
SIZE: Mapping[str, Any] = {"pattern": r"^\s*\d+(\.\d+)?\s*(kB|MB|GB|TB)\s*$"}
ASCENDING: Mapping[str, Any] = {"allOf": [{"$ref": "#/definitions/ascending"}]}  # see `ascending`
DISTINCT: Mapping[str, Any] = {"allOf": [{"$ref": "#/definitions/distinct"}]}  # see `distinct`
PORT_NUMBER = r"([0-9]{1,4}|[1-5][0-9]{4}|6[0-4][0-9]{3}|65[0-4][0-9]{2}|655[0-2][0-9]|6553[0-5])"
_IPV6 = r"\[?[0-9A-Fa-f.]*:[0-9A-Fa-f:.]*(%[^\s\]]+)?\]?"
# unlike an IPv4 address, a host name does not end in a number
_HOST_NAME = r"([A-Za-z0-9_-]+\.)*[0-9]*[A-Za-z_-][A-Za-z0-9_-]*\.?"
_IPV4 = r"[0-9]{1,3}(\.[0-9]{1,3}){3}"
ADDRESS: Mapping[str, Any] = {"pattern": f"^({_IPV6}|{_HOST_NAME}|{_IPV4}):{PORT_NUMBER}$"}


def ascending() -> dict[str, Any]:
    """Return the JSON Schema of two numbers in ascending order.

    A JSON Schema can compare a number only with a constant. This schema has a list of constants: if the first
    number reaches a constant, the second number must reach it too.
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


def distinct() -> dict[str, Any]:
    """Return the JSON Schema "distinct", and the schemas to which it refers.

    It accepts tables such as { stopped = 0, running = 1 } if no two names have the same whole number. A JSON
    Schema cannot compare two values with each other. But it can divide the names into two groups by their
    first or last character: if a number occurs in one group, it must not occur in the other group. The schema
    does so with several divisions, so that most pairs of names are in different groups at least once.
    """
    letters = [f"{small}{small.upper()}" for small in ascii_lowercase]
    characters = [*letters, "_", *digits]
    halves = [
        ["".join(one for at, one in enumerate(characters) if (at >> bit & 1) == side) for side in (0, 1)]
        for bit in range(len(characters).bit_length())
    ]
    groups = [[form.format(half) for half in each] for form in ("^[{}]", "[{}]$") for each in halves]
    # Duplicates of other numbers are not found. Bits have no others, and named raw counts seldom have.
    numbers = range(16)
    parts: dict[str, Any] = {
        f"not-{number}": {"not": {"const": number, "description": f"another name has the number {number}"}}
        for number in numbers
    }
    rules = [
        {
            "if": {"not": {"patternProperties": {one: {"$ref": f"#/definitions/not-{number}"}}}},
            "then": {"patternProperties": {other: {"$ref": f"#/definitions/not-{number}"}}},
        }
        for number in numbers
        for one, other in groups
    ]
    return {"distinct": {"allOf": rules}, **parts}


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
