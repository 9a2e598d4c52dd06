"""Suggest what would make a line fit: lower rates, a higher baud rate, fewer registers."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

from multidrop.drive.family import Drive
from multidrop.drive.register import Register
from multidrop.planning.blocks import Planned, planned
from multidrop.planning.prediction import Prediction, Rate, predict

SLOWER = 1.05  # by so much the periods grow


@dataclass(frozen=True)
class Suggestions:
    """Three changes, each of which makes the line fit by itself; None where it cannot."""

    every: tuple[tuple[float, float], ...]  # periods in s that are wanted, and what fits instead
    baudrate: tuple[int, tuple[Drive, ...]] | None  # and the drives that are to have it
    registers: int | None  # at most so many of each drive that does not fit

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
    """Return a duration as a plant file has it, such as "50 ms"."""
    return f"{seconds:g} s" if seconds >= 1 else f"{seconds * 1e3:g} ms"


def suggest(exchanges: Sequence[Planned], prediction: Prediction, switching: float = 0.0) -> Suggestions:
    """Return what would make these exchanges fit, of which `prediction` says that they do not.

    `switching` is as for `predict`.
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
    """Lengthen the periods that do not fit by one factor, from `least` on, until all fit.

    That ends: the others fit beside those that are lengthened, and fit better the rarer these come.
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
    """Round up to two digits."""
    digit = 10.0 ** (math.floor(math.log10(seconds)) - 1)
    return round(math.ceil(seconds / digit - 1e-9) * digit, 9)


def _baudrate(exchanges: Sequence[Planned], switching: float) -> tuple[int, tuple[Drive, ...]] | None:
    """Return the lowest baud rate that fits, and the drives that are slower now."""
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
    """Return the same drive with another baud rate."""
    return type(drive)(
        drive.address,
        name=drive.name,
        framing=drive.framing,
        baudrate=baudrate,
        format=drive.settings.format,
        silence=drive.agreed_silence,
    )


def _registers(exchanges: Sequence[Planned], tight: Sequence[Rate], switching: float) -> int | None:
    """Return with how many registers each rate that does not fit would; None where not with a single one."""
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
