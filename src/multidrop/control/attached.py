"""The drives of a bus, and what happens when they leave it. A drive is on one bus at a time.

`Attached` holds the drives. `Leaving` cancels their calls and stops their motors when drives are detached,
the bus is closed or the process exits.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeVar

from multidrop.control.call import MOST_EXPIRY_S, Call, Latches, check_expiry
from multidrop.control.exit_hook import ExitTask, exit_hook
from multidrop.control.outcome import Outcome, Stopped
from multidrop.control.performer import Performer
from multidrop.control.stops import Stopper
from multidrop.core import Message
from multidrop.drive.family import Drive, check_own, check_own_text
from multidrop.drive.register import Register
from multidrop.drive.text import Text
from multidrop.drive.verbs import CalledStop, Script
from multidrop.errors import LineError
from multidrop.transport.aside_log import log_aside
from multidrop.transport.exchange import Exchanges

D = TypeVar("D", bound=Drive)

_log = logging.getLogger("multidrop.bus")


def made(drive: D | type[D], address: int | None, line: dict[str, Any], details: dict[str, Any]) -> D:
    """Return `drive`; if it is a class, create a drive of that class.

    `line` and `details` are options of the new drive; `details` override `line`. Raises TypeError if `drive`
    is neither a drive nor a class of drives, if the address is missing, or if details are given for an
    existing drive.
    """
    family = drive if isinstance(drive, type) else type(drive)
    if not issubclass(family, Drive):
        raise TypeError(f"attach needs a family such as YD1000, or a drive such as YD1000(1), not {drive!r}")
    if isinstance(drive, type):
        if address is None:
            raise TypeError(f"attach({drive.__name__}, address=...): the address is missing")
        return drive(address, **{**line, **details})
    if address is not None or details:
        raise TypeError(f"{drive.name} already exists: give its address and options to {family.__name__}(…)")
    return drive


class BusLink:
    """Carries out the reads, writes and stops that the methods of a bus's drives request."""

    def __init__(self, exchanges: Exchanges, performer: Performer, stopper: Stopper) -> None:
        self._exchanges = exchanges
        self._performer = performer
        self._stopper = stopper

    def values(self, drive: Drive, registers: tuple[Any, ...]) -> dict[str, Any]:
        try:
            return self._exchanges.read(drive, registers)
        except TypeError:  # an unhashable argument cannot be a register
            for register in registers:
                if not isinstance(register, str):
                    check_own(drive, register)
            raise

    def text(self, drive: Drive, text: Text) -> str:
        check_own_text(drive, text)
        return self._exchanges.read_text(drive, text)

    def write(self, drive: Drive, register: Register[Any], value: Any) -> Outcome:
        return self._performer.write(drive, register, value)

    def read_raw(
        self,
        drive: Drive,
        function: int,
        start: int,
        count: int,
        expiry: float = MOST_EXPIRY_S,
        attempts: int = 1,
    ) -> bytes:
        check_expiry(expiry)
        return self._exchanges.ask(drive, function, start, count, expiry, attempts)

    def send_raw(self, drive: Drive, function: int, start: int, data: bytes, count: int) -> bytes:
        if not isinstance(data, bytes | bytearray):
            raise TypeError(f"data = {data!r}: it must be bytes, such as b'\\x00\\x01'")
        return self._performer.raw(drive, Message(drive.address, function, start, count, data))

    def perform(self, drive: Drive, script: Script[Any]) -> Any:
        return self._performer.perform(script, self._performer.call(drive))

    def begin_call(self, drive: Drive, verb: str, seen: int) -> Call:
        return self._performer.call(drive, verb, seen)

    def carry_out_move(self, drive: Drive, script: Script[Any], call: Call) -> Any:
        return self._performer.move(script, call)

    def begin_stop(
        self, drive: Drive, verb: str, make: Callable[[], Script[Any]], seconds: float | None
    ) -> CalledStop:
        return self._stopper.stop(drive, verb, make, seconds)


