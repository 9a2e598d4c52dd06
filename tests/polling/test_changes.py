"""Drives and rates that change while a plant is polled."""

from __future__ import annotations

import gc
import random
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest
from clocked_lines import ClockedLines, ClockedWire, S
from lines import line, plant, polled, rows_of, until
from toy import Picky, Toy

from multidrop.bus import Bus
from multidrop.families import YD1000, InvtCHE
from multidrop.plant.loader import load_plant
from multidrop.plant.model import PolledDrive
from multidrop.poller import Poller
from multidrop.polling.batch import Row
from multidrop.polling.jobs import AHEAD_NS
from multidrop.polling.polled_line import PolledLine
from multidrop.sim import EncodedDrive, Faults, SimulatedDrive, Simulator, Wire, proof, simulated

# ---- drives that are added and removed ----


ROOT = Path(__file__).parents[2]
CURRENT = Toy.registers["output_current"]
EVERY_S = 0.02
QUEUED = round(AHEAD_NS / 1e9 / EVERY_S) + 2  # highest number of queued requests of one drive


def pump(address: int, name: str = "", every: float | None = None) -> PolledDrive:
    return polled(Toy(address, name=name or f"pump-{address}"), [CURRENT], every)


@pytest.fixture
def port() -> Iterator[str]:
    """Return the port of a line on which the addresses 1 and 2 answer."""
    with Simulator([Wire([EncodedDrive(Toy(1)), EncodedDrive(Toy(2))], unpaced=True)]) as sim:
        yield sim.wires[0].path


class Seen:
    """Collects a poller's rows, by drive."""

    def __init__(self, poller: Poller) -> None:
        self._poller = poller
        self.values: dict[str, list[float]] = {}
        self.last_asked_ns: dict[str, int] = {}
        self.statuses: set[str] = set()

    def of(self, name: str) -> list[float]:
        for row in rows_of(self._poller):
            self.statuses.add(row.status)
            if row.value is not None:
                self.values.setdefault(row.drive, []).append(row.value)
                self.last_asked_ns[row.drive] = row.monotonic_ns
        return self.values.get(name, [])


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("every", [None, EVERY_S])
def test_a_drive_is_added_and_removed_while_others_are_polled(port: str, every: float | None) -> None:
    second = pump(2, every=every)
    with Poller(plant(line(port, pump(1, every=every)))) as poller:
        seen = Seen(poller)
        until(lambda: seen.of("pump-1"))
        for _ in range(3):
            before = len(seen.of("pump-2"))
            poller.add("line", second)
            until(lambda before=before: len(seen.of("pump-2")) > before)
            poller.remove("line", "pump-2")
            assert "pump-2" not in poller.summary()["lines"]["line"]["drives"]
            first = len(seen.of("pump-1"))
            until(lambda first=first: len(seen.of("pump-1")) > first + QUEUED)
            settled_ns = time.monotonic_ns()  # all earlier requests have ended
            until(lambda first=first: len(seen.of("pump-1")) > first + 2 * QUEUED)
            assert seen.last_asked_ns["pump-2"] < settled_ns
    assert {*seen.of("pump-1")} == {proof(Toy(1), CURRENT)}
    assert {*seen.of("pump-2")} == {proof(Toy(2), CURRENT)}


def test_a_drive_added_after_all_drives_were_removed_is_polled(port: str) -> None:
    first = pump(1)
    with Poller(plant(line(port, first))) as poller:
        seen = Seen(poller)
        until(lambda: seen.of("pump-1"))
        poller.remove("line", "pump-1")
        before = len(seen.of("pump-1"))
        poller.add("line", first)
        until(lambda: len(seen.of("pump-1")) > before + 20)
        assert poller.summary()["samples"] > before


@pytest.mark.slow
def test_the_removal_of_a_silent_drive_does_not_disturb_other_drives(port: str) -> None:
    with Poller(plant(line(port, pump(1), pump(3, "dead")))) as poller:
        seen = Seen(poller)
        until(lambda: "not asked: drive is silent" in (seen.of("dead") and ()) or len(seen.statuses) > 1)
        poller.remove("line", "dead")
        before = len(seen.of("pump-1"))
        until(lambda: len(seen.of("pump-1")) > before + 50)


