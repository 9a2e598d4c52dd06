"""Poller: all lines of a plant, polled continuously, as batches of rows.

The lines are kept busy by the core's own thread; one thread here tends them all when the core calls.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar, overload

from multidrop.bus import Bus
from multidrop.control.eeprom_ledger import Ledger
from multidrop.control.exit_hook import exit_hook, give_signals_back, without_internals
from multidrop.core import Mastership, RowQueue
from multidrop.core.fork import register_at_fork
from multidrop.core.undisturbed import undisturbed
from multidrop.drive.family import Drive
from multidrop.drive.register import Register
from multidrop.errors import LineError, PollingFailed
from multidrop.plant.model import Plant, PlantLine, Polled, PolledDrive
from multidrop.polling.adoption import GONE, Adoption
from multidrop.polling.line_set import LineSet
from multidrop.polling.row_source import RowSource
from multidrop.toml_check import check_period
from multidrop.transport import clock
from multidrop.transport.aside_log import log_aside, traceback_of, words_of
from multidrop.transport.statistics import LineStatistics

LOOK_NS = 50_000_000  # between looks at the lines, while one of them or a reader of `fileno` needs them
BUSY_NS = 100_000_000  # the same, where they only have to be kept busy: a third of what is queued ahead
REST_NS = 500_000_000  # the same, where nothing is to be done
MOST_FAILURES = 8  # of the thread itself, in a row, before it gives up
FAILED_NS = 50_000_000  # between its attempts

_log = logging.getLogger("multidrop.polling")

D = TypeVar("D", bound=Drive)


def _plant_of(plant: Plant | Path | str) -> Plant:
    if isinstance(plant, Plant):
        return plant
    if not isinstance(plant, (Path, str)):
        raise TypeError(f"Poller takes a Plant or a plant file such as 'plant.toml', not {plant!r}")
    return Plant.load(plant)


class Poller(RowSource):
    """Polls a plant as its file says, from `with` on until the block is left.

    Raises LineError when a port cannot be opened; later failures are rows that say why a value is
    missing. An exception on one line, such as one of a user's own class, is logged, and that line is tried
    again later: `line_failures`. If polling itself fails, `take`, `batches` and `close` raise PollingFailed:
    `failure`. Any thread may take batches, and add or remove drives; commands go through `bus(line)`, ahead
    of the polling, and are counted in `ledger` and noted in `audit`, as Bus says. With a `mastership` nothing
    is sent on any line, and no port opened, unless that holds: each value that is due meanwhile has a row
    that says so.

    The logger `multidrop.line` has no polled frames: they never enter Python. `multidrop poll --capture`
    writes them to a file for Wireshark.
    """

    def __init__(
        self,
        plant: Plant | Path | str,
        *,
        ledger: Ledger | Path | str | None = None,
        audit: Path | str | None = None,
        stop_on_exit: bool = False,
        mastership: Mastership | None = None,
    ) -> None:
        plant = _plant_of(plant)
        row_queue = RowQueue()
        self._lines = LineSet(row_queue, ledger, audit, mastership)
        super().__init__(row_queue, self._lines.names)
        self._path = plant.path
        self._thread = threading.Thread(target=self._run, name="multidrop poller", daemon=True)
        self._look_ns = 0  # when lines that have not called are looked at again: each look costs them all
        self._is_failure_raised = False
        self._ending = threading.Lock()
        register_at_fork(self)
        try:
            self._fill(plant)
            if stop_on_exit:
                self.stop_on_exit()
        except BaseException:
            self._end()
            raise

    @undisturbed
    def _fill(self, plant: Plant) -> None:
        with self._changing:
            self._check_polling()  # whoever makes it may have been interrupted, and have closed it
            self._lines.fill(plant.lines)

    def forked(self) -> None:
        """Be closed in the child, without rows."""
        self._closing = True
        self._over, self._caller = threading.Event(), None
        self._over.set()
        self._changing = threading.Lock()
        self._ending = threading.Lock()
        self._wakeup.close()

    def __repr__(self) -> str:
        if self._closing:
            state = "closed"
        elif self.failure:
            state = str(self.failure)
        else:
            state = "polling" if self._thread.is_alive() else "not started"
        failing = {name: f", failing ({why})" for name, why in self.line_failures.items()}
        lines = ", ".join(
            f"{line.name}: {len(line.bus.drives)} drives{failing.get(line.name, '')}" for line in self._lines
        )
        return f"<Poller {state}; {lines or 'no lines'}>"

    def __enter__(self) -> Poller:
        try:
            self._start()
        except BaseException:  # then nobody leaves the block
            self._end()
            raise
        return self

    @undisturbed
    def _start(self) -> None:
        with self._changing:
            self._check_polling()
            for line in self._lines:
                line.start()
            self._thread.start()

    def __exit__(self, kind: object, error: BaseException | None, *trace: object) -> None:
        self._end()
        if isinstance(error, KeyboardInterrupt):
            without_internals(error)
        if error is not None:  # it goes on; other failures were logged
            self._caller, self._is_failure_raised = None, True
        self.close()

    def close(self) -> None:
        """Stop polling and close the ports; rows not yet taken can still be.

        Exchanges under way are waited for, for a second at most; every slot that is over by now has a row.
        Where a signal interrupts the wait for that, it is done all the same; called again, this waits again.
        A function that `on_batch` calls gets its last batches first. Raises its failure, if it had one, and
        PollingFailed if polling had failed; each once.
        """
        self._end()
        give_signals_back()
        if self._caller:
            self._caller.raise_failure()
        if self.failure and not self._is_failure_raised:
            self._is_failure_raised = True
            raise self.failure

    @undisturbed
    def _end(self) -> None:
        with self._ending:
            if not self._over.is_set():
                self._end_lines()
        if self._caller:
            self._caller.join()

    def _end_lines(self) -> None:
        self._closing = True
        for line in self._lines:
            line.bus.leave()  # all of them at once
        with self._changing:  # an adoption that is under way is waited for
            if self._thread.is_alive():
                self._call_thread()
                self._thread.join()
            self._lines.end(self._lines, "it is closed")
        self._wakeup.close()
        self._over.set()

    def _run(self) -> None:
        try:
            with self._lines.tended():
                self._poll()
        except BaseException as failure:  # else polling would end without a word
            self.failure = PollingFailed(f"polling has ended on all lines: {words_of(failure)}")
            self.failure.__cause__ = failure
            self._lines.end_polling()
            self._wakeup.set()
            log_aside(_log, logging.CRITICAL, "%s\n%s", self.failure, traceback_of(failure))

    def _poll(self) -> None:
        """Tend the lines until the poller is closed.

        Raises what goes wrong MOST_FAILURES times in a row: memory may be short for a moment.
        """
        failures = 0
        while not self._closing:
            try:
                self._tend_lines()
                failures = 0
            except BaseException:
                failures += 1
                if failures == MOST_FAILURES:
                    raise
                clock.sleep(FAILED_NS / 1e9)

    def _tend_lines(self) -> None:
        """Wait until lines call or are to be looked at, and tend them."""
        seconds = max(0, self._look_ns - clock.now_ns()) / 1e9
        called = self._lines.called(self._row_queue.await_calls(seconds))
        now = clock.now_ns()
        if now >= self._look_ns:
            restless = [line for line in self._lines if not line.is_steady(now)]
            called = list(dict.fromkeys([*restless, *called]))
            needs_looks = self._is_watched or not all(line.is_well(now) for line in restless)
            self._look_ns = now + (LOOK_NS if needs_looks else BUSY_NS if restless else REST_NS)
        for line in called:
            line.tend(clock.now_ns())
        if self._is_watched and self._row_queue.chunks:
            self._wakeup.set()

    # ---- lines and drives ----

    @property
    def plant(self) -> Plant:
        """The plant as it is polled now; its drives are those that are on the buses."""
        lines = tuple(replace(line.declared, drives=line.polled) for line in self._lines)
        return Plant(lines, self._path)

    @property
    def polled_since(self) -> dict[str, int]:
        """By name, since which `monotonic_ns` rows are of the drive that `plant` describes."""
        return {name: since_ns for line in self._lines for name, since_ns in line.since_ns.items()}

    def adopt(self, plant: Plant | Path | str) -> dict[str, LineError]:
        """Poll another plant from now on; return the lines whose port is not there, by name, and why.

        Every mistake in it raises ValueError (PlantError with all of them, NoSuchPort for a name that no port
        can have, OSError for an audit log that cannot be opened), and all stays as it was.

        A line whose description is the same goes on as if nothing had happened, and so does each drive of
        which nothing changes: it stays the same object, which `plant` has and `buses`, and what is known of
        its identity and its late replies is kept. Changed registers, rates and drives of a line with the same
        port take effect on the open port; a line with a new name keeps its port too. All else is let go of
        and opened anew. A port that is not there is tried again and again, as a lost one is, and its values
        are missed. What `add` and `set_rate` changed is as in the plant.

        What leaves: requests under way are ended, and their rows come; other calls that use the line fail
        with LineError, those of a drive with NotAttached, and what would move its motor with CancelledByStop.
        Stops under way are waited for. Motors go on as they are, unless `stop_on_exit` was called: then they
        are stopped before they leave, for nobody would later. One whose address is another family's now is
        not: the old family's stop may mean something else there.

        Names in batches keep their codes. Returns when all is done; other lines are polled meanwhile. Any
        thread may call this, one at a time.
        """
        wanted = _plant_of(plant)
        self._take_signals()
        return self._adopt(wanted)

    @undisturbed
    def _adopt(self, plant: Plant) -> dict[str, LineError]:
        with self._changing:
            self._check_polling()
            adoption = Adoption(self._lines, plant)
            self._path = plant.path
            return adoption.carry_out(start=self._thread.is_alive())

    def add_line(self, line: PlantLine) -> None:
        """Open one more line and poll it, from now on.

        Raises LineError when its port is not there, and ValueError where the plant with it would be wrong;
        then nothing has changed.
        """
        self._take_signals()
        self._add_line(line)

    def _take_signals(self) -> None:
        """Take the signals for lines that come, if this is the main thread: no other may."""
        if self._lines.stops_on_exit:
            with suppress(ValueError):
                exit_hook().take_signals()

    @undisturbed
    def _add_line(self, line: PlantLine) -> None:
        with self._changing:
            self._check_polling()
            plant = self.plant
            wanted = replace(plant, lines=(*plant.lines, line))
            adoption = Adoption(self._lines, wanted)
            failures = adoption.carry_out(start=False)
            added = self._lines.find(line.name)
            if failures:
                self._lines.let_go([added], GONE)
                raise failures[line.name]
            if self._thread.is_alive():
                added.start()

    @undisturbed
    def remove_line(self, name: str) -> None:
        """Poll a line no more, and close its port, as `adopt` does. Raises ValueError when there is none.

        While its stops, and what is under way, are waited for other lines come and go.
        """
        with self._changing:
            self._check_polling()
            leaving = self._lines.find(name)
        self._lines.wind_down([leaving])  # a stop may take half a minute
        with self._changing:
            if not self._closing and leaving in self._lines:
                self._lines.let_go([leaving], GONE)

    def _check_polling(self) -> None:
        if self._closing:
            raise ValueError("polling has ended: no line comes or goes any more")
        if self.failure:
            raise self.failure

    @overload
    def add(self, line: str, drive: PolledDrive) -> Drive: ...
    @overload
    def add(
        self,
        line: str,
        drive: D,
        poll: Iterable[Polled | Register[Any] | str] | None = None,
        *,
        every: float | None = None,
    ) -> D: ...
    def add(
        self,
        line: str,
        drive: Drive | PolledDrive,
        poll: Iterable[Polled | Register[Any] | str] | None = None,
        *,
        every: float | None = None,
    ) -> Drive:
        """Poll one more drive on this line from now on; return the drive.

        `poll` has registers or their names, and Polled for a register with a period of its own; without it,
        all readings are polled. `every` is the period in s, None for as fast as the line allows. Raises
        ValueError for an unknown line, or a name or an address that is taken.
        """
        polled = drive if isinstance(drive, PolledDrive) else PolledDrive(drive, poll, every=every)
        self._add(line, polled)
        return polled.drive

    @undisturbed
    def _add(self, line: str, polled: PolledDrive) -> None:
        with self._changing:
            names = {drive.name for bus in self.buses.values() for drive in bus.drives}
            if polled.drive.name in names:
                raise ValueError(f"another drive is called {polled.drive.name}; give every one its own name")
            self._lines.find(line).add(polled)

    @undisturbed
    def remove(self, line: str, drive: str) -> None:
        """Poll the drive of this name no more; its motor goes on as it is.

        What is queued of it is still asked. What is known of it stays in memory until polling ends, for
        when the same PolledDrive is added again. Raises ValueError when there is none.
        """
        with self._changing:
            polled = self._lines.find(line)
            for attached in polled.bus.drives:
                if attached.name == drive:
                    return polled.remove(attached)
        raise ValueError(f"there is no drive {drive!r} on line {line!r}")

    @undisturbed
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
            line, known = self._lines.find_drive(drive)
            line.set_rate(known, known.register(register) if isinstance(register, str) else register, every)

    def __getitem__(self, name: str) -> Drive:
        """Return the polled drive of this name. Raises KeyError if there is none."""
        try:
            return self._lines.find_drive(name)[1]
        except ValueError as unknown:
            raise KeyError(str(unknown)) from None

    @property
    def buses(self) -> dict[str, Bus]:
        """The lines' buses, by name."""
        return {line.name: line.bus for line in self._lines}

    def bus(self, line: str) -> Bus:
        """Return the bus of the line with this name."""
        return self._lines.find(line).bus

    def stop_on_exit(self) -> None:
        """Stop the drives of all lines, at once, when polling ends or the process does; see Bus.

        Also those of lines that come later, and of lines and drives that leave by `adopt` or `remove_line`.
        """
        exit_hook().take_signals()
        self._lines.stops_on_exit = True
        for line in self._lines:
            line.bus.stop_on_exit()

    # ---- how it went ----

    @property
    def line_failures(self) -> dict[str, str]:
        """By name, the lines on which polling raised an exception lately, and which; {}: none.

        Such a line is tried again, at most 30 s later. It counts as sound after 10 s without another one.
        """
        return {line.name: line.failure for line in self._lines if line.failure}

    def statistics(self) -> dict[str, LineStatistics]:
        """Return statistics by line and drive since polling began, or `reset_statistics`; cheap."""
        return {line.name: line.bus.statistics() for line in self._lines}

    def reset_statistics(self) -> None:
        """Count from here on; `summary` is always since the beginning."""
        for line in self._lines:
            line.bus.reset_statistics()

    @property
    def dropped(self) -> int:
        """The rows that came too fast for who takes them, so far."""
        return self._row_queue.dropped

    def summary(self) -> dict[str, Any]:
        """Return exchanges, values, misses by reason, rates and utilisation so far, by line and drive."""
        lines = {line.name: line.summary() for line in self._lines}
        return {
            "lines": lines,
            "samples": sum(line["samples"] for line in lines.values()),
            "misses": sum(sum(line["misses"].values()) for line in lines.values()),
            "dropped": self.dropped,
        }
