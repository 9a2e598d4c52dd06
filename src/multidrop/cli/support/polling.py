"""A polled plant for commands: the polling session, the state that screens show, and triggers."""

from __future__ import annotations

import argparse
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from enum import Flag
from itertools import chain, islice
from pathlib import Path
from typing import Any, NamedTuple

from multidrop.cli.support.arguments import argument
from multidrop.cli.support.signals import Interruption, noting_signals
from multidrop.cli.support.terminal import sparkline
from multidrop.cli.support.values import columns_of, padded, value_text
from multidrop.core import UNASKED, Counters
from multidrop.drive.known_state import StateReader
from multidrop.drive.verbs import Condition, Direction
from multidrop.plant.model import Plant, PlantLine, PolledDrive, current_for
from multidrop.plant.triggers import POST_S, PRE_S, TriggerSeries, with_triggers
from multidrop.poller import Poller
from multidrop.polling.batch import Row, Rows
from multidrop.recording import FORMATS, open_recording, open_writer
from multidrop.recording.format import Metadata, RecordingWriter
from multidrop.recording.segments import SegmentWriter
from multidrop.recording.triggered import TriggeredWriter
from multidrop.toml_check import parse_duration
from multidrop.transport.statistics import LineStatistics, Statistics, line_statistics


class PollingSession(NamedTuple):
    poller: Poller  # the poller, which is not started yet
    interruption: Interruption
    hand_out: Callable[[], None]  # passes the newest rows to the recording and to all other consumers
    writer: RecordingWriter | None = None  # the recording


class Rotation(NamedTuple):
    """How a recording is split into segments: seconds per segment, and limits for all segments."""

    every: float
    keep: float | None = None  # limit of a segment's age, in s
    most: int | None = None  # limit of all segments' size, in bytes


class Triggering(NamedTuple):
    """How triggers are recorded, each in its own file."""

    pre: float  # seconds recorded before a trigger
    post: float  # seconds recorded after a trigger
    # the text of the condition from which each trigger channel is computed
    conditions: Mapping[TriggerSeries, str]
    # registers whose curves are drawn, by the condition's text
    signals: Mapping[str, Sequence[TriggerSeries]]


def _open(out: Path, metadata: Metadata, how: Rotation | Triggering | None) -> RecordingWriter:
    if how is None:
        return open_writer(out, metadata)
    if isinstance(how, Triggering):
        return TriggeredWriter(out, metadata, pre=how.pre, post=how.post, conditions=how.conditions)
    return SegmentWriter(out, metadata, every=how.every, keep=how.keep, most=how.most)


@contextmanager
def polling_session(
    plant: Plant,
    out: Path | None,
    *consumers: Callable[[Rows], None],
    how: Rotation | Triggering | None = None,
) -> Iterator[PollingSession]:
    """Open the plant's ports, then its recording, and yield the session.

    `how` says which rows are recorded in which files; None: all rows in one file.

    When the context ends, record all remaining rows, and close recording and ports.
    """
    takers = list(consumers)
    with ExitStack() as stack:
        interruption = stack.enter_context(noting_signals())
        # opened before the recording: if no port can be opened, no file is created
        poller = stack.enter_context(closing(Poller(plant)))
        writer = stack.enter_context(_open(out, plant.metadata(), how)) if out else None
        if writer:
            takers.append(writer.write)

        def hand_out() -> None:
            while batch := poller.take():
                for take in tuple(takers):
                    try:
                        take(batch)
                    except BaseException:
                        # The consumer failed and lacks this batch, so it gets no further batches.
                        takers.remove(take)
                        raise

        try:
            yield PollingSession(poller, interruption, hand_out, writer)
        finally:
            hand_out()  # even after a failure, hand out the rows that the poller has delivered


POINT_S = 0.25  # seconds between two points of a history
HISTORY = 240  # most points of a history, which are those of the last minute
RECENT = 5.0  # period in s over which rates are measured
MISSED = 1.0  # if the last request for a register failed, its value is old after this many s
FREQUENCY, CURRENT, FAULT, STATE = "output_frequency", "output_current", "fault", "status"

_NOTHING = Statistics(1.0, Counters())


