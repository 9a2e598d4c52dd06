"""TestRun: carry out the steps of a test while its plant is polled, and abort at a limit.

Each drive's commands run on a separate thread. So do the recording and each callback that the caller passes
to `run`. The calling thread compares the rows with the limits, and starts each step at its planned time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing
from contextvars import copy_context
from dataclasses import dataclass, replace
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from typing import Any, ClassVar

from multidrop.bus import Bus
from multidrop.control.call import written_before
from multidrop.control.eeprom_ledger import Ledger
from multidrop.control.exit_hook import await_signal
from multidrop.control.outcome import Seen, Stopped
from multidrop.control.ramp import check_setpoint, checked_rate, ramp
from multidrop.drive.family import Drive
from multidrop.errors import BadReply, BusError, Expired, NoReply
from multidrop.plant.model import Plant, Polled, PolledDrive
from multidrop.poller import Poller
from multidrop.polling.batch import Rows, copied
from multidrop.recording import RecordingWriter, open_writer
from multidrop.recording.rows import phase_row, with_phases
from multidrop.runs.checks import RAMP_EVERY_S, check_step, misfits, silence_of
from multidrop.runs.loader import STOP, load_test
from multidrop.runs.model import RunPlan, RunStep, timeline
from multidrop.runs.watch import LimitWatch
from multidrop.transport import clock
from multidrop.transport.port_identity import is_simulated

LOOK_S = 0.01  # pause in s between two comparisons of new rows with the limits
STILL_S = 5.0  # a run is aborted if it compares no rows with its limits for this many seconds
LATE_S = 0.5  # s; if a step ends later than this, all later steps are delayed, and none gets shorter
UNKNOWN = "its line's stops failed; the log has the error"
SHORTEST_S = 1e-4  # shortest period of a polled register, in s
MOST_WAITING = 3000  # limit of batches (30 s or more) that wait for the recording or for a callback
# On a busy computer, a simulated drive may reply after the timeout.
SIMULATED_ATTEMPTS = 20  # limit of attempts to check or command a simulated drive
# If all lines are simulated, the default of the limit `silence` is at least this, in s.
SIMULATED_SILENCE_S = 60.0
ENDING_S = 10.0  # time in s that the end of a run waits for the recording and for each callback


@dataclass(frozen=True)
class RunResult:
    """The result of a run.

    `abort` is the reason why the run was aborted, or "". `stopped` has the result of each drive's stop.
    """

    abort: str
    stopped: Mapping[str, Stopped]

    @property
    def ok(self) -> bool:
        """True if all steps were carried out, and every motor was seen at rest."""
        return not self.abort and bool(self.stopped) and all(one.ok for one in self.stopped.values())


class _Aborted(Exception):
    """The run must end. The text of the exception says why."""


class TestRun:
    """The test of a test file or a RunPlan, which `run` carries out.

    All drives of the plant are polled. At the end of the run all drives are stopped, in the same way as by
    `Poller.stop_on_exit`. A run ends after the last step, at a limit, a fault or a failed command, on Ctrl-C,
    SIGTERM and any error. `ledger` and `audit` are those of Bus. `speed` is for drives that are simulated at
    this speed: all times of the test except `silence` are divided by it.

    Raises ValueError for mistakes in the test file, and PlantError for those in its plant file.
    """

    __test__: ClassVar[bool] = False  # pytest collects classes with names like this one

    def __init__(
        self,
        plan: RunPlan | Path | str,
        *,
        ledger: Ledger | Path | str | None = None,
        audit: Path | str | None = None,
        speed: float = 1.0,
    ) -> None:
        self.plan = plan if isinstance(plan, RunPlan) else load_test(plan)
        self.timeline = timeline(self.plan.steps)
        self.number = 0  # index of the present step in `timeline`
        self.phase = ""  # name of the present phase; "" before the first step
        self._ledger = ledger
        self._audit = audit
        self._speed = speed
        self._begin_ns = 0
        self._phases = [*dict.fromkeys([*(step.name for step in self.plan.steps), STOP])]

    def misfits(self) -> list[str]:
        """Return a sentence for each part of the test for which a line is too slow, with a possible value."""
        return misfits(self.plan)

    @property
    def elapsed(self) -> float:
        """The time in s since the first step started; 0 before."""
        return (clock.now_ns() - self._begin_ns) * self._speed / 1e9 if self._begin_ns else 0.0

    def run(self, out: Path | str | None = None, *takers: Callable[[Rows], object]) -> RunResult:
        """Carry out all steps, stop all drives, and return the result once the motors are at rest.

        `out` is a new recording. Each of `takers` is called with each batch of rows, on a thread of its own.
        Limits and stops do not wait for the recording or a taker. If the recording or a taker is too slow,
        rows are lost: the run is aborted, and the result's `abort` has their number. An error of a taker ends
        the run and is raised here.

        Call this in the main thread, which handles signals. Raises ValueError for a command that a rule
        forbids and for a test that does not fit its lines, LineError if a port cannot be opened,
        FileExistsError if `out` exists, and RecordingError. The result says which command failed. If an error
        is raised before the recording is open, no drive is stopped.
        """
        self.number, self.phase, self._begin_ns = 0, "", 0
        for step in {id(step): step for step in self.plan.steps}.values():
            check_step(step, self.plan.plant)
        if found := self.misfits():
            raise ValueError("\n".join(found))
        plant = _at_speed(self.plan.plant, self._speed)
        with ExitStack() as stack:
            stack.enter_context(clock.at_speed(self._speed))
            poller = stack.enter_context(closing(Poller(plant, ledger=self._ledger, audit=self._audit)))
            self._check_speed(poller)
            writer: RecordingWriter | None = None
            if out is not None:
                writer = open_writer(out, with_phases(plant.metadata(), self._phases))
            # only after the checks above: if one fails, motors that already run are not stopped
            poller.stop_on_exit()
            return _Session(self, poller, writer, takers).carry_out()

    def _check_speed(self, poller: Poller) -> None:
        if self._speed != 1.0 and not all(map(_is_simulated, poller.buses.values())):
            raise ValueError(
                "argument 'speed' is only for simulated ports, and this plant has another port; leave it out"
            )


def _is_simulated(bus: Bus) -> bool:
    return is_simulated(bus.line.identity)


def _at_speed(plant: Plant, speed: float) -> Plant:
    """Return the plant with its polling periods divided by `speed`."""

    def faster(polled: PolledDrive) -> PolledDrive:
        polls = (
            Polled(poll.register, poll.every and max(SHORTEST_S, poll.every / speed)) for poll in polled.polls
        )
        return PolledDrive(polled.drive, tuple(polls), channels=polled.channels)

    if speed == 1.0:
        return plant
    return replace(plant, lines=[replace(line, drives=[*map(faster, line.drives)]) for line in plant.lines])


class _RowThread:
    """Calls `take` with batches of rows on a separate thread. So a slow `take` delays no abort and no stop.

    After the last batch, or an error of `take`, the thread calls `close`.
    """

    def __init__(
        self, name: str, take: Callable[[Rows], object], close: Callable[[], object] = lambda: None
    ) -> None:
        self.name = name
        self.failure: BaseException | None = None  # the error of `take` or `close`
        self.has_lost = False  # True once a batch was dropped because too many were waiting
        self._take, self._close = take, close
        self._put_rows = self._taken_rows = 0
        self._queue: SimpleQueue[Rows | None] = SimpleQueue()  # None ends the thread
        self._thread = Thread(target=self._run, name=f"multidrop run: {name}", daemon=True)
        self._thread.start()

    def put(self, rows: Rows) -> None:
        """Queue these rows, and return immediately."""
        self._put_rows += len(rows)
        if self._queue.qsize() < MOST_WAITING:
            self._queue.put(rows)
        else:
            self.has_lost = True

    def end(self) -> str:
        """Wait up to ENDING_S for the thread's end; return a sentence if rows are missing, else ""."""
        self._queue.put(None)
        self._thread.join(ENDING_S)
        hangs = self._thread.is_alive()
        if not hangs and not self.has_lost:
            return ""
        missing = f"{self._put_rows - self._taken_rows} rows did not reach {self.name}"
        return missing + (f", which did not end within {ENDING_S:g} s" if hangs else "")

    def _run(self) -> None:
        try:
            try:
                while (rows := self._queue.get()) is not None:
                    self._take(rows)
                    self._taken_rows += len(rows)
            finally:
                self._close()
        except BaseException as failure:  # any failure: the run raises it
            self.failure = failure


