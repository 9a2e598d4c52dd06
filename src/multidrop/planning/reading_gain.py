"""Find what stated gaps would save: addresses without registers that one request may read across."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from multidrop.drive.family import Drive
from multidrop.drive.register import COIL, DISCRETE, HOLDING, HOLDING_MULTIPLE, INPUT, Register, Table
from multidrop.drive.request import readable_addresses, stated_gaps
from multidrop.planning.blocks import Planned, planned, sending
from multidrop.planning.bus_time import silence

WORTH_SAYING = 0.02  # of the time
_NAMES = {
    HOLDING: "HOLDING",
    HOLDING_MULTIPLE: "HOLDING",
    INPUT: "INPUT",
    COIL: "COIL",
    DISCRETE: "DISCRETE",
}


@dataclass(frozen=True)
class ReadingGain:
    """Gaps that a class does not state, and the requests and seconds of its reads with and without them."""

    drive: Drive
    gaps: tuple[tuple[Table, range], ...]
    requests: int
    seconds: float
    requests_now: int
    seconds_now: float

    def __str__(self) -> str:
        requests = "request" if self.requests == 1 else "requests"
        return (
            f"{self.requests} {requests} with {self._declaration()} instead of {self.requests_now}: "
            f"{self.seconds:.3f} s instead of {self.seconds_now:.3f} s; "
            f"state them if the document allows reading there"
        )

    def _declaration(self) -> str:
        """Return the gaps as the family's file or class would have them."""
        named = [(_NAMES.get(table, table.name), gap) for table, gap in self.gaps]
        if self.drive.declared_in:
            in_file = (f"{name.lower()} = [0x{gap[0]:X}, 0x{gap[-1]:X}]" for name, gap in named)
            return f"gaps = {{ {', '.join(in_file)} }}"
        in_class = (f"{name}: range(0x{gap.start:X}, 0x{gap.stop:X})" for name, gap in named)
        return f"readable_gaps = {{{', '.join(in_class)}}}"


def reading_gain(drive: Drive, wanted: Iterable[tuple[Register[Any], float | None]]) -> ReadingGain | None:
    """Return what stated gaps would save where the class states none; None where that is next to nothing."""
    wanted = list(wanted)
    before = planned(drive, wanted)
    unstated = {
        register.table.read_space: register.table
        for register, _ in wanted
        if not stated_gaps(drive, register.table)
    }
    freer = copy.copy(drive)
    everywhere = dict.fromkeys(unstated.values(), range(0x10000))
    freer.readable_gaps = {**drive.readable_gaps, **everywhere}  # type: ignore[misc]
    after = planned(freer, wanted)
    gaps = [(table, crossed) for table in everywhere if (crossed := _crossed(drive, table, after))]
    seconds, now = _seconds(after), _seconds(before)
    if not gaps or seconds > (1 - WORTH_SAYING) * now:
        return None
    return ReadingGain(drive, tuple(gaps), len(after), seconds, len(before), now)


def _crossed(drive: Drive, table: Table, found: Sequence[Planned]) -> range:
    """Return the addresses, from the first to the last, that are read without being declared."""
    family: Any = type(drive)
    readable = readable_addresses(family, table)
    blocks = [one.block for one in found if one.block.table.read_space == table.read_space]
    new = [at for one in blocks for at in range(one.start, one.start + one.count) if at not in readable]
    return range(min(new), max(new) + 1) if new else range(0)


def _seconds(found: Sequence[Planned]) -> float:
    return sum(silence(one.drive) + sending(one.drive, one.block) + one.drive.response_delay for one in found)
