"""A whole recording in memory, as one series for each register of each drive."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from multidrop.polling.batch import Row
from multidrop.recording import open_reader

RAW = "raw count"  # the unit where no document states the scale
LARGEST = 1e150  # of what can be drawn: axes reckon with differences and products
LATEST_NS = 230 * 365 * 86400 * 10**9  # UTC: beyond that no date is reckoned with
LARGEST_COUNT = 2**53  # that a column of values can hold exactly
Array = NDArray[Any]


@dataclass(frozen=True)
class TimeSpan:
    """From when to when, in ns UTC, something was so."""

    begin: int
    end: int
    what: str


@dataclass(frozen=True, eq=False)
class Series:
    """One register of one drive: a value, or NaN where it was missed, for each time it was due."""

    drive: str
    register: str
    time: Array  # int64, ns UTC
    value: Array  # float64
    uncertainty: Array  # float64, ns
    status: Array  # int, into `statuses`
    statuses: tuple[str, ...]
    meaning: Mapping[str, Any]

    @cached_property
    def missed(self) -> Array:
        return np.asarray(np.isnan(self.value))

    @property
    def has_values(self) -> bool:
        return not self.missed.all()

    @cached_property
    def drawable(self) -> Array:
        """Its values, and NaN also for those that are too large for a picture."""
        return np.where(np.abs(self.value) < LARGEST, self.value, np.nan)

    @cached_property
    def names(self) -> dict[int, str]:
        """What its counts mean, where they have names."""
        names: Mapping[str, int] = self.meaning.get("values") or {}
        return {number: name for name, number in names.items()}

    @property
    def is_bits(self) -> bool:
        """Its count is a sum of bits, each with a meaning of its own."""
        return bool(self.names) and self.meaning.get("bits") is True

    @property
    def unit(self) -> str:
        """As it stands beside an axis; a register whose scale no document states has raw counts."""
        if self.names:
            return ""
        if "step" in self.meaning and self.meaning["step"] is None:
            return RAW
        return str(self.meaning.get("unit") or "")

    def reasons(self) -> Counter[str]:
        """Misses by reason."""
        numbers, counts = np.unique(self.status[self.missed], return_counts=True)
        return Counter(
            {self.statuses[number]: int(count) for number, count in zip(numbers, counts, strict=True)}
        )

    def faults(self) -> list[TimeSpan]:
        """When it was not 0, for a register of faults; a miss says nothing, and ends no fault."""
        there = ~self.missed
        time, value = self.time[there], self.value[there]
        if not len(time):
            return []
        changes = np.flatnonzero(value[1:] != value[:-1]) + 1
        begins = [0, *changes.tolist()]
        ends = [*changes.tolist(), len(time) - 1]
        return [
            TimeSpan(int(time[begin]), int(time[end]), self.name_of(value[begin]))
            for begin, end in zip(begins, ends, strict=True)
            if value[begin] != 0
        ]

    def name_of(self, value: float) -> str:
        """The name of a count; of bits those that are set; or the number itself."""
        if not value.is_integer() or not 0 <= value < LARGEST_COUNT:
            return f"code {value:g}"
        number = int(value)
        if number in self.names:
            return self.names[number]
        if not self.is_bits:
            return f"code {number}"
        return " ".join(
            self.names.get(1 << bit, f"bit {bit}") for bit in range(number.bit_length()) if number >> bit & 1
        )


@dataclass(frozen=True, eq=False)
class Selection:
    """A recording: its metadata, and its series in the order in which they first appear.

    Drives are in the order of their plant file.
    """

    path: Path
    metadata: Mapping[str, Any]
    series: tuple[Series, ...]
    truncated: int  # bytes at the recording's end that were left out

    @property
    def rows(self) -> int:
        return sum(len(it.time) for it in self.series)

    @property
    def drives(self) -> tuple[str, ...]:
        there = {it.drive for it in self.series}
        known = [drive for drive in self.metadata.get("drives", {}) if drive in there]
        return tuple(dict.fromkeys([*known, *(it.drive for it in self.series)]))

    @cached_property
    def begin(self) -> int:
        return min(int(it.time.min()) for it in self.series)

    @cached_property
    def end(self) -> int:
        return max(int(it.time.max()) for it in self.series)

    @property
    def seconds(self) -> float:
        return (self.end - self.begin) / 1e9

    def about(self, drive: str) -> Mapping[str, Any]:
        """What the metadata says of a drive."""
        found: Mapping[str, Any] = self.metadata.get("drives", {}).get(drive, {})
        return found

    def of(self, drive: str, register: str = "") -> tuple[Series, ...]:
        """A drive's series; of one register, where one is named."""
        return tuple(
            it for it in self.series if it.drive == drive and it.register == (register or it.register)
        )