class _Session:
    """One run: its poller, its threads and its limits."""

    def __init__(
        self,
        run: TestRun,
        poller: Poller,
        writer: RecordingWriter | None,
        takers: Iterable[Callable[[Rows], object]],
    ) -> None:
        self._run = run
        self._plan = run.plan
        self._poller = poller
        self._row_threads = [_RowThread("a taker of rows", take) for take in takers]
        self._recording: _RowThread | None = None
        if writer:
            self._recording = _RowThread(f"the recording {writer.path}", writer.write, writer.close)
            self._row_threads.append(self._recording)
        silence = silence_of(self._plan)
        if self._plan.limits.silence is None and all(map(_is_simulated, poller.buses.values())):
            silence = max(silence, SIMULATED_SILENCE_S)
        self._watch = LimitWatch(self._plan, round(silence * 1e9), clock.now_ns())
        # time in ns for which the computer had slept before the run
        self._slept_ns = clock.boottime_ns() - clock.now_ns()
        self._looked_ns = clock.boottime_ns()  # when rows were last compared with the limits
        self._is_stopping = False

    def carry_out(self) -> RunResult:
        """Carry out the steps, stop all drives, and write all rows; return the result."""
        missing: list[str] = []
        try:
            try:
                abort = self._carry_out_and_stop()
            finally:
                missing += self._end_rows()
        except KeyboardInterrupt as interruption:  # the drives were already stopped
            for sentence in (*self._stopped().values(), *missing):
                interruption.add_note(str(sentence))
            raise
        self._raise_failure()
        return RunResult("; ".join([*([abort] if abort else []), *missing]), self._stopped())

    def _end_rows(self) -> list[str]:
        """Pass on the last rows and close the recording.

        Return an error sentence for each recording and callback that did not get all rows.
        """
        while self.take():  # pass on the rows that arrived while the poller was being closed
            pass
        return [sentence for thread in self._row_threads if (sentence := thread.end())]

    def _raise_failure(self) -> None:
        for thread in self._row_threads:
            if thread.failure is not None:
                raise thread.failure

    def _stopped(self) -> dict[str, Stopped]:
        """Return the result of each drive's stop, even of drives on a line whose stops raised an error."""
        found = {name: one for bus in self._poller.buses.values() for name, one in bus.stopped.items()}
        names = [polled.drive.name for polled in self._plan.plant.drives]
        return {name: found.get(name, Stopped(name, Seen.SENT, 0.0, UNKNOWN)) for name in names}

    def _carry_out_and_stop(self) -> str:
        """Carry out the steps, then stop all drives. Return why the run was aborted; "" if it was not."""
        abort = ""
        threads = len(self._plan.drives) + len(self._plan.plant.lines)
        with self._poller, ThreadPoolExecutor(threads, "multidrop run") as pool:
            try:
                self._follow(
                    [pool.submit(copy_context().run, self._check, name) for name in self._plan.commanded]
                )
                self._carry_out_steps(pool)
            except _Aborted as why:
                abort = str(why)
            finally:
                self._stop(pool)
        return abort

    def _carry_out_steps(self, pool: ThreadPoolExecutor) -> None:
        self._run._begin_ns = clock.now_ns()
        at = 0.0
        for number, planned in enumerate(self._run.timeline):
            step = planned.step
            self._run.number = number
            self._check_standstill()  # if the process was suspended, no further drive may be started
            self._mark(step.name)
            commands = [
                pool.submit(copy_context().run, self._command, self._poller[name], step)
                for name in step.drives
            ]
            at = self._follow(commands, at + planned.seconds, step)

    def _follow(self, commands: list[Future[Any]], end: float = 0.0, step: RunStep | None = None) -> float:
        """Wait until all commands are done, the planned end has passed, and the step's condition holds.

        Return when the next step is due. This time and `end` are in s since the run's start. Raises _Aborted
        at a limit, and if a command fails.
        """
        since_ns, is_late = clock.now_ns(), False
        until = step.until if step else None
        while True:
            self._look(commands)
            now = self._run.elapsed
            is_done = all(command.done() for command in commands)
            is_late |= now >= end + LATE_S * self._run._speed
            if now >= end and is_done:
                if until is None:
                    return now if is_late else end
                if self._watch.holds(until, since_ns):
                    return now
                if step and now >= end + step.within:
                    raise _Aborted(f"{step.name}: {until.text} did not hold within {step.within:g} s")
            is_late |= now >= end and not is_done
            pause = LOOK_S * self._run._speed
            clock.sleep(min(pause, end - now) if end > now else pause)

    def _look(self, commands: list[Future[Any]]) -> None:
        """Take one batch of rows, and check limits, commands and callbacks.

        Raises _Aborted if a limit is reached, if a command has failed, or if rows were lost. Raises the error
        of the recording or of a callback.
        """
        self._check_standstill()
        self.take()
        self._raise_failure()
        if slow := next((thread for thread in self._row_threads if thread.has_lost), None):
            raise _Aborted(f"{slow.name} was too slow: more than {MOST_WAITING} batches were waiting")
        # Sleep of the computer during the run counts as silence, so that the run does not continue after it.
        if why := self._watch.silent(clock.boottime_ns() - self._slept_ns):
            raise _Aborted(why)
        duration = self._plan.limits.duration
        if duration is not None and self._run.elapsed > duration:
            raise _Aborted(f"the run took longer than its duration, {duration:g} s")
        for command in commands:
            failure = command.exception() if command.done() else None
            if isinstance(failure, (BusError, ValueError, TypeError)):
                raise _Aborted(str(failure)) from failure
            if failure is not None:
                raise failure

    def _check_standstill(self) -> None:
        """Raise _Aborted if no rows were compared for too long, such as while the process was suspended."""
        now_ns = clock.boottime_ns()
        still_s = (now_ns - self._looked_ns) / 1e9
        if still_s > STILL_S:
            raise _Aborted(
                f"the limits were not checked for {still_s:.1f} s: the process was suspended or too slow"
            )
        self._looked_ns = now_ns

    def _limit_ns(self) -> float:
        """Return the time in ns (CLOCK_MONOTONIC) by which rows must be compared again."""
        left_ns: float = self._looked_ns + STILL_S * 1e9 - clock.boottime_ns()
        return clock.now_ns() + left_ns

    def take(self) -> bool:
        """Pass one batch of new rows on; return False if there is none.

        If a limit is reached, start the stops, then raise _Aborted.
        """
        batch = self._poller.take()
        if batch is None:
            return False
        why = "" if self._is_stopping else self._watch.add(batch)
        if why:
            self._begin_stops()
        if self._row_threads:
            kept = copied(batch)
            for thread in self._row_threads:
                thread.put(kept)
        if why:
            raise _Aborted(why)
        return True

    def _check(self, name: str) -> None:
        """Check a drive's identity, and the test's frequencies and rates against the drive's own limits."""
        drive = self._poller[name]
        steps = [step for step in self._plan.steps if name in step.frequency]

        def check() -> None:
            drive.bus.check_identity(drive)
            for hz in {step.frequency[name] for step in steps}:
                drive.perform(check_setpoint(drive, hz))
            for rate in {step.rate for step in steps if step.rate}:
                drive.perform(checked_rate(drive, rate))

        self._insist(drive, check, NoReply, BadReply, Expired)

    def _command(self, drive: Drive, step: RunStep) -> None:
        """Carry out a step's commands to this drive. A start that may have been sent is not repeated.

        Nothing is sent after a suspension of the process, even if `_check_standstill` has not noticed it yet.
        """
        with written_before(self._limit_ns):
            self._insist(drive, lambda: _command(drive, step), Expired)

    def _insist(self, drive: Drive, work: Callable[[], object], *too_late: type[Exception]) -> object:
        """Do the work. If the drive is simulated, repeat the work after one of the errors `too_late`."""
        attempts = SIMULATED_ATTEMPTS if _is_simulated(drive.bus) else 1
        for attempt in range(attempts):
            try:
                return work()
            except too_late:
                if attempt == attempts - 1 or self._is_stopping:
                    raise
        return None

    def _mark(self, phase: str) -> None:
        """Set the present phase, and record a row at its start."""
        self._run.phase = phase
        if self._recording:
            number = self._run._phases.index(phase)
            self._recording.put(phase_row(number, clock.utc_ns(), clock.now_ns()))

    def _begin_stops(self) -> None:
        if not self._is_stopping:
            self._is_stopping = True
            for bus in self._poller.buses.values():
                bus.leave()
            self._mark(STOP)

    def _stop(self, pool: ThreadPoolExecutor) -> None:
        """Stop all drives, and take rows until all stops have ended; then wait for a pending signal."""
        self._begin_stops()
        stops = [pool.submit(copy_context().run, bus.part) for bus in self._poller.buses.values()]
        while not all(stop.done() for stop in stops):
            self.take()
            clock.sleep(LOOK_S * self._run._speed)
        await_signal()


def _command(drive: Drive, step: RunStep) -> None:
    """Carry out the step's commands to this drive."""
    name = drive.name
    if name in step.stop:
        drive.stop()
    for register, value in step.write.get(name, {}).items():
        known = drive.register(register)
        drive.write(known, known.parse(value) if isinstance(value, str) else value)
    if name in step.frequency and step.rate:
        ramp(drive, step.frequency[name], rate=step.rate, every=RAMP_EVERY_S)
    elif name in step.frequency:
        drive.set_frequency(step.frequency[name])
    if name in step.start:
        drive.start(step.direction)
