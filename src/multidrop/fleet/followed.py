"""FollowedFleet: a fleet's lines and newest samples, for a gateway that polls no lines of its own."""

from __future__ import annotations

import asyncio
import logging
import time
from array import array
from collections import deque
from collections.abc import Callable, Container, Coroutine, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import pyarrow as pa

from multidrop import LineError, Plant, PlantLine
from multidrop.fleet.errors import FleetError
from multidrop.fleet.overview import FleetWatch
from multidrop.fleet.samples.samples_stream import StreamMessage, read_after, stream_info
from multidrop.fleet.servers.buckets import Record
from multidrop.fleet.servers.connections import ServerPath
from multidrop.fleet.servers.plant_store import line_of
from multidrop.polling import BatchColumns
from multidrop.samples import MessageError, unpack
from multidrop.transport import LineStatistics

# limits of one read from the stream: number of messages, and their size in bytes
MOST_READ, MOST_READ_BYTES = 64, 8 << 20
MOST_BATCHES = 100  # limit of batches of samples that wait for the gateway; the oldest are dropped
PAUSE_S = 0.2  # pause after a read from the stream without a new message
AGAIN_S = 1.0  # pause after a failure, and between two checks of the fleet's lines
SILENT_S = 6.0  # a line counts as lost after this many seconds without a sample
MOST_NAMES = 65_535  # limit of different drive names, and of register names: their codes have 16 bits
MOST_STATUSES = 1000  # limit of different status texts
OTHER = "other"  # shown instead of a status if MOST_STATUSES different ones were seen before
NO_VALUE = "no valid value"  # status of a sample that is marked "ok" but has no value
LATE_S = 5.0  # samples that are older than this on arrival are reported
EARLY_S = 2.0  # samples dated further in the future than this are reported, because a clock is wrong

_log = logging.getLogger("multidrop.fleet")


class FollowedLine(NamedTuple):
    """A line that another gateway of the fleet polls.

    It has those attributes of a Bus that the web page and other parts of `multidrop serve` read.
    """

    identity: str  # the port
    why_lost: str = ""
    is_lost: bool = False  # always False, because this process has no port for the line
    audit_trouble: str = ""

    @property
    def line(self) -> FollowedLine:
        return self


class FollowedRows:
    """The newest sample of each register in a group of messages, with the columns of a Batch."""

    def __init__(self, columns: BatchColumns) -> None:
        self._columns = columns

    def columns(self) -> BatchColumns:
        return self._columns


class NameCodes:
    """Gives each name a number, in the order of first use.

    After `most` different names, all new names share one number: that of the name `rest`.
    """

    def __init__(self, most: int, rest: str, *names: str) -> None:
        self._most, self._rest = most, rest
        self._codes = {name: code for code, name in enumerate(names)}

    def code(self, name: str) -> int:
        if name not in self._codes and len(self._codes) >= self._most:
            name = self._rest
        return self._codes.setdefault(name, len(self._codes))

    def names(self) -> tuple[str, ...]:
        return tuple(self._codes)


