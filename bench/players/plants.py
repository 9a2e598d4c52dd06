"""Simulated lines with all families and faults, in a separate process.

Drives of eight variants have values that encode drive and register (EncodedDrive), so each value shows
which register it belongs to. A ninth drive on each line has a motor, because starts cause noise.
"""

from __future__ import annotations

import multiprocessing
import os
import time
import tty
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.sharedctypes import SynchronizedArray
from pathlib import Path
from threading import Thread

from multidrop.families import MODELS
from multidrop.plant.loader import load_plant
from multidrop.plant.model import Plant
from multidrop.sim import EncodedDrive, Faults, FaultyWire, Simulator, Wire, proof, serve, simulated

VARIANTS = (  # a simulated drive's name, model and framing
    ("erman", "erman-er-g-220", "rtu"),
    ("che", "invt-che", "rtu"),
    ("ibd", "innovert-ibd", "rtu"),
    ("ibd-ascii", "innovert-ibd", "ascii"),
    ("delixi", "delixi-modbus", "rtu"),
    ("delixi-ascii", "delixi-modbus", "ascii"),
    ("delixi-native", "delixi-native", "delixi"),
    ("yd1000", "yd1000", "rtu"),
)
OPTIONS = {"maximum_frequency": 50}
MOTOR = "fan"
EVERY = 2.0  # s, period of each drive's first register; the other registers have no rate
PATIENCE = 30.0  # longest wait for the simulator's start, in s
BEAT = 5e-3  # time between two measurements of the simulator's delays, in s
LONG = 30e-3  # s; after a longer delay of the simulator, a reply may come after its time-out


def write_plant(directory: Path, lines: int) -> Path:
    """Write a plant file; if it has several lines, the last has a TCP port that the simulator chooses."""
    path = directory / "plant.toml"
    tables = []
    for number in range(1, lines + 1):
        tcp = number == lines > 1
        port = "socket://127.0.0.1:0" if tcp else directory / f"line-{number}"
        tables.append(f'[[line]]\nname = "line-{number}"\nport = "{port}"\n')
        for address, (name, model, framing) in enumerate([*VARIANTS, (MOTOR, "yd1000", "rtu")], 1):
            family = MODELS[model]
            options = "".join(f"{key} = {value}\n" for key, value in OPTIONS.items() if key in family.options)
            first, *others = (reading.name for reading in family.readings())
            poll = ", ".join([f'{{ register = "{first}", every = "{EVERY:g} s" }}', *map(repr, others)])
            tables.append(
                f'[[line.drive]]\nname = "{name}-{number}"\nmodel = "{model}"\nframing = "{framing}"\n'
                f"address = {address}\n{options}poll = [{poll}]\n"
            )
    path.write_text("\n".join(tables))
    return path


def proofs(plant: Plant) -> dict[tuple[str, str], float]:
    """Return the constant value of each polled register, by drive and register name.

    The registers of motor drives are left out, because their values change.
    """
    return {
        (drive.drive.name, poll.register.name): proof(drive.drive, poll.register)
        for line in plant.lines
        for drive in line.drives
        if not is_motor(drive.drive.name)
        for poll in drive.polls
    }


def is_motor(drive: str) -> bool:
    return drive.startswith(MOTOR)


@dataclass
class RunningPlant:
    """A running simulator: its ports, and its delays."""

    ports: Sequence[str]
    pid: int
    _late: SynchronizedArray[float]

    def latest(self) -> float:
        """Return the longest delay of the simulator or a pty since the last call, in s."""
        with self._late.get_lock():
            late, self._late[0] = self._late[0], 0.0
        return late

    def was_held_up(self, since: float) -> bool:
        """Return True if, after the time `since`, a delay may have made replies later than their time-out."""
        return max(self._late[1:]) >= since


def hostile_wires(plant: Path, faults: Faults) -> list[Wire]:
    """Return the plant's lines with these faults.

    The value of each register encodes its drive and its address, except in motors.
    """
    return [
        FaultyWire(
            [
                simulated(drive.drive) if is_motor(drive.drive.name) else EncodedDrive(drive.drive)
                for drive in line.drives
            ],
            faults,
            name=line.name,
            port=line.port,
        )
        for line in load_plant(plant).lines
    ]


@contextmanager
def running(make: Callable[..., Sequence[Wire]], *arguments: object) -> Iterator[RunningPlant]:
    """Start a process that calls `make(*arguments)` and simulates the lines (wires) that it returns."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    late = context.Array("d", 2)  # the longest delay in s; the time of the last long delay
    process = context.Process(target=_simulate, args=(make, arguments, theirs, late), daemon=True)
    process.start()
    try:
        if not ours.poll(PATIENCE):
            raise TimeoutError("the simulator did not start")
        yield RunningPlant(ours.recv(), process.pid or 0, late)
    finally:
        process.terminate()
        process.join()
        process.close()
        ours.close()
        theirs.close()


def _simulate(
    make: Callable[..., Sequence[Wire]],
    arguments: Sequence[object],
    connection: Connection,
    late: SynchronizedArray[float],
) -> None:
    with suppress(OSError):  # real-time priority keeps the lines' pace on a busy machine
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    Thread(target=_watch, args=(late,), daemon=True).start()

    def announce(simulator: Simulator) -> None:
        connection.send([wire.path for wire in simulator.wires])

    serve(make(*arguments), announce)


def _watch(late: SynchronizedArray[float]) -> None:
    """Measure forever how late this process, and the kernel's worker for a pty, get to run.

    A simulated drive that receives a request late also replies late.
    """
    master, slave = os.openpty()
    tty.setraw(slave)
    while True:
        begun = time.monotonic()
        time.sleep(BEAT)
        os.write(slave, b"!")
        os.read(master, 1)
        now = time.monotonic()
        with late.get_lock():
            late[0] = max(late[0], now - begun - BEAT)
            if now - begun - BEAT >= LONG:
                late[1] = now
