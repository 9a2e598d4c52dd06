"""Hub: the newest row of every register of every drive, and each drive's state, computed from these rows.

A row is one read of a register: its value, or a miss if the read failed. Rows and times are arguments: this
module does no I/O. Rows are dated by CLOCK_MONOTONIC, which stops while the computer sleeps. So after a sleep
all earlier rows count as stale.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from math import isfinite
from operator import itemgetter
from typing import Any, NamedTuple

from multidrop import Batch, Condition, Plant, Polled, PolledDrive, Register
from multidrop.channels import ChannelSet
from multidrop.core import STATUSES, UNASKED, Status
from multidrop.drive import FAULT_RECORDS, StateReader
from multidrop.plant import current_for, series_of

# a row: UTC in ns, monotonic time in ns, value (undefined if the read failed), status code
KeptRow = tuple[int, int, float, int]
# a register with its newest row, its newest row with a value, and whether that value is fresh
Known = tuple[Register[Any], KeptRow | None, KeptRow | None, bool]
STATES = RUNS, STANDS, FAULT, SILENT, UNKNOWN = "runs", "stands", "fault", "silent", "unknown"
UNNAMED = "it shows a fault"  # text of a fault without a text of its own
NOT_ASKED = "not asked recently"  # text for the state UNKNOWN if the drive was not polled recently
INCOMPLETE = "not all of its values are known"  # text for the state UNKNOWN if some values are missing
_STATES = {
    Condition.STOPPED: STANDS,
    Condition.RUNNING: RUNS,
    Condition.ACCELERATING: RUNS,
    Condition.DECELERATING: RUNS,
    Condition.FAULT: FAULT,
    Condition.UNKNOWN: UNKNOWN,
}
# in ns: a smaller increase of the computer's time asleep is ignored. It is the difference of two clocks that
# are read one after the other, so it is inexact.
LEAST_SLEEP_NS = 100_000_000
FAULT_REGISTER = "fault"
# in ns: if the motor still turns this long after the register of past faults has changed, no fault is shown
RAN_NS = 3_000_000_000
# the drive has replied if the status of a failed read starts with one of these texts
_ANSWERED = ("exception ", "no valid value")
# statuses of a read that polling left out, and of a read without a reply; a silent drive has both
_SKIPPED, _NO_REPLY = STATUSES[Status.NOT_ASKED], STATUSES[Status.NO_REPLY]


class RegisterRows:
    """The newest rows (reads) of one polled register of one drive."""

    __slots__ = ("good", "holds_ns", "newest", "register", "since_ns")

    def __init__(self, register: Register[Any], since_ns: int) -> None:
        self.register = register
        self.holds_ns = 0  # how long a value stays current
        # rows requested before this time are ignored, because they are from another drive of the same name
        self.since_ns = since_ns
        self.newest: KeptRow | None = None
        self.good: KeptRow | None = None

    def is_current(self, now_ns: int, woke_ns: int) -> bool:
        """Return True if the newest value is not too old, and is from after the computer's last sleep."""
        good = self.good
        return good is not None and good[1] >= woke_ns and now_ns - good[1] <= self.holds_ns


# registers that show a motor's frequency, the preferred one first
FREQUENCIES = ("output_frequency", "motor_speed")
MINUTE_POINTS = 60
LEAST_POINT_MS = 900  # shortest time, in ms, between two points of the curve of the last minute


class Shown(NamedTuple):
    """A drive's state (one of STATES), and the text that describes a fault or silence."""

    state: str
    words: str | None
    note: str = ""  # further text for the page, such as why the state is unknown

    @property
    def fault(self) -> str | None:
        """The text of the drive's fault; None if the drive is in another state."""
        return self.words if self.state == FAULT else None

    @property
    def why_silent(self) -> str | None:
        return self.words if self.state == SILENT else None


class _Trip(NamedTuple):
    """A fault that was only noticed because the drive's register of past faults has changed."""

    words: str
    at_ns: int


def _rows_of(polls: Iterable[Polled], since_ns: int) -> dict[str, RegisterRows]:
    return {poll.register.name: RegisterRows(poll.register, since_ns) for poll in polls}


