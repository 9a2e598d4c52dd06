"""A device is silent to registers that it lacks: what shows that its replies are in step cannot be asked."""

from __future__ import annotations

import pytest
from clocked_lines import ClockedLines, ClockedWire
from lines import polled
from toy import Toy

from multidrop.sim import EncodedDrive, Faults

POLLED = bytes((1, 3, 0, 1, 0, 1))  # output_frequency


class SilentWire(ClockedWire):
    """Its device answers what is polled, and keeps silent to all else; `loses` so many requests of those."""

    loses = 0
    unanswered = 0

    def receive(self, request: bytes, now: float, baudrate: int) -> None:
        if not request.startswith(POLLED):
            self.unanswered += 1
        elif self.loses:
            self.loses -= 1
        else:
            super().receive(request, now, baudrate)


@pytest.mark.parametrize("lost", [1, 5])
def test_a_lost_request_does_not_slow_it_for_good(lost: int) -> None:
    pump = Toy(1, name="pump")
    wire = SilentWire([EncodedDrive(pump)], Faults())
    with ClockedLines(wire, [polled(pump, [Toy.output_frequency], 0.1)]) as lines:
        lines.run(4)
        wire.loses = lost
        lines.run(10)
        assert wire.unanswered > 0
        wire.unanswered = 0
        rows = lines.run(4)
    assert [row.status for row in rows] == ["ok"] * 40
    assert wire.unanswered == 0
