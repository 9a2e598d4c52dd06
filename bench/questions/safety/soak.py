"""Poll and record a plant with every family on hostile lines for hours, and report costs and errors.

Exits with 1 in these cases:

- A value belongs to another register, unless the simulator was delayed beyond the response time-out: no
  client can recognise such late replies.
- A value is missing without a row that gives the reason.
- The recording differs from the polled rows.
- Memory, descriptors or threads grow.
"""

from __future__ import annotations

import argparse
import os
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from bench.players import plants
from bench.support import tables
from multidrop.bus import Bus
from multidrop.errors import BusError
from multidrop.plant.loader import load_plant
from multidrop.plant.model import Plant
from multidrop.poller import Poller
from multidrop.polling.batch import Batch, Row
from multidrop.recording import open_recording, open_writer
from multidrop.sim import load_faults
from multidrop.toml_check import parse_duration

PLAYERS = Path(__file__).parents[2] / "players"
MOST_GROWTH_KB = 2048  # limit of the growth of resident memory since the end of the first period
COMMAND_EVERY = 20.0  # s between the start and the stop of a motor
IN_FLIGHT = 2  # number of each register's newest reads that may have no row yet
HELD_UP = 1.0  # s; a wrong value is excused if the simulator was late within this time before the value
HEAD: tuple[str, ...] = (
    "hours",
    "exchanges",
    "a second",
    "values",
    "missed",
    "misattributed",
    "beyond",
    "unexplained",
    "overrun",
)
HEAD += ("commands", "failed", "memory kB", "descriptors", "threads", "simulator kB", "late ms")


def resident_kb(pid: int) -> int:
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGESIZE") // 1024


@dataclass
class Span:
    """The least and the greatest value that a number had."""

    least: int = sys.maxsize
    most: int = 0

    def see(self, number: int) -> None:
        self.least, self.most = min(self.least, number), max(self.most, number)

    def __str__(self) -> str:
        return str(self.least) if self.least == self.most else f"{self.least}-{self.most}"


@dataclass
class Period:
    """The counts of one period, which are one row of the printed table."""

    exchanges: int = 0
    values: int = 0
    misattributed: int = 0
    beyond: int = 0
    misses: Counter[str] = field(default_factory=Counter)
    memory_kb: int = 0
    descriptors: Span = field(default_factory=Span)
    threads: Span = field(default_factory=Span)


class Commander(threading.Thread):
    """Starts and stops the motor of each line, as a person at a panel would."""

    def __init__(self, buses: list[Bus]) -> None:
        super().__init__(name="commander", daemon=True)
        self._buses = buses
        self._leave = threading.Event()
        self.given = self.failed = 0

    def run(self) -> None:
        while True:
            for verb in ("start", "stop"):
                for bus in self._buses:
                    self._command(bus, verb)
                if self._leave.wait(COMMAND_EVERY):
                    return

    def _command(self, bus: Bus, verb: str) -> None:
        (motor,) = (drive for drive in bus.drives if plants.is_motor(drive.name))
        self.given += 1
        try:
            if verb == "start":
                motor.set_frequency(20.0)
            getattr(motor, verb)()
        except BusError:
            self.failed += 1

    def leave(self) -> None:
        self._leave.set()
        self.join()


