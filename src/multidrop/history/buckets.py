"""Buckets: equal time intervals, each with the least, mean and greatest value of a register."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import count

from multidrop.history.folder import SECOND_NS, TEN_NS

STEPS_S = (10, 20, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 10800, 21600, 43200, 86400)
MOST_POINTS = 100_000
_BEFORE_ALL, _AFTER_ALL = -(1 << 64), 1 << 64  # in ns: before and after the time of every row
# an empty bucket: number of values, number of failed reads; sum, least and greatest of the values
_EMPTY = 0, 0, 0.0, math.inf, -math.inf
# Buckets of this length or more are rounded up to 10 s or more, and computed from the stored summaries of ten
# seconds. This costs a hundredth of computing them from rows, which shorter buckets need.
FINE_NS = 2 * SECOND_NS


@dataclass(frozen=True)
class Buckets:
    """A register's values in time buckets of equal length; each list has one entry per bucket.

    Bucket i starts at `begin + i * step`, in ns. In a bucket without values, `least`, `mean` and `most`
    are None, and `missed` is above 0 if the register was polled, else 0.

    If the register's unit changed in the range, only values with the newest unit are included. `unit` is that
    unit, if recorded. `left_out` lists the units of the excluded rows.
    """

    begin: int  # UTC in ns
    step: int  # in ns
    n: list[int]  # number of values in each bucket
    missed: list[int]  # number of failed reads in each bucket, and of values that are not finite
    least: list[float | None]
    mean: list[float | None]
    most: list[float | None]
    unit: str | None = None
    left_out: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.n)

    @property
    def times(self) -> list[int]:
        """The start of each bucket, UTC in ns."""
        return [self.begin + number * self.step for number in range(len(self))]


@dataclass(frozen=True)
class Grid:
    """The times of buckets of equal length that cover a range."""

    begin: int  # in ns
    step: int
    points: int

    @property
    def end(self) -> int:
        return self.begin + self.step * self.points

    @property
    def is_of_tens(self) -> bool:
        """True if every bucket starts and ends at a multiple of ten seconds."""
        return self.step % TEN_NS == 0 and self.begin % TEN_NS == 0

    def bucket_of(self, time: int) -> tuple[int, int, int]:
        """Return index, start and end of the bucket that contains `time`; outside the grid, index -1."""
        if time < self.begin:
            return -1, _BEFORE_ALL, self.begin
        if time >= self.end:
            return -1, self.end, _AFTER_ALL
        number = (time - self.begin) // self.step
        return number, self.begin + number * self.step, self.begin + (number + 1) * self.step


def grid_of(begin: int, end: int, points: int) -> Grid:
    """Return a grid of at most `points` buckets that cover the range from `begin` to `end`, in ns.

    A bucket length of 2 s or more is rounded up to a multiple of 10 s; the first bucket may then start before
    `begin`. Raises ValueError for an empty range, or for points outside 1 to 100000.
    """
    if not 1 <= points <= MOST_POINTS:
        raise ValueError(f"invalid points = {points}: write 1 to {MOST_POINTS}")
    if begin >= end:
        raise ValueError(f"empty range: it starts at {begin} ns and ends at {end} ns")
    least = -(-(end - begin) // points)
    if least < FINE_NS:
        return Grid(begin, least, -(-(end - begin) // least))
    for step in _handy_steps(least):
        first = begin // step * step
        needed = -(-(end - first) // step)
        if needed <= max(points, 2):  # even with `points` = 1, the range may overlap two aligned buckets
            return Grid(first, step, needed)
    raise AssertionError("unreachable: the bucket lengths have no limit")


def _handy_steps(least: int) -> Iterator[int]:
    """Yield round bucket lengths in ns, such as 10 s, 1 min or 1 day, from `least` upwards."""
    yield from (seconds * SECOND_NS for seconds in STEPS_S if seconds * SECOND_NS >= least)
    yield from (days * 86400 * SECOND_NS for days in count(max(2, least // (86400 * SECOND_NS))))


class Accumulator:
    """Collects one register's values, and counts its failed reads, in each bucket of a grid."""

    def __init__(self, grid: Grid) -> None:
        self._grid = grid
        self._n, self._missed = [0] * grid.points, [0] * grid.points
        self._sum = [0.0] * grid.points
        self._least, self._most = [math.inf] * grid.points, [-math.inf] * grid.points

    def add(self, bucket: int, n: int, missed: int, total: float, least: float, most: float) -> None:
        """Add `n` values, with their sum, least and greatest value, and `missed` failed reads to a bucket."""
        self._missed[bucket] += missed
        if n:
            self._n[bucket] += n
            self._sum[bucket] += total
            self._least[bucket] = min(self._least[bucket], least)
            self._most[bucket] = max(self._most[bucket], most)

    def add_rows(self, times: Iterable[int], values: Iterable[float], valid: Iterable[int]) -> None:
        """Add rows with times in ns; rows outside the grid are skipped. An invalid row is a failed read."""
        grid, bucket, begin, end = self._grid, -1, 0, 0
        n, missed, total, least, most = _EMPTY
        for time, value, is_valid in zip(times, values, valid, strict=True):
            if not begin <= time < end:
                if bucket >= 0:
                    self.add(bucket, n, missed, total, least, most)
                n, missed, total, least, most = _EMPTY
                bucket, begin, end = grid.bucket_of(time)
            if is_valid:
                n += 1
                total += value
                if value < least:
                    least = value
                if value > most:
                    most = value
            else:
                missed += 1
        if bucket >= 0:
            self.add(bucket, n, missed, total, least, most)

    def add_all(self, other: Accumulator) -> None:
        """Add the values of another accumulator with the same buckets."""
        gathered = zip(other._n, other._missed, other._sum, other._least, other._most, strict=True)
        for bucket, known in enumerate(gathered):
            self.add(bucket, *known)

    def buckets(self, unit: str | None = None, left_out: Iterable[str] = ()) -> Buckets:
        has = self._n
        return Buckets(
            self._grid.begin,
            self._grid.step,
            self._n,
            self._missed,
            _where(has, self._least),
            _where(has, [*map(_mean, has, self._sum, self._least, self._most)]),
            _where(has, self._most),
            unit,
            tuple(left_out),
        )


