"""Tables of rows in PostgreSQL: one row per exchange (request and reply), with an array of its values.

| table or view             | content                                                                   |
|---------------------------|---------------------------------------------------------------------------|
| `multidrop.samples`       | view: time, time_ns, uncertainty_us, drive, register, value, status, unit |
| `multidrop.exchanges`     | one row per exchange: its values, and `misses`, null if all are ok        |
| `multidrop.drives`        | id and name                                                               |
| `multidrop.register_sets` | id, names and units, in the order of the values                           |

A row per value would take four and a half times the disk space. Rows are inserted by COPY. A timestamptz has
a resolution of microseconds; `time_ns` is exact. The drive's monotonic clock is not stored.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from typing import Any, NamedTuple

import psycopg
import pyarrow as pa
import pyarrow.compute as pc
from psycopg.conninfo import make_conninfo

from multidrop.samples.message import SinkError

EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
ANSWER_S = 10  # time limit for connecting
# libpq's time limits for a server that does not answer: in s; the last one in ms
SILENT_SERVER: dict[str, int] = {
    "keepalives_idle": 10,
    "keepalives_interval": 5,
    "keepalives_count": 3,
    "tcp_user_timeout": 25_000,
}
TABLES = """
create table if not exists multidrop.drives (id serial primary key, name text unique not null);
create table if not exists multidrop.register_sets (
    id serial primary key, names text[] not null, units text[] not null);
create table if not exists multidrop.exchanges (
    time timestamptz not null, time_ns bigint not null, uncertainty_us integer, drive integer not null,
    registers integer not null, values float8[] not null, misses text[]);
create index if not exists exchanges_drive_time on multidrop.exchanges (drive, time);
create or replace view multidrop.samples as
    select e.time, e.time_ns, e.uncertainty_us, d.name as drive, v.register, v.value,
        coalesce(v.miss, 'ok') as status, v.unit
    from multidrop.exchanges e
    join multidrop.drives d on d.id = e.drive
    join multidrop.register_sets r on r.id = e.registers
    cross join lateral unnest(r.names, e.values, e.misses, r.units) as v(register, value, miss, unit);
"""
COPY = (
    "copy multidrop.exchanges (time, time_ns, uncertainty_us, drive, registers, values, misses)"
    " from stdin (format binary)"
)
TYPES = ("timestamptz", "int8", "int4", "int4", "int4", "float8[]", "text[]")  # types of the columns in COPY


class RegisterSet(NamedTuple):
    """The names and units of the registers that one request reads. A unit is None if it is unknown."""

    names: tuple[str, ...]
    units: tuple[str | None, ...]


class ExchangeRow(NamedTuple):
    """The values that one request has read from a drive."""

    time_ns: int
    uncertainty_ns: int | None
    drive: str
    asked: RegisterSet
    values: list[float | None]
    misses: list[str] | None  # the status of each value; None if all are "ok"


def exchanges_of(table: Any) -> list[ExchangeRow]:
    """Return the exchanges in a table with the columns of `message.ROWS`, sorted by time and drive."""
    table = table.combine_chunks()
    if not len(table):
        return []
    drives = table.column("drive").chunk(0)
    keys = pa.table({"time": table.column("time").cast(pa.int64()), "drive": drives.indices})
    table = table.take(
        pc.sort_indices(keys, [("time", "ascending"), ("drive", "ascending")])
    ).combine_chunks()
    columns = {name: table.column(name).chunk(0) for name in table.schema.names}
    codes = {name: _numbers(columns[name].indices, "i") for name in ("drive", "register", "status", "unit")}
    texts = {name: columns[name].dictionary.to_pylist() for name in codes}
    times = _numbers(columns["time"], "q")
    uncertainties, values = _numbers(columns["uncertainty_ns"], "q"), _numbers(columns["value"], "d")
    begins = _changes(columns["time"].cast(pa.int64()), columns["drive"].indices)
    registers, units = codes["register"], codes["unit"]
    statuses, status_texts = codes["status"], texts["status"]
    ok = status_texts.index("ok") if "ok" in status_texts else -1
    sets: dict[tuple[tuple[int, ...], tuple[int | None, ...]], RegisterSet] = {}
    found = []
    for begin, end in pairwise([*begins, len(times)]):
        key = tuple(registers[begin:end]), tuple(units[begin:end])
        asked = sets.get(key)
        if asked is None:
            asked = sets[key] = RegisterSet(
                tuple(texts["register"][code] for code in key[0]),
                tuple(None if code is None else texts["unit"][code] for code in key[1]),
            )
        found_statuses = statuses[begin:end]
        is_ok = found_statuses.count(ok) == len(found_statuses)
        misses = None if is_ok else [status_texts[code] for code in found_statuses]
        one = uncertainties[begin:end]
        uncertainty = next((known for known in one if known is not None), None) if misses else one[0]
        drive = texts["drive"][codes["drive"][begin]]
        found.append(ExchangeRow(times[begin], uncertainty, drive, asked, values[begin:end], misses))
    return found


def _numbers(column: Any, kind: str) -> list[Any]:
    """Return a column's numbers, with None for nulls. This is ten times as fast as `to_pylist`."""
    data: Any = memoryview(column.buffers()[1]).cast("B")
    found: list[Any] = data.cast(kind)[column.offset :][: len(column)].tolist()
    if column.null_count:
        for at in pc.indices_nonzero(pc.is_null(column)).to_pylist():
            found[at] = None
    return found