class Attached:
    """The drives of a bus; any thread may add and remove them."""

    def __init__(
        self, bus: Any, exchanges: Exchanges, latches: Latches, performer: Performer, stopper: Stopper
    ) -> None:
        self.drives: list[Drive] = []
        self.lock = threading.RLock()  # held by a thread while it adds or removes a drive
        self._bus = bus
        self._exchanges = exchanges
        self._latches = latches
        self._link = BusLink(exchanges, performer, stopper)

    def forked(self) -> None:
        """Release the drives in a forked child, so that they can be attached to a bus of the child."""
        self.lock = threading.RLock()
        self._free(self.drives)

    def add(self, drive: Drive) -> None:
        """Attach a drive. Raises ValueError if its address is taken, or if the drive is on another bus.

        Raises LineError if this bus is closed.
        """
        with self.lock:
            if not self._bus.is_open:
                raise LineError(self._bus.line.port, f"its bus is closed: open a new one for {drive.name}")
            for other in self.drives:
                if other.address == drive.address:
                    raise ValueError(f"address {drive.address} is taken by {other.name}")
            # `setdefault` is atomic: two buses cannot both take the drive
            owner = vars(drive).setdefault("bus", self._bus)
            if owner is not self._bus and owner.is_open:
                raise ValueError(
                    f"{drive.name} is on the bus at {owner.line.port}: detach it there first, or create "
                    "another drive object"
                )
            self._exchanges.peers.add(drive)
            drive.bus = self._bus
            drive.stops_called = self._latches.add(drive).c
            drive.link = self._link
            self.drives = [*self.drives, drive]  # replaced, never mutated: readers iterate without a lock

    def remove(self, drive: Drive) -> None:
        """Remove a drive from the bus. Raises NotAttached if it is not there."""
        with self.lock:
            self._exchanges.peers.of(drive)
            self.drives = [other for other in self.drives if other is not drive]
            self._exchanges.remove(drive)
            self._free([drive])

    def free(self) -> None:
        """Release the drives once this bus is closed, so that they can be attached to other buses."""
        with self.lock:
            self._free(self.drives)

    def _free(self, drives: Iterable[Drive]) -> None:
        for drive in drives:
            if drive.bus is self._bus:
                del drive.bus


# ---- leaving the bus ----


class Leaving:
    """Cancels all calls on a bus when it ends, and stops its drives if `stop_on_exit` was called."""

    def __init__(
        self,
        latches: Latches,
        stopper: Stopper,
        stop_all: Callable[[], Mapping[str, Stopped]],
        drives: Callable[[], Sequence[Drive]],
    ) -> None:
        self._drives = drives
        self._latches = latches
        self._stopper = stopper
        self._stop_all = stop_all
        self._exit_task: ExitTask | None = None
        # results of the stops at exit, by drive name
        self.found: Mapping[str, Stopped] = {}

    @property
    def stops(self) -> bool:
        """True once `stop_on_exit` was called."""
        return self._exit_task is not None

    def stop_on_exit(self) -> None:
        """Stop all drives when the bus is closed or the process ends.

        The first call raises ValueError outside the main thread.
        """
        if self._exit_task is None:
            self._exit_task = exit_hook().add(
                self._latches.shut, self._act, lambda: [drive.name for drive in self._drives()]
            )

    def _act(self) -> None:
        self.found = self._stop_all()
        _warn_of(self.found)

    def begin(self) -> None:
        """Cancel all calls on the bus; start to stop the drives if `stop_on_exit` was called.

        Does not wait for the end of the stops.
        """
        self._latches.shut()
        if self._exit_task is not None:
            self._exit_task.begin()

    def finish(self) -> None:
        """Cancel all calls, stop the drives if `stop_on_exit` was called, and wait for all stops."""
        self.begin()
        if self._exit_task is not None:
            exit_hook().finish(self._exit_task)
        if self._exit_task is None or not self._exit_task.is_cut_short:
            self._latches.await_stops()

    def part_with(self, drives: Sequence[Drive], to_stop: Sequence[Drive]) -> None:
        """Cancel the calls of drives that are about to be detached, and wait for their unfinished stops.

        If `stop_on_exit` was called, stop the drives `to_stop` before that wait.
        """
        self._latches.end(drives)  # cancel calls first: a start sent after the stops would not be stopped
        motors = [drive for drive in to_stop if drive.has_motor]
        if motors and self.stops:
            run = self._stopper.stop_all(motors, lambda: False, None)
            try:
                run.carry_out()
            except BaseException as interruption:
                run.interrupted(interruption)
                raise
            _warn_of(run.found())
        self._latches.await_stops(drives)


def _warn_of(found: Mapping[str, Stopped]) -> None:
    for stopped in found.values():
        if not stopped.ok:
            log_aside(_log, logging.WARNING, "%s", stopped)
