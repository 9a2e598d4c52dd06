"""Messages of a fleet: bytes and CPU a value, and what a spool takes with each message on the disk.

The rows are those of a plant in operation: each line asks its drives in turn, ten registers at once, every
12 ms and some; speeds, currents and voltages move by a step or two at three of five polls, temperatures at
one of three; 5 of 1000 requests are missed. Nothing is as regular as a simulator's.
"""

from __future__ import annotations

import argparse
import heapq
import random
import resource
import time
from array import array
from collections.abc import Iterator
from typing import Any

from bench.support import tables
from multidrop import BatchColumns
from multidrop.fleet.message import Packed, RowBuffer, unpack

UTC = 1_795_253_399_123_456_789
DRIVES = 16  # a line
REGISTERS = {  # name: a value in steps, the step, and how often it moves
    "output_frequency": (4500, 0.01, 0.6),
    "output_current": (53, 0.1, 0.7),
    "output_voltage": (3800, 0.1, 0.3),
    "dc_bus_voltage": (5400, 0.1, 0.4),
    "temperature": (45, 0.1, 0.3),
    "motor_speed": (1460, 1.0, 0.6),
    "output_power": (620, 0.1, 0.7),
    "load": (31, 1.0, 0.02),
    "status_word": (1, 1.0, 0.0),
    "fault": (0, 1.0, 0.0),
}
STATUSES = ("ok", "no reply")


def exchanges(lines: int, dice: random.Random) -> Iterator[tuple[int, int, int, list[float] | None]]:
    """Yield the time, the uncertainty, the drive and its values, or None for a miss."""
    due = [(dice.randrange(12_000_000), line) for line in range(lines)]
    heapq.heapify(due)
    turn = [0] * lines
    steps: dict[int, list[int]] = {}
    while True:
        now, line = heapq.heappop(due)
        drive = line * DRIVES + turn[line]
        turn[line] = (turn[line] + 1) % DRIVES
        heapq.heappush(due, (now + 12_000_000 + dice.randrange(400_000), line))
        values = steps.setdefault(
            drive,
            [of + (dice.randint(-of // 5, of // 5) if of > 20 else 0) for of, _, _ in REGISTERS.values()],
        )
        for at, (_, _, moves) in enumerate(REGISTERS.values()):
            if dice.random() < moves:
                values[at] += dice.choice((-2, -1, 1, 2))
        told = [many * step for many, (_, step, _) in zip(values, REGISTERS.values(), strict=True)]
        yield now, dice.randrange(2_500_000, 4_500_000), drive, None if dice.random() < 0.005 else told


def columns_of(rows: int, lines: int, dice: random.Random) -> BatchColumns:
    """Return rows as `Batch.columns()` gives them."""
    kinds = {"time": "q", "monotonic_ns": "q", "uncertainty_ns": "q"}
    kinds |= {"drive": "H", "register": "H", "value": "d", "status": "H"}
    made: dict[str, array[Any]] = {name: array(kind) for name, kind in kinds.items()}
    for now, uncertainty, drive, values in exchanges(lines, dice):
        if len(made["time"]) >= rows:
            break
        for register, value in enumerate(values or [0.0] * len(REGISTERS)):
            one: tuple[Any, ...] = (UTC + now, now, uncertainty, drive, register, value, int(values is None))
            for name, number in zip(made, one, strict=True):
                made[name].append(number)
    return BatchColumns(
        **{name: memoryview(column) for name, column in made.items()},
        valid=memoryview(b""),
        drives=tuple(f"line-{at // DRIVES + 1}-pump-{at % DRIVES + 1}" for at in range(lines * DRIVES)),
        registers=tuple(REGISTERS),
        statuses=STATUSES,
    )


def packed(columns: BatchColumns) -> list[Packed]:
    buffer = RowBuffer()
    assert buffer.add(columns)
    return list(buffer.messages())


def cpu() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def cost(act: Any, times: int) -> float:
    """Return the CPU of one call in ns."""
    act()
    begun = cpu()
    for _ in range(times):
        act()
    return (cpu() - begun) / times * 1e9


def messages() -> Iterator[tuple[object, ...]]:
    for rows, lines in ((3100, 2), (4096, 40), (16384, 40), (16384, 500), (65536, 40), (65536, 500)):
        columns = columns_of(rows, lines, random.Random(rows))
        made = len(columns.time)
        found = packed(columns)
        size = sum(len(one.data) for one in found)
        times = max(3, 400_000 // made)
        packing = cost(lambda columns=columns: packed(columns), times) / made
        reading = cost(lambda found=found: [unpack(one.data) for one in found], times) / made
        yield made, lines, len(found), f"{size / made:.2f}", f"{packing:.0f}", f"{reading:.0f}"


def main() -> None:
    argparse.ArgumentParser(description=__doc__).parse_args()
    tables.heading("Messages of samples.")
    begun = time.monotonic()
    tables.show(
        ("rows", "lines", "messages", "B/value", "pack ns/value", "unpack ns/value"), list(messages())
    )
    print(f"\n{time.monotonic() - begun:.0f} s")


if __name__ == "__main__":
    main()
