"""Ports: lines that the core's thread drives, and the queue of their rows."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from enum import IntEnum, StrEnum
from functools import partial
from typing import Any
from weakref import finalize

from multidrop._core import ffi, lib
from multidrop.core.capture import Tap
from multidrop.core.columns import Columns, RowLayout
from multidrop.core.exchange import Completion, Exchange, Peer
from multidrop.core.fork import only_here, register_at_fork
from multidrop.core.permissions import Mastership
from multidrop.core.result import Status

CHUNK_ROWS = 1 << 12
MOST_CHUNKS = 256  # waiting to be taken; further rows are dropped, and counted


class RowQueue:
    """Rows that nobody has taken yet, and the numbers of ports that need attention (struct md_row_queue)."""

    _MOST_AT_ONCE = 1024

    def __init__(self, chunk_rows: int = CHUNK_ROWS, most_chunks: int = MOST_CHUNKS) -> None:
        self._room = (chunk_rows, most_chunks)
        self._called = ffi.new("uint32_t[]", self._MOST_AT_ONCE)
        self._begin()
        register_at_fork(self)

    def _begin(self) -> None:
        made = lib.md_row_queue_new(*self._room)
        if made == ffi.NULL:
            raise OSError(ffi.errno, "no room for what the core leaves")
        self.c = ffi.gc(made, only_here(lib.md_row_queue_free))
        self._give_back = only_here(partial(lib.md_row_queue_give_back, self.c))

    def forked(self) -> None:
        """Be empty, in the child: the rows that wait are the parent's to take."""
        self._begin()

    def take(self) -> Columns | None:
        """Return the oldest rows that wait; None when there are none."""
        made = lib.md_row_queue_take(self.c)
        return None if made == ffi.NULL else Columns.lent(made, self._give_back)

    def add_miss(self, block: RowLayout, status: Status, due_ns: int) -> None:
        """Add rows for values that were due at `due_ns` and not asked for."""
        lib.md_row_queue_miss(self.c, block.c, status, due_ns)

    @property
    def chunks(self) -> int:
        """Columns that wait to be taken; the newest are still being filled."""
        return int(lib.md_row_queue_chunks(self.c))

    @property
    def dropped(self) -> int:
        """Rows for which there was no room."""
        return int(lib.md_row_queue_dropped(self.c))

    def call(self, number: int) -> None:
        """Wake whoever waits, as if the port of this number needed attention."""
        lib.md_row_queue_call(self.c, number)

    def await_calls(self, seconds: float) -> list[int]:
        """Wait for calls, at most so long; return the numbers of the ports that need attention."""
        count = lib.md_row_queue_await(self.c, round(seconds * 1e9), self._called, self._MOST_AT_ONCE)
        return ffi.unpack(self._called, count) if count else []


now_ns = lib.md_now_ns
utc_minus_monotonic_ns = lib.md_utc_minus_monotonic_ns


class Echo(StrEnum):
    """An adapter's echo: it repeats to the client what the client sends; `AUTO`: that is learnt."""

    AUTO = "auto"
    ON = "on"
    OFF = "off"

    @classmethod
    def _missing_(cls, value: object) -> Echo:
        raise ValueError(f'echo {value!r} is none of "auto", "on" and "off"')


class RS485(StrEnum):
    """The one that switches between sending and receiving, where the adapter does not.

    `KERNEL`: the driver's own RS-485 mode; `RTS_UP`: the core, RTS being on while a request leaves;
    `RTS_DOWN`: RTS being off then.
    """

    OFF = "off"
    KERNEL = "kernel"
    RTS_UP = "rts-up"
    RTS_DOWN = "rts-down"

    @classmethod
    def _missing_(cls, value: object) -> RS485:
        raise ValueError(f'rs485 {value!r} is none of "off", "kernel", "rts-up" and "rts-down"')

    def check_port(self, port: str) -> None:
        """Raise ValueError for a port that cannot have it."""
        if self is not RS485.OFF and "://" in port:
            raise ValueError(f"rs485 is a fact of serial devices, and {port} is none; leave it out")


class TransactionIds(StrEnum):
    """A gateway's transaction ids: its replies `MATCH` their requests, or it has ids of its own: `IGNORE`."""

    MATCH = "match"
    IGNORE = "ignore"

    @classmethod
    def _missing_(cls, value: object) -> TransactionIds:
        raise ValueError(f'transaction {value!r} is none of "match" and "ignore"')


class Transactions(IntEnum):
    """The use of transaction ids on a port (enum md_transactions)."""

    NONE = lib.MD_NO_TRANSACTIONS  # it has none: any framing but Modbus TCP
    MATCHED = lib.MD_MATCHED  # a reply has its request's id, and any other is late or foreign
    IGNORED = lib.MD_IGNORED  # a gateway replies with ids of its own


