"""Every fault on a line of every family: no value is misattributed, every missing value has a reason, and
polling recovers.

The tests run on a simulated clock, so that a seed reproduces its run. To run for hours, with new seeds:
`HOSTILE_HOURS=2 pytest -m '' tests/polling/test_hostile_line.py -k hours`.
"""

from __future__ import annotations

import gc
import os
import random
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from math import inf
from pathlib import Path
from typing import Any

import pytest
from clocked_lines import ClockedLines, ClockedWire
from commands import descriptors, threads
from lines import LateWire, line, plant, polled, proofs, rows_of, served
from motors import (
    LATEST,
    LINES,
    REASONS,
    fast_drives,
    of_all_variants,
    of_one_variant,
    real_drives,
    real_wires,
)
from stories import HEALTHY, Story
from tables import table, usually
from toy import Toy

from multidrop.drive import Drive
from multidrop.drive.register import HOLDING, Register
from multidrop.families import DelixiNative
from multidrop.plant.model import PolledDrive
from multidrop.poller import Poller
from multidrop.polling.batch import Row
from multidrop.sim import EncodedDrive, Faults, SimulatedDrive, Wire, simulated

MOST_GROWTH_KB = 2048

KINDS = {
    "drop": Faults(drop=0.2),
    "flip": Faults(flip=0.2),
    "repeat": Faults(repeat=0.2),
    "delay": Faults(delay=0.2),
    "merge": Faults(merge=0.2),
    "split": Faults(split=0.5),
    "twice": Faults(twice=0.2),
    "noise": Faults(noise=0.3),
    "start noise": Faults(start_noise=1),
    "echo": Faults(echo=1),
    "echo now and then": Faults(echo=0.2),
    "hang up": Faults(hang_up=0.1, rename=0.5),
    "dead": Faults(drop=1),
    "all": Faults(
        drop=0.03, flip=0.03, repeat=0.03, delay=0.03, merge=0.03, split=0.1, noise=0.05, hang_up=0.01
    ),
}


def resident_kb() -> int:
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGESIZE") // 1024


# The short run tests an eighth of all pairs of a line and a fault.
EACH_ON_EACH = [
    pytest.param(name, kind, marks=pytest.mark.long if (number + nth) % 8 else ())
    for number, name in enumerate(LINES)
    for nth, kind in enumerate(KINDS)
]


@pytest.mark.story
@pytest.mark.long
@pytest.mark.parametrize(("name", "kind"), EACH_ON_EACH)
def test_polling_recovers_from_each_fault_without_misattributed_values(name: str, kind: str) -> None:
    number = LINES[name]
    before = descriptors(), threads()
    story = Story(of_one_variant(number))
    story.run_with_fault(KINDS[kind])
    assert (descriptors(), threads()) == before
    assert story.wire.struck.total()


@pytest.mark.story
@pytest.mark.long
@table("name", LINES)
def test_every_value_is_read_despite_a_permanent_echo(name: str) -> None:
    story = Story(of_one_variant(LINES[name]))
    story.wire.faults = KINDS["echo"]
    with story.clocked:
        begun = len(story.run(2))  # in the first 2 s, some values are read twice
        story.run(HEALTHY)
    story.rows += rows_of(story.clocked.poller)
    story.judge()
    assert {row.status for row in story.rows[begun:]} <= {"ok", "poll ended"}


@pytest.mark.story
@pytest.mark.slow
@table("echo", [0, 1], ids=["no echo", "an echo"])
@table("register", ["dc_bus_voltage", "output_frequency"], ids=["a value", "a zero"])
def test_a_delixi_reply_equal_to_its_request_is_not_taken_for_an_echo(register: str, echo: int) -> None:
    """In Delixi's protocol, a reply with the value 0 equals its request. It must not be taken for an echo."""
    drive = DelixiNative(1, name="drive-1")
    asked = polled(drive, [drive.register(register)])
    with ClockedLines(ClockedWire([simulated(drive)], Faults(echo=echo)), [asked]) as clocked:
        rows = clocked.run(HEALTHY)
    assert len(rows) > 10
    assert {(row.value == 0, row.status) for row in rows} == {(register == "output_frequency", "ok")}


