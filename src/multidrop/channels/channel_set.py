"""ChannelSet: compute the rows of a plant's channels from the polled rows of its registers."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from math import isfinite
from typing import Any, NamedTuple

from multidrop.channels.functions import Value
from multidrop.channels.grammar import ExpressionError
from multidrop.channels.program import Channel, DriveSeries, Program, SeriesTable
from multidrop.channels.units import unit_of
from multidrop.core import Status

MOST_CHANNELS = 1000  # limit of channels in a plant
MOST_NAME = 100  # limit of characters in a channel's name, and in its unit
UNSEEN = -1  # status of a register or channel that has had no row yet
OLD = -2  # status of a register or channel whose newest value is too old
# in ns: the operating system reports the time asleep inexactly, so shorter sleeps are ignored
LEAST_SLEEP_NS = 100_000_000


class Mistake(NamedTuple):
    """A mistake in a channel, described in one sentence."""

    drive: str
    channel: str
    sentence: str

    def __str__(self) -> str:
        return f'drive "{self.drive}", channel "{self.channel}": {self.sentence}'


class SlotRow(NamedTuple):
    """A row of a register or channel.

    Only a row with the status 0 has a value. A channel's row has the status OLD if one of its registers has
    had no row for too long.
    """

    slot: int  # index of the register or channel
    time_ns: int
    monotonic_ns: int
    uncertainty_ns: int
    value: float
    status: int


class Outage(NamedTuple):
    """A period until `end_ns` that a channel's totals do not include, because a value was unknown."""

    channel: str  # DRIVE.CHANNEL, such as "pump-1.energy"
    end_ns: int  # UTC
    seconds: float

    def __str__(self) -> str:
        seconds = f"{self.seconds:.0f}" if self.seconds >= 100 else f"{self.seconds:.3g}"
        return f"{self.channel}: {seconds} s without values are not counted"


class _Computed(NamedTuple):
    drive: str
    channel: Channel
    program: Program
    slot: int

    @property
    def name(self) -> str:
        return f"{self.drive}.{self.channel.name}"


