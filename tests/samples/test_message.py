"""Messages of samples: any Arrow reader can open them, and invalid bytes are rejected."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

import pyarrow as pa
import pytest
from batches import DRIVES, EXAMPLE, REGISTERS, SECOND, UTC_0, add_rows, block, completion, example
from spooled import numbered, rows_of
from tables import table

from multidrop import Batch
from multidrop.core import Columns, Field, Names, NumberFormat, RowLayout
from multidrop.polling.added_rows import LONGEST_TEXT, AddedRow, JoinedColumns
from multidrop.polling.batch import status_code
from multidrop.samples.message import MOST_ROWS, MessageError, Packed, RowBuffer, unpack, unpacked_size


def packed(*batches: Batch, most: int = 900_000) -> list[Packed]:
    buffer = RowBuffer()
    for batch in batches:
        assert buffer.add(batch.columns())
    return list(buffer.messages(most))


@pytest.mark.slow
def test_rows_are_read_back_unchanged_from_a_message() -> None:
    (message,) = packed(example())
    assert message.rows == len(EXAMPLE)
    wanted = [(*row[:2], row[2] and 1000, *row[3:], None) for row in EXAMPLE]  # 7 ns are rounded up to 1 us
    assert rows_of(unpack(message.data)) == sorted(wanted, key=lambda row: (row[0], row[3:5]))


@pytest.mark.slow
def test_pyarrow_opens_a_message() -> None:
    """Only pyarrow reads the message. The columns are those of the table in the docstring of message.py."""
    (message,) = packed(example())
    with pa.ipc.open_stream(message.data) as reader:
        table = reader.read_all()
    assert table.schema.names == [
        "time",
        "clock_ns",
        "uncertainty_us",
        "drive",
        "register",
        "value",
        "status",
        "unit",
    ]
    assert set(table.column("clock_ns").to_pylist()) == {UTC_0}
    found = table.drop_columns(["time"]).to_pylist()  # pyarrow needs pandas to return nanoseconds
    assert [(row["register"], row["drive"], row["value"]) for row in found][:2] == [
        ("output_frequency", "pump-1", 49.99),
        ("output_frequency", 'fan, the "old" one', None),
    ]
    assert {row["status"] for row in found} == {row.status for row in EXAMPLE}
    assert table.column("time").type == pa.timestamp("ns", "UTC")


def test_values_are_stored_bit_for_bit() -> None:
    numbers = [-0.0, 0.0, 1e300, 5e-324, 0.1, -1 / 3]
    columns = Columns(len(numbers))
    for at, number in enumerate(numbers):
        found = completion((at + 1) * SECOND, first_ns=(at + 1) * SECOND + 1)
        found.reply.data_len = 8
        found.reply.data[0:8] = list(struct.pack(">d", number))
        assert add_rows(columns, RowLayout(0, [Field(0, NumberFormat.F64, 0, 1.0, 1.0)]), found, UTC_0)
    batch = Batch(columns, DRIVES, REGISTERS)
    (message,) = packed(batch)
    got = unpack(message.data).column("value").to_pylist()
    assert struct.pack(f"{len(numbers)}d", *got) == bytes(batch.columns().value)
    assert got == numbers


def test_a_message_with_the_longest_text_of_an_event_is_accepted() -> None:
    """A character takes up to four bytes in UTF-8. All rows of a message that is not accepted are lost."""
    text = "\N{MOTOR BOAT}" * LONGEST_TEXT
    event = AddedRow(UTC_0, 0, 0, 0, 0, status_code(text), 0.0)
    (message,) = packed(Batch(JoinedColumns(example().parts()[0], [event]), DRIVES, REGISTERS))
    assert text in unpack(message.data).column("status").to_pylist()


@table(("ns", "told"), [(1, 1000), (1000, 1000), (1001, 2000), (3 * 10**12, (2**31 - 1) * 1000)])
def test_time_uncertainty_of_a_sample_is_rounded_up(ns: int, told: int) -> None:
    """The last uncertainty, 50 minutes, exceeds 32 bits and is capped. No request takes that long."""
    columns = Columns(1)
    assert add_rows(columns, block(0, 0), completion(SECOND, first_ns=SECOND + ns, words=(1,)), UTC_0)
    (message,) = packed(Batch(columns, DRIVES, REGISTERS))
    assert unpack(message.data).column("uncertainty_ns").to_pylist() == [told]


@pytest.mark.long
def test_messages_are_not_larger_than_their_size_limit() -> None:
    found = packed(numbered(0, 2000), most=8_000)
    assert len(found) > 2
    assert all(len(message.data) <= 8_000 for message in found)
    rows = [row for message in found for row in rows_of(unpack(message.data))]
    assert sorted(rows, key=lambda row: (row[0], row[3:5])) == rows_of(
        unpack(packed(numbered(0, 2000))[0].data)
    )


@pytest.mark.slow
def test_a_message_has_at_most_65536_rows() -> None:
    found = packed(*(numbered(first, 1000) for first in range(0, 7000, 1000)))
    assert [message.rows for message in found] == [MOST_ROWS, 70_000 - MOST_ROWS]


def test_a_row_buffer_refuses_rows_of_another_poller() -> None:
    buffer = RowBuffer()
    assert buffer.add(numbered(0, 10).columns())
    assert not buffer.add(numbered(10, 10, Names(["fan-1", "fan-2", "fan-3", "fan-4"])).columns())
    assert buffer.rows == 100
    more = Names([f"pump-{number}" for number in range(1, 7)])
    assert buffer.add(numbered(10, 10, more).columns())  # the same poller, with more drives


@pytest.mark.long
def test_damaged_messages_raise_only_message_error() -> None:
    (message,) = packed(numbered(0, 40))
    whole = unpack(message.data)
    dice = random.Random(7)
    for _ in range(300):
        damaged = bytearray(message.data)
        for _ in range(dice.randrange(1, 4)):
            damaged[dice.randrange(len(damaged))] = dice.randrange(256)
        with suppress(MessageError):  # any other exception fails the test
            assert unpack(bytes(damaged)).schema == whole.schema
    for length in range(0, len(message.data) - 8, 7):
        with pytest.raises(MessageError, match=f"^{length} bytes are not a message of samples"):
            unpack(message.data[:length])
    with pytest.raises(MessageError):
        unpack(b"no Arrow at all")


def named(*names: str | None) -> pa.DictionaryArray:
    return pa.array(names, pa.utf8()).dictionary_encode()


def times(*ns: int | None) -> pa.Array:
    return pa.array(ns, pa.int64()).cast(pa.timestamp("ns", "UTC"))


NAMELESS = pa.DictionaryArray.from_arrays(pa.array([0, 1], pa.int32()), pa.array(["a", None]))


def written(options: pa.ipc.IpcWriteOptions | None = None, **other: pa.Array) -> bytes:
    """Return a message of two rows with these columns, as if another program had written it."""
    columns = {
        "time": times(UTC_0, UTC_0),
        "clock_ns": pa.array([5, 5], pa.int64()),
        "uncertainty_us": pa.array([1, 2], pa.int32()),
        "drive": named("fan", "fan"),
        "register": named("speed", "torque"),
        "value": pa.array([1.0, 2.0]),
        "status": named("ok", "ok"),
        "unit": named("Hz", None),
    }
    rows = pa.RecordBatch.from_pydict(columns | other)
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, rows.schema, options=options) as writer:
        writer.write_batch(rows)
    return bytes(sink.getvalue())


@table(
    ("column", "rows", "said"),
    [
        ("time", times(None, UTC_0), "some rows have no time"),
        ("clock_ns", pa.array([None, 5], pa.int64()), "some rows have no monotonic_ns"),
        ("drive", named("fan", None), "some rows have no drive"),
        ("register", named(None, "speed"), "some rows have no register"),
        ("status", named("ok", None), "some rows have no status"),
        ("drive", NAMELESS, "the column drive has a null text"),
        ("status", NAMELESS, "the column status has a null text"),
        ("unit", NAMELESS, "the column unit has a null text"),
        ("drive", named("fan\0", "fan"), "a text in the column drive has a NUL character"),
        ("register", named("speed", "\0"), "a text in the column register has a NUL character"),
        ("status", named("ok", "o\0k"), "a text in the column status has a NUL character"),
        ("unit", named("Hz", "\0"), "a text in the column unit has a NUL character"),
        ("drive", named("f" * 2001, "fan"), "a text in the column drive is longer than 2000 bytes"),
        ("register", named("speed", "ü" * 1001), "a text in the column register is longer than 2000 bytes"),
        ("uncertainty_us", pa.array([1, 1 << 31], pa.int64()), "Integer value 2147483648 not in range"),
    ],
)
def test_message_with_unstorable_rows_is_rejected(column: str, rows: pa.Array, said: str) -> None:
    """A hub that accepted such rows could store no later message of any gateway."""
    with pytest.raises(MessageError, match=f"bytes are not a message of samples: {said}"):
        unpack(written(**{column: rows}))


def test_a_message_written_by_another_arrow_program_is_accepted() -> None:
    assert rows_of(unpack(written()))[0][3:] == ("fan", "speed", 1.0, "ok", "Hz")
    assert len(unpack(written(drive=named("ü" * 1000, "fan")))) == 2


def alike(rows: int) -> dict[str, Any]:
    """Return columns of `rows` equal rows."""
    names = ("drive", "register", "status", "unit")
    return {
        "time": pa.repeat(times(UTC_0)[0], rows),
        "clock_ns": pa.repeat(5, rows),
        "uncertainty_us": pa.repeat(pa.scalar(1, pa.int32()), rows),
        "value": pa.repeat(1.0, rows),
        **{name: pa.repeat("a", rows).dictionary_encode() for name in names},
    }


@pytest.mark.slow
def test_a_message_with_too_many_rows_is_rejected() -> None:
    many = MOST_ROWS + 1
    columns = alike(many)
    with pytest.raises(MessageError, match="65537 rows; the limit is 65536"):
        unpack(written(**columns))


BOMB = 1 << 28  # bytes
ZSTD = pa.ipc.IpcWriteOptions(compression="zstd")
# Functions that return a column with `rows` rows. It is small until it is converted to the column's type.
OF_ONE_TEXT = {
    "unit": lambda rows: pa.RunEndEncodedArray.from_arrays([rows], pa.array(["f" * 9000])),
    "value": lambda rows: pa.DictionaryArray.from_arrays(pa.repeat(0, rows), pa.array(["1" * 9000])),
    "clock_ns": lambda rows: pa.RunEndEncodedArray.from_arrays([rows], pa.array([5])),
}

# keeps the pools alive, because memory of a test may be freed after the test
POOLS: list[pa.MemoryPool] = []


@pytest.fixture
def most_allocated() -> Iterator[Callable[[], int]]:
    """Yield a function that returns the peak of memory that pyarrow has allocated since this call."""
    before = pa.default_memory_pool()
    pool = pa.proxy_memory_pool(pa.system_memory_pool())
    POOLS.append(pool)
    pa.set_memory_pool(pool)
    yield lambda: int(pool.max_memory() or 0)
    pa.set_memory_pool(before)


def bomb(compression: str) -> bytes:
    """Return a message that declares a large name, but lacks most of the name's bytes."""
    options = pa.ipc.IpcWriteOptions(compression=compression)
    data = written(options, drive=named("f" * BOMB, "fan"))
    assert len(data) < BOMB / 200
    return data


