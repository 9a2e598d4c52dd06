"""Run a poller and a simulated line on a simulated clock: a simulated hour takes seconds.

The poller is real, with its thread, plan and schedule. The line's state machine and its turns are the core's
own code (csrc/line.c, csrc/turn.c). The descriptor, the core's thread and the clock are simulated: time
passes only when the test advances it, however busy the machine is.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, Protocol

import pytest
from batches import copied
from lines import PATIENCE, line, plant, rows_of
from multidrop._core import ffi, lib

from multidrop import bus, poller
from multidrop.core import Completion, Exchange, Message, Peer, RowQueue, TransactionIds
from multidrop.core.port import TRANSACTIONS
from multidrop.drive import Drive
from multidrop.drive.line_settings import speaks_tcp
from multidrop.errors import LineError
from multidrop.plant.model import Plant, PolledDrive
from multidrop.poller import Poller
from multidrop.polling.batch import Row
from multidrop.sim import FaultyWire
from multidrop.sim import wire as wire_of_drives
from multidrop.transport import clock, drive_records
from multidrop.transport.drive_reads import NO_ROWS, make_exchange

S = 1_000_000_000
BEGIN_NS = 1000 * S
NEVER = 1 << 62
ENODEV = 19


class ClockedWire(FaultyWire):
    """A faulty wire without a port of the operating system."""

    ids = TransactionIds.MATCH  # requests and replies have transaction ids, as on a tcp:// port
    chunk = 1.0  # s; characters within this time arrive together, so the line receives a reply in one piece

    def open(self) -> None:
        path = "test line"
        port: Any = SimpleNamespace(path=path, close=lambda: None)
        self.port = port


class ClockedRowQueue(RowQueue):
    """A row queue without real waits: `await_calls` advances simulated time instead."""

    pass_time: Callable[[float], None]

    def __init__(self) -> None:
        super().__init__()
        self._called_before: list[int] = []

    @property
    def has_called(self) -> bool:
        if not self._called_before:
            self._called_before = super().await_calls(0)
        return bool(self._called_before)

    def await_calls(self, seconds: float) -> list[int]:
        self.pass_time(seconds)
        called, self._called_before = [*self._called_before, *super().await_calls(0)], []
        return called


class PortSurroundings(Protocol):
    """What a `ClockedPort` needs: the simulated time and the wire."""

    @property
    def now(self) -> int: ...

    def send(self, request: bytes, baudrate: int) -> None: ...


class ClockedPort:
    """Replaces core.Port: runs the core's turns on simulated time and a simulated wire."""

    room = 256
    switching = 0.0

    def __init__(self, clocked: PortSurroundings, transactions: TransactionIds | None = None) -> None:
        self._clocked = clocked
        self._slots = ffi.new("struct md_slot[]", self.room)
        self._turn = ffi.new("struct md_turn *")
        self._wake = ffi.new("int64_t *")
        self._urgent: Any = None
        self._kept: list[object] = []  # keeps objects alive that the core may read
        self._received = b""
        self._guard = threading.RLock()  # locks the port, as the engine's mutex does
        self._is_closed = False
        lib.md_turn_init(self._turn, self._slots, self.room, clocked.now)
        self._turn.line.transactions = TRANSACTIONS[transactions]
        if transactions:
            lib.md_turn_set_echo(self._turn, lib.MD_NO_ECHO)

    # ---- methods of core.Port that clients call ----

    @property
    def lost(self) -> bool:
        return bool(self._turn.progress.lost)

    @property
    def done(self) -> int:
        return int(self._turn.progress.done)

    @property
    def repeating(self) -> bool:
        return bool(self._turn.progress.repeating)

    @property
    def cut_off(self) -> bool:
        return bool(self._turn.progress.cut_off)

    @property
    def has_echo(self) -> bool:
        return int(self._turn.progress.echo) == int(lib.MD_ECHO)

    def is_asking(self, peer: Peer) -> bool:
        with self._guard:
            return bool(lib.md_turn_is_asking(self._turn, peer.c))

    def counted_ns(self, now_ns: int) -> int:
        with self._guard:
            return min(now_ns, int(lib.md_turn_counted_ns(self._turn, now_ns)))

    def report_to(self, row_queue: RowQueue, number: int) -> None:
        self._kept.append(row_queue)
        self._turn.row_queue, self._turn.number = row_queue.c, number

    def submit(self, exchanges: Sequence[Exchange], not_before_ns: Sequence[int]) -> int:
        return int(
            lib.md_turn_submit(self._turn, self._pointers(exchanges), list(not_before_ns), len(exchanges))
        )

    def repeat(self, exchanges: Sequence[Exchange]) -> int:
        with self._guard:
            return int(lib.md_turn_repeat(self._turn, self._pointers(exchanges), len(exchanges)))

    def _pointers(self, exchanges: Sequence[Exchange]) -> Any:
        pointers = ffi.new("struct md_exchange *[]", [exchange.c for exchange in exchanges])
        self._kept += [*exchanges, pointers]
        return pointers

    def begin_urgent(self, exchange: Exchange) -> Any:
        """Add an urgent exchange; return its md_urgent, which shows whether the exchange is done."""
        found = ffi.new("struct md_completion *")
        self._urgent = ffi.new("struct md_urgent *", {"exchange": exchange.c, "completion": found})
        self._kept += [exchange, found, self._urgent]
        lib.md_turn_add_urgent(self._turn, self._urgent)
        return self._urgent

    def listen_until(self, at_ns: int) -> None:
        """Let all requests except stops wait until this time, as if another master might still send."""
        self._turn.line.listened_ns = at_ns

    @property
    def granted(self) -> Completion | None:
        """Return the completion of the latest urgent exchange; None while the exchange is pending."""
        return copied(self._urgent.completion) if self._urgent and self._urgent.is_done else None

    def end(self) -> bool:
        with self._guard:
            return bool(lib.md_turn_end(self._turn))

    def stop(self) -> None:
        with self._guard:
            lib.md_turn_close(self._turn)
            self._is_closed = True

    # ---- in place of the engine's thread ----

    def hang_up(self) -> None:
        lib.md_turn_lose(self._turn, ENODEV)
        lib.md_turn_want(self._turn, self._wake, self._clocked.now)

    def advance(self, received: bytes) -> int:
        """Let the core process received bytes until it waits; return the time in ns at which it continues."""
        with self._guard:
            return NEVER if self._is_closed else self._advance(received)

    def _advance(self, received: bytes) -> int:
        self._received += received
        now = self._clocked.now
        for _ in range(10_000):
            want = lib.md_turn_want(self._turn, self._wake, now)
            wake = int(self._wake[0])
            if want == lib.MD_DONE:
                self._receive()
                return wake
            if want == lib.MD_WRITE:
                self._send()
                if self.lost:
                    return NEVER
            elif want == lib.MD_READ and self._received:
                self._receive()
            elif want == lib.MD_WAIT or wake > now:
                return wake
        raise AssertionError("the line never waits")

    def _receive(self) -> None:
        received, self._received = self._received, b""
        lib.md_line_received(ffi.addressof(self._turn.line), received, len(received), self._clocked.now)
        assert not self._turn.line.is_out_of_step

    def _send(self) -> None:
        line, now = self._turn.line, self._clocked.now
        request = bytes(ffi.buffer(line.tx, line.tx_len))
        baudrate = int(line.exchange.settings.baudrate)
        lib.md_line_sent(ffi.addressof(line), len(request), now, now)
        self._clocked.send(request, baudrate)


