"""Collects every mistake in a file of nested tables, each as a sentence with its place."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from multidrop.printable import printable

T = TypeVar("T")


def read_document(path: Path, what: str) -> dict[str, Any]:
    """A TOML file's tables; ValueError, without the path, when there are none to be had.

    Some editors put a byte order mark before the text.
    """
    try:
        document = tomllib.loads(path.read_text("utf-8-sig"))
    except OSError as failure:
        raise ValueError(f"the {what} cannot be read: {failure.strerror}") from failure
    except UnicodeDecodeError as failure:
        raise ValueError(f"is not text in UTF-8, from byte {failure.start} on") from failure
    except RecursionError as failure:
        raise ValueError("is not TOML of ours: it is nested too deeply") from failure
    except ValueError as failure:
        raise ValueError(f"is not TOML: {failure}") from failure
    if not _fits(document):
        raise ValueError("is not TOML: a number does not fit into 64 bits")
    return document


def _fits(value: Any) -> bool:
    """Whether every number is one of TOML's, which has integers of 64 bits."""
    if isinstance(value, dict):
        return all(map(_fits, value.values()))
    if isinstance(value, list):
        return all(map(_fits, value))
    return not isinstance(value, int) or -(2**63) <= value < 2**63


@dataclass(frozen=True)
class Key:
    """What a table may hold under a name: its type, and an example of it that is right."""

    kind: type | tuple[type, ...]
    example: str
    needed: bool = False


@dataclass(frozen=True)
class TomlPlace:
    """Somewhere in the file; all places share the list of mistakes and of what must not come twice."""

    path: Path
    labels: tuple[str, ...] = ()
    mistakes: list[str] = field(default_factory=list)
    seen: dict[tuple[object, ...], str] = field(default_factory=dict)

    def inside(self, kind: str, tables: list[Any]) -> Iterator[tuple[Any, TomlPlace]]:
        """Each table with its own place, called by its name or else its number."""
        for number, table in enumerate(tables, 1):
            name = table.get("name") if isinstance(table, dict) else None
            label = f'{kind} "{name}"' if name and isinstance(name, str) else f"{kind} number {number}"
            yield table, TomlPlace(self.path, (*self.labels, label), self.mistakes, self.seen)

    def wrong(self, sentence: object) -> None:
        """This is a mistake. What a terminal would not print as it stands is spelt out."""
        text = ": ".join(filter(None, (", ".join(self.labels), str(sentence))))
        self.mistakes.append(f"{self.path}: {printable(text)}")

    def once(self, *what: object, sentence: str) -> None:
        """It is a mistake if this has been seen before; `{first}` in the sentence is where."""
        if what in self.seen:
            self.wrong(sentence.format(first=self.seen[what]))
        self.seen.setdefault(what, ", ".join(self.labels))

    def attempt(self, make: Callable[..., T], *arguments: Any, hint: str = "") -> T | None:
        """What it makes of the arguments; None if they are a mistake, whose sentence ends with the hint."""
        try:
            return make(*arguments)
        except (ValueError, TypeError) as mistake:
            self.wrong(f"{mistake}{hint}")
            return None

    def check(self, table: Any, keys: Mapping[str, Key]) -> dict[str, Any]:
        """Those entries of the table that have a known key and the right type."""
        if not isinstance(table, dict):
            self.wrong(f"{table!r} is not a table with {', '.join(keys)}")
            return {}
        meant = self._unknown(table, keys)
        good = {}
        for name, key in keys.items():
            value = table.get(name)
            if value is None:
                if key.needed and name not in meant:
                    self.wrong(f"{name!r} is missing; add {key.example}")
            elif isinstance(value, bool) or not isinstance(value, key.kind) or value in ("", []):
                self.wrong(f"{name} = {value!r} is not right; write {key.example}")
            elif isinstance(value, str) and not value.isprintable():
                self.wrong(f"{name} = {value!r} has characters that do not print; leave them out")
            else:
                good[name] = value
        return good

    def _unknown(self, table: Mapping[str, Any], keys: Mapping[str, Key]) -> set[str]:
        """Report the unknown keys; the known ones that they probably mean."""
        meant: set[str] = set()
        for name in [name for name in table if name not in keys]:
            near = difflib.get_close_matches(name, keys, n=1)
            meant.update(near)
            hint = f"did you mean {near[0]!r}?" if near else f"the keys here are {', '.join(keys)}"
            self.wrong(f"unknown key {name!r}; {hint}")
        return meant
