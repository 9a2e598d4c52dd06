"""Ports, on which the C core's thread carries out exchanges, and the queue of the resulting rows."""

from __future__ import annotations

import errno
import os
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Any, Literal
from weakref import finalize

from multidrop._core import ffi, lib
from multidrop.core.capture import Tap
from multidrop.core.columns import Columns, RowLayout, flag_at, number_at
from multidrop.core.exchange import Completion, Exchange, Peer, Status
from multidrop.core.frame import settings_to_c
from multidrop.core.permissions import Mastership
from multidrop.core.process import only_here, register_at_fork

CHUNK_ROWS = 1 << 12
WAKE_PERIOD_S = 2e-3  # s; duration of each sleep in `wake_lateness`
MOST_CHUNKS = 256  # limit of the chunks of rows; when all are full, the queue drops new rows and counts them


class RowQueue:
    """A queue of rows from ports, and of the numbers of ports that need attention (struct md_row_queue)."""

    _MOST_AT_ONCE = 1024

    def __init__(self, chunk_rows: int = CHUNK_ROWS, most_chunks: int = MOST_CHUNKS) -> None:
        self._room = (chunk_rows, most_chunks)
        self._called = ffi.new("uint32_t[]", self._MOST_AT_ONCE)
        self._begin()
        register_at_fork(self)

    def _begin(self) -> None:
        made = lib.md_row_queue_new(*self._room)
        if made == ffi.NULL:
            raise OSError(ffi.errno, "no memory for the rows of a poll")
        self.c = ffi.gc(made, only_here(lib.md_row_queue_release))
        self._give_back = only_here(partial(lib.md_row_queue_give_back, self.c))

    def forked(self) -> None:
        """Empty the queue in a forked child, because the rows belong to the parent."""
        self._begin()

    def take(self) -> Columns | None:
        """Remove and return the oldest chunk of rows; None if there are no rows."""
        made = lib.md_row_queue_take(self.c)
        return None if made == ffi.NULL else Columns.lent(made, self._give_back)

    def add_miss(self, block: RowLayout, status: Status, due_ns: int) -> None:
        """Add rows with this status for a block's values that were due at `due_ns` but not requested."""
        lib.md_row_queue_miss(self.c, block.c, status, due_ns)

    @property
    def chunks(self) -> int:
        """The number of chunks with rows, including the newest one, which is not full yet."""
        return int(lib.md_row_queue_chunks(self.c))

    @property
    def dropped(self) -> int:
        """The number of rows that were dropped because the queue was full."""
        return int(lib.md_row_queue_dropped(self.c))

    def call(self, number: int) -> None:
        """Wake the client that waits in `await_calls`, as if the port with this number needed attention."""
        lib.md_row_queue_call(self.c, number)

    def await_calls(self, seconds: float) -> list[int]:
        """Wait at most `seconds` s; return the numbers of the ports that need attention."""
        count = lib.md_row_queue_await(self.c, round(seconds * 1e9), self._called, self._MOST_AT_ONCE)
        return ffi.unpack(self._called, count) if count else []


now_ns = lib.md_now_ns
utc_minus_monotonic_ns = lib.md_utc_minus_monotonic_ns


class Echo(StrEnum):
    """Whether an adapter echoes the bytes that it sends; with `AUTO` the C core detects that."""

    AUTO = "auto"
    ON = "on"
    OFF = "off"

    @classmethod
    def _missing_(cls, value: object) -> Echo:
        raise ValueError(f'echo {value!r} is none of "auto", "on" and "off"')


EchoMode = Echo | Literal["auto", "on", "off"]


class RS485(StrEnum):
    """The party that switches the transceiver between receiving and sending.

    `OFF`: the adapter itself. `KERNEL`: the driver's RS-485 mode. `RTS_UP`: the C core, with RTS on while a
    request is sent. `RTS_DOWN`: the C core, with RTS off while a request is sent.
    """

    OFF = "off"
    KERNEL = "kernel"
    RTS_UP = "rts-up"
    RTS_DOWN = "rts-down"

    @classmethod
    def _missing_(cls, value: object) -> RS485:
        raise ValueError(f'rs485 {value!r} is none of "off", "kernel", "rts-up" and "rts-down"')

    def check_port(self, port: str) -> None:
        """Raise ValueError if the port cannot switch a transceiver."""
        if self is not RS485.OFF and "://" in port:
            raise ValueError(
                f"rs485 applies to serial devices only; the port {port} is not one, so remove rs485"
            )


RS485Mode = RS485 | Literal["off", "kernel", "rts-up", "rts-down"]