_ECHOES = {Echo.AUTO: lib.MD_ECHO_UNKNOWN, Echo.ON: lib.MD_ECHO, Echo.OFF: lib.MD_NO_ECHO}


_SWITCHES = {
    RS485.OFF: lib.MD_RS485_OFF,
    RS485.KERNEL: lib.MD_RS485_KERNEL,
    RS485.RTS_UP: lib.MD_RS485_RTS_UP,
    RS485.RTS_DOWN: lib.MD_RS485_RTS_DOWN,
}


class _Engine:
    """The core's thread, started when the first port is opened; there is one in a process."""

    def __init__(self) -> None:
        self.forked()
        register_at_fork(self)

    def forked(self) -> None:
        """Start another one, in the child, with the next port that is opened."""
        self._starting = threading.Lock()  # ports are opened beside each other
        self._c: Any = None

    @property
    def c(self) -> Any:
        """The core's own (struct md_engine). Raises OSError where its thread cannot be started."""
        with self._starting:
            if self._c is None:
                started = lib.md_engine_start()
                if started == ffi.NULL:
                    raise OSError(ffi.errno, "the core's thread cannot be started")
                self._c = started
            return self._c


class _PortMemory:
    """All of Python's memory that the core's thread reads and writes for one port.

    What the core is given is put here first.
    """

    def __init__(self, room: int, mastership: Mastership | None) -> None:
        self.mastership = mastership
        self.lasting: set[object] = set()  # as long as the port is open
        self.queued: list[Exchange | None] = [None] * room  # as in the core's own ring
        self._newest: dict[str, tuple[object, ...]] = {}

    @contextmanager
    def replacing(self, kind: str, new: object) -> Iterator[None]:
        """Keep what replaces another of its kind, and the other too until the core has the new one."""
        self._newest[kind] = (*self._newest.get(kind, ()), new)
        yield
        self._newest[kind] = (new,)


_engine = _Engine()


def _owner_of(port: Any, memory: _PortMemory) -> Any:
    """Return the owner of a port and of its memory.

    Once nothing refers to it the core's thread lets the port go, and then the memory is freed: cffi calls its
    destructor before it drops the handle, and the garbage collector calls all destructors before it frees
    anything, also at the interpreter's end. No Python code runs meanwhile that a signal could break off.
    """
    return ffi.gc(ffi.new_handle(memory), partial(lib.md_port_let_go, port))


def _stop(port: Any, memory: _PortMemory) -> None:
    """Stop a port to which nothing refers any more, with all of its memory still there.

    A collector calls this first. Then it finalizes all else in any order, also what owns the descriptor.
    """
    lib.md_port_stop(port)


