"""Samples in PostgreSQL: one row per exchange, with an array of its values.

| table or view             | content                                                                   |
|---------------------------|---------------------------------------------------------------------------|
| `multidrop.samples`       | view: time, time_ns, uncertainty_us, drive, register, value, status, unit |
| `multidrop.exchanges`     | one row per exchange: its values, and `misses`, null if all are ok        |
| `multidrop.families`      | id and name                                                               |
| `multidrop.register_sets` | id, names and units, in the order of the values                           |
| `multidrop.hub`           | one row: the stream, the position of its last message here, the sources   |

A row per value would take four and a half times the disk space. Rows are inserted by COPY, in the transaction
that advances the position. If another hub has moved the position, the transaction is refused. One hub writes
at a time, and others wait until it ends. A timestamptz has microseconds; `time_ns` is exact. The drive's
monotonic clock is not stored.

The data of a COPY has the format in PostgreSQL's manual, section "COPY, Binary Format". An array is its
number of dimensions, a flag for nulls, its elements' type, a size, a lower bound, and the elements, each
after its length.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from itertools import pairwise
from struct import Struct, pack
from typing import Any, NamedTuple

import psycopg
import pyarrow as pa
import pyarrow.compute as pc

from multidrop.fleet.samples.hub import Commit, KeptPlace, NotThisHubs, SinkError

HEAD = b"PGCOPY\n\xff\r\n\0" + bytes(8)
END = b"\xff\xff"
EPOCH_US = 946_684_800_000_000  # 2000-01-01, the epoch of PostgreSQL
FLOAT8, TEXT = 701, 25  # PostgreSQL's type ids (oids)
NULL = b"\xff\xff\xff\xff"
PIECE = 1 << 18  # approximate size of one piece of COPY data, in bytes
_FIRST = Struct(">hiqiq")  # number of columns; then time and time_ns, each after its length
_NUMBER = Struct(">ii")
_ARRAY = Struct(">iiiiii")


class RegisterSet(NamedTuple):
    """The names and units of the registers that one request reads. A unit is None if it is unknown."""

    names: tuple[str, ...]
    units: tuple[str | None, ...]


class ExchangeRow(NamedTuple):
    """The values of one drive that were requested together."""

    time_ns: int
    uncertainty_ns: int | None
    drive: str
    asked: RegisterSet
    values: list[float | None]
    misses: list[str] | None  # the status of each value; None if all are "ok"


class ExchangeRows(NamedTuple):
    """The exchanges of a message, and the names that occur in them."""

    exchanges: list[ExchangeRow]
    drives: frozenset[str]
    sets: frozenset[RegisterSet]


def exchanges_of(table: Any) -> ExchangeRows:
    """Return the exchanges in a table of `message.ROWS`, sorted by time and drive."""
    table = table.combine_chunks()
    if not len(table):
        return ExchangeRows([], frozenset(), frozenset())
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
    return ExchangeRows(found, frozenset(one.drive for one in found), frozenset(sets.values()))


def _numbers(column: Any, kind: str) -> list[Any]:
    """Return a column's numbers, with None for nulls. Ten times as fast as `to_pylist`."""
    data: Any = memoryview(column.buffers()[1]).cast("B")
    found: list[Any] = data.cast(kind)[column.offset :][: len(column)].tolist()
    if column.null_count:
        for at in pc.indices_nonzero(pc.is_null(column)).to_pylist():
            found[at] = None
    return found


def _changes(first: Any, second: Any) -> list[int]:
    """Return the numbers of the rows that differ from the row before in either column; includes row 0."""
    changed = [pc.not_equal(column[1:], column[:-1]) for column in (first, second)]
    either = pc.or_(*changed)
    return [0, *(at + 1 for at in pc.indices_nonzero(either).to_pylist())]


def copied(
    found: Iterable[ExchangeRows], drives: Mapping[str, int], sets: Mapping[RegisterSet, int]
) -> Iterator[bytes]:
    """Yield the data of a COPY in pieces. Its columns are those of `COPY`."""
    piece = [HEAD]
    size = 0
    for one in found:
        for exchange in one.exchanges:
            piece.append(_row(exchange, drives[exchange.drive], sets[exchange.asked]))
            size += len(piece[-1])
            if size >= PIECE:
                yield b"".join(piece)
                piece, size = [], 0
    yield b"".join([*piece, END])