class Moment(NamedTuple):
    """One moment in UTC and by CLOCK_MONOTONIC, both in ns."""

    utc_ns: int
    monotonic_ns: int

    def age(self, row: Row) -> float:
        """Return the time in s since a row's request: the larger of the times by both clocks.

        UTC may be set back, and CLOCK_MONOTONIC stops while the computer sleeps. Both make an age too small.
        """
        return max(self.utc_ns - row.time_ns, self.monotonic_ns - row.monotonic_ns, 0) / 1e9


@dataclass
class LiveDrive:
    """A polled drive: its newest values, its missed values, its statistics and a history."""

    line: PlantLine
    polled: PolledDrive
    cycle: float = 0.0  # planned cycle time of the drive's line, in s
    line_utilisation: float = 1.0  # planned utilisation; at 1 and above, polling leaves no spare bus time
    newest: dict[str, Row] = field(default_factory=dict)  # each register's newest sample
    # each register's last missed value, if newer than its newest sample
    missed: dict[str, Row] = field(default_factory=dict)
    last_miss: str = ""  # status of the last value that was requested but not received
    so_far: Statistics = _NOTHING
    recent: Statistics = _NOTHING
    history: deque[float | None] = field(default_factory=lambda: deque(maxlen=HISTORY))
    points: int = 0  # number of points ever added to the history

    def __post_init__(self) -> None:
        self._reader = StateReader(self.polled.drive)

    @property
    def name(self) -> str:
        return self.polled.drive.name

    def add(self, row: Row) -> None:
        if row.value is None:
            self.missed[row.register] = row
            if not row.status.startswith(UNASKED):
                self.last_miss = row.status
        else:
            self.newest[row.register] = row
            self.missed.pop(row.register, None)

    def shown(self, name: str) -> str:
        """Return a register's newest value with its unit; "" without any value."""
        row = self.newest.get(name)
        if row is None or row.value is None:
            return ""
        return value_text(self.polled.find_register(name), row.value)

    def age(self, now: Moment) -> float | None:
        """Return how old the newest sample is, in s; None without any sample."""
        polled = (self.newest.get(poll.register.name) for poll in self.polled.polls)
        return min((now.age(row) for row in polled if row), default=None)

    def is_old(self, name: str, now: Moment) -> bool:
        """Return True if a register's newest value is no longer current."""
        row = self.newest.get(name)
        age = 0.0 if row is None else now.age(row)
        every = next((poll.every for poll in self.polled.series if poll.register.name == name), None)
        return age > (MISSED if name in self.missed else current_for(max(every or 0.0, self.cycle)))

    @property
    def why_silent(self) -> str:
        """If the last request for every polled register failed, return why; else ""."""
        if any(poll.register.name not in self.missed for poll in self.polled.polls) or not self.missed:
            return ""
        return self.last_miss or max(self.missed.values(), key=lambda row: row.monotonic_ns).status

    @property
    def fault(self) -> str:
        row = self.newest.get(FAULT)
        return self.shown(FAULT).lower() if row and row.value else ""

    @property
    def state_register(self) -> str:
        """Return the name of the register that shows the state; "" if the drive is silent."""
        if self.why_silent:
            return ""
        if self.fault:
            return FAULT
        is_named = STATE in self.newest and not self._is_bare(self.newest[STATE])
        return STATE if is_named else FREQUENCY

    @property
    def state(self) -> str:
        """Return the drive's state as a short text such as "fault"; "" if no polled register shows it."""
        register = self.state_register
        if register in (STATE, FREQUENCY) and (known := self._known_state()):
            return known
        if register == STATE:
            return self.shown(STATE).lower()
        if register != FREQUENCY:
            return "fault" if register else "silent"
        row = self.newest.get(FREQUENCY)
        return "turns" if row and row.value else ""  # 0 Hz may mean stopped, or running at a setpoint of 0

    def _known_state(self) -> str:
        """Return the state by the family's own rules; "" if these need registers that are not polled."""
        values = {name: row.value for name, row in self.newest.items() if name not in self.missed}
        state = self._reader.state({name: value for name, value in values.items() if value is not None})
        if state is None or state.condition is Condition.UNKNOWN:
            return ""
        is_reverse = state.condition is Condition.RUNNING and state.direction is Direction.REVERSE
        return "reverse" if is_reverse else state.condition.value

    def _is_bare(self, row: Row) -> bool:
        """Return True for a register of flags in which no flag is set, so that it names no state."""
        values = self.polled.drive.register(row.register).values
        return not row.value and values is not None and issubclass(values, Flag)

    def remember(self) -> None:
        """Add a point to the history: the frequency or, if it is not polled, the first polled register."""
        polled = [poll.register.name for poll in self.polled.polls]
        name = FREQUENCY if FREQUENCY in polled else next(iter(polled), "")
        fresh = name in self.newest and name not in self.missed
        self.history.append(self.newest[name].value if fresh else None)
        self.points += 1