@pytest.mark.slow
@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_a_message_of_huge_size_is_not_unpacked(compression: str, most_allocated: Callable[[], int]) -> None:
    data = bomb(compression)
    before = most_allocated()
    with pytest.raises(MessageError, match=r"2684\d{5} bytes unpacked; the limit is 4194304"):
        unpack(data)
    assert most_allocated() - before < 1 << 20


@pytest.mark.slow
@pytest.mark.parametrize("column", OF_ONE_TEXT)
def test_a_column_that_repeats_one_value_is_not_unpacked(
    column: str, most_allocated: Callable[[], int]
) -> None:
    rows = 30_000
    columns = alike(rows)
    data = written(ZSTD, **(columns | {column: OF_ONE_TEXT[column](rows)}))
    before = most_allocated()
    with pytest.raises(MessageError, match=f"the column {column} has the wrong type"):
        unpack(data)
    assert most_allocated() - before < 8 << 20


def test_a_billion_empty_rows_are_rejected_without_much_memory(most_allocated: Callable[[], int]) -> None:
    schema = pa.schema([("time", pa.null())])
    rows = pa.RecordBatch.from_arrays([pa.Array.from_buffers(pa.null(), 1 << 30, [None])], schema=schema)
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, schema) as writer:
        writer.write_batch(rows)
    with pytest.raises(MessageError, match="the column time has the wrong type"):
        unpack(sink.getvalue())
    assert most_allocated() < 1 << 20