class RowReader:
    """Converts messages into samples with this computer's monotonic times. One thread at a time uses it."""

    def __init__(self, clocks: Callable[[], tuple[int, int]]) -> None:
        # pairs of drive and register to read; samples of other pairs are ignored
        self.known: Container[tuple[str, str]] = ()
        self._clocks = clocks
        # names beyond MOST_NAMES become "", a name that the gateway ignores
        self._drives, self._registers = NameCodes(MOST_NAMES, ""), NameCodes(MOST_NAMES, "")
        self._statuses = NameCodes(MOST_STATUSES, OTHER, "ok")
        self._newest: dict[tuple[str, str], int] = {}  # time of the newest sample, by drive and register
        self._read_ns = 0  # this computer's clock (UTC, ns) at the last call of `rows`
        # arrival time of the newest sample, and the sample's own time (UTC, ns), by gateway
        self.arrivals: dict[str, tuple[int, int]] = {}

    def rows(self, messages: Sequence[StreamMessage]) -> FollowedRows | None:
        """Return the newest sample of each register in the messages; None if no sample is new.

        Skip a sample that is older than a returned sample of the same register: a gateway may send samples of
        a line long after another gateway has taken the line over.
        """
        now_ns, utc_ns = self._clocks()
        if utc_ns < self._read_ns:  # the clock was set back, so known times may be in the future now
            self._newest.clear()
        self._read_ns = utc_ns
        found: dict[tuple[str, str], tuple[int, int | None, float | None, str]] = {}
        for message in messages:
            for key, row in _newest_rows(message):
                time_ns = min(row[0], utc_ns)
                if key in self.known and time_ns > self._newest.get(key, 0):
                    self._newest[key] = time_ns
                    found[key] = (time_ns, *row[1:])
                self.arrivals[message.gateway] = utc_ns, row[0]
        if not found:
            return None
        times = [row[0] for row in found.values()]
        statuses = [self._statuses.code(row[3]) for row in found.values()]
        valid = sum(1 << at for at, status in enumerate(statuses) if status == 0)
        return FollowedRows(
            BatchColumns(
                time=memoryview(array("q", times)),
                monotonic_ns=memoryview(array("q", [now_ns - (utc_ns - time_ns) for time_ns in times])),
                uncertainty_ns=memoryview(array("q", [row[1] or 0 for row in found.values()])),
                drive=memoryview(array("H", [self._drives.code(drive) for drive, _ in found])),
                register=memoryview(array("H", [self._registers.code(register) for _, register in found])),
                value=memoryview(array("d", [row[2] or 0.0 for row in found.values()])),
                status=memoryview(array("H", statuses)),
                valid=memoryview(valid.to_bytes((len(statuses) + 7) // 8, "little")),
                drives=self._drives.names(),
                registers=self._registers.names(),
                statuses=self._statuses.names(),
            )
        )


def _newest_rows(message: StreamMessage) -> list[tuple[tuple[str, str], tuple[Any, ...]]]:
    """Return the newest sample (time, uncertainty, value, status) of each pair of drive and register."""
    if message.sequence == 0:  # the message is not from a gateway
        return []
    try:
        table = unpack(message.data)
    except MessageError as error:
        _log.error("%s: message %d is ignored: %s", message.gateway, message.sequence, error)
        return []
    names = {name: table.column(name).cast(pa.utf8()) for name in ("drive", "register", "status")}
    times = table.column("time").cast(pa.int64())
    keyed = pa.table([names["drive"], names["register"], times], names=["drive", "register", "time"])
    keyed = keyed.append_column("at", pa.array(range(len(keyed))))
    last = keyed.group_by(["drive", "register"]).aggregate([("at", "max")]).column("at_max")
    columns = (
        *(names["drive"], names["register"], times, table.column("uncertainty_ns"), table.column("value")),
        names["status"],
    )
    rows = zip(*(column.take(last).to_pylist() for column in columns), strict=True)
    return [
        ((drive, register), (*row, value, NO_VALUE if value is None and status == "ok" else status))
        for drive, register, *row, value, status in rows
    ]


def _clocks() -> tuple[int, int]:
    return time.monotonic_ns(), time.time_ns()


class FollowedFleet:
    """The lines of a fleet, with those methods of a Poller that `multidrop serve` uses.

    The samples are read over the server connection `path`; `watch` reads the fleet's lines and masters.
    `on_change` is called in the event loop when the fleet's lines have changed; the gateway then calls
    `adopt`.
    """

    dropped = 0
    line_failures: Mapping[str, str] = {}

    def __init__(self, path: ServerPath, watch: FleetWatch) -> None:
        self.plant = Plant(())
        self.on_change: Callable[[], object] = lambda: None
        self.trouble = "no samples were read yet"  # "" if the samples can be read
        self.path = path
        self._watch = watch
        self._reader = RowReader(_clocks)
        self._rows: deque[FollowedRows] = deque(maxlen=MOST_BATCHES)
        self._folder = TemporaryDirectory(prefix="multidrop-")
        self._records: Mapping[str, Record] = {}  # line records that the next call of `adopt` will use
        self._wanted: Mapping[str, int] = {}  # revisions of the line records at the last call of `on_change`
        # revision of a line's record, and the parsed line (None if the record has a mistake), by line
        self._lines: dict[str, tuple[int, PlantLine | None]] = {}
        self._line_of: dict[str, str] = {}  # line names by drive
        self._begun = time.monotonic()
        self._heard: dict[str, float] = {}  # arrival time of the newest sample, by line

    # ---- reading ----

    def works(self) -> list[Coroutine[Any, Any, None]]:
        """Return the coroutines that must run as long as this object is used."""
        return [self.path.keep(), self._read_rows(), self._watch_lines()]

    async def _read_rows(self) -> None:
        """Read new samples until cancelled. Older messages of the stream are skipped."""
        while True:
            try:
                place = (await stream_info(self.path)).last
                self.trouble = ""
                while True:
                    place = await self._read_after(place)
            except FleetError as failure:
                self.trouble = str(failure)
            await asyncio.sleep(AGAIN_S)

    async def _read_after(self, place: int) -> int:
        messages = await read_after(self.path, place, MOST_READ, MOST_READ_BYTES)
        if not messages:
            await asyncio.sleep(PAUSE_S)
            return place
        rows = await asyncio.to_thread(self._reader.rows, messages)
        if rows is not None:
            now, columns = time.monotonic(), rows.columns()
            drives = {columns.drives[code] for code in columns.drive}
            self._heard |= {line: now for drive in drives if (line := self._line_of.get(drive))}
            self._rows.append(rows)
        return messages[-1].place

    async def _watch_lines(self) -> None:
        """Call `on_change` when the fleet's lines have changed, until cancelled."""
        while True:
            records = self._watch.lines()
            revisions = {name: record.revision for name, record in records.items()}
            if self._watch.age_s is not None and revisions != self._wanted:
                self._records, self._wanted = records, revisions
                self.on_change()
            await asyncio.sleep(AGAIN_S)

    def health(self) -> str:
        now_ns = time.time_ns()
        ages_s = {
            gateway: (arrived_ns - asked_ns) / 1e9
            for gateway, (arrived_ns, asked_ns) in sorted(self._reader.arrivals.items())
            if now_ns - arrived_ns < SILENT_S * 1e9
        }
        odd = [
            f"samples of {gateway} are {age_s:.0f} s old on arrival: it sends a backlog, or its clock is slow"
            if age_s > 0
            else f"the clock of {gateway} is {-age_s:.0f} s ahead of this computer's"
            for gateway, age_s in ages_s.items()
            if not -EARLY_S <= age_s <= LATE_S
        ]
        return "; ".join([self.trouble] if self.trouble else odd)

    # ---- as a Poller ----

    def __enter__(self) -> FollowedFleet:
        return self

    def close(self) -> None:
        self._folder.cleanup()

    def take(self) -> FollowedRows | None:
        return self._rows.popleft() if self._rows else None

    def adopt(self, plant: Plant) -> dict[str, LineError]:
        """Use the fleet's present lines; take all other settings from the plant file."""
        records, before = self._records, self._lines
        self._lines = {
            name: before[name]
            if name in before and before[name][0] == record.revision
            else (record.revision, self._line(record))
            for name, record in sorted(records.items())
        }
        lines = tuple(line for _, line in self._lines.values() if line is not None)
        self._line_of = {polled.drive.name: line.name for line in lines for polled in line.drives}
        self._reader.known = {
            (polled.drive.name, poll.register.name)
            for line in lines
            for polled in line.drives
            for poll in polled.series
        }
        self.plant = replace(plant, lines=lines)
        return {}

    def _line(self, record: Record) -> PlantLine | None:
        try:
            return line_of(record, Path(self._folder.name))
        except (KeyError, TypeError, ValueError, OSError) as mistake:
            _log.error("line %s of the fleet is not shown: %s", record.key, mistake)
            return None

    @property
    def buses(self) -> dict[str, FollowedLine]:
        """The lines by name. A line that is not polled has a reason in `why_lost`."""
        state = self._watch.state()
        return {
            line.name: FollowedLine(line.port, self._why_lost(line.name, state)) for line in self.plant.lines
        }

    def _why_lost(self, line: str, fleet: Mapping[str, Any]) -> str:
        """Return the reason why no values of this line arrive; "" if a value has arrived recently."""
        master = fleet["lines"].get(line, {}).get("master")
        gateway = fleet["gateways"].get(master, {})
        says = gateway.get("says")
        if says and line in says["troubles"]:
            return f"{master}: {says['troubles'][line]}"
        if time.monotonic() - self._heard.get(line, self._begun) < SILENT_S:
            return ""
        if fleet["trouble"]:
            return f"the fleet's servers do not answer: {fleet['trouble']}"
        if master is None:
            return "no gateway of the fleet polls it"
        return f"its gateway {master} {'sends no samples' if says else 'does not answer'}"

    def bus(self, line: str) -> Any:
        raise ValueError(f"line {line} is polled by a gateway of the fleet, not by this one")

    def statistics(self) -> dict[str, LineStatistics]:
        return {}
