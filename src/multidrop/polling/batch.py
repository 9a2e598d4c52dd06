"""Rows of samples and missing values: as Arrow columns, tables by time, and `Row` objects.

`batch.to_pandas()`, `batch.to_polars()` and `batch.wide()` make tables. Any library with the Arrow PyCapsule
interface can read a batch directly: `pyarrow.record_batch(batch)`, `duckdb.sql("from batch")`. multidrop
itself needs no such library. `pandas.DataFrame(batch)` does not use the interface and would read row by row,
with times as plain integers, so it raises TypeError. For NumPy, with NaN for every missing value:
`nanoarrow.Array(batch).child(5).to_pysequence(handle_nulls=nanoarrow.nulls_as_sentinel())`.
"""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from array import array
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from functools import cache
from typing import Any, NamedTuple, NoReturn

from multidrop.channels import SlotRow
from multidrop.core import STATUSES, Columns, Names, spell
from multidrop.core.columns import COLUMNS, find_codes
from multidrop.printable import did_you_mean, install_command


class ArrowTable(ABC):
    """A table with the Arrow PyCapsule interface, through which other libraries can read it."""

    @abstractmethod
    def __arrow_c_stream__(self, requested_schema: object = None) -> Any: ...

    def to_pandas(self) -> Any:
        """Return a pandas.DataFrame; its `time` is datetime64[ns, UTC], and a missing value is NaN.

        Raises ImportError if pandas or pyarrow is not installed.
        """
        _library("pandas", "pandas", "to_pandas")
        return _library("pyarrow", "pandas", "to_pandas").table(self).to_pandas()

    def to_polars(self) -> Any:
        """Return a polars.DataFrame; its `time` is Datetime("ns", "UTC"), and a missing value is null.

        Raises ImportError if polars is not installed.
        """
        return _library("polars", "polars", "to_polars").DataFrame(self)


def nanoarrow() -> Any:
    """Return the nanoarrow module. Raises ImportError if it is not installed."""
    try:
        return importlib.import_module("nanoarrow")
    except ImportError as failure:
        raise ImportError(
            "rows in Arrow's layout, such as the rows of a recording, need the package nanoarrow: "
            "pip install nanoarrow",
            name="nanoarrow",
        ) from failure


