"""The quantity of each series in each segment of a history, from the metadata.

A series is a register of a drive; its quantity is a unit, or the names of its values. In a new segment, its
name may belong to another drive or family. Values of different quantities are never combined.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from typing import Any, NamedTuple

from multidrop.printable import is_whole

Series = tuple[str, str]  # drive and register
Moment = int | datetime
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
RAW, NAMED = "raw count", "names"


class Quantity(NamedTuple):
    """What a register's values measure: a unit ("" for none), or the names of an enumeration's numbers."""

    unit: str
    names: tuple[tuple[str, object], ...] = ()


Known = Mapping[Series, Sequence[Quantity]]  # quantities of each series in one file, oldest first


def quantities_of(metadata: object) -> dict[Series, Quantity]:
    """Return the quantity of each series that the metadata of a segment describes."""
    return {
        (drive, register): _quantity(about)
        for drive, described in _table(_table(metadata).get("drives")).items()
        for register, about in _table(_table(described).get("registers")).items()
        if isinstance(about, dict)
    }


def known_by(metadata: object) -> Known:
    """Return the quantities that one segment's metadata describes."""
    return {series: (quantity,) for series, quantity in quantities_of(metadata).items()}


def units_of(metadata: object) -> dict[Series, str]:
    """Return each series' text for the column `unit` of Parquet files and of messages to `multidrop hub`."""
    found = {}
    drives = _table(_table(metadata).get("drives"))
    for (drive, register), quantity in quantities_of(metadata).items():
        model = _table(drives.get(drive)).get("model") if quantity.unit == NAMED else None
        found[drive, register] = f"{NAMED} of {model}" if model else quantity.unit
    return found


def _table(found: object) -> Mapping[str, Any]:
    return found if isinstance(found, dict) else {}


def _quantity(about: Mapping[str, Any]) -> Quantity:
    if names := _table(about.get("values")):
        return Quantity(NAMED, tuple((name, str(number)) for name, number in names.items()))
    if "step" in about and about["step"] is None:
        return Quantity(RAW)
    return Quantity(str(about.get("unit") or ""))


def description_of(quantity: Quantity) -> dict[str, Any]:
    """Return the metadata that describes a register with this quantity."""
    if quantity.unit == RAW:
        return {"unit": "", "step": None}
    if quantity.unit == NAMED:
        return {"unit": "", "values": {name: _number(text) for name, text in quantity.names}}
    return {"unit": quantity.unit}


def _number(text: object) -> object:
    try:
        return int(str(text))
    except ValueError:
        return text


class OtherColumn(NamedTuple):
    """A separate column for rows of a series with an earlier quantity, in one file."""

    series: Series
    unit: str | None  # the unit of the column's rows; None: all rows of the series in this file
    column: str


class UnitHistory:
    """The quantity (unit, or names of values) that each series has now, and those that it had earlier.

    Buckets exclude values of earlier quantities.

    When rows are read, values of an earlier quantity get a separate column, such as "load [A]". `series` None
    means all series that the segments describe.
    """

    def __init__(self, known: Mapping[int, Known], series: Iterable[Series] | None = None) -> None:
        self._known: dict[int, Known] = {}
        self._series = None if series is None else list(series)
        self.newest: dict[Series, Quantity] = {}
        self.left_out: dict[Series, list[str]] = {}
        self._columns: dict[tuple[Series, Quantity], str] = {}
        self.learn(known)

    def learn(self, known: Mapping[int, Known]) -> None:
        """Add the quantities of more segments. An existing column keeps its quantity."""
        before: Known | None = None
        for number in sorted(known.keys() - self._known.keys(), reverse=True):
            self._known[number] = found = known[number]
            if found != before:
                for one in found if self._series is None else self._series:
                    for quantity in reversed(found.get(one, ())):
                        self._note(one, quantity)
            before = found

    def _note(self, series: Series, quantity: Quantity) -> None:
        if self.newest.setdefault(series, quantity) == quantity:
            return
        others = self.left_out.setdefault(series, [])
        if quantity.unit not in others:
            others.append(quantity.unit)
        if (series, quantity) not in self._columns:
            alike = sum(one == series and other.unit == quantity.unit for one, other in self._columns)
            words = (quantity.unit or "no unit") + (f" {alike + 1}" if alike else "")
            self._columns[series, quantity] = f"{series[1]} [{words}]"

    def unknown_of(self, numbers: Iterable[int]) -> list[int]:
        """Return the segment numbers whose quantities are not known yet."""
        return [number for number in numbers if number not in self._known]

    def renamed(self, number: int) -> list[OtherColumn]:
        """Return the separate columns for values with an earlier quantity in this segment."""
        known = self._known.get(number, {})
        return [
            OtherColumn(series, None if len(known[series]) == 1 else quantity.unit, column)
            for (series, quantity), column in self._columns.items()
            if quantity in known.get(series, ())
        ]

    def described(self, metadata: Mapping[str, Any]) -> dict[str, Any]:
        """Return the metadata with a correct description of every column, including the separate columns."""
        columns = {series: (series[1], quantity) for series, quantity in self.newest.items()}
        drives = {name: dict(_table(about)) for name, about in _table(metadata.get("drives")).items()}
        said = quantities_of(metadata)
        for (drive, _), (column, quantity) in [
            *columns.items(),
            *((series, (column, quantity)) for (series, quantity), column in self._columns.items()),
        ]:
            if said.get((drive, column)) != quantity:
                about = drives.setdefault(drive, {})
                about["registers"] = {**_table(about.get("registers")), column: description_of(quantity)}
        return {**metadata, "drives": drives} if drives else dict(metadata)

    def unit_of(self, series: Series) -> str | None:
        """Return the unit of a series' newest quantity; None if no segment states it."""
        return self.newest[series].unit if series in self.newest else None

    def series_of(self, number: int) -> tuple[Series, ...]:
        """Return the series whose values in this segment have the series' newest quantity."""
        return tuple(one for one in self._series or () if self._is_newest(one, number))

    def is_whole(self, first: int, last: int) -> bool:
        """Return True if all series have their newest quantity in the segments `first` to `last`."""
        return not self.left_out or all(
            self._is_newest(one, number) for one in self.left_out for number in range(first, last + 1)
        )

    def _is_newest(self, series: Series, number: int) -> bool:
        quantities = self._known.get(number, {}).get(series, ())
        return all(quantity == self.newest[series] for quantity in quantities)


# ---- arguments of a query ----


def parsed_series(series: str | Iterable[str] | None) -> list[Series] | None:
    """Return series as pairs of drive and register. Raises ValueError for an invalid name."""
    if series is None:
        return None
    found = []
    for name in [series] if isinstance(series, str) else series:
        drive, point, register = name.rpartition(".")
        if not (drive and point and register):
            raise ValueError(
                f"invalid series {name!r}: write a drive and a register, such as 'pump-1.motor_speed'"
            )
        found.append((drive, register))
    return list(dict.fromkeys(found))


def ns_of(moment: Moment) -> int:
    """Convert a moment (UTC in ns, or a datetime with a time zone) to UTC in ns."""
    if isinstance(moment, datetime):
        if moment.tzinfo is None:
            raise ValueError(f"{moment} has no time zone: write datetime(..., tzinfo=UTC)")
        return (moment - _EPOCH) // timedelta(microseconds=1) * 1000
    if not is_whole(moment):
        raise TypeError(f"a time must be UTC in ns, or a datetime with a time zone, not {moment!r}")
    return moment
