"""Newcomers: hold back rows of drives that a reload has changed, until the new plant is in effect."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

from multidrop import Batch, Plant, PolledDrive

MOST_WAITING = 250_000  # limit of rows held back: 12 MB; further rows wait in the core


class ChangingPlant(Protocol):
    """The properties of a poller that this module uses."""

    @property
    def plant(self) -> Plant: ...
    @property
    def polled_since(self) -> Mapping[str, int]: ...


class Newcomers:
    """The rows of drives that the reload has changed already: the previous plant does not describe them.

    A changed drive may keep its name, but have another family, with other units. All other rows pass.
    """

    def __init__(self) -> None:
        self._waiting: list[Batch] = []
        self._rows = 0

    @property
    def has_room(self) -> bool:
        return self._rows < MOST_WAITING

    def keep(self, batch: Batch, before: Plant, poller: ChangingPlant) -> Batch:
        """Hold back the rows that the plant `before` does not describe; return the others."""
        since_ns = _changed_since(before, poller)
        if not since_ns:
            return batch
        columns = batch.columns()
        codes = {code: since_ns[name] for code, name in enumerate(columns.drives) if name in since_ns}
        is_new = [
            drive in codes and asked_ns >= codes[drive]
            for drive, asked_ns in zip(columns.drive, columns.monotonic_ns, strict=True)
        ]
        new = [at for at, is_kept in enumerate(is_new) if is_kept]
        if not new:
            return batch
        self._waiting.append(batch.at(new))
        self._rows += len(new)
        return batch.at([at for at, is_kept in enumerate(is_new) if not is_kept])

    def release(self, feed: Callable[[Batch], object]) -> None:
        """Pass the rows held back to `feed`: the new plant is in effect."""
        waiting, self._waiting, self._rows = self._waiting, [], 0
        for batch in waiting:
            feed(batch)


def _changed_since(before: Plant, poller: ChangingPlant) -> dict[str, int]:
    """Return the drives that are polled differently than before, with the time of the change (ns)."""
    known = _drives(before)
    since_ns = poller.polled_since
    return {
        name: since_ns[name]
        for name, polled in _drives(poller.plant).items()
        if name in since_ns and not _is_as_before(known.get(name), polled)
    }


def _drives(plant: Plant) -> dict[str, PolledDrive]:
    return {polled.drive.name: polled for line in plant.lines for polled in line.drives}


def _is_as_before(known: PolledDrive | None, polled: PolledDrive) -> bool:
    """Return True if family, address and polled registers are the same, so that rows mean the same."""
    if known is None or type(known.drive) is not type(polled.drive):
        return False
    return known.drive.address == polled.drive.address and known.polls == polled.polls