@pytest.mark.story
def test_echoes_of_a_silent_delixi_drive_are_read_as_0_at_most_twice() -> None:
    """A broken wire may silence a drive and echo requests. The third read shows it: its reply must differ."""
    drive = DelixiNative(1, name="drive-1")
    asked = polled(drive, [DelixiNative.output_frequency, DelixiNative.output_current])
    wire = ClockedWire([simulated(drive)], Faults())
    with ClockedLines(wire, [asked]) as clocked:
        rows = clocked.run(HEALTHY)
        assert {(row.value, row.status) for row in rows} == {(0, "ok")}
        wire.faults = Faults(echo=1)
        wire.drives[0].deaf_until = inf
        deaf_ns = clocked.now  # the drive's last reply may still be in flight
        rows = clocked.run(HEALTHY)
    assert len(rows) > 4
    assert sum(row.status == "ok" and row.monotonic_ns >= deaf_ns for row in rows) <= 2
    assert rows[-1].status != "ok"


@pytest.mark.story
@pytest.mark.slow
@pytest.mark.parametrize("kind", usually(*KINDS))
def test_a_line_polled_without_rates_recovers_from_a_fault(kind: str) -> None:
    """Without rates, the core repeats the bus cycle without the poller until a fault occurs."""
    story = Story(of_one_variant(LINES["innovert-ibd rtu"]), every=None)
    story.run_with_fault(KINDS[kind])
    assert story.wire.struck.total()


def all_lines() -> Iterator[list[Drive]]:
    """Yield the drives of one line for each family variant, then of one line with all variants."""
    yield from map(of_one_variant, LINES.values())
    yield of_all_variants()


@pytest.mark.story
@pytest.mark.long
def test_resources_do_not_grow_over_hours_of_faults() -> None:
    """Memory, descriptors and threads stay constant on a line with all families.

    With HOSTILE_HOURS, each family variant is also polled alone, with each kind of fault in turn.
    """
    hours = float(os.environ.get("HOSTILE_HOURS", "0"))
    end = time.monotonic() + 3600 * hours
    seen: list[tuple[int, int, int]] = []
    while len(seen) < 3 or time.monotonic() < end:
        if hours:
            for kind in KINDS:
                for drives in all_lines():
                    Story(drives, seed=len(seen)).run_with_fault(KINDS[kind])
        else:
            Story(of_all_variants(), seed=len(seen)).run_with_fault(KINDS["all"])
        seen.append((resident_kb(), descriptors(), threads()))
        print(f"pass {len(seen)}: %d kB, %d descriptors, %d threads" % seen[-1], flush=True)
    assert seen[-1][0] - seen[0][0] <= MOST_GROWTH_KB
    assert seen[-1][1:] == seen[0][1:]


REAL_SECONDS = 4.0
EVERY = 1.0  # period in s of the registers that have a rate

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
    """Check that no value is misattributed, missing values have reasons, and the summary is complete."""
    truth = proofs(*drives)
    assert len(set(truth.values())) > len(drives)
    samples = [row for row in rows if row.value is not None]
    assert [row for row in samples if row.value != truth[row.drive, row.register]] == []
    misses = Counter(row.status for row in rows if row.value is None)
    assert misses.keys() <= REASONS
    assert {row.status for row in samples} == {"ok"}
    assert (len(samples), misses) == (summary["samples"], summary["misses"])


def test_the_polled_registers_of_any_two_drives_hold_different_values() -> None:
    """The other tests need this to detect a value of another drive."""
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
def test_all_family_variants_on_one_line_are_polled_at_real_baud_rates() -> None:
    drives = []
    for drive in real_drives():
        at_a_rate, *others = drive.readings()
        polls = polled(drive, others[:5]).polls + polled(drive, [at_a_rate], EVERY).polls
        drives.append(PolledDrive(drive, polls))
    with served(real_wires) as (path,):
        rows, summary = poll(path, drives, REAL_SECONDS)
    check(rows, drives, summary)
    assert {row.drive for row in rows if row.value is not None} == {each.drive.name for each in drives}
    # Each due poll of a register with a rate has a row or is counted as skipped, except the last ones.
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
    """A wire whose device answers only polled reads. `unanswered` counts the other requests."""

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


def test_polling_continues_if_a_class_declares_wrong_raw_counts() -> None:
    """After a lost request, no reply has a raw count that the class declares."""
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
