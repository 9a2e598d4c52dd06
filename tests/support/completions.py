"""Completions in the core's own memory, and the rows made of them."""

from __future__ import annotations

from typing import Any

from multidrop._core import ffi, lib

from multidrop.core import EXCEPTION_STATUS, Columns, Completion, Port, RowLayout, Status


def new_completion(**fields: object) -> Any:
    """Return a struct md_completion."""
    return ffi.new("struct md_completion *", fields)


def add_rows(columns: Columns, block: RowLayout, found: Any, utc_minus_monotonic_ns: int) -> bool:
    """Append the rows of a struct md_completion; False where there is no room for all of them."""
    return bool(lib.md_columns_add(columns.c, block.c, found, utc_minus_monotonic_ns))


def add_miss(
    columns: Columns, block: RowLayout, status: Status, due_ns: int, utc_minus_monotonic_ns: int
) -> bool:
    """Append rows for values that were due at `due_ns` and not asked for."""
    found = new_completion(result=-status, begun_ns=due_ns)
    return add_rows(columns, block, found, utc_minus_monotonic_ns)


def status_of(found: Completion) -> int:
    """Return the status of its rows."""
    if found.result <= 0:
        return -found.result
    return EXCEPTION_STATUS + found.reply.exception if found.reply.exception else 0


def pending(port: Port) -> int:
    """Return how many queued exchanges are not carried out yet."""
    progress = lib.md_port_progress(port.c)
    return int(progress.submitted - progress.done) & 0xFFFF_FFFF
