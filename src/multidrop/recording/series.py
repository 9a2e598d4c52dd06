"""A recording's rows as numpy arrays, for reports and for exports to other systems; needs numpy."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from multidrop.polling.added_rows import EVENT, TRIGGER
from multidrop.polling.batch import ROW_COLUMNS, Rows
from multidrop.printable import is_whole
from multidrop.recording.format import Metadata, RecordingWriter, tables_in, writing

LONGEST_NAME = 4096  # limit of a name's length in bytes
LARGEST_COUNT = 2**53  # largest count that a float64 holds exactly
LATEST_NS = 230 * 365 * 86400 * 10**9  # ns UTC; libraries cannot convert later times to dates
RAW = "raw count"  # unit of values without a known scale
PIECE_ROWS = 1 << 18  # number of rows that an export collects in memory
MOST_CODES = 1 << 16  # largest number of different drives, of different registers, and of different statuses
Array = NDArray[Any]


# ---- columns ----


def codes_of(column: Any, known: dict[str, int]) -> Array:
    """Return the code of each row's text. `known` maps texts to codes; new texts are added to it."""
    ends = np.array(column.buffer(1))[: column.length + 1]
    lengths = np.diff(ends)
    if lengths.max(initial=0) > LONGEST_NAME:
        raise ValueError(
            f"a name has {lengths.max()} bytes: names in a recording have at most {LONGEST_NAME}"
        )
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


def numbers_of(column: Any) -> Array:
    """Return a column of numbers, with NaN for nulls."""
    numbers = np.array(column.buffer(1))[: column.length]
    if not column.null_count:
        return numbers
    valid = np.unpackbits(np.frombuffer(bytes(column.buffer(0)), np.uint8), bitorder="little")
    return np.where(valid[: column.length] == 1, numbers.astype(float), np.nan)


def rows_by_series(drive: Array, register: Array, time: Array) -> list[Array]:
    """Return the row indexes of each series (a drive's register), in the order of time.

    `drive` and `register` are codes. There must be at least one row.
    """
    pair = drive.astype(np.int64) * (int(register.max()) + 1) + register
    order = np.lexsort((time, pair))
    return np.split(order, np.flatnonzero(np.diff(pair[order])) + 1)


# ---- metadata ----


def checked_drives(metadata: object) -> dict[str, Any]:
    """Return the metadata of drives and registers without invalid entries."""
    found = {}
    for name, about in tables_in(metadata, "drives"):
        registers = {register: _checked(table) for register, table in tables_in(about, "registers")}
        found[name] = {**about, "registers": registers}
    return found


def _checked(register: dict[str, Any]) -> dict[str, Any]:
    values = register.get("values")
    if not isinstance(values, dict):
        return {**register, "values": None}
    return {**register, "values": {name: count for name, count in values.items() if _is_count(count)}}


def _is_count(count: object) -> bool:
    return is_whole(count) and abs(count) < LARGEST_COUNT


def unit_of_register(about: Mapping[str, Any]) -> str:
    """Return the unit in a register's metadata: "raw count" without a known scale, "" for named values."""
    if about.get("values"):
        return ""
    if "step" in about and about["step"] is None:
        return RAW
    return str(about.get("unit") or "")


class Event(NamedTuple):
    """A comment, an outage or a trigger in a recording; `time` is in ns UTC."""

    time: int
    kind: str
    text: str


def trigger_of(metadata: Mapping[str, Any]) -> Event | None:
    """Return the trigger in a recording's metadata; None without one."""
    found = metadata.get("trigger")
    table = found if isinstance(found, dict) else {}
    time, condition = table.get("time_ns"), table.get("condition")
    if not isinstance(time, int) or not isinstance(condition, str) or not 0 <= time < LATEST_NS:
        return None
    return Event(time, TRIGGER, condition)


# ---- exports ----


class ExportedRows(NamedTuple):
    """Consecutive rows of one register, or of one kind of event."""

    drive: str
    register: str
    time: Array  # int64, ns UTC
    monotonic_ns: Array
    uncertainty_ns: Array  # float64; NaN for a missed value
    value: Array  # float64; NaN for a missed value
    status: Array  # codes, indexes into the list of all statuses


