"""WideRows: a column for each register of each drive, and a row for each request time."""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from array import array
from collections.abc import Collection, Iterable, Sequence
from typing import TYPE_CHECKING, Any

from multidrop.extras import install_command
from multidrop.printable import did_you_mean


class ArrowTable(ABC):
    """A table with the Arrow PyCapsule interface, through which other libraries can read it."""

    @abstractmethod
    def __arrow_c_stream__(self, requested_schema: object = None) -> Any: ...

    def to_pandas(self) -> Any:
        """Return a pandas.DataFrame; its `time` is datetime64[ns, UTC], and a miss is NaN.

        Raises ImportError if pandas or pyarrow is not installed.
        """
        _library("pandas", "pandas", "to_pandas")
        return _library("pyarrow", "pandas", "to_pandas").table(self).to_pandas()

    def to_polars(self) -> Any:
        """Return a polars.DataFrame; its `time` is Datetime("ns", "UTC"), and a miss is null.

        Raises ImportError if polars is not installed.
        """
        return _library("polars", "polars", "to_polars").DataFrame(self)


def nanoarrow() -> Any:
    """Return the nanoarrow module. Raises ImportError if it is not installed."""
    try:
        return importlib.import_module("nanoarrow")
    except ImportError as failure:
        raise ImportError(
            "rows in Arrow's layout, such as those of a recording that is read, need nanoarrow, which is not "
            "installed: pip install nanoarrow",
            name="nanoarrow",
        ) from failure


def _library(name: str, extra: str, method: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as failure:
        raise ImportError(
            f"{method}() needs {name}, which is not installed: {install_command(extra)}"
        ) from failure


if TYPE_CHECKING:
    from multidrop.polling.batch import Row

TIMES = ("time", "monotonic_ns")


class _WideColumn:
    """One register's values on one drive, each with its row number."""

    def __init__(self) -> None:
        self.rows = array("q")
        self.values = array("d")

    def dense(self, places: Sequence[int]) -> tuple[bytearray, array[float]]:
        """Return a bitmap (1 for each row with a value) and the values, in the table's final order.

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

    Rows of the long form that have the same time to the nanosecond become one row. These are the rows of one
    request, because the registers of a request share the time at which it was sent. Other values are not
    joined, filled or interpolated: a row has values for the registers of one request, and null for all
    others. A miss is also null; only the long form has its reason. Rows are sorted by `monotonic_ns`.
    """

    def __init__(self, rows: Iterable[Row], chosen: Sequence[str] = (), known: Collection[str] = ()) -> None:
        """Use the rows of the `chosen` columns, or all rows if none are chosen.

        `known` are valid columns that may have no row. Raises ValueError for an unknown column, and if two
        registers would have the same column name.
        """
        self._columns = {name: _WideColumn() for name in chosen}
        self._times: dict[tuple[int, int], int] = {}  # row numbers by (time, monotonic_ns)
        found: dict[tuple[str, str], _WideColumn | None] = {}
        owners: dict[str, tuple[str, str]] = {}
        for time, monotonic_ns, _, drive, register, value, _ in rows:
            owner = drive, register
            if owner not in found:
                found[owner] = self._column(owner, owners, bool(chosen))
            column = found[owner]
            if column is None:
                continue
            row = self._times.setdefault((time, monotonic_ns), len(self._times))
            if value is not None:
                column.rows.append(row)
                column.values.append(value)
        _check_chosen(chosen, {*owners, *known})

    def _column(
        self, owner: tuple[str, str], owners: dict[str, tuple[str, str]], are_chosen: bool
    ) -> _WideColumn | None:
        """Return the column of a drive's register, new or existing; None if it is not chosen."""
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
        """Names of all columns."""
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
        ordered = sorted(self._times, key=lambda times: (times[1], times[0]))
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


def _transposed(times: Sequence[tuple[int, int]]) -> Iterable[Iterable[int]]:
    return zip(*times, strict=True) if times else ((), ())


def _check_chosen(chosen: Sequence[str], known: set[str]) -> None:
    for name in chosen:
        if name not in known:
            hint = did_you_mean(name, known, "a column is DRIVE.REGISTER")
            raise ValueError(f"there is no column {name!r}; {hint}")
        if chosen.count(name) > 1:
            raise ValueError(f"column {name!r} is chosen twice")
