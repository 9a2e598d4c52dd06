"""Useless proofs: the device does not answer them, or the register holds an unexpected value."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest
from clocked_lines import ClockedLines, ClockedWire
from lines import polled
from toy import Toy

from multidrop.drive.register import HOLDING, Register
from multidrop.sim import EncodedDrive, Faults, SimulatedDrive

POLLED = bytes((1, 3, 0, 1, 0, 1))  # output_frequency


class LossyWire(ClockedWire):
    """It `loses` so many polled requests."""

    loses = 0

    def receive(self, request: bytes, now: float, baudrate: int) -> None:
        if self.loses and request.startswith(POLLED):
            self.loses -= 1
        else:
            super().receive(request, now, baudrate)


class SilentWire(LossyWire):
    """Its device answers polled reads only."""

    unanswered = 0

    def receive(self, request: bytes, now: float, baudrate: int) -> None:
        if request.startswith(POLLED):
            super().receive(request, now, baudrate)
        else:
            self.unanswered += 1


class MisprintedToy(Toy):
    """Its document is wrong about what two registers hold."""

    most_registers = {HOLDING: 1}

    def known_counts(self) -> Mapping[Register[Any], tuple[int, int]]:
        return {Toy.mystery: (1, 1), Toy.acceleration_time: (2, 9)}


@pytest.mark.slow
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


def test_a_misprint_does_not_end_the_polling_after_a_lost_request() -> None:
    pump = MisprintedToy(1, name="pump")
    sim = SimulatedDrive(pump)
    sim["mystery"], sim["acceleration_time"] = 1234, 123.4
    wire = LossyWire([sim], Faults())
    with ClockedLines(wire, [polled(pump, [Toy.output_frequency], 0.1)]) as lines:
        lines.run(4)
        wire.loses = 1
        lines.run(10)
        rows = lines.run(4)
    assert [row.status for row in rows] == ["ok"] * 40
