"""Drives that fall silent, on the test's clock: their cost to the others, and their return."""

from __future__ import annotations

import pytest
from clocked_lines import ClockedLines, ClockedWire, S
from lines import polled, rows_of
from toy import Toy

from multidrop.families import InvtCHE
from multidrop.polling.polled_line import PolledLine
from multidrop.sim import Faults, simulated

DRIVES = 31
FIRST, LATER = 8, 52  # durations in s over which the promised rates are measured
BACK = 45  # s until drives that were dead from the start are polled again, after all have power


def test_the_row_of_a_skipped_slot_does_not_appear_before_the_slot() -> None:
    """Skipped slots are planned in advance, but their rows must not appear before the slots."""
    toy = Toy(1, name="pump-1")
    silent = simulated(toy)
    silent.deaf_until = float("inf")
    with ClockedLines(ClockedWire([silent], Faults()), [polled(toy, [Toy.fault], 0.01)]) as clocked:
        clocked.run(5)
        for _ in range(100):
            rows = clocked.run(0.05)
            assert clocked.now - 0.02 * S <= rows[-1].monotonic_ns <= clocked.now
            assert all(row.monotonic_ns <= clocked.now for row in rows)
    assert all(row.monotonic_ns <= clocked.now for row in rows_of(clocked.poller))
    assert clocked.poller.summary()["lines"]["line"]["misses"]["not asked: drive is silent"] > 400


@pytest.mark.parametrize(("is_silent", "looks"), [(False, 20), (True, 40)])
def test_a_line_is_checked_more_often_while_a_drive_is_silent(
    monkeypatch: pytest.MonkeyPatch, is_silent: bool, looks: int
) -> None:
    """While all drives of a line with a period answer, its queue only needs to be refilled."""
    looked: list[int] = []
    tend = PolledLine.tend

    def noted(line: PolledLine, now_ns: int) -> None:
        looked.append(now_ns)
        tend(line, now_ns)

    monkeypatch.setattr(PolledLine, "tend", noted)
    drives = [Toy(1, name="pump-1"), Toy(2, name="pump-2")]
    sims = [simulated(drive) for drive in drives]
    sims[1].deaf_until = float("inf") if is_silent else 0.0
    with ClockedLines(
        ClockedWire(sims, Faults()), [polled(drive, [Toy.fault], 0.1) for drive in drives]
    ) as clocked:
        clocked.run(5)
        looked.clear()
        rows = clocked.run(2)
        assert len([row for row in rows if row.value is not None]) == (20 if is_silent else 40)
        assert abs(len(looked) - looks) <= 3  # the core also calls when a drive falls silent or answers again


@pytest.mark.long
@pytest.mark.story
@pytest.mark.parametrize(
    ("dead", "back_s"),
    [(1, 5), (5, 25), (10, 45)],
)
def test_silent_drives_hardly_slow_the_others_and_return_soon(dead: int, back_s: int) -> None:
    drives = [InvtCHE(address, name=f"drive-{address}", baudrate=38_400) for address in range(1, DRIVES + 1)]
    sims = [simulated(drive) for drive in drives]
    clocked = ClockedLines(
        ClockedWire(sims, Faults()), [polled(each, each.readings()[:1]) for each in drives]
    )
    gone = {each.name for each in drives[:dead]}

    def answered(seconds: float) -> int:
        return sum(1 for row in clocked.run(seconds) if row.value is not None)

    with clocked:
        clocked.run(5)  # until response delays are measured
        healthy = answered(10)
        for sim in sims[:dead]:
            sim.deaf_until = float("inf")
        clocked.run(10)  # until the poller knows that they are silent
        assert answered(50) >= 0.97 * 5 * healthy
        for sim in sims[:dead]:
            sim.deaf_until = 0.0
        revived, back = clocked.now, set()
        while not gone <= back:
            assert clocked.now <= revived + back_s * S
            back |= {row.drive for row in clocked.run(0.5) if row.value is not None}


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.story
@pytest.mark.parametrize(("count", "dead", "every"), [(16, 5, None), (16, 1, 0.5), (31, 10, None)])
def test_drives_dead_from_the_start_hardly_slow_the_others(
    count: int, dead: int, every: float | None
) -> None:
    """Every third drive is dead, so that most answering drives are polled after a dead one."""
    gone = {3 * number + 1 for number in range(dead)}

    def answered(addresses: list[int]) -> list[int]:
        """Return the number of answers in the first seconds, and later."""
        drives = [InvtCHE(address, name=f"drive-{address}", baudrate=38_400) for address in addresses]
        sims = [simulated(drive) for drive in drives]
        for sim in sims:
            sim.deaf_until = float("inf") if sim.drive.address in gone else 0.0
        clocked = ClockedLines(
            ClockedWire(sims, Faults()), [polled(each, each.readings()[:1], every) for each in drives]
        )
        with clocked:
            found = [sum(row.value is not None for row in clocked.run(span)) for span in (FIRST, LATER)]
            for sim in sims:
                sim.deaf_until = 0.0
            revived, back = clocked.now, set[str]()
            while not back >= {each.name for each in drives}:
                assert clocked.now < revived + BACK * S
                back |= {row.drive for row in clocked.run(1) if row.value is not None}
            return found

    every_drive = list(range(1, count + 1))
    first, later = answered(every_drive)
    without_first, without_later = answered([address for address in every_drive if address not in gone])
    assert first >= 0.9 * without_first
    assert later >= 0.98 * without_later