def test_invalid_additions_and_removals_of_drives_raise_errors(port: str) -> None:
    with Poller(plant(line(port, pump(1)))) as poller:
        for polled_drive, sentence in (
            (pump(1, "other"), "address 1 is already used by pump-1"),
            (pump(2, "pump-1"), "two drives are called pump-1; give each its own name"),
            (polled(InvtCHE(3), [CURRENT]), "this output_current is not a register of invt-che@3"),
        ):
            with pytest.raises(ValueError, match=sentence):
                poller.add("line", polled_drive)
        with pytest.raises(ValueError, match="there is no line 'hall'; there are line"):
            poller.add("hall", pump(2))
        with pytest.raises(ValueError, match="there is no drive 'pump-2' on line 'line'"):
            poller.remove("line", "pump-2")
        assert list(poller.summary()["lines"]["line"]["drives"]) == ["pump-1"]
    with pytest.raises(ValueError, match="polling has ended"):
        poller.add("line", pump(2))


@pytest.mark.slow
def test_an_unpolled_drive_does_not_disturb_other_drives(port: str) -> None:
    with Poller(plant(line(port, pump(1), polled(Toy(3, name="pump-3"), [])))) as poller:
        seen = Seen(poller)
        until(lambda: len(seen.of("pump-1")) > 50)
        assert seen.of("pump-3") == []


def test_every_call_of_a_detached_drive_raises_and_sends_nothing(port: str) -> None:
    with Bus(port) as bus:
        ours = bus.attach(Toy, address=1, name="pump-1")
        assert ours.read(CURRENT) == proof(Toy(1), CURRENT)
        peer = bus.peer(ours)
        proofs = peer.proofs
        bus.detach(ours)
        assert bus.drives == []
        for do in (lambda: ours.read(CURRENT), ours.stop, lambda: bus.detach(ours)):
            with pytest.raises(ValueError, match="pump-1 is not attached to this bus"):
                do()
        again = bus.attach(Toy, address=1, name="pump-1")
        assert bus.peer(again) is peer  # the core's record, which knows the late replies that may come
        assert peer.proofs is proofs  # the core may still be using them