def _row(exchange: ExchangeRow, drive: int, names: int) -> bytes:
    time, uncertainty = exchange.time_ns, exchange.uncertainty_ns
    return b"".join(
        (
            _FIRST.pack(7, 8, time // 1000 - EPOCH_US, 8, time),
            NULL if uncertainty is None else _NUMBER.pack(4, uncertainty // 1000),
            _NUMBER.pack(4, drive),
            _NUMBER.pack(4, names),
            _floats(exchange.values),
            NULL if exchange.misses is None else _texts(exchange.misses),
        )
    )


def _floats(values: list[float | None]) -> bytes:
    if None not in values:
        many = len(values)
        numbers: list[Any] = [8] * (2 * many)
        numbers[1::2] = values
        return _whole(many).pack(20 + 12 * many, 1, 0, FLOAT8, many, 1, *numbers)
    elements = [NULL if value is None else pack(">id", 8, value) for value in values]
    return _array(FLOAT8, elements, has_nulls=True)


@cache
def _whole(many: int) -> Struct:
    return Struct(">iiiiii" + "id" * many)


def _texts(texts: list[str]) -> bytes:
    encoded = [text.encode() for text in texts]
    return _array(TEXT, [pack(">i", len(text)) + text for text in encoded], has_nulls=False)


def _array(kind: int, elements: list[bytes], *, has_nulls: bool) -> bytes:
    body = b"".join(elements)
    return _ARRAY.pack(20 + len(body), 1, int(has_nulls), kind, len(elements), 1) + body


ANSWER_S = 10  # time limit for connecting
TABLES = """
create schema if not exists multidrop;
create table if not exists multidrop.hub (
    id boolean primary key default true check (id),
    stream text not null, place bigint not null, sources jsonb not null);
create table if not exists multidrop.families (id serial primary key, name text unique not null);
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
    join multidrop.families d on d.id = e.drive
    join multidrop.register_sets r on r.id = e.registers
    cross join lateral unnest(r.names, e.values, e.misses, r.units) as v(register, value, miss, unit);
"""
HAS_TABLES = "select from pg_views where schemaname = 'multidrop' and viewname = 'samples'"
COPY = (
    "copy multidrop.exchanges (time, time_ns, uncertainty_us, drive, registers, values, misses)"
    " from stdin (format binary)"
)
# One hub at a time locks the database, for as long as its connection lasts. The server drops a dead
# connection after 25 s.
TAKEN = """
set tcp_keepalives_idle = 10; set tcp_keepalives_interval = 5; set tcp_keepalives_count = 3;
set lock_timeout = '3s'; select pg_advisory_lock(hashtext('multidrop hub that writes')); set lock_timeout = 0
"""
MOVE = "update multidrop.hub set place = %s, sources = %s where stream = %s and place = %s"


class PostgresSink:
    """Writes each commit as one transaction. `where` is a connection string, such as "dbname=plant"."""

    def __init__(self, where: str) -> None:
        self._where = where
        self._connection: psycopg.Connection[Any] | None = None
        self._drives: dict[str, int] = {}
        self._sets: dict[RegisterSet, int] = {}

    def close(self) -> None:
        if self._connection:
            self._connection.close()
            self._connection = None

    def begin(self, stream: str) -> KeptPlace:
        """Reconnect, create missing tables, and return the position in `multidrop.hub`."""
        self.close()
        try:
            self._connection = psycopg.connect(
                self._where, connect_timeout=ANSWER_S, application_name="multidrop hub", autocommit=True
            )
            self._connection.execute(TAKEN)
            self._drives, self._sets = {}, {}
            with self._connection.transaction():
                return self._begin(self._connection, stream)
        except psycopg.errors.LockNotAvailable as failure:
            raise SinkError("another hub writes into this database; waiting until it ends") from failure
        except psycopg.Error as failure:
            raise SinkError(f"PostgreSQL: {_sentence(failure)}") from failure

    def _begin(self, connection: psycopg.Connection[Any], stream: str) -> KeptPlace:
        if connection.execute(HAS_TABLES).fetchone() is None:
            connection.execute(TABLES)
        first = (
            "insert into multidrop.hub (stream, place, sources) values (%s, 0, '{}') on conflict do nothing"
        )
        connection.execute(first, (stream,))
        found = connection.execute("select stream, place, sources from multidrop.hub").fetchone()
        assert found is not None
        if found[0] != stream:
            raise NotThisHubs(
                f"the database holds samples of a stream created at {found[0]}, and this one was created "
                f"at {stream}: name another database"
            )
        self._drives = dict(connection.execute("select name, id from multidrop.families").fetchall())
        sets = connection.execute("select names, units, id from multidrop.register_sets").fetchall()
        self._sets = {RegisterSet(tuple(names), tuple(units)): number for names, units, number in sets}
        return KeptPlace(found[1], found[2])

    def write(self, commit: Commit) -> None:
        """Store the rows and their position in one transaction."""
        assert self._connection is not None
        try:
            with self._connection.transaction():
                self._write(self._connection, commit)
        except psycopg.Error as failure:
            raise SinkError(f"PostgreSQL: {_sentence(failure)}") from failure

    def _write(self, connection: psycopg.Connection[Any], commit: Commit) -> None:
        moved = connection.execute(
            MOVE, (commit.last, json.dumps(commit.sources), commit.stream, commit.first - 1)
        )
        if moved.rowcount != 1:
            raise SinkError("another hub writes into this database: stop one of them")
        found: list[ExchangeRows] = [exchanges_of(table) for table in commit.tables]
        self._name(connection, found)
        with connection.cursor() as cursor, cursor.copy(COPY) as copy:
            for piece in copied(found, self._drives, self._sets):
                copy.write(piece)

    def _name(self, connection: psycopg.Connection[Any], found: Sequence[ExchangeRows]) -> None:
        """Insert those names that have no id in the database yet."""
        drives = sorted({name for one in found for name in one.drives} - self._drives.keys())
        query = "insert into multidrop.families (name) select unnest(%s::text[]) returning name, id"
        if drives:
            self._drives |= dict(connection.execute(query, (drives,)).fetchall())
        for asked in sorted({asked for one in found for asked in one.sets} - self._sets.keys(), key=str):
            query = "insert into multidrop.register_sets (names, units) values (%s, %s) returning id"
            made = connection.execute(query, (list(asked.names), list(asked.units))).fetchone()
            assert made is not None
            self._sets[asked] = made[0]


def _sentence(failure: psycopg.Error) -> str:
    return " ".join(str(failure).split()) or type(failure).__name__
