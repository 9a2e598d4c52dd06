"""Messages: many rows packed into one Arrow IPC stream, in two to three bytes per row.

| column           | type                        | meaning                                              |
|------------------|-----------------------------|------------------------------------------------------|
| `time`           | timestamp[ns, UTC]          | when the request was sent                            |
| `clock_ns`       | int64                       | time - monotonic_ns: nearly the same in all rows     |
| `uncertainty_us` | int32, null if missing      | the value was taken between time and this much later |
| `drive`          | dictionary of utf8          | the drive's name                                     |
| `register`       | dictionary of utf8          | the register's name                                  |
| `value`          | float64, null if missing    | in `unit`                                            |
| `status`         | dictionary of utf8          | `ok`, or why there is no value                       |
| `unit`           | dictionary of utf8, or null | see below; null if unknown                           |

Rows are ordered by register, and by time within a register. So similar values are adjacent, and a time
that ten registers share costs little more than one. Buffers are compressed with zstd-1; dictionaries
hold only the names in these rows. An uncertainty is rounded up to whole microseconds, so it stays an
upper bound; the ten bits that rounding drops are noise.

The unit comes from the register's description at the time of the poll: "" for a number without a unit, "raw
count" if the step is unknown, and, for instance, "names of yd1000" if numbers stand for named values of this
drive family.

Any holder of a gateway's key may send other bytes as a message. A message that declares an unpacked
size above 4 MiB is rejected before it is unpacked, and so are columns of other types, which may grow in
a cast.

A compressed buffer starts with its unpacked size, and pyarrow allocates that much memory before it checks the
rest. So the sizes are read first, from the flatbuffers described in Message.fbs of Arrow's format. A
flatbuffer's table starts with the distance back to a list of its fields' offsets; the offset of a missing
field is 0.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping, Sequence
from itertools import takewhile
from struct import Struct
from struct import error as struct_error
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.compute as pc

from multidrop.drive import Drive
from multidrop.drive.register import Register
from multidrop.plant.model import PlantLine
from multidrop.polling import BatchColumns

LATEST = 4  # MetadataVersion.V5: older versions mark compressed buffers differently
MOST_MESSAGES = 100  # limit of Arrow messages in a stream: the schema, dictionaries and rows
_DICTIONARY, _RECORD_BATCH = 2, 3  # kinds of Arrow messages, from MessageHeader in Message.fbs
_I8, _U16, _I32, _U32, _I64 = (Struct(f"<{kind}") for kind in "bHiIq")
_BUFFER = Struct("<qq")  # a buffer's offset in the body, and its length
# unpacked size that marks a buffer as stored without compression
_NOT_COMPRESSED = -1
MOST_BYTES = 900_000  # size limit of a message; NATS accepts 1 MiB by default, including headers
MOST_ROWS = 1 << 16
MOST_UNPACKED = 4 << 20  # limit of the unpacked size in bytes; enough for 2.4 MB of rows and their names
# Limit of a name, status or unit, in bytes. PostgreSQL indexes names, and an index entry has at most 2704
# bytes. Texts of events are allowed: they have at most 500 characters of 4 bytes.
MOST_NAME = 2000
MOST_SAID = 300  # limit, in characters, of an error's text
LONGEST_US = (1 << 31) - 1
COMPRESSED = pa.ipc.IpcWriteOptions(compression=pa.Codec("zstd", 1))
# type of columns with names; codes have 32 bits because a table may join many messages
NAMED = pa.dictionary(pa.int32(), pa.utf8())
TIMES = pa.timestamp("ns", "UTC")
ROWS = pa.schema(  # columns of the table that `unpack` returns, the same as in recordings
    [
        pa.field("time", TIMES, nullable=False),
        pa.field("monotonic_ns", pa.int64(), nullable=False),
        pa.field("uncertainty_ns", pa.int64()),
        pa.field("drive", NAMED, nullable=False),
        pa.field("register", NAMED, nullable=False),
        pa.field("value", pa.float64()),
        pa.field("status", NAMED, nullable=False),
        pa.field("unit", NAMED),
    ]
)
_TYPES: Mapping[str, Sequence[Any]] = {  # allowed types of a message's columns, except dictionary columns
    "time": [TIMES],
    "clock_ns": [pa.int64()],
    "uncertainty_us": [pa.int32(), pa.int64()],
    "value": [pa.float64()],
}
_KINDS = {"time": pa.int64(), "monotonic_ns": pa.int64(), "uncertainty_ns": pa.int64()}
_KINDS |= {"drive": pa.uint16(), "register": pa.uint16(), "value": pa.float64(), "status": pa.uint16()}


def unpacked_size(data: bytes | memoryview) -> int:
    """Return how many bytes a message's buffers take unpacked. Raises ValueError or pa.ArrowException."""
    size = 0
    for number, message in enumerate(pa.ipc.MessageReader.open_stream(data)):
        if number == MOST_MESSAGES:
            raise ValueError(f"the message has more than {MOST_MESSAGES} parts")
        try:
            size += _size(memoryview(message.metadata), memoryview(message.body or b""))
        except struct_error:
            raise ValueError("the message is truncated") from None
    return size


