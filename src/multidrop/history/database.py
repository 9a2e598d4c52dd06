"""DuckDB for the history, with limited memory and one thread. Rows are passed in Arrow's layout."""

from __future__ import annotations

import json
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp
from typing import Any

from multidrop.history.units import Series
from multidrop.polling.batch import Rows, assemble, schema
from multidrop.printable import install_command
from multidrop.recording.format import METADATA_KEY, Metadata
from multidrop.recording.rows import RecordedRows

MOST_INSERTED = 60_000  # limit of rows per insert, at 70 bytes per row
TABLE = (
    "create temp table recorded (time timestamptz_ns, monotonic_ns bigint, uncertainty_ns bigint,"
    " drive varchar, register varchar, value double, status varchar)"
)
# SQL for a value in a bucket: null unless it is finite, because one infinite value makes the mean infinite.
FINITE = "case when isfinite(value) then value end"
FORM = "format parquet, compression zstd"


class MissingDuckDB(ImportError):
    """DuckDB is not installed, but reading compacted files needs it."""


def connect(memory: str, spill: Path | None = None) -> Any:
    """Return a connection to an empty database in memory. Raises MissingDuckDB."""
    try:
        import duckdb
    except ImportError as failure:
        raise MissingDuckDB(
            f"compacted history needs duckdb, which is not installed: {install_command('history')}"
        ) from failure
    settings: dict[str, Any] = {"memory_limit": memory, "threads": 1, "autoinstall_known_extensions": False}
    if spill:
        settings["temp_directory"] = str(spill)
    return duckdb.connect(config=settings)


class Database:
    """A database in memory. It is opened on first use, because opening takes 20 ms of CPU time.

    Data that does not fit into memory goes to the folder `spill`, or to a temporary folder if `spill` is
    None.
    """

    def __init__(self, memory: str, spill: Path | None = None) -> None:
        self._memory = memory
        self._spill = spill
        self._opened: Any = None
        self._forget: Callable[[], object] = lambda: None

    def cursor(self) -> Any:
        """Return a cursor. The caller closes it, which drops its temporary tables. Raises MissingDuckDB."""
        if self._opened is None:
            self._opened = connect(self._memory, self._spill)
            if self._spill is None:
                self._make_spill()
        return self._opened.cursor()

    def _make_spill(self) -> None:
        folder = mkdtemp(prefix="multidrop-history-")  # readable by this user only
        self._forget = weakref.finalize(self, rmtree, folder, ignore_errors=True)
        self._opened.execute("set temp_directory = ?", [folder])

    def close(self) -> None:
        """Close the database if it is open; the next `cursor` opens it again."""
        if self._opened is not None:
            self._opened.close()
            self._opened = None
            self._forget()


class ArrowStream:
    """Passes batches to DuckDB as an Arrow stream. DuckDB requests a new stream for each query."""

    def __init__(self, batches: Iterable[Rows]) -> None:
        self._arrays = [rows.arrow() for rows in batches]

    def __arrow_c_stream__(self, requested_schema: object = None) -> Any:
        from nanoarrow.c_array_stream import CArrayStream

        return CArrayStream.from_c_arrays(self._arrays, schema()).__arrow_c_stream__()


def insert(database: Any, batches: Iterable[Rows]) -> None:
    """Create the table `recorded` with these rows."""
    database.execute(TABLE)
    waiting: list[Rows] = []
    for rows in batches:
        waiting.append(rows)
        if sum(map(len, waiting)) >= MOST_INSERTED:
            _insert(database, waiting)
    _insert(database, waiting)


def _insert(database: Any, waiting: list[Rows]) -> None:
    if waiting:
        database.register("arrived", ArrowStream(waiting))
        database.execute("insert into recorded from arrived")
        database.unregister("arrived")
        waiting.clear()


def insert_units(database: Any, units: Mapping[Series, str]) -> None:
    """Create the table `units`, with the unit of each series (a drive's register)."""
    database.execute("create temp table units (drive varchar, register varchar, unit varchar)")
    columns = [[*part] for part in zip(*(pair for pair in units), strict=True)] or [[], []]
    database.execute(
        "insert into units select unnest($1), unnest($2), unnest($3)", [*columns, [*units.values()]]
    )


def copy_out(
    database: Any,
    query: str,
    path: Path,
    metadata: Metadata | None = None,
    values: Mapping[str, Any] | None = None,
) -> int:
    """Write the rows that a query returns into a Parquet file; return the number of rows."""
    form = FORM
    if metadata is not None:
        form += f", kv_metadata {{{METADATA_KEY}: {quoted(json.dumps(metadata, ensure_ascii=False))}}}"
    copied = database.execute(f"copy ({query}) to {quoted(str(path))} ({form})", dict(values or {}))
    return int(copied.fetchone()[0])


def rows_of(database: Any, query: str, values: Mapping[str, Any]) -> Iterator[Rows]:
    """Yield the rows of a query. Its columns must be those of a recording."""
    import nanoarrow

    for array in nanoarrow.c_array_stream(database.sql(query, params=dict(values))):
        columns = [
            (
                bytes(child.buffer(0)) if child.null_count else None,
                # bytes() copies the buffer
                *(bytes(child.buffer(number)) for number in range(1, child.n_buffers)),
            )
            for child in array.view().children
        ]
        yield RecordedRows(assemble(array.length, *columns))


def kept_metadata(database: Any, path: Path) -> dict[str, Any]:
    """Return the recording's metadata from a Parquet file of a history."""
    query = f"select decode(value) from parquet_kv_metadata({quoted(str(path))}) where decode(key) = $key"
    found = database.execute(query, {"key": METADATA_KEY}).fetchone()
    metadata: dict[str, Any] = json.loads(found[0]) if found else {}
    return metadata


def texts_of_metadata(database: Any, paths: Iterable[Path]) -> Iterator[tuple[str, list[str]]]:
    """Yield each metadata text in these Parquet files, with the names of the files that have it."""
    query = f"""select decode(value), list(file_name) from parquet_kv_metadata({_list(paths)})
        where decode(key) = $key group by value"""
    yield from database.execute(query, {"key": METADATA_KEY}).fetchall()


def quoted(text: str) -> str:
    return "'" + text.replace("'", "''") + "'"


def files_of(paths: Iterable[Path]) -> str:
    """Return the SQL expression that reads these Parquet files as one table."""
    return f"read_parquet({_list(paths)})"


def with_units(paths: Iterable[Path]) -> str:
    """Return the SQL that reads Parquet files as one table with the columns `filename` and `unit`.

    `unit` is null for files without this column.
    """
    files = f"read_parquet({_list(paths)}, union_by_name = true, filename = true)"
    return f"(select * from {files} union all by name select null::varchar as unit where false)"


def _list(paths: Iterable[Path]) -> str:
    return f"[{', '.join(quoted(str(path)) for path in paths)}]"
