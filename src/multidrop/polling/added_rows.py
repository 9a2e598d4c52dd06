"""Rows that a poller adds to the core's rows: events, and values of computed channels and their totals."""

from __future__ import annotations

import json
import logging
import os
import threading
from array import array
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple
from weakref import ref

from multidrop.channels import OLD, ChannelSet, SlotRow
from multidrop.core import Columns
from multidrop.core.columns import COLUMNS
from multidrop.drive.family import Drive
from multidrop.plant.model import Plant, series_of
from multidrop.polling.batch import Batch, CopiedColumns, slot_rows, status_code
from multidrop.polling.jobs import RowNames
from multidrop.transport import clock
from multidrop.transport.aside_log import AsideThread, log_aside
from multidrop.transport.port_identity import is_simulated, of_name
from multidrop.whole_file import whole_file

# rows of events have this as drive name, and the kind of event as register name
EVENT = "event"
COMMENT, OUTAGE, TRIGGER = "comment", "outage", "trigger"  # kinds of events
# status of a computed channel's row if one of its inputs has no recent row
INPUT_OLD = status_code("input too old")
SAVE_NS = 10_000_000_000  # interval between writes of the file that keeps the channels' totals
LONGEST_TEXT = 500  # limit of an event's text, in characters
CLOSE_S = 2.0  # s; longest wait for the disk when polling ends
MOST_BYTES = 1 << 26  # limit of the size of the file that keeps the channels' totals

_log = logging.getLogger("multidrop.polling")


class AddedRow(NamedTuple):
    """A row to be added; its fields are the core's columns, with codes in place of names."""

    time: int
    sent: int
    uncertainty: int
    drive: int
    reg: int
    status: int
    value: float


class JoinedColumns(CopiedColumns):
    """A copy of other columns, with added rows at the end."""

    def __init__(self, columns: Columns | None, added: Sequence[AddedRow]) -> None:
        super().__init__(
            {
                name: (bytes(columns.array(name)) if columns is not None else b"")
                + array(kind, [getattr(row, name) for row in added]).tobytes()
                for name, kind in COLUMNS.items()
            }
        )


class AddedRows:
    """A poller's computed channels, and the events that wait for the next batch. Thread-safe."""

    def __init__(self, names: RowNames) -> None:
        self._names = names
        self._lock = threading.RLock()  # reentrant: a signal handler may close the poller during `take`
        self._channels = ChannelSet(())
        # codes of a drive and its register, by input slot (index of a register that channels use)
        self._codes: dict[int, tuple[int, int]] = {}
        # input slots, by the codes of the drive and the register
        self._slots: dict[tuple[int, int], int] = {}
        # the newest drive of each name; weak: a drive that was removed must not stay in memory
        self._drives: dict[str, ref[Drive]] = {}
        # For a name that another drive had before: the monotonic time of the new drive's first row.
        self._since_ns: dict[str, int] = {}  # by drive name
        self._slot_since_ns: dict[int, int] = {}  # by input slot
        self._events: list[AddedRow] = []
        self._totals: TotalsFile | None = None
        # totals by channel name, including those of channels that are not computed now
        self._kept: dict[str, Any] = {}
        self._save_ns = 0
        self._is_saved = True  # True if the totals have not changed since the last write

    def adopt(self, plant: Plant, polled_since: Mapping[str, int]) -> None:
        """Compute the channels of this plant from now on. Channels computed before keep their totals.

        `polled_since` has the monotonic time in ns since which each drive of the plant is polled, by drive
        name. If another drive has taken over a name, earlier rows of that name are not used.
        """
        channels = ChannelSet(series_of(plant))
        for mistake in channels.mistakes:  # for example, a channel names a drive that was removed
            log_aside(_log, logging.WARNING, "a channel is not computed: %s", mistake)
        place = totals_path(plant) if channels else None
        drives = {polled.drive.name: ref(polled.drive) for polled in plant.drives}
        with self._lock:
            replaced = {name for name, drive in drives.items() if self._drives.get(name, drive) != drive}
            self._since_ns |= {name: polled_since[name] for name in replaced}
            self._drives |= drives
            before, self._channels = self._channels, channels
            self._kept |= before.totals()
            if place and (self._totals is None or self._totals.path != place):
                self._totals = TotalsFile(place)
                self._kept = self._totals.read()
            for name in channels.restore(self._kept):
                self._note_start(f"{name} starts at 0, because its expression was changed", logging.WARNING)
            if self._totals:
                for name in channels.totals().keys() - self._kept.keys() - before.totals().keys():
                    self._note_start(f"{name} starts at 0", logging.INFO)
            channels.take_over(before, replaced)
            self._is_saved = False
            names = self._names
            self._codes = {
                slot: (names.drives.number(drive), names.registers.number(name))
                for (drive, name), slot in channels.slots.items()
            }
            self._slots = {self._codes[slot]: slot for slot in channels.inputs.values()}
            self._slot_since_ns = {
                slot: self._since_ns[drive]
                for (drive, _), slot in channels.inputs.items()
                if drive in self._since_ns
            }

    def _note_start(self, text: str, level: int) -> None:
        """Log why a total starts again instead of continuing the kept total, and add an event."""
        log_aside(_log, level, "%s", text)
        # raised if there are too many different event texts: then the event is only logged
        with suppress(ValueError):
            self.mark(OUTAGE, text)

    def mark(self, kind: str, text: str, ago_s: float = 0.0) -> None:
        """Add an event `ago_s` s before now. Raises ValueError for a text that is empty or too long."""
        text = " ".join(text.split())
        if not text or len(text) > LONGEST_TEXT or not text.isprintable():
            raise ValueError(f"an event has a text of 1 to {LONGEST_TEXT} printable characters, not {text!r}")
        ago_ns = round(ago_s * 1e9)
        with self._lock:
            row = self._event(clock.utc_ns() - ago_ns, clock.now_ns() - ago_ns, kind, text)
            self._events.append(row)

    def _event(self, time_ns: int, monotonic_ns: int, kind: str, text: str) -> AddedRow:
        names = self._names
        codes = names.drives.number(EVENT), names.registers.number(kind)
        return AddedRow(time_ns, monotonic_ns, 0, *codes, status_code(text), 0.0)

    # ---- batches ----

    def __bool__(self) -> bool:
        """Return True if the next batch may get rows of channels or events."""
        return bool(self._channels or self._events)

    def added_to(self, batch: Batch | None) -> Batch | None:
        """Return the batch with the rows of channels and events appended; None if the result has no rows."""
        with self._lock:
            added, self._events = self._events, []
            if batch is not None and self._channels:
                added += self._computed(batch)
        if not added:
            return batch
        columns = batch.parts()[0] if batch is not None else None
        return Batch(JoinedColumns(columns, added), self._names.drives, self._names.registers)

    def _computed(self, batch: Batch) -> list[AddedRow]:
        # The boot time is read first. So a pause between the two reads can only make the difference smaller.
        slept_ns = clock.boottime_ns() - clock.now_ns()
        added = [
            AddedRow(
                row.time_ns,
                row.monotonic_ns,
                row.uncertainty_ns,
                *self._codes[row.slot],
                INPUT_OLD if row.status == OLD else row.status,
                row.value,
            )
            for row in self._channels.compute(self._rows_of_present_drives(batch), slept_ns)
        ]
        outages, self._channels.outages = self._channels.outages, []
        for number, outage in enumerate(outages):
            log_aside(_log, logging.WARNING, "%s", outage)
            # events get different times, because InfluxDB keeps only one row for each series and time
            end_ns = outage.end_ns + number
            # raised if there are too many different event texts: then the outage is only logged
            with suppress(ValueError):
                added.append(self._event(end_ns, clock.now_ns(), OUTAGE, str(outage)))
        self._is_saved &= not added
        if self._totals and clock.now_ns() >= self._save_ns:
            self._save_ns = clock.now_ns() + SAVE_NS
            self._write_totals(self._totals)
        return added

    def _rows_of_present_drives(self, batch: Batch) -> Iterator[SlotRow]:
        """Yield the rows from which channels are computed, without rows of replaced drives."""
        rows = slot_rows(batch.columns(), self._slots)
        since_ns = self._slot_since_ns
        return (row for row in rows if row.monotonic_ns >= since_ns.get(row.slot, 0)) if since_ns else rows

    def _write_totals(self, file: TotalsFile) -> None:
        if totals := self._kept | self._channels.totals():
            file.write(totals)
        self._is_saved = True

    def save(self) -> None:
        """Write the totals if they have changed, and wait up to CLOSE_S for the disk."""
        with self._lock:
            if self._totals and not self._is_saved:
                self._write_totals(self._totals)
                self._totals.flush()


