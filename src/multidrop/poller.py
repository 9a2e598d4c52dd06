"""Poller: polls all lines of a plant continuously, and delivers the values as batches of rows.

The core's own thread carries out the exchanges. One Python thread queues new exchanges for all lines and
handles lost ports, whenever the core requests it.
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
from multidrop.core import (
    REALTIME_ENDED,
    WHY_NOT_NICE,
    Mastership,
    Realtime,
    RowQueue,
    why_not_realtime,
)
from multidrop.core.process import register_at_fork, undisturbed
from multidrop.drive.family import Drive
from multidrop.drive.register import Register
from multidrop.errors import LineError, PollingFailed
from multidrop.plant.loader import check_channels
from multidrop.plant.model import Plant, PlantLine, Polled, PolledDrive
from multidrop.polling.added_rows import AddedRows
from multidrop.polling.adoption import GONE, Adoption
from multidrop.polling.line_set import LineSet
from multidrop.polling.row_source import RowSource
from multidrop.toml_check import check_period
from multidrop.transport import clock
from multidrop.transport.aside_log import log_aside, traceback_of, words_of
from multidrop.transport.statistics import LineStatistics

# interval between checks of the lines, if a line has a problem, or if the program has called `fileno`
LOOK_NS = 50_000_000
# the same interval if realtime scheduling was granted, so that values reach the program earlier
PROMPT_NS = 20_000_000
# interval between checks of the lines, if lines only need new exchanges; shorter than AHEAD_NS, so that no
# line runs out of queued exchanges
BUSY_NS = 100_000_000
REST_NS = 500_000_000  # interval between checks of the lines, if no line needs attention
MOST_FAILURES = 8  # consecutive failures of the poller's thread before polling ends
FAILED_NS = 50_000_000  # pause after a failure of the poller's thread

_log = logging.getLogger("multidrop.polling")

D = TypeVar("D", bound=Drive)


def _plant_of(plant: Plant | Path | str) -> Plant:
    if isinstance(plant, Plant):
        return plant
    if not isinstance(plant, (Path, str)):
        raise TypeError(f"Poller takes a Plant or a plant file such as 'plant.toml', not {plant!r}")
    return Plant.load(plant)


class Poller(RowSource):
    """Polls a plant, or the plant of a file, within a `with` block.

    Iterate over it for batches of rows, with `for` or `async for`; `poller["pump-1"]` is a drive. Any thread
    may take batches, and add or remove drives. Reads, writes and verbs of its drives are sent before queued
    polling. `ledger`, `audit`, `stop_on_exit` and `mastership` are as in Bus.

    With `realtime`, or with the key `realtime` in the plant file, the core's thread is scheduled before all
    normal threads until the poller is closed. The threads that take batches then have the nice value -10. If
    the system refuses this, a warning is logged, and the poller works without it.

    Raises LineError if a port cannot be opened. Later failures appear as rows with the reason why a value is
    missing. An exception on one line, such as one in a user's own class, is logged, and the line is tried
    again (see `line_failures`). If polling itself fails, `take`, `batches` and `close` raise PollingFailed
    (see `failure`). Without its mastership the poller sends no request and opens no port; each value that is
    due then has a row with that reason.

    The logger `multidrop.line` does not log polled frames. `multidrop poll --capture` writes them to a file
    for Wireshark.
    """

    def __init__(
        self,
        plant: Plant | Path | str,
        *,
        ledger: Ledger | Path | str | None = None,
        audit: Path | str | None = None,
        stop_on_exit: bool = False,
        mastership: Mastership | None = None,
        realtime: bool = False,
    ) -> None:
        plant = _plant_of(plant)
        check_channels(plant)
        row_queue = RowQueue()
        self._is_realtime_given = realtime
        self._lines = LineSet(row_queue, ledger, audit, mastership)
        super().__init__(row_queue, self._lines.names, Realtime())
        self._path, self._totals = plant.path, plant.totals
        self._thread = threading.Thread(target=self._run, name="multidrop poller", daemon=True)
        self._look_ns = 0  # time of the next check of all lines
        self._is_failure_raised = False
        self._ending = threading.Lock()
        register_at_fork(self)
        try:
            self._want_realtime(plant)
            self._fill(plant)
            if stop_on_exit:
                self.stop_on_exit()
        except BaseException:
            self._end()
            raise

    @undisturbed
    def _fill(self, plant: Plant) -> None:
        with self._changing:
            self._check_polling()  # an interruption may have closed the poller already
            self._lines.fill(plant.lines)
            self._adopt_channels()

    def _want_realtime(self, plant: Plant) -> None:
        try:
            self._realtime.want(self._is_realtime_given or plant.realtime)
        except OSError as failure:
            log_aside(_log, logging.WARNING, "polling without realtime: %s", why_not_realtime(failure))

    def forked(self) -> None:
        """Mark the poller closed in a forked child, which gets no rows."""
        self._closing = True
        self._over, self._caller = threading.Event(), None
        self._over.set()
        self._added = AddedRows(self._names)
        self._realtime = Realtime()
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
        except BaseException:  # close here, because Python does not call __exit__ if __enter__ fails
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
            self._is_started = True

    def __exit__(self, kind: object, error: BaseException | None, *trace: object) -> None:
        self._end()
        if isinstance(error, KeyboardInterrupt):
            without_internals(error)
        if error is not None:  # the error of the `with` block propagates; other failures were logged
            self._caller, self._is_failure_raised = None, True
        self.close()

    def close(self) -> None:
        """Stop polling and close the ports. Rows that are not taken yet can still be taken.

        Waits up to a second for exchanges in flight; every value due before the call has a row. Then waits up
        to 2 s until the totals of channels are on the disk. If a signal interrupts the wait, the closing
        still completes; a second call of `close` waits until the closing is complete. The function given to
        `on_batch` gets its last batches first. Raises that function's failure, and PollingFailed if polling
        had failed; neither is raised a second time.
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
        self._added.save()

    def _end_lines(self) -> None:
        self._closing = True
        for line in self._lines:
            line.bus.leave()  # start the stops of all lines before waiting for any
        with self._changing:  # waits until a call of `adopt` on another thread is complete
            if self._thread.is_alive():
                self._call_thread()
                self._thread.join()
            self._lines.end(self._lines, "it is closed")
            self._realtime.want(False)
        self._wakeup.close()
        self._over.set()

    def _run(self) -> None:
        try:
            self._poll()
        except BaseException as failure:  # any failure: polling must not end silently
            self.failure = PollingFailed(f"polling has ended on all lines: {words_of(failure)}")
            self.failure.__cause__ = failure
            self._lines.end_polling()
            self._wakeup.set()
            log_aside(_log, logging.CRITICAL, "%s\n%s", self.failure, traceback_of(failure))

    def _poll(self) -> None:
        """Queue exchanges and handle lost ports of all lines until the poller is closed.

        A failure is raised only after MOST_FAILURES in a row, because memory may be short for a moment.
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
        """Wait until the C core reports a line or the next check is due; then tend the lines that need it."""
        try:
            self._realtime.lower_nice()
        except OSError:
            log_aside(_log, logging.WARNING, WHY_NOT_NICE)
        seconds = max(0, self._look_ns - clock.now_ns()) / 1e9
        called = self._lines.called(self._row_queue.await_calls(seconds))
        now = clock.now_ns()
        if now >= self._look_ns:
            restless = [line for line in self._lines if not line.is_steady(now)]
            called = list(dict.fromkeys([*restless, *called]))
            needs_looks = self._is_watched or not all(line.is_well(now) for line in restless)
            look_ns = PROMPT_NS if self._realtime.is_held else LOOK_NS
            self._look_ns = now + (look_ns if needs_looks else BUSY_NS if restless else REST_NS)
            if self._realtime.has_ended():
                log_aside(_log, logging.WARNING, REALTIME_ENDED)
        for line in called:
            line.tend(clock.now_ns())
        if self._is_watched and self._row_queue.chunks:
            self._wakeup.set()

    # ---- lines and drives ----

    @property
    def plant(self) -> Plant:
        """The plant as it is polled now, with the drive objects that are on the buses."""
        lines = tuple(replace(line.declared, drives=line.polled) for line in self._lines)
        return Plant(lines, self._path, realtime=self._realtime.is_wanted, totals=self._totals)

    @property
    def polled_since(self) -> dict[str, int]:
        """The `monotonic_ns` since which each drive is polled, by drive name.

        Older rows may be from an earlier drive of the same name.
        """
        return {name: since_ns for line in self._lines for name, since_ns in line.since_ns.items()}

    def _adopt_channels(self) -> None:
        self._added.adopt(self.plant, self.polled_since)

    def adopt(self, plant: Plant | Path | str) -> dict[str, LineError]:
        """Poll another plant from now on; return the error of each line whose port cannot be opened, by name.

        A mistake in the plant raises ValueError and changes nothing: PlantError with all mistakes, NoSuchPort
        for an invalid port name, OSError for an audit log that cannot be opened.

        An unchanged line keeps its polling times. A changed line closes its port and opens it again, usually
        within half a second. Its stops in progress continue on the opened port; other calls in progress may
        raise LineError or Unconfirmed. An unchanged drive stays the same object, and its late replies are
        still recognised. A line with another port or other port options is removed, and a new line added. A
        port that cannot be opened is tried again like a lost one. The plant overrides earlier calls of `add`
        and `set_rate`.

        When lines and drives are removed, their requests in flight are completed and give rows. Other calls
        on a removed line raise LineError; calls of a removed drive raise NotAttached, or CancelledByStop if
        they move its motor. This call waits for the pending stops of removed drives. Motors continue as they
        are, unless `stop_on_exit` is set: then the drives are stopped before they are removed. A drive whose
        address becomes another family's is not stopped, because its stop may mean something else there.

        In batches, names keep their codes. The call returns when the change is complete; other lines are
        polled meanwhile. Any thread may call this; calls run one after another.
        """
        wanted = _plant_of(plant)
        check_channels(wanted)
        self._take_signals()
        return self._adopt(wanted)

    @undisturbed
    def _adopt(self, plant: Plant) -> dict[str, LineError]:
        with self._changing:
            self._check_polling()
            adoption = Adoption(self._lines, plant)
            self._path, self._totals = plant.path, plant.totals
            self._want_realtime(plant)
            failures = adoption.carry_out(start=self._thread.is_alive())
            self._adopt_channels()
            return failures

    def add_line(self, line: PlantLine) -> None:
        """Open one more line and poll it from now on.

        Raises LineError if its port cannot be opened, and ValueError if the plant would be invalid with this
        line; then the poller is unchanged.
        """
        self._take_signals()
        self._add_line(line)

    def _take_signals(self) -> None:
        """Install the signal handlers for `stop_on_exit`, if it was called. Only the main thread can."""
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
            self._adopt_channels()
            if self._thread.is_alive():
                added.start()

    @undisturbed
    def remove_line(self, name: str) -> None:
        """Stop polling a line and close its port, as `adopt` does. Raises ValueError for an unknown line.

        Other lines may be added and removed while this waits for stops and requests in flight.
        """
        with self._changing:
            self._check_polling()
            leaving = self._lines.find(name)
        self._lines.wind_down([leaving])  # not under the lock, because a stop may take half a minute
        with self._changing:
            if not self._closing and leaving in self._lines:
                self._lines.let_go([leaving], GONE)
                self._adopt_channels()

    def _check_polling(self) -> None:
        if self._closing:
            raise ValueError("polling has ended: no line or drive can be added or removed")
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

        `poll` lists registers or their names, or Polled for a register with a period of its own. Without
        `poll`, all readings are polled. `every` is the period in s of registers without their own; None means
        as fast as the line allows. Raises ValueError for an unknown line, or a name or an address that is
        already used.
        """
        polled = drive if isinstance(drive, PolledDrive) else PolledDrive(drive, poll, every=every)
        self._add(line, polled)
        return polled.drive

    @undisturbed
    def _add(self, line: str, polled: PolledDrive) -> None:
        with self._changing:
            self._check_polling()
            names = {drive.name for bus in self.buses.values() for drive in bus.drives}
            if polled.drive.name in names:
                raise ValueError(f"two drives are called {polled.drive.name}; give each its own name")
            self._lines.find(line).add(polled)
            self._adopt_channels()

    @undisturbed
    def remove(self, line: str, drive: str) -> None:
        """Stop polling the drive of this name; its motor continues as it is.

        Queued requests are still sent. The drive's learnt timing stays in memory in case the same PolledDrive
        is added again. Raises ValueError for an unknown drive.
        """
        with self._changing:
            polled = self._lines.find(line)
            for attached in polled.bus.drives:
                if attached.name == drive:
                    polled.remove(attached)
                    return self._adopt_channels()
        raise ValueError(f"there is no drive {drive!r} on line {line!r}")

    @undisturbed
    def set_rate(self, drive: Drive | str, register: Register[Any] | str | None, every: float | None) -> None:
        """Set the period of a polled register in s, or of all polled registers if `register` is None.

        `every` None means as fast as the line allows. Requests in flight are finished. Other registers keep
        their polling times; each changed register is polled now, and then at its new rate. The drive and the
        register may be given by name. The metadata of a recording keeps the rates of its start. Raises
        ValueError for a drive or register that is not polled, and for an invalid period.
        """
        if every is not None:
            check_period(every)
        with self._changing:
            if self._closing:
                raise ValueError("polling has ended: no rate can be set")
            line, known = self._lines.find_drive(drive)
            line.set_rate(known, known.register(register) if isinstance(register, str) else register, every)
            if self._added:
                self._adopt_channels()  # the rate determines how long values of channels stay current

    def __getitem__(self, name: str) -> Drive:
        """Return the polled drive of this name. Raises KeyError if there is none."""
        try:
            return self._lines.find_drive(name)[1]
        except ValueError as unknown:
            raise KeyError(str(unknown)) from None

    def __contains__(self, name: object) -> bool:
        """Return True if a polled drive has this name."""
        return any(drive.name == name for bus in self.buses.values() for drive in bus.drives)

    @property
    def buses(self) -> dict[str, Bus]:
        """The lines' buses, by name."""
        return {line.name: line.bus for line in self._lines}

    def bus(self, line: str) -> Bus:
        """Return the bus of the line with this name."""
        return self._lines.find(line).bus

    def stop_on_exit(self) -> None:
        """Stop the drives of all lines when polling or the process ends; see `Bus.stop_on_exit`.

        This includes drives of lines that are added later, and those that `adopt` or `remove_line` removes.
        """
        exit_hook().take_signals()
        self._lines.stops_on_exit = True
        for line in self._lines:
            line.bus.stop_on_exit()

    # ---- failures and statistics ----

    @property
    def line_failures(self) -> dict[str, str]:
        """The exceptions of lines on which polling failed recently, by the line's name.

        Polling of such a line is retried within 30 s. If there is no other exception for 10 s after the
        retry, the line is no longer listed.
        """
        return {line.name: line.failure for line in self._lines if line.failure}

    def statistics(self) -> dict[str, LineStatistics]:
        """Return the statistics of each line since polling started or `reset_statistics`, by line name."""
        return {line.name: line.bus.statistics() for line in self._lines}

    def reset_statistics(self) -> None:
        """Start the statistics again from zero; `summary` always counts from the start."""
        for line in self._lines:
            line.bus.reset_statistics()

    @property
    def dropped(self) -> int:
        """The number of rows that were dropped because they were not taken in time."""
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
