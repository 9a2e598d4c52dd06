"""All families on one line, with different baud rates and formats: no value is taken for another drive's."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Mapping
from typing import Any

import pytest
from clocked_lines import ClockedLines, ClockedWire
from lines import LateWire, line, plant, polled, proofs, rows_of, served
from toy import Toy
from variants import LATEST, REASONS, fast_drives, real_drives, real_wires

from multidrop.drive.register import HOLDING, Register
from multidrop.plant.model import PolledDrive
from multidrop.poller import Poller
from multidrop.polling.batch import Row
from multidrop.sim import EncodedDrive, Faults, SimulatedDrive, Wire

REAL_SECONDS = 4.0
EVERY = 1.0  # s, the period of the rated registers

FAST_SECONDS = 2.0


class UnreliableWire(LateWire):
    """A wire on which some replies are lost, late or doubled."""

    def __init__(self, drives: list[EncodedDrive]) -> None:
        super().__init__(drives, unpaced=True)
        self._random = random.Random(8)

    def distort(self, reply: bytes) -> bytes:
        times = self._random.choices([1, 2, 0], [85, 10, 5])[0]
        if times and self._random.random() < 0.1:
            return self.hold_up(times * reply, self._random.uniform(0, LATEST))
        return times * reply


def fast_wires() -> list[Wire]:
    return [UnreliableWire([EncodedDrive(drive) for drive in fast_drives()])]


def poll(path: str, drives: list[PolledDrive], seconds: float) -> tuple[list[Row], dict[str, Any]]:
    """Poll for `seconds` s; return all rows and the line's summary."""
    with Poller(plant(line(path, *drives))) as poller:
        rows = [row for batch in poller.batches(seconds) for row in batch]
    return rows + rows_of(poller), poller.summary()["lines"]["line"]


def check(rows: list[Row], drives: list[PolledDrive], summary: dict[str, Any]) -> None:
    """Check that no value is misattributed, every miss has a valid reason, and the summary is complete."""
    truth = proofs(*drives)
    assert len(set(truth.values())) > len(drives)
    samples = [row for row in rows if row.value is not None]
    assert [row for row in samples if row.value != truth[row.drive, row.register]] == []
    misses = Counter(row.status for row in rows if row.value is None)
    assert misses.keys() <= REASONS
    assert {row.status for row in samples} == {"ok"}
    assert (len(samples), misses) == (summary["samples"], summary["misses"])


def test_all_polled_registers_hold_different_values() -> None:
    """The raw counts of any two drives differ, so that other tests can detect a misattributed value."""
    for drives in (real_drives(), fast_drives()):
        asked = [polled(drive, drive.readings()) for drive in drives]
        truth = proofs(*asked)
        steps = {
            (each.drive.name, poll.register.name): poll.register.scale
            for each in asked
            for poll in each.polls
        }
        raws = Counter(round(value / steps[key]) for key, value in truth.items())
        assert max(raws.values()) == 1


@pytest.mark.long
@pytest.mark.slow
def test_all_variants_on_one_line_are_polled_at_real_baud_rates() -> None:
    drives = []
    for drive in real_drives():
        at_a_rate, *others = drive.readings()
        polls = polled(drive, others[:5]).polls + polled(drive, [at_a_rate], EVERY).polls
        drives.append(PolledDrive(drive, polls))
    with served(real_wires) as (path,):
        rows, summary = poll(path, drives, REAL_SECONDS)
    check(rows, drives, summary)
    assert {row.drive for row in rows if row.value is not None} == {each.drive.name for each in drives}
    # Each slot of a rated register has a row or is counted as skipped, except the last slots.
    on_a_grid = {(each.drive.name, each.polls[-1].register.name) for each in drives}
    kept = sum(1 for row in rows if (row.drive, row.register) in on_a_grid)
    assert kept + summary["overrun_slots"] >= len(drives) * (REAL_SECONDS // EVERY - 2)


@pytest.mark.long
@pytest.mark.slow
def test_late_lost_and_doubled_replies_are_never_misattributed() -> None:
    drives = [polled(drive, drive.readings()) for drive in fast_drives()]
    with served(fast_wires) as (path,):
        rows, summary = poll(path, drives, FAST_SECONDS)
    check(rows, drives, summary)
    assert summary["samples"] > 0
    assert summary["misses"]["no reply"] > 0
    assert summary["stray_bytes"] > 0


# ---- useless proofs ----


POLLED = bytes((1, 3, 0, 1, 0, 1))  # output_frequency


class LossyWire(ClockedWire):
    """A wire that loses the next `loses` polled requests."""

    loses = 0

    def receive(self, request: bytes, now: float, baudrate: int) -> None:
        if self.loses and request.startswith(POLLED):
            self.loses -= 1
        else:
            super().receive(request, now, baudrate)


class SilentWire(LossyWire):
    """A wire whose device only answers polled reads; other requests are counted as `unanswered`."""

    unanswered = 0

    def receive(self, request: bytes, now: float, baudrate: int) -> None:
        if request.startswith(POLLED):
            super().receive(request, now, baudrate)
        else:
            self.unanswered += 1


class MisprintedToy(Toy):
    """A drive whose `known_counts` are wrong for two registers."""

    most_registers = {HOLDING: 1}

    def known_counts(self) -> Mapping[Register[Any], tuple[int, int]]:
        return {Toy.mystery: (1, 1), Toy.acceleration_time: (2, 9)}


@pytest.mark.slow
@pytest.mark.parametrize("lost", [1, 5])
def test_a_lost_request_does_not_slow_a_drive_permanently(lost: int) -> None:
    pump = Toy(1, name="pump")
    wire = SilentWire([EncodedDrive(pump)], Faults())
    with ClockedLines(wire, [polled(pump, [Toy.output_frequency], 0.1)]) as lines:
        lines.run(4)
        wire.loses = lost
        lines.run(10)
        assert wire.unanswered > 0
        wire.unanswered = 0
        rows = lines.run(4)
    assert [row.status for row in rows] == ["ok"] * 40
    assert wire.unanswered == 0


def test_wrong_known_counts_do_not_end_polling_after_a_lost_request() -> None:
    pump = MisprintedToy(1, name="pump")
    sim = SimulatedDrive(pump)
    sim["mystery"], sim["acceleration_time"] = 1234, 123.4
    wire = LossyWire([sim], Faults())
    with ClockedLines(wire, [polled(pump, [Toy.output_frequency], 0.1)]) as lines:
        lines.run(4)
        wire.loses = 1
        lines.run(10)
        rows = lines.run(4)
    assert [row.status for row in rows] == ["ok"] * 40
