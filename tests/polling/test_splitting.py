"""A block that a drive does not answer as a whole is split: bounded, and no register is lost."""

from __future__ import annotations

from collections import Counter

import pytest
from clocked_lines import ClockedLines, ClockedWire
from examples import examples, usually
from hypothesis import example, given, settings
from hypothesis import strategies as st
from lines import polled
from picky import Picky, family
from simulated_bus import SimulatedBus

from multidrop.core import NumberFormat
from multidrop.drive import Drive
from multidrop.drive.declare import reading
from multidrop.errors import DriveRefused, NoReply
from multidrop.planning.blocks import blocks
from multidrop.planning.splitting import halves
from multidrop.polling import refusals
from multidrop.polling.batch import Row
from multidrop.sim import Faults

WIDE = 24


def clocked_line_of(drive: Drive, sim: Picky, every: float | None = None) -> ClockedLines:
    return ClockedLines(ClockedWire([sim], Faults()), [polled(drive, drive.registers.values(), every)])


def values(rows: list[Row]) -> dict[str, float]:
    return {row.register: row.value for row in rows if row.value is not None}


def right(names: range | set[int]) -> dict[str, float]:
    return {f"r{at}": 100 + at for at in names}


# ---- halves ----


def test_registers_at_the_same_addresses_and_groups_stay_together() -> None:
    class Kind(Drive):
        read_together = (("high", "low"),)
        a = reading(0)
        same = reading(0)
        b = reading(1)
        high = reading(2)
        between = reading(3)
        low = reading(4)
        long = reading(1, number_format=NumberFormat.U32)

    (whole,) = blocks(Kind(1), Kind.registers.values())
    todo, ends, made = [whole], [], 0
    while todo:
        parts = halves(Kind(1), block := todo.pop())
        made += len(parts)
        todo += parts
        if not parts:
            ends.append({register.name for register in block.registers})
    assert sorted(map(sorted, ends)) == [["a", "same"], ["b"], ["between"], ["high", "low"], ["long"]]
    assert made == 2 * len(ends) - 2


# ---- polled ----


@pytest.mark.parametrize("every", [None, 0.5])
def test_one_refused_register_costs_its_neighbours_a_few_requests_and_no_more(every: float | None) -> None:
    drive = family(WIDE)(1, name="pump-1")
    sim = Picky(drive, refused={7})
    with clocked_line_of(drive, sim, every) as clocked:
        clocked.run(15)
        sim.asked.clear()
        rows = clocked.run(10)
        told = clocked.poller.summary()["lines"]["line"]["set_aside"]
    assert values(rows) == right(set(range(WIDE)) - {7})
    assert told == ["pump-1.r7"]
    asked = {span for span in sim.asked if span != (7, 1)}
    assert len(asked) <= 5  # log2 of 24, and 24 requests if each were asked singly
    assert all(row.value is not None for row in rows if row.register != "r7")


def test_a_device_that_takes_fewer_is_read_in_blocks_that_it_takes() -> None:
    drive = family(WIDE)(1, name="pump-1")
    sim = Picky(drive, most=8)
    with clocked_line_of(drive, sim) as clocked:
        clocked.run(10)
        sim.asked.clear()
        rows = clocked.run(5)
        assert clocked.poller.summary()["lines"]["line"]["set_aside"] == []
    assert values(rows) == right(range(WIDE))
    assert {row.status for row in rows} == {"ok"}
    assert {count for _, count in sim.asked} == {6}


def test_what_was_refused_for_a_while_is_read_as_a_whole_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(refusals, "SET_ASIDE_NS", 2_000_000_000)
    drive = family(WIDE)(1, name="pump-1")
    sim = Picky(drive)
    with clocked_line_of(drive, sim) as clocked:
        clocked.run(3)
        sim.missing = set(range(WIDE))
        clocked.run(10)
        assert len(clocked.poller.summary()["lines"]["line"]["set_aside"]) == WIDE
        sim.missing = set()
        clocked.run(10)
        sim.asked.clear()
        rows = clocked.run(3)
        assert clocked.poller.summary()["lines"]["line"]["set_aside"] == []
    assert values(rows) == right(range(WIDE))
    assert set(sim.asked) == {(0, WIDE)}