def test_a_message_in_an_older_arrow_format_is_rejected() -> None:
    """In the older format, compressed buffers are marked differently."""
    options = pa.ipc.IpcWriteOptions(metadata_version=pa.ipc.MetadataVersion.V4)
    with pytest.raises(MessageError, match="the Arrow metadata version is not 5"):
        unpack(written(options))


@pytest.mark.parametrize("options", [None, ZSTD, pa.ipc.IpcWriteOptions(compression="lz4")])
def test_computed_unpacked_size_equals_the_size_of_pyarrow_buffers(
    options: pa.ipc.IpcWriteOptions | None,
) -> None:
    """Equal texts are stored compressed, and random numbers uncompressed. Empty lists have no bytes."""
    dice = random.Random(3)
    data = written(
        options,
        drive=named("f" * 900, None),
        value=pa.array([dice.random(), None]),
        status=named("ok", "o" * 700),
        unit=named(None, None),
    )
    with pa.ipc.open_stream(data) as reader:
        (rows,) = list(reader)
    names = ("drive", "register", "status", "unit")
    buffers = [
        *(buffer for name in rows.schema.names for buffer in rows.column(name).buffers()),
        *(buffer for name in names for buffer in rows.column(name).dictionary.buffers()),
    ]
    assert unpacked_size(data) == sum(buffer.size for buffer in buffers if buffer)


def test_rows_are_split_into_messages_small_enough_to_be_unpacked() -> None:
    """Long names of many drives compress well, so a small message may be too large when unpacked."""
    drives = Names([f"{number:0900d}" for number in range(6000)])
    columns = Columns(6000)
    for number in range(6000):
        found = completion((number + 1) * SECOND, first_ns=(number + 1) * SECOND + 1, words=(1,))
        assert add_rows(columns, block(number, 0), found, UTC_0)
    messages = packed(Batch(columns, drives, REGISTERS))
    assert sum(message.rows for message in messages) == 6000
    assert len(messages) > 1
    assert all(len(unpack(message.data)) == message.rows for message in messages)
