"""Permissions to send: a drive's permits end with a stop, a process's mastership at a deadline."""

from __future__ import annotations

import errno
import threading
from dataclasses import dataclass
from typing import Any
from weakref import finalize

from multidrop._core import ffi, lib
from multidrop.core.fork import register_at_fork


class Latch:
    """The stops of one drive, counted; the core compares the count right before a request begins to leave.

    `rise` takes no lock: a signal handler may call it.
    """

    def __init__(self) -> None:
        self.c: Any = ffi.new("uint32_t *")
        self.why = ""  # of the last rise, or of its shutting
        self._is_shut = False
        self._holds: set[object] = set()  # stops under way

    def rise(self, why: str) -> None:
        """End every permit that there is."""
        if not self._is_shut:
            self.why = why
        lib.md_count_stop(self.c)

    def shut(self, why: str) -> None:
        """Rise for good: no permit is good any more."""
        if not self._is_shut:
            self.why = why
        self._is_shut = True
        self.rise(why)

    def hold(self, stop: object, why: str) -> None:
        """Rise, and stay so until it is let go: no permit that is asked for meanwhile is good."""
        self._holds.add(stop)
        self.rise(why)

    def let_go(self, stop: object) -> None:
        """End this stop's hold, if there is one."""
        self._holds.discard(stop)

    def permit(self, seen: int | None = None) -> Permit:
        """Return a permit that is good until the latch rises; while a stop is under way it never is.

        `seen`: what `c[0]` was when the call began that needs it.
        """
        if seen is None:
            seen = int(self.c[0])
        if self._is_shut or self._holds:  # read after `seen`: a rise between the two ends this permit
            seen = (seen - 1) & 0xFFFF_FFFF
        return Permit(self, seen)


@dataclass(frozen=True)
class Permit:
    """The permission to write what may move a motor, until a stop is called."""

    latch: Latch
    seen: int

    @property
    def is_good(self) -> bool:
        return int(self.latch.c[0]) == self.seen


GUARD_S = 0.7
MOST_GUARD_S = 3600.0
MOST_NS = 1 << 62

boottime_ns = lib.md_boottime_ns


class Mastership:
    """The right to send on lines that other processes may be masters of, too, until a deadline.

    Times are ns of CLOCK_BOOTTIME, as `time.clock_gettime_ns(time.CLOCK_BOOTTIME)` has them. It does not hold
    before the first `extend`. Ports that have it look at the clock right before each write: after the
    deadline nothing is sent, not even a stop. Where this process stands still until half of `guard_s`, in s,
    after its deadline, the kernel kills it with SIGKILL, so that nothing is sent when it goes on. Whoever
    takes its lines over listens to each for at least `guard_s` before the first request, and only a stop
    goes at once. Any thread may call these.

    Raises NotImplementedError where the system is not Linux, and ValueError for a guard that is no time.
    """

    def __init__(self, guard_s: float = GUARD_S) -> None:
        if isinstance(guard_s, bool) or not isinstance(guard_s, (int, float)):
            raise TypeError(f"guard_s is a number of seconds, not {guard_s!r}")
        if not 0 < guard_s <= MOST_GUARD_S:
            raise ValueError(f"guard_s = {guard_s!r} must be above 0 and at most {MOST_GUARD_S:g}, in s")
        self.guard_s = float(guard_s)
        c = lib.md_mastership_new(round(self.guard_s * 1e9))
        if c == ffi.NULL and ffi.errno == errno.ENOSYS:
            raise NotImplementedError(
                "a mastership needs Linux, whose kernel can end a process that stands still"
            )
        if c == ffi.NULL:
            raise OSError(ffi.errno, "the kernel's timer cannot be made")
        self.c: Any = c
        self._free = finalize(self, lib.md_mastership_free, c)
        self._free.atexit = False  # ports may still look at it
        self._is_inherited = False
        self._lock = threading.Lock()  # of the deadline and its timer, which go together
        register_at_fork(self)

    def forked(self) -> None:
        """Hold no more in the child, whose parent is the master; the timer is the parent's."""
        self._free.detach()
        self._is_inherited = True
        self._lock = threading.Lock()

    def __repr__(self) -> str:
        state = f"until {self.until_ns}" if self.until_ns else "not held"
        return f"<Mastership {state}, guard {self.guard_s:g} s>"

    @property
    def until_ns(self) -> int:
        """The deadline; 0 before the first `extend` and after `end`."""
        return 0 if self._is_inherited else int(lib.md_mastership_until_ns(self.c))

    @property
    def holds(self) -> bool:
        """True until the deadline."""
        return not self._is_inherited and bool(lib.md_mastership_holds(self.c))

    def extend(self, until_ns: int) -> None:
        """Hold until this time, and put the kernel's timer off to half of the guard after it.

        A time before the present deadline changes nothing. After `end` it holds anew. Raises ValueError for
        a time that is past, and nothing has changed: a timer that is set to the past would kill at once.
        """
        if isinstance(until_ns, bool) or not isinstance(until_ns, int):
            raise TypeError(f"until_ns is a whole number of ns of CLOCK_BOOTTIME, not {until_ns!r}")
        if self._is_inherited:
            raise ValueError("this mastership is of the process that was forked: make another one here")
        late_ns = boottime_ns() - until_ns
        if late_ns >= 0:
            raise ValueError(
                f"until_ns = {until_ns} is past, by {late_ns / 1e9:.3f} s of CLOCK_BOOTTIME: a mastership is "
                "extended to a time to come"
            )
        if until_ns > MOST_NS:
            raise ValueError(f"until_ns = {until_ns} is beyond {MOST_NS}: give ns of CLOCK_BOOTTIME")
        kill_ns = until_ns + round(self.guard_s * 1e9 / 2)
        with self._lock:
            if until_ns > self.until_ns and lib.md_mastership_extend(self.c, until_ns, kill_ns):
                raise OSError(ffi.errno, "the kernel's timer cannot be set")

    def end(self) -> None:
        """Hold no more: nothing is sent once this returns, and the kernel's timer is called off.

        What the system has been given and has not sent yet is discarded when the lines' ports are closed:
        remove the lines first.
        """
        if self._is_inherited:
            return
        with self._lock:
            lib.md_mastership_end(self.c)