class TransactionIds(StrEnum):
    """A gateway's transaction ids: `MATCH` if a reply has the id of its request, `IGNORE` if not."""

    MATCH = "match"
    IGNORE = "ignore"

    @classmethod
    def _missing_(cls, value: object) -> TransactionIds:
        raise ValueError(f'transaction {value!r} is none of "match" and "ignore"')


TransactionMode = TransactionIds | Literal["match", "ignore"]

# None: no transaction ids, as with every framing except Modbus TCP
TRANSACTIONS = {
    None: lib.MD_NO_TRANSACTIONS,
    TransactionIds.MATCH: lib.MD_MATCHED,
    TransactionIds.IGNORE: lib.MD_IGNORED,
}

_ECHOES = {Echo.AUTO: lib.MD_ECHO_UNKNOWN, Echo.ON: lib.MD_ECHO, Echo.OFF: lib.MD_NO_ECHO}

_SWITCHES = {
    RS485.OFF: lib.MD_RS485_OFF,
    RS485.KERNEL: lib.MD_RS485_KERNEL,
    RS485.RTS_UP: lib.MD_RS485_RTS_UP,
    RS485.RTS_DOWN: lib.MD_RS485_RTS_DOWN,
}


NICE = -10  # nice value of threads that pass on polled values, if realtime scheduling was granted


class _Engine:
    """The C core's thread, one per process, started with the first port."""

    def __init__(self) -> None:
        self.forked()
        register_at_fork(self)

    def forked(self) -> None:
        """Forget the thread in a forked child, where the next opened port starts a new thread."""
        self._starting = threading.Lock()  # several threads may open a first port at the same time
        self._c: Any = None
        self._changing = threading.Lock()
        self._realtime: set[Realtime] = set()
        self._nice: dict[int, int] = {}  # original nice values of threads, by native thread id

    @property
    def c(self) -> Any:
        """The C core's engine (struct md_engine). Raises OSError if the C core's thread cannot be started."""
        with self._starting:
            if self._c is None:
                started = lib.md_engine_start()
                if started == ffi.NULL:
                    raise OSError(ffi.errno, "the core's thread cannot be started")
                self._c = started
            return self._c

    def set_realtime(self, client: Realtime, wanted: bool) -> None:
        """Give the C core's thread realtime scheduling while any client wants it.

        Raises OSError if the system refuses.
        """
        with self._changing:
            was_wanted = bool(self._realtime)
            (self._realtime.add if wanted else self._realtime.discard)(client)
            if was_wanted == bool(self._realtime):
                return  # nothing to change, even if the thread has ended realtime scheduling by itself
            failure = lib.md_engine_realtime(self.c, bool(self._realtime))
            if failure:
                self._realtime.discard(client)
                raise OSError(-failure, os.strerror(-failure))
            if not self._realtime:
                self._restore_nice()

    def lower_nice(self) -> None:
        """Lower the calling thread's nice value to NICE until no client wants realtime scheduling.

        New threads and processes of this thread get normal scheduling. Raises OSError if the system refuses.
        """
        thread = threading.get_native_id()
        if sys.platform != "linux" or thread in self._nice:
            return
        with self._changing:
            nice = os.getpriority(os.PRIO_PROCESS, thread)
            if not self._realtime or os.sched_getscheduler(thread) & ~os.SCHED_RESET_ON_FORK:
                return  # no client wants realtime scheduling now, or this thread has another scheduling
            self._nice[thread] = nice
            if nice > NICE:
                os.sched_setscheduler(thread, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.sched_param(0))
                os.setpriority(os.PRIO_PROCESS, thread, NICE)

    def _restore_nice(self) -> None:
        while self._nice:
            thread, nice = self._nice.popitem()
            if Path(f"/proc/self/task/{thread}").exists():
                os.setpriority(os.PRIO_PROCESS, thread, nice)

    @property
    def is_realtime(self) -> bool:
        return self._c is not None and bool(lib.md_engine_is_realtime(self._c))


