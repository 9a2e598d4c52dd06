"""Rates that change while a plant is polled, on a clock that the test sets."""

from __future__ import annotations

import gc
import random
from collections import Counter
from collections.abc import Iterator
from itertools import pairwise

import pytest
from clocked_lines import ClockedLines, ClockedWire, S
from lines import plant, polled, rows_of
from toy import Picky, Toy

from multidrop.plant.model import PolledDrive
from multidrop.poller import Poller
from multidrop.polling.batch import Row
from multidrop.polling.polled_line import PolledLine
from multidrop.sim import EncodedDrive, Faults, SimulatedDrive, proof

CURRENT, FREQUENCY, FAULT, STATUS = (
    Toy.registers[name] for name in ("output_current", "output_frequency", "fault", "status")
)
ALL = (CURRENT, FREQUENCY, FAULT, STATUS)


def toy(address: int = 1) -> Toy:
    return Toy(address, name=f"pump-{address}")


def clocked(*drives: PolledDrive) -> ClockedLines:
    return ClockedLines(ClockedWire([EncodedDrive(each.drive) for each in drives], Faults()), list(drives))


@pytest.fixture
def two() -> Iterator[ClockedLines]:
    """Yield a polled plant of two drives; four registers of each are polled every 100 ms."""
    with clocked(*(polled(toy(address), ALL, 0.1) for address in (1, 2))) as made:
        made.run(2)
        yield made


def values(rows: list[Row]) -> Counter[tuple[str, str]]:
    return Counter((row.drive, row.register) for row in rows if row.value is not None)


def only_line(made: ClockedLines) -> PolledLine:
    (line,) = made.poller._lines
    return line


def test_set_rate_of_one_register_changes_no_other_rate(two: ClockedLines) -> None:
    two.poller.set_rate("pump-1", "output_current", 1.0)
    two.run(1)  # until all queued requests have been sent
    counts = values(two.run(10))
    assert counts.pop(("pump-1", "output_current")) in (10, 11)
    assert len(counts) == 7
    assert all(count in (99, 100, 101) for count in counts.values())


def test_set_rate_of_a_drive_changes_all_its_registers(two: ClockedLines) -> None:
    pump = two.poller.bus("line").drives[0]
    two.poller.set_rate(pump, None, 0.5)
    two.run(1)
    counts = values(two.run(10))
    assert {counts[pump.name, register.name] for register in ALL} <= {20, 21}
    assert {counts["pump-2", register.name] for register in ALL} <= {99, 100, 101}


def test_a_rate_can_be_removed_and_set_again(two: ClockedLines) -> None:
    for drive in ("pump-1", "pump-2"):
        two.poller.set_rate(drive, None, None)
    two.run(1)
    assert min(values(two.run(5)).values()) > 60
    assert only_line(two)._queue.is_repeating
    for drive in ("pump-1", "pump-2"):
        two.poller.set_rate(drive, None, 1.0)
    two.run(1)
    assert set(values(two.run(10)).values()) <= {10, 11}


@pytest.mark.slow
def test_the_first_value_at_a_new_rate_is_read_immediately(two: ClockedLines) -> None:
    two.poller.set_rate("pump-1", "fault", 3600.0)
    two.run(1)
    assert values(two.run(10))["pump-1", "fault"] == 0
    two.poller.set_rate("pump-1", "fault", 60.0)
    assert values(two.run(1))["pump-1", "fault"] == 1


def test_registers_with_an_unchanged_rate_keep_their_time_slots() -> None:
    """They keep them although the register with the new rate is no longer read in the same block."""
    with clocked(polled(toy(), ALL, 0.1)) as made:
        begun = made.run(3)[0].monotonic_ns
        made.poller.set_rate("pump-1", "output_frequency", 0.25)
        rows = [row for row in made.run(3) if row.register == "status" and row.value is not None]
    grid = [round((row.monotonic_ns - begun) / S, 4) % 0.1 for row in rows]
    assert max(min(late, 0.1 - late) for late in grid) < 0.02
    gaps = [later.monotonic_ns - row.monotonic_ns for row, later in pairwise(rows)]
    assert max(gaps) < 0.12 * S  # no slot is skipped
    assert len(rows) in (29, 30, 31)


@pytest.mark.long
def test_changes_of_rates_attribute_no_value_to_another_register() -> None:
    """Every value is of the right register, and each register has rows after each change."""
    chance = random.Random(7)
    drives = [polled(toy(address), ALL, 0.05) for address in (1, 2)]
    with clocked(*drives) as made:
        rows = made.run(1)
        for _ in range(150):
            pump = chance.choice(drives).drive
            register = chance.choice([*ALL, None])
            made.poller.set_rate(pump, register, chance.choice([None, 0.02, 0.05, 0.11, 0.3]))
            new = made.run(chance.choice([0.0, 0.01, 0.5]))
            rows += new
        for each in drives:
            made.poller.set_rate(each.drive, None, 0.1)
        made.run(1)
        last = made.run(1)
    for row in rows:
        assert row.status in ("ok", "not sent: expired")  # the rates may exceed the line's capacity
        if row.value is not None:
            pump = next(each.drive for each in drives if each.drive.name == row.drive)
            assert row.value == proof(pump, pump.register(row.register))
    assert set(values(last).values()) <= {9, 10, 11}
    assert len(values(last)) == 8
    summary = made.poller.summary()["lines"]
    (told,) = summary.values()
    total = len(rows) + len(rows_of(made.poller))
    assert told["samples"] >= total