def _changes(first: Any, second: Any) -> list[int]:
    """Return 0 and the indices of all rows in which either column differs from the row before."""
    changed = [pc.not_equal(column[1:], column[:-1]) for column in (first, second)]
    either = pc.or_(*changed)
    return [0, *(at + 1 for at in pc.indices_nonzero(either).to_pylist())]


class SampleTables:
    """A connection that writes samples into a PostgreSQL database.

    `database` is a connection string, such as "dbname=plant"; `login` has further parameters of libpq. All
    methods raise psycopg.Error, which `sentences` converts to SinkError.
    """

    def __init__(self, database: str, program: str, **login: str) -> None:
        self._database, self._program, self._login = database, program, login
        self._connection: psycopg.Connection[Any] | None = None
        self._drives: dict[str, int] = {}
        self._sets: dict[RegisterSet, int] = {}

    @property
    def connection(self) -> psycopg.Connection[Any]:
        assert self._connection is not None
        return self._connection

    def close(self) -> None:
        if self._connection:
            self._connection.close()
            self._connection = None

    def open(self) -> psycopg.Connection[Any]:
        """Close the old connection, connect to the database, and return the new connection."""
        self.close()
        login = {"application_name": self._program, **self._login}
        where = make_conninfo(self._database, connect_timeout=ANSWER_S, **SILENT_SERVER, **login)
        self._connection = psycopg.connect(where, autocommit=True)
        return self._connection

    def prepare(self, position: str, columns: str) -> None:
        """Create missing tables and read all stored names. `position` is the writer's own table."""
        # query first whether a table exists: "create if not exists" needs the right to create it
        for query, name, statement in (
            ("select to_regnamespace(%s)", "multidrop", "create schema if not exists multidrop"),
            ("select to_regclass(%s)", "multidrop.samples", TABLES),
            ("select to_regclass(%s)", position, f"create table if not exists {position} ({columns})"),
        ):
            if self.connection.execute(query, (name,)).fetchone() == (None,):
                self.connection.execute(statement.encode())
        self._drives = dict(self.connection.execute("select name, id from multidrop.drives").fetchall())
        sets = self.connection.execute("select names, units, id from multidrop.register_sets").fetchall()
        self._sets = {RegisterSet(tuple(names), tuple(units)): number for names, units, number in sets}

    def insert(self, tables: Iterable[Any]) -> None:
        """Insert rows from tables with the columns of `message.ROWS`."""
        found = [exchange for table in tables for exchange in exchanges_of(table)]
        self._insert_names(found)
        with self.connection.cursor() as cursor, cursor.copy(COPY) as copy:
            copy.set_types(TYPES)
            for exchange in found:
                copy.write_row(self._row(exchange))

    def _row(self, exchange: ExchangeRow) -> tuple[Any, ...]:
        """Return the values of the columns in the statement COPY."""
        time_ns, uncertainty_ns, drive, asked, values, misses = exchange
        uncertainty_us = None if uncertainty_ns is None else uncertainty_ns // 1000
        time = EPOCH + timedelta(microseconds=time_ns // 1000)
        return time, time_ns, uncertainty_us, self._drives[drive], self._sets[asked], values, misses

    def _insert_names(self, found: Sequence[ExchangeRow]) -> None:
        """Insert the drives and register sets that are not in the database yet."""
        drives = sorted({one.drive for one in found} - self._drives.keys())
        query = "insert into multidrop.drives (name) select unnest(%s::text[]) returning name, id"
        if drives:
            self._drives |= dict(self.connection.execute(query, (drives,)).fetchall())
        for asked in sorted({one.asked for one in found} - self._sets.keys(), key=str):
            query = "insert into multidrop.register_sets (names, units) values (%s, %s) returning id"
            made = self.connection.execute(query, (list(asked.names), list(asked.units))).fetchone()
            assert made is not None
            self._sets[asked] = made[0]


@contextmanager
def sentences() -> Iterator[None]:
    """Convert errors of PostgreSQL to SinkError."""
    try:
        yield
    except psycopg.Error as failure:
        sentence = " ".join(str(failure).split()) or type(failure).__name__
        raise SinkError(f"PostgreSQL: {sentence}") from failure
