"""A poller and a simulated line on a clock of their own: an hour of the line takes seconds.

The poller is the real one with its thread, plan and schedule; the line is the core's state machine.
In place of the port, the core's thread and the clock is a world, in which time passes only while
the test lets it, and never because the machine is busy.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Sequence
from enum import Enum
from types import SimpleNamespace
from typing import Any

import pytest
from line_driver import LineDriver
from lines import PATIENCE, line, plant, rows_of
from multidrop._core import ffi, lib

from multidrop import bus, poller
from multidrop.core import Completion, Exchange, Message, Result, RowQueue, completion, new_completion
from multidrop.drive import Drive
from multidrop.errors import LineError
from multidrop.plant.model import PolledDrive
from multidrop.poller import Poller
from multidrop.polling.batch import Row
from multidrop.sim import HostileWire
from multidrop.transport import clock
from multidrop.transport.exchange import NO_ROWS, make_exchange

S = 1_000_000_000
BEGIN_NS = 1000 * S
NEVER = 1 << 62
ENODEV = 19


class WorldWire(HostileWire):
    """A hostile wire whose port is nothing that the system knows."""

    def open(self) -> None:
        path = "world"
        port: Any = SimpleNamespace(path=path, close=lambda: None)
        self.port = port


class WorldRowQueue(RowQueue):
    """Whoever waits for a call lets time pass meanwhile."""

    pass_time: Callable[[float], None]

    def await_calls(self, seconds: float) -> list[int]:
        self.pass_time(seconds)
        return super().await_calls(0)


class Turn(Enum):
    """Whose exchange is under way."""

    NOBODYS = 0
    BEFORE = 1
    WISHED = 2
    QUEUED = 3
    REPEATED = 4


class WorldPort:
    """What the poller sees of an open port (core.Port), and what the core's thread does for it."""

    room = 256
    switching = 0.0

    def __init__(self, world: World) -> None:
        self.lost = False
        self.done = 0
        self.urgent: deque[Exchange] = deque()
        self._world = world
        self._row_queue: RowQueue | None = None
        self._number = 0
        self._driver = LineDriver()
        self._driver.now = world.now
        self._queue: deque[tuple[Exchange, int]] = deque()
        self._cycle: list[Exchange] = []
        self._round: deque[Exchange] = deque()  # the next one first
        self._turn = Turn.NOBODYS
        self._under_way: Exchange | None = None
        self._put_off: tuple[Turn, Exchange] | None = None  # until what is asked before it was asked
        self._before = ffi.new("struct md_before *")
        self._heard = b""
        self._has_ended = False
        self.granted: Completion | None = None  # what became of the latest urgent exchange

    # ---- the poller's side ----

    @property
    def has_echo(self) -> bool:
        return self._driver.echo == int(lib.MD_ECHO)

    def report_to(self, row_queue: RowQueue, number: int) -> None:
        self._row_queue, self._number = row_queue, number

    def submit(self, exchanges: Sequence[Exchange], not_before_ns: Sequence[int]) -> int:
        assert len(self._queue) + len(exchanges) <= self.room
        self._queue += zip(exchanges, not_before_ns, strict=True)
        return len(exchanges)

    def repeat(self, exchanges: Sequence[Exchange]) -> int:
        following = self._cycle.index(self._round[0]) if self._round else 0
        self._cycle, self._round = list(exchanges), deque(exchanges)
        return following

    @property
    def repeating(self) -> bool:
        return bool(self._round)

    def end(self) -> bool:
        self._has_ended = True
        return self._turn in (Turn.QUEUED, Turn.REPEATED)

    def stop(self) -> None:
        if self.end():
            self._driver.abandon(Result.POLL_ENDED)
            self._finish()

    # ---- the core's side ----

    def hang_up(self) -> None:
        """What is under way fails, and so does all that is queued."""
        self.lost = True
        self._round.clear()
        while self._under_way or self._take_up():
            self._driver.abandon(Result.LINE_LOST, ENODEV)
            self._finish()
        self._call()

    def advance(self, heard: bytes) -> int:
        """Carry on until there is nothing to do but wait; until when."""
        driver = self._driver
        driver.now = self._world.now
        self._heard += heard
        for _ in range(10_000):
            if not self._under_way and not self._take_up():
                self._listen()
                return self._queue[0][1] if self._queue and not self._has_ended else NEVER
            want = driver.want
            if want == "done":
                self._finish()
            elif want == "write":
                self._listen()
                assert self._under_way
                self._world.send(driver.take(), self._under_way.settings[0])
                if self.lost:
                    return NEVER
            elif want == "read" and self._heard:
                self._listen()
            elif want == "wait" or driver.wake > driver.now:
                return driver.wake
        raise AssertionError("the line never waits")

    def _listen(self) -> None:
        heard, self._heard = self._heard, b""
        self._driver.receive(heard)

    def _take_up(self) -> bool:
        now = self._world.now
        if self._put_off:
            (turn, exchange), self._put_off = self._put_off, None
            self._ask(turn, exchange)
        elif self.urgent:
            self._ask(Turn.WISHED, self.urgent.popleft())
        elif self._has_ended:
            return False
        elif self._queue and (self._queue[0][1] <= now or self.lost):
            exchange, due_ns = self._queue.popleft()
            self._ask(Turn.QUEUED, exchange)
            if self._turn is Turn.QUEUED and exchange.c.period_ns and now >= due_ns + exchange.c.period_ns:
                again = (at_ns for other, at_ns in self._queue if other is exchange)
                if now >= next(again, NEVER):
                    self._driver.abandon(Result.EXPIRED)
        elif self._round:
            self._ask(Turn.REPEATED, self._round[0])
            self._round.rotate(-1)
        else:
            return False
        return True

    def _ask(self, turn: Turn, exchange: Exchange) -> None:
        first = lib.md_before(self._before, exchange.c, self._driver.echo, self._world.now)
        if first:
            self._put_off = turn, exchange
            turn, exchange = Turn.BEFORE, self._of(exchange, first)
        self._begin(turn, exchange)

    @staticmethod
    def _of(exchange: Exchange, c: Any) -> Exchange:
        """The one that the core means."""
        known = [*exchange.peer.proofs, *([exchange.echo_probe] if exchange.echo_probe else [])]
        return next(it for it in known if it.c == c)

    def _begin(self, turn: Turn, exchange: Exchange) -> None:
        self._turn, self._under_way = turn, exchange
        self._driver.found = new_completion()
        self._driver.begin(exchange)

    def _finish(self) -> None:
        assert self._under_way
        turn, exchange, found = self._turn, self._under_way, self._driver.found
        self._turn, self._under_way = Turn.NOBODYS, None
        if turn is Turn.BEFORE:
            return
        if lib.md_is_asked_again(self._before, exchange.c, found) and not self.lost and not self._has_ended:
            self._put_off = turn, exchange
            return
        if turn is Turn.WISHED:
            self.granted = completion(found)
            return
        self._report(exchange, found)
        if turn is Turn.QUEUED:
            self.done += 1
            if len(self._queue) in (0, self.room // 4):
                self._call()
        elif found.result < 0 and not found.sent_ns:
            self._round.clear()
            self._call()

    def _report(self, exchange: Exchange, found: Any) -> None:
        assert self._row_queue
        assert exchange.block
        lib.md_row_queue_add(self._row_queue.c, exchange.block.c, found)
        is_refusal = found.result > 0 and found.reply.exception
        if is_refusal or exchange.peer.failures != self._before.failures:
            self._call()

    def _call(self) -> None:
        if self._row_queue:
            self._row_queue.call(self._number)
            self._world.is_called = True


class WorldLine:
    """What the bus sees of a line (line.Line)."""

    def __init__(self, world: World) -> None:
        self.port = "world"
        self._world = world
        self.queue: WorldPort | None = None
        self.reopen()

    def require(self, settings: tuple[int, str]) -> None:
        pass

    def overruns(self) -> None:
        pass

    def drop(self) -> None:
        self.queue = self._world.port = None

    close = drop

    def reopen(self) -> None:
        self.close()
        if self._world.wire.port is None:
            raise LineError(self.port, "it is not there")
        self.queue = self._world.port = WorldPort(self._world)

    regain = reopen  # it is lost: the poller has dropped it
    is_lost = False  # nobody stops a motor here


class World:
    """A wire, and a poller of drives on it: `run` lets time pass, and returns the rows that come of it."""

    def __init__(self, wire: WorldWire, drives: Sequence[PolledDrive]) -> None:
        self.now = self._limit = BEGIN_NS
        self.wire = wire
        self.port: WorldPort | None = None
        self.is_called = False
        self._leaving = False
        self._failure: BaseException | None = None
        self._turn = threading.Condition()
        self._threads = {*threading.enumerate()}
        patch = self._patch = pytest.MonkeyPatch()
        patch.setattr(bus, "Line", lambda port, echo: WorldLine(self))
        patch.setattr(clock, "now_ns", lambda: self.now)
        patch.setattr(clock, "sleep", lambda seconds: self._pass_until(self.now + round(seconds * S)))
        patch.setattr(poller, "RowQueue", self._row_queue)
        wire.open()
        self.poller = Poller(plant(line("world", *drives)))

    def __enter__(self) -> World:
        self.poller.__enter__()
        return self

    def __exit__(self, *failure: Any) -> None:
        with self._turn:
            self._leaving = True
            self._turn.notify_all()
        self.poller.close()
        self._patch.undo()

    @property
    def seconds(self) -> float:
        return (self.now - BEGIN_NS) / S

    def run(self, seconds: float) -> list[Row]:
        """Let so many seconds pass."""
        with self._turn:
            self._limit += round(seconds * S)
            self._turn.notify_all()
            assert self._turn.wait_for(lambda: self._failure or self._rests, PATIENCE)
        if self._failure:
            raise self._failure
        return rows_of(self.poller)

    def command(self, drive: Drive, request: Message) -> None:
        """Have a request carried out ahead of the polling, if the port is there."""
        ours = self.poller.bus("line")
        if self.port:
            self.port.urgent.append(make_exchange(drive, request, ours.peer(drive), NO_ROWS))

    # ---- the poller's thread ----

    @property
    def _rests(self) -> bool:
        return self.now >= self._limit and self._is_waiting

    _is_waiting = False

    def _row_queue(self) -> WorldRowQueue:
        made = WorldRowQueue()
        made.pass_time = self._pass_time
        return made

    def _pass_time(self, seconds: float) -> None:
        for thread in {*threading.enumerate()} - self._threads - {threading.current_thread()}:
            thread.join()  # opens the port again: in the world that takes no time
        try:
            with self._turn:
                self._is_waiting = True
                self._turn.notify_all()
                while self.now >= self._limit and not self._leaving:
                    self._turn.wait()
                self._is_waiting = False
            if not self._leaving:
                self._look(min(self.now + round(seconds * S), self._limit))
        except BaseException as failure:
            self._failure = failure
            with self._turn:
                self._turn.notify_all()
            raise

    def _pass_until(self, end_ns: int) -> None:
        while self.now < end_ns:
            self._look(end_ns)

    def _look(self, end_ns: int) -> None:
        """Let time pass until then, or until the port wants more."""
        self.is_called = False
        while True:
            wake = self._settle()
            if self.is_called or self.now >= end_ns:
                return
            self.now = min(max(wake, self.now + 1), end_ns)

    def _settle(self) -> int:
        """All that happens now; when something happens next."""
        heard = self.wire.advance(self.now / S)
        if self.port and not self.port.lost and self.wire.port is None:
            self.port.hang_up()
        wake = NEVER
        if self.port and not self.port.lost:
            wake = self.port.advance(heard)
        at = self.wire.wake
        return wake if at is None else min(wake, -int(-at * S // 1))

    def send(self, request: bytes, baudrate: int) -> None:
        """What the client sends, to the drives; the port may be gone with it."""
        self.wire.receive(request, self.now / S, baudrate)
        if self.wire.port is None and self.port:
            self.port.hang_up()