class ChannelSet:
    """The valid channels of drives. `mistakes` lists the mistakes in invalid channels.

    A series is a register or a channel. `slots` maps the drive and the name of each series to its index.
    Registers have the first slots.
    """

    def __init__(self, drives: Sequence[DriveSeries]) -> None:
        self.mistakes: list[Mistake] = []
        series = SeriesTable(drives)
        self.slots: Mapping[tuple[str, str], int] = series.slots
        self.inputs = dict(series.slots)  # indexes of the registers only
        self._computed: list[_Computed] = []
        self._drive_of = [drive for drive, _ in series.slots]
        for drive in drives:
            for channel in drive.channels:
                self._add(drive, channel, series)
        size = len(series.units)
        self._values: list[Value] = [None] * size
        self._statuses = [UNSEEN] * size
        self._sent_ns = [0] * size
        self._known_ns: dict[int, int] = {}  # monotonic time of the newest known value, by index
        self._gaps: set[int] = set()  # indexes of channels that use a value which is too old
        self._holds_ns = [round(hold_s * 1e9) for hold_s in series.holds_s]
        # UTC in ns of the newest value in the restored totals, by channel index
        self._restored_ns: dict[int, int] = {}
        self._newest_ns: dict[int, int] = {}  # UTC in ns of the newest value in the totals, by channel index
        # periods without values that have ended; the caller empties this list
        self.outages: list[Outage] = []
        self._slept_ns = 0  # how long the computer has slept, at the latest call of `compute`
        self._ahead_ns: int | None = None  # UTC minus monotonic time of the newest row

    def _add(self, drive: DriveSeries, channel: Channel, series: SeriesTable) -> None:
        try:
            program = self._checked(drive, channel, series)
        except ExpressionError as mistake:
            self.mistakes.append(Mistake(drive.name, channel.name, f"value: {mistake}"))
        except ValueError as mistake:
            self.mistakes.append(Mistake(drive.name, channel.name, str(mistake)))
        else:
            slot = series.add(drive.name, channel.name, unit_of(channel.unit), program.hold_s)
            self._computed.append(_Computed(drive.name, channel, program, slot))

    def _checked(self, drive: DriveSeries, channel: Channel, series: SeriesTable) -> Program:
        """Check a channel and compile its expression to a program. Raises ValueError for a mistake."""
        if not channel.name.isidentifier():
            raise ValueError(f"{channel.name!r} is not a valid channel name; use letters, digits and _")
        if max(len(channel.name), len(channel.unit)) > MOST_NAME:
            raise ValueError(f"a channel's name and its unit have at most {MOST_NAME} characters each")
        if channel.name in drive.known or (drive.name, channel.name) in series.slots:
            raise ValueError(
                f"{drive.name} already has a register or channel {channel.name!r}; "
                "give the channel another name"
            )
        if len(self._computed) == MOST_CHANNELS:
            raise ValueError(f"a plant has at most {MOST_CHANNELS} channels")
        return Program(channel.value, drive.name, series, channel.unit)

    def __bool__(self) -> bool:
        return bool(self._computed)

    @property
    def holds_s(self) -> Mapping[tuple[str, str], float]:
        """Seconds for which a value of each channel is valid, by drive and channel name."""
        return {(one.drive, one.channel.name): one.program.hold_s for one in self._computed}

    # ---- rows ----

    def compute(self, rows: Iterable[SlotRow], slept_ns: int = 0) -> list[SlotRow]:
        """Return the rows of channels that are computed from these rows of registers.

        `slept_ns` is how long the computer has slept since its boot: the monotonic clock stops meanwhile. A
        channel gets a row for each request that read one of its registers, with the time of that request.
        If the newest row of a register has no value, the channel's row has none either, and the same status.
        If a register has had no row for too long, the channel's row has no value and the status OLD.
        """
        if self._ahead_ns is None:
            self._slept_ns = slept_ns
        step_ns = slept_ns - self._slept_ns
        if self._ahead_ns is None or step_ns <= LEAST_SLEEP_NS:
            return self._compute(rows)
        self._slept_ns = slept_ns
        listed, awake_ns = [*rows], self._ahead_ns + step_ns // 2
        found = self._compute(row for row in listed if row.time_ns - row.monotonic_ns < awake_ns)
        self._known_ns = {slot: known_ns - step_ns for slot, known_ns in self._known_ns.items()}
        for computed in self._computed:
            computed.program.note_sleep(step_ns)
        return found + self._compute(row for row in listed if row.time_ns - row.monotonic_ns >= awake_ns)

    def _compute(self, rows: Iterable[SlotRow]) -> list[SlotRow]:
        found: list[SlotRow] = []
        group: dict[int, SlotRow] = {}  # rows of one request, by index of the register
        key: tuple[int, str] | None = None
        for row in rows:
            before, key = key, (row.monotonic_ns, self._drive_of[row.slot])
            if group and (key != before or row.slot in group):
                found += self._computed_from([*group.values()])
                group = {}
            group[row.slot] = row
        if group:
            found += self._computed_from([*group.values()])
        return found

    def _computed_from(self, group: list[SlotRow]) -> Iterator[SlotRow]:
        """Compute channels from the rows of one request; yield the channels' rows."""
        fresh: set[int] = set()
        uncertainty_ns = max(row.uncertainty_ns for row in group)
        for row in group:
            self._note(row, fresh)
        first = group[0]
        self._ahead_ns = first.time_ns - first.monotonic_ns
        for computed in self._computed:
            program = computed.program
            if program.slots.isdisjoint(fresh):
                continue
            self._expire(computed, first.monotonic_ns)
            value = program.run(self._values, fresh, first.monotonic_ns)
            self._note_outages(computed, first)
            status = self._status(program.slots)
            if status == UNSEEN:
                continue
            if status == Status.OK and value is None:
                status = Status.NO_VALUE
            row = SlotRow(
                computed.slot,
                first.time_ns,
                first.monotonic_ns,
                uncertainty_ns,
                0.0 if value is None else value,
                status,
            )
            self._note(row, fresh)
            yield row

    def _expire(self, computed: _Computed, now_ns: int) -> None:
        """Treat the values of a channel's registers as unknown if they are too old at `now_ns` (monotonic).

        Integrals and other stateful functions do not count the time until the next known value. The status
        becomes OLD, unless the newest row already has no value for another reason.
        """
        gone = set()
        for slot in computed.program.slots:
            if now_ns - self._known_ns.get(slot, now_ns) > self._holds_ns[slot]:
                gone.add(slot)
                if self._statuses[slot] == Status.OK:
                    self._values[slot], self._statuses[slot] = None, OLD
            elif slot in self._gaps:
                gone.add(slot)
        self._gaps.discard(computed.slot)
        if gone:
            self._gaps.add(computed.slot)
            computed.program.interrupt(gone)

    def _note(self, row: SlotRow, fresh: set[int]) -> None:
        is_good = row.status == Status.OK and isfinite(row.value)
        self._values[row.slot] = row.value if is_good else None
        if is_good:
            self._known_ns[row.slot] = row.monotonic_ns
        self._statuses[row.slot] = row.status
        self._sent_ns[row.slot] = row.monotonic_ns
        fresh.add(row.slot)

    def _status(self, slots: Iterable[int]) -> int:
        """Return the status of a row that is computed from the newest rows of the given series.

        If some of these rows have no value, it is the status of the newest such row.
        """
        missing = [slot for slot in slots if self._statuses[slot] not in (Status.OK, UNSEEN)]
        if missing:
            return self._statuses[max(missing, key=self._sent_ns.__getitem__)]
        return min(self._statuses[slot] for slot in slots)  # UNSEEN if a series has had no row yet

    def _note_outages(self, computed: _Computed, row: SlotRow) -> None:
        """If an outage of this channel ended with this row, add it to `outages`.

        A restart counts as an outage.
        """
        totals = computed.program.totals
        if not totals or any(self._values[slot] is None for slot in computed.program.slots):
            return
        seconds = max(memory.outage_s for memory in totals)
        for memory in totals:
            memory.outage_s = 0.0
        if (restored_ns := self._restored_ns.pop(computed.slot, None)) is not None:
            seconds = max(seconds, (row.time_ns - restored_ns) / 1e9)
        if seconds > 0:
            self.outages.append(Outage(computed.name, row.time_ns, seconds))
        self._newest_ns[computed.slot] = row.time_ns

    # ---- totals ----

    def take_over(self, before: ChannelSet, replaced: Collection[str] = ()) -> None:
        """Continue the totals of channels that `before` has too, with the same expression and units.

        `before` is an earlier set. `replaced` are names that now belong to other drives. Totals do not count
        the time between the last value of the old drive and the first value of the new one.
        """
        self._slept_ns, self._ahead_ns = before._slept_ns, before._ahead_ns
        known = {(one.name, one.channel, *one.program.units): one for one in before._computed}
        for one in self._computed:
            if same := known.get((one.name, one.channel, *one.program.units)):
                for memory, old in zip(one.program.memories, same.program.memories, strict=True):
                    memory.take_over(old)
                self._restored_ns.pop(one.slot, None)
                if same.slot in before._restored_ns:
                    self._restored_ns[one.slot] = before._restored_ns[same.slot]
                if same.slot in before._newest_ns:
                    self._newest_ns[one.slot] = before._newest_ns[same.slot]
        changed = {slot for (drive, _), slot in self.inputs.items() if drive in replaced}
        for one in self._computed:
            if not one.program.slots.isdisjoint(changed):
                # so that the channels that use this channel are interrupted too
                changed.add(one.slot)
                one.program.interrupt(changed)

    def totals(self) -> dict[str, Any]:
        """Return the integrals and counts that `restore` continues after a restart."""
        return {
            one.name: {
                "value": one.channel.value,
                "units": one.program.units,
                "totals": [memory.kept for memory in one.program.totals],
                "time_ns": self._newest_ns.get(one.slot, self._restored_ns.get(one.slot)),
            }
            for one in self._computed
            if one.channel.is_kept and one.program.totals
        }

    def restore(self, kept: Mapping[str, Any]) -> list[str]:
        """Continue with stored totals; return the channels that start at 0 instead.

        These are the channels whose expression was changed, or whose stored totals are damaged.
        """
        changed = []
        for one in self._computed:
            about = kept.get(one.name)
            totals = one.program.totals
            if not totals or about is None or not one.channel.is_kept:
                continue
            numbers = _numbers(about, one)
            if numbers is None:
                changed.append(one.name)
                continue
            for memory, own in zip(totals, numbers, strict=True):
                memory.kept = own
            time_ns = about.get("time_ns")
            if isinstance(time_ns, int) and 0 < time_ns < 1 << 63:
                self._restored_ns[one.slot] = time_ns
        return changed


def _numbers(about: Any, computed: _Computed) -> list[list[float]] | None:
    """Return a channel's stored totals as numbers.

    Return None if they are damaged, or if the channel's expression has changed.
    """
    program = computed.program
    if not isinstance(about, dict) or about.get("value") != computed.channel.value:
        return None
    totals = about.get("totals")
    if about.get("units") != program.units or not isinstance(totals, list):
        return None
    if len(totals) != len(program.totals):
        return None
    for numbers in totals:
        if not isinstance(numbers, list) or not 1 <= len(numbers) <= 2:
            return None
        if not all(isinstance(number, float) and isfinite(number) for number in numbers):
            return None
    return totals
