"""Read a segment that is not compacted yet: rows and ten-second summaries ("tens") of requested series."""

from __future__ import annotations

import threading
from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from math import isfinite
from pathlib import Path
from typing import NamedTuple

from multidrop.core.columns import find_codes
from multidrop.history.buckets import Accumulator, Grid
from multidrop.history.folder import TEN_NS
from multidrop.history.units import Series
from multidrop.polling.batch import Row
from multidrop.recording.arrow_decoder import RecordedColumns
from multidrop.recording.arrows import ArrowsTail, BatchPlace

MOST_TENS = 4096  # limit of series with cached ten-second summaries, because queries may name unknown series
MOST_KEPT = 200_000  # limit of cached rows per segment: 4 MB
MOST_SERIES = 4096  # limit of series with cached rows; requested series without rows count too

Ten = list[float]  # a summary: number of values, number of failed reads; sum, least, greatest value


class SeriesRow(NamedTuple):
    """A row of a series; the value None is a failed read, or a value that is not finite."""

    series: Series
    time: int  # UTC in ns
    value: float | None


class SeriesRows:
    """Rows of one series from a range of batches."""

    def __init__(self, first: int) -> None:
        self.first = self.past = first  # first batch number, and last batch number + 1
        self.times = array("q")
        self.values = array("d")
        self.valid = bytearray()

    def add(self, row: SeriesRow) -> None:
        self.times.append(row.time)
        self.values.append(0.0 if row.value is None else row.value)
        self.valid.append(row.value is not None)


