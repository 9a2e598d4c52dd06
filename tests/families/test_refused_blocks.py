"""Reads that A1000 and CP2000 drives refuse are learnt without options, and cost no other value."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from clocked_lines import ClockedLines, ClockedWire
from lines import polled
from profile_families import shipped
from tables import table

from multidrop.core import Message
from multidrop.drive import Drive
from multidrop.polling.batch import Row
from multidrop.sim import Faults, simulated

ILLEGAL_ADDRESS, ILLEGAL_VALUE = 2, 3


class Choosy:
    """A simulated drive that refuses some reads with an exception."""

    def __init__(self, drive: Drive, refusal: Callable[[Message], int]) -> None:
        self.sim: Any = simulated(drive)
        self._answer = self.sim.answer
        self._refusal = refusal
        self.read: list[tuple[int, int]] = []
        vars(self.sim)["answer"] = self.answer

    def answer(self, request: Message, now: float) -> Message | None:
        self.read.append((request.start, request.count))
        if code := self._refusal(request):
            return Message(request.address, request.function, request.start, exception=code)
        reply: Message | None = self._answer(request, now)
        return reply


def more_than_four(request: Message) -> int:
    return ILLEGAL_VALUE if request.count > 4 else 0


def at_210b(request: Message) -> int:
    return ILLEGAL_ADDRESS if request.start <= 0x210B < request.start + request.count else 0


def values(rows: list[Row]) -> set[str]:
    return {row.register for row in rows if row.value is not None}


@table(
    "name, refusal, lost",
    [("yaskawa-a1000", more_than_four, set()), ("delta-cp2000", at_210b, {"output_torque"})],
)
def test_refused_read_costs_no_other_value(
    name: str, refusal: Callable[[Message], int], lost: set[str]
) -> None:
    drive = shipped(name, 1)
    choosy = Choosy(drive, refusal)
    readings = drive.readings()
    with ClockedLines(ClockedWire([choosy.sim], Faults()), [polled(drive, readings, 0.5)]) as clocked:
        clocked.run(8)
        choosy.read.clear()
        rows = clocked.run(4)
    assert values(rows) == {register.name for register in readings} - lost
    refused = [each for each in choosy.read if refusal(Message(1, 3, *each))]
    assert not refused, "the drive is asked again only after a minute"
    assert len(set(choosy.read)) < len(readings), "registers are still read together"
