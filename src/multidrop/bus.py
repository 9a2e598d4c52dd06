"""Bus: one line with its drives, by hand: reads, writes, broadcasts, stops, and the drives' verbs."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar

from multidrop.control.attached import Attached, made
from multidrop.control.audit_log import AuditLog
from multidrop.control.broadcast import Broadcaster
from multidrop.control.eeprom_ledger import Ledger
from multidrop.control.exit_hook import give_signals_back, without_internals
from multidrop.control.latches import Latches
from multidrop.control.leaving import Leaving
from multidrop.control.outcome import Stopped
from multidrop.control.performer import Performer
from multidrop.control.records import WriteRecords
from multidrop.control.stops import Stopper, StopRun
from multidrop.control.time_limit import checked_expiry
from multidrop.control.writer import Writer
from multidrop.core import RS485, Echo, Mastership, Peer, TransactionIds
from multidrop.core.fork import register_at_fork
from multidrop.core.undisturbed import undisturbed
from multidrop.drive.family import Drive, check_drive
from multidrop.drive.register import Register
from multidrop.drive.state import State
from multidrop.drive.verbs import TRIES
from multidrop.errors import BusError
from multidrop.transport.exchange import Exchanges
from multidrop.transport.line import Line
from multidrop.transport.statistics import LineMeter, LineStatistics

D = TypeVar("D", bound=Drive)

EchoMode = Echo | Literal["auto", "on", "off"]
TransactionMode = TransactionIds | Literal["match", "ignore"]
RS485Mode = RS485 | Literal["off", "kernel", "rts-up", "rts-down"]

EXPIRY = 1.0  # s


def _facts(port: str, echo: str, transaction: str, rs485: str) -> tuple[Echo, TransactionIds, RS485]:
    """Parse the port options. Raises ValueError for an invalid one."""
    switch = RS485(rs485)
    switch.check_port(port)
    return Echo(echo), TransactionIds(transaction), switch


class Bus:
    """A line and the drives on it, which may differ in family, baud rate and format.

    `port` is a device such as /dev/ttyUSB0, a URL of socket:// or rfc2217://, or tcp://10.0.0.7:502 for
    Modbus TCP, which all drives on such a port then speak; `transaction` is "ignore" where its gateway
    replies with transaction ids of its own. `baudrate` and `format` replace the families' defaults for
    drives that are attached without their own, and `silence`, in s, the standard's t3.5 between frames,
    if all of them bear it. `echo` says that the adapter repeats what it sends: "on", "off" (until it
    does), or "auto", to find out. `rs485` is who switches between sending and receiving where the adapter
    does not: "kernel", the driver, or "rts-up" or "rts-down", the core, by RTS being on or off while a
    request leaves. Devices that are deaf after the port opens, such as an Arduino that this resets, are sent
    nothing for `settle` seconds, at most 10. Raises LineError when the port cannot be opened. Writes that may
    wear an EEPROM are counted in `ledger`, a file that all processes share, and all writes are noted in the
    file `audit`.

    A write is not sent when it is late by `expiry` seconds: since the verb was called, but for the time that
    its own steps may take. It is not sent either once a stop was called: that ends all that may move a motor
    and was called before it, on any thread, with CancelledByStop. A drive is on one bus at a time. Leaving
    the `with` block, or closing, waits for the stops that are under way and closes the port; it sends
    nothing, unless `stop_on_exit` was called, and nothing that moves a motor is sent after it.

    Where other processes may be masters of the line too, `mastership` holds requests back: what is too late
    is not sent, a stop neither, and raises NotMaster. Nor is the port opened unless it holds.

    The logger `multidrop.line` has the port's coming and going, and at DEBUG the frames; `multidrop.control`
    has writes, refusals and stops.
    """

    def __init__(
        self,
        port: str,
        *,
        baudrate: int | None = None,
        format: str | None = None,
        silence: float | None = None,
        echo: EchoMode = "auto",
        transaction: TransactionMode = "match",
        rs485: RS485Mode = "off",
        settle: float = 0.0,
        ledger: Ledger | Path | str | None = None,
        audit: Path | str | None = None,
        expiry: float = EXPIRY,
        stop_on_exit: bool = False,
        mastership: Mastership | None = None,
    ) -> None:
        checked_expiry(expiry, "a write")
        self.baudrate = baudrate
        self.format = format
        self.silence = silence
        facts = _facts(port, echo, transaction, rs485)
        line = Line(port, *facts, mastership, settle)
        try:
            self._begin(line.open(), ledger, audit, expiry)
        except BaseException:  # Ctrl-C too
            line.close()
            raise
        if stop_on_exit:
            try:
                self.stop_on_exit()
            except BaseException:
                self.close()
                raise

    @classmethod
    def awaiting(
        cls,
        port: str,
        *,
        echo: EchoMode = "auto",
        transaction: TransactionMode = "match",
        rs485: RS485Mode = "off",
        settle: float = 0.0,
        ledger: Ledger | Path | str | None = None,
        audit: Path | str | None = None,
        mastership: Mastership | None = None,
    ) -> Bus:
        """Return a bus whose port is not there yet: the poller that has it opens it, and so do stops."""
        bus = cls.__new__(cls)
        bus.baudrate = bus.format = bus.silence = None
        facts = _facts(port, echo, transaction, rs485)
        bus._begin(Line(port, *facts, mastership, settle), ledger, audit, EXPIRY)
        return bus

    def _begin(
        self, line: Line, ledger: Ledger | Path | str | None, audit: Path | str | None, expiry: float
    ) -> None:
        self.line = line
        book = ledger if isinstance(ledger, Ledger) else Ledger(ledger)
        log = AuditLog(audit) if audit else None
        self._exchanges = Exchanges(self.line)
        self._records = WriteRecords(self.line, book, log)
        self._latches = Latches(self._exchanges)
        self._writer = Writer(self._exchanges, self._records)
        self._stopper = Stopper(self._exchanges, self._writer, self._latches)
        self._performer = Performer(self._exchanges, self._writer, self._stopper, self._latches, expiry)
        self._broadcaster = Broadcaster(self._writer, self._performer, self._latches)
        self._meter = LineMeter(self._exchanges)
        self._leaving = Leaving(self._latches, self._stopper, self.stop_all, lambda: self.drives)
        self._is_closed = False
        self._closing = threading.Lock()
        self._attached = Attached(self, self._exchanges, self._latches, self._performer, self._stopper)
        register_at_fork(self)

    def forked(self) -> None:
        """Be closed in the child, where nobody stops drives."""
        self._is_closed = True
        self._closing = threading.Lock()
        self._latches.forked()
        self._attached.forked()

    def __repr__(self) -> str:
        state = "" if self.is_open else ", closed"
        return (
            f"<Bus {self.line.port}{state}: {', '.join(drive.name for drive in self.drives) or 'no drives'}>"
        )

    # ---- closing ----

    @property
    def is_open(self) -> bool:
        """True until it is closed."""
        return not self._is_closed

    @property
    def why_lost(self) -> str | None:
        """Why its port does not come back: "/dev/ttyUSB0: there is no such port"; None while it is there."""
        return self.line.why_lost

    def __enter__(self) -> Bus:
        return self

    def __exit__(self, kind: object, error: BaseException | None, *trace: object) -> None:
        if isinstance(error, KeyboardInterrupt):
            without_internals(error)
        try:
            self.close()
        except KeyboardInterrupt as interruption:
            interruption.__traceback__ = None
            raise

    def leave(self) -> None:
        """End all that moves a motor, and begin to stop the drives if `stop_on_exit` was called."""
        self._leaving.begin()

    def part(self) -> None:
        """Leave, and wait for all stops under way; the port stays open."""
        self._leaving.finish()

    def close(self) -> None:
        """Leave the line and close the port. A write that was sent and is not answered yet is Unconfirmed.

        Where a signal interrupts the wait for that, it is done all the same; called again, this waits again.
        """
        self._close()
        if self.stops_on_exit:
            give_signals_back()

    @undisturbed
    def _close(self) -> None:
        with self._closing:
            try:
                self.part()
            finally:
                self._is_closed = True
                overruns = self.line.overruns()
                self._exchanges.close()
                self._meter.freeze(overruns)
                self._records.close()
                self._attached.free()

    def tended(self, is_tended: bool) -> None:
        """Note that a poller opens a lost port again: a stop waits for that, or else does it itself."""
        self._stopper.is_tended = is_tended

    # ---- the drives ----

    @property
    def drives(self) -> list[Drive]:
        """The drives that are on the bus now."""
        return self._attached.drives

    def attach(self, drive: D | type[D], address: int | None = None, **details: Any) -> D:
        """Put a drive on the bus: a family with address, name and so on, or a drive made before.

        Nothing is sent: its watchdog is read and logged when its identity is checked first. Any thread may
        call this. Raises ValueError for what the family does not allow, an address taken, or a drive that is
        on another bus.
        """
        line = {"baudrate": self.baudrate, "format": self.format, "silence": self.silence}
        attached = made(drive, address, line, details)
        attached.take_framing_of(self.line.port)
        self._attached.add(attached)
        return attached

    def detach(self, drive: Drive) -> None:
        """Take a drive off the bus: nothing is asked of it any more, and its verbs raise ValueError.

        Nothing is sent: its motor goes on as it is. Ends what would move it with CancelledByStop, or
        Unconfirmed where it was sent, and waits until its stops that are under way are done.
        """
        self._latches.remove(drive)
        with self._attached.lock:
            self._attached.remove(drive)
            self._writer.identity_check.forget(drive)

    def remember(self, before: Bus) -> None:
        """Take over what another bus, which is closed, learnt of the drives on the same serial line.

        The drives' answers to requests of that bus may still come.
        """
        self._exchanges.remember(before._exchanges)

    def peer(self, drive: Drive) -> Peer:
        """Return what is learnt of this drive's answers; ValueError for a drive that is not on this bus."""
        return self._exchanges.peer(drive)

    def is_asking(self, peer: Peer) -> bool:
        """Return True while an exchange with this peer is queued, under way or about to be."""
        return self._exchanges.is_asking(peer)

    @property
    def peers(self) -> dict[Drive, Peer]:
        """Learnt answers of each drive that is on this bus now."""
        return self._exchanges.peers

    # ---- commands ----

    def check_identity(self, drive: Drive) -> None:
        """Check that the drive at this address is of its declared family, as far as the family can tell.

        It only reads, and does so once until the port is opened again. The first write does this by itself.
        The first check also logs what the drive's watchdog does. Raises WriteForbidden when it is another
        drive, NoReply when it does not answer.
        """
        check_drive(drive)
        self._performer.check_identity(drive)

    def knows_identity(self, drive: Drive) -> bool:
        """Return True where `check_identity` would read nothing: the drive was of its family on this port."""
        check_drive(drive)
        return self._writer.identity_check.is_known(drive)

    def watchdog(self, drive: Drive) -> str:
        """Say what the motor does when this client dies, as far as the drive can tell."""
        check_drive(drive)
        return self._performer.watchdog(drive)

    # ---- all drives at once ----

    def broadcast(self, register: Register[Any] | str, value: Any) -> dict[str, State | BusError]:
        """Write to every drive on the line at once; nobody answers, so each drive is asked afterwards.

        The same address means different things to different families. So all drives on the line must be of
        one family and share their settings and framing, and its document must have this broadcast. Returns
        each drive's state, or why it says none, by name. Raises WriteForbidden.
        """
        return self._broadcaster.write(self.drives, register, value)

    def stop_all(self, seconds: float | None = None) -> dict[str, Stopped]:
        """Stop every drive, ahead of all that is queued; by drive's name, what is known of it.

        First by broadcast, where all drives are known to be of one family that has it. Then each drive is
        sent its stop, in turns, until it is seen to stand: for `seconds` s, or without that for 30 s at
        least, and for as long as the motor's ramp may take; what is no time is logged, and is as none. Never
        raises for one drive: the others go on. A call that would move a motor ends with CancelledByStop, if
        it came before this or comes while it lasts.
        After an interruption each drive that does not stand yet is sent its stop once more.
        """
        run: StopRun | None = None
        tried = 0
        while True:
            try:
                tried += 1
                run = run or self._all_called(seconds)
                run.carry_out()
                break
            except BaseException as failure:
                if tried < TRIES and isinstance(failure, (MemoryError, OSError)):
                    continue
                (run or self._all_called(seconds)).interrupted(failure)
                raise
        return run.found()

    def _all_called(self, seconds: float | None) -> StopRun:
        peers = self.peers
        is_known = self._writer.identity_check.is_known
        in_turn = sorted(peers, key=lambda drive: (not is_known(drive), peers[drive].failures))
        return self._stopper.stop_all(in_turn, lambda: self._broadcaster.stop(self.drives), seconds)

    def stops_under_way(self) -> dict[str, str]:
        """Return, by drive's name, a sentence of what is known so far of its stop, while one is under way.

        It says whether the stop was sent and confirmed, and why it goes on; it is the same as long as nothing
        changes. Any thread may ask; nothing is sent, and nobody is waited for.
        """
        return self._stopper.so_far()

    def stop_on_exit(self) -> None:
        """From now on, stop all drives when the `with` block is left or the process ends.

        Also on SIGINT and SIGTERM, at once, together with the drives of all other buses that asked for it;
        and on SIGHUP, of a terminal that is closed, unless the program handles or ignores that one.
        Standard error then says which drives are being stopped. The signal is held until that is done, and
        then does what it did before: Ctrl-C raises KeyboardInterrupt. Three within a second cut it short.
        From the signal on nothing that moves a motor is sent: a verb that would waits for its effect.
        Python handles it in the main thread: where that waits for a reply, when it has come or timed out.
        A handler that the program installs later replaces this, until another bus calls `stop_on_exit`.
        Without this call leaving sends nothing: the motors go on as they are. Call it from the main thread.
        """
        self._leaving.stop_on_exit()

    @property
    def stops_on_exit(self) -> bool:
        """True once `stop_on_exit` was called."""
        return self._leaving.stops

    def part_with(self, drives: Sequence[Drive], to_stop: Sequence[Drive]) -> None:
        """End all that moves these drives, which are about to be detached, and wait for their stops.

        Those `to_stop` are stopped if `stop_on_exit` was called: once they are detached, nobody would.
        """
        self._leaving.part_with(drives, to_stop)

    # ---- how it went ----

    @property
    def audit_trouble(self) -> str:
        """Return why the newest write is not in the audit log; "" where it is, or there is no log."""
        return self._records.audit_trouble

    def statistics(self) -> LineStatistics:
        """Return the statistics of all exchanges since the bus was opened, or reset, also per drive.

        Any thread may call it, as often as wanted: it costs the line nothing.
        """
        return self._meter.read()

    def reset_statistics(self) -> None:
        """Begin the statistics anew."""
        self._meter.reset()
