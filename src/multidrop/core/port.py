"""Lines driven on descriptors by the core's own thread: exchanges are queued, or repeated."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from enum import StrEnum
from functools import cache
from typing import Any
from weakref import finalize

from multidrop._core import ffi, lib
from multidrop.core.exchange import Completion, Exchange, Peer, completion
from multidrop.core.fork import register_at_fork
from multidrop.core.row_queue import RowQueue
from multidrop.core.tap import Tap

now_ns = lib.md_now_ns
utc_minus_monotonic_ns = lib.md_utc_minus_monotonic_ns


class Echo(StrEnum):
    """Whether an adapter repeats to the client what it sends; `AUTO`: that is learnt."""

    AUTO = "auto"
    ON = "on"
    OFF = "off"

    @classmethod
    def _missing_(cls, value: object) -> Echo:
        raise ValueError(f'echo {value!r} is none of "auto", "on" and "off"')


_ECHOES = {Echo.AUTO: lib.MD_ECHO_UNKNOWN, Echo.ON: lib.MD_ECHO, Echo.OFF: lib.MD_NO_ECHO}


class _Engine:
    """The core's thread, started when the first port is opened; there is one in a process."""

    def __init__(self) -> None:
        self.c = lib.md_engine_start()
        if self.c == ffi.NULL:
            raise OSError(ffi.errno, "the core's thread cannot be started")
        register_at_fork(self)

    def forked(self) -> None:
        """In the child the next port that is opened starts another."""
        _engine.cache_clear()


@cache
def _engine() -> _Engine:
    return _Engine()


def _let_go(port: Any) -> None:
    lib.md_port_stop(port)
    lib.md_port_free(port)


class Port:
    """A line driven on a descriptor by the core's thread (struct md_port).

    `must_take` is the mask of REFUSALS that are failures; -1 for a port without settings. `room` is
    how many exchanges may be queued, a power of two. OSError where the descriptor cannot be waited for.
    """

    def __init__(self, fd: int, must_take: int, room: int = 256) -> None:
        self.c = lib.md_port_open(_engine().c, fd, must_take, room)
        if self.c == ffi.NULL:
            raise OSError(ffi.errno, "the port cannot be waited for")
        self.room = room
        # Read in place: a call of the core would let go of the interpreter, and wait to have it back.
        self._progress = lib.md_port_progress(self.c)
        self._free = finalize(self, _let_go, self.c)  # before that at which the core still looks
        self._free.atexit = False  # others may still use it then
        self._kept: set[Exchange | Peer] = set()  # at which the core may still look
        self._submitted: deque[Exchange] = deque(maxlen=room)  # at most so many are pending
        self._row_queue: RowQueue | None = None
        self._round: object = None
        register_at_fork(self)

    def forked(self) -> None:
        """In the child it is closed, without a word to the engine, which is not there to answer."""
        self._free.detach()
        self.close()

    def tap(self, tap: Tap) -> None:
        """Tell this tap, and no other any more, of all that goes over the line."""
        lib.md_port_tap(self.c, tap.c)
        self._tap = tap

    def tell_echo(self, echo: Echo) -> None:
        """Whether its adapter echoes."""
        lib.md_port_tell_echo(self.c, _ECHOES[echo])

    def inherit(self, peer: Peer, before: Peer) -> None:
        """Have one take the place of another, which may be on the line."""
        self._kept.update((peer, before))
        lib.md_port_inherit(self.c, peer.c, before.c)

    def end(self) -> bool:
        """Nothing more of the queue is begun; whether one of it is under way. Urgent exchanges still are."""
        return bool(lib.md_port_end(self.c))

    def stop(self) -> None:
        """Nothing more is carried out, and the descriptor is the caller's."""
        if self._free.alive:
            lib.md_port_stop(self.c)

    def close(self) -> None:
        """Stop, and let go of its memory."""
        self._free()
        self.c = self._progress = None

    def report_to(self, row_queue: RowQueue, number: int) -> None:
        """Whose rows are what becomes of exchanges, and who is called when the port is to be looked at:

        when little is queued, when the port was lost or repeats nothing any more, and when a drive
        refuses, fails to answer, or answers again.
        """
        self._row_queue = row_queue
        lib.md_port_report(self.c, row_queue.c, number)

    def repeat(self, exchanges: Sequence[Exchange]) -> int:
        """Carry these out again and again while nothing that is queued is due, until they are replaced.

        Returns which of those that are replaced would have been next.
        """
        self._kept.update(exchanges)  # one of them may be under way when they are replaced
        rounds = ffi.new("struct md_exchange *[]", [exchange.c for exchange in exchanges])
        following = lib.md_port_repeat(self.c, rounds, len(exchanges))
        self._round = rounds
        return int(following)

    @property
    def repeating(self) -> bool:
        """It does so; it does not any more when the port was lost, or an exchange could not be sent."""
        return bool(self._progress.repeating)

    def submit(self, exchanges: Sequence[Exchange], not_before_ns: Sequence[int]) -> int:
        """Queue exchanges, none to be sent before its time; how many there was room for."""
        todo = ffi.new("struct md_exchange *[]", [exchange.c for exchange in exchanges])
        times = ffi.new("int64_t[]", not_before_ns)
        taken = int(lib.md_port_submit(self.c, todo, times, len(exchanges)))
        self._submitted.extend(exchanges[:taken])
        self._kept.update(exchange.peer for exchange in exchanges)  # for when a late answer comes
        return taken

    @property
    def done(self) -> int:
        """How many queued exchanges were carried out; it wraps around at 2^32."""
        return int(self._progress.done)

    @property
    def lost(self) -> bool:
        """The descriptor failed, and nothing more is carried out on it."""
        return bool(self._progress.lost)

    @property
    def has_echo(self) -> bool:
        """Its adapter is known to repeat what it sends, and a reply that is a copy is told from that."""
        return int(self._progress.echo) == int(lib.MD_ECHO)

    @property
    def switching(self) -> float:
        """Seconds that a change of baud rate or format takes, on average; 0 before the first one."""
        return float(self._progress.switching_ns) / 1e9 / max(int(self._progress.switches), 1)

    def carry_out(self, exchange: Exchange, *, not_before_ns: int = 0, expires_ns: int = 0) -> Completion:
        """Carry one out ahead of the queue and wait for it; after `expires_ns` it is not sent."""
        self._kept.add(exchange.peer)  # for when a late answer comes
        found = ffi.new("struct md_completion *")
        lib.md_port_carry_out(self.c, exchange.c, not_before_ns, expires_ns, found)
        return completion(found)