class ClockedLine:
    """Replaces line.Line: the interface that the bus uses."""

    only_settings = None  # None: drives of any line settings are allowed
    why_closing = ""
    mastership = None
    may_send = True

    def __init__(self, clocked: ClockedLines, port: str, ids: TransactionIds) -> None:
        self.port = self.identity = port
        self.is_tcp = speaks_tcp(port)
        self.ids = ids
        self._clocked = clocked
        self.queue: ClockedPort | None = None

    @property
    def now(self) -> int:
        return self._clocked.now

    def send(self, request: bytes, baudrate: int) -> None:
        self._clocked.send(self.port, request, baudrate)

    def require(self, settings: tuple[int, str]) -> None:
        pass

    def inherit(self, peer: Peer, before: Peer) -> None:
        peer.inherit(before)

    def is_asking(self, peer: Peer) -> bool:
        return self.queue is not None and self.queue.is_asking(peer)

    def counted_ns(self, now_ns: int) -> int:
        return self.queue.counted_ns(now_ns) if self.queue else now_ns

    def end(self) -> bool:
        return self.queue is not None and self.queue.end()

    def note_news(self) -> None:
        pass

    def note_stall(self) -> None:
        pass

    def overruns(self) -> None:
        pass

    def drop_lost(self) -> None:
        if self.queue:
            self.queue = self._clocked.ports[self.port] = None

    def drop(self, why: str) -> None:
        self.drop_lost()

    close = drop_lost

    def reopen(self) -> None:
        self.close()
        wire = self._clocked.wires.get(self.port)
        if wire is None or wire.port is None:
            raise LineError(self.port, "it is not there")
        self.queue = self._clocked.ports[self.port] = ClockedPort(self, self.ids if self.is_tcp else None)
        self._clocked.opened.append(self.port)

    def open(self) -> ClockedLine:
        self.reopen()
        return self

    regain = reopen  # the poller has already closed the lost port
    is_lost = False  # unused: no test here stops a motor


