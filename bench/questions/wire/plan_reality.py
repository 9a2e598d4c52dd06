"""The predicted bus cycle compared with the measured bus cycle.

Measured on paced_line.c, and on simulated drives of all families with their own settings and silences. A
measured cycle is the time from a drive's first request in one cycle to its first request in the next. The
figure is the median of per-second means, because other programs disturb some seconds.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

from bench.players.replay import Played
from bench.support import tables
from bench.support.programs import paced_line
from multidrop.core import Framing, Status
from multidrop.drive import Drive
from multidrop.families import YD1000, DelixiModbus, DelixiNative, ErmanERG220, InnovertIBD, InvtCHE
from multidrop.planning.blocks import Planned, planned
from multidrop.planning.prediction import predict
from multidrop.plant.model import Plant, PlantLine, Polled, PolledDrive
from multidrop.poller import Poller

GOAL = 0.02
SETTLING_S = 0.5  # time in which the poller learns the response delays

Wanted = list[tuple[Drive, float | None]]  # drives, and the period in s at which all readings are polled


@dataclass(frozen=True)
class Case:
    name: str
    predicted: float  # predicted cycle in s
    known: float  # cycle predicted from the measured response delays, in s
    measured: float
    missed: int  # missed values; each failed exchange costs a time-out

    def row(self) -> list[str]:
        seconds = (self.predicted, self.known, self.measured)
        off = (self.measured / each - 1 for each in seconds[:2])
        return [
            self.name,
            *(f"{each * 1e3:.2f}" for each in seconds),
            *(f"{each:+.2%}" for each in off),
            str(self.missed),
        ]


def polls(drive: Drive, every: float | None) -> tuple[Polled, ...]:
    return tuple(Polled(register, every) for register in drive.readings())


def exchanges(wanted: Wanted) -> list[Planned]:
    return [
        one
        for drive, every in wanted
        for one in planned(drive, [(register, every) for register in drive.readings()])
    ]


def case(name: str, port: str, wanted: Wanted, seconds: float) -> Case:
    """Poll a line; return the predicted and measured cycles of the drives that are polled without a rate."""
    drives = tuple(PolledDrive(drive, polls(drive, every)) for drive, every in wanted)
    plant = Plant((PlantLine("line", port, drives=drives),), Path("plant.toml"))
    watched = next(drive for drive, every in wanted if every is None)
    first = watched.readings()[0].name
    with Poller(plant) as poller:
        time.sleep(SETTLING_S)
        times = [
            row.monotonic_ns
            for batch in poller.batches(seconds)
            for row in batch
            if (row.drive, row.register) == (watched.name, first)
        ]
    delays = {drive: poller.bus("line").peer(drive).response_delay for drive, _ in wanted}
    misses = Counter(poller.summary()["lines"]["line"]["misses"])
    del misses[str(Status.POLL_ENDED)]
    return Case(name, cycle(wanted, {}), cycle(wanted, delays), middle(times), misses.total())


def middle(times: Sequence[int]) -> float:
    """Return the usual interval in s between these times in ns.

    Each second has a mean interval; the result is the median of the means.
    """
    most = len(times) - 1
    step = min(most, max(1, round(1e9 * most / (times[-1] - times[0]))))
    return median(times[at + step] - times[at] for at in range(0, most - step + 1, step)) / step / 1e9


def cycle(wanted: Wanted, delays: dict[Drive, float]) -> float:
    """Return the predicted cycle of drives polled without a rate, in s; `delays` are response delays in s."""
    return next(1 / rate.reached for rate in predict(exchanges(wanted), delays).rates if rate.every is None)


# ---- paced_line.c ----


def paced(seconds: float) -> Iterator[Case]:
    for baudrate in (9600, 19200, 38400, 115200):
        for drives, delay in ((16, 0.002), (1, 0.002), (16, 0.01)):
            with paced_line(baudrate=baudrate, delay_us=round(delay * 1e6)) as line:
                name = f"{baudrate}, {drives} x {delay * 1e3:g} ms"
                yield case(name, line.path, at_pace(drives, baudrate, delay, [None]), seconds)
    with paced_line(baudrate=38400) as line:
        wanted = at_pace(16, 38400, 0.002, [None, 0.5, 0.1, None])
        yield case("38400, 16 x 2 ms, mixed rates", line.path, wanted, seconds)


def at_pace(drives: int, baudrate: int, delay: float, every: Sequence[float | None]) -> Wanted:
    wanted: Wanted = []
    for address in range(1, drives + 1):
        drive = Played(address, baudrate=baudrate)
        drive.response_delay = delay
        wanted.append((drive, every[address % len(every)]))
    return wanted


# ---- simulated drives ----


def mixed(seconds: float) -> Iterator[Case]:
    drives = [
        ("erman-er-g-220", ErmanERG220(1, name="erman")),
        ("invt-che", InvtCHE(2, name="che")),
        ("innovert-ibd", InnovertIBD(3, name="ibd")),
        ("innovert-ibd", InnovertIBD(4, name="ibd-ascii", framing=Framing.ASCII)),
        ("delixi-modbus", DelixiModbus(5, name="delixi")),
        ("delixi-modbus", DelixiModbus(6, name="delixi-ascii", framing=Framing.ASCII)),
        ("delixi-native", DelixiNative(7, name="delixi-native")),
        ("yd1000", YD1000(8, name="yd1000")),
    ]
    with simulated(drives) as port:
        yield case("all eight variants", port, [(drive, None) for _, drive in drives], 3 * seconds)


@contextmanager
def simulated(drives: Iterable[tuple[str, Drive]]) -> Iterator[str]:
    """Yield the port of a line on which `multidrop simulate` simulates these drives."""
    with TemporaryDirectory() as directory:
        plant = Path(directory) / "plant.toml"
        entries = (
            f'[[line.drive]]\nname = "{drive.name}"\nmodel = "{model}"\naddress = {drive.address}\n'
            f'framing = "{drive.framing}"\n'
            for model, drive in drives
        )
        plant.write_text('[[line]]\nname = "line"\nport = "-"\n' + "".join(entries))
        command = [sys.executable, "-m", "multidrop", "simulate", str(plant), "--ports", directory]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            yield process.stdout.readline().split()[2]
            process.terminate()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=4.0, help="of each line")
    arguments = parser.parse_args()
    tables.heading("Bus cycles in ms: predicted, predicted with the measured response delays, measured.")
    cases = [*paced(arguments.seconds), *mixed(arguments.seconds)]
    columns = ("line", "predicted", "by delays", "measured", "off", "by delays", "missed")
    tables.show(columns, [case.row() for case in cases])
    outside = [case.name for case in cases if abs(case.measured / case.predicted - 1) > GOAL]
    print(f"\nmore than {GOAL:.0%} away from the prediction: {'; '.join(outside) or 'none'}")


if __name__ == "__main__":
    main()
