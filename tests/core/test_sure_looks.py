"""A client that waits for values of a steady drive is woken once, when the reply is whole."""

from __future__ import annotations

from line_driver import MS, LineDriver
from line_exchanges import CHARACTER, READ, drive, exchange, line, reply

from multidrop.core import Field, NumberFormat, Peer, RowLayout

__all__ = ["drive", "line"]  # fixtures

FIELDS = RowLayout(0, [Field(0, NumberFormat.U16, 0, 1.0, 1.0)])
BY_HAND, FOR_A_ROW = {"values": FIELDS}, {"block": FIELDS}
STEADY = 60 * [15 * MS]


def looks(line: LineDriver, drive: Peer, delay: int, details: dict[str, RowLayout]) -> tuple[int, int]:
    """Carry one out as the engine does it; return the number of looks, and how late the last one was."""
    line.begin(exchange(READ, drive, **details))
    line.wait_until_write()
    left = line.now + 8 * CHARACTER
    times = [left + delay + (at + 1) * CHARACTER for at in range(len(reply()))]
    seen = found = 0
    while line.want != "done":
        line.wait_for_look()
        if found and line.now < times[seen]:  # it waits for the next character
            line.now = times[seen]
        come = sum(time <= line.now for time in times)
        line.receive(reply()[seen:come])
        seen = come
        found += 1
    return found, line.now - times[-1]


def all_looks(
    line: LineDriver, drive: Peer, delays: list[int], details: dict[str, RowLayout]
) -> list[tuple[int, int]]:
    return [looks(line, drive, delay, details) for delay in delays]


def test_seven_of_eight_looks_for_a_client_come_when_the_reply_is_whole(
    line: LineDriver, drive: Peer
) -> None:
    all_looks(line, drive, STEADY, BY_HAND)
    found = all_looks(line, drive, 80 * [15 * MS], BY_HAND)
    assert sum(times == 1 for times, _ in found) == 70
    assert max(late for _, late in found) <= CHARACTER


def test_a_row_s_reply_is_always_looked_for_before_it_is_whole(line: LineDriver, drive: Peer) -> None:
    all_looks(line, drive, STEADY, BY_HAND)
    found = all_looks(line, drive, STEADY, FOR_A_ROW)
    assert min(times for times, _ in found) > 1
    assert {late for _, late in found} == {0}


def test_a_drive_whose_delays_vary_is_looked_at_early(line: LineDriver, drive: Peer) -> None:
    all_looks(line, drive, 20 * [15 * MS, 19 * MS], BY_HAND)
    assert {late for _, late in all_looks(line, drive, 20 * [15 * MS, 19 * MS], BY_HAND)} == {0}


def test_a_steady_drive_that_becomes_quicker_is_followed(line: LineDriver, drive: Peer) -> None:
    all_looks(line, drive, [*STEADY, *(120 * [5 * MS])], BY_HAND)
    assert looks(line, drive, 5 * MS, BY_HAND)[1] <= CHARACTER
    assert drive.response_delay < 6e-3


def test_a_steady_drive_that_becomes_slower_is_followed(line: LineDriver, drive: Peer) -> None:
    found = all_looks(line, drive, [*STEADY, *(120 * [18 * MS])], BY_HAND)
    assert max(late for _, late in found) <= CHARACTER
    assert drive.response_delay > 17.5e-3