class LivePlant:
    """All drives of a plant, with statistics of its lines since the start and in the last RECENT seconds.

    Rows, statistics and times are arguments, so the class reads no clock. `planned` has the planned cycle
    time of each line, from `plant.metadata()["planned"]`; it is needed to mark old values.
    """

    def __init__(self, plant: Plant, planned: Mapping[str, Any] | None = None) -> None:
        self.plant = plant
        self.drives = []
        for line in plant.lines:
            facts = planned[line.name] if planned else {}
            cycle, utilisation = facts.get("cycle_ms", 0.0) / 1e3, facts.get("utilisation", 1.0)
            self.drives += [LiveDrive(line, polled, cycle, utilisation) for polled in line.drives]
        self.so_far = {line.name: line_statistics(1.0, {}, None) for line in plant.lines}
        self.recent = self.so_far
        self._by_name = {drive.name: drive for drive in self.drives}
        self._earlier: deque[tuple[float, Mapping[str, LineStatistics]]] = deque()

    def add(self, rows: Iterable[Row]) -> None:
        for row in rows:
            if drive := self._by_name.get(row.drive):  # an event has no drive
                drive.add(row)

    def tick(self, now: float, statistics: dict[str, LineStatistics]) -> None:
        """Store the poller's statistics of the time `now`, in s. Call this once a second."""
        self._earlier.append((now, statistics))
        while now - self._earlier[0][0] > RECENT:
            self._earlier.popleft()
        before = self._earlier[0][1]
        self.so_far = self.recent = statistics
        if before is not statistics:
            self.recent = {name: line.since(before[name]) for name, line in statistics.items()}
        for drive in self.drives:
            drive.so_far = statistics[drive.line.name].drives[drive.name]
            drive.recent = self.recent[drive.line.name].drives[drive.name]

    def remember(self) -> None:
        """Add a point to each drive's history. Call this every POINT_S."""
        for drive in self.drives:
            drive.remember()


# ---- triggers ----


def add_trigger_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--trigger",
        metavar="CONDITION",
        action="append",
        default=[],
        help="record only around each moment at which this becomes true, such as "
        '"pump-1.output_current > 30"; fault: a fault of any drive; key: the key t; may be repeated',
    )
    for name, default, where in (("pre", PRE_S, "before"), ("post", POST_S, "after")):
        parser.add_argument(
            f"--{name}",
            metavar="TIME",
            type=argument(parse_duration),
            help=f"with --trigger: how long to record {where} each trigger; default: {default:g} s",
        )


def triggering_of(plant: Plant, arguments: argparse.Namespace) -> tuple[Plant, Triggering | None]:
    """Return the plant with a channel for each trigger's condition, and how the triggers are recorded.

    Raises ValueError for contradicting options and for a mistake in a condition.
    """
    if not arguments.trigger:
        if arguments.pre is not None or arguments.post is not None:
            raise ValueError(
                '--pre and --post belong to a trigger: add --trigger "pump-1.output_current > 30"'
            )
        return plant, None
    if not arguments.out:
        raise ValueError("--trigger needs --out, such as --out trip.arrows")
    if getattr(arguments, "rotate", None) is not None:
        raise ValueError("--trigger and --rotate exclude each other: each trigger has its own file")
    if arguments.out.suffix not in FORMATS:
        raise ValueError(f"{arguments.out}: a recording's name must end in {', '.join(FORMATS)}")
    try:
        found = with_triggers(plant, [condition for condition in arguments.trigger if condition != "key"])
    except ValueError as mistakes:
        raise ValueError("\n".join(f"--trigger {one}" for one in str(mistakes).splitlines())) from None
    how = Triggering(arguments.pre or PRE_S, arguments.post or POST_S, found.texts, found.signals)
    return found.plant, how