def _mean(n: int, total: float, least: float, most: float) -> float:
    """Return the mean of `n` values; it is between `least` and `most` even if `total` is rounded."""
    return min(max(total / n, least), most) if n else 0.0


def _where(has: Sequence[int], values: Sequence[float]) -> list[float | None]:
    return [value if n else None for n, value in zip(has, values, strict=True)]


class UnitBuckets:
    """The buckets of one register, separately for each unit in its rows.

    Only the rows that `multidrop hub` stores have a unit of their own.
    """

    def __init__(self, grid: Grid) -> None:
        self._grid = grid
        self._by_unit: dict[str, Accumulator] = {}
        self._newest_ns: dict[str, int] = {}
        self.without_unit = Accumulator(grid)

    def of_unit(self, unit: str | None, newest_ns: int) -> Accumulator:
        """Return the accumulator for rows with this unit. `newest_ns` is the time of their newest row."""
        if unit is None:
            return self.without_unit
        self._newest_ns[unit] = max(newest_ns, self._newest_ns.get(unit, newest_ns))
        return self._by_unit.setdefault(unit, Accumulator(self._grid))

    def buckets(self, unit: str | None, left_out: Sequence[str]) -> Buckets:
        """Return the buckets of the rows with this unit. None selects the unit of the newest row."""
        if unit is None and self._by_unit:
            unit, *others = sorted(self._by_unit, key=self._newest_ns.__getitem__, reverse=True)
            parts, left_out = [self._by_unit[unit]], others
        else:
            parts = [*self._by_unit.values()]
        for part in parts:
            self.without_unit.add_all(part)
        return self.without_unit.buckets(unit, left_out)
