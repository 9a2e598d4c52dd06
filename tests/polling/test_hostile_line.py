"""Every fault on a line of every family: nothing is misattributed, every miss is explained, and it ends.

On a world's clock, so that a seed is a story that can be told again. For hours, with new seeds:
`HOSTILE_HOURS=2 pytest tests/polling/test_hostile_line.py -k hours`.
"""

from __future__ import annotations

import gc
import os
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from lines import polled, proofs, rows_of
from test_mixed_line import REASONS, VARIANTS
from worlds import World, WorldWire

from multidrop import poller
from multidrop.core import Framing, Message, Status
from multidrop.drive import Drive
from multidrop.drives import YD1000, DelixiNative
from multidrop.planning import schedule
from multidrop.plant.model import PolledDrive
from multidrop.polling import polled_line
from multidrop.polling.batch import Row
from multidrop.sim import EncodedDrive, Faults, simulated
from multidrop.sim.faults import RATES

pytestmark = pytest.mark.story

S = 1_000_000_000
REGISTERS = 5  # of each drive
EVERY = 0.5  # s, of the first of them; the others as fast as the line allows
HEALTHY, FAULTY = 4.0, 8.0  # s
CYCLES = 10  # in which the rate must be back, but for what one of them holds
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

# The echo of a Delixi query is what a reply with the value 0 is: an adapter that echoes from the beginning is
# known for it, one that begins later is not at once. The client does not tell these.
NOT_TOLD = {
    "echo": (Framing.DELIXI,),
    "echo now and then": (Framing.DELIXI,),
}

UNASKED = {str(it) for it in (Status.NOT_ASKED, Status.LINE_LOST, Status.LATE_ANSWER_DUE)}
START, STOP = (Message(31, 6, 0x1000, data=bytes([word, 0])) for word in (0xC4, 0xC0))


def of_one_variant(number: int) -> list[Drive]:
    """Two drives of one family and framing."""
    family, framing, _ = VARIANTS[number]
    return [family(address, name=f"drive-{address}", framing=framing) for address in (1, 2)]


def of_all_variants() -> list[Drive]:
    return [
        family(address, name=f"drive-{address}", framing=framing)
        for address, (family, framing, _) in enumerate(VARIANTS, 1)
    ]


LINES = {f"{family.model} {framing}": number for number, (family, framing, _) in enumerate(VARIANTS)}


class Story:
    """A line in health, under a fault, and afterwards; all its rows are kept and judged."""

    wires: type[WorldWire] = WorldWire

    def __init__(self, drives: Sequence[Drive], *, seed: int = 1, every: float | None = EVERY) -> None:
        self.every = every
        self.asked = [_polls(drive, every) for drive in drives]
        self.motor = YD1000(31, name="motor")
        sims = [*(EncodedDrive(drive) for drive in drives), simulated(self.motor)]
        self.wire: Any = self.wires(sims, Faults(seed=seed))
        motor = polled(self.motor, self.motor.readings()[:1], every)
        self.world = World(self.wire, [*self.asked, motor])
        self.truth = proofs(*self.asked)
        self.rows: list[Row] = []
        self.drives = [*drives, self.motor]

    def run(self, seconds: float) -> list[Row]:
        first = len(self.rows)
        self.rows += self.world.run(seconds)
        return self.rows[first:]

    def run_motor(self, seconds: float) -> None:
        """So many seconds, in each of which the motor starts and stops."""
        for _ in range(round(seconds)):
            for command in (START, STOP):
                self.world.command(self.motor, command)
                self.run(0.5)

    def tell(self, faults: Faults) -> None:
        """Health, the fault, and its end, after which the rate must be back."""
        with self.world:
            cycle = _longest_gap([row for row in self.run(HEALTHY) if row.value is not None])
            healthy = [row for row in self.run(CYCLES * cycle) if row.value is not None]
            self.wire.faults = faults
            self.run_motor(FAULTY)
            self.wire.faults = Faults()
            self.run(2 * faults.late)  # what is on its way comes
            begin = self.back_off_is_over() + round(cycle * S)
            end = begin + round(CYCLES * cycle * S)
            self.run((end - self.world.now) / S)
            again = [row for row in self.rows if begin <= row.monotonic_ns < end]
            assert len(again) >= len(healthy) * (CYCLES - 1) / CYCLES
            assert {row.status for row in again} == {"ok"}
        self.rows += rows_of(self.world.poller)
        self.judge()

    def back_off_is_over(self) -> int:
        """Let time pass until every drive was asked again; when that was.

        It takes until the port is opened again, and silent drives have rested for their share of the line.
        """
        cost = sum(drive.response_timeout for drive in self.drives) / 2  # and rarely more
        longest = max(schedule.LONGEST_REST_NS / S, cost / schedule.SILENT_SHARE)
        longest += Faults().away + polled_line.REOPEN_NS / S + poller.LOOK_S
        ended = self.world.now
        asked: dict[str, int] = {}
        while len(asked) < len(self.drives):
            assert self.world.now <= ended + longest * S
            for row in self.run(0.5):
                if row.monotonic_ns >= ended and row.status not in UNASKED:
                    asked.setdefault(row.drive, row.monotonic_ns)
        return max(asked.values())

    def judge_values(self) -> None:
        wrong = [
            (row, self.truth[row.drive, row.register])
            for row in self.rows
            if row.value not in (None, self.truth.get((row.drive, row.register), row.value))
        ]
        assert wrong == []

    def judge(self) -> None:
        self.judge_values()
        misses = Counter(row.status for row in self.rows if row.value is None)
        assert {why for why in misses if not why.startswith("exception ")} <= REASONS
        told = self.world.poller.summary()
        line = told["lines"]["line"]
        assert told["dropped"] == 0
        assert told["samples"] + misses.total() == len(self.rows)
        assert Counter(line["misses"]) == misses
        slots = int(self.world.seconds / self.every) - 1 if self.every else 0
        rows = Counter((row.drive, row.register) for row in self.rows)
        missing = sum(max(0, slots - rows[it.drive.name, it.polls[0].register.name]) for it in self.asked)
        assert missing <= line["overrun_slots"]


