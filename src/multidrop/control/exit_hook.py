"""ExitHook: before this process ends, stop the drives of all buses with `stop_on_exit`.

A process has one hook, for its exit and for SIGINT, SIGTERM and SIGHUP. A bus registers its stops there as an
"exit task", which runs in its own thread. The signal handler starts the exit tasks without waiting for them,
because they may need a lock that the interrupted thread holds.
"""

from __future__ import annotations

import atexit
import logging
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from queue import SimpleQueue
from types import FrameType
from typing import Any

from multidrop.core.process import HANDLING_S, register_at_fork
from multidrop.errors import BusError

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
IMPATIENT = 3  # this many signals within a second end the wait for the stops
PACKAGE = __name__.partition(".")[0]
MOST_NAMES = 20  # limit of the drives that a message names
CUT_SHORT = "the stops were cut short by a third signal: motors may still be turning"
REPLACED = (
    "%s will not stop the drives, because the program has set its own signal handler; closing the bus or "
    "ending the process still stops them. To handle the signal again, open a bus with stop_on_exit in the "
    "main thread"
)
STOPPING = "{} received: stopping {}; press Ctrl-C three times within a second to give up"


def _ending() -> tuple[signal.Signals, ...]:
    """Return the signals to handle.

    The signals include SIGHUP (the terminal was closed) unless the program handles it or nohup ignores it.
    """
    if sys.platform != "win32" and signal.getsignal(signal.SIGHUP) == signal.SIG_DFL:
        return (*_SIGNALS, signal.SIGHUP)
    return _SIGNALS


def _send(number: int, ident: int) -> None:
    """Send the signal to the main thread. On Windows, signals always go to the main thread."""
    if sys.platform == "win32":
        signal.raise_signal(number)
    else:
        signal.pthread_kill(ident, number)


def _print_error(sentence: str) -> None:
    """Write a sentence to standard error, unbuffered; skip it if standard error is closed or would block."""
    with suppress(OSError, ValueError):
        if sys.platform == "win32" or select.select([], [2], [], 0)[1]:
            os.write(2, f"multidrop: {sentence}\n".encode(errors="backslashreplace"))


def _listed(names: list[str]) -> str:
    left = len(names) - MOST_NAMES
    return ", ".join(names[:MOST_NAMES]) + (f" and {left} more" if left > 0 else "")


_log = logging.getLogger("multidrop.control")


class ExitTask:
    """Work that is done once at the process's end, by a thread that is started in advance.

    `drives` returns the names of the drives that the work stops.
    """

    def __init__(
        self,
        begin: Callable[[], object],
        work: Callable[[], object],
        over: Callable[[], None],
        drives: Callable[[], list[str]],
    ) -> None:
        self.drives = drives
        self._on_begin = begin
        self._work = work
        self._on_over = over
        self._calls: SimpleQueue[None] = SimpleQueue()  # safe in a signal handler, unlike an Event
        self._over = threading.Event()
        self.is_cut_short = False  # whether a third signal ended the wait for the work
        threading.Thread(target=self._run, name="multidrop exit", daemon=True).start()

    @property
    def is_over(self) -> bool:
        return self.is_cut_short or self._over.is_set()

    def begin(self) -> None:
        """Start the work, and return without waiting for its end."""
        self._on_begin()
        self._calls.put(None)

    def finish(self) -> None:
        """Start the work, and wait until it is done."""
        self.begin()
        # The waits are short, so this thread can handle signals that other threads received.
        while not self.is_over:
            self._over.wait(HANDLING_S)

    def forget(self) -> None:
        """In a forked child, mark the work as given up, because the parent process does the work."""
        self._over = threading.Event()
        self.is_cut_short = True

    def _run(self) -> None:
        self._calls.get()
        try:
            self._work()
        except Exception:
            _log.exception("the drives could not be stopped")
        finally:
            self._over.set()
            self._on_over()