class Port:
    """A line driven on a descriptor by the core's thread (struct md_port).

    `must_take` is the mask of REFUSALS that are failures; -1 for a port without settings. `room` is
    how many exchanges may be queued, a power of two. With `transactions` all of them are of Modbus TCP,
    and without them none is. Requests leave while the `mastership` holds; None: always. OSError where the
    descriptor cannot be waited for.
    """

    def __init__(
        self,
        fd: int,
        must_take: int,
        room: int = 256,
        *,
        transactions: Transactions = Transactions.NONE,
        mastership: Mastership | None = None,
    ) -> None:
        self.room = room
        self._memory = _PortMemory(room, mastership)
        self._is_inherited = False
        self.c = lib.md_port_open(_engine.c, fd, must_take, transactions, room)
        if self.c == ffi.NULL:
            raise OSError(ffi.errno, "the port cannot be waited for")
        self._owner = _owner_of(self.c, self._memory)
        self._abandoned = finalize(self, _stop, self.c, self._memory)
        self._abandoned.atexit = False  # others may still use the port at exit
        if mastership is not None:
            lib.md_port_fence(self.c, mastership.c)
        # Read in place: a call of the core would release the GIL, and wait to have it back.
        self._progress = lib.md_port_progress(self.c)
        register_at_fork(self)

    def forked(self) -> None:
        """Leave it to the parent, in the child: the engine's thread is there alone."""
        self._abandoned.detach()
        ffi.gc(self._owner, None)
        self._is_inherited = True

    def tap(self, tap: Tap) -> None:
        """Put all that goes over the line into this tap, and into no other any more."""
        with self._memory.replacing("tap", tap):
            lib.md_port_tap(self.c, tap.c)

    def tell_echo(self, echo: Echo) -> None:
        """Say whether its adapter echoes."""
        lib.md_port_tell_echo(self.c, _ECHOES[echo])

    def switch(self, rs485: RS485) -> None:
        """Say who switches its transceiver, before anything is sent. OSError where the driver refuses."""
        failure = lib.md_port_rs485(self.c, _SWITCHES[rs485])
        if failure:
            raise OSError(-failure, "the transceiver cannot be switched")

    def is_asking(self, peer: Peer) -> bool:
        """Return True while an exchange with this peer is queued, repeated, urgent or under way."""
        return bool(lib.md_port_is_asking(self.c, peer.c))

    def counted_ns(self) -> int:
        """Return until when the port's time is over and counted: where it stands still in an exchange."""
        return int(lib.md_port_counted_ns(self.c))

    def inherit(self, peer: Peer, before: Peer) -> None:
        """Have a peer take the place of another, which may be on the line."""
        self._memory.lasting.update((peer, before))
        lib.md_port_inherit(self.c, peer.c, before.c)

    @property
    def cut_off(self) -> bool:
        """True once the port was lost in the middle of a polled exchange, and not of the first one on it."""
        return bool(self._progress.cut_off)

    def end(self) -> bool:
        """Begin nothing more of the queue; return True while one of it is under way.

        Urgent exchanges are still carried out.
        """
        return bool(lib.md_port_end(self.c))

    def stop(self) -> None:
        """Carry out nothing more, and give the descriptor back. What it did can still be asked."""
        if not self._is_inherited:
            lib.md_port_stop(self.c)

    close = stop

    def report_to(self, row_queue: RowQueue, number: int) -> None:
        """Deliver rows to `row_queue`, and call it with `number` when the port needs attention.

        That is when little is queued, when the port was lost or repeats nothing any more, and when a drive
        refuses, fails to answer, or answers again.
        """
        with self._memory.replacing("rows", row_queue):
            lib.md_port_report(self.c, row_queue.c, number)

    def repeat(self, exchanges: Sequence[Exchange]) -> int:
        """Carry these out in turn while nothing that is queued is due, until they are replaced.

        Returns which of those that are replaced would have been next; on a closed port 0.
        """
        if self.c is None:
            return 0
        self._memory.lasting.update(exchanges)  # one of them may be under way when they are replaced
        rounds = ffi.new("struct md_exchange *[]", [exchange.c for exchange in exchanges])
        with self._memory.replacing("round", rounds):
            return int(lib.md_port_repeat(self.c, rounds, len(exchanges)))

    @property
    def repeating(self) -> bool:
        """True while it repeats: until the port is lost, or an exchange could not be sent."""
        return bool(self._progress.repeating)

    def submit(self, exchanges: Sequence[Exchange], not_before_ns: Sequence[int]) -> int:
        """Queue exchanges, none to be sent before its time; return how many there was room for."""
        todo = ffi.new("struct md_exchange *[]", [exchange.c for exchange in exchanges])
        times = ffi.new("int64_t[]", not_before_ns)
        self._memory.lasting.update(exchange.peer for exchange in exchanges)  # a late reply may come
        free = exchanges[: self.room - self.pending]
        for at, exchange in enumerate(free, int(self._progress.submitted)):
            self._memory.queued[at & (self.room - 1)] = exchange
        return int(lib.md_port_submit(self.c, todo, times, len(free)))

    @property
    def done(self) -> int:
        """Queued exchanges that were carried out; it wraps around at 2^32."""
        return int(self._progress.done)

    @property
    def pending(self) -> int:
        """Queued exchanges that were not carried out yet."""
        return (int(self._progress.submitted) - self.done) & 0xFFFF_FFFF

    @property
    def lost(self) -> bool:
        """True once the descriptor failed: nothing more is carried out on it."""
        return bool(self._progress.lost)

    @property
    def has_echo(self) -> bool:
        """True once its adapter is known to echo: then no echo is taken for a reply."""
        return int(self._progress.echo) == int(lib.MD_ECHO)

    @property
    def foreign(self) -> int:
        """Bytes that came while the line was listened to before a request: another master's doing."""
        return int(self._progress.foreign)

    @property
    def switching(self) -> float:
        """Seconds that a change of baud rate or format takes, on average; 0 before the first one."""
        return float(self._progress.switching_ns) / 1e9 / max(int(self._progress.switches), 1)

    def carry_out(
        self,
        exchange: Exchange,
        not_before_ns: int = 0,
        expires_ns: int = 0,
        into: Completion | None = None,
    ) -> Completion:
        """Carry one out ahead of the queue and wait for it; `into`: the completion to fill in, where it fits.

        After `expires_ns` (of CLOCK_BOOTTIME; 0: never), or after a stop, it is not sent.
        """
        self._memory.lasting.add(exchange.peer)  # a late reply may come
        found = into if into is not None and into.room == exchange.room else Completion(room=exchange.room)
        found.count = lib.md_port_carry_out(
            self.c, exchange.c, not_before_ns, expires_ns, found.c, found.values
        )
        return found