def _polls(drive: Drive, every: float | None) -> PolledDrive:
    first, *others = drive.readings()[:REGISTERS]
    timed, quick = polled(drive, [first], every), polled(drive, others)
    return PolledDrive(drive, (*timed.polls, *quick.polls))


def _longest_gap(rows: Sequence[Row]) -> float:
    """The bus cycle in s: the longest time between two values of one register."""
    times: dict[tuple[str, str], list[int]] = {}
    for row in rows:
        times.setdefault((row.drive, row.register), []).append(row.monotonic_ns)
    return max(b - a for it in times.values() for a, b in pairwise(it)) / S


def descriptors() -> int:
    return len(list(Path("/dev/fd").iterdir()))


def resident_kb() -> int:
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGESIZE") // 1024


# Two lines for each fault, and three faults or more for each line; the rest takes long.
EACH_ON_EACH = [
    pytest.param(name, kind, marks=pytest.mark.long if (number + nth) % 4 else ())
    for number, name in enumerate(LINES)
    for nth, kind in enumerate(KINDS)
]


@pytest.mark.parametrize(("name", "kind"), EACH_ON_EACH)
def test_a_fault_and_its_end(name: str, kind: str) -> None:
    number = LINES[name]
    if VARIANTS[number][1] in NOT_TOLD.get(kind, ()):
        pytest.skip("no client can tell this yet")
    before = descriptors(), threading.active_count()
    story = Story(of_one_variant(number))
    story.tell(KINDS[kind])
    assert (descriptors(), threading.active_count()) == before
    assert any(story.wire.struck[it] for it in RATES if getattr(KINDS[kind], it))


@pytest.mark.parametrize("name", LINES)
def test_an_adapter_that_always_echoes_is_known_for_it(name: str) -> None:
    story = Story(of_one_variant(LINES[name]))
    story.wire.faults = KINDS["echo"]
    with story.world:
        story.run(HEALTHY)
    story.rows += rows_of(story.world.poller)
    story.judge()
    assert {row.status for row in story.rows} <= {"ok", "poll ended"}


@pytest.mark.parametrize("echo", [0, 1], ids=["no echo", "an echo"])
@pytest.mark.parametrize("register", ["dc_bus_voltage", "output_frequency"], ids=["a value", "a zero"])
def test_a_delixi_parameter_is_no_echo_of_its_query(register: str, echo: int) -> None:
    """Nothing else is polled on the line: what is asked for may have the value that its query says."""
    drive = DelixiNative(1, name="drive-1")
    asked = polled(drive, [drive.register(register)])
    with World(WorldWire([simulated(drive)], Faults(echo=echo)), [asked]) as world:
        rows = world.run(HEALTHY)
    assert len(rows) > 10
    assert {(row.value == 0, row.status) for row in rows} == {(register == "output_frequency", "ok")}


@pytest.mark.parametrize("kind", KINDS)
def test_a_fault_while_the_core_repeats_the_bus_cycle(kind: str) -> None:
    """Nothing is polled at a rate: that goes without the poller's thread until something fails."""
    story = Story(of_one_variant(LINES["innovert-ibd rtu"]), every=None)
    story.tell(KINDS[kind])
    assert any(story.wire.struck[it] for it in RATES if getattr(KINDS[kind], it))


def lines_that_tell(kind: str) -> Iterator[list[Drive]]:
    """Each variant alone, and all on one line."""
    numbers = [it for it in LINES.values() if VARIANTS[it][1] not in NOT_TOLD.get(kind, ())]
    yield from map(of_one_variant, numbers)
    if len(numbers) == len(LINES):
        yield of_all_variants()


def test_nothing_grows_for_hours() -> None:
    """All families on one line; where there are hours, each alone too, with all kinds of faults in turn."""
    hours = float(os.environ.get("HOSTILE_HOURS", "0"))
    end = time.monotonic() + 3600 * hours
    seen: list[tuple[int, int, int]] = []
    while len(seen) < 3 or time.monotonic() < end:
        if hours:
            for kind in KINDS:
                for drives in lines_that_tell(kind):
                    Story(drives, seed=len(seen)).tell(KINDS[kind])
        else:
            Story(of_all_variants(), seed=len(seen)).tell(KINDS["all"])
        seen.append((resident_kb(), descriptors(), threading.active_count()))
        print(f"pass {len(seen)}: %d kB, %d descriptors, %d threads" % seen[-1], flush=True)
    assert seen[-1][0] - seen[0][0] <= MOST_GROWTH_KB
    assert seen[-1][1:] == seen[0][1:]