class Realtime:
    """A client's request for realtime scheduling of the C core's thread, which then precedes normal threads.

    The thread has realtime scheduling while any client requests it. It returns to normal scheduling by itself
    if it uses more than half of a processor.
    """

    def __init__(self) -> None:
        self.is_wanted = False
        self.is_held = False  # whether realtime scheduling was granted, and has not ended by itself since

    def want(self, wanted: bool) -> None:
        """Request realtime scheduling, or withdraw the request. Raises OSError if the system refuses."""
        if wanted != self.is_wanted:
            self.is_wanted = wanted
            self.is_held = False  # first: `has_ended` must not report an end that was requested
            _engine.set_realtime(self, wanted)
            self.is_held = wanted

    def lower_nice(self) -> None:
        """Let the calling thread run before most normal threads, if realtime scheduling was granted.

        Threads that pass on polled values call this. Raises OSError if the system refuses; another call from
        the same thread then does nothing.
        """
        if self.is_held:
            _engine.lower_nice()

    def has_ended(self) -> bool:
        """Return True if the thread has returned to normal scheduling by itself; True only once."""
        has_ended = self.is_held and not _engine.is_realtime
        self.is_held &= not has_ended
        return has_ended


REALTIME_ENDED = "realtime has ended: the lines took more than half of a processor; poll fewer or slower"


def why_not_realtime(failure: OSError) -> str:
    """Return why the system refused realtime scheduling, and what would permit it."""
    if failure.errno == errno.ENOSYS:
        return "this system is neither Linux nor Windows"
    if sys.platform == "win32":
        return "the multimedia class scheduler refuses it; start the service MMCSS"
    return (
        f"the system refuses it ({failure.strerror}); permit it with LimitRTPRIO=1 and RestrictRealtime=no "
        'in the systemd unit, or with "USER - rtprio 1" in /etc/security/limits.conf and a new login'
    )


WHY_NOT_NICE = (
    "values may reach the program late: permit it with LimitNICE=-10 in the systemd unit, or with "
    '"USER - nice -10" in /etc/security/limits.conf and a new login'
)


def wake_lateness(seconds: float, *, realtime: bool) -> list[float]:
    """Sleep repeatedly, as the C core does, for `seconds` s in total; return how late each sleep ended, in s.

    Raises OSError if `realtime` scheduling is refused.
    """
    count = round(seconds / WAKE_PERIOD_S)
    late = ffi.new("int64_t[]", count)
    failure = lib.md_wake_lateness(realtime, round(WAKE_PERIOD_S * 1e9), late, count)
    if failure:
        raise OSError(-failure, os.strerror(-failure))
    return [max(0, each) / 1e9 for each in ffi.unpack(late, count)]


# ---- the settings of a port ----


REFUSALS = {
    lib.MD_REFUSED_BAUDRATE: "baud rate",
    lib.MD_REFUSED_DATABITS: "data bits",
    lib.MD_REFUSED_PARITY: "parity",
    lib.MD_REFUSED_STOPBITS: "stop bits",
}
# refused because no whole divisor of the UART's clock gives the baud rate
NO_DIVISOR = int(lib.MD_REFUSED_DIVISOR)


def is_pseudo_terminal(device: str) -> bool:
    return device.startswith(("/dev/pts/", "/dev/ttys"))


def must_take(device: str) -> int:
    """Return the mask (of REFUSALS) of the settings that a device must not refuse.

    A pseudo-terminal may refuse all settings except the baud rate.
    """
    return int(lib.MD_REFUSED_BAUDRATE) if is_pseudo_terminal(device) else sum(REFUSALS)


def refused_names(mask: int) -> str:
    return ", ".join(name for bit, name in REFUSALS.items() if mask & bit)


