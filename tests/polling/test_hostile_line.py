"""Every fault on a line of every family: no misattribution, a reason for every miss, and recovery.

The tests run on a simulated clock, so that a seed reproduces its run. To run for hours, with new seeds:
`HOSTILE_HOURS=2 pytest -m '' tests/polling/test_hostile_line.py -k hours`.
"""

from __future__ import annotations

import gc
import os
import time
from collections.abc import Iterator
from math import inf
from pathlib import Path

import pytest
from clocked_lines import ClockedLines, ClockedWire
from examples import usually
from kills import descriptors, threads
from lines import polled, rows_of
from stories import HEALTHY, Story
from tables import table
from variants import LINES, of_all_variants, of_one_variant

from multidrop.drive import Drive
from multidrop.families import DelixiNative
from multidrop.sim import Faults, simulated

pytestmark = pytest.mark.story

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


# The short run has one line for each fault, and one or two faults for each line.
EACH_ON_EACH = [
    pytest.param(name, kind, marks=pytest.mark.long if (number + nth) % 8 else ())
    for number, name in enumerate(LINES)
    for nth, kind in enumerate(KINDS)
]


@pytest.mark.long
@pytest.mark.parametrize(("name", "kind"), EACH_ON_EACH)
def test_polling_recovers_from_each_fault_without_misattributed_values(name: str, kind: str) -> None:
    number = LINES[name]
    before = descriptors(), threads()
    story = Story(of_one_variant(number))
    story.run_with_fault(KINDS[kind])
    assert (descriptors(), threads()) == before
    assert story.wire.struck.total()


@pytest.mark.long
@table("name", LINES)
def test_a_permanent_echo_is_detected_and_removed(name: str) -> None:
    story = Story(of_one_variant(LINES[name]))
    story.wire.faults = KINDS["echo"]
    with story.clocked:
        begun = len(story.run(2))  # without the first two seconds, in which each first value is read twice
        story.run(HEALTHY)
    story.rows += rows_of(story.clocked.poller)
    story.judge()
    assert {row.status for row in story.rows[begun:]} <= {"ok", "poll ended"}


@pytest.mark.slow
@table("echo", [0, 1], ids=["no echo", "an echo"])
@table("register", ["dc_bus_voltage", "output_frequency"], ids=["a value", "a zero"])
def test_a_delixi_reply_equal_to_its_request_is_not_taken_for_an_echo(register: str, echo: int) -> None:
    """In Delixi's protocol, a reply with the value 0 equals its request; it must not count as an echo."""
    drive = DelixiNative(1, name="drive-1")
    asked = polled(drive, [drive.register(register)])
    with ClockedLines(ClockedWire([simulated(drive)], Faults(echo=echo)), [asked]) as clocked:
        rows = clocked.run(HEALTHY)
    assert len(rows) > 10
    assert {(row.value == 0, row.status) for row in rows} == {(register == "output_frequency", "ok")}


def test_an_echo_of_a_silent_delixi_drive_is_not_read_as_0_for_long() -> None:
    """A broken wire may silence a drive and cause an echo. After two values of 0, a probe shows the echo."""
    drive = DelixiNative(1, name="drive-1")
    asked = polled(drive, [DelixiNative.output_frequency, DelixiNative.output_current])
    wire = ClockedWire([simulated(drive)], Faults())
    with ClockedLines(wire, [asked]) as clocked:
        rows = clocked.run(HEALTHY)
        assert {(row.value, row.status) for row in rows} == {(0, "ok")}
        wire.faults = Faults(echo=1)
        wire.drives[0].deaf_until = inf
        deaf_ns = clocked.now  # one reply may still be in flight
        rows = clocked.run(HEALTHY)
    assert len(rows) > 4
    assert sum(row.status == "ok" and row.monotonic_ns >= deaf_ns for row in rows) <= 2
    assert rows[-1].status != "ok"


@pytest.mark.slow
@pytest.mark.parametrize("kind", usually(*KINDS))
def test_polling_recovers_from_a_fault_while_the_core_repeats_the_cycle(kind: str) -> None:
    """Without rates the core repeats the bus cycle by itself until a fault occurs."""
    story = Story(of_one_variant(LINES["innovert-ibd rtu"]), every=None)
    story.run_with_fault(KINDS[kind])
    assert story.wire.struck.total()


def all_lines() -> Iterator[list[Drive]]:
    """Yield the drives of each variant alone, and then all variants on one line."""
    yield from map(of_one_variant, LINES.values())
    yield of_all_variants()


@pytest.mark.long
def test_resources_do_not_grow_over_hours_of_faults() -> None:
    """Memory, descriptors and threads stay constant on a line with all families.

    With HOSTILE_HOURS, each variant is also polled alone, with all kinds of faults in turn.
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