# ---- the picture of the last trigger ----

MOST_SIGNALS = 4  # limit of curves in the picture
LEAST_COLUMNS = 10  # least width of a curve
MOST_ROWS = 100_000  # rows read from a recording for a picture; new rows must wait during the reading


def trigger_picture(path: Path, how: Triggering, width: int, blocks: str) -> list[str]:
    """Draw the signals around the moment of a trigger, as lines of text with at most `width` columns.

    The signals are those that the condition names; for a trigger without a condition, they are the polled
    registers. `path` is a complete recording. Return [] if it cannot be read, because polling must go on.
    """
    try:
        recording = open_recording(path)
        trigger = recording.metadata["trigger"]
        rows = list(islice(chain.from_iterable(recording), MOST_ROWS + 1))
    except (ImportError, KeyError, OSError, ValueError):
        return []
    is_large = len(rows) > MOST_ROWS
    polled: dict[TriggerSeries, list[Row]] = {}
    for row in sorted([] if is_large else rows, key=lambda row: row.time_ns):
        polled.setdefault((row.drive, row.register), []).append(row)
    known = recording.metadata.get("drives", {})
    wanted = how.signals.get(trigger["condition"]) or [one for one in polled if one[0] in known]
    signals = {series: polled[series] for series in wanted if series in polled}
    shown = [*signals.items()][:MOST_SIGNALS]
    names = [".".join(series) for series, _ in shown]
    registers = [known.get(drive, {}).get("registers", {}).get(name, {}) for (drive, name), _ in shown]
    ranges = [_range(own, about.get("unit", "")) for about, (_, own) in zip(registers, shown, strict=True)]
    side = max(map(columns_of, names), default=0) + 2
    columns = max(LEAST_COLUMNS, width - side - max(map(columns_of, ranges), default=0) - 2)
    span = SpanOfTime(trigger["time_ns"], trigger["pre_s"], trigger["post_s"])
    time = datetime.fromtimestamp(trigger["time_ns"] / 1e9, UTC)
    note = ", which is too large for a picture" if is_large else ""
    lines = [f"trigger {time:%H:%M:%S.%f} UTC: {trigger['condition']}, in {path.name}{note}"]
    for name, text, (_, own) in zip(names, ranges, shown, strict=True):
        lines.append(
            f"{padded(name, '<', side)}{sparkline(span.history(own, columns), columns, blocks)}  {text}"
        )
    mark = " " * span.column(trigger["time_ns"], columns) + "^"
    return [*lines, f"{padded('', '<', side)}{mark} {span}"] if shown else lines


class SpanOfTime(NamedTuple):
    """The time that a trigger's picture shows, from `pre_s` before the trigger to `post_s` after it."""

    trigger_ns: int
    pre_s: float
    post_s: float

    def __str__(self) -> str:
        return f"from -{self.pre_s:g} s to {self.post_s:g} s"

    def column(self, time_ns: int, columns: int) -> int:
        """Return which of `columns` columns shows this time."""
        since_ns = time_ns - self.trigger_ns + round(self.pre_s * 1e9)
        span_ns = round((self.pre_s + self.post_s) * 1e9)
        return max(0, min(columns - 1, since_ns * columns // max(1, span_ns)))

    def history(self, rows: Iterable[Row], columns: int) -> list[float | None]:
        """Return a value for each column: the value with the largest magnitude among its rows.

        A column without rows has the value of the last row before it: None if that row is a missed value.
        """
        found: dict[int, list[float | None]] = {}
        for row in rows:
            found.setdefault(self.column(row.time_ns, columns), []).append(row.value)
        history: list[float | None] = []
        last: float | None = None
        for column in range(columns):
            values = found.get(column, [last])
            history.append(max((value for value in values if value is not None), key=abs, default=None))
            last = values[-1]
        return history


def _range(rows: Iterable[Row], unit: str) -> str:
    values = [row.value for row in rows if row.value is not None]
    return f"{min(values):g} to {max(values):g} {unit}".rstrip() if values else "no value"
