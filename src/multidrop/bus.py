"""Bus: a line with its drives; reads, writes, broadcasts, and the verbs of the drives on it."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterable
from contextlib import suppress
from math import inf
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar, cast
from weakref import WeakKeyDictionary

from multidrop.control.audit_log import AuditLog
from multidrop.control.eeprom_ledger import Ledger
from multidrop.control.exit_hook import LastAct, exit_hook
from multidrop.control.outcome import Outcome
from multidrop.control.performer import Performer
from multidrop.control.rules import check_own, check_plain, is_harmless, raw_count
from multidrop.control.stop_all import Seen, Stopped
from multidrop.control.writer import Writer
from multidrop.core import Echo, Message, Peer
from multidrop.core.fork import register_at_fork
from multidrop.drive.family import Drive
from multidrop.drive.register import Register
from multidrop.drive.script import Script, Write
from multidrop.drive.state import State
from multidrop.errors import BusError, Refused
from multidrop.transport.clock import now_ns
from multidrop.transport.exchange import LEAST_TIMEOUT, READ_ATTEMPTS, Exchanges, exchange
from multidrop.transport.line import Line
from multidrop.transport.statistics import LineStatistics, look

__all__ = ["LEAST_TIMEOUT", "READ_ATTEMPTS", "Bus", "exchange"]

D = TypeVar("D", bound=Drive)
T = TypeVar("T", bound=float)


class _Claims:
    """Which bus each drive is on: one at a time."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._buses: WeakKeyDictionary[Drive, Bus] = WeakKeyDictionary()
        register_at_fork(self)

    def forked(self) -> None:
        self._lock = threading.Lock()

    def claim(self, drive: Drive, bus: Bus) -> None:
        """Raise ValueError where another bus that is still open has it."""
        with self._lock:
            owner = self._buses.get(drive)
            if owner is not None and owner is not bus and owner.is_open:
                raise ValueError(
                    f"{drive.name} is on the bus at {owner.line.port}: detach it there first, or make another"
                )
            self._buses[drive] = bus

    def free(self, drive: Drive, bus: Bus) -> None:
        with self._lock:
            if self._buses.get(drive) is bus:
                del self._buses[drive]


_claims = _Claims()