def _size(metadata: memoryview, body: memoryview) -> int:
    message = _FlatbufferTable(metadata, _U32.unpack_from(metadata)[0])
    if message.number(0, _U16) != LATEST:
        raise ValueError("the Arrow metadata version is not 5")
    kind = message.number(1, _I8)
    rows = message.table(2)
    if kind == _DICTIONARY and rows:
        rows = rows.table(1)
    if kind not in (_DICTIONARY, _RECORD_BATCH) or not rows:
        return 0
    is_compressed = rows.table(3) is not None
    size = 0
    for place, length in rows.pairs(2):
        if place < 0 or length < 0 or place + length > len(body):
            raise ValueError("a buffer extends beyond the end of the message")
        declared = _I64.unpack_from(body, place)[0] if is_compressed and length else _NOT_COMPRESSED
        if declared < _NOT_COMPRESSED:
            raise ValueError("a buffer has a size below 0")
        size += length if declared == _NOT_COMPRESSED else declared
    return size


class _FlatbufferTable:
    def __init__(self, data: memoryview, place: int) -> None:
        self._data = data
        self._place = place
        self._fields = place - _I32.unpack_from(data, place)[0]
        self._length: int = _U16.unpack_from(data, self._fields)[0]

    def _field(self, number: int) -> int:
        entry = 4 + 2 * number
        offset = _U16.unpack_from(self._data, self._fields + entry)[0] if entry < self._length else 0
        return self._place + offset if offset else 0

    def number(self, number: int, kind: Struct) -> int:
        place = self._field(number)
        return int(kind.unpack_from(self._data, place)[0]) if place else 0

    def table(self, number: int) -> _FlatbufferTable | None:
        place = self._field(number)
        return _FlatbufferTable(self._data, place + _U32.unpack_from(self._data, place)[0]) if place else None

    def pairs(self, number: int) -> Any:
        place = self._field(number)
        if not place:
            return ()
        place += _U32.unpack_from(self._data, place)[0]
        count = _U32.unpack_from(self._data, place)[0]
        begin = place + _U32.size
        return _BUFFER.iter_unpack(self._data[begin : begin + count * _BUFFER.size])


class MessageError(ValueError):
    """Bytes that are not a valid message of samples."""


class SinkError(OSError):
    """A store of rows cannot be written now. The message is one sentence."""


class Packed(NamedTuple):
    """A message, and the number of its rows."""

    data: bytes
    rows: int


class RowBuffer:
    """Collects copies of polled rows until they are packed into messages."""

    def __init__(self) -> None:
        self.rows = 0
        self._names: dict[str, tuple[str, ...]] = {"drive": (), "register": (), "status": ()}
        self._columns = {name: bytearray() for name in _KINDS}

    def add(self, columns: BatchColumns) -> bool:
        """Copy the rows; return True if they were copied.

        Rows have numbers instead of the names of drives, registers and statuses. Rows whose numbers stand for
        other names than those of the earlier rows are not copied.
        """
        names = {"drive": columns.drives, "register": columns.registers, "status": columns.statuses}
        if any(not _continues(names[of], known) for of, known in self._names.items()):
            return False
        self._names = names
        for name, copied in self._columns.items():
            copied += getattr(columns, name).cast("B")
        self.rows += len(columns.time)
        return True

    def messages(self, most: int = MOST_BYTES, units: PolledUnits | None = None) -> Iterator[Packed]:
        """Yield the rows as messages of at most `most` bytes and 65536 rows."""
        column = {
            name: pa.Array.from_buffers(kind, self.rows, [None, pa.py_buffer(self._columns[name])])
            for name, kind in _KINDS.items()
        }
        is_sample = pc.equal(column["status"], 0)
        columns = {
            "time": column["time"].cast(TIMES),
            "clock_ns": pc.subtract(column["time"], column["monotonic_ns"]),
            "uncertainty_us": _microseconds(pc.if_else(is_sample, column["uncertainty_ns"], None)),
            "drive": column["drive"],
            "register": column["register"],
            "value": pc.if_else(is_sample, column["value"], None),
            "status": column["status"],
        }
        columns["unit"], texts = _units(column, self._names, units or PolledUnits())
        names = {**self._names, "unit": texts}
        rows = pa.RecordBatch.from_pydict(columns)
        for begin in range(0, self.rows, MOST_ROWS):
            yield from _pieces(rows.slice(begin, MOST_ROWS), names, most)


