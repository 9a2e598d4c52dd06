"""Does one poller with many lines stay correct while many threads use all of its functions?

Threads concurrently take and check rows, start and stop motors, remove and add drives, and read the summary.
Several times the poller is closed, and a new one is opened. Exits with 1 if a value belongs to another
register, if a row or a command is lost, if a thread does not end, or if the use of memory, descriptors or
threads grows.
"""

from __future__ import annotations

import argparse
import faulthandler
import gc
import os
import random
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from bench.players import plants
from bench.questions.safety.soak import MOST_GROWTH_KB, resident_kb
from bench.support import tables
from multidrop.drive import Drive
from multidrop.errors import BusError
from multidrop.families import YD1000, InnovertIBD
from multidrop.plant.model import Plant, PlantLine, Polled, PolledDrive
from multidrop.poller import Poller
from multidrop.sim import EncodedDrive, Wire, simulated

PATIENCE = 30.0  # longest wait for a thread's end, in s
HEAD: tuple[str, ...] = (
    "exchanges",
    "a second",
    "values",
    "missed",
    "misattributed",
    "lost",
    "came and went",
    "commands",
)
HEAD += ("failed", "memory kB", "descriptors", "threads")


def plant(ports: Sequence[str], drives: int) -> Plant:
    """Return a plant: each line has IBDs with addresses from 1, and a YD1000 whose motor gets commands."""
    lines = []
    for number, port in enumerate(ports, 1):
        found = [InnovertIBD(at, name=f"ibd-{number}-{at}") for at in range(1, drives)]
        motor = YD1000(drives, name=f"{plants.MOTOR}-{number}")
        polled = [PolledDrive(each, tuple(Polled(reg, None) for reg in each.readings())) for each in found]
        polled.append(PolledDrive(motor, (Polled(YD1000.register("status"), 1.0),)))
        lines.append(PlantLine(f"line-{number}", port, drives=tuple(polled)))
    return Plant(tuple(lines), Path("plant.toml"))


def wires(lines: int, drives: int) -> list[Wire]:
    """Return simulated lines without the delays of a serial line, which this busy computer could not keep."""
    return [
        Wire(
            [
                simulated(drive.drive) if plants.is_motor(drive.drive.name) else EncodedDrive(drive.drive)
                for drive in line.drives
            ],
            name=line.name,
            unpaced=True,
        )
        for line in plant([""] * lines, drives).lines
    ]