@pytest.mark.slow
def test_memory_is_bounded_over_many_changes_of_rates() -> None:
    with clocked(polled(toy(), ALL, 0.1)) as made:
        line = only_line(made)

        def kept() -> tuple[int, ...]:
            gc.collect()
            return len(line._maker._made), len(line._planned), len(line._schedule.jobs)

        for number in range(20):
            made.poller.set_rate("pump-1", "fault", 0.1 + number / 1000)
            made.run(0.05)
        before = kept()
        for number in range(100):
            made.poller.set_rate("pump-1", "fault", 0.2 + number / 1000)
            made.poller.set_rate("pump-1", "status", None if number % 2 else 0.3)
            made.run(0.01)
        after = kept()
    assert all(now <= then + 4 for now, then in zip(after, before, strict=True)), (before, after)


def test_skipped_time_slots_stay_counted_after_a_change_of_the_rate() -> None:
    with clocked(polled(toy(), ALL, 0.001)) as made:
        made.run(2)
        (before,) = (line["overrun_slots"] for line in made.poller.summary()["lines"].values())
        made.poller.set_rate("pump-1", None, 1.0)
        made.run(2)
        (after,) = (line["overrun_slots"] for line in made.poller.summary()["lines"].values())
    assert after >= before > 0


def test_a_register_that_the_drive_refuses_is_still_skipped_at_a_new_rate() -> None:
    pump = toy()
    with ClockedLines(
        ClockedWire([Picky(pump, {FAULT.address})], Faults()), [polled(pump, ALL, 0.1)]
    ) as made:
        made.run(3)
        assert only_line(made).summary()["set_aside"] == ["pump-1.fault"]
        made.poller.set_rate(pump, None, 0.2)
        rows = made.run(3)
        missed = {row.register for row in rows if row.value is None}
        assert missed <= {"fault", "status"}  # the refusal is still known at the new rate
        assert only_line(made).summary()["set_aside"] == ["pump-1.fault"]
        counts = Counter(row.register for row in made.run(10) if row.value is not None)
    assert {counts[register.name] for register in (CURRENT, FREQUENCY, STATUS)} <= {49, 50, 51}


@pytest.mark.slow
def test_the_rate_of_a_silent_drive_can_be_changed() -> None:
    pump, silent = toy(1), SimulatedDrive(toy(2))
    silent.deaf_until = float("inf")
    drives = [polled(pump, ALL, 0.1), polled(silent.drive, ALL, 0.1)]
    with ClockedLines(ClockedWire([EncodedDrive(pump), silent], Faults()), drives) as made:
        made.run(5)
        made.poller.set_rate("pump-2", None, 0.2)
        rows = made.run(5)
        assert {row.status for row in rows if row.drive == "pump-2"} <= {
            "no reply",
            "not asked: drive is silent",
            "not asked: late reply due",
        }
        silent.deaf_until = 0.0
        made.run(5)
        assert {values(made.run(10))["pump-2", register.name] for register in ALL} <= {49, 50, 51}


def test_rates_can_be_set_before_polling_starts() -> None:
    pump = toy()
    made = clocked(polled(pump, ALL, 0.1))
    made.poller.set_rate(pump, CURRENT, 1.0)
    with made:
        counts = values(made.run(10))
    assert counts["pump-1", "output_current"] in (10, 11)
    assert counts["pump-1", "status"] in (99, 100, 101)


def test_a_drive_that_is_added_again_has_its_declared_rates() -> None:
    pump = polled(toy(), ALL, 0.1)
    with clocked(pump) as made:
        made.poller.set_rate("pump-1", None, 1.0)
        made.poller.remove("line", "pump-1")
        made.poller.add("line", pump)
        made.run(1)
        assert set(values(made.run(10)).values()) <= {99, 100, 101}


@pytest.mark.slow
def test_an_invalid_rate_changes_nothing(two: ClockedLines) -> None:
    for drive, register, every, sentence in (
        ("pump-3", None, 1.0, r"pump-3 is not polled here; did you mean pump-\d"),
        ("zzz", None, 1.0, "zzz is not polled here; there are pump-1, pump-2"),
        ("pump-1", "output_curent", 1.0, "has no register 'output_curent'; did you mean output_current"),
        (
            "pump-1",
            "mystery",
            1.0,
            "mystery of pump-1 is not polled; polled are: output_current, output_freq",
        ),
        ("pump-1", None, 0, "every = 0 is not a number of seconds from 0.0001 to 86400, or None"),
        ("pump-1", None, -1.0, "every = -1.0 is not"),
        ("pump-1", None, float("nan"), "every = nan is not"),
        ("pump-1", None, float("inf"), "every = inf is not"),
        ("pump-1", None, True, "every = True is not"),
        ("pump-1", None, "1 s", "every = '1 s' is not"),
        ("pump-1", None, 86401, "every = 86401 is not"),
    ):
        with pytest.raises(ValueError, match=sentence):
            two.poller.set_rate(drive, register, every)
    assert set(values(two.run(10)).values()) <= {99, 100, 101}


def test_set_rate_of_another_drive_object_with_the_same_name_raises(two: ClockedLines) -> None:
    with pytest.raises(ValueError, match="pump-1 is not polled here"):
        two.poller.set_rate(toy(1), None, 1.0)


def test_set_rate_raises_after_polling_has_ended() -> None:
    poller = Poller(plant())
    poller.close()
    with pytest.raises(ValueError, match="polling has ended"):
        poller.set_rate("pump-1", None, 1.0)