class Bus:
    """A line and the drives on it, which may differ in family, baud rate and format.

    `port` is a device such as /dev/ttyUSB0 or any pyserial URL; `baudrate` and `format` replace the
    families' defaults for drives that are attached without their own, and `silence`, in s, the standard's
    t3.5 between frames, if all of them bear it. `echo` tells whether the adapter repeats what it sends: "on",
    "off", until it does, or "auto", to find out. Raises LineError when the port cannot be opened. Writes
    that may wear an EEPROM are counted in `ledger`, a file that all processes share, and all writes are
    noted in the file `audit`.

    A write is not sent when it is late by `expiry` seconds: since the verb was called, but for the time that
    its own looks may take. It is not sent either once a stop was called: that ends all that may move a motor
    and was called before it, on any thread, with Overtaken. A drive is on one bus at a time. Leaving the
    `with` block, or closing, waits for the stops that are under way and closes the port; it sends nothing,
    unless `stop_on_exit` was called, and nothing that moves a motor is sent after it.
    """

    def __init__(
        self,
        port: str,
        *,
        baudrate: int | None = None,
        format: str | None = None,
        silence: float | None = None,
        echo: str = "auto",
        ledger: Ledger | Path | str | None = None,
        audit: Path | str | None = None,
        expiry: float = 1.0,
    ) -> None:
        if isinstance(expiry, bool) or not isinstance(expiry, (int, float)) or not 0 < expiry < inf:
            raise ValueError(
                f"expiry = {expiry!r} is not a number of seconds above 0 for a write's turn to come"
            )
        self.baudrate = baudrate
        self.format = format
        self.silence = silence
        self.drives: list[Drive] = []
        self.line = Line(port, Echo(echo))
        try:
            log = AuditLog(audit) if audit else None
        except OSError:
            self.line.close()
            raise
        self._exchanges = Exchanges(self.line)
        book = ledger if isinstance(ledger, Ledger) else Ledger(ledger)
        self._writer = Writer(self._exchanges, book, log)
        self._performer = Performer(self._exchanges, self._writer, expiry)
        self._last_act: LastAct | None = None
        self._is_closed = False
        self._attaching = threading.RLock()  # one drive comes or goes at a time
        self._opened_ns = now_ns()
        self._reset_at = look(0.0, {}, self.line.overruns())
        self._at_last: LineStatistics | None = None  # when it was closed
        register_at_fork(self)

    def forked(self) -> None:
        """In the child nobody stops drives: the line is closed there."""
        self._is_closed = True
        self._attaching = threading.RLock()
        self._performer.forked()

    @property
    def is_open(self) -> bool:
        """It was not closed yet."""
        return not self._is_closed

    def __enter__(self) -> Bus:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def leave(self) -> None:
        """What closing does first: end all that moves a motor, and begin to stop the drives.

        They are stopped if `stop_on_exit` was called.
        """
        self._performer.shut()
        if self._last_act is not None:
            self._last_act.begin()

    def part(self) -> None:
        """What closing does as long as the port is open: leave, and wait for all stops under way."""
        self.leave()
        if self._last_act is not None:
            exit_hook().finish(self._last_act)
        if self._last_act is None or not self._last_act.is_cut_short:
            self._performer.await_stops()

    def close(self) -> None:
        """Leave the line and close the port. What was sent and is not answered yet is Unconfirmed."""
        try:
            self.part()
        finally:
            self._is_closed = True
            overruns = self.line.overruns()
            self.line.close()
            self._at_last = self._at_last or self._counted(overruns)
            self._writer.close()

    def tended(self, is_tended: bool) -> None:
        """Take note whether somebody opens a lost port again: a stop waits for that, or else does it."""
        self._performer.is_tended = is_tended

    def attach(self, drive: D | type[D], address: int | None = None, **details: Any) -> D:
        """Put a drive on the bus: a family with address, name and so on, or a drive made before.

        Nothing is sent: its watchdog is read and logged at the first look. Any thread may call this. Raises
        ValueError for what the family does not allow, an address taken, or a drive that is on another bus.
        """
        family = drive if isinstance(drive, type) else type(drive)
        if not issubclass(family, Drive):
            raise TypeError(f"attach takes a family such as InnovertIBD, or a drive of one, not {drive!r}")
        if isinstance(drive, type):
            if address is None:
                raise TypeError(f"attach({drive.__name__}, address=...): which address does it have?")
            line = {"baudrate": self.baudrate, "format": self.format, "silence": self.silence}
            details = {**line, **details}
            drive = drive(address, **details)
        elif address is not None or details:
            raise TypeError(f"{drive.name} is made already: what it is to be goes into {family.__name__}(…)")
        made = drive
        with self._attaching:
            for other in self.drives:
                if other.address == made.address:
                    raise ValueError(f"address {made.address} is taken by {other.name}")
            _claims.claim(made, self)
            made.perform = lambda script: self.perform(made, script)
            made.check_identity = lambda: self.check_identity(made)
            made.begin_call = lambda verb: self._performer.call(made, verb)
            made.carry_out_move = self._performer.move
            made.carry_out_stop = lambda verb, script, seconds: self._performer.stop(made, script, seconds)
            self._exchanges.add(made)
            self._performer.add(made)
            self.drives = [*self.drives, made]  # anew, for others may be going through them
        return made

    def detach(self, drive: Drive) -> None:
        """Take a drive off the bus: nothing is asked of it any more, and its verbs raise ValueError.

        Nothing is sent: its motor goes on as it is. Ends what would move it with Overtaken, or Unconfirmed
        where it was sent, and waits until the stops that are under way are done.
        """
        self._performer.remove(drive)
        with self._attaching:
            self.peer(drive)
            self.drives = [other for other in self.drives if other is not drive]
            self._exchanges.remove(drive)
            self._writer.identity_check.forget(drive)
            _claims.free(drive, self)

    # ---- reading ----

    def read(self, drive: Drive, register: Register[T]) -> T:
        """The register's value in engineering units.

        Raises NoReply, BadReply, DriveRefused or LineError; ValueError if it cannot be read.
        """
        return cast(T, self.read_many(drive, [register])[register.name])

    def read_many(self, drive: Drive, registers: Iterable[Register[Any]]) -> dict[str, Any]:
        """Values by register name, in as few exchanges as the family allows; raises as `read` does."""
        registers = list(registers)
        for register in registers:
            check_own(drive, register)
        return self._exchanges.values(drive, registers, READ_ATTEMPTS)

    # ---- writing ----

    def write(self, drive: Drive, register: Register[T], value: T) -> T:
        """Write a value and return what the drive then holds, where that can be read, else `value`.

        Sent once; not at all where a register that may be in EEPROM holds the value already, nor when
        its turn does not come within `expiry` seconds. Before the first write to a drive it is looked
        at, whether it is of its family. Raises Refused (also a ValueError) for what the library does
        not send, TypeError for what is no value, Expired, DriveRefused when the drive says no, and
        Unconfirmed when its answer is lost and the write may have happened.
        """
        return cast(T, self.try_write(drive, register, value).value)

    def try_write(self, drive: Drive, register: Register[T], value: T) -> Outcome:
        """As `write`, but what became of a write that was sent is returned, whatever it is."""
        raw = raw_count(drive, register, value)
        check_plain(drive, register, raw)
        step = Write(register, value)
        if is_harmless(register, raw):  # a stop
            self._performer.rise([drive])
            try:
                return self._writer.heard_since(drive, self._performer.insist(drive, step))
            finally:
                self._writer.catch_up()
        call = self._performer.call(drive)
        with call.noted():
            call.check(f"{register.name} = {register.format(value)}")
            outcome = self._writer.put(drive, step, call)
            with call.look():
                return self._writer.heard_since(drive, outcome)

    def raw(self, drive: Drive, function: int, start: int, data: bytes = b"", *, count: int = 0) -> bytes:
        """Send any request once, past every rule, and return the data of the reply.

        The one deliberate way round: no look at the drive's family, no span, no budget. It may start a
        motor. Raises Unconfirmed when no answer comes, and DriveRefused; Overtaken and Expired as `write`.
        """
        call = self._performer.call(drive)
        with call.noted():
            return self._writer.raw(drive, Message(drive.address, function, start, count, data), call)

    # ---- who is there ----

    def check_identity(self, drive: Drive) -> None:
        """Look, once, whether the drive at this address is of its family; Refused when it is another.

        The first write does this by itself. The first look also logs what the drive's watchdog does.
        """
        self._performer.check_identity(drive)

    def watchdog(self, drive: Drive) -> str:
        """What becomes of the motor when this client dies, as far as the drive can say."""
        return self._performer.watchdog(drive)

    # ---- all drives at once ----

    def broadcast(self, register: Register[T], value: T) -> dict[str, State | BusError]:
        """Write to every drive on the line at once; nobody answers, so each one is looked at afterwards.

        Refused unless all drives on the line are of one family, share their settings and framing, and
        its document has this broadcast, because the same address means different things to different
        families. Returns what each drive then says, or why it says nothing. Raises Refused.
        """
        kinds = {(type(drive), drive.settings, drive.framing) for drive in self.drives}
        if len(kinds) != 1:
            raise Refused(
                f"{register.name} cannot be broadcast: the drives on this line differ in family or settings, "
                "and the same address means different things to them; write to one after another",
                register=register.name,
                rule="the drives on the line differ",
            )
        drive = self.drives[0]
        raw = raw_count(drive, register, value)
        if raw not in register.broadcast:
            raise Refused(f"{drive.title} has no harmless broadcast of {register.name} = {value}")
        for it in self.drives:
            self.check_identity(it)
        if is_harmless(register, raw):
            self._performer.rise(self.drives)
        try:
            self._writer.broadcast(drive, register, raw)
        finally:
            self._writer.catch_up()
        return {it.name: self._look(it) for it in self.drives}

    def _look(self, drive: Drive) -> State | BusError:
        try:
            return cast(State, self.perform(drive, drive.state.script()))
        except BusError as failure:
            return failure

    def stop_all(self, *, seconds: float | None = None) -> dict[str, Stopped]:
        """Stop every drive, ahead of all that is queued; by drive's name, what is known of it.

        By broadcast where all drives are of one family that has it, and known to be; and then each of
        them, in turns, again and again until it is seen to stand: for `seconds` s, or without that for 30 s
        at least, and as long as the motor's ramp may take. Never raises for one drive: the others go on.
        What was called before and would move a motor ends with Overtaken, and so does what is called
        meanwhile. An interruption has each that does not stand yet sent its stop once more.
        """
        peers = self.peers
        is_known = self._writer.identity_check.is_known
        in_turn = sorted(peers, key=lambda drive: (not is_known(drive), peers[drive].failures))
        return self._performer.stop_all(in_turn, self._stop_by_broadcast, seconds)

    def _stop_by_broadcast(self) -> bool:
        """Whether a stop was broadcast, which it is only where that harms none and all are known."""
        drives = self.drives
        kinds = {(type(drive), drive.settings, drive.framing) for drive in drives}
        known = all(self._writer.identity_check.is_known(drive) for drive in drives)
        control = drives[0].registers.get("control") if drives else None
        if len(drives) < 2 or len(kinds) != 1 or not known or control is None or not control.broadcast:
            return False
        with suppress(Exception):
            self._writer.broadcast(drives[0], control, control.broadcast[0])
            return True
        return False

    def stop_on_exit(self) -> None:
        """From now on, stop all drives when the `with` block is left or the process ends.

        Also on SIGINT and SIGTERM, at once, together with the drives of all other buses that asked for it.
        The signal is held until that is done, and then does what it did before; three within a second cut
        it short, which is told on standard error. From the signal on nothing that moves a motor is sent.
        Without this call leaving sends nothing: the motors go on as they are. Call it from the main thread.
        """
        if self._last_act is None:
            self._last_act = exit_hook().add(self._performer.shut, self._stop_at_last)

    def _stop_at_last(self) -> None:
        for stopped in self.stop_all().values():
            if stopped.seen is not Seen.STOPPED:
                logging.getLogger("multidrop").warning("%s", stopped)

    # ---- verbs ----

    def perform(self, drive: Drive, script: Script[Any]) -> Any:
        """Carry out a script's steps, none of which is written once a stop was called.

        What fails to be read after something was written is Unconfirmed: NoReply would say that nothing
        was, and DriveRefused that the drive did not do it.
        """
        return self._performer.perform(script, self._performer.call(drive))

    def peer(self, drive: Drive) -> Peer:
        """What is known of how this drive answers; ValueError for a drive that is not on this bus."""
        return self._exchanges.peer(drive)

    @property
    def peers(self) -> dict[Drive, Peer]:
        """What is known of each drive that is on this bus now."""
        return self._exchanges.peers

    # ---- how it went ----

    def statistics(self) -> LineStatistics:
        """Of all exchanges since the bus was opened, or since `reset_statistics`, also per drive.

        It may be asked for at any time, as often as wanted, and from any thread.
        """
        return (self._at_last or self._counted(self.line.overruns())).since(self._reset_at)

    def reset_statistics(self) -> None:
        """Count from here on."""
        self._reset_at = self._at_last or self._counted(self.line.overruns())

    def _counted(self, overruns: int | None) -> LineStatistics:
        counters_by_drive = {drive.name: it.counters() for drive, it in self.peers.items()}
        return look((now_ns() - self._opened_ns) / 1e9, counters_by_drive, overruns)
