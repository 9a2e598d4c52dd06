"""Blocks are planned again for a drive that answers sooner or later than documented."""

from __future__ import annotations

from collections import Counter

import pytest
from clocked_lines import ClockedLines, ClockedWire, S
from lines import polled
from tables import table
from toy import Toy

from multidrop.drive.register import HOLDING, reading
from multidrop.polling.batch import Row
from multidrop.polling.jobs import JobMaker
from multidrop.sim import Faults, SimulatedDrive

SOON, LATE = 0.005, 0.06  # short and long response delay in s


class Wide(Toy):
    """Two registers so far apart that one request is faster than two only with a long response delay."""

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
def test_blocks_are_planned_again_for_the_measured_response_delay(
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
def test_blocks_are_kept_unless_others_are_faster(monkeypatch: pytest.MonkeyPatch) -> None:
    """Measured delays always vary a little, for example because of the host."""
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
