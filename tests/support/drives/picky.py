"""Simulated devices that reject or ignore some requests."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any

from multidrop.core import Message
from multidrop.drive import Drive
from multidrop.drive.register import reading
from multidrop.sim import SimulatedDrive
from multidrop.sim.protocol import Reason, Refusal


def family(registers: int, **declared: Any) -> type[Drive]:
    """Return a class with this many adjacent registers, named r0 and so on, and no other declaration."""
    readings = {f"r{at}": reading(at) for at in range(registers)}
    return type("Plain", (Drive,), {"__doc__": "Of this test.", **readings, **declared})


def expected_values(addresses: Iterable[int]) -> dict[str, float]:
    """Return a picky device's values at these addresses, by register name."""
    return {f"r{at}": 100 + at for at in addresses}


class Picky(SimulatedDrive):
    """Rejects reads of some addresses; rejects or ignores reads of too many registers."""

    def __init__(
        self, drive: Drive, refused: Collection[int] = (), most: int = 125, silent_beyond: int = 125
    ) -> None:
        super().__init__(drive)
        self.missing = set(refused)
        self.limit, self.silent_beyond = most, silent_beyond
        self.asked: list[tuple[int, int]] = []
        for at, name in enumerate(drive.registers):
            self[name] = 100 + at

    def answer(self, request: Message, now: float) -> Message | None:
        if request.address != self.drive.address or now < self.deaf_until:
            return None
        self.asked.append((request.start, request.count))
        if request.count > self.silent_beyond:
            return None
        return super().answer(request, now)

    def read(self, function: int, start: int, count: int) -> list[int]:
        if count > self.limit:
            raise Refusal(Reason.COUNT)
        if self.missing & set(range(start, start + count)):
            raise Refusal(Reason.READ_ADDRESS)
        return super().read(function, start, count)
