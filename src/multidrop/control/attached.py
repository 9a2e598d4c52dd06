"""Attached: the drives of a bus; the bus carries out their verbs. A drive is on one bus at a time."""

from __future__ import annotations

import threading
from collections.abc import Iterable
from typing import Any, TypeVar

from multidrop.control.latches import Latches
from multidrop.control.outcome import Outcome
from multidrop.control.performer import Performer
from multidrop.control.stops import Stopper
from multidrop.control.time_limit import MOST_EXPIRY_S, check_expiry
from multidrop.core import Latch, Message
from multidrop.drive.family import Drive, check_own, check_own_text
from multidrop.drive.register import Register
from multidrop.drive.text import Text
from multidrop.transport.exchange import Exchanges

D = TypeVar("D", bound=Drive)


def made(drive: D | type[D], address: int | None, line: dict[str, Any], details: dict[str, Any]) -> D:
    """Return `drive`, or, if it is a family, a new drive of that family.

    `line` and `details` are options of the new drive; `details` override `line`. Raises TypeError for any
    other object, for a missing address, and for details of an existing drive.
    """
    family = drive if isinstance(drive, type) else type(drive)
    if not issubclass(family, Drive):
        raise TypeError(f"attach takes a family such as InnovertIBD, or a drive of one, not {drive!r}")
    if isinstance(drive, type):
        if address is None:
            raise TypeError(f"attach({drive.__name__}, address=...): the address is missing")
        return drive(address, **{**line, **details})
    if address is not None or details:
        raise TypeError(f"{drive.name} already exists: give its address and options to {family.__name__}(…)")
    return drive


class BusLink:
    """The link through which drives of a bus read and write when their own methods are called."""

    def __init__(self, exchanges: Exchanges, performer: Performer) -> None:
        self._exchanges = exchanges
        self._performer = performer

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


class Attached:
    """The drives of a bus; any thread may add and remove them."""

    def __init__(
        self, bus: Any, exchanges: Exchanges, latches: Latches, performer: Performer, stopper: Stopper
    ) -> None:
        self.drives: list[Drive] = []
        self.lock = threading.RLock()  # one drive is added or removed at a time
        self._bus = bus
        self._exchanges = exchanges
        self._latches = latches
        self._performer = performer
        self._stopper = stopper
        self._link = BusLink(exchanges, performer)

    def forked(self) -> None:
        """Release the drives in a forked child, so that a bus of the child can have them."""
        self.lock = threading.RLock()
        self._free(self.drives)

    def add(self, drive: Drive) -> None:
        """Attach a drive. Raises ValueError if its address is taken or it is on another bus."""
        with self.lock:
            for other in self.drives:
                if other.address == drive.address:
                    raise ValueError(f"address {drive.address} is taken by {other.name}")
            owner = vars(drive).setdefault("bus", self._bus)  # atomic: two buses cannot both take the drive
            if owner is not self._bus and owner.is_open:
                raise ValueError(
                    f"{drive.name} is on the bus at {owner.line.port}: detach it there first, or create "
                    "another drive object"
                )
            self._exchanges.add(drive)
            self._give_verbs(drive, self._latches.add(drive))
            self.drives = [*self.drives, drive]  # replaced, never mutated: readers iterate without a lock

    def _give_verbs(self, drive: Drive, latch: Latch) -> None:
        bus, performer, stopper = self._bus, self._performer, self._stopper
        drive.bus = bus
        drive.link = self._link
        drive.perform = lambda script: performer.perform(script, performer.call(drive))
        drive.stops_called = latch.c
        drive.begin_call = lambda verb, seen: performer.call(drive, verb, seen)
        drive.carry_out_move = performer.move
        drive.begin_stop = lambda verb, script, seconds: stopper.stop(drive, verb, script, seconds)

    def remove(self, drive: Drive) -> None:
        """Remove a drive from the bus. Raises NotAttached if it is not there."""
        with self.lock:
            self._exchanges.peer(drive)
            self.drives = [other for other in self.drives if other is not drive]
            self._exchanges.remove(drive)
            self._free([drive])

    def free(self) -> None:
        """Release the drives once this bus is closed, so that other buses can have them."""
        with self.lock:
            self._free(self.drives)

    def _free(self, drives: Iterable[Drive]) -> None:
        for drive in drives:
            if drive.bus is self._bus:
                del drive.bus
