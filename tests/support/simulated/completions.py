"""Create completions in the core's memory, and the rows made from them."""

from __future__ import annotations

from typing import Any

from multidrop._core import ffi, lib

from multidrop.core import EXCEPTION_STATUS, Columns, Completion, Message, Port, RowLayout, Status
from multidrop.core.frame import to_c


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
