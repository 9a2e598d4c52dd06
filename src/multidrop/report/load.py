"""Load a whole recording, as one series for each register of each drive."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from multidrop.polling.batch import ROW_COLUMNS
from multidrop.recording import open_recording

RAW = "raw count"  # unit of values without a known scale
LARGEST = 1e150  # larger values are not drawn: matplotlib computes products of values
LATEST_NS = 230 * 365 * 86400 * 10**9  # UTC; no dates can be computed for later times
PAUSE_NS, PAUSE_STEPS = 2 * 10**9, 5  # a longer step between rows is a pause, as of a suspended process
MOST_ROWS = 100_000_000  # limit of a recording's rows: so many take 5 GB of memory
MOST_NAMES = 4096  # limit for the names of drives, of registers and of statuses
LONGEST_NAME = 4096  # limit in bytes
LARGEST_COUNT = 2**53  # largest count that a float64 holds exactly
Array = NDArray[Any]


@dataclass(frozen=True)
class TimeSpan:
    """A span of time in ns UTC, such as that of a fault."""

    begin: int
    end: int
    what: str


@dataclass(frozen=True, eq=False)
class Series:
    """The rows of one register of one drive; `value` is NaN for a miss."""

    drive: str
    register: str
    time: Array  # int64, ns UTC
    value: Array  # float64
    uncertainty: Array  # float64, ns
    status: Array  # int, index into `statuses`
    statuses: tuple[str, ...]
    metadata: Mapping[str, Any]  # of the register

    @cached_property
    def missed(self) -> Array:
        return np.asarray(np.isnan(self.value))

    @property
    def has_values(self) -> bool:
        return not self.missed.all()

    @cached_property
    def drawable(self) -> Array:
        """The values, with NaN for misses and for values too large for a picture."""
        return np.where(np.abs(self.value) < LARGEST, self.value, np.nan)

    @cached_property
    def pauses(self) -> Array:
        """For each row except the last: True if polling paused after the row (no values and no misses)."""
        steps = np.diff(self.time)
        beside = np.maximum(np.append(steps[1:], 0), np.append(0, steps[:-1]))
        return np.asarray((steps > PAUSE_NS) & (steps / PAUSE_STEPS > beside) & (beside > 0))

    @cached_property
    def names(self) -> dict[int, str]:
        names: Mapping[str, int] = self.metadata.get("values") or {}
        return {number: name for name, number in names.items()}

    @property
    def is_bits(self) -> bool:
        """True if the register's raw value is a set of named bits."""
        return bool(self.names) and self.metadata.get("bits") is True

    @property
    def unit(self) -> str:
        """The unit to write on an axis: "raw count" if the scale is unknown, "" for named states."""
        if self.names:
            return ""
        if "step" in self.metadata and self.metadata["step"] is None:
            return RAW
        return str(self.metadata.get("unit") or "")

    def reasons(self) -> Counter[str]:
        numbers, counts = np.unique(self.status[self.missed], return_counts=True)
        return Counter({self.statuses[number]: int(n) for number, n in zip(numbers, counts, strict=True)})

    def times_of(self, reason: str) -> Array:
        """Return the times of the misses with this reason."""
        return np.asarray(self.time[self.missed & (self.status == self.statuses.index(reason))])

    def faults(self) -> list[TimeSpan]:
        """Return the time spans in which this fault register was not 0; a miss does not end a span."""
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
        """Return the name of a raw value, the names of its set bits, or a text with the number."""
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
class Recording:
    """A whole recording: its metadata, and its series in the order of their first rows.

    Drives are in the order of the plant file.
    """

    path: Path
    metadata: Mapping[str, Any]
    series: tuple[Series, ...]
    truncated: int  # number of skipped bytes at the recording's end

    @property
    def statuses(self) -> tuple[str, ...]:
        return self.series[0].statuses

    @property
    def rows(self) -> int:
        return sum(len(series.time) for series in self.series)

    @cached_property
    def drives(self) -> tuple[str, ...]:
        there = dict.fromkeys(series.drive for series in self.series)
        known = [drive for drive in self.metadata.get("drives", {}) if drive in there]
        return tuple(dict.fromkeys([*known, *there]))

    @cached_property
    def begin(self) -> int:
        return min(int(series.time.min()) for series in self.series)

    @cached_property
    def end(self) -> int:
        return max(int(series.time.max()) for series in self.series)

    @property
    def seconds(self) -> float:
        return (self.end - self.begin) / 1e9

    def about(self, drive: str) -> Mapping[str, Any]:
        found: Mapping[str, Any] = self.metadata.get("drives", {}).get(drive, {})
        return found

    def of(self, drive: str, register: str = "") -> tuple[Series, ...]:
        """Return all series of a drive, or only the series of `register`."""
        of_drive = self._by_drive.get(drive, ())
        return tuple(series for series in of_drive if register in ("", series.register))

    @cached_property
    def _by_drive(self) -> dict[str, list[Series]]:
        found: dict[str, list[Series]] = {}
        for series in self.series:
            found.setdefault(series.drive, []).append(series)
        return found


