"""The bus cycle of random plants with multidrop's plan, compared with the usual ways to merge registers.

All plans keep the families' limits, and merge registers only across addresses that can be read. All have the
order of drives that multidrop plans, except the last row: multidrop's blocks in the plant file's order.
"""

from __future__ import annotations

import argparse
import random
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from statistics import mean, median
from typing import Any

from bench.support import tables
from multidrop.drive import Drive
from multidrop.drive.register import Register, Table
from multidrop.families import MODELS
from multidrop.planning.blocks import Block, Planned, blocks, sending
from multidrop.planning.bus_time import gap
from multidrop.planning.bus_time import in_order as cycle_order

GAPS = range(40)
MOST_DRIVES = 31

Registers = Sequence[Register[Any]]
Plant = list[tuple[Drive, Registers]]


def plant(lot: random.Random) -> Plant:
    """Return a plant with drives of all families, random settings, and some registers of each drive."""
    drives: Plant = []
    for address in range(1, lot.randint(1, MOST_DRIVES) + 1):
        family = lot.choice(list(MODELS.values()))
        readable = [register for register in family.registers.values() if register.readable]
        wanted = lot.sample(readable, lot.randint(1, len(readable)))
        drive = family(address, framing=lot.choice(family.framings), baudrate=lot.choice(family.baudrates))
        drives.append((drive, wanted))
    return drives


# ---- the usual ways ----


def merged(drive: Drive, registers: Registers, most_gap: int) -> list[Block]:
    """Return blocks of registers, merged across at most `most_gap` other addresses; -1: never merged."""
    tables: dict[Table, list[Register[Any]]] = {}
    for register in registers:
        tables.setdefault(register.table, []).append(register)
    found = []
    for wanted in tables.values():
        groups: list[list[Register[Any]]] = []
        for register in sorted(wanted, key=lambda each: each.address):
            if groups and most_gap >= 0 and joins(drive, groups[-1], register, most_gap):
                groups[-1].append(register)
            else:
                groups.append([register])
        found += [Block.of(drive, group) for group in groups]
    return found


def joins(drive: Drive, group: Registers, register: Register[Any], most_gap: int) -> bool:
    between = range(end(group[-1]), register.address)
    known = {
        address
        for each in drive.registers.values()
        if each.table == register.table and each.readable
        for address in range(each.address, end(each))
    }
    allowed = drive.readable_gaps.get(register.table, range(0))
    return (
        len(between) <= most_gap
        and end(register) - group[0].address <= drive.most_registers.get(register.table, 1)
        and all(address in known or address in allowed for address in between)
    )


def end(register: Register[Any]) -> int:
    return register.address + register.words


# ---- bus cycles ----


def cycle(drives: Iterable[Drive], of_drive: dict[Drive, Iterable[Block]]) -> float:
    """Return the time in s to read all blocks once, in this order of the drives."""
    exchanges = [Planned(drive, block) for drive in drives for block in of_drive[drive]]
    return sum(
        gap(exchanges[at - 1].drive, each.drive) + sending(each.drive, each.block) + each.drive.response_delay
        for at, each in enumerate(exchanges)
    )


def row(name: str, ours: Sequence[float], theirs: Sequence[float]) -> list[str]:
    savings = [1 - our / their for our, their in zip(ours, theirs, strict=True)]
    worse = sum(saving < -1e-9 for saving in savings)
    return [
        name,
        f"{sum(theirs):.2f}",
        f"{mean(savings):.1%}",
        f"{median(savings):.1%}",
        f"{max(savings):.1%}",
        str(worse),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plants", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    tables.heading(
        f"{arguments.plants} random plants of the {len(MODELS)} models: seconds for all bus cycles."
    )

    lot = random.Random(arguments.seed)
    plants = [plant(lot) for _ in range(arguments.plants)]

    def all_cycles(plan: Callable[[Drive, Registers], Iterable[Block]]) -> list[float]:
        return [
            cycle(
                cycle_order(drive for drive, _ in plant),
                {drive: plan(drive, wanted) for drive, wanted in plant},
            )
            for plant in plants
        ]

    ours = all_cycles(blocks)
    by_gap = {most: all_cycles(partial(merged, most_gap=most)) for most in GAPS}
    best = min(GAPS, key=lambda most: sum(by_gap[most]))
    rivals = {
        "one request per register": all_cycles(lambda drive, wanted: merged(drive, wanted, -1)),
        "contiguous merging": by_gap[0],
        f"the best gap for all plants: {best}": by_gap[best],
        "the best gap for each plant": [min(cycles) for cycles in zip(*by_gap.values(), strict=True)],
        "the plant file's order": [
            cycle((drive for drive, _ in each), {drive: blocks(drive, wanted) for drive, wanted in each})
            for each in plants
        ],
    }
    columns = ("plan", "s", "mean saving", "median", "most", "worse")
    rows = [["multidrop", f"{sum(ours):.2f}", *[""] * 4]]
    tables.show(columns, rows + [row(name, ours, theirs) for name, theirs in rivals.items()])
    for name, theirs in rivals.items():
        if any(our > their + 1e-9 for our, their in zip(ours, theirs, strict=True)):
            raise AssertionError(f"{name} is better on some plant")
    print("\nworse: plants on which multidrop's plan takes longer than that of the row.")


if __name__ == "__main__":
    main()
