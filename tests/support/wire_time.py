"""A simulated wire on the test's clock, and a plain device on it."""

from __future__ import annotations

from multidrop.core import Framing
from multidrop.drive import Drive
from multidrop.drive.register import HOLDING, setting
from multidrop.sim import Wire


class Own(Drive):
    framings = (Framing.RTU, Framing.ASCII)
    most_registers = {HOLDING: 10}
    broadcasts = True
    value = setting(0x01)
    another = setting(0x02)


def timeline(wire: Wire, until: float) -> list[tuple[float, bytes]]:
    """Return every piece that the client receives, with its time."""
    received = []
    for _ in range(10_000):
        wake = wire.wake
        if wake is None or wake > until:
            break
        piece = wire.advance(wake)
        if piece:
            received.append((wake, piece))
    return received