def test_no_drive_is_detached_during_stop_all(port: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with Bus(port) as bus:
        ours = bus.attach(Toy, address=1, name="pump-1")
        begun, go_on = threading.Event(), threading.Event()
        step = bus._stopper.do

        def slow(*arguments: object) -> object:
            begun.set()
            assert go_on.wait(120)
            return step(*arguments)

        monkeypatch.setattr(bus._stopper, "do", slow)
        stopping = threading.Thread(target=bus.stop_all)
        stopping.start()
        assert begun.wait(120)
        leaving = threading.Thread(target=bus.detach, args=(ours,))
        leaving.start()
        leaving.join(0.05)
        assert leaving.is_alive()
        assert bus.drives == [ours]
        go_on.set()
        stopping.join(120)
        leaving.join(120)
        assert bus.drives == []


@pytest.mark.slow
@pytest.mark.long
def test_many_threads_can_read_poll_and_change_lines_concurrently() -> None:
    """A short run of the benchmark many_at_once, which normally takes ten minutes with 64 lines."""
    program = [
        sys.executable,
        "-m",
        "bench.questions.safety.many_at_once",
        "--lines=6",
        "--drives=5",
        "--minutes=0.08",
        "--rounds=3",
    ]
    done = subprocess.run(program, cwd=ROOT, capture_output=True, text=True, timeout=180)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.endswith("\nnothing misattributed, nothing lost, nothing grows\n")


def test_statistics_can_be_read_while_drives_are_removed(port: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Reading statistics does not fail if another thread removes a drive at the same time."""
    with Bus(port) as bus:
        ours = [bus.attach(Toy, address=address, name=f"pump-{address}") for address in (1, 2)]
        counters = bus.peer(ours[0]).counters

        def leave_and_tell() -> object:
            bus.detach(ours[1])
            return counters()

        monkeypatch.setattr(bus.peer(ours[0]), "counters", leave_and_tell)
        assert list(bus.statistics().drives) == ["pump-1", "pump-2"]
        monkeypatch.undo()
        assert list(bus.statistics().drives) == ["pump-1"]


PLANT = """
[[line]]
name = "a"
port = "{port}"

[[line.drive]]
name = "pump"
model = "yd1000"
address = 1
poll = ["output_frequency"]
"""


@pytest.mark.slow
def test_a_drive_attached_to_the_bus_can_also_be_polled(tmp_path: Path) -> None:
    path = tmp_path / "plant.toml"
    with Simulator([Wire([simulated(YD1000(1)), simulated(YD1000(9))])]) as simulator:
        path.write_text(PLANT.format(port=simulator.wires[0].path))
        poller = Poller(load_plant(path))
        extra = poller.bus("a").attach(YD1000, 9)
        with poller:
            assert extra.read(extra.output_frequency) == 0
            until(lambda: any(row.drive == "pump" for row in poller.take() or ()))
            with pytest.raises(ValueError, match=r"this poller has no drive .*; there are pump"):
                poller.set_rate(extra, None, 1.0)


# ---- rates, on a clock that the test sets ----


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


def test_a_new_rate_of_one_register_changes_no_other_rate(two: ClockedLines) -> None:
    two.poller.set_rate("pump-1", "output_current", 1.0)
    two.run(1)  # until all queued requests have been sent
    counts = values(two.run(10))
    assert counts.pop(("pump-1", "output_current")) in (10, 11)
    assert len(counts) == 7
    assert all(count in (99, 100, 101) for count in counts.values())


def test_a_new_rate_of_a_drive_applies_to_all_its_registers(two: ClockedLines) -> None:
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


def test_registers_with_an_unchanged_rate_are_still_polled_on_time() -> None:
    """The register with the new rate is no longer read by the same request."""
    with clocked(polled(toy(), ALL, 0.1)) as made:
        begun = made.run(3)[0].monotonic_ns
        made.poller.set_rate("pump-1", "output_frequency", 0.25)
        rows = [row for row in made.run(3) if row.register == "status" and row.value is not None]
    grid = [round((row.monotonic_ns - begun) / S, 4) % 0.1 for row in rows]
    assert max(min(late, 0.1 - late) for late in grid) < 0.02
    gaps = [later.monotonic_ns - row.monotonic_ns for row, later in pairwise(rows)]
    assert max(gaps) < 0.12 * S  # no poll is skipped
    assert len(rows) in (29, 30, 31)


@pytest.mark.long
def test_values_stay_with_their_registers_when_rates_change() -> None:
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


def test_skipped_polls_stay_counted_after_a_change_of_the_rate() -> None:
    with clocked(polled(toy(), ALL, 0.001)) as made:
        made.run(2)
        (before,) = (line["overrun_slots"] for line in made.poller.summary()["lines"].values())
        made.poller.set_rate("pump-1", None, 1.0)
        made.run(2)
        (after,) = (line["overrun_slots"] for line in made.poller.summary()["lines"].values())
    assert after >= before > 0


def test_a_refused_register_is_still_skipped_at_a_new_rate() -> None:
    pump = toy()
    with ClockedLines(
        ClockedWire([Picky(pump, {FAULT.address})], Faults()), [polled(pump, ALL, 0.1)]
    ) as made:
        made.run(3)
        assert only_line(made).summary()["set_aside"] == ["pump-1.fault"]
        made.poller.set_rate(pump, None, 0.2)
        rows = made.run(3)
        missed = {row.register for row in rows if row.value is None}
        # at the new rate, the refused register is not tried again together with other registers
        assert missed <= {"fault", "status"}
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


def test_the_rates_can_be_set_before_polling_starts() -> None:
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
        ("pump-3", None, 1.0, r"this poller has no drive pump-3; did you mean pump-\d"),
        ("zzz", None, 1.0, "this poller has no drive zzz; there are pump-1, pump-2"),
        ("pump-1", "output_curent", 1.0, "has no register 'output_curent'; did you mean output_current"),
        (
            "pump-1",
            "mystery",
            1.0,
            "mystery of pump-1 is not polled; its polled registers are: output_current, output_freq",
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


def test_a_rate_for_another_drive_object_of_the_same_name_is_refused(two: ClockedLines) -> None:
    with pytest.raises(ValueError, match="this poller has no drive pump-1"):
        two.poller.set_rate(toy(1), None, 1.0)


def test_a_rate_cannot_be_set_after_polling_has_ended() -> None:
    poller = Poller(plant())
    poller.close()
    with pytest.raises(ValueError, match="polling has ended"):
        poller.set_rate("pump-1", None, 1.0)
