"""Kept series: rows of the series that were asked for lately, so that a live plot reads each batch once."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterable
from typing import NamedTuple

Series = tuple[str, str]  # drive and register
MOST_KEPT = 200_000  # rows of a segment: 4 MB
MOST_SERIES = 4096  # without rows too: names of none may be asked for


class SeriesRow(NamedTuple):
    """A row of a series that is known; None is a miss."""

    series: Series
    time: int  # UTC in ns
    value: float | None


class SeriesRows:
    """Rows of one series from a range of batches."""

    def __init__(self, first: int) -> None:
        self.first = self.past = first  # numbers of the first batch, and of the one behind the last
        self.times = array("q")
        self.values = array("d")
        self.valid = bytearray()

    def add(self, row: SeriesRow) -> None:
        self.times.append(row.time)
        self.values.append(0.0 if row.value is None else row.value)
        self.valid.append(row.value is not None)


class KeptSeries:
    """The rows of the series that were asked for last; `read` gives a batch's rows of some series."""

    def __init__(self, read: Callable[[int, frozenset[Series]], Iterable[SeriesRow]]) -> None:
        self._read = read
        self._kept: dict[Series, SeriesRows] = {}  # the one that was asked for last is the last

    def rows_of(self, series: Iterable[Series], batches: range) -> dict[Series, SeriesRows]:
        """Return the rows of each series in these batches, and maybe in others beside them."""
        if not batches:
            return {}
        found = {one: self._found(one, batches) for one in series}
        begin = min((rows.past for rows in found.values()), default=batches.stop)  # of what is to be read
        for number in range(begin, batches.stop):
            for row in self._read(number, frozenset(one for one in found if found[one].past <= number)):
                found[row.series].add(row)
        for rows in found.values():
            rows.past = max(rows.past, batches.stop)
        self._kept.update(found)
        while len(self._kept) > MOST_SERIES or self._rows() > MOST_KEPT:
            del self._kept[next(iter(self._kept))]
        return found

    def _rows(self) -> int:
        return sum(len(rows.times) for rows in self._kept.values())

    def _found(self, series: Series, batches: range) -> SeriesRows:
        """Return the rows that are kept, if these batches follow on them; else none, to be read anew."""
        rows = self._kept.pop(series, None)
        return rows if rows and rows.first <= batches.start <= rows.past else SeriesRows(batches.start)
