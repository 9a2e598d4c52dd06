"""Simulated lines to poll and command: in a process of their own, and what their values prove."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from time import monotonic, sleep
from typing import Any

from multidrop.batch import Row
from multidrop.drive import Drive
from multidrop.plant import Line, Plant, Polled, PolledDrive
from multidrop.poller import Poller
from multidrop.register import Register
from multidrop.sim import SimulatedDrive, Simulator, Wire, proof, serve

PATIENCE = 30.0  # s, for what comes at once but on a machine that has much else to do


def until(met: Callable[[], Any], patience: float = PATIENCE) -> None:
    """Wait for a condition; the test fails when it is not met at last."""
    end = monotonic() + patience
    while not met():
        assert monotonic() < end, f"not met within {patience:g} s"
        sleep(0.005)


class Faulty(Wire):
    """A wire on which every reply has the fate that it is given."""

    def __init__(
        self, drives: Sequence[SimulatedDrive], fate: Callable[[bytes], bytes], **details: Any
    ) -> None:
        super().__init__(drives, **details)
        self.fate = fate

    def distort(self, reply: bytes) -> bytes:
        return self.fate(reply)


# ---- in a process of their own ----


@contextmanager
def served(make: Callable[[], Sequence[Wire]]) -> Iterator[list[str]]:
    """The paths of wires that another process runs; `make` is a function that it can import."""
    ours, theirs = multiprocessing.Pipe()
    context = multiprocessing.get_context("spawn")
    process = context.Process(target=_serve, args=(make, theirs), daemon=True)
    process.start()
    try:
        assert ours.poll(PATIENCE)
        yield ours.recv()
    finally:
        process.terminate()
        process.join()
        process.close()
        ours.close()
        theirs.close()


def _serve(make: Callable[[], Sequence[Wire]], connection: Connection) -> None:
    def announce(simulator: Simulator) -> None:
        connection.send([wire.path for wire in simulator.wires])

    serve(make(), announce)


# ---- plants without a file ----


def polled(drive: Drive, registers: Iterable[Register[Any]], every: float | None = None) -> PolledDrive:
    return PolledDrive(drive, tuple(Polled(register, every) for register in registers))


def line(port: str, *drives: PolledDrive, name: str = "line") -> Line:
    return Line(name, port, None, None, drives)


def plant(*lines: Line) -> Plant:
    return Plant(lines, Path("plant.toml"))


def rows_of(poller: Poller) -> list[Row]:
    """All that waits to be taken."""
    found: list[Row] = []
    while batch := poller.take():
        found += batch
    return found


# ---- what a value proves ----


def proofs(*drives: PolledDrive) -> dict[tuple[str, str], float]:
    """The same for all that is polled, by the names of drive and register."""
    return {
        (it.drive.name, poll.register.name): proof(it.drive, poll.register)
        for it in drives
        for poll in it.polls
    }