def possible_rates(fd: int, baudrate: int) -> tuple[int, int, int]:
    """Return the rate that a UART would use for `baudrate`, and the nearest rates below and above."""
    base = int(lib.md_port_baud_base(fd))
    divisor = (base + baudrate // 2) // baudrate
    return base // divisor, base // -(-base // baudrate), base // (base // baudrate)


def close_behind(fd: int, other: int, seconds: float) -> None:
    """Close the port behind descriptor `fd`, which then refers to the file of descriptor `other`.

    The port's driver may still send for `seconds` s; then it discards its unsent bytes.
    """
    lib.md_port_close(fd, other, round(seconds * 1e9))


def get_settings(fd: int) -> tuple[int, str]:
    """Return a port's present baud rate and format. Raises OSError if the port has no such settings."""
    settings = ffi.new("struct md_settings *")
    failure = lib.md_port_get(fd, settings)
    if failure:
        raise OSError(-failure, "the port has no serial settings")
    return settings.baudrate, f"{settings.databits}{settings.parity.decode()}{settings.stopbits}"


def set_settings(fd: int, baudrate: int, format: str) -> int:
    """Put a port in raw mode with these settings; return the mask (of REFUSALS) of the refused settings.

    Raises OSError if the port has no settings.
    """
    refused = lib.md_port_set(fd, ffi.new("struct md_settings *", settings_to_c(baudrate, format)))
    if refused < 0:
        raise OSError(-refused, "the port has no serial settings")
    return int(refused)


# ---- ports ----


class _PortMemory:
    """All memory of Python objects that the C core's thread reads or writes for one port.

    Store an object here before passing it to the C core.
    """

    def __init__(self, room: int, mastership: Mastership | None) -> None:
        self.mastership = mastership
        self.lasting: set[object] = set()  # objects kept until the port closes
        self.queued: list[Exchange | None] = [None] * room  # queued exchanges, by index in the C core's ring
        self._newest: dict[str, tuple[object, ...]] = {}

    @contextmanager
    def replacing(self, kind: str, new: object) -> Iterator[None]:
        """Keep the new object of this kind alive; within the block, keep the replaced object alive too."""
        self._newest[kind] = (*self._newest.get(kind, ()), new)
        yield
        self._newest[kind] = (new,)


_engine = _Engine()


def _owner_of(port: Any, memory: _PortMemory) -> Any:
    """Return the owner of a port and of its memory.

    When the last reference to the owner is gone, the C core's thread first releases the port. Then the memory
    is freed. That order is certain, also at interpreter exit: cffi calls its destructor before it drops the
    handle, and the garbage collector calls all destructors before it frees memory. No Python code runs in
    between, so no signal can interrupt this.
    """
    return ffi.gc(ffi.new_handle(memory), partial(lib.md_port_free, port))


def _stop(port: Any, memory: _PortMemory) -> None:
    """Stop an unreferenced port while all of its memory still exists.

    The garbage collector calls this before it finalizes other objects, such as the descriptor's owner.
    """
    lib.md_port_stop(port)


class Port:
    """A descriptor on which the C core's thread carries out exchanges (struct md_port).

    `must_take` is a mask (of REFUSALS): the settings that the port must not refuse. It is -1 for a port that
    has no settings, such as a socket. `room` is the length of the queue, a power of two. `transactions` is
    None for every framing except Modbus TCP. With a `mastership`, requests are sent only before its deadline.

    Raises OSError if the descriptor cannot be polled.
    """

    def __init__(
        self,
        fd: int,
        must_take: int,
        room: int = 256,
        *,
        transactions: TransactionIds | None = None,
        mastership: Mastership | None = None,
    ) -> None:
        self.room = room
        self._memory = _PortMemory(room, mastership)
        self._is_inherited = False
        self.c = lib.md_port_open(_engine.c, fd, must_take, TRANSACTIONS[transactions], room)
        if self.c == ffi.NULL:
            raise OSError(ffi.errno, "the core cannot watch the port")
        self._owner = _owner_of(self.c, self._memory)
        self._abandoned = finalize(self, _stop, self.c, self._memory)
        # not called at exit, because other exit handlers may still use the port
        self._abandoned.atexit = False
        if mastership is not None:
            lib.md_port_fence(self.c, mastership.c)
        # Python reads this struct directly: a call into the C core would release the GIL and wait for it
        # again.
        self._progress = lib.md_port_progress(self.c)
        register_at_fork(self)

    def forked(self) -> None:
        """Leave the port to the parent, because a forked child has no engine thread."""
        self._abandoned.detach()
        ffi.gc(self._owner, None)
        self._is_inherited = True

    done = number_at("_progress.done")  # number of queued exchanges that ended; wraps around at 2^32
    lost = flag_at("_progress.lost")  # whether the descriptor failed: no further exchange is sent
    lost_error = number_at("_progress.lost_error")  # errno of the loss; 0 if the far end hung up
    # whether the port repeats exchanges; False once it is lost or an exchange cannot be sent
    repeating = flag_at("_progress.repeating")
    # whether the port was lost during a polled exchange, after it had delivered a good reply
    cut_off = flag_at("_progress.cut_off")
    # whether at the last timeout the driver still held the request, and no reply has come since
    is_stalled = flag_at("_progress.stalled")
    # whether the driver's count of unsent bytes is ignored: it stayed above 0 although replies came
    miscounts = flag_at("_progress.miscounts")
    # 1 if the driver may still hold bytes of a command that has ended, which must be discarded
    called_off = number_at("_progress.called_off")  # not a bool, because reading a number is faster
    # number of another master's bytes, received while the port listened before its first request
    foreign = number_at("_progress.foreign")

    def tap(self, tap: Tap) -> None:
        """Copy all bytes of the line to this tap from now on, and none to the previous tap."""
        with self._memory.replacing("tap", tap):
            lib.md_port_tap(self.c, tap.c)

    def set_echo(self, echo: Echo) -> None:
        """Set whether the adapter returns a copy (echo) of each request."""
        lib.md_port_set_echo(self.c, _ECHOES[echo])

    def switch(self, rs485: RS485, is_usb: bool = False) -> None:
        """Set what switches the transceiver between receiving and sending. Call before the first request.

        A USB adapter (`is_usb`) does not report when a request has left. Raises OSError if the driver
        refuses.
        """
        failure = lib.md_port_rs485(self.c, _SWITCHES[rs485], is_usb)
        if failure:
            raise OSError(-failure, "the RS-485 transceiver cannot be switched to sending or receiving")

    def is_asking(self, peer: Peer) -> bool:
        """Return True while an exchange with this drive is queued, repeated, urgent or in flight."""
        return bool(lib.md_port_is_asking(self.c, peer.c))

    def counted_ns(self) -> int:
        """Return the time in ns up to which the use of the line has been counted."""
        return int(lib.md_port_counted_ns(self.c))

    def inherit(self, peer: Peer, before: Peer) -> None:
        """Expect late replies to requests of `before` too: an earlier drive at the same address."""
        self._memory.lasting.update((peer, before))
        lib.md_port_inherit(self.c, peer.c, before.c)

    def end(self) -> bool:
        """Start only urgent exchanges from now on. Return True while a polled exchange is in flight."""
        return bool(lib.md_port_end(self.c))

    def stop(self) -> None:
        """Stop all exchanges and give the descriptor back. The port's counters stay readable."""
        if not self._is_inherited:
            lib.md_port_stop(self.c)

    close = stop

    def report_to(self, row_queue: RowQueue, number: int) -> None:
        """Deliver rows to `row_queue`, and wake its reader when the port needs attention.

        `row_queue.await_calls` then returns `number`. The port needs attention if few queued exchanges are
        left, if repeated exchanges have stopped, or if the port is lost. It also needs attention if a drive
        refuses a request, does not answer, or answers again.
        """
        with self._memory.replacing("rows", row_queue):
            lib.md_port_report(self.c, row_queue.c, number)

    def repeat(self, exchanges: Sequence[Exchange]) -> int:
        """Carry out these exchanges in turn, whenever no queued exchange is due, until the next call.

        Return which of the previous exchanges would have come next, as an index.
        """
        # keep old exchanges alive too: one may still be in flight after new exchanges have replaced it
        self._memory.lasting.update(exchanges)
        rounds = ffi.new("struct md_exchange *[]", [exchange.c for exchange in exchanges])
        with self._memory.replacing("round", rounds):
            return int(lib.md_port_repeat(self.c, rounds, len(exchanges)))

    def submit(self, exchanges: Sequence[Exchange], not_before_ns: Sequence[int]) -> int:
        """Queue exchanges, each with its earliest start in ns; return how many fitted into the queue."""
        todo = ffi.new("struct md_exchange *[]", [exchange.c for exchange in exchanges])
        times = ffi.new("int64_t[]", not_before_ns)
        # keep the drives' records: late replies may still come
        self._memory.lasting.update(exchange.peer for exchange in exchanges)
        free = exchanges[: self.room - self.pending]
        for at, exchange in enumerate(free, int(self._progress.submitted)):
            self._memory.queued[at & (self.room - 1)] = exchange
        return int(lib.md_port_submit(self.c, todo, times, len(free)))

    @property
    def pending(self) -> int:
        """The number of queued exchanges that have not ended."""
        return (int(self._progress.submitted) - self.done) & 0xFFFF_FFFF

    @property
    def has_echo(self) -> bool:
        """True once the adapter is known to echo; the C core then never mistakes an echo for a reply."""
        return int(self._progress.echo) == int(lib.MD_ECHO)

    @property
    def switching(self) -> float:
        """The average duration of a change of baud rate or format, in s; 0 before the first change."""
        return float(self._progress.switching_ns) / 1e9 / max(int(self._progress.switches), 1)

    def carry_out(
        self, exchange: Exchange, not_before_ns: int = 0, expires_ns: int = 0, into: Completion | None = None
    ) -> Completion:
        """Carry out an exchange before all queued ones, wait for it, and return its completion.

        Reuse the completion `into` if it has room for the values. The request is not sent after
        `expires_ns` (CLOCK_BOOTTIME; 0: no limit), nor after a stop has revoked the exchange's permit.
        """
        self._memory.lasting.add(exchange.peer)  # keep the drive's record: a late reply may still come
        found = into if into is not None and into.room == exchange.room else Completion(room=exchange.room)
        found.count = lib.md_port_carry_out(
            self.c, exchange.c, not_before_ns, expires_ns, found.c, found.values
        )
        return found
