"""Poller: all lines of a plant, polled continuously, as batches of rows.

The lines are kept busy by the core's own thread; one thread here tends them all when the core calls.
Rows gather in the core, in chunks of bounded number, and are taken from there, the oldest first.
"""

from __future__ import annotations

import difflib
import threading
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from multidrop.bus import Bus
from multidrop.control.eeprom_ledger import Ledger
from multidrop.core import RowQueue
from multidrop.core.fork import register_at_fork
from multidrop.drive.family import Drive
from multidrop.drive.register import Register
from multidrop.plant.model import Plant, PolledDrive
from multidrop.polling.batch import Batch
from multidrop.polling.batch_caller import BatchCaller
from multidrop.polling.jobs import RowNames
from multidrop.polling.polled_line import PolledLine
from multidrop.toml_check import check_period
from multidrop.transport import clock
from multidrop.transport.statistics import LineStatistics
from multidrop.transport.wakeup import WakeUp

LOOK_S = 0.05  # between looks at the lines, while one of them or a reader of `fileno` needs them
REST_S = 0.5  # the same, where neither does
FILLING_NS = 10_000_000  # for which new rows gather before they are taken from a chunk that is not full
ENDING_NS = 1_000_000_000  # for which the end of the polling waits for exchanges under way


class Poller:
    """Polls a plant as its file says, from `with` on until the block is left.

    Raises LineError when a port cannot be opened; later failures are rows that say why a value is
    missing. Any thread may take batches, and add or remove drives; commands go through `bus(line)`, ahead
    of the polling, and are counted in `ledger` and noted in `audit`, as Bus says.

    The logger `multidrop.line` has no polled frames: they never enter Python. `multidrop poll --capture`
    writes them to a file for Wireshark.
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
        self._names = RowNames()
        self._row_queue = RowQueue()
        self._wakeup = WakeUp()
        self._is_watched = False  # somebody waits for `fileno`
        self._taken_ns = 0  # the newest rows
        self._lines: list[PolledLine] = []
        self._closing = False
        self._over = threading.Event()  # all lines are closed, and no row comes any more
        self._caller: BatchCaller | None = None
        self._changing = threading.Lock()  # one drive comes or goes at a time
        self._thread = threading.Thread(target=self._poll, name="multidrop poller", daemon=True)
        register_at_fork(self)
        try:
            for number, declared in enumerate(plant.lines):
                bus = Bus(
                    declared.port,
                    echo=declared.echo,
                    transaction=declared.ids,
                    ledger=ledger,
                    audit=audit,
                )
                self._lines.append(PolledLine(declared, number, bus, self._row_queue, self._names))
        except BaseException:
            self.close()
            raise

    def forked(self) -> None:
        """Be closed in the child, without rows."""
        self._closing = True
        self._over, self._caller = threading.Event(), None
        self._over.set()
        self._changing = threading.Lock()
        self._wakeup.close()

    def __repr__(self) -> str:
        state = "closed" if self._closing else "polling" if self._thread.is_alive() else "not started"
        lines = ", ".join(f"{line.name}: {len(line.bus.drives)} drives" for line in self._lines)
        return f"<Poller {state}; {lines or 'no lines'}>"

    def __enter__(self) -> Poller:
        for line in self._lines:
            line.start()
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._end()
        if error[0] is not None:  # it goes on; a failure of the caller's function was logged
            self._caller = None
        self.close()

    def close(self) -> None:
        """Stop polling and close the ports; rows not yet taken can still be.

        Exchanges under way are waited for, for a second at most; every slot that is over by now has a row.
        A function that `on_batch` calls gets its last batches first. Raises its failure, if it had one.
        """
        self._end()
        if self._caller:
            self._caller.raise_failure()

    def _end(self) -> None:
        if self._closing:
            return
        self._closing = True
        for line in self._lines:
            line.bus.leave()  # all of them at once
        if self._thread.is_alive():
            self._call_thread()
            self._thread.join()
        for line in self._lines:
            line.bus.tended(False)
        for line in self._lines:
            line.bus.part()  # before the port is closed, on which it stops motors
        given_up_ns = clock.now_ns() + ENDING_NS
        while sum(line.end() for line in self._lines) and clock.now_ns() < given_up_ns:
            clock.sleep(0.001)
        for line in self._lines:
            line.close()
        self._wakeup.close()
        self._over.set()
        if self._caller:
            self._caller.join()

    def _poll(self) -> None:
        called: Iterable[PolledLine] = self._lines
        while not self._closing:
            for line in called:
                line.tend(clock.now_ns())
            if self._is_watched and self._row_queue.chunks:
                self._wakeup.set()
            now = clock.now_ns()
            restless = [line for line in self._lines if not line.is_steady(now)]
            seconds = LOOK_S if restless or self._is_watched else REST_S
            numbers = self._row_queue.await_calls(seconds)
            lines = [self._lines[number] for number in numbers if number < len(self._lines)]
            called = dict.fromkeys([*restless, *lines])

    def _call_thread(self) -> None:
        """Wake the thread by a number that no line has."""
        self._row_queue.call(len(self._lines))

    # ---- lines and drives ----

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
            polled = self._line(line)
            for attached in polled.bus.drives:
                if attached.name == drive:
                    return polled.remove(attached)
        raise ValueError(f"there is no drive {drive!r} on line {line!r}")

    def set_rate(self, drive: Drive | str, register: Register[Any] | str | None, every: float | None) -> None:
        """Read a register of a drive every so many seconds from now on; with None all that are polled of it.

        `every` None is as fast as the line allows. Requests are planned anew; those under way are finished,
        registers whose rate stays keep their slots, and each changed one has its first slot now. The drive
        and the register may be given by their names. A recording's metadata keeps the rates that its plant
        began with. Raises ValueError for a drive or register that is not polled, and for no such time.
        """
        if every is not None:
            check_period(every)
        with self._changing:
            if self._closing:
                raise ValueError("polling has ended: no rate can be set")
            line, known = self._polled(drive)
            line.set_rate(known, known.register(register) if isinstance(register, str) else register, every)

    def _polled(self, drive: Drive | str) -> tuple[PolledLine, Drive]:
        """Return a drive that is polled, by itself or by its name, and its line."""
        drives = {known.name: (line, known) for line in self._lines for known in line.bus.drives}
        name = drive if isinstance(drive, str) else drive.name
        line, known = drives.get(name, (None, None))
        if line is None or known is None or drive not in (name, known):
            near = difflib.get_close_matches(name, drives, n=2)
            hint = (
                f"did you mean {' or '.join(near)}?" if near else f"there are {', '.join(drives) or 'none'}"
            )
            raise ValueError(f"{name} is not polled here; {hint}")
        return line, known

    def _line(self, name: str) -> PolledLine:
        for line in self._lines:
            if line.name == name:
                return line
        raise ValueError(f"there is no line {name!r}; there are {', '.join(self.buses)}")

    @property
    def buses(self) -> dict[str, Bus]:
        """The lines' buses, by name."""
        return {line.name: line.bus for line in self._lines}

    def bus(self, line: str) -> Bus:
        """Return the bus of the line with this name."""
        return self._line(line).bus

    def stop_on_exit(self) -> None:
        """Stop the drives of all lines, at once, when polling ends or the process does; see Bus."""
        for line in self._lines:
            line.bus.stop_on_exit()

    # ---- rows ----

    def fileno(self) -> int:
        """Return a descriptor that is readable while rows wait to be taken, for select or an asyncio loop."""
        self._is_watched = True
        self._call_thread()
        return self._wakeup.fileno()

    def take(self) -> Batch | None:
        """Return the oldest rows that wait, at once; None when there are none, or only a few new ones."""
        now, chunks = clock.now_ns(), self._row_queue.chunks
        if chunks < 2:
            if self._is_watched:
                self._wakeup.clear()
            if now - self._taken_ns < FILLING_NS and not self._closing:
                return None
            self._taken_ns = now
        columns = self._row_queue.take()
        return Batch(columns, self._names.drives, self._names.registers) if columns else None

    def batches(self, seconds: float | None = None, *, every: float = 0.1) -> Iterator[Batch]:
        """Yield batches as they come, about one in `every` s, for `seconds` s or until the caller stops.

        Once the poller is closed what is left comes at once, and then no more.
        """
        end_ns = None if seconds is None else clock.now_ns() + round(seconds * 1e9)
        is_over = False
        while not is_over and (end_ns is None or clock.now_ns() < end_ns):
            left = every if end_ns is None else max(0.0, (end_ns - clock.now_ns()) / 1e9)
            is_over = self._over.wait(min(every, left))
            while batch := self.take():
                yield batch

    def on_batch(self, function: Callable[[Batch], object], *, every: float = 0.1) -> None:
        """Call `function` with each of `batches()` on a thread of its own, until the poller is closed.

        It holds no line up, however slow it is: rows gather meanwhile, as many as `take` leaves, and further
        ones are dropped and counted in `summary()`. Closing waits until it has had the last batch. When it
        raises, that is logged at once, it is called no more, and closing raises the same. A batch goes to
        one taker: do not take others beside it. Raises ValueError for a second function.
        """
        if not callable(function):
            raise TypeError(f"on_batch takes a function of one batch, not {function!r}")
        with self._changing:
            if self._caller:
                raise ValueError("on_batch has a function already, which gets every batch")
            if self._closing:
                raise ValueError("polling has ended: no batches come any more")
            self._caller = BatchCaller(self.batches(every=every), function)

    # ---- how it went ----

    def statistics(self) -> dict[str, LineStatistics]:
        """Return statistics by line and drive since polling began, or `reset_statistics`; cheap."""
        return {line.name: line.bus.statistics() for line in self._lines}

    def reset_statistics(self) -> None:
        """Count from here on; `summary` is always since the beginning."""
        for line in self._lines:
            line.bus.reset_statistics()

    def summary(self) -> dict[str, Any]:
        """Return exchanges, values, misses by reason, rates and utilisation so far, by line and drive."""
        lines = {line.name: line.summary() for line in self._lines}
        return {
            "lines": lines,
            "samples": sum(line["samples"] for line in lines.values()),
            "misses": sum(sum(line["misses"].values()) for line in lines.values()),
            "dropped": self._row_queue.dropped,
        }