def load(path: str | Path) -> Selection:
    """Read a recording. Raises ValueError for what is not one or has no rows, and OSError."""
    reader = open_reader(path)
    names: dict[str, list[str]] = {"drive": [], "register": [], "status": []}
    parts: list[list[Array]] = []
    for rows in reader:
        children = dict(zip(Row._fields, rows.arrow().view().children, strict=True))
        codes = [_codes(children[name], known) for name, known in names.items()]
        parts.append(
            [
                *codes,
                _numbers(children["time"]),
                _numbers(children["value"]),
                _numbers(children["uncertainty_ns"]),
            ]
        )
    if not parts or not any(len(part[0]) for part in parts):
        raise ValueError(f"{path} holds no rows: nothing was polled while it was recorded")
    drive, register, status, time, value, uncertainty = (
        np.concatenate(column) for column in zip(*parts, strict=True)
    )
    if not 0 <= time.min() <= time.max() < LATEST_NS:
        raise ValueError(f"{path} cannot be drawn: there are rows from before 1970 or after 2200")
    metadata = {**reader.metadata, "drives": _described(reader.metadata.get("drives"))}
    statuses = tuple(names["status"])
    series = []
    pair = drive.astype(np.int64) * len(names["register"]) + register
    for key in dict.fromkeys(pair.tolist()):
        rows_of = np.flatnonzero(pair == key)
        rows_of = rows_of[np.argsort(time[rows_of], kind="stable")]
        drive_name = names["drive"][key // len(names["register"])]
        register_name = names["register"][key % len(names["register"])]
        meaning = metadata["drives"].get(drive_name, {}).get("registers", {}).get(register_name, {})
        series.append(
            Series(
                drive_name,
                register_name,
                time[rows_of],
                value[rows_of].astype(float),
                uncertainty[rows_of].astype(float),
                status[rows_of],
                statuses,
                meaning,
            )
        )
    return Selection(Path(path), metadata, tuple(series), reader.truncated)


def _described(drives: object) -> dict[str, Any]:
    """What the metadata says of drives and registers, without what `Plant.metadata` would not write."""
    found = {}
    for name, about in _tables(drives):
        registers = {register: _meaning(meaning) for register, meaning in _tables(about.get("registers"))}
        found[name] = {**about, "registers": registers}
    return found


def _tables(tables: object) -> list[tuple[str, dict[str, Any]]]:
    if not isinstance(tables, dict):
        return []
    return [(name, table) for name, table in tables.items() if isinstance(table, dict)]


def _meaning(meaning: dict[str, Any]) -> dict[str, Any]:
    values = meaning.get("values")
    if not isinstance(values, dict):
        return {**meaning, "values": None}
    return {**meaning, "values": {name: count for name, count in values.items() if _is_count(count)}}


def _is_count(count: object) -> bool:
    return isinstance(count, int) and not isinstance(count, bool) and 0 <= count < LARGEST_COUNT


def _numbers(column: Any) -> Array:
    """NaN where there is none."""
    numbers = np.array(column.buffer(1))[: column.length]
    if not column.null_count:
        return numbers
    valid = np.unpackbits(np.frombuffer(bytes(column.buffer(0)), np.uint8), bitorder="little")
    return np.where(valid[: column.length] == 1, numbers.astype(float), np.nan)


def _codes(column: Any, known: list[str]) -> Array:
    """The number of each row's text in `known`, which grows by what is new."""
    ends = np.array(column.buffer(1))[: column.length + 1]
    lengths = np.diff(ends)
    width = int(lengths.max(initial=1)) or 1
    padded = np.zeros((column.length, width), np.uint8)
    text = np.frombuffer(bytes(column.buffer(2)), np.uint8)[ends[0] : ends[-1]]
    padded[np.arange(width) < lengths[:, None]] = text
    found, firsts, places = np.unique(
        padded.view(f"S{width}").ravel(), return_index=True, return_inverse=True
    )
    for at in np.argsort(firsts):
        name = found[at].decode(errors="replace")
        if name not in known:
            known.append(name)
    numbers = np.array([known.index(text.decode(errors="replace")) for text in found.tolist()], np.int32)
    return numbers[places] if len(found) else np.zeros(0, np.int32)