# ---- the file of totals ----


def totals_path(plant: Plant) -> Path | None:
    """Return the path of the file with the totals of a plant's channels; None if no totals are kept.

    The plant file's key `totals` sets the path. By default, the file is in the service's state folder, or
    beside the plant file if there is no service. A simulation of the plant uses a different file.
    """
    if plant.totals is not None:
        return plant.totals
    if not plant.path.is_file():
        return None
    state = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    is_real = not any(is_simulated(of_name(line.port)) for line in plant.lines)
    name = f"{plant.path.stem}{'' if is_real else '.simulated'}.totals.json"
    return (Path(state) if state else plant.path.parent) / name


class TotalsFile:
    """A file that keeps the totals of channels over restarts.

    A thread writes the file, so that rows never wait for the disk.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._thread = AsideThread("multidrop totals")
        self._failure = ""
        self._waiting: dict[str, Any] | None = None  # the newest totals, if they are not written yet

    def read(self) -> dict[str, Any]:
        """Return the kept totals; {} if the file does not exist or is damaged.

        A damaged file is renamed to FILE.damaged.
        """
        try:
            with self.path.open("rb") as file:
                found = json.loads(file.read(MOST_BYTES))
        except FileNotFoundError:
            return {}
        except (OSError, ValueError, RecursionError) as failure:
            log_aside(_log, logging.ERROR, "totals start at 0: %s cannot be read: %s", self.path, failure)
            with suppress(OSError):
                if self.path.is_file():
                    self.path.replace(self.path.with_name(f"{self.path.name}.damaged"))
            return {}
        return found if isinstance(found, dict) else {}

    def write(self, totals: dict[str, Any]) -> None:
        """Queue a write of the totals, which replace the file's content."""
        self._waiting = totals
        self._thread.put(self._write)

    def _write(self) -> None:
        totals, self._waiting = self._waiting, None
        if totals is None:  # an earlier call has already written the newest totals
            return
        try:
            with whole_file(self.path) as part:
                part.write_text(json.dumps(totals, indent=1), "utf-8")
            self._failure = ""
        except Exception as failure:  # log the failure, so that a bug is seen
            if str(failure) != self._failure:
                is_usual = isinstance(failure, OSError)
                _log.error("totals are not kept: %s", failure, exc_info=not is_usual)
            self._failure = str(failure)

    def flush(self) -> None:
        """Wait up to CLOSE_S until all queued writes are done, unless an earlier wait timed out."""
        if not self._thread.hangs(CLOSE_S) and not self._thread.flush(CLOSE_S):
            _log.error("totals are not kept: %s has not been written for %g s", self.path, CLOSE_S)
