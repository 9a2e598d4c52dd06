"""The unit of each series in each segment of a history, from the metadata.

A series is a register of a drive. Here, the names of an enumeration's values count as a unit too. In a new
segment, a series' name may belong to another drive or family. Values in different units are never combined.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from typing import Any, NamedTuple

from multidrop.printable import is_whole
from multidrop.recording.format import described_registers, tables_in

Series = tuple[str, str]  # drive and register
Moment = int | datetime
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
RAW, NAMED = "raw count", "names"


class SeriesUnit(NamedTuple):
    """The unit of a register's values, or the names of an enumeration's numbers."""

    text: str  # such as "A"; "" for none; RAW for raw counts; NAMED for an enumeration
    names: tuple[tuple[str, object], ...] = ()


FileUnits = Mapping[Series, Sequence[SeriesUnit]]  # each series' units in one file, the oldest first


def units_by_series(metadata: object) -> dict[Series, SeriesUnit]:
    """Return the units of all series that a segment's metadata describes."""
    return {(drive, name): _unit_in(about) for drive, name, about in described_registers(metadata)}


def file_units_of(metadata: object) -> FileUnits:
    """Return the units of a file with one segment, from its metadata."""
    return {series: (unit,) for series, unit in units_by_series(metadata).items()}


def unit_texts_of(metadata: object) -> dict[Series, str]:
    """Return each series' text for the column `unit` of Parquet files and of messages to `multidrop hub`."""
    found = {}
    models = {drive: about.get("model") for drive, about in tables_in(metadata, "drives")}
    for (drive, register), unit in units_by_series(metadata).items():
        model = models[drive] if unit.text == NAMED else None
        found[drive, register] = f"{NAMED} of {model}" if model else unit.text
    return found


def _table(found: object) -> Mapping[str, Any]:
    return found if isinstance(found, dict) else {}


def _unit_in(about: Mapping[str, Any]) -> SeriesUnit:
    if names := _table(about.get("values")):
        return SeriesUnit(NAMED, tuple((name, str(number)) for name, number in names.items()))
    if "step" in about and about["step"] is None:
        return SeriesUnit(RAW)
    return SeriesUnit(str(about.get("unit") or ""))


def description_of(unit: SeriesUnit) -> dict[str, Any]:
    """Return metadata that describe a register with this unit, such as {"unit": "A"}."""
    if unit.text == RAW:
        return {"unit": "", "step": None}
    if unit.text == NAMED:
        return {"unit": "", "values": {name: _number(text) for name, text in unit.names}}
    return {"unit": unit.text}


def _number(text: object) -> object:
    try:
        return int(str(text))
    except ValueError:
        return text


class OtherColumn(NamedTuple):
    """The register name for a series' values in an earlier unit, such as "load [A]" for "load".

    It applies to one file of the history.
    """

    series: Series
    unit: str | None  # unit of the values; None: all values of the series in the file get the name
    column: str


class UnitHistory:
    """The newest unit of each series, and its earlier units.

    The averages in `Buckets` leave out values in earlier units. `History.read` returns such values with
    another register name, such as "load [A]". `series` None means all series that the segments describe.
    """

    def __init__(self, series: Iterable[Series] | None) -> None:
        self._known: dict[int, FileUnits] = {}
        self._series = None if series is None else list(series)
        self.newest: dict[Series, SeriesUnit] = {}
        self.left_out: dict[Series, list[str]] = {}
        self._columns: dict[tuple[Series, SeriesUnit], str] = {}

    def learn(self, known: Mapping[int, FileUnits]) -> None:
        """Add the units of new segments. Columns that were already assigned to a unit stay the same."""
        before: FileUnits | None = None
        for number in sorted(known.keys() - self._known.keys(), reverse=True):
            self._known[number] = found = known[number]
            if found != before:
                for one in found if self._series is None else self._series:
                    for unit in reversed(found.get(one, ())):
                        self._note(one, unit)
            before = found

    def _note(self, series: Series, unit: SeriesUnit) -> None:
        if self.newest.setdefault(series, unit) == unit:
            return
        others = self.left_out.setdefault(series, [])
        if unit.text not in others:
            others.append(unit.text)
        if (series, unit) not in self._columns:
            alike = sum(one == series and other.text == unit.text for one, other in self._columns)
            words = (unit.text or "no unit") + (f" {alike + 1}" if alike else "")
            self._columns[series, unit] = f"{series[1]} [{words}]"

    def unknown_of(self, numbers: Iterable[int]) -> list[int]:
        """Return those segments, by number, whose units were not added yet."""
        return [number for number in numbers if number not in self._known]

    def other_columns(self, number: int) -> list[OtherColumn]:
        """Return the register names for those values of this segment that are in an earlier unit."""
        known = self._known.get(number, {})
        return [
            OtherColumn(series, None if len(known[series]) == 1 else unit.text, column)
            for (series, unit), column in self._columns.items()
            if unit in known.get(series, ())
        ]

    def described(self, metadata: Mapping[str, Any]) -> dict[str, Any]:
        """Return the metadata with the units of all registers, including columns such as "load [A]"."""
        columns = {series: (series[1], unit) for series, unit in self.newest.items()}
        drives = {name: dict(about) for name, about in tables_in(metadata, "drives")}
        said = units_by_series(metadata)
        for (drive, _), (column, unit) in [
            *columns.items(),
            *((series, (column, unit)) for (series, unit), column in self._columns.items()),
        ]:
            if said.get((drive, column)) != unit:
                about = drives.setdefault(drive, {})
                about["registers"] = {**_table(about.get("registers")), column: description_of(unit)}
        return {**metadata, "drives": drives} if drives else dict(metadata)

    def unit_of(self, series: Series) -> str | None:
        """Return a series' newest unit as text; None if no segment's metadata describes the series."""
        return self.newest[series].text if series in self.newest else None

    def series_of(self, number: int) -> tuple[Series, ...]:
        """Return the series that have no values in an earlier unit in this segment."""
        return tuple(one for one in self._series or () if self._is_newest(one, number))

    def is_whole(self, first: int, last: int) -> bool:
        """Return True if all values in segments `first` to `last` have the newest unit of their series."""
        return not self.left_out or all(
            self._is_newest(one, number) for one in self.left_out for number in range(first, last + 1)
        )

    def _is_newest(self, series: Series, number: int) -> bool:
        units = self._known.get(number, {}).get(series, ())
        return all(unit == self.newest[series] for unit in units)


# ---- queries ----


class Query(NamedTuple):
    """Which rows to read: their series (None: all series), and their range of time in ns UTC."""

    series: Sequence[Series] | None
    begin: int
    end: int  # the time of each row is less


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