def _units(
    column: Mapping[str, Any], names: Mapping[str, Sequence[str]], units: PolledUnits
) -> tuple[Any, Sequence[str]]:
    """Return each row's unit as a code, and the text of each code."""
    table = units.table(names["drive"], names["register"])
    registers = pa.scalar(len(names["register"]), pa.uint32())
    series = pc.add(pc.multiply(column["drive"].cast(pa.uint32()), registers), column["register"])
    codes = table.newest.take(series)
    oldest_ns = pc.min(column["monotonic_ns"]).as_py()
    for change in takewhile(lambda change: change.until_ns > oldest_ns, table.changes):
        is_its = pc.equal(series, pa.scalar(change.series, pa.uint32()))
        is_before = pc.less(column["monotonic_ns"], change.until_ns)
        codes = pc.if_else(pc.and_(is_its, is_before), pa.scalar(change.code, pa.uint16()), codes)
    return codes, table.texts


def _continues(names: tuple[str, ...], known: tuple[str, ...]) -> bool:
    return names is known or names[: len(known)] == known


def unpack(data: bytes | memoryview) -> Any:
    """Return the rows of a message as a pyarrow.Table with the columns of `ROWS`. Raises MessageError."""
    try:
        table = _table(data)
        table.validate(full=True)
        columns = {name: table.column(name) for name in ("time", "clock_ns", "drive", "register", "status")}
        columns["monotonic_ns"] = pc.subtract(columns["time"].cast(pa.int64()), columns.pop("clock_ns"))
        uncertainty_us = table.column("uncertainty_us").cast(pa.int32()).cast(pa.int64())
        columns["uncertainty_ns"] = pc.multiply(uncertainty_us, 1000)
        columns["value"] = table.column("value")
        columns["unit"] = table.column("unit")
        rows = pa.table([columns[name].cast(ROWS.field(name).type) for name in ROWS.names], schema=ROWS)
        _check(rows)
    except (pa.ArrowException, KeyError, TypeError, ValueError, OSError, MemoryError) as error:
        first = (str(error) or type(error).__name__).splitlines()[0][:MOST_SAID]
        raise MessageError(f"{len(data)} bytes are not a message of samples: {first}") from error
    return rows


def _table(data: bytes | memoryview) -> Any:
    """Return the table in an Arrow stream. Raises ValueError if it is too large or a type is wrong."""
    size = unpacked_size(data)
    if size > MOST_UNPACKED:
        raise ValueError(f"the message has {size} bytes unpacked; the limit is {MOST_UNPACKED}")
    with pa.ipc.open_stream(data) as reader:
        for field in reader.schema:
            if not _is_ours(field):
                raise ValueError(f"the column {field.name} has the wrong type {field.type}")
        batches = []
        rows = 0
        for batch in reader:
            rows += len(batch)
            if rows > MOST_ROWS:
                raise ValueError(f"the message has {rows} rows; the limit is {MOST_ROWS}")
            batches.append(batch)
        return pa.Table.from_batches(batches, reader.schema)


def _is_ours(field: Any) -> bool:
    if field.name in ("drive", "register", "status", "unit"):
        return bool(pa.types.is_dictionary(field.type) and field.type.value_type == pa.utf8())
    return field.type in _TYPES.get(field.name, ())


def _check(rows: Any) -> None:
    """Raise ValueError for rows that a database would reject: they would block all later messages."""
    for field, column in zip(rows.schema, rows.columns, strict=True):
        if not field.nullable and column.null_count:
            raise ValueError(f"some rows have no {field.name}")
        if pa.types.is_dictionary(field.type):
            for chunk in column.chunks:
                _check_names(field.name, chunk.dictionary)


def _check_names(kind: str, names: Any) -> None:
    if names.null_count:
        raise ValueError(f"the column {kind} has a null text")
    if (pc.max(pc.binary_length(names)).as_py() or 0) > MOST_NAME:
        raise ValueError(f"a text in the column {kind} is longer than {MOST_NAME} bytes")
    if pc.any(pc.match_substring(names, "\0")).as_py():
        raise ValueError(f"a text in the column {kind} has a NUL character")


