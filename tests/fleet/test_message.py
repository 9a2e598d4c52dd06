"""Messages: what any reader of Arrow finds in them, and bytes that are none."""

from __future__ import annotations

import random
import struct
from contextlib import suppress

import pyarrow as pa
import pytest
from batches import DRIVES, EXAMPLE, REGISTERS, SECOND, UTC_0, block, completion, example
from completions import add_rows
from spooled import numbered, rows_of
from tables import table

from multidrop import Batch
from multidrop.core import Columns, Field, Names, NumberFormat, RowLayout
from multidrop.fleet.message import MOST_ROWS, MessageError, Packed, RowBuffer, unpack


def packed(*batches: Batch, most: int = 900_000) -> list[Packed]:
    buffer = RowBuffer()
    for batch in batches:
        assert buffer.add(batch.columns())
    return list(buffer.messages(most))


@pytest.mark.slow
def test_the_rows_come_back() -> None:
    (message,) = packed(example())
    assert message.rows == len(EXAMPLE)
    wanted = [(*row[:2], row[2] and 1000, *row[3:], None) for row in EXAMPLE]  # 7 ns, rounded up to 1 us
    assert rows_of(unpack(message.data)) == sorted(wanted, key=lambda row: (row[0], row[3:5]))


@pytest.mark.slow
def test_pyarrow_alone_opens_it() -> None:
    """By the table in the module's docstring, and no function of ours."""
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
    found = table.drop_columns(["time"]).to_pylist()  # pyarrow gives nanoseconds by pandas alone
    assert [(row["register"], row["drive"], row["value"]) for row in found][:2] == [
        ("output_frequency", "pump-1", 49.99),
        ("output_frequency", 'fan, the "old" one', None),
    ]
    assert {row["status"] for row in found} == {row.status for row in EXAMPLE}
    assert table.column("time").type == pa.timestamp("ns", "UTC")


def test_values_are_kept_bit_for_bit() -> None:
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


@table(("ns", "told"), [(1, 1000), (1000, 1000), (1001, 2000), (3 * 10**12, (2**31 - 1) * 1000)])
def test_an_uncertainty_is_rounded_up(ns: int, told: int) -> None:
    """Fifty minutes are more than 32 bits of microseconds hold, and than any request lasts."""
    columns = Columns(1)
    assert add_rows(columns, block(0, 0), completion(SECOND, first_ns=SECOND + ns, words=(1,)), UTC_0)
    (message,) = packed(Batch(columns, DRIVES, REGISTERS))
    assert unpack(message.data).column("uncertainty_ns").to_pylist() == [told]


@pytest.mark.long
def test_a_message_is_no_larger_than_it_may_be() -> None:
    found = packed(numbered(0, 2000), most=8_000)
    assert len(found) > 2
    assert all(len(message.data) <= 8_000 for message in found)
    rows = [row for message in found for row in rows_of(unpack(message.data))]
    assert sorted(rows, key=lambda row: (row[0], row[3:5])) == rows_of(
        unpack(packed(numbered(0, 2000))[0].data)
    )


@pytest.mark.slow
def test_a_message_has_no_more_rows_than_codes_have_room_for() -> None:
    found = packed(*(numbered(first, 1000) for first in range(0, 7000, 1000)))
    assert [message.rows for message in found] == [MOST_ROWS, 70_000 - MOST_ROWS]


def test_rows_of_another_poller_are_not_mixed_in() -> None:
    buffer = RowBuffer()
    assert buffer.add(numbered(0, 10).columns())
    assert not buffer.add(numbered(10, 10, Names(["fan-1", "fan-2", "fan-3", "fan-4"])).columns())
    assert buffer.rows == 100
    more = Names([f"pump-{number}" for number in range(1, 7)])
    assert buffer.add(numbered(10, 10, more).columns())  # the same poller, which knows more drives


@pytest.mark.long
def test_damaged_bytes_end_in_a_sentence() -> None:
    (message,) = packed(numbered(0, 40))
    whole = unpack(message.data)
    dice = random.Random(7)
    for _ in range(300):
        damaged = bytearray(message.data)
        for _ in range(dice.randrange(1, 4)):
            damaged[dice.randrange(len(damaged))] = dice.randrange(256)
        with suppress(MessageError):  # and no other error
            assert unpack(bytes(damaged)).schema == whole.schema
    for length in range(0, len(message.data) - 8, 7):
        with pytest.raises(MessageError, match=f"^{length} bytes are no message of samples"):
            unpack(message.data[:length])
    with pytest.raises(MessageError):
        unpack(b"no Arrow at all")


def named(*names: str | None) -> pa.DictionaryArray:
    return pa.array(names, pa.utf8()).dictionary_encode()


def times(*ns: int | None) -> pa.Array:
    return pa.array(ns, pa.int64()).cast(pa.timestamp("ns", "UTC"))


NAMELESS = pa.DictionaryArray.from_arrays(pa.array([0, 1], pa.int32()), pa.array(["a", None]))


def written(**other: pa.Array) -> bytes:
    """Return a message of two rows as another writer than ours would write it, with these columns."""
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
    with pa.ipc.new_stream(sink, rows.schema) as writer:
        writer.write_batch(rows)
    return bytes(sink.getvalue())


@table(
    ("column", "rows", "said"),
    [
        ("time", times(None, UTC_0), "its time is missing in some rows"),
        ("clock_ns", pa.array([None, 5], pa.int64()), "its monotonic_ns is missing in some rows"),
        ("drive", named("fan", None), "its drive is missing in some rows"),
        ("register", named(None, "speed"), "its register is missing in some rows"),
        ("status", named("ok", None), "its status is missing in some rows"),
        ("drive", NAMELESS, "one drive has no name"),
        ("status", NAMELESS, "one status has no name"),
        ("unit", NAMELESS, "one unit has no name"),
        ("drive", named("fan\0", "fan"), "one drive has a NUL character"),
        ("register", named("speed", "\0"), "one register has a NUL character"),
        ("status", named("ok", "o\0k"), "one status has a NUL character"),
        ("unit", named("Hz", "\0"), "one unit has a NUL character"),
        ("drive", named("f" * 1001, "fan"), "one drive is longer than 1000 bytes"),
        ("register", named("speed", "ü" * 501), "one register is longer than 1000 bytes"),
        ("uncertainty_us", pa.array([1, 1 << 31], pa.int64()), "Integer value 2147483648 not in range"),
    ],
)
def test_rows_that_no_store_takes_are_no_message(column: str, rows: pa.Array, said: str) -> None:
    """A hub that could not keep one message would never come to those behind it, of all gateways."""
    with pytest.raises(MessageError, match=f"bytes are no message of samples: {said}"):
        unpack(written(**{column: rows}))


def test_another_writers_rows_are_rows() -> None:
    assert rows_of(unpack(written()))[0][3:] == ("fan", "speed", 1.0, "ok", "Hz")
    assert len(unpack(written(drive=named("ü" * 500, "fan")))) == 2


@pytest.mark.slow
def test_a_message_of_more_rows_than_ours_have_is_none() -> None:
    many = MOST_ROWS + 1
    columns = {
        "time": pa.repeat(times(UTC_0)[0], many),
        "clock_ns": pa.repeat(5, many),
        "uncertainty_us": pa.repeat(pa.scalar(1, pa.int32()), many),
        "value": pa.repeat(1.0, many),
        **{
            name: pa.repeat("a", many).dictionary_encode() for name in ("drive", "register", "status", "unit")
        },
    }
    with pytest.raises(MessageError, match="it has 65537 rows, and 65536 are the most"):
        unpack(written(**columns))
