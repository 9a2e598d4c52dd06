"""Drives that fall silent, on a clock that the test sets: the time they cost other drives, and their
return.
"""

from __future__ import annotations

from collections import Counter

import pytest
from clocked_lines import ClockedLines, ClockedWire, S
from lines import polled, rows_of
from tables import table
from toy import Toy

from multidrop.drive.register import HOLDING, reading
from multidrop.families import InvtCHE
from multidrop.polling.batch import Row
from multidrop.polling.jobs import JobMaker
from multidrop.polling.polled_line import PolledLine
from multidrop.sim import Faults, SimulatedDrive, simulated

DRIVES = 31
FIRST, LATER = 8, 30  # s; values are counted in the first 8 s and in the 30 s after them
BACK = 45  # s; time limit until dead drives are polled again after they get power


def test_the_row_of_a_slot_skipped_in_advance_appears_only_at_the_slots_time() -> None:
    """The poller decides in advance which slots of a silent drive it skips."""
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
    """While all drives of a line with a period answer, the line is checked only to refill its queue."""
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
        # a few further checks when a drive falls silent or answers again
        assert abs(len(looked) - looks) <= 3


@pytest.mark.long
@pytest.mark.story
@pytest.mark.parametrize(("dead", "back_s"), [(1, 5), (5, 25), (10, 45)])
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
        clocked.run(5)  # the poller measures the response delays
        healthy = answered(10)
        for sim in sims[:dead]:
            sim.deaf_until = float("inf")
        clocked.run(10)  # the poller notices that these drives are silent
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
def test_drives_dead_from_the_start_hardly_slow_others(count: int, dead: int, every: float | None) -> None:
    """Every third drive is dead, so that most answering drives are polled after a dead one."""
    gone = {3 * number + 1 for number in range(dead)}

    def answered(addresses: list[int]) -> list[int]:
        """Return the numbers of answers in the first FIRST s, and in the LATER s after that."""
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


SOON, LATE = 0.005, 0.06  # short and long response delay in s


class Wide(Toy):
    """A drive with two registers far apart. One request for both pays only if replies are slow."""

    most_registers = {HOLDING: 100}
    readable_gaps = {HOLDING: range(100)}

    near = reading(0x20)
    far = reading(0x38)


NAMES = (Wide.near.name, Wide.far.name)


def asked_together(rows: list[Row]) -> set[bool]:
    """Return, for each exchange, True if it read both registers."""
    assert {row.status for row in rows} == {"ok"}
    return {count == len(NAMES) for count in Counter(row.monotonic_ns for row in rows).values()}


@pytest.mark.slow
@table(("document", "truth"), [(SOON, LATE), (LATE, SOON)], ids=["later", "sooner"])
@table("every", [None, 0.75], ids=["in turn", "at a rate"])
def test_blocks_are_planned_again_if_the_response_delay_differs_from_the_manual(
    document: float, truth: float, every: float | None
) -> None:
    drive = Wide(1, name="pump-1")
    drive.response_delay = document
    sim = SimulatedDrive(Wide(1), response_delay=truth)
    with ClockedLines(ClockedWire([sim], Faults()), [polled(drive, [Wide.near, Wide.far], every)]) as clocked:
        first = clocked.run(0.7)
        assert asked_together(first) == {document == LATE}
        between = clocked.run(3.0)
        after = clocked.run(9.0)
        assert asked_together(after) == {truth == LATE}
        summary = clocked.poller.summary()["lines"]["line"]
    assert summary["misses"] == {}
    if every:
        assert summary["overrun_slots"] == 0
        for name in NAMES:
            slots = [row.monotonic_ns for row in first + between + after if row.register == name]
            dues = {round((at - slots[0]) / (every * S)) for at in slots}
            assert dues == set(range(len(dues)))  # each slot has exactly one row


def test_replanning_one_drive_keeps_the_polling_order() -> None:
    drives = [Wide(address, name=f"pump-{address}") for address in (1, 2, 3)]
    drives[1].response_delay = LATE
    sims = [SimulatedDrive(Wide(address), response_delay=SOON) for address in (1, 2, 3)]
    with ClockedLines(
        ClockedWire(sims, Faults()), [polled(each, [Wide.near, Wide.far]) for each in drives]
    ) as clocked:
        clocked.run(5.0)
        rows = [(row.drive, row.register) for row in clocked.run(2.0)]
    at = rows.index(("pump-1", "near"))
    assert rows[at : at + 6] == [(drive.name, name) for drive in drives for name in NAMES]


@pytest.mark.slow
def test_memory_is_bounded_if_a_response_delay_keeps_changing() -> None:
    drive = Wide(1, name="pump-1")
    sim = SimulatedDrive(Wide(1), response_delay=SOON)
    with ClockedLines(ClockedWire([sim], Faults()), [polled(drive, [Wide.near, Wide.far])]) as clocked:
        (line,) = clocked.poller._lines
        seen = set()
        for _ in range(6):
            for sim.response_delay in (SOON, LATE):
                clocked.run(6.0)
                seen.add(len(line._maker._made))
    assert seen == {2, 3}


@pytest.mark.slow
def test_a_drives_blocks_change_only_if_others_are_faster(monkeypatch: pytest.MonkeyPatch) -> None:
    """Measured delays always vary a little. That alone must not change the blocks."""
    drive = Wide(1, name="pump-1")
    sim = SimulatedDrive(Wide(1), response_delay=SOON)
    choose, chosen = JobMaker.plan, []
    monkeypatch.setattr(JobMaker, "plan", lambda *given: chosen.append(given) or choose(*given))
    with ClockedLines(ClockedWire([sim], Faults()), [polled(drive, [Wide.near, Wide.far])]) as clocked:
        for sim.response_delay in (SOON / 20, 2 * SOON, SOON / 5, SOON):
            assert asked_together(clocked.run(6.0)) == {False}
        assert len(chosen) == 1
        sim.response_delay = LATE
        clocked.run(6.0)
        assert len(chosen) == 2
