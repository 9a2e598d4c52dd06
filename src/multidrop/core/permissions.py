"""Permissions to send: permits, which a drive's stop ends, and a mastership, which a deadline ends."""

from __future__ import annotations

import errno
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any
from weakref import finalize

from multidrop._core import ffi, lib
from multidrop.core.process import register_at_fork


class Latch:
    """A drive's stop counter, which the C core checks right before a request is sent.

    `count` is the number of stops so far: a drive that is attached again gets a new latch, which continues
    the count. `revoke` takes no lock, so a signal handler may call it.
    """

    def __init__(self, count: int = 0) -> None:
        self.c: Any = ffi.new("uint32_t *", count)
        self.why = ""  # why permits were last revoked; after `shut`, why no permit is valid
        self._is_shut = False
        self._holds: set[object] = set()  # stops in progress, during which new permits are invalid

    def revoke(self, why: str) -> None:
        """Make all existing permits invalid, so that their writes are not sent."""
        if not self._is_shut:
            self.why = why
        lib.md_count_stop(self.c)

    def shut(self, why: str) -> None:
        """Revoke all permits; from now on, new permits are invalid too."""
        if not self._is_shut:
            self.why = why
        self._is_shut = True
        self.revoke(why)

    def hold(self, stop: object, why: str) -> None:
        """Revoke all permits; new ones are invalid too until `let_go` is called for this stop."""
        self._holds.add(stop)
        self.revoke(why)

    def let_go(self, stop: object) -> None:
        """Allow writes again after the `hold` for this stop, unless another stop is in progress."""
        self._holds.discard(stop)

    def permit(self, seen: int | None = None) -> Permit:
        """Return a permit that is valid until permits are revoked.

        A permit made during a stop or after `shut` is never valid.

        `seen` is the value of the stop counter `c[0]` at the start of the call that needs the permit.
        """
        if seen is None:
            seen = int(self.c[0])
        # checked only now, so that a stop after `seen` was read is noticed
        if self._is_shut or self._holds:
            seen = (seen - 1) & 0xFFFF_FFFF
        return Permit(self, seen)


@dataclass(frozen=True)
class Permit:
    """The permission for a write that may move a motor; it ends when the drive's stop is called."""

    latch: Latch
    seen: int

    @property
    def is_good(self) -> bool:
        return int(self.latch.c[0]) == self.seen


GUARD_S = 0.7
MOST_GUARD_S = 3600.0
MOST_NS = 1 << 62

boottime_ns: Callable[[], int] = lib.md_boottime_ns


class Mastership:
    """The right to send on lines that other processes may also use, until a deadline.

    Times are ns of CLOCK_BOOTTIME, as from `time.clock_gettime_ns(time.CLOCK_BOOTTIME)`. A mastership does
    not hold before the first `extend`. Its ports check the clock right before each write: after the deadline
    they send no bytes, not even a stop. If the process is still suspended `guard_s / 2` seconds after the
    deadline, a kernel timer kills it with SIGKILL, so that it cannot send when it resumes. The next master
    listens to each line for at least `guard_s` before its first request; only stops are sent immediately.
    Thread-safe.

    Raises NotImplementedError on other systems than Linux, and ValueError if `guard_s` is out of range.
    """

    def __init__(self, guard_s: float = GUARD_S) -> None:
        if isinstance(guard_s, bool) or not isinstance(guard_s, (int, float)):
            raise TypeError(f"guard_s must be a number of seconds, not {guard_s!r}")
        if not 0 < guard_s <= MOST_GUARD_S:
            raise ValueError(f"guard_s = {guard_s!r} must be above 0 and at most {MOST_GUARD_S:g}, in s")
        self.guard_s = float(guard_s)
        c = lib.md_mastership_new(round(self.guard_s * 1e9))
        if c == ffi.NULL and ffi.errno == errno.ENOSYS:
            raise NotImplementedError("a mastership needs Linux, whose kernel can kill a suspended process")
        if c == ffi.NULL:
            raise OSError(ffi.errno, "the kernel's timer cannot be created")
        self.c: Any = c
        self._free = finalize(self, lib.md_mastership_free, c)
        self._free.atexit = False  # the struct is not freed at exit, because ports may still use it
        self._is_inherited = False
        self._lock = threading.Lock()  # held while the deadline and its timer are changed together
        register_at_fork(self)

    def forked(self) -> None:
        """End the mastership in a forked child, because the mastership and its timer belong to the parent."""
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
        """True while this process may send: the deadline has not passed."""
        return not self._is_inherited and bool(lib.md_mastership_holds(self.c))

    def extend(self, until_ns: int) -> None:
        """Set the deadline to this time, unless the present deadline is later.

        The first call starts the mastership, and the first call after `end` starts it again. The kernel's
        timer is set to `guard_s / 2` seconds after the deadline: if the process is suspended then, the timer
        kills it.

        Raises ValueError for a time in the past, and changes nothing: the timer would kill this process at
        once.
        """
        if isinstance(until_ns, bool) or not isinstance(until_ns, int):
            raise TypeError(f"until_ns must be a whole number of ns of CLOCK_BOOTTIME, not {until_ns!r}")
        if self._is_inherited:
            raise ValueError("this mastership belongs to the parent of this forked process: create a new one")
        late_ns = boottime_ns() - until_ns
        if late_ns >= 0:
            raise ValueError(
                f"until_ns = {until_ns} is {late_ns / 1e9:.3f} s in the past of CLOCK_BOOTTIME: give a "
                f"later time"
            )
        if until_ns > MOST_NS:
            raise ValueError(f"until_ns = {until_ns} is beyond {MOST_NS}: give ns of CLOCK_BOOTTIME")
        kill_ns = until_ns + round(self.guard_s * 1e9 / 2)
        with self._lock:
            if until_ns > self.until_ns and lib.md_mastership_extend(self.c, until_ns, kill_ns):
                raise OSError(ffi.errno, "the kernel's timer cannot be set")

    def end(self) -> None:
        """End the mastership and disarm the kernel's timer; after this call no byte is written.

        Bytes in the system's output buffers may still be sent. Closing the ports discards these
        bytes, so remove the lines first.
        """
        if self._is_inherited:
            return
        with self._lock:
            lib.md_mastership_end(self.c)