class Round:
    """One poller from start to end, and the threads that use it."""

    def __init__(self, declared: Plant, seed: int) -> None:
        self.plant = declared
        self.poller = Poller(declared)
        self.truth = plants.proofs(declared)
        self.counts: Counter[str] = Counter()
        self.failures: list[str] = []
        self._seed = seed
        self._panels = {line.name: threading.Lock() for line in declared.lines}
        self._leave = threading.Event()
        self._lock = threading.Lock()  # protects `counts`

    def count(self, **numbers: int) -> None:
        with self._lock:
            self.counts.update(numbers)

    def run(self, seconds: float) -> None:
        acts = ((self.take, 2), (self.come_and_go, 3), (self.command, 3), (self.look, 1))
        actors = [
            threading.Thread(target=self._act, args=(act, f"{self._seed} {at}"), name=act.__name__)
            for act, number in acts
            for at in range(number)
        ]
        begun = time.monotonic()
        with self.poller:
            for actor in actors:
                actor.start()
            self._leave.wait(seconds)
            self._leave.set()
            for actor in actors:
                actor.join(PATIENCE)
                if actor.is_alive():
                    faulthandler.dump_traceback(all_threads=True)
                    self.failures.append(f"a thread that does {actor.name!r} does not end")
        self.take_all()
        self.seconds = time.monotonic() - begun

    def _act(self, act: Callable[[random.Random], None], seed: str) -> None:
        chance = random.Random(f"{seed} {act.__name__}")
        try:
            while not self._leave.is_set():
                act(chance)
        except BaseException as failure:
            self.failures.append(f"{threading.current_thread().name}: {failure!r}")
            self._leave.set()
            raise

    # ---- the threads' tasks ----

    def take(self, chance: random.Random) -> None:
        self.take_all()
        time.sleep(chance.uniform(0, 0.1))

    def take_all(self) -> None:
        while batch := self.poller.take():
            rows = list(batch)
            values = [row for row in rows if row.value is not None]
            wrong = [
                row for row in values if row.value != self.truth.get((row.drive, row.register), row.value)
            ]
            self.count(rows=len(rows), values=len(values), misattributed=len(wrong))

    def come_and_go(self, chance: random.Random) -> None:
        """Remove a drive and add it again; only count the attempt if another thread was faster."""
        line = chance.choice(self.plant.lines)
        polled = chance.choice(line.drives[:-1])
        try:
            self.poller.remove(line.name, polled.drive.name)
        except ValueError:
            self.count(beaten=1)
            return
        time.sleep(chance.uniform(0, 0.05))
        self.poller.add(line.name, polled)
        self.count(moved=1)

    def command(self, chance: random.Random) -> None:
        """Command a motor unless another thread does so: another start would delay the end of a stop."""
        line = chance.choice(self.plant.lines)
        if self._panels[line.name].acquire(blocking=False):
            try:
                self.use_panel(line.drives[-1].drive, chance)
            finally:
                self._panels[line.name].release()

    def use_panel(self, motor: Drive, chance: random.Random) -> None:
        self.count(given=1)
        try:
            if chance.random() < 0.3:
                motor.set_frequency(chance.randrange(1, 5))  # at a low frequency, the motor stops soon
            getattr(motor, chance.choice(["start", "stop", "state"]))()
        except BusError:
            self.count(failed=1)
        self.count(ended=1)

    def look(self, chance: random.Random) -> None:
        self.poller.summary()
        self.poller.statistics()
        time.sleep(chance.uniform(0, 0.2))

    # ---- the results ----

    def told(self) -> tuple[int, int]:
        """Return the number of exchanges, and the number of rows that the poller counts but did not deliver.

        Call this after `run`: its threads add every removed drive again, so the summary has all drives.
        """
        summary = self.poller.summary()
        lost = summary["samples"] + summary["misses"] - self.counts["rows"]
        return sum(line["exchanges"] for line in summary["lines"].values()), lost


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--lines", type=int, default=64)
    parser.add_argument("--drives", type=int, default=31, help="on each line")
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--rounds", type=int, default=10, help="how often the poller is opened and closed")
    arguments = parser.parse_args()
    tables.heading(
        f"{arguments.lines} lines of {arguments.drives} drives without waits, polled by one process, "
        "and 9 threads around the poller."
    )
    failures: list[str] = []
    seen: list[tuple[int, int, int]] = []
    print("  ".join(HEAD), flush=True)
    with TemporaryDirectory(prefix="multidrop-many-") as name:
        os.environ["XDG_STATE_HOME"] = name
        with plants.running(wires, arguments.lines, arguments.drives) as simulator:
            for number in range(arguments.rounds):
                this_round = Round(plant(simulator.ports, arguments.drives), number)
                this_round.run(60 * arguments.minutes / arguments.rounds)
                exchanges, lost = this_round.told()
                descriptors = len(list(Path("/proc/self/fd").iterdir()))
                gc.collect()  # objects in reference cycles would count as a leak
                seen.append((resident_kb(os.getpid()), descriptors, threading.active_count()))
                cells = (
                    exchanges,
                    f"{exchanges / this_round.seconds:.0f}",
                    this_round.counts["values"],
                    this_round.counts["rows"] - this_round.counts["values"],
                    this_round.counts["misattributed"],
                    lost,
                    this_round.counts["moved"],
                    this_round.counts["given"],
                    this_round.counts["failed"],
                    *seen[-1],
                )
                print(
                    "  ".join(str(cell).rjust(len(head)) for cell, head in zip(cells, HEAD, strict=True)),
                    flush=True,
                )
                failures += this_round.failures
                if (
                    this_round.counts["misattributed"]
                    or lost
                    or this_round.counts["given"] != this_round.counts["ended"]
                ):
                    failures.append(f"round {number + 1}: a value is another's, or a row or command is lost")
    half = seen[len(seen) // 2]  # after half of the rounds, buffers have their final size
    if seen[-1][0] - half[0] > MOST_GROWTH_KB or seen[-1][1:] != seen[0][1:]:
        failures.append(f"memory, descriptors or threads grow: half-way {half}, at last {seen[-1]}")
    print("\n" + ("\n".join(failures) or "nothing misattributed, nothing lost, nothing grows"))
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