class SeriesTens:
    """The ten-second summaries of one series. They include all batches with numbers below `past`."""

    __slots__ = ("by_number", "past")

    def __init__(self) -> None:
        self.past = 0
        self.by_number: dict[int, Ten] = {}  # key: ten-second intervals since 1970

    def add(self, row: SeriesRow) -> None:
        ten = self.by_number.setdefault(row.time // TEN_NS, [0, 0, 0.0, float("inf"), float("-inf")])
        value = row.value
        if value is None:
            ten[1] += 1
            return
        ten[0] += 1
        ten[2] += value
        if value < ten[3]:
            ten[3] = value
        if value > ten[4]:
            ten[4] = value


class IndexedBatch(NamedTuple):
    """A batch's place in the file, and the least and greatest time of its rows."""

    place: BatchPlace
    least: int
    most: int

    def may_have(self, begin: int, end: int) -> bool:
        """Return True if the batch may have rows with begin <= time < end, in ns."""
        return self.least < end and begin <= self.most


class GrowingSegment:
    """A segment, read up to its current end or to its first damaged part. `damage` describes the damage.

    Raises ValueError if the file is not a recording, and OSError.
    """

    def __init__(self, path: Path) -> None:
        self._tail = ArrowsTail(path)
        self._holders = 1
        self._changing = threading.RLock()
        self._batches: list[IndexedBatch] = []
        self._kept: dict[Series, SeriesRows] = {}  # the least recently requested series first
        self._tens: dict[Series, SeriesTens] = {}
        self.metadata = self._tail.metadata
        self.damage: str | None = None

    def hold(self) -> None:
        """Keep the file open until the matching call of `let_go`."""
        with self._changing:
            self._holders += 1

    def let_go(self) -> None:
        """Undo one call of `hold`. When all calls are undone, close the file."""
        with self._changing:
            self._holders -= 1
            if not self._holders:
                self._tail.close()

    @property
    def bounds(self) -> tuple[int, int]:
        """The least and the greatest time of the segment's rows, in ns UTC; (0, 0) without rows."""
        least = min((batch.least for batch in self._batches), default=0)
        return least, max((batch.most for batch in self._batches), default=0)

    @property
    def left_out(self) -> int:
        """The number of bytes of an incomplete batch at the segment's end."""
        return self._tail.left_out

    def read_new(self) -> None:
        """Read the batches written since the last call."""
        with self._changing:
            try:
                for columns, place in self._tail.new() if self.damage is None else ():
                    if len(columns.time):
                        self._batches.append(IndexedBatch(place, min(columns.time), max(columns.time)))
            except ValueError as damage:
                self.damage = str(damage)

    def batches(self, begin: int, end: int) -> list[IndexedBatch]:
        """Return the batches that may have rows with begin <= time < end, in ns."""
        return [batch for batch in self._batches if batch.may_have(begin, end)]

    def rows_of(
        self, batch: IndexedBatch, series: frozenset[Series] | None, begin: int, end: int
    ) -> list[Row]:
        """Return a batch's rows of the given series (None: all series) with begin <= time < end, in ns."""
        columns = self._tail.again(batch.place)
        wanted = None if series is None else _codes(columns.drives, columns.registers, series)
        return list(_rows(columns, wanted, begin, end))

    def gather(self, found: Mapping[Series, Accumulator], grid: Grid) -> None:
        """Add this segment's rows of the series in `found` to the accumulators, in the buckets of `grid`."""
        with self._changing:
            if grid.is_of_tens:
                self._gather_tens(found, grid)
            else:
                self._gather_rows(found, grid)

    def _gather_rows(self, found: Mapping[Series, Accumulator], grid: Grid) -> None:
        if batches := self._batches_between(grid.begin, grid.end):
            for series, rows in self._rows_in(batches, found).items():
                found[series].add_rows(rows.times, rows.values, rows.valid)

    def _rows_in(self, batches: range, series: Iterable[Series]) -> dict[Series, SeriesRows]:
        """Return each series' rows in these batches, and maybe in others that a former query read.

        The rows of recently requested series are cached, so that a live plot reads each batch once.
        """
        found = {}
        for one in series:
            rows = self._kept.pop(one, None)
            if rows is None or not rows.first <= batches.start <= rows.past:
                rows = SeriesRows(batches.start)
            found[one] = rows
        self._catch_up(found, batches.stop)
        self._kept |= found
        while len(self._kept) > MOST_SERIES or sum(len(one.times) for one in self._kept.values()) > MOST_KEPT:
            del self._kept[next(iter(self._kept))]
        return found

    def _batches_between(self, begin: int, end: int) -> range:
        """Return the range of batch numbers that includes all batches with rows in this time range."""
        found = [number for number, batch in enumerate(self._batches) if batch.may_have(begin, end)]
        return range(found[0], found[-1] + 1) if found else range(0)

    def _gather_tens(self, found: Mapping[Series, Accumulator], grid: Grid) -> None:
        if len(self._tens) > MOST_TENS:
            self._tens.clear()
        self._tens = {one: SeriesTens() for one in found} | self._tens
        self._catch_up(self._tens, len(self._batches))
        for series, into in found.items():
            for number, (n, missed, *sums) in self._tens[series].by_number.items():
                if grid.begin <= number * TEN_NS < grid.end:
                    into.add((number * TEN_NS - grid.begin) // grid.step, int(n), int(missed), *sums)

    def _catch_up(self, series: Mapping[Series, SeriesTens | SeriesRows], end: int) -> None:
        """Add to each series its rows from the batches up to number `end` that it does not include yet."""
        for number in range(min((one.past for one in series.values()), default=end), end):
            behind = frozenset(name for name, one in series.items() if one.past <= number)
            for row in self._read(number, behind):
                series[row.series].add(row)
        for one in series.values():
            one.past = max(one.past, end)

    def _read(self, number: int, series: frozenset[Series]) -> Iterator[SeriesRow]:
        columns = self._tail.again(self._batches[number].place)
        for at in _places(columns, _codes(columns.drives, columns.registers, series)):
            name = columns.drives[columns.drive[at]], columns.registers[columns.register[at]]
            value = columns.value[at]
            is_known = _is_set(columns.valid, at) and isfinite(value)
            yield SeriesRow(name, columns.time[at], value if is_known else None)


def _is_set(bits: bytes | None, at: int) -> bool:
    return bits is None or bool(bits[at >> 3] >> (at & 7) & 1)


@lru_cache(maxsize=64)
def _codes(
    drives: tuple[str, ...], registers: tuple[str, ...], series: frozenset[Series]
) -> frozenset[tuple[int, int]]:
    """Return the indexes of each series' drive in `drives` and of its register in `registers`."""
    known = {drive for drive, _ in series}
    return frozenset(
        (drive_code, code)
        for drive_code, drive in enumerate(drives)
        if drive in known
        for code, register in enumerate(registers)
        if (drive, register) in series
    )


def _places(columns: RecordedColumns, wanted: frozenset[tuple[int, int]] | None) -> Sequence[int]:
    """Return the indexes of the rows whose drive and register are in `wanted`; None means all rows."""
    if wanted is None:
        return range(len(columns.time))
    return find_codes(columns.drive, columns.register, wanted)


def _rows(
    columns: RecordedColumns, wanted: frozenset[tuple[int, int]] | None, begin: int, end: int
) -> Iterator[Row]:
    for at in _places(columns, wanted):
        time = columns.time[at]
        if begin <= time < end:
            yield Row(
                time,
                columns.monotonic_ns[at],
                columns.uncertainty_ns[at] if _is_set(columns.certain, at) else None,
                columns.drives[columns.drive[at]],
                columns.registers[columns.register[at]],
                columns.value[at] if _is_set(columns.valid, at) else None,
                columns.statuses[columns.status[at]],
            )