class ClockedLines:
    """Simulated wires and a poller of the plant on them; `run` advances time and returns the new rows."""

    def __init__(self, wire: ClockedWire, drives: Sequence[PolledDrive]) -> None:
        wire.open()
        name = wire.where if speaks_tcp(wire.where) else "test line"
        declared = line(name, *drives)
        self._begin({name: wire}, plant(replace(declared, transaction=wire.ids)))

    @classmethod
    def of_lines(cls, wires: Mapping[str, ClockedWire], polled: Plant) -> ClockedLines:
        """Return clocked lines on several wires, given by port name."""
        clocked = cls.__new__(cls)
        for wire in wires.values():
            wire.open()
        clocked._begin(wires, polled)
        return clocked

    def _line(
        self, port: str, echo: object, ids: TransactionIds, rs485: object, mastership: None, settle: float
    ) -> ClockedLine:
        return ClockedLine(self, port, ids)

    def _begin(self, wires: Mapping[str, ClockedWire], polled: Plant) -> None:
        self.now = self._limit = BEGIN_NS
        self.wires = dict(wires)
        self.ports: dict[str, ClockedPort | None] = {}
        self.opened: list[str] = []  # names of opened ports, in the order of opening
        self._queue: ClockedRowQueue | None = None
        self._leaving = False
        self._failure: BaseException | None = None
        self._turn = threading.Condition()
        self._beside: set[threading.Thread] = set()
        patch = self._patch = pytest.MonkeyPatch()
        patch.setattr(bus, "Line", self._line)
        patch.setattr(drive_records, "_former", {})  # forget timing that was learnt on another clock
        patch.setattr(clock, "now_ns", lambda: self.now)
        patch.setattr(clock, "boottime_ns", lambda: self.now)
        patch.setattr(clock, "sleep", self._sleep)
        patch.setattr(poller, "RowQueue", self._row_queue)
        patch.setattr(wire_of_drives, "CHUNK", min(wire.chunk for wire in wires.values()))
        self.poller = Poller(polled)

    @property
    def wire(self) -> ClockedWire:
        """Return the only wire; there must be exactly one."""
        (wire,) = self.wires.values()
        return wire

    @property
    def port(self) -> ClockedPort | None:
        """Return the port of the only wire; None while the port is closed."""
        return next(iter(self.ports.values()), None)

    def __enter__(self) -> ClockedLines:
        self.poller.__enter__()
        return self

    def __exit__(self, *failure: Any) -> None:
        with self._turn:
            self._leaving = True
            self._turn.notify_all()
        try:
            self.poller.close()
        finally:
            self._patch.undo()

    @property
    def seconds(self) -> float:
        return (self.now - BEGIN_NS) / S

    def run(self, seconds: float) -> list[Row]:
        """Advance simulated time by this many seconds; return the new rows."""
        with self._turn:
            self._limit += round(seconds * S)
            self._turn.notify_all()
            assert self._turn.wait_for(lambda: self._failure or self._rests, PATIENCE)
        if self._failure:
            raise self._failure
        return rows_of(self.poller)

    def beside(self, do: Callable[[], object]) -> threading.Thread:
        """Call `do` on another thread, whose waits end as `run` advances time; return the thread."""
        thread = threading.Thread(target=do, daemon=True)
        self._beside.add(thread)
        thread.start()
        return thread

    def finish(self, beside: threading.Thread) -> None:
        """Advance time until the thread has ended."""
        while beside.is_alive():
            with self._turn:
                self._limit += S // 20
                self._turn.notify_all()
                assert self._turn.wait_for(lambda: self._failure or self._rests, PATIENCE)
            assert not self._failure

    def _sleep(self, seconds: float) -> None:
        end_ns = self.now + round(seconds * S)
        if threading.current_thread() not in self._beside:
            self._pass_until(end_ns)
        while self.now < end_ns:
            assert not self._leaving, "time has ended: finish the thread first"
            time.sleep(0.0002)

    def command(self, drive: Drive, request: Message) -> None:
        """Queue a request ahead of the polling if the port is open."""
        ours = self.poller.bus("line")
        if self.port:
            self.port.begin_urgent(make_exchange(drive, request, ours.peer(drive), NO_ROWS))

    # ---- the poller's thread ----

    @property
    def _rests(self) -> bool:
        return self.now >= self._limit and self._is_waiting

    _is_waiting = False

    def _row_queue(self) -> ClockedRowQueue:
        self._queue = ClockedRowQueue()
        self._queue.pass_time = self._pass_time
        return self._queue

    def _pass_time(self, seconds: float) -> None:
        for thread in threading.enumerate():
            # wait for this thread, which reopens a port: on the simulated clock this takes no time
            # a thread that is being started is listed too, and cannot be joined yet
            if thread.name == "multidrop reopening" and thread.is_alive():
                thread.join()
        try:
            with self._turn:
                self._is_waiting = True
                if self.now >= self._limit:
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
            wake = self._settle()
            self.now = min(max(wake, self.now + 1), end_ns)

    def _look(self, end_ns: int) -> None:
        """Advance time to `end_ns`, or until a call wakes the poller."""
        wake = end_ns
        while self.now < end_ns:
            wake = self._settle()
            if self._queue and self._queue.has_called:
                return
            self.now = min(max(wake, self.now + 1), end_ns)
        if wake <= end_ns:  # False if no event is due before the end
            self._settle()

    def _settle(self) -> int:
        """Process all events that are due; return the time in ns of the next event."""
        wake = NEVER
        for name, wire in self.wires.items():
            received, port = wire.advance(self.now / S), self.ports.get(name)
            if port and not port.lost and wire.port is None:
                port.hang_up()
            if port and not port.lost:
                wake = min(wake, port.advance(received))
            arrival = wire.wake
            if arrival is not None:
                wake = min(wake, -int(-arrival * S // 1))
        return wake

    def send(self, name: str, request: bytes, baudrate: int) -> None:
        """Send a request's bytes to the drives of a port, unless the port is closed."""
        wire, port = self.wires[name], self.ports.get(name)
        wire.receive(request, self.now / S, baudrate)
        if wire.port is None and port:
            port.hang_up()
