"""Told units: a register's buckets where rows themselves say their unit, as those of a fleet's hub do."""

from __future__ import annotations

from collections.abc import Sequence

from multidrop.history.buckets import Accumulator, Buckets, Grid


class UnitBuckets:
    """The buckets of one register: for each unit that rows told, and for those that told none."""

    def __init__(self, grid: Grid) -> None:
        self._grid = grid
        self._told: dict[str, Accumulator] = {}
        self._newest_ns: dict[str, int] = {}
        self.untold = Accumulator(grid)

    def told(self, unit: str | None, newest_ns: int) -> Accumulator:
        """Return the buckets of rows of this unit, the newest of which has this time."""
        if unit is None:
            return self.untold
        self._newest_ns[unit] = max(newest_ns, self._newest_ns.get(unit, newest_ns))
        return self._told.setdefault(unit, Accumulator(self._grid))

    def buckets(self, unit: str | None, left_out: Sequence[str]) -> Buckets:
        """Return all as of a unit that is known by other means; None is the newest that was told."""
        if unit is None and self._told:
            unit, *others = sorted(self._told, key=self._newest_ns.__getitem__, reverse=True)
            parts, left_out = [self._told[unit]], others
        else:
            parts = [*self._told.values()]
        for part in parts:
            self.untold.add_all(part)
        return self.untold.buckets(unit, left_out)