def test_trials_of_the_whole_make_no_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(refusals, "SET_ASIDE_NS", 1_000_000_000)
    drive = family(WIDE)(1, name="pump-1")
    sim = Picky(drive, most=12)
    with clocked_line_of(drive, sim) as clocked:
        clocked.run(5)
        sim.asked.clear()
        rows = clocked.run(10)
    assert 5 <= Counter(sim.asked)[0, WIDE] <= 12
    assert {row.status for row in rows} == {"ok"}


# ---- silent to long requests ----


@pytest.mark.long
@pytest.mark.parametrize("every", [None, 0.5])
@pytest.mark.parametrize("longest", usually(10, 1))
def test_a_device_that_is_silent_to_long_requests_is_read_in_shorter_ones(
    longest: int, every: float | None
) -> None:
    drive = family(WIDE)(1, name="pump-1")
    sim = Picky(drive, silent_beyond=longest)
    with clocked_line_of(drive, sim, every) as clocked:
        clocked.run(120)
        sim.asked.clear()
        rows = clocked.run(10)
    assert values(rows) == right(range(WIDE))
    assert {row.status for row in rows} == {"ok"}
    assert {count for _, count in sim.asked} == ({1} if longest == 1 else {6})


@pytest.mark.long
def test_a_dead_drive_is_never_split_and_is_read_as_a_whole_when_it_comes() -> None:
    drive = family(WIDE)(1, name="pump-1")
    sim = Picky(drive)
    sim.deaf_until = float("inf")
    with clocked_line_of(drive, sim) as clocked:
        clocked.run(120)
        sim.deaf_until = 0.0
        clocked.run(10)
        sim.asked.clear()
        rows = clocked.run(5)
    assert set(sim.asked) == {(0, WIDE)}
    assert values(rows) == right(range(WIDE))


def test_a_drive_that_falls_silent_is_not_split() -> None:
    drive = family(WIDE)(1, name="pump-1")
    sim = Picky(drive)
    with clocked_line_of(drive, sim) as clocked:
        clocked.run(3)
        sim.deaf_until = float("inf")
        clocked.run(60)
        sim.deaf_until = 0.0
        clocked.run(10)
        sim.asked.clear()
        clocked.run(5)
    assert set(sim.asked) == {(0, WIDE)}


@pytest.mark.long
def test_a_noisy_line_splits_nothing_that_was_answered_once() -> None:
    drive = family(WIDE)(1, name="pump-1")
    sim = Picky(drive)
    with ClockedLines(ClockedWire([sim], Faults()), [polled(drive, drive.registers.values())]) as clocked:
        clocked.run(3)
        sim.silent_beyond = 1
        clocked.run(60)
        counts = {count for _, count in sim.asked}
        assert counts <= {WIDE, 1}  # one: a proof that no late reply is taken for another
        (line,) = clocked.poller._lines
        assert len(line._maker._made) == 1


@pytest.mark.long
@settings(max_examples=examples(4), deadline=None)
@example({2, 4}, 5, 1)
@given(st.sets(st.integers(1, 5), max_size=3), st.integers(1, 6), st.integers(1, 6))
def test_no_register_is_lost_that_can_be_read_by_itself(refused: set[int], most: int, silent: int) -> None:
    """But for a device that refuses the first one and is silent to all that is longer: nothing proves then
    that no late answer is due. Otherwise each silence holds the next question up for two minutes."""
    drive = family(6)(1, name="pump-1")
    sim = Picky(drive, refused, most, silent)
    with clocked_line_of(drive, sim, every=5.0) as clocked:
        clocked.run(900)
        sim.asked.clear()
        rows = clocked.run(20)
        (line,) = clocked.poller._lines
        assert len(line._maker._made) <= 2 * 6
    assert values(rows) == right(set(range(6)) - refused)


# ---- by hand ----


