"""Suggest changes with which a line reaches its rates: lower rates, a higher baud rate, fewer registers."""

from __future__ import annotations

import copy
import math
from bisect import bisect_left
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

from multidrop.drive.family import Drive
from multidrop.drive.register import COIL, DISCRETE, HOLDING, HOLDING_MULTIPLE, INPUT, Register, Table
from multidrop.drive.request import readable_addresses, stated_gaps
from multidrop.planning.blocks import Planned, planned, sending
from multidrop.planning.bus_time import silence
from multidrop.planning.prediction import Prediction, Rate, predict

WORTH_SAYING = 0.02  # minimum fraction of the reading time that a suggestion must save
_NAMES = {
    HOLDING: "HOLDING",
    HOLDING_MULTIPLE: "HOLDING",
    INPUT: "INPUT",
    COIL: "COIL",
    DISCRETE: "DISCRETE",
}

SLOWER = 1.05  # factor from one attempted period to the next


@dataclass(frozen=True)
class Suggestions:
    """Three changes, each of which lets the line reach its rates. A change is None if it is not enough."""

    every: tuple[tuple[float, float], ...]  # pairs: wanted period, reachable period (s)
    # lowest sufficient baud rate, and the drives that now use a lower one
    baudrate: tuple[int, tuple[Drive, ...]] | None
    registers: int | None  # most registers per drive, for drives whose rates do not fit

    def __str__(self) -> str:
        pairs = (f'every = "{duration_text(new)}" instead of {duration_text(old)}' for old, new in self.every)
        found = [" and ".join(pairs)]
        if self.baudrate:
            found.append(
                f"baudrate = {self.baudrate[0]} for {', '.join(drive.name for drive in self.baudrate[1])}"
            )
        if self.registers:
            found.append(f"at most {self.registers} of these registers for each drive")
        return f"it would fit with {', or '.join(found)}"


def duration_text(seconds: float) -> str:
    """Return a duration as it is written in a plant file, such as "50 ms"."""
    return f"{seconds:g} s" if seconds >= 1 else f"{seconds * 1e3:g} ms"


def suggest(exchanges: Sequence[Planned], prediction: Prediction, switching: float = 0.0) -> Suggestions:
    """Return changes that would make these exchanges reach their rates.

    `prediction` shows which rates they do not reach. `switching` is the time in s that the port takes to
    change baud rate or format.
    """
    tight = [rate for rate in prediction.rates if not rate.fits]
    return Suggestions(
        _every(exchanges, tight, max(1.0, prediction.utilisation), switching),
        _baudrate(exchanges, switching),
        _registers(exchanges, tight, switching),
    )


def _every(
    exchanges: Sequence[Planned], tight: Sequence[Rate], least: float, switching: float
) -> tuple[tuple[float, float], ...]:
    """Lengthen the periods of the rates `tight`, which are not reached, until all rates are reached.

    Return pairs in s: the wanted period, and the longer period. All wanted periods are multiplied by the
    same factor, at least `least`. The search always ends: the other exchanges reach their rates already, and
    longer periods leave them more time.
    """
    hasty = {(rate.drive, rate.every) for rate in tight}
    wanted = sorted({rate.every for rate in tight if rate.every})
    for attempt in count():
        longer = {every: _rounded_up(least * every * SLOWER**attempt) for every in wanted}
        changed = [
            replace(planned, every=longer[planned.every])
            if planned.every and (planned.drive, planned.every) in hasty
            else planned
            for planned in exchanges
        ]
        if predict(changed, switching=switching).fits:
            break
    return tuple(longer.items())


def _rounded_up(seconds: float) -> float:
    """Round up to two significant digits."""
    digit = 10.0 ** (math.floor(math.log10(seconds)) - 1)
    return round(math.ceil(seconds / digit - 1e-9) * digit, 9)


def _baudrate(exchanges: Sequence[Planned], switching: float) -> tuple[int, tuple[Drive, ...]] | None:
    """Return the lowest baud rate at which all rates are reached, and the drives that now use a lower one."""
    wanted: dict[Drive, list[tuple[Register[Any], float | None]]] = {}
    for each in exchanges:
        wanted.setdefault(each.drive, []).extend((register, each.every) for register in each.block.registers)
    for baudrate in sorted({baudrate for drive in wanted for baudrate in drive.baudrates}):
        slow = [d for d in wanted if d.settings.baudrate < baudrate and baudrate in d.baudrates]
        fast = {drive: _at(drive, baudrate) for drive in slow}
        changed = [
            each for drive, registers in wanted.items() for each in planned(fast.get(drive, drive), registers)
        ]
        if slow and predict(changed, switching=switching).fits:
            return baudrate, tuple(slow)
    return None


def _at(drive: Drive, baudrate: int) -> Drive:
    """Return a copy of the drive with another baud rate."""
    return type(drive)(
        drive.address,
        name=drive.name,
        framing=drive.framing,
        baudrate=baudrate,
        format=drive.settings.format,
        silence=drive.agreed_silence,
    )


def _registers(exchanges: Sequence[Planned], tight: Sequence[Rate], switching: float) -> int | None:
    """Return the most registers per drive with which each rate is reached; None if even one is too many."""
    crowded = {(rate.drive, rate.every) for rate in tight}
    others = [each for each in exchanges if (each.drive, each.every) not in crowded]

    def is_too_many(count: int) -> bool:
        fewer = [
            each
            for rate in tight
            for each in planned(rate.drive, [(register, rate.every) for register in rate.registers[:count]])
        ]
        return not predict([*others, *fewer], switching=switching).fits

    most = max(len(rate.registers) for rate in tight)
    return bisect_left(range(1, most), True, key=is_too_many) or None


@dataclass(frozen=True)
class ReadingGain:
    """The cost of a drive's reads if its class declared these readable gaps, and their cost now.

    A readable gap is a range of addresses without declared registers that a request may read across.
    """

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
        """Return the text that would declare the gaps in the family's file or class."""
        named = [(_NAMES.get(table, table.name), gap) for table, gap in self.gaps]
        if self.drive.declared_in:
            in_file = (f"{name.lower()} = [0x{gap[0]:X}, 0x{gap[-1]:X}]" for name, gap in named)
            return f"gaps = {{ {', '.join(in_file)} }}"
        in_class = (f"{name}: range(0x{gap.start:X}, 0x{gap.stop:X})" for name, gap in named)
        return f"readable_gaps = {{{', '.join(in_class)}}}"


def reading_gain(drive: Drive, wanted: Iterable[tuple[Register[Any], float | None]]) -> ReadingGain | None:
    """Return the bus time that these reads would save if the class declared readable gaps.

    Return None if the class already declares some, or if the gain is too small.
    """
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
    """Return the range from the first to the last undeclared address in these blocks of `table`."""
    family: Any = type(drive)
    readable = readable_addresses(family, table)
    blocks = [one.block for one in found if one.block.table.read_space == table.read_space]
    new = [at for one in blocks for at in range(one.start, one.start + one.count) if at not in readable]
    return range(min(new), max(new) + 1) if new else range(0)


def _seconds(found: Sequence[Planned]) -> float:
    return sum(silence(one.drive) + sending(one.drive, one.block) + one.drive.response_delay for one in found)