def _microseconds(ns: Any) -> Any:
    up = pc.divide(pc.add(ns, 999), 1000)
    return pc.min_element_wise(up, LONGEST_US, skip_nulls=False).cast(pa.int32())


def _pieces(rows: Any, names: Mapping[str, Sequence[str]], most: int) -> Iterator[Packed]:
    coded = _coded(rows, names)
    data = _stream(coded)
    if (len(data) <= most and coded.get_total_buffer_size() <= MOST_UNPACKED) or len(rows) < 2:
        yield Packed(data, len(rows))
        return
    middle = len(rows) // 2
    yield from _pieces(rows.slice(0, middle), names, most)
    yield from _pieces(rows.slice(middle), names, most)


def _coded(rows: Any, names: Mapping[str, Sequence[str]]) -> Any:
    rows = rows.take(pc.array_sort_indices(rows.column("register")))
    columns = {name: rows.column(name) for name in rows.schema.names}
    for name, known in names.items():
        used = columns[name].unique().drop_null().sort()
        codes = pc.index_in(columns[name], value_set=used).cast(pa.uint16())
        texts = pa.array([known[code] for code in used.to_pylist()], pa.utf8())
        columns[name] = pa.DictionaryArray.from_arrays(codes, texts)
    return pa.RecordBatch.from_pydict(columns)


def _stream(rows: Any) -> bytes:
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, rows.schema, options=COMPRESSED) as writer:
        writer.write_batch(rows)
    return bytes(sink.getvalue())


# ---- units of rows ----


RAW = "raw count"  # unit of values whose scale is unknown; histories use the same text


class UnitChange(NamedTuple):
    """A change of a register's unit: until `until_ns` (monotonic), the unit was `code`."""

    until_ns: int
    series: int
    code: int


class UnitTable(NamedTuple):
    """The unit of each register of each drive, as a code.

    The values of one register of one drive are a series. Series are numbered drive * len(registers) +
    register, by the positions of the two names in their lists.
    """

    newest: Any  # pa.Array of the present unit code of each series; null if unknown
    changes: Sequence[UnitChange]  # the newest change comes first
    texts: Sequence[str]  # unit texts by code


class PolledUnits:
    """The units of all polled registers, now and in the past. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._since: dict[tuple[str, str], list[tuple[int, str]]] = {}
        self._made: tuple[Sequence[str], Sequence[str], UnitTable] | None = None

    def note(self, line: PlantLine, since_ns: int) -> None:
        """Set the units of a line's registers for requests sent at or after `since_ns` (monotonic)."""
        with self._lock:
            for polled in line.drives:
                for poll in polled.series:
                    known = self._since.setdefault((polled.drive.name, poll.register.name), [])
                    unit = unit_of(polled.drive, poll.register)
                    if not known or known[-1][1] != unit:
                        known.append((since_ns, unit))
            self._made = None

    def table(self, drives: Sequence[str], registers: Sequence[str]) -> UnitTable:
        """Return the units of the drives' registers. The table is cached until lines or names change."""
        # without the cache, looking up units would cost more than all other work on a row
        with self._lock:
            if self._made is None or self._made[:2] != (drives, registers):
                self._made = drives, registers, self._make(drives, registers)
            return self._made[2]

    def _make(self, drives: Sequence[str], registers: Sequence[str]) -> UnitTable:
        drive_at = {name: at for at, name in enumerate(drives)}
        register_at = {name: at for at, name in enumerate(registers)}
        code: dict[str, int] = {}
        newest: list[int | None] = [None] * (len(drives) * len(registers))
        changes: list[UnitChange] = []
        for (drive, register), known in self._since.items():
            if drive in drive_at and register in register_at:
                series = drive_at[drive] * len(registers) + register_at[register]
                codes = [code.setdefault(unit, len(code)) for _, unit in known]
                newest[series] = codes[-1]
                for (until_ns, _), before in zip(known[1:], codes[:-1], strict=True):
                    changes.append(UnitChange(until_ns, series, before))
        return UnitTable(pa.array(newest, pa.uint16()), sorted(changes, reverse=True), list(code))


def unit_of(drive: Drive, register: Register[Any]) -> str:
    """Return a register's unit: "" for a plain number, "names of yd1000" for named values of a YD1000."""
    if register.values:
        return f"names of {drive.model or type(drive).__name__}"
    return RAW if register.step is None else register.unit
