"""Quantities: what the values of a series are, by the metadata of the segments that hold them. Pure.

A name may be another drive's, or of another family, from one segment on. Values of two quantities are never
put together.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from multidrop.history.kept_series import Series

RAW, NAMED = "raw count", "names"


class Quantity(NamedTuple):
    """The unit of values, which may be "", or the names that their numbers stand for."""

    unit: str
    names: tuple[tuple[str, object], ...] = ()


Known = Mapping[Series, Quantity]


def quantities_of(metadata: object) -> dict[Series, Quantity]:
    """Return the quantity of each series that the metadata of a segment describes."""
    return {
        (drive, register): _quantity(about)
        for drive, described in _table(_table(metadata).get("drives")).items()
        for register, about in _table(_table(described).get("registers")).items()
        if isinstance(about, dict)
    }


def _table(found: object) -> Mapping[str, Any]:
    return found if isinstance(found, dict) else {}


def _quantity(about: Mapping[str, Any]) -> Quantity:
    if names := _table(about.get("values")):
        return Quantity(NAMED, tuple((name, str(number)) for name, number in names.items()))
    if "step" in about and about["step"] is None:
        return Quantity(RAW)
    return Quantity(str(about.get("unit") or ""))


class Parting:
    """The series of a question by the quantity that each has in the newest segment, and those left out."""

    def __init__(self, known: Mapping[int, Known], series: Iterable[Series]) -> None:
        self._known = known
        self._series = list(series)
        self.newest: dict[Series, Quantity] = {}
        self.left_out: dict[Series, list[str]] = {}
        for number in sorted(known, reverse=True):
            for one in self._series:
                self._note(one, known[number].get(one))

    def _note(self, series: Series, quantity: Quantity | None) -> None:
        if quantity is None or self.newest.setdefault(series, quantity) == quantity:
            return
        others = self.left_out.setdefault(series, [])
        if quantity.unit not in others:
            others.append(quantity.unit)

    def unit_of(self, series: Series) -> str | None:
        """Return the unit of its values; None where no segment says it."""
        return self.newest[series].unit if series in self.newest else None

    def series_of(self, number: int) -> tuple[Series, ...]:
        """Return the series whose values in this segment are of the newest quantity."""
        return tuple(one for one in self._series if self._is_newest(one, number))

    def is_whole(self, first: int, last: int) -> bool:
        """Return True where the values of all series are of their newest quantity in these segments."""
        return not self.left_out or all(
            self._is_newest(one, number) for one in self.left_out for number in range(first, last + 1)
        )

    def _is_newest(self, series: Series, number: int) -> bool:
        quantity = self._known.get(number, {}).get(series)
        return quantity is None or quantity == self.newest[series]