def _library(name: str, extra: str, method: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as failure:
        raise ImportError(
            f"{method}() needs {name}, which is not installed: {install_command(extra)}"
        ) from failure


TIMES = ("time", "monotonic_ns")
RESTART_NS = 60_000_000_000  # tolerance for detecting a restart of the computer, see `_is_restarted`


class _WideColumn:
    """The values of one register of one drive, each with its row number in the table."""

    def __init__(self) -> None:
        self.rows = array("q")
        self.values = array("d")

    def dense(self, places: Sequence[int]) -> tuple[bytearray, array[float]]:
        """Return a bitmap (1 for each row with a value) and the values, in the order of the final table.

        `places[n]` is the position of row n in that order.
        """
        valid = bytearray((len(places) + 7) // 8)
        values = array("d", bytes(8 * len(places)))
        for row, value in zip(self.rows, self.values, strict=True):
            at = places[row]
            valid[at >> 3] |= 1 << (at & 7)
            values[at] = value
        return valid, values


class WideRows(ArrowTable):
    """Rows by time: columns `time`, `monotonic_ns`, and `drive.register` for each register of each drive.

    Rows of the long form (one row for each value) that have the same time to the nanosecond become one row.
    These are the rows of one request, because the registers of a request share the time at which it was sent.
    Other values are not joined, filled or interpolated: a row has values for the registers of one request,
    and null for all others. A missing value is null too; only the long form has its reason. Rows are sorted
    by `monotonic_ns`, but the rows that follow a restart of the computer stay behind the rows before it.
    """

    def __init__(self, rows: Iterable[Row], chosen: Sequence[str] = (), known: Collection[str] = ()) -> None:
        """Use the rows of the `chosen` columns, or all rows if none are chosen.

        `known` are valid columns that may have no row. Raises ValueError for an unknown column, and if two
        registers would have the same column name.
        """
        for name in chosen:
            if not isinstance(name, str):
                raise TypeError(f"wide takes column names as separate arguments, not {name!r}")
        self._columns = {name: _WideColumn() for name in chosen}
        self._times: dict[tuple[int, int], int] = {}  # row numbers by (time, monotonic_ns)
        self._starts = array("q")  # number of restarts of the computer before each row, by row number
        restarts, newest = 0, (0, 0)  # `newest`: time and monotonic time of the newest row since the restart
        found: dict[tuple[str, str], _WideColumn | None] = {}
        owners: dict[str, tuple[str, str]] = {}
        for time, monotonic_ns, _, drive, register, value, _ in rows:
            if monotonic_ns > newest[1]:
                newest = time, monotonic_ns
            elif _is_restarted(newest, (time, monotonic_ns)):
                restarts, newest = restarts + 1, (time, monotonic_ns)
            owner = drive, register
            if owner not in found:
                found[owner] = self._column(owner, owners, bool(chosen))
            column = found[owner]
            if column is None:
                continue
            row = self._times.setdefault((time, monotonic_ns), len(self._times))
            if row == len(self._starts):
                self._starts.append(restarts)
            if value is not None:
                column.rows.append(row)
                column.values.append(value)
        _check_chosen(chosen, {*owners, *known})

    def _column(
        self, owner: tuple[str, str], owners: dict[str, tuple[str, str]], are_chosen: bool
    ) -> _WideColumn | None:
        """Return the column of a drive's register; None if other columns were chosen."""
        name = ".".join(owner)
        if owners.setdefault(name, owner) != owner:
            drives = " and ".join(repr(drive) for drive, _ in (owners[name], owner))
            raise ValueError(
                f"drives {drives} both have a column that is called {name!r}: rename one of them"
            )
        if are_chosen:
            return self._columns.get(name)
        return self._columns.setdefault(name, _WideColumn())

    @property
    def columns(self) -> list[str]:
        return [*TIMES, *self._columns]

    def __len__(self) -> int:
        return len(self._times)

    def __repr__(self) -> str:
        return f"<{len(self)} rows of {len(self._columns)} registers>"

    def __arrow_c_schema__(self) -> Any:
        return self._schema().__arrow_c_schema__()

    def __arrow_c_stream__(self, requested_schema: object = None) -> Any:
        return nanoarrow().c_array_stream(self._arrow()).__arrow_c_stream__()

    def _schema(self) -> Any:
        arrow = nanoarrow()
        times = {
            "time": arrow.timestamp("ns", "UTC", nullable=False),
            "monotonic_ns": arrow.int64(nullable=False),
        }
        values = {name: arrow.float64() for name in self._columns}
        return arrow.c_schema(arrow.struct({**times, **values}, nullable=False))

    def _arrow(self) -> Any:
        c_array_from_buffers = nanoarrow().c_array_from_buffers
        starts, rows = self._starts, self._times
        ordered = sorted(rows, key=lambda times: (starts[rows[times]], times[1], times[0]))
        places = array("q", bytes(8 * len(ordered)))
        for place, times in enumerate(ordered):
            places[self._times[times]] = place
        buffers: list[tuple[Any, Any]] = [(None, array("q", column)) for column in _transposed(ordered)]
        buffers += [column.dense(places) for column in self._columns.values()]
        schema = self._schema()
        children = [
            c_array_from_buffers(kind, len(self), pair)
            for kind, pair in zip(schema.children, buffers, strict=True)
        ]
        return c_array_from_buffers(schema, len(self), [None], children=children, move=True)


def _is_restarted(before: tuple[int, int], now: tuple[int, int]) -> bool:
    """Return True if the computer was restarted, or changed, between two rows.

    A row is given by its time and monotonic time. A restart sets the monotonic clock back, and changes its
    offset from UTC, each by more than RESTART_NS.
    """
    (time, monotonic_ns), (later, later_monotonic_ns) = before, now
    is_earlier = later_monotonic_ns < monotonic_ns - RESTART_NS
    return is_earlier and abs(later - later_monotonic_ns - time + monotonic_ns) > RESTART_NS


def _transposed(times: Sequence[tuple[int, int]]) -> Iterable[Iterable[int]]:
    return zip(*times, strict=True) if times else ((), ())


def _check_chosen(chosen: Sequence[str], known: set[str]) -> None:
    for name in chosen:
        if name not in known:
            hint = did_you_mean(name, known, "a column is DRIVE.REGISTER")
            raise ValueError(f"there is no column {name!r}; {hint}")
        if chosen.count(name) > 1:
            raise ValueError(f"column {name!r} is chosen twice")


# ---- batches ----


_STATUSES = Names(STATUSES)  # the core's status texts, followed by the texts of events
MOST_STATUSES = 1 << 14  # limit of the number of different status texts in one process
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


class Row(NamedTuple):
    """A value of a register, or a missing value; then the status is the reason."""

    time_ns: int  # UTC at which the request was sent
    monotonic_ns: int
    uncertainty_ns: int | None  # the drive sampled the value between time_ns and time_ns + uncertainty_ns
    drive: str
    register: str
    value: float | None
    status: str  # "ok", or the reason why there is no value

    @property
    def time(self) -> datetime:
        """The UTC time at which the request was sent, to the microsecond."""
        return EPOCH + timedelta(microseconds=self.time_ns // 1000)


ROW_COLUMNS = ("time", *Row._fields[1:])  # names of the columns if rows are shown as a table


def shown_span(rows: Sequence[Row]) -> str:
    """Return a text for a repr: number of rows and drives, duration, and the time of the first row."""
    if not rows:
        return "no rows"
    first, last = min(row.time_ns for row in rows), max(row.time_ns for row in rows)
    drives = len({row.drive for row in rows})
    begin = datetime.fromtimestamp(first / 1e9, UTC).isoformat(timespec="milliseconds")
    return (
        f"{len(rows)} row{'s' * (len(rows) > 1)} of {drives} drive{'s' * (drives > 1)}, "
        f"{(last - first) / 1e9:.3f} s from {begin}"
    )


class BatchColumns(NamedTuple):
    """Columns of a batch as read-only one-dimensional memoryviews, without a copy.

    Each column except `valid` has one number per row (shape `(len(batch),)`). The memory of a view stays
    valid and unchanged, even after the batch is deleted and the poller is closed. The same applies to an
    object that shares the view's memory, such as `numpy.asarray(view)`.

    `drives`, `registers` and `statuses` are tuples of names; a code is the index of its name. A name has the
    same code in all batches of one poller. Later batches may have more names.
    """

    time: memoryview  # int64 (format "q"): UTC in ns at which the request was sent
    monotonic_ns: memoryview  # int64: the same moment by CLOCK_MONOTONIC, in ns
    uncertainty_ns: memoryview  # int64; undefined if the value is missing
    drive: memoryview  # uint16 ("H"): a code in `drives`
    register: memoryview  # uint16: a code in `registers`
    value: memoryview  # float64 ("d"), in the register's unit; undefined if it is missing
    status: memoryview  # uint16: a code in `statuses`; 0 is "ok", any other: no value
    valid: memoryview  # uint8 ("B"), a bit for each row, least significant first: 1 if status is 0
    drives: tuple[str, ...]
    registers: tuple[str, ...]
    statuses: tuple[str, ...]


def slot_rows(columns: BatchColumns, slots: Mapping[tuple[int, int], int]) -> Iterator[SlotRow]:
    """Yield the rows of some registers. `slots` has their indexes by the codes of drive and register."""
    for at in find_codes(columns.drive, columns.register, slots):
        yield SlotRow(
            slots[columns.drive[at], columns.register[at]],
            columns.time[at],
            columns.monotonic_ns[at],
            columns.uncertainty_ns[at],
            columns.value[at],
            columns.status[at],
        )


class Rows(ArrowTable):
    """Rows as a sequence, as Arrow capsules, and as tables of other libraries."""

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def __iter__(self) -> Iterator[Row]: ...

    @abstractmethod
    def arrow(self) -> Any:
        """Return all rows as one nanoarrow array."""

    def wide(self, *columns: str) -> WideRows:
        """Return a table with a row for each time and a column for each `drive.register`, or only `columns`.

        The registers of one request share a row, and a missing value is null: see `WideRows`. Raises
        ValueError for an unknown column.
        """
        return WideRows(self, columns, self._may_have() if columns else ())

    def _may_have(self) -> Collection[str]:
        """Return the names of all columns that `wide` accepts, including columns without a row."""
        return ()

    def __array__(self, *how: object, **details: object) -> NoReturn:
        """Raise TypeError, because `pandas.DataFrame(batch)` would convert the rows to one array."""
        raise TypeError(
            "a batch cannot become one array, because its columns have several types. Use "
            "batch.to_pandas(), batch.to_polars() or pyarrow.record_batch(batch)"
        )

    def __arrow_c_schema__(self) -> Any:
        return schema().__arrow_c_schema__()

    def __arrow_c_array__(self, requested_schema: object = None) -> Any:
        return self.arrow().__arrow_c_array__()

    def __arrow_c_stream__(self, requested_schema: object = None) -> Any:
        return nanoarrow().c_array_stream(self.arrow()).__arrow_c_stream__()


class Batch(Rows):
    """Rows from the core, with the names for the codes in the rows."""

    def __init__(self, columns: Columns, drives: Names, registers: Names) -> None:
        self._columns = columns
        self._drives = drives
        self._registers = registers

    def __len__(self) -> int:
        return len(self._columns)

    def __iter__(self) -> Iterator[Row]:
        drives, registers = self._drives, self._registers
        names = ("time", "sent", "uncertainty", "drive", "reg", "value", "status")
        for time, sent, uncertainty, drive, register, value, status in zip(
            *map(self._columns.array, names), strict=True
        ):
            sample = (uncertainty, value) if status == 0 else (None, None)
            yield Row(time, sent, sample[0], drives[drive], registers[register], sample[1], _STATUSES[status])

    def columns(self) -> BatchColumns:
        """Return the columns, without a copy, and the names for their codes.

        For many rows this is much faster than one `Row` object for each.
        """
        time, sent, uncertainty, drive, register, value, status, valid = (
            self._columns.array(name).toreadonly()
            for name in ("time", "sent", "uncertainty", "drive", "reg", "value", "status", "valid")
        )
        names = (self._drives.listed, self._registers.listed, _STATUSES.listed)
        return BatchColumns(time, sent, uncertainty, drive, register, value, status, valid, *names)

    def at(self, places: Sequence[int]) -> Batch:
        """Return a copy of the rows at these indices."""
        copies = {
            name: array(kind, map(self._columns.array(name).__getitem__, places)).tobytes()
            for name, kind in COLUMNS.items()
        }
        return Batch(CopiedColumns(copies), self._drives, self._registers)

    def parts(self) -> tuple[Columns, Names, Names]:
        """Return the core's columns, the names of the drives, and the names of the registers."""
        return self._columns, self._drives, self._registers

    def _may_have(self) -> Collection[str]:
        registers, drives = self._registers.listed, self._drives.listed
        return [f"{drive}.{register}" for drive in drives for register in registers]

    def __repr__(self) -> str:
        return f"<Batch: {shown_span([*self])}>"

    def arrow(self) -> Any:
        column = self._columns.array
        valid = column("valid")
        return assemble(
            len(self),
            (None, column("time")),
            (None, column("sent")),
            (valid, column("uncertainty")),
            (None, *spell(column("drive"), self._drives)),
            (None, *spell(column("reg"), self._registers)),
            (valid, column("value")),
            (None, *spell(column("status"), _STATUSES)),
        )


class CopiedColumns(Columns):
    """Rows in Python's memory: one buffer for each column except `valid`."""

    def __init__(self, copies: Mapping[str, bytes | bytearray]) -> None:
        self._copies = copies

    def __len__(self) -> int:
        return len(self._copies["time"]) // 8

    def array(self, name: str) -> memoryview[Any]:
        if name == "valid":
            return bitmap_of(self.array("status"))
        return memoryview(bytes(self._copies[name])).cast(COLUMNS[name])


def bitmap_of(statuses: memoryview[Any]) -> memoryview[Any]:
    """Return a bitmap with one bit per row, the least significant bit first: 1 if the row's status is 0."""
    size = (len(statuses) + 7) // 8
    if statuses.tobytes().count(0) == statuses.nbytes:
        return memoryview(b"\xff" * size)
    bits = "".join("0" if code else "1" for code in reversed(statuses))
    return memoryview(int(bits, 2).to_bytes(size, "little"))


def status_code(text: str) -> int:
    """Return the code of a status text. Raises ValueError if the process has too many different texts."""
    if len(_STATUSES) >= MOST_STATUSES and text not in _STATUSES.listed:
        raise ValueError(f"this process has more than {MOST_STATUSES} different event texts")
    return _STATUSES.number(text)


@cache
def schema() -> Any:
    """Return the Arrow schema of every batch and every recording."""
    arrow = nanoarrow()
    return arrow.c_schema(
        arrow.struct(
            {
                "time": arrow.timestamp("ns", "UTC", nullable=False),
                "monotonic_ns": arrow.int64(nullable=False),
                "uncertainty_ns": arrow.int64(),
                "drive": arrow.string(nullable=False),
                "register": arrow.string(nullable=False),
                "value": arrow.float64(),
                "status": arrow.string(nullable=False),
            },
            nullable=False,
        )
    )


def assemble(rows: int, *columns: tuple[Any, ...]) -> Any:
    """Return an array of `schema()` from each column's buffers in Arrow's layout, without copying.

    Raises ValueError or RuntimeError if the buffers do not have this number of rows.
    """
    c_array_from_buffers = nanoarrow().c_array_from_buffers
    children = [
        c_array_from_buffers(kind, rows, buffers, validation_level="full")
        for kind, buffers in zip(schema().children, columns, strict=True)
    ]
    return c_array_from_buffers(schema(), rows, [None], children=children, move=True)


class GatheredRows(CopiedColumns):
    """Copies of the rows of several batches. The core can then reuse the batches' memory."""

    def __init__(self, drives: Names, registers: Names) -> None:
        self._drives, self._registers = drives, registers
        self._gathered = {name: bytearray() for name in COLUMNS}
        super().__init__(self._gathered)

    def add(self, batch: Batch) -> bool:
        """Append a copy of a batch's rows; return True.

        Return False, without copying, if the batch is from another poller, whose codes mean other names.
        """
        columns, drives, registers = batch.parts()
        if drives is not self._drives or registers is not self._registers:
            return False
        for name, gathered in self._gathered.items():
            gathered += columns.array(name).cast("B")
        return True

    def batch(self) -> Batch:
        """Return all rows so far. No rows may be added afterwards."""
        return Batch(self, self._drives, self._registers)


def gather(gathered: list[GatheredRows], batch: Batch) -> None:
    """Append the rows to the last element of `gathered`; rows of another poller start a new element."""
    if not gathered or not gathered[-1].add(batch):
        _, drives, registers = batch.parts()
        gathered.append(GatheredRows(drives, registers))
        gathered[-1].add(batch)


def copied(batch: Batch) -> Batch:
    """Return a copy of the batch. The core can then reuse the batch's memory."""
    gathered: list[GatheredRows] = []
    gather(gathered, batch)
    return gathered[0].batch()