class _WatchedDrive:
    """One drive of the plant, with the newest rows of its polled registers."""

    def __init__(self, polled: PolledDrive, since_ns: int) -> None:
        self.polled = polled
        self.reader = StateReader(polled.drive)
        self.record: float | None = None  # newest value of the register of past faults
        self.trip: _Trip | None = None
        self.cells = _rows_of(polled.polls, since_ns)
        # computed channels are not in `cells`, because their values do not show whether the drive answers
        self.channels = _rows_of(polled.series[len(polled.polls) :], since_ns)
        self.frequency = next((name for name in FREQUENCIES if name in self.cells), "")
        # frequency in the last minute: pairs of time in ms and value
        self.minute: deque[tuple[int, float | None]] = deque(maxlen=MINUTE_POINTS)

    def hold(self, cycle_s: float) -> None:
        """Compute how long values stay current, on a line whose polling cycle takes `cycle_s`."""
        of_channels = self.polled.series[len(self.polled.polls) :]
        for cells, polls in ((self.cells, self.polled.polls), (self.channels, of_channels)):
            for poll in polls:
                cells[poll.register.name].holds_ns = round(current_for(max(cycle_s, poll.every or 0.0)) * 1e9)


class Hub:
    """The newest rows of a plant's registers. `take` must be called with every batch of rows.

    `clock` returns CLOCK_MONOTONIC and the computer's total time asleep, both in ns. `late_s` is how long
    after its request a row may arrive, in s.
    """

    def __init__(
        self, plant: Plant, clock: Callable[[], tuple[int, int]] = lambda: (0, 0), *, late_s: float = 0.0
    ) -> None:
        self.plant = plant
        self._clock = clock
        self._late_s = late_s
        _, self._slept_ns = clock()
        self._woke_ns = 0  # monotonic time, in ns, at which the computer's latest sleep was noticed
        self.time = 0  # request time of the newest row, UTC in ns
        self._time_ns = 0  # the same as monotonic time, because UTC may be set back
        self.taken = 0  # number of batches received
        self.unopened: dict[str, str] = {}  # why a port could not be opened, by line
        self.stalled: dict[str, str] = {}  # why an open port accepts no bytes, by line
        # Rows of a register; None for a register that is not in the plant. The key combines the register's
        # drive code and register code in a batch.
        self._cells: dict[int, RegisterRows | None] = {}
        self._statuses: tuple[str, ...] = ("ok",)
        self._watched: dict[str, _WatchedDrive] = {}
        self.adopt(plant)

    def adopt(self, plant: Plant, planned: Mapping[str, Any] | None = None) -> None:
        """Use another plant, and keep the rows of the drives that it does not change.

        For other drives, rows requested before this call are ignored: a name may mean another drive now. Pass
        `plant.metadata()["planned"]` as `planned` if it is known: computing it for hundreds of lines takes
        seconds.
        """
        before = self._watched
        since_ns = self._clock()[0] if before else 0
        self.plant = plant
        self._cells = {}
        self._watched = {}
        planned = plant.metadata()["planned"] if planned is None else planned
        for line in plant.lines:
            cycle_s = planned[line.name]["cycle_ms"] / 1e3 + self._late_s
            for polled in line.drives:
                known = before.get(polled.drive.name)
                stays = known is not None and known.polled == polled
                watched = known if known is not None and stays else _WatchedDrive(polled, since_ns)
                watched.hold(cycle_s)
                self._watched[polled.drive.name] = watched
        for (drive, name), seconds in ChannelSet(series_of(plant, planned)).holds_s.items():
            cell = self._watched[drive].channels[name]
            # the channel may have an input from another drive, whose values stay current longer
            cell.holds_ns = max(cell.holds_ns, round(seconds * 1e9))

    def take(self, batch: Batch) -> None:
        """Store the newest rows of a batch; takes about 1 us per row."""
        columns = batch.columns()
        cells = self._cells
        self._statuses = columns.statuses
        rows = zip(
            columns.time,
            columns.monotonic_ns,
            columns.drive,
            columns.register,
            columns.value,
            columns.status,
            strict=True,
        )
        for time, monotonic_ns, drive, register, value, status in rows:
            key = drive << 16 | register
            cell = cells.get(key)
            if cell is None:
                if key in cells:
                    continue
                cell = cells[key] = self._cell(columns.drives[drive], columns.registers[register])
                if cell is None:
                    continue
            if monotonic_ns < cell.since_ns:
                continue
            row = (time, monotonic_ns, value, status)
            if status == 0:
                cell.good = row
            cell.newest = row
            if monotonic_ns > self._time_ns:
                self.time, self._time_ns = time, monotonic_ns
        self.taken += 1

    def _cell(self, drive: str, register: str) -> RegisterRows | None:
        watched = self._watched.get(drive)
        return watched.cells.get(register) or watched.channels.get(register) if watched else None

    def now_ns(self) -> int:
        """Return the present time (CLOCK_MONOTONIC, ns). Rows have their times from the same clock."""
        return self._times()[0]

    def woke_ns(self) -> int:
        """Return when the computer's latest sleep was noticed (CLOCK_MONOTONIC, ns); 0 without one.

        Values requested before that time are stale.
        """
        return self._times()[1]

    def _times(self) -> tuple[int, int]:
        """Return the present time, and when the computer's latest sleep was noticed (CLOCK_MONOTONIC, ns).

        The clock is read on each call, because the process may have been suspended until now.
        """
        now_ns, slept_ns = self._clock()
        if slept_ns > self._slept_ns + LEAST_SLEEP_NS:
            self._woke_ns = now_ns + 1
        self._slept_ns = max(slept_ns, self._slept_ns)
        return now_ns, self._woke_ns

    # ---- the last minute ----

    def note_minute(self) -> None:
        """Add each drive's newest frequency to its curve of the last minute. Call this once a second."""
        for watched in self._watched.values():
            cell = watched.cells.get(watched.frequency)
            if cell is None or cell.newest is None:
                continue
            time_ns, _, value, status = cell.newest
            ms = time_ns // 1_000_000
            if not watched.minute or abs(ms - watched.minute[-1][0]) >= LEAST_POINT_MS:
                watched.minute.append((ms, None if status or not isfinite(value) else value))

    def last_minute(self) -> dict[str, dict[str, list[tuple[int, float | None]]]]:
        """Return the frequencies of the last minute by drive and register: pairs of time in ms and value.

        The value is None if the read failed.
        """
        return {
            name: {watched.frequency: list(watched.minute)}
            for name, watched in self._watched.items()
            if watched.minute
        }

    # ---- values ----

    def newest(self, drive: str, register: str) -> KeptRow | None:
        """Return the newest row of a register, which may be a failed read; None before the first read."""
        cell = self._cell(drive, register)
        return cell.newest if cell else None

    def fresh(self, drive: str, register: str, since_ns: int = 0) -> KeptRow | None:
        """Return the newest row of a register if it has a fresh value, requested at `since_ns` or later.

        Return None if the newest read has failed, is too old, or is from before the computer's last sleep.
        """
        cell = self._cell(drive, register)
        if cell is None or cell.newest is not cell.good or not cell.is_current(*self._times()):
            return None
        return cell.good if cell.good and cell.good[1] >= since_ns else None

    def holds_s(self, drive: str, register: str) -> float | None:
        """Return how long a value stays current, in s; None for a register that is not polled."""
        cell = self._cell(drive, register)
        return cell.holds_ns / 1e9 if cell else None

    @property
    def drives(self) -> Iterator[str]:
        """The names of all drives, in the plant file's order."""
        return iter(self._watched)

    def known(self, drive: str) -> Iterator[Known]:
        """Yield each polled register and channel of a drive with its rows, in the plant file's order."""
        now_ns, woke_ns = self._times()
        watched = self._watched[drive]
        for cell in (*watched.cells.values(), *watched.channels.values()):
            yield cell.register, cell.newest, cell.good, cell.is_current(now_ns, woke_ns)

    def status(self, code: int) -> str:
        return self._statuses[code]

    def last_answer(self, drive: str) -> KeptRow | None:
        """Return the newest value that a drive has sent, of any register; None if it never answered."""
        watched = self._watched.get(drive)
        good = [cell.good for cell in watched.cells.values() if cell.good] if watched else []
        return max(good, default=None, key=itemgetter(1))

    # ---- states ----

    def state(self, drive: str) -> str:
        """Return one of STATES."""
        return self.seen(drive).state

    def seen(self, drive: str) -> Shown:
        """Return a drive's state, with the text of its fault or the reason why it is silent."""
        watched = self._watched.get(drive)
        return Shown(UNKNOWN, None) if watched is None else self._look(watched)

    def is_set_to_zero(self, drive: str) -> bool:
        """Return True if a drive's frequency setpoint is known to be 0.

        Its motor may then rest during a run.
        """
        watched = self._watched[drive]
        setpoint = watched.polled.drive.setpoint_name
        return self._fresh_values(watched).get(setpoint) == 0

    def note_reset(self, drive: str) -> None:
        """Forget a fault seen in the register of past faults, because the fault was reset."""
        watched = self._watched.get(drive)
        if watched is not None:
            _forget_trip(watched)

    def _look(self, watched: _WatchedDrive) -> Shown:
        shown = self._shown(watched, self._fresh_values(watched))
        if FAULT_REGISTER not in watched.cells:
            _look_for_trip(watched)
        if watched.trip is None or shown.state == SILENT:
            return shown
        if shown.state == RUNS and _turns_since(watched, watched.trip.at_ns + RAN_NS):
            _forget_trip(watched)
            return shown
        return shown if shown.state == FAULT else Shown(FAULT, watched.trip.words, shown.note)

    def _fresh_values(self, watched: _WatchedDrive) -> dict[str, float]:
        """Return a drive's values by register that are not too old, even if later reads have failed."""
        times = self._times()
        return {
            name: cell.good[2]
            for name, cell in watched.cells.items()
            if cell.good and cell.is_current(*times)
        }

    def _shown(self, watched: _WatchedDrive, fresh: Mapping[str, float]) -> Shown:
        found = watched.reader.state(fresh)
        if found is not None and found.condition is not Condition.UNKNOWN:
            fault = found.fault or UNNAMED
            words = fault if found.condition is Condition.FAULT else None
            return Shown(_STATES[found.condition], words, found.note)
        if not fresh:
            return self._unseen(watched)
        if not watched.reader.has_state and fresh.get(FAULT_REGISTER):
            register = watched.polled.drive.registers[FAULT_REGISTER]
            return Shown(FAULT, _words(register, fresh[FAULT_REGISTER]))
        # 0 Hz does not show that a drive is stopped, because it may run with setpoint 0
        if any(fresh.get(name) for name in FREQUENCIES):
            return Shown(RUNS, None)
        note = found.note if found is not None else _lack(watched)
        return Shown(UNKNOWN, INCOMPLETE if any(name not in fresh for name in watched.cells) else None, note)

    def _unseen(self, watched: _WatchedDrive) -> Shown:
        """Return the state of a drive without fresh values: UNKNOWN if it replied recently, else SILENT."""
        newest = [cell.newest for cell in watched.cells.values() if cell.newest]
        misses = [row for row in newest if row[3] != 0]
        if not misses or len(misses) < len(watched.cells):
            return Shown(UNKNOWN, NOT_ASKED)
        reasons = [self._statuses[status] for _, _, _, status in sorted(misses, key=lambda row: -row[1])]
        if any(reason.startswith(_ANSWERED) for reason in reasons):
            return Shown(UNKNOWN, INCOMPLETE)
        why = next((reason for reason in reasons if not reason.startswith(UNASKED)), reasons[0])
        return Shown(SILENT, _NO_REPLY if why == _SKIPPED else why)


