"""What would make a line fit that does not: lower rates, a higher baud rate, fewer registers. Pure."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from multidrop.drive.family import Drive
from multidrop.drive.register import Register
from multidrop.planning.blocks import Planned, planned
from multidrop.planning.prediction import Prediction, Rate, predict

SLOWER = 1.05  # by so much the periods grow
MOST_ATTEMPTS = 40


@dataclass(frozen=True)
class Remedies:
    """Each by itself makes the line fit; None where it cannot."""

    every: tuple[tuple[float, float], ...] | None  # periods in s that are wanted, and what fits instead
    baudrate: tuple[int, tuple[Drive, ...]] | None  # and whose it is to be
    registers: int | None  # at most so many of each drive's that do not fit

    def __str__(self) -> str:
        found = []
        if self.every:
            pairs = (
                f'every = "{duration_text(new)}" instead of {duration_text(old)}' for old, new in self.every
            )
            found.append(" and ".join(pairs))
        if self.baudrate:
            found.append(f"baudrate = {self.baudrate[0]} for {', '.join(it.name for it in self.baudrate[1])}")
        if self.registers:
            found.append(f"at most {self.registers} of these registers for each drive")
        if not found:
            return "no lower rate, higher baud rate or smaller number of registers makes it fit"
        return f"it would fit with {', or '.join(found)}"


def duration_text(seconds: float) -> str:
    """As a plant file has it, such as "50 ms"."""
    return f"{seconds:g} s" if seconds >= 1 else f"{seconds * 1e3:g} ms"


def remedies(exchanges: Sequence[Planned], prediction: Prediction, switching: float = 0.0) -> Remedies:
    """What would make these fit, of which this is predicted; `switching` is as for `predict`."""
    tight = [rate for rate in prediction.rates if not rate.fits]
    return Remedies(
        _every(exchanges, tight, max(1.0, prediction.utilisation), switching),
        _baudrate(exchanges, switching),
        _registers(exchanges, tight, switching),
    )


def _every(
    exchanges: Sequence[Planned], tight: Sequence[Rate], least: float, switching: float
) -> tuple[tuple[float, float], ...] | None:
    """Longer by one factor, of which this is the least that can do."""
    hasty = {(rate.drive, rate.every) for rate in tight}
    wanted = sorted({rate.every for rate in tight if rate.every})
    for attempt in range(MOST_ATTEMPTS):
        longer = {every: _rounded_up(least * every * SLOWER**attempt) for every in wanted}
        changed = [
            replace(it, every=longer[it.every]) if it.every and (it.drive, it.every) in hasty else it
            for it in exchanges
        ]
        if predict(changed, switching=switching).fits:
            return tuple(longer.items())
    return None


def _rounded_up(seconds: float) -> float:
    """To two digits."""
    digit = 10.0 ** (math.floor(math.log10(seconds)) - 1)
    return round(math.ceil(seconds / digit - 1e-9) * digit, 9)


def _baudrate(exchanges: Sequence[Planned], switching: float) -> tuple[int, tuple[Drive, ...]] | None:
    drives = dict.fromkeys(it.drive for it in exchanges)
    for baudrate in sorted({baudrate for drive in drives for baudrate in drive.baudrates}):
        slow = [it for it in drives if it.settings.baudrate < baudrate and baudrate in it.baudrates]
        fast = {it: _at(it, baudrate) for it in slow}
        changed = [
            one for drive in drives for one in planned(fast.get(drive, drive), _wanted(exchanges, drive))
        ]
        if slow and predict(changed, switching=switching).fits:
            return baudrate, tuple(slow)
    return None


def _at(drive: Drive, baudrate: int) -> Drive:
    """The same drive with another baud rate."""
    return type(drive)(
        drive.address,
        name=drive.name,
        framing=drive.framing,
        baudrate=baudrate,
        format=drive.settings.format,
        silence=drive.agreed_silence,
    )


def _wanted(exchanges: Sequence[Planned], drive: Drive) -> list[tuple[Register[Any], float | None]]:
    return [(register, it.every) for it in exchanges if it.drive is drive for register in it.block.registers]


def _registers(exchanges: Sequence[Planned], tight: Sequence[Rate], switching: float) -> int | None:
    crowded = {(rate.drive, rate.every) for rate in tight}
    others = [it for it in exchanges if (it.drive, it.every) not in crowded]

    def is_too_many(count: int) -> bool:
        fewer = [
            one
            for rate in tight
            for one in planned(rate.drive, [(register, rate.every) for register in rate.registers[:count]])
        ]
        return not predict([*others, *fewer], switching=switching).fits

    most = max(len(rate.registers) for rate in tight)
    return bisect_left(range(1, most), True, key=is_too_many) or None