def test_by_hand_a_refusal_splits_and_is_remembered(monkeypatch: pytest.MonkeyPatch) -> None:
    drive = family(WIDE)(1, name="pump-1")
    sim = Picky(drive, most=8)
    bus = SimulatedBus(monkeypatch, sim)
    bus.attach(drive)
    first = bus.bus.read_many(drive, drive.registers.values())
    assert first == right(range(WIDE))
    assert [count for _, count in sim.asked] == [24, 12, 6, 6, 12, 6, 6]
    sim.asked.clear()
    assert bus.bus.read_many(drive, drive.registers.values()) == first
    assert [count for _, count in sim.asked] == [6] * 4
    bus.queue = object()  # the port was opened again
    sim.asked.clear()
    assert bus.bus.read_many(drive, drive.registers.values()) == first
    assert sim.asked[0] == (0, WIDE)


def test_by_hand_a_refused_register_is_refused_by_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    drive = family(WIDE)(1, name="pump-1")
    sim = Picky(drive, refused={3})
    bus = SimulatedBus(monkeypatch, sim)
    bus.attach(drive)
    with pytest.raises(DriveRefused, match=r"^pump-1 refuses r3: ") as caught:
        bus.bus.read_many(drive, drive.registers.values())
    assert caught.value.register == "r3"
    assert sim.asked[-1] == (3, 1)
    assert len(sim.asked) <= 11
    others = [register for register in drive.registers.values() if register.address != 3]
    assert bus.bus.read_many(drive, others) == right(set(range(WIDE)) - {3})


@given(st.sets(st.integers(0, 5), max_size=2), st.integers(1, 6), st.sets(st.integers(0, 5), min_size=1))
def test_by_hand_all_comes_or_what_is_refused_is_named(refused: set[int], most: int, asked: set[int]) -> None:
    drive = family(6)(1, name="pump-1")
    with pytest.MonkeyPatch.context() as monkeypatch:
        bus = SimulatedBus(monkeypatch, Picky(drive, refused, most)).bus
        bus.attach(drive)
        registers = [drive.register(f"r{at}") for at in sorted(asked)]
        for _ in range(2):  # then the parts are known
            if not refused & asked:
                assert bus.read_many(drive, registers) == right(asked)
                continue
            with pytest.raises(DriveRefused) as caught:
                bus.read_many(drive, registers)
            assert caught.value.register in {f"r{at}" for at in refused & asked}


@pytest.mark.parametrize("code", [1, 5, 6])
def test_by_hand_busy_splits_nothing(code: int, monkeypatch: pytest.MonkeyPatch) -> None:
    drive = family(WIDE)(1, name="pump-1")
    bus = SimulatedBus(monkeypatch, sim := Picky(drive))
    bus.attach(drive)
    sim.limit = 0
    monkeypatch.setattr(sim, "_code", lambda reason: code)
    with pytest.raises(DriveRefused):
        bus.bus.read_many(drive, drive.registers.values())
    assert sim.asked == [(0, WIDE)]


def test_by_hand_silence_to_a_long_request_splits_where_a_short_one_is_answered(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drive = family(WIDE)(1, name="pump-1")
    bus = SimulatedBus(monkeypatch, sim := Picky(drive, silent_beyond=8))
    bus.attach(drive)
    assert bus.bus.read_many(drive, drive.registers.values()) == right(range(WIDE))
    sim.asked.clear()
    assert bus.bus.read_many(drive, drive.registers.values()) == right(range(WIDE))
    assert [count for _, count in sim.asked] == [6] * 4


def test_by_hand_a_dead_drive_costs_one_request_more(monkeypatch: pytest.MonkeyPatch) -> None:
    drive = family(WIDE)(1, name="pump-1")
    bus = SimulatedBus(monkeypatch, sim := Picky(drive, silent_beyond=0))
    bus.attach(drive)
    with pytest.raises(NoReply):
        bus.bus.read_many(drive, drive.registers.values())
    assert sim.asked == [(0, WIDE)] * 3 + [(0, 1)]
    sim.silent_beyond = 125
    assert bus.bus.read_many(drive, drive.registers.values()) == right(range(WIDE))
    sim.asked.clear()
    sim.silent_beyond = 1  # noise, say: it has answered the whole
    with pytest.raises(NoReply):
        bus.bus.read_many(drive, drive.registers.values())
    assert sim.asked == [(0, WIDE)] * 3
