"""Create batches like the core's, for tests of code that processes rows."""

from __future__ import annotations

from typing import Any

from multidrop._core import ffi, lib

from multidrop.core import (
    EXCEPTION_STATUS,
    Columns,
    Completion,
    Field,
    Message,
    Names,
    NumberFormat,
    Port,
    RowLayout,
    Status,
)
from multidrop.core.frame import to_c
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
    Row(UTC_0 + 2 * SECOND, 2 * SECOND, None, 'fan, the "old" one', "output_frequency", None, "exception 12"),
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
    """Return a batch whose values count up from `start` (below 65536); every tenth value is missing."""
    columns = Columns(rows)
    for at in range(start, start + rows):
        drive = block(at % 3, at % 2, divisor=1.0)
        if at % 10 == 9:
            assert add_miss(columns, drive, Status.NO_REPLY, at + 1, UTC_0)
        else:
            assert add_rows(columns, drive, completion(at + 1, first_ns=at + 3, words=(at,)), UTC_0)
    return Batch(columns, DRIVES, REGISTERS)


# ---- create completions in the core's memory, and the rows made from them ----


def new_completion(**fields: object) -> Any:
    """Return a struct md_completion with these fields."""
    return ffi.new("struct md_completion *", fields)


def completion_of(found: Any, values: RowLayout | None = None) -> Completion:
    """Return the completion that md_port_carry_out() would fill in, with these values decoded."""
    completion = Completion(found, room=values.count if values else 0)
    if found.result > 0 and not found.reply.exception:
        reply = ffi.addressof(found, "reply")
        completion.count = lib.md_values(values.c, reply, completion.values) if values else 0
    return completion


def copied(found: Any) -> Completion:
    """Return a completion with a copy of a struct md_completion that the core may overwrite."""
    return completion_of(ffi.new("struct md_completion *", found[0]))


def completed(
    result: int, reply: Message, raw: bytes, values: RowLayout | None = None, *, at_ns: int, skipped: int = 0
) -> Completion:
    """Return the completion of an exchange that started and ended at `at_ns`."""
    times = dict.fromkeys(("begun_ns", "sent_ns", "first_ns", "last_ns"), at_ns)
    found = new_completion(result=result, skipped=skipped, reply=to_c(reply)[0], raw_len=len(raw), **times)
    found.raw[0 : len(raw)] = list(raw)
    return completion_of(found, values)


def add_rows(columns: Columns, block: RowLayout, found: Any, utc_minus_monotonic_ns: int) -> bool:
    """Append the rows of a struct md_completion to `columns`; return False if they do not all fit."""
    return bool(lib.md_columns_add(columns.c, block.c, found, utc_minus_monotonic_ns))


def add_miss(
    columns: Columns, block: RowLayout, status: Status, due_ns: int, utc_minus_monotonic_ns: int
) -> bool:
    """Append rows for values that were due at `due_ns` but not read; return False if they do not fit."""
    found = new_completion(result=-status, begun_ns=due_ns)
    return add_rows(columns, block, found, utc_minus_monotonic_ns)


def status_of(found: Completion) -> int:
    """Return the status that the completion's rows get."""
    if found.result <= 0:
        return -found.result
    return EXCEPTION_STATUS + found.reply.exception if found.reply.exception else 0


def pending(port: Port) -> int:
    """Return the number of queued exchanges that are not yet complete."""
    progress = lib.md_port_progress(port.c)
    return int(progress.submitted - progress.done) & 0xFFFF_FFFF