def load(path: str | Path) -> Recording:
    """Load a recording. Raises OSError, or ValueError for an empty, too large or invalid file."""
    reader = open_recording(path)
    codes: dict[str, dict[str, int]] = {"drive": {}, "register": {}, "status": {}}
    parts: list[list[Array]] = []
    rows = 0
    for batch in reader:
        children = dict(zip(ROW_COLUMNS, batch.arrow().view().children, strict=True))
        columns = [_codes(children[name], known) for name, known in codes.items()]
        parts.append(columns + [_numbers(children[name]) for name in ("time", "value", "uncertainty_ns")])
        rows += len(batch)
        if rows > MOST_ROWS:
            raise ValueError(f"{path} is too large to draw: it has more than {MOST_ROWS} rows")
        if max(map(len, codes.values())) > MOST_NAMES:
            raise ValueError(
                f"{path} cannot be drawn: it names more than {MOST_NAMES} drives, registers or statuses"
            )
    if not rows:
        raise ValueError(f"{path} holds no rows: nothing was polled while it was recorded")
    drive, register, status, time, value, uncertainty = (
        np.concatenate(column) for column in zip(*parts, strict=True)
    )
    if not 0 <= time.min() <= time.max() < LATEST_NS:
        raise ValueError(f"{path} cannot be drawn: there are rows from before 1970 or after 2200")
    metadata = {**reader.metadata, "drives": _described(reader.metadata.get("drives"))}
    drives, registers, statuses = map(tuple, codes.values())
    pair = drive.astype(np.int64) * len(registers) + register
    order = np.lexsort((time, pair))
    starts = np.flatnonzero(np.diff(pair[order], prepend=-1))
    first_seen = np.minimum.reduceat(order, starts)  # the row in which each series first appears
    series = []
    groups = np.split(order, starts[1:])
    for rows_of in (groups[at] for at in np.argsort(first_seen)):
        drive_name, register_name = drives[drive[rows_of[0]]], registers[register[rows_of[0]]]
        about = metadata["drives"].get(drive_name, {}).get("registers", {}).get(register_name, {})
        series.append(
            Series(
                drive_name,
                register_name,
                time[rows_of],
                value[rows_of].astype(float),
                uncertainty[rows_of].astype(float),
                status[rows_of],
                statuses,
                about,
            )
        )
    return Recording(Path(path), metadata, tuple(series), reader.truncated)


def _described(drives: object) -> dict[str, Any]:
    """Return the metadata of drives and registers, without parts that `Plant.metadata` never writes."""
    found = {}
    for name, about in _tables(drives):
        registers = {register: _checked(table) for register, table in _tables(about.get("registers"))}
        found[name] = {**about, "registers": registers}
    return found


def _tables(tables: object) -> list[tuple[str, dict[str, Any]]]:
    if not isinstance(tables, dict):
        return []
    return [(name, table) for name, table in tables.items() if isinstance(table, dict)]


def _checked(register: dict[str, Any]) -> dict[str, Any]:
    values = register.get("values")
    if not isinstance(values, dict):
        return {**register, "values": None}
    return {**register, "values": {name: count for name, count in values.items() if _is_count(count)}}


def _is_count(count: object) -> bool:
    return isinstance(count, int) and not isinstance(count, bool) and 0 <= count < LARGEST_COUNT


def _numbers(column: Any) -> Array:
    """Return a column of numbers, with NaN for nulls."""
    numbers = np.array(column.buffer(1))[: column.length]
    if not column.null_count:
        return numbers
    valid = np.unpackbits(np.frombuffer(bytes(column.buffer(0)), np.uint8), bitorder="little")
    return np.where(valid[: column.length] == 1, numbers.astype(float), np.nan)


def _codes(column: Any, known: dict[str, int]) -> Array:
    """Return each row's text as its code in `known`; texts that `known` lacks are added to it."""
    ends = np.array(column.buffer(1))[: column.length + 1]
    lengths = np.diff(ends)
    if lengths.max(initial=0) > LONGEST_NAME:
        raise ValueError(f"a name has {lengths.max()} bytes: a recording's have at most {LONGEST_NAME}")
    width = int(lengths.max(initial=1)) or 1
    padded = np.zeros((column.length, width), np.uint8)
    text = np.frombuffer(bytes(column.buffer(2)), np.uint8)[ends[0] : ends[-1]]
    padded[np.arange(width) < lengths[:, None]] = text
    found, firsts, places = np.unique(
        padded.view(f"S{width}").ravel(), return_index=True, return_inverse=True
    )
    for at in np.argsort(firsts):
        known.setdefault(found[at].decode(errors="replace"), len(known))
    numbers = np.array([known[text.decode(errors="replace")] for text in found.tolist()], np.int32)
    return numbers[places] if len(found) else np.zeros(0, np.int32)
