"""Ownership: the record that says whose a line is, and who may write it when. Pure.

A record is written only when its line changes hands. It names a gateway and its session: once that session
is over, it is void.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

from multidrop.fleet.buckets import Record

NOBODY = ""


class Step(NamedTuple):
    """The claims and releases of a gateway, at the revisions that it judged by."""

    claims: dict[str, int]  # line: revision of the record that is replaced
    releases: set[str]


def owner_of(record: Record | None) -> tuple[str, int]:
    """Return gateway and session of a line's record; a free line has neither."""
    if record is None or not record.value:
        return NOBODY, 0
    return record.value["gateway"], record.value["session"]


def owner_value(gateway: str, session: int, now_ms: int) -> dict[str, Any]:
    """Return a line's record; `now_ms` (UTC) is for people alone."""
    return {"gateway": gateway, "session": session, "since": now_ms}


def decide(
    me: tuple[str, int],
    lines: Iterable[str],
    wanted: Mapping[str, str],
    records: Callable[[str], Record | None],
    is_over: Callable[[str, int], bool],
    *,
    is_settled: bool,
    is_draining: bool,
) -> Step:
    """Return which lines to claim and which to give away.

    `me` is our name and session, `wanted` the gateway of each line by the balance. A line that nobody ever
    had is claimed only when we are settled: else the first gateway of a cold start would take all of them.
    """
    claims: dict[str, int] = {}
    releases: set[str] = set()
    over: dict[tuple[str, int], bool] = {}
    for line in lines:
        record = records(line)
        owner = owner_of(record)
        if owner == me:
            if is_draining or wanted.get(line, me[0]) != me[0]:
                releases.add(line)
        elif wanted.get(line) != me[0] or is_draining:
            continue
        elif record is None or record.value is None:
            if is_settled:
                claims[line] = record.revision if record else 0
        elif owner[0] == NOBODY:
            claims[line] = record.revision
        else:
            if owner not in over:
                over[owner] = is_over(*owner)
            if over[owner]:
                claims[line] = record.revision
    return Step(claims, releases)
