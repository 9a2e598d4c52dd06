"""Poller: plan, schedule and lines together, turned into batches of columns.

The lines are kept busy by the core's own thread, which waits for nobody; one thread tends them all
when the core calls. Rows gather in the core, in chunks of bounded number; whoever takes them gets
the oldest first.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

from multidrop.bus import Bus
from multidrop.control.eeprom_ledger import Ledger
from multidrop.core import RowQueue
from multidrop.core.fork import register_at_fork
from multidrop.plant.model import Plant, PolledDrive
from multidrop.polling.batch import Batch
from multidrop.polling.polled_line import Codes, PolledLine
from multidrop.transport.clock import now_ns, sleep
from multidrop.transport.statistics import LineStatistics
from multidrop.transport.wakeup import Wake

LOOK_S = 0.05  # the longest that a line waits to be tended, or whoever wants rows to be told of them
REST_S = 0.5  # the same, where nobody waits for either
FILLING_NS = 10_000_000  # so long new rows gather before they are taken from a chunk that is not full
PARTING_NS = 1_000_000_000  # so long the end of the polling waits for what is under way


class Poller:
    """Polls a plant as its file says, from `with` on until the block is left.

    Raises LineError when a port cannot be opened; later failures are rows that say why a value is
    missing. Any thread may take batches, and add or remove drives; commands go through `bus(line)`, ahead
    of the polling, and are counted in `ledger` and noted in `audit`, as Bus says.
    """

    def __init__(
        self,
        plant: Plant,
        *,
        ledger: Ledger | Path | str | None = None,
        audit: Path | str | None = None,
    ) -> None:
        if not isinstance(plant, Plant):
            raise TypeError(f"Poller takes a Plant, such as load_plant('plant.toml') gives, not {plant!r}")
        self._codes = Codes()
        self._row_queue = RowQueue()
        self._wake = Wake()
        self._taken_ns = 0  # the newest rows
        self._is_watched = False  # somebody waits for `fileno`
        self._lines: list[PolledLine] = []
        self._closing = False
        self._changing = threading.Lock()  # one drive comes or goes at a time
        self._thread = threading.Thread(target=self._poll, name="multidrop poller", daemon=True)
        register_at_fork(self)
        try:
            for number, declared in enumerate(plant.lines):
                bus = Bus(declared.port, echo=declared.echo, ledger=ledger, audit=audit)
                self._lines.append(PolledLine(declared, number, bus, self._row_queue, self._codes))
        except BaseException:
            self.close()
            raise

    def forked(self) -> None:
        """In the child it is closed, and has no rows."""
        self._closing = True
        self._changing = threading.Lock()
        self._wake.close()

    def __enter__(self) -> Poller:
        for line in self._lines:
            line.start()
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Stop polling and close the ports; rows not yet taken can still be.

        What is under way is waited for, for a second at most; every slot that is over by now has a row.
        """
        if self._closing:
            return
        self._closing = True
        for line in self._lines:
            line.bus.leave()  # all of them at once
        if self._thread.is_alive():
            self._wake_up()
            self._thread.join()
        for line in self._lines:
            line.bus.tended(False)
        for line in self._lines:
            line.bus.part()  # before the port is closed, on which it stops motors
        given_up_ns = now_ns() + PARTING_NS
        while sum(line.end() for line in self._lines) and now_ns() < given_up_ns:
            sleep(0.001)
        for line in self._lines:
            line.close()
        self._wake.close()

    def _poll(self) -> None:
        called: Iterable[PolledLine] = self._lines
        while not self._closing:
            for line in called:
                line.tend(now_ns())
            if self._is_watched and self._row_queue.chunks:
                self._wake.set()
            now = now_ns()
            restless = [line for line in self._lines if not line.is_steady(now)]
            seconds = LOOK_S if restless or self._is_watched else REST_S
            numbers = self._row_queue.await_calls(seconds)
            lines = [self._lines[it] for it in numbers if it < len(self._lines)]
            called = dict.fromkeys([*restless, *lines])

    def _wake_up(self) -> None:
        """Call the thread by a number that no line has."""
        self._row_queue.call(len(self._lines))

    def add(self, line: str, polled: PolledDrive) -> None:
        """Poll one more drive on this line, from now on.

        Raises ValueError when there is no such line, or its name or address is taken.
        """
        with self._changing:
            names = {drive.name for bus in self.buses.values() for drive in bus.drives}
            if polled.drive.name in names:
                raise ValueError(f"another drive is called {polled.drive.name}; give every one its own name")
            self._line(line).add(polled)

    def remove(self, line: str, drive: str) -> None:
        """Poll the drive of this name no more; its motor goes on as it is.

        What is queued of it is still asked. What is known of it stays in memory until polling ends, for
        when the same PolledDrive is added again. Raises ValueError when there is none.
        """
        with self._changing:
            found = self._line(line)
            for it in found.bus.drives:
                if it.name == drive:
                    return found.remove(it)
        raise ValueError(f"there is no drive {drive!r} on line {line!r}")

    def _line(self, name: str) -> PolledLine:
        for line in self._lines:
            if line.name == name:
                return line
        raise ValueError(f"there is no line {name!r}; there are {', '.join(self.buses)}")

    @property
    def buses(self) -> dict[str, Bus]:
        """The lines' buses, by name."""
        return {polled.name: polled.bus for polled in self._lines}

    def bus(self, line: str) -> Bus:
        """The bus of the line with this name."""
        return self._line(line).bus

    def stop_on_exit(self) -> None:
        """Stop the drives of all lines, at once, when polling ends or the process does; see Bus."""
        for line in self._lines:
            line.bus.stop_on_exit()

    def fileno(self) -> int:
        """A descriptor that is readable while rows wait to be taken, for select or an asyncio loop."""
        self._is_watched = True
        self._wake_up()
        return self._wake.fileno()

    def take(self) -> Batch | None:
        """The oldest rows that wait, at once; None when there are none, or only just a few new ones."""
        now, chunks = now_ns(), self._row_queue.chunks
        if chunks < 2:
            if self._is_watched:
                self._wake.clear()
            if now - self._taken_ns < FILLING_NS and not self._closing:
                return None
            self._taken_ns = now
        columns = self._row_queue.take()
        return Batch(columns, self._codes.drives, self._codes.registers) if columns else None

    def batches(self, seconds: float | None = None, *, every: float = 0.1) -> Iterator[Batch]:
        """Batches as they come, about one `every` s, for `seconds` s or until the caller leaves off."""
        end_ns = None if seconds is None else now_ns() + round(seconds * 1e9)
        while end_ns is None or now_ns() < end_ns:
            sleep(every if end_ns is None else min(every, max(0.0, (end_ns - now_ns()) / 1e9)))
            while batch := self.take():
                yield batch

    def statistics(self) -> dict[str, LineStatistics]:
        """Of each line by name, since polling began or `reset_statistics`, also per drive; cheap."""
        return {line.name: line.bus.statistics() for line in self._lines}

    def reset_statistics(self) -> None:
        """Count from here on; `summary` is always since the beginning."""
        for line in self._lines:
            line.bus.reset_statistics()

    def summary(self) -> dict[str, Any]:
        """So far, per line and drive: exchanges, values, misses by reason, rates, utilisation."""
        lines = {line.name: line.summary() for line in self._lines}
        return {
            "lines": lines,
            "samples": sum(line["samples"] for line in lines.values()),
            "misses": sum(sum(line["misses"].values()) for line in lines.values()),
            "dropped": self._row_queue.dropped,
        }