class SeriesWriter(RecordingWriter):
    """Writes the rows of each register together, for file formats of other systems.

    The writer keeps at most PIECE_ROWS rows in memory, besides the library's own buffers.

    The library runs in a thread of its own. In the main thread, it could catch a KeyboardInterrupt and
    continue with some rows missing. After Ctrl-C, that thread removes the file.
    """

    def __init__(self, path: Path, metadata: Metadata) -> None:
        super().__init__(path)
        self.drives = checked_drives(metadata)
        self._thread = ThreadPoolExecutor(1, "multidrop export")
        self._thread.submit(int)  # start the thread before a file exists, in case Ctrl-C interrupts the start
        self._codes: dict[str, dict[str, int]] = {"drive": {}, "register": {}, "status": {}}
        self._waiting: list[list[Array]] = []
        self._waiting_rows = 0
        self._trigger = trigger_of(metadata)
        self._is_closed = False
        self.begin_ns: int | None = None  # earliest time in the batch that was written first, ns UTC

    @property
    def statuses(self) -> list[str]:
        """The text of each status code so far."""
        return list(self._codes["status"])

    def write(self, batch: Rows) -> None:
        array = batch.arrow()  # keep a reference: the buffers are freed with the array
        children = dict(zip(ROW_COLUMNS, array.view().children, strict=True))
        columns = [codes_of(children[name], known) for name, known in self._codes.items()]
        numbers = ("time", "monotonic_ns", "uncertainty_ns", "value")
        self._waiting.append([*columns, *(numbers_of(children[name]) for name in numbers)])
        if max(map(len, self._codes.values())) > MOST_CODES:
            raise ValueError(
                f"{self.path}: more than {MOST_CODES} different names do not fit into this format"
            )
        self.rows += len(batch)
        self._waiting_rows += len(batch)
        if self._waiting_rows >= PIECE_ROWS:
            with writing(self.path):
                self._in_thread(self._write_piece)

    def _in_thread(self, work: Callable[[], Any]) -> None:
        """Do this work in the library's thread. Ctrl-C interrupts only the wait, not the work."""
        self._thread.submit(work).result()

    def _open(self, work: Callable[[], Any]) -> None:
        """Call `work`, which creates the file, in the library's thread. If it fails, remove the file."""
        try:
            self._in_thread(work)
        except BaseException:
            self.discard()
            raise

    def close(self) -> None:
        if not self._is_closed:
            with writing(self.path):
                self._in_thread(self._close)

    def _close(self) -> None:
        self._is_closed = True
        try:
            self._complete()
        finally:
            self._release()

    def _complete(self) -> None:
        if self._waiting:
            self._write_piece()
        if self._trigger:
            self._add_event(self._trigger)
        self._finish()

    def discard(self) -> None:
        with suppress(OSError):
            self._in_thread(self._remove)

    def _remove(self) -> None:
        try:
            if not self._is_closed:
                self._is_closed = True
                self._release()
        finally:
            super().discard()

    def __exit__(self, *error: object) -> None:
        if error[0] is None:
            self.close()
        else:  # after an exception, remove the file instead of completing it, which could take minutes
            self.discard()

    def _write_piece(self) -> None:
        waiting, self._waiting, self._waiting_rows = self._waiting, [], 0
        drive, register, status, *numbers = map(np.concatenate, zip(*waiting, strict=True))
        if not 0 <= numbers[0].min() <= numbers[0].max() < LATEST_NS:
            raise ValueError(f"{self.path}: rows from before 1970 or after 2200 do not fit into this format")
        if self.begin_ns is None:
            self.begin_ns = int(numbers[0].min())
        drives, registers, statuses = map(list, self._codes.values())
        for rows in rows_by_series(drive, register, numbers[0]):
            columns = [column[rows] for column in (*numbers, status)]
            part = ExportedRows(drives[drive[rows[0]]], registers[register[rows[0]]], *columns)
            if part.drive == EVENT:
                for time, code in zip(part.time.tolist(), part.status.tolist(), strict=True):
                    self._add_event(Event(time, part.register, statuses[code]))
            else:
                self._append(part, self.drives.get(part.drive, {}))

    @abstractmethod
    def _append(self, rows: ExportedRows, drive: Mapping[str, Any]) -> None:
        """Append rows of one series. `drive` is the checked metadata of the series' drive."""

    @abstractmethod
    def _add_event(self, event: Event) -> None:
        """Add an event to the file."""

    @abstractmethod
    def _finish(self) -> None:
        """Complete the file."""

    @abstractmethod
    def _release(self) -> None:
        """Close the files that h5py or asammdf has open."""
