"""Simulated lines in another process or on simulated time, and values that identify their register."""

from __future__ import annotations

import heapq
import multiprocessing
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from time import monotonic, sleep
from typing import Any

import pytest

from multidrop.core import Framing, Status
from multidrop.drive import Drive
from multidrop.drive.register import HOLDING, Register, setting
from multidrop.plant.model import Plant, PlantLine, Polled, PolledDrive
from multidrop.poller import Poller
from multidrop.polling.batch import Row
from multidrop.sim import SimulatedDrive, Simulator, Wire, proof, serve

ANY_PORT = "socket://127.0.0.1:0"  # any free TCP port; needs no pseudo-terminals
PATIENCE = 120.0  # s, longest wait for events that are immediate on an idle machine
# Statuses of misses that a delay of the test machine alone can cause.
HOST_LATE = {
    str(status)
    for status in (
        Status.NO_REPLY,
        Status.CUT_SHORT,
        Status.LATE_ANSWER_DUE,
        Status.NOT_ASKED,
        Status.EXPIRED,
        Status.POLL_ENDED,
    )
}
patient = pytest.mark.usefixtures("_patient")  # marks tests that wait for drives as long as needed


def until(met: Callable[[], Any], patience: float = PATIENCE) -> None:
    """Wait until `met()` is true; fail after `patience` seconds."""
    end, pause_s = monotonic() + patience, 0.002
    while not met():
        assert monotonic() < end, f"not met within {patience:g} s"
        sleep(pause_s)
        pause_s = min(1.2 * pause_s, 0.04)  # checks become rarer, as a check may be costly


class Faulty(Wire):
    """A wire that passes each reply through a function that may damage it."""

    def __init__(
        self, drives: Sequence[SimulatedDrive], fate: Callable[[bytes], bytes], **details: Any
    ) -> None:
        super().__init__(drives, **details)
        self.fate = fate

    def distort(self, reply: bytes) -> bytes:
        return self.fate(reply)


class LateWire(Wire):
    """A wire whose `distort` may delay replies with `hold_up`."""

    def __init__(self, drives: Sequence[SimulatedDrive], **details: Any) -> None:
        super().__init__(drives, **details)
        self._late: list[tuple[float, bytes]] = []  # heap of delayed replies: time at which to send it, reply
        self._now = 0.0

    def hold_up(self, reply: bytes, seconds: float) -> bytes:
        """Queue the reply to be sent `seconds` later; return no bytes."""
        heapq.heappush(self._late, (self._now + seconds, reply))
        return b""

    def receive(self, chunk: bytes, now: float, baudrate: int | None = None) -> None:
        self._now = now
        super().receive(chunk, now, baudrate)

    def advance(self, now: float) -> bytes:
        self._now = now
        received = super().advance(now)
        while self._late and self._late[0][0] <= now:
            received += heapq.heappop(self._late)[1]
        return received

    @property
    def wake(self) -> float | None:
        times = [at for at, _ in self._late[:1]]
        return min([*times, *([] if super().wake is None else [super().wake])], default=None)


@contextmanager
def served(make: Callable[[], Sequence[Wire]]) -> Iterator[list[str]]:
    """Start a process that imports `make` and simulates the wires that it returns; yield their paths."""
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


def polled(drive: Drive, registers: Iterable[Register[Any]], every: float | None = None) -> PolledDrive:
    return PolledDrive(drive, tuple(Polled(register, every) for register in registers))


def line(port: str, *drives: PolledDrive, name: str = "line") -> PlantLine:
    return PlantLine(name, port, drives=drives)


def plant(*lines: PlantLine) -> Plant:
    return Plant(lines, Path("plant.toml"))


def rows_of(poller: Poller) -> list[Row]:
    """Return all rows that the poller has collected."""
    found: list[Row] = []
    while batch := poller.take():
        found += batch
    return found


def proofs(*drives: PolledDrive) -> dict[tuple[str, str], float]:
    """Return the value that an EncodedDrive has in each polled register, by drive and register name."""
    return {
        (drive.drive.name, poll.register.name): proof(drive.drive, poll.register)
        for drive in drives
        for poll in drive.polls
    }


class Own(Drive):
    framings = (Framing.RTU, Framing.ASCII)
    most_registers = {HOLDING: 10}
    broadcasts = True
    value = setting(0x01)
    another = setting(0x02)


def timeline(wire: Wire, until: float) -> list[tuple[float, bytes]]:
    """Advance the wire to `until` s; return every piece that the client receives, with its time in s."""
    received = []
    for _ in range(10_000):
        wake = wire.wake
        if wake is None or wake > until:
            break
        piece = wire.advance(wake)
        if piece:
            received.append((wake, piece))
    return received
