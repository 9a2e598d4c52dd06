"""Create batches like the core's, for tests of code that processes rows."""

from __future__ import annotations

from typing import Any

from completions import add_miss, add_rows, new_completion

from multidrop.core import Columns, Field, Names, NumberFormat, RowLayout, Status
from multidrop.polling.batch import Batch, Row

# UTC in ns when the monotonic clock was 0: 2026-11-21 09:29:59.123456789.
UTC_0 = 1_795_253_399_123_456_789
SECOND = 1_000_000_000

DRIVES = Names(["pump-1", 'fan, the "old" one', "насос"])
REGISTERS = Names(["output_frequency", "motor_speed"])
METADATA = {
    "multidrop": "0.1.0",
    "plant": "завод.toml",
    "drives": {"pump-1": {"registers": {"output_frequency": {"unit": "Hz", "step": 0.01}}}},
}


def block(drive: int, *registers: int, divisor: float = 100.0) -> RowLayout:
    return RowLayout(
        drive, [Field(at, NumberFormat.U16, register, 1.0, divisor) for at, register in enumerate(registers)]
    )


def completion(sent_ns: int, *, first_ns: int = 0, words: tuple[int, ...] = (), exception: int = 0) -> Any:
    """Return the completion of a request sent at `sent_ns`, whose reply has these words or an exception."""
    found = new_completion()
    data = b"".join(word.to_bytes(2, "big") for word in words)
    found.result = 5 + len(data)
    found.sent_ns, found.first_ns = sent_ns, first_ns
    found.reply.exception = exception
    found.reply.data_len = len(data)
    found.reply.data[0 : len(data)] = list(data)
    return found


def example() -> Batch:
    """Return a batch with two samples, an exception, a timeout, and a skipped read."""
    columns = Columns(8)
    assert add_rows(columns, block(0, 0, 1), completion(SECOND, first_ns=SECOND + 7, words=(4999, 30)), UTC_0)
    assert add_rows(columns, block(1, 0), completion(2 * SECOND, exception=0x12), UTC_0)
    assert add_miss(columns, block(2, 1), Status.NO_REPLY, 3 * SECOND, UTC_0)
    assert add_miss(columns, block(1, 1), Status.NOT_ASKED, 4 * SECOND, UTC_0)
    return Batch(columns, DRIVES, REGISTERS)


EXAMPLE = [
    Row(UTC_0 + SECOND, SECOND, 7, "pump-1", "output_frequency", 49.99, "ok"),
    Row(UTC_0 + SECOND, SECOND, 7, "pump-1", "motor_speed", 0.3, "ok"),
    Row(
        UTC_0 + 2 * SECOND,
        2 * SECOND,
        None,
        'fan, the "old" one',
        "output_frequency",
        None,
        "exception 12",
    ),
    Row(UTC_0 + 3 * SECOND, 3 * SECOND, None, "насос", "motor_speed", None, "no reply"),
    Row(
        UTC_0 + 4 * SECOND,
        4 * SECOND,
        None,
        'fan, the "old" one',
        "motor_speed",
        None,
        "not asked: drive is silent",
    ),
]


def counting(rows: int, start: int = 0) -> Batch:
    """Return a batch whose values count up from `start` (below 65536); every tenth row is a miss."""
    columns = Columns(rows)
    for at in range(start, start + rows):
        drive = block(at % 3, at % 2, divisor=1.0)
        if at % 10 == 9:
            assert add_miss(columns, drive, Status.NO_REPLY, at + 1, UTC_0)
        else:
            assert add_rows(columns, drive, completion(at + 1, first_ns=at + 3, words=(at,)), UTC_0)
    return Batch(columns, DRIVES, REGISTERS)
