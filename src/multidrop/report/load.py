"""Load a whole recording, as one series for each register of each drive."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from multidrop.polling.added_rows import EVENT
from multidrop.polling.batch import ROW_COLUMNS
from multidrop.recording import open_recording
from multidrop.recording.rows import PHASE_DRIVE, phase_names
from multidrop.recording.series import (
    LARGEST_COUNT,
    LATEST_NS,
    Array,
    Event,
    checked_drives,
    codes_of,
    numbers_of,
    rows_by_series,
    trigger_of,
    unit_of_register,
)

NUMBERS = ("time", "monotonic_ns", "value", "uncertainty_ns")  # columns of numbers
LARGEST = 1e150  # larger values are not drawn, because matplotlib multiplies values
# The time between two rows is a pause if it is longer than PAUSE_NS, and longer than PAUSE_STEPS times the
# interval before it and PAUSE_STEPS times the interval after it.
PAUSE_NS, PAUSE_STEPS = 2 * 10**9, 5
SET_NS = 10**9  # the time of day was set, or the computer slept, if two clocks differ by more than this
MOST_ROWS = 100_000_000  # limit of a recording's rows, which then take 5 GB of memory
MOST_NAMES = 4096  # limit of the number of different names: of drives, of registers, and of statuses


@dataclass(frozen=True)
class TimeSpan:
    """A span of time in ns UTC, such as that of a fault."""

    begin: int
    end: int
    what: str


@dataclass(frozen=True)
class StepSpan(TimeSpan):
    """The time of a step of a test run, in ns UTC and also in ns of the monotonic clock."""

    monotonic_begin: int
    monotonic_end: int


@dataclass(frozen=True, eq=False)
class Series:
    """The rows of one register of one drive, sorted by `time`; `value` is NaN for a missed value."""

    drive: str
    register: str
    time: Array  # times of the rows: int64, ns UTC
    monotonic: Array  # the same times in ns of CLOCK_MONOTONIC
    value: Array  # float64
    uncertainty: Array  # float64, ns
    status: Array  # each row's status, as an index into `statuses`
    place: Array  # each row's place in the recording
    statuses: tuple[str, ...]
    metadata: Mapping[str, Any]  # metadata of the register

    @cached_property
    def missed(self) -> Array:
        return np.asarray(np.isnan(self.value))

    @property
    def has_values(self) -> bool:
        return not self.missed.all()

    @cached_property
    def drawable(self) -> Array:
        """The values, with NaN for missed values and for values too large to draw."""
        return np.where(np.abs(self.value) < LARGEST, self.value, np.nan)

    @cached_property
    def pauses(self) -> Array:
        """For each row but the last: True if polling paused after it."""
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
        return unit_of_register(self.metadata)

    def reasons(self) -> Counter[str]:
        numbers, counts = np.unique(self.status[self.missed], return_counts=True)
        return Counter({self.statuses[number]: int(n) for number, n in zip(numbers, counts, strict=True)})

    def times_of(self, reason: str) -> Array:
        return np.asarray(self.time[self.missed & (self.status == self.statuses.index(reason))])

    def faults(self) -> list[TimeSpan]:
        """Return the time spans in which this fault register was not 0. Missed values do not end a span."""
        in_order = np.argsort(self.place)
        there = in_order[~self.missed[in_order]]
        time, value = self.time[there], self.value[there]
        if not len(time):
            return []
        # if the time of day is set back, only the monotonic clock shows how long a fault lasts
        steps = np.maximum(np.diff(time), np.diff(self.monotonic[there])).clip(0)
        since = np.append(0, np.cumsum(steps))
        changes = np.flatnonzero(value[1:] != value[:-1]) + 1
        begins = [0, *changes.tolist()]
        ends = [*changes.tolist(), len(time) - 1]
        return [
            TimeSpan(int(time[at]), int(time[at] + since[end] - since[at]), self.name_of(value[at]))
            for at, end in zip(begins, ends, strict=True)
            if value[at] != 0
        ]

    def name_of(self, value: float) -> str:
        """Return the name of a raw value, or the names of its set bits; "code 7" if it has no name."""
        if not value.is_integer() or not abs(value) < LARGEST_COUNT:
            return f"code {value:g}"
        number = int(value)
        if number in self.names:
            return self.names[number]
        if not self.is_bits or number < 0:
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
    seconds: float  # duration; without the time that the computer slept
    truncated: int  # number of skipped bytes at the recording's end
    steps: tuple[StepSpan, ...] = ()  # steps of a test run, named by their phases
    events: tuple[Event, ...] = ()  # in the order of their times

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

    def about(self, drive: str) -> Mapping[str, Any]:
        found: Mapping[str, Any] = self.metadata.get("drives", {}).get(drive, {})
        return found

    def of(self, drive: str, register: str = "") -> tuple[Series, ...]:
        """Return all series of a drive, or only the series of `register`."""
        of_drive = self._by_drive.get(drive, ())
        return tuple(series for series in of_drive if register in ("", series.register))

    def plot(self, *, drives: Sequence[str] = (), registers: Sequence[str] = ()) -> Figure:
        """Return a picture of the named drives and registers (default: all), which a notebook shows.

        Raises ValueError for unknown names, and if there is no value to draw.
        """
        from multidrop.report.value_plot import plot  # imported here, because value_plot imports this module

        return plot(self, drives, registers)[0]

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
        columns = [codes_of(children[name], known) for name, known in codes.items()]
        parts.append(columns + [numbers_of(children[name]) for name in NUMBERS])
        rows += len(batch)
        if rows > MOST_ROWS:
            raise ValueError(f"{path} is too large to draw: it has more than {MOST_ROWS} rows")
        if max(map(len, codes.values())) > MOST_NAMES:
            raise ValueError(
                f"{path} cannot be drawn: it names more than {MOST_NAMES} drives, registers or statuses"
            )
    if not rows:
        why = (
            "it ends within the first one" if reader.truncated else "nothing was polled while it was recorded"
        )
        raise ValueError(f"{path} holds no rows: {why}")
    drive, register, status, time, monotonic, value, uncertainty = (
        np.concatenate(column) for column in zip(*parts, strict=True)
    )
    if not 0 <= time.min() <= time.max() < LATEST_NS:
        raise ValueError(f"{path} cannot be drawn: it has rows from before 1970 or after 2200")
    metadata = {**reader.metadata, "drives": checked_drives(reader.metadata)}
    drives, registers, statuses = map(tuple, codes.values())
    series = []
    for rows_of in sorted(rows_by_series(drive, register, time), key=np.min):
        drive_name, register_name = drives[drive[rows_of[0]]], registers[register[rows_of[0]]]
        about = metadata["drives"].get(drive_name, {}).get("registers", {}).get(register_name, {})
        series.append(
            Series(
                drive_name,
                register_name,
                time[rows_of],
                monotonic[rows_of],
                value[rows_of].astype(float),
                uncertainty[rows_of].astype(float),
                status[rows_of],
                rows_of,
                statuses,
                about,
            )
        )
    others = {EVENT, PHASE_DRIVE} if phase_names(metadata) else {EVENT}
    polled = tuple(one for one in series if one.drive not in others)
    if not polled:
        raise ValueError(f"{path} holds no rows of drives, but only events or the phases of a test run")
    phases = [one for one in series if one.drive == PHASE_DRIVE and one not in polled]
    end = int(time.max()) + 1, int(monotonic.max()) + 1
    steps = [step for one in phases for step in _steps(one, end)]
    events = {event for one in series if one.drive == EVENT for event in _events(one)}
    if trigger := trigger_of(metadata):
        events.add(trigger)
    in_order = sorted(events, key=lambda event: event.time)
    series_of_row = drive.astype(np.int64) * len(registers) + register
    seconds = _seconds(series_of_row, time, monotonic)
    return Recording(Path(path), metadata, polled, seconds, reader.truncated, tuple(steps), tuple(in_order))


def _seconds(series: Array, time: Array, monotonic: Array) -> float:
    """Return the duration of a recording in s. The arrays have each row's series, and its times in ns.

    If the time of day was set meanwhile, or if the computer slept, return the longest duration of a series by
    the monotonic clock. This clock goes back only if the computer restarts.
    """
    in_order = np.argsort(series, kind="stable")
    is_same = np.diff(series[in_order]) == 0
    utc, awake = np.diff(time[in_order]), np.diff(monotonic[in_order])
    if not (is_same & (awake >= 0) & (np.abs(utc - awake) > SET_NS)).any():
        return (int(time.max()) - int(time.min())) / 1e9
    steps = np.append(0, np.where(is_same, np.where(awake < 0, utc.clip(0), awake), 0))
    starts = np.append(0, np.flatnonzero(~is_same) + 1)
    return int(np.add.reduceat(steps, starts).max()) / 1e9


def _steps(phases: Series, end: tuple[int, int]) -> list[StepSpan]:
    """Return the steps of a test run. Each ends at the next step, or at the recording's end `end`.

    `end` is in ns UTC, and in ns of CLOCK_MONOTONIC.
    """
    in_order = np.argsort(phases.monotonic, kind="stable")
    names = map(phases.name_of, phases.value[in_order].tolist())
    utc, monotonic = (
        pairwise([*times[in_order].tolist(), last])
        for times, last in zip((phases.time, phases.monotonic), end, strict=True)
    )
    return [StepSpan(*span, name, *same) for span, name, same in zip(utc, names, monotonic, strict=True)]


def _events(series: Series) -> list[Event]:
    """Return the events of one kind; their texts are stored as statuses."""
    places = zip(series.time.tolist(), series.status.tolist(), strict=True)
    return [Event(time, series.register, series.statuses[code]) for time, code in places]
