"""Simulated drives that number their replies, and a check that each number appears in a poller's rows.

The drives speak Modbus TCP, whose replies name their requests. So each sent request has one row: with the
number in its own reply, or without a number, however late the reply came.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from multidrop.families import InnovertIBD
from multidrop.sim import SimulatedDrive
from multidrop.sim.memory import MemoryCell

NUMBERED = "motor_speed"  # a register whose value is its raw count
DRIVES = 2  # drives on each line
PORT = "tcp://127.0.0.1:0"


class NumberedDrive(SimulatedDrive):
    """A drive whose motor speed register counts its own reads."""

    answers = 0

    def refresh(self, cell: MemoryCell) -> None:
        super().refresh(cell)
        if cell.name == NUMBERED:
            self.answers += 1
            cell.raw = self.answers


def drive_name(line: str, address: int) -> str:
    return f"{line}-drive-{address}"


def plant_file(ports: dict[str, str]) -> str:
    """Return a plant file with these lines, given as port by line name."""
    return "\n".join(
        f'[[line]]\nname = "{line}"\nport = "{port}"\n'
        + "".join(
            f'[[line.drive]]\nname = "{drive_name(line, address)}"\nmodel = "{InnovertIBD.model}"\n'
            f'address = {address}\npoll = ["{NUMBERED}"]\nevery = "100 ms"\n'
            for address in range(1, DRIVES + 1)
        )
        for line, port in ports.items()
    )


class KeptRow(NamedTuple):
    """A row: the time of its request in ns, and the number in the reply; None for a miss."""

    time_ns: int
    number: int | None


class Answers(NamedTuple):
    """How many replies one drive sent, and how many of them have a row, are missing, or came late."""

    answered: int = 0
    kept: int = 0
    late: int = 0  # rows that report a reply that came too late
    lost: int = 0
    doubled: int = 0


def judge_drive(rows: Iterable[KeptRow], answered: int) -> Answers:
    """Return how many of a drive's `answered` replies have a row."""
    kept = late = lost = doubled = misses = last = 0
    ordered = sorted(rows, key=lambda row: row.time_ns)
    for row in (*ordered, KeptRow(1 << 63, answered + 1)):  # detects missing replies at the end
        if row.number is None:
            misses += 1
            continue
        gap = row.number - last - 1
        if gap < 0:
            doubled += 1
            continue
        explained = min(gap, misses)
        late += explained
        lost += gap - explained
        kept, last, misses = kept + 1, row.number, 0
    return Answers(answered, kept - 1, late, lost, doubled)