class ExitHook:
    """Starts all exit tasks at exit or on a signal, and delays the signal's effect until they have ended.

    The hook immediately prints which drives are being stopped, and how to end the wait. After the stops the
    signal has the effect that it would have without this hook. A third signal within a second (see IMPATIENT)
    ends the wait.
    """

    def __init__(self) -> None:
        # changed by atomic operations only, because any thread may add and remove tasks
        self._tasks: list[ExitTask] = []
        # the program's own signal handlers, which this hook has replaced
        self._before: dict[signal.Signals, Any] = {}
        self._has_taken = False
        self._held: int | None = None  # number of the signal whose effect is delayed; None: no signal came
        self._came: list[float] = []  # s; times of the signals that came within the last second
        self._passing = threading.Lock()
        self._has_passed = False
        self._is_passing_on = False
        atexit.register(self._at_exit)
        register_at_fork(self)

    def forked(self) -> None:
        self._passing = threading.Lock()
        self._held, self._came = None, []
        for task in self._tasks:
            task.forget()
        self._tasks = []

    def add(
        self, begin: Callable[[], object], work: Callable[[], object], drives: Callable[[], list[str]] = list
    ) -> ExitTask:
        """Do `work` before the process ends; `begin` is called first, possibly in a signal handler.

        Raises ValueError outside the main thread, unless our signal handlers are already installed.
        """
        self.take_signals()
        task = ExitTask(begin, work, self._one_is_over, drives)
        self._tasks.append(task)
        try:
            self.take_signals()  # closing another bus may have restored the old handlers meanwhile
        except ValueError:
            self._tasks.remove(task)
            raise
        self._warn_of_replaced()
        if self._held is not None:  # the process is already ending
            task.begin()
        return task

    def take_signals(self) -> None:
        """Install our signal handlers, which call the earlier handlers after the stops.

        Raises ValueError outside the main thread, unless our handlers are already installed.
        """
        if threading.current_thread() is not threading.main_thread():
            if self._has_taken:
                return
            raise ValueError(
                "stop_on_exit must be set on the main thread, because Python handles signals there: create "
                "this Bus or Poller on the main thread"
            )
        for number in _ending():
            had = signal.getsignal(number)
            if had != self._on_signal:
                # stored before our handler is installed, because the signal may arrive immediately
                self._before[number] = had
                signal.signal(number, self._on_signal)
        self._has_taken = True

    def _warn_of_replaced(self) -> None:
        if lost := [number.name for number in _SIGNALS if signal.getsignal(number) != self._on_signal]:
            _log.warning(REPLACED, " and ".join(lost))

    def finish(self, task: ExitTask) -> None:
        """Carry out an exit task now, and remove it."""
        task.finish()
        with suppress(ValueError):  # another thread has already removed the task
            self._tasks.remove(task)
        self.rest()

    def rest(self) -> None:
        """If no exit task is left, restore the earlier handlers. Does nothing outside the main thread."""
        if not self._tasks and self._held is None and threading.current_thread() is threading.main_thread():
            self._let_go()
            if self._tasks:  # another thread has added a task
                self.take_signals()

    def _at_exit(self) -> None:
        tasks = [*self._tasks]
        for task in tasks:
            task.begin()
        for task in tasks:
            task.finish()

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        """Start the exit tasks. Takes no lock that the interrupted main thread may hold."""
        now = time.monotonic()
        if number in _SIGNALS:  # not SIGHUP: a closing terminal may send it several times
            self._came = [*(at for at in self._came if now - at < 1.0), now]
        is_first = self._held is None
        if is_first:
            self._held, self._has_passed = number, False
        tasks = [*self._tasks]
        for task in tasks:
            task.begin()
        names = [name for task in tasks if not task.is_over for name in task.drives()]
        if is_first and names:
            _print_error(STOPPING.format(signal.Signals(number).name, _listed(names)))
        if all(task.is_over for task in tasks):
            self._pass_on(number, frame)
        elif len(self._came) >= IMPATIENT:
            _print_error(CUT_SHORT)
            for task in tasks:
                task.is_cut_short = True
            self._pass_on(number, frame)

    def _one_is_over(self) -> None:
        """If all exit tasks have ended, send the delayed signal to the main thread."""
        with self._passing:
            held, ident = self._held, threading.main_thread().ident
            if self._has_passed or held is None or ident is None:
                return
            if not all(task.is_over for task in [*self._tasks]):
                return
            self._has_passed = True
        _send(held, ident)

    @property
    def delays_signal(self) -> bool:
        """True while the effect of a signal is delayed until the exit tasks have ended."""
        return self._held is not None

    def await_effect(self) -> None:
        """Wait until a delayed signal has its effect, such as KeyboardInterrupt (main thread only)."""
        if threading.current_thread() is not threading.main_thread():
            return
        while self._held is not None:
            time.sleep(HANDLING_S)

    def _pass_on(self, number: int, frame: FrameType | None) -> None:
        """Give the signal the effect that it would have without this hook.

        If the program has since installed a handler that calls ours, do not call that handler again.
        """
        installed, before = signal.getsignal(number), self._before.get(signal.Signals(number))
        self._let_go()
        self._held, self._came = None, []
        if self._is_passing_on:
            return
        self._is_passing_on = True
        try:
            if installed == self._on_signal:
                signal.raise_signal(number)
            elif callable(before) and before != installed:
                before(number, frame)
        finally:
            self._is_passing_on = False

    def _let_go(self) -> None:
        self._has_taken = False
        for number, handler in self._before.items():
            if signal.getsignal(number) == self._on_signal:
                signal.signal(number, signal.SIG_DFL if handler is None else handler)


def without_internals(interruption: BaseException) -> None:
    """Cut an interruption's traceback before the first frame of this package.

    Also remove a BusError from the interruption's context: it only says that the stops cancelled a call.
    """
    if isinstance(interruption.__context__, BusError):
        interruption.__context__ = None
    entry = interruption.__traceback__
    while entry is not None and (behind := entry.tb_next) is not None:
        if str(behind.tb_frame.f_globals.get("__name__")).partition(".")[0] == PACKAGE:
            entry.tb_next = None
        entry = entry.tb_next


def give_signals_back() -> None:
    """Restore the earlier signal handlers if no drives must be stopped at exit (main thread only)."""
    if _hook is not None:
        _hook.rest()


def await_signal() -> None:
    """If a signal has started the stops, wait until the signal has its effect (main thread only)."""
    if _hook is not None:
        _hook.await_effect()


def signal_has_come() -> bool:
    """Return True while drives are stopped because of a signal. Any thread may call this."""
    return _hook is not None and _hook.delays_signal


_hook: ExitHook | None = None


def exit_hook() -> ExitHook:
    """Return the only ExitHook of this process, which the first call creates."""
    global _hook
    if _hook is None:
        _hook = ExitHook()
    return _hook
