"""Simulator: runs any number of simulated wires in one thread.

No other file of `multidrop.sim` reads a clock.
"""

from __future__ import annotations

import heapq
import logging
import math
import select
import selectors
import signal
import socket
import threading
from collections.abc import Callable, Sequence
from time import monotonic
from typing import Self

from multidrop.core.process import register_at_fork, undisturbed
from multidrop.sim.wire import SimulatedEnd, Wire

_log = logging.getLogger("multidrop.sim")


class Simulator:
    """Runs wires during a `with` block: `with Simulator([wire]) as sim: sim.wires[0].path`.

    With `speed=10`, simulated time passes ten times as fast for wires, drives and motors.
    """

    def __init__(self, wires: Sequence[Wire], *, speed: float = 1.0) -> None:
        if not 0 < speed < math.inf:
            raise ValueError(f"speed {speed!r} is not a positive number")
        self.wires = tuple(wires)
        self._speed = speed
        self._thread = threading.Thread(target=self._run_in_thread, name="multidrop-sim", daemon=True)
        self.failure: BaseException | None = None
        """The first exception of a simulated drive, or of the thread itself; None: there was none."""
        self._failed: set[int] = set()  # indexes of the wires whose first failure was logged
        self._changing = threading.Lock()
        self._is_over = False
        self._is_open = False
        self._wakes: list[tuple[float, int]] = []  # heap of pairs: wake-up time in s, index of the wire
        # next wake-up times, by index of the wire; other times in the heap are obsolete
        self._planned: dict[int, float] = {}
        # ports that the selector observes and their descriptors, by index of the wire
        self._attended: dict[int, tuple[SimulatedEnd, int]] = {}

    def __enter__(self) -> Self:
        try:
            self._start()
        except BaseException:  # Python does not call __exit__ if __enter__ fails
            self._end()
            raise
        return self

    @undisturbed
    def _start(self) -> None:
        with self._changing:
            if not self._is_over:
                self.open()
                self._is_open = True
                self._thread.start()

    def __exit__(self, *error: object) -> None:
        self._end()
        if self.failure is not None:
            raise self.failure

    @undisturbed
    def _end(self) -> None:
        with self._changing:
            self._is_over = True
            if self._thread.is_alive():
                self.interrupt()
                self._thread.join()
            if self._is_open:
                self._is_open = False
                self.close()

    def _run_in_thread(self) -> None:
        try:
            self.run()
        except BaseException as failure:  # after this, no simulated drive replies
            self.failure = self.failure or failure
            _log.critical("the simulator has ended: no drive answers any more", exc_info=failure)

    def open(self) -> None:
        """Open all ports, which determines their paths.

        If one cannot be opened, close all and raise its error.
        """
        self._selector = selectors.DefaultSelector()
        self._interrupted, self._interrupter = socket.socketpair()
        self._interrupter.setblocking(False)
        self._selector.register(self._interrupted, selectors.EVENT_READ, None)
        register_at_fork(self)
        try:
            for number, wire in enumerate(self.wires):
                wire.open()
                self._attend(number)
        except BaseException:
            self.close()
            raise

    def forked(self) -> None:
        """Create new wake-up sockets in a forked child, because the old ones wake the parent's simulator."""
        if self._interrupter.fileno() >= 0:  # open
            self._interrupted.close()
            self._interrupter.close()
            self._interrupted, self._interrupter = socket.socketpair()

    def close(self) -> None:
        for wire in self.wires:
            wire.close()
        self._selector.close()
        self._interrupted.close()
        self._interrupter.close()

    def interrupt(self) -> None:
        """Make `run` return. Callable from any thread."""
        self._interrupter.send(b"!")

    @property
    def wakeup(self) -> int:
        """A file descriptor; a byte that is written to it makes `run` return."""
        return self._interrupter.fileno()

    def run(self) -> None:
        """Simulate all wires in the calling thread until interrupted.

        If a simulated drive raises an exception, its request gets no reply. The first exception of each wire
        is logged.
        """
        while True:
            self._sleep()
            for key, _ in self._selector.select(0):
                if key.data is None:
                    return
                self._receive(key.data)
            now = self._now()
            while self._wakes and self._wakes[0][0] <= now:
                at, number = heapq.heappop(self._wakes)
                if self._planned.get(number) == at:
                    del self._planned[number]
                    self._advance(number)

    def _now(self) -> float:
        return monotonic() * self._speed

    def _sleep(self) -> None:
        """Wait until bytes are received, or until the next wake-up time."""
        # select() on the selector's own descriptor is more accurate than epoll_wait(): to 1 us, not 1 ms
        limit = max(0.0, self._wakes[0][0] - self._now()) / self._speed if self._wakes else None
        if isinstance(self._selector, selectors.SelectSelector):
            self._selector.select(limit)
        else:
            select.select([self._selector], [], [], limit)

    def _note(self, number: int, failure: Exception) -> None:
        """Log the first failure of a wire. All wires continue."""
        self.failure = self.failure or failure
        if number not in self._failed:
            self._failed.add(number)
            _log.error("%s: a simulated drive failed", self.wires[number].name, exc_info=failure)

    def _receive(self, number: int) -> None:
        wire = self.wires[number]
        now = self._now()
        chunk = wire.port.read() if wire.port else b""
        self._attend(number)
        if chunk and wire.port:
            try:
                wire.receive(chunk, now, wire.port.baudrate())
            except Exception as failure:
                self._note(number, failure)
            self._advance(number)

    def _advance(self, number: int) -> None:
        """Send the client the bytes that are due, and compute the wire's next wake-up time."""
        wire = self.wires[number]
        try:
            data = wire.advance(self._now())
        except Exception as failure:
            self._note(number, failure)
            data = b""
        if data and wire.port:
            wire.port.write(data)
        self._attend(number)
        wake = wire.wake
        if wake is not None and wake < self._planned.get(number, math.inf):
            self._planned[number] = wake
            heapq.heappush(self._wakes, (wake, number))

    def _attend(self, number: int) -> None:
        """Let the selector observe the wire's present port, which may have been closed or reopened."""
        port, before = self.wires[number].port, self._attended.get(number)
        now = (port, port.fileno()) if port else None
        if now == before:
            return
        if before:
            self._selector.unregister(before[1])
            del self._attended[number]
        if now:
            self._selector.register(now[1], selectors.EVENT_READ, number)
            self._attended[number] = now


def serve(
    wires: Sequence[Wire],
    announce: Callable[[Simulator], None] = lambda simulator: None,
    *,
    speed: float = 1.0,
) -> None:
    """Simulate wires in the main thread until the process is interrupted or terminated.

    `announce` is called once, as soon as the wires' paths are known.
    """
    simulator = Simulator(wires, speed=speed)
    simulator.open()
    before = signal.signal(signal.SIGTERM, lambda *_: None)
    # Python does not run the handler of a signal that comes just before the sleep. The byte that the signal
    # writes ends the sleep.
    wakeup = signal.set_wakeup_fd(simulator.wakeup)
    try:
        announce(simulator)
        simulator.run()
    except KeyboardInterrupt:
        pass
    finally:
        signal.set_wakeup_fd(wakeup)
        signal.signal(signal.SIGTERM, before)
        simulator.close()
