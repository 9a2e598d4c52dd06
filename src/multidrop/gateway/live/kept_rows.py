"""Kept rows: the newest rows of each register, as the hub keeps them, and how young they are. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

STALE_NS = 1_000_000_000  # a value is never stale before that,
STALE_PERIODS = 3  # nor before so many of its periods have passed

KeptRow = tuple[int, int, float, int]  # time, monotonic, value (of a miss without meaning), status
Known = tuple[str, KeptRow | None, KeptRow | None, bool]  # register, newest row, newest good one, is it fresh


class RegisterRows:
    """One register of one drive."""

    __slots__ = ("good", "intervals_ns", "least_ns", "newest", "since_ns")

    def __init__(self, least_ns: int, since_ns: int = 0) -> None:
        self.since_ns = since_ns  # rows of before are another drive's, which had the name
        self.newest: KeptRow | None = None
        self.good: KeptRow | None = None
        self.least_ns = least_ns  # of its intervals, as planned
        self.intervals_ns = 0, 0  # the latest two between samples with no miss between them

    @property
    def holds_ns(self) -> int:
        """The time for which its value is the present one.

        Its line may be slower than planned; but one long interval is a pause, and not how often it is asked.
        """
        return max(STALE_NS, STALE_PERIODS * max(self.least_ns, min(self.intervals_ns)))

    def is_fresh(self, now_ns: int, woke_ns: int) -> bool:
        """Return True while its newest value is the present one, and from after the machine woke."""
        if self.good is None or self.good[1] < woke_ns:
            return False
        age = now_ns - self.good[1]
        return age <= STALE_NS or age <= self.holds_ns


class FreshValues(Mapping[str, float]):
    """Values of one drive's registers that are young enough, looked up when they are asked for."""

    def __init__(self, cells: Mapping[str, RegisterRows], now_ns: int, woke_ns: int) -> None:
        self._cells = cells
        self._now_ns = now_ns
        self._woke_ns = woke_ns

    def __getitem__(self, register: str) -> float:
        found: float | None = self.get(register)
        if found is None:
            raise KeyError(register)
        return found

    def get(self, register: str, default: Any = None) -> Any:
        cell = self._cells.get(register)
        if cell is None or cell.good is None or not cell.is_fresh(self._now_ns, self._woke_ns):
            return default
        return cell.good[2]

    def __iter__(self) -> Iterator[str]:
        return (name for name in self._cells if name in self)

    def __len__(self) -> int:
        return sum(1 for _ in self)
