"""A device as an importer found it: registers with their gaps, and what could not be carried over."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from multidrop.drive.family import TAKEN_NAMES
from multidrop.family_file.names import OF_ENUMERATIONS, unusable
from multidrop.importers.line_settings import UNKNOWN_LINE, LineSettings

WRITTEN = "it is written there; what a write does is not known here"
ONLY_WRITTEN = "is only written: a command is never imported"
MOST_ENTRIES = 20_000  # of one file
_LONGEST_NAME = 50
_TAKEN = TAKEN_NAMES | {"declared_verbs", "is_jogged"}


@dataclass
class ImportedRegister:
    """One register; its address is the one that is sent. `gaps` are sentences about what is not known.

    `lacks` is what its value needs and a register cannot say: only the raw count is carried over. A family
    file gets readings alone; what is written elsewhere is noted for whoever asks how much a register holds.
    """

    name: str
    address: int
    table: str = "holding"
    details: dict[str, Any] = field(default_factory=dict)  # by the keys of a family file, in this order
    gaps: list[str] = field(default_factory=list)
    lacks: str = ""
    is_read: bool = True
    is_written: bool = False
    of_writes: dict[str, Any] = field(default_factory=dict)  # details that a written register has besides

    def note_write(self, *, is_written: bool = True) -> None:
        """Note that the other program writes it too: a gap, because nothing is known of what that does."""
        self.is_written = is_written
        if is_written:
            self.gaps.append(WRITTEN)


@dataclass(frozen=True)
class Lost:
    """An entry that could not be carried over, or with `is_entry` false another fact; and why."""

    name: str
    reason: str
    is_entry: bool = True

    def __str__(self) -> str:
        return f"{self.name}: {self.reason}" if self.name else self.reason


@dataclass
class ImportedDevice:
    """A device: what is read of it, what is only written, and what could not be carried over."""

    title: str = ""
    address: int | None = None
    registers: list[ImportedRegister] = field(default_factory=list)
    texts: list[ImportedRegister] = field(default_factory=list)
    commands: list[ImportedRegister] = field(default_factory=list)
    lost: list[Lost] = field(default_factory=list)
    readable: range = range(0)  # holding registers, of which any may be read across
    together: int = 0  # registers that one request may read; 0 is not stated
    line: LineSettings = UNKNOWN_LINE
    names: UniqueNames = field(default_factory=lambda: UniqueNames())

    def add(self, found: ImportedRegister, *, is_text: bool = False) -> None:
        """Add a register under a name that no other has; what cannot be one is lost."""
        if isinstance(found.address, bool) or not isinstance(found.address, int):
            self.lose(found.name, f"its address {str(found.address)[:40]!r} is no whole number")
            return
        if not 0 <= found.address <= 0xFFFF:
            self.lose(found.name, "its address is none from 0 to 65535")
            return
        spelt, found.name = found.name, self.names.free(found.name)
        if not found.is_read:
            self.lose(spelt, ONLY_WRITTEN)
            self.commands.append(found)
            return
        if spelt != found.name and "note" not in found.details and not is_text:
            found.details["note"] = spelt
        (self.texts if is_text else self.registers).append(found)

    def lose(self, name: str, reason: str, *, is_entry: bool = True) -> None:
        """Note what could not be carried over, and why."""
        self.lost.append(Lost(name, reason, is_entry))

    @contextmanager
    def entry(self, name: str) -> Iterator[None]:
        """Lose the entry where reading it fails, not its file. Raises ValueError for too many entries."""
        if len(self.registers) + len(self.texts) + len(self.lost) >= MOST_ENTRIES:
            raise ValueError(f"has more than {MOST_ENTRIES} entries, which no device has")
        try:
            yield
        except (KeyError, AttributeError, TypeError, ValueError, OverflowError, IndexError) as failure:
            self.lose(name, f"it cannot be read: {type(failure).__name__} {str(failure)[:100]}")


class UniqueNames:
    """Names for Python that are as near as can be to what was spelt, each given once."""

    def __init__(self, taken: Collection[str] = _TAKEN) -> None:
        self._taken = taken
        self._given = Counter[str]()

    def free(self, spelt: str) -> str:
        name = re.sub(r"[^A-Za-z0-9]+", "_", spelt[:200]).strip("_").lower()[:_LONGEST_NAME] or "register"
        if unusable(name) or name in self._taken:
            name = f"r_{name}"
        free = name
        while free in self._given:
            self._given[name] += 1
            free = f"{name}_{self._given[name]}"
        self._given[free] = 1
        return free


def unit_address(given: Any) -> int | None:
    """Return a device's address on the line; None where it is none."""
    if isinstance(given, str) and given.strip().isdecimal():
        given = int(given.strip()[:6])
    is_one = isinstance(given, int) and not isinstance(given, bool) and 1 <= given <= 247
    return given if is_one else None


def names_of(pairs: Mapping[str, Any]) -> dict[str, int]:
    """Return the numbers of named values, or of bits, under names that an enumeration can have.

    Two of one number are one: the first name stands.
    """
    names, found = UniqueNames(OF_ENUMERATIONS), dict[str, int]()
    for spelt, number in pairs.items():
        if isinstance(number, bool) or not isinstance(number, int) or number in found.values():
            continue
        found[names.free(str(spelt))] = number
    return found