class Soak:
    """One run: checks the polled rows, and counts them by period."""

    def __init__(self, plant: Plant, poller: Poller, out: Path, simulator: plants.RunningPlant) -> None:
        self.plant = plant
        self.poller = poller
        self.out = out
        self.simulator = simulator
        self.truth = plants.proofs(plant)
        self.timed = {
            (drive.drive.name, poll.register.name): line.name
            for line in plant.lines
            for drive in line.drives
            for poll in drive.polls
            if poll.every
        }
        # number of rows of each register that has a polling rate
        self.slots: Counter[tuple[str, str]] = Counter()
        self.total = Period()
        self.exchanges = 0
        self.faults: list[str] = []
        self.begun = time.monotonic()

    def judge(self, batch: Batch, period: Period) -> None:
        for row in batch:
            key = row.drive, row.register
            self.slots[key] += key in self.timed
            if row.value is None:
                period.misses[row.status] += 1
            else:
                period.values += 1
                if row.value != self.truth.get(key, row.value):
                    self._tell_misattributed(row, period)

    def _tell_misattributed(self, row: Row, period: Period) -> None:
        beyond = self.simulator.was_held_up(row.monotonic_ns / 1e9 - HELD_UP)
        period.misattributed += not beyond
        period.beyond += beyond
        whose = [name for name, value in self.truth.items() if value == row.value]
        sentence = (
            f"{row.time_ns / 1e9:.3f} {row.drive}.{row.register} = {row.value:g}, not "
            f"{self.truth[row.drive, row.register]:g}: {', '.join(map('.'.join, whose[:4])) or 'no register'}"
        )
        print(f"{sentence}{', while the line was held up' if beyond else ''}", flush=True)
        if not beyond:
            self.faults.append(sentence)

    def run_period(self, seconds: float) -> Period:
        period = Period()
        self.out.unlink(missing_ok=True)
        with open_writer(self.out, self.plant.metadata()) as writer:
            for batch in self.poller.batches(seconds):
                self.judge(batch, period)
                writer.write(batch)
                period.descriptors.see(len(list(Path("/proc/self/fd").iterdir())))
                period.threads.see(threading.active_count())
        recorded = sum(len(batch) for batch in open_recording(self.out))
        if recorded != period.values + period.misses.total():
            self.faults.append(f"{recorded} rows in the recording, not those that were polled")
        period.memory_kb = resident_kb(os.getpid())
        return period

    def unexplained(self, overrun: int) -> int:
        """Return how many due values have no row, not counting the `overrun` values that were skipped."""
        slots = int((time.monotonic() - self.begun) / plants.EVERY) - IN_FLIGHT
        return max(0, sum(max(0, slots - self.slots[key]) for key in self.timed) - overrun)

    def periods(self, hours: float, every: float, commander: Commander) -> Iterator[Period]:
        """Poll for `hours`. After each period of `every` s, print and yield the period's figures."""
        print("  ".join(HEAD), flush=True)
        end = self.begun + hours * 3600
        while (left := end - time.monotonic()) > 1:
            given, failed = commander.given, commander.failed
            seconds = min(every, left)
            period = self.run_period(seconds)
            told = self.poller.summary()
            exchanges = sum(line["exchanges"] for line in told["lines"].values())
            overrun = sum(line["overrun_slots"] for line in told["lines"].values())
            period.exchanges, self.exchanges = exchanges - self.exchanges, exchanges
            unexplained = self.unexplained(overrun) + told["dropped"]
            cells = (
                f"{(time.monotonic() - self.begun) / 3600:.2f}",
                period.exchanges,
                f"{period.exchanges / seconds:.1f}",
                period.values,
                period.misses.total(),
                period.misattributed,
                period.beyond,
                unexplained,
                overrun,
                commander.given - given,
                commander.failed - failed,
                period.memory_kb,
                period.descriptors,
                period.threads,
                resident_kb(self.simulator.pid),
                f"{1e3 * self.simulator.latest():.0f}",
            )
            print("  ".join(str(cell).rjust(len(name)) for cell, name in zip(cells, HEAD, strict=True)))
            print("       " + ", ".join(f"{why} {n}" for why, n in period.misses.most_common()), flush=True)
            if unexplained:
                self.faults.append(f"{unexplained} values are missing and nothing says why")
            self.total.misses += period.misses
            yield period

    def check_growth(self, first: Period, last: Period) -> None:
        grown = last.memory_kb - first.memory_kb
        if grown > MOST_GROWTH_KB:
            self.faults.append(f"resident memory has grown by {grown} kB since the first period")
        if last.descriptors.least > first.descriptors.most:
            self.faults.append(f"{last.descriptors} descriptors, at first {first.descriptors}")
        if last.threads.least > first.threads.most:
            self.faults.append(f"{last.threads} threads, at first {first.threads}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", type=float, default=1.0)
    parser.add_argument("--every", type=parse_duration, default=3600.0, help='such as "5 min"; a line each')
    parser.add_argument("--lines", type=int, default=4, help="the last one is a TCP port")
    parser.add_argument("--faults", type=Path, default=PLAYERS / "hostile.toml")
    parser.add_argument("--out", type=Path, help="the last period's recording")
    arguments = parser.parse_args()
    tables.heading(
        f"Every family and one motor on each of {arguments.lines} hostile lines, polled and recorded; "
        f"faults of {arguments.faults.name}."
    )
    with TemporaryDirectory(prefix="multidrop-soak-") as name:
        os.environ["XDG_STATE_HOME"] = name  # the EEPROM ledger is in a folder below this one
        directory = Path(name)
        path = plants.write_plant(directory, arguments.lines)
        with plants.running(plants.hostile_wires, path, load_faults(arguments.faults)) as simulator:
            plant = load_plant(path)
            lines = [
                replace(each, port=port) for each, port in zip(plant.lines, simulator.ports, strict=True)
            ]
            plant = replace(plant, lines=tuple(lines))
            with Poller(plant) as poller:
                soak = Soak(plant, poller, arguments.out or directory / "soak.arrows", simulator)
                commander = Commander([poller.bus(line.name) for line in plant.lines])
                commander.start()
                with suppress(KeyboardInterrupt):
                    periods = list(soak.periods(arguments.hours, arguments.every, commander))
                    soak.check_growth(periods[0], periods[-1])
                commander.leave()
    if threading.active_count() > 1:
        soak.faults.append(f"threads are left: {', '.join(each.name for each in threading.enumerate())}")
    print("\nmissed: " + ", ".join(f"{why} {n}" for why, n in soak.total.misses.most_common()))
    print("\n".join(soak.faults) or "nothing misattributed, nothing unexplained, nothing grows")
    return 1 if soak.faults else 0


if __name__ == "__main__":
    sys.exit(main())