def _lack(watched: _WatchedDrive) -> str:
    """Return the text for the page about why a drive's state is unknown."""
    reader = watched.reader
    if not reader.has_state:
        return "its family has no register for its state"
    if not reader.lacks:
        return "at rest its state needs two readings in a row, which polled values do not give"
    return f"{reader.lacks} is {'not known' if reader.lacks in watched.cells else 'not polled'}"


def _look_for_trip(watched: _WatchedDrive) -> None:
    """Note a fault if the drive's register of past faults has changed.

    The first value of that register is skipped, because that fault may be an old one.
    """
    name = next((name for name in FAULT_RECORDS if name in watched.cells), "")
    cell = watched.cells.get(name)
    if cell is None or cell.good is None:
        return
    _, at_ns, value, _ = cell.good
    before, watched.record = watched.record, value
    if before is not None and value != before:
        words = _words(watched.polled.drive.registers[name], value)
        watched.trip = _Trip(words, at_ns) if value else None


def _turns_since(watched: _WatchedDrive, since_ns: int) -> bool:
    """Return True if the newest status and frequencies of the drive were requested after this time."""
    cells = [cell for name in ("status", *FREQUENCIES) if (cell := watched.cells.get(name)) and cell.good]
    return all(cell.good[1] > since_ns for cell in cells if cell.good)


def _forget_trip(watched: _WatchedDrive) -> None:
    watched.trip = None
    # a new reader, because the old one remembers the value of the register of past faults
    watched.reader = StateReader(watched.polled.drive)


def _words(register: Register[Any], value: float) -> str:
    """Return a fault as text, such as "overcurrent"; "last fault: 7" if the value has no name."""
    if register.values is not None:
        return register.in_words(register.decode(value))
    return f"{register.name.replace('_', ' ')}: {register.format(value)}"


# ---- values as clients get them ----


def digits_of(register: Register[Any]) -> int | None:
    """Return the number of digits after the decimal point; None if it varies, as for a float."""
    return None if register.is_float or register.scale_register else register.decimals


def published_value(register: Register[Any], value: float) -> float | str:
    """Return a register's value as published: a number, or the name of a choice."""
    return value if register.values is None else register.format(register.decode(value))


def published_values(hub: Hub, drive: str) -> dict[str, float | str | None]:
    """Return a drive's polled values by register; None for a value that is stale, infinite or missing."""
    return {
        register.name: published_value(register, good[2])
        if is_current and good is not None and newest is good and isfinite(good[2])
        else None
        for register, newest, good, is_current in hub.known(drive)
    }
