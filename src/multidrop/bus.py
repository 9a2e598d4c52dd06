"""Bus: one line with its drives: attaching and leaving, broadcasts, stops and statistics."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from multidrop.control.call import Latches, check_expiry
from multidrop.control.eeprom_ledger import Ledger
from multidrop.control.exit_hook import ExitTask, exit_hook, give_signals_back, without_internals
from multidrop.control.outcome import Seen, Stopped
from multidrop.control.performer import Broadcaster, BusLink, Performer
from multidrop.control.records import AuditLog, WriteRecords
from multidrop.control.stops import Stopper, StopRun
from multidrop.control.writer import Writer
from multidrop.core import (
    RS485,
    Echo,
    EchoMode,
    Mastership,
    Peer,
    RS485Mode,
    TransactionIds,
    TransactionMode,
)
from multidrop.core.process import register_at_fork, undisturbed
from multidrop.drive.family import Drive
from multidrop.drive.link import check_drive
from multidrop.drive.register import Register
from multidrop.drive.verbs import TRIES, State
from multidrop.errors import BusError, LineError
from multidrop.transport.aside_log import log_aside
from multidrop.transport.exchange import Exchanges
from multidrop.transport.line import Line
from multidrop.transport.statistics import LineMeter, LineStatistics

D = TypeVar("D", bound=Drive)

EXPIRY = 1.0  # s; default time limit for sending a write

_log = logging.getLogger("multidrop.bus")


def _facts(port: str, echo: str, transaction: str, rs485: str) -> tuple[Echo, TransactionIds, RS485]:
    switch = RS485(rs485)
    switch.check_port(port)
    return Echo(echo), TransactionIds(transaction), switch


class Bus:
    """A line and the drives on it, which may differ in family, baud rate and format.

    `port` is a device such as /dev/ttyUSB0, a URL of socket:// or rfc2217://, or tcp://10.0.0.7:502 for
    Modbus TCP. `baudrate` and `format` replace the families' defaults for drives that are attached without
    their own. `silence`, in s, replaces the standard's t3.5 between frames, if all drives tolerate it.

    - `echo`: whether the adapter echoes the requests that it sends: "on", "off" (valid until an echo is
      received), or "auto" to detect it.
    - `transaction`: "ignore" if a Modbus TCP gateway replies with transaction ids of its own.
    - `rs485`: what switches the transceiver to sending and back if the adapter does not: the kernel's driver
      ("kernel"), or multidrop by the RTS line ("rts-up", "rts-down").
    - `settle`: seconds without requests after the port opens, at most 10, for devices that restart when the
      port opens.
    - `ledger`: the file that counts writes to EEPROM, shared by all processes. `audit`: the log of all
      writes.
    - `expiry`: seconds. A write that cannot be sent within this time of the call, not counting the verb's own
      waits, raises Expired.
    - `stop_on_exit`: stop all drives when the bus is closed or the program ends; see `Bus.stop_on_exit`.
    - `mastership`: for a line on which another process may be the Modbus master. While this process does not
      hold the mastership, the port is not opened, and all requests raise NotMaster, even stops.

    A stop cancels each earlier call that may move a motor, on any thread, with CancelledByStop. A drive is on
    one bus at a time. Leaving the `with` block waits for pending stops and closes the port. It stops no drive
    unless `stop_on_exit` is set. Raises LineError if the port cannot be opened.

    The logger `multidrop.line` reports when the port is opened, lost and closed, and frames at DEBUG. The
    logger `multidrop.control` reports writes, refusals and stops.
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
        check_expiry(expiry)
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
        """Return a bus whose port is not open yet; a poller or a stop opens it later."""
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
        self._leaving = Leaving(self._latches, self._stopper, self.stop_all, self._motors)
        self._is_closed = False
        self._closing = threading.Lock()
        self._attached = Attached(self, self._exchanges, self._latches, self._performer, self._stopper)
        register_at_fork(self)

    def forked(self) -> None:
        """Mark the bus closed in a forked child."""
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
        """True until the bus is closed."""
        return not self._is_closed

    @property
    def why_lost(self) -> str | None:
        """Why the port is lost or stalled ("/dev/ttyUSB0: unplugged"); None while the port works."""
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
        """Cancel all calls that move a motor. If `stop_on_exit` is set, another thread stops the drives."""
        self._leaving.begin()

    def part(self) -> None:
        """Cancel all calls that move a motor, and wait for all pending stops. The port stays open.

        If `stop_on_exit` is set, all drives are stopped first.
        """
        self._leaving.finish()

    def close(self) -> None:
        """Cancel calls that move a motor, wait for stops, and close the port.

        A write in flight raises Unconfirmed. If a signal interrupts the wait, the closing still completes; a
        second call of `close` waits until the closing is complete.
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
                self._exchanges.peers.close()
                self._meter.freeze(overruns)
                self._records.close()
                self._attached.free()

    def note_reopening(self, is_under_way: bool) -> None:
        """Set whether a poller is now reopening the lost port. Otherwise a stop reopens the port itself."""
        self._stopper.is_reopening = is_under_way

    # ---- the drives ----

    @property
    def drives(self) -> list[Drive]:
        """The drives that are on the bus now."""
        return self._attached.drives

    def attach(self, drive: D | type[D], address: int | None = None, **details: Any) -> D:
        """Put a drive on the bus, and return it. `drive` is a family, with its arguments, or a drive object.

        No request is sent; the identity of the drive is checked before its first write. Any thread may call
        this. Raises ValueError for an argument, or a setting of this bus, that the family does not allow, for
        a taken address, or a drive on another bus. Raises LineError if this bus is closed.
        """
        line = {"baudrate": self.baudrate, "format": self.format, "silence": self.silence}
        attached = _made(drive, address, line, details)
        if attached is drive:
            attached.take_settings(self.baudrate, self.format, self.silence, bus=self)
        self._attached.add(attached)
        return attached

    def detach(self, drive: Drive) -> None:
        """Take a drive off the bus: its reads, writes and verbs raise NotAttached from then on.

        The motor keeps running or standing. The drive's pending verbs raise CancelledByStop, or Unconfirmed
        if they were sent already. Waits for the drive's pending stops.
        """
        self._latches.remove(drive)
        with self._attached.lock:
            self._attached.remove(drive)
            self._writer.identity_check.forget(drive)

    def peer(self, drive: Drive) -> Peer:
        """Return the Peer of a drive: its learnt response delay and its late replies. Raises NotAttached."""
        return self._exchanges.peers.of(drive)

    def is_asking(self, peer: Peer) -> bool:
        """Return True while a request to the drive of this peer is about to start, queued or in flight."""
        return self._exchanges.peers.is_asking(peer)

    @property
    def peers(self) -> dict[Drive, Peer]:
        """The peer of each drive that is on this bus now."""
        return dict(self._exchanges.peers.present)

    # ---- commands ----

    def check_identity(self, drive: Drive, *, rest_s: float = 0.0) -> None:
        """Check that the drive which answers is of the declared family, as far as its registers show.

        The check only reads. It is made once each time the port is opened, at the latest before the first
        write. `rest_s` is a pause in s before each read, which leaves the line to polling. The first check
        also logs the drive's watchdog. Raises WriteForbidden for a drive of another family, and NoReply for a
        silent drive.
        """
        check_drive(drive)
        self._performer.check_identity(drive, rest_s)

    def knows_identity(self, drive: Drive) -> bool:
        """Return True if the drive has passed `check_identity` since the port was opened."""
        check_drive(drive)
        return self._writer.identity_check.is_known(drive)

    def watchdog(self, drive: Drive) -> str:
        """Return a sentence on what the motor does if this client dies.

        The answer is read from the drive if possible, and otherwise taken from the family's document.
        """
        check_drive(drive)
        return self._performer.watchdog(drive)

    # ---- all drives together ----

    def broadcast(self, register: Register[Any] | str, value: Any) -> dict[str, State | BusError]:
        """Broadcast a write to all drives of the line; return each drive's state, or its error, by name.

        Drives do not answer a broadcast, so each drive's state is read afterwards. All drives must be of one
        family, because an address means different things to different families. They must have the same line
        settings, and the family's manual must document this broadcast. Otherwise raises WriteForbidden.
        """
        return self._broadcaster.write(self.drives, register, value)

    def stop_all(self, seconds: float | None = None) -> dict[str, Stopped]:
        """Stop every drive, before all queued requests; return the results by drive name.

        If `identify` has confirmed that all drives are of one family with a stop broadcast, that broadcast is
        sent first. Then each drive in turn is sent its stop. A stop is repeated until the motor is seen to
        stand still, for at most `seconds`. By default it is repeated for 30 s, and the last repetition may
        last as long as the motor's ramp. An invalid `seconds` is logged and ignored. The failure of one
        drive's stop is in its result, and never ends the other stops. A device with `has_motor = False` gets
        no stop. Calls that move a motor, made before or during this call, raise CancelledByStop. If this call
        is interrupted, each drive whose motor is not seen to stand still gets one more stop.
        """
        # the loop of `_BoundStop.__call__`; in a shared function, Ctrl-C between its return and this call's
        # next instruction would lose the stops
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
        without = [drive.name for drive in self.drives if not drive.has_motor]
        return run.found() | {name: Stopped(name, Seen.NO_MOTOR, 0.0) for name in without}

    def _motors(self) -> list[Drive]:
        return [drive for drive in self.drives if drive.has_motor]

    def _all_called(self, seconds: float | None) -> StopRun:
        peers = {drive: peer for drive, peer in self.peers.items() if drive.has_motor}
        is_known = self._writer.identity_check.is_known
        in_turn = sorted(peers, key=lambda drive: (not is_known(drive), peers[drive].failures))
        return self._stopper.stop_all(in_turn, lambda: self._broadcaster.stop(self.drives), seconds)

    def stops_under_way(self) -> dict[str, str]:
        """Return the state of each pending stop in a sentence, by the drive's name.

        The sentence says whether the stop was sent and confirmed, and why it is repeated. Any thread may call
        this; the call does not wait for a stop.
        """
        return self._stopper.so_far()

    def stop_on_exit(self) -> None:
        """From now on, stop all drives when the `with` block is left or the process ends.

        SIGINT and SIGTERM also stop these drives immediately, and the drives of all other buses with
        `stop_on_exit`. So does the SIGHUP of a closed terminal, unless the program handles or ignores it.
        Standard error names the drives that are being stopped. After the stops, the signal has its previous
        effect: Ctrl-C raises KeyboardInterrupt. Three signals within a second end the wait for the stops.
        After the signal, no call that moves a motor is sent; such a call waits for the signal's effect.

        Python handles signals in the main thread: if that thread waits for a reply, the stops start when the
        reply has come or timed out. A handler that the program installs later replaces this one, until
        another bus calls `stop_on_exit`. Call this method from the main thread; on any other thread, it
        raises ValueError.
        """
        self._leaving.stop_on_exit()

    @property
    def stops_on_exit(self) -> bool:
        """True if `stop_on_exit` is set."""
        return self._leaving.stops

    @property
    def stopped(self) -> Mapping[str, Stopped]:
        """The results of the stops by `stop_on_exit`, by the drive's name; empty until they have ended."""
        return self._leaving.found

    def part_with(self, drives: Sequence[Drive], to_stop: Sequence[Drive]) -> None:
        """Cancel all calls that move `drives`, which are about to be detached, and wait for their stops.

        If `stop_on_exit` is set, stop the drives in `to_stop` first, because detached drives are not stopped
        later.
        """
        self._leaving.part_with(drives, to_stop)

    # ---- audit log and statistics ----

    @property
    def audit_trouble(self) -> str:
        """Why the newest write is not in the audit log; "" if it is, or if there is no log."""
        return self._records.audit_trouble

    def note_refused(self, drive: str, what: str, why: str) -> None:
        """Record in the audit log that a program's write to a drive was refused and not sent."""
        self._records.note_refused(drive, what, why)

    def statistics(self) -> LineStatistics:
        """Return the statistics of the line and its drives since the opening or the last `reset_statistics`.

        Any thread may call this at any time; it does not delay the line.
        """
        return self._meter.read()

    def reset_statistics(self) -> None:
        """Start the statistics again from zero."""
        self._meter.reset()


# ---- attaching and leaving ----


def _made(drive: D | type[D], address: int | None, line: dict[str, Any], details: dict[str, Any]) -> D:
    """Return `drive`; if it is a class, create a drive of that class.

    `line` has the settings of the line, and `details` the options of the new drive, which override `line`.
    Raises TypeError if `drive` is neither a drive nor a class of drives, if the address is missing, or if
    details are given for an existing drive.
    """
    family = drive if isinstance(drive, type) else type(drive)
    if not issubclass(family, Drive):
        raise TypeError(f"attach needs a family such as YD1000, or a drive such as YD1000(1), not {drive!r}")
    if isinstance(drive, type):
        if address is None:
            raise TypeError(f"attach({drive.__name__}, address=...): the address is missing")
        return drive(address, **{**line, **details})
    if address is not None or details:
        raise TypeError(
            f"attach takes no address or options with a drive object; write them in {family.__name__}(…)"
        )
    return drive


class Attached:
    """The drives of a bus; any thread may add and remove them."""

    def __init__(
        self, bus: Bus, exchanges: Exchanges, latches: Latches, performer: Performer, stopper: Stopper
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

        Raises ValueError for a framing that the port cannot have, and LineError if this bus is closed.
        """
        with self.lock:
            if not self._bus.is_open:
                raise LineError(self._bus.line.port, f"the bus is closed: attach {drive.name} to a new Bus")
            for other in self.drives:
                if other.address == drive.address:
                    raise ValueError(f"address {drive.address} is already used by {other.name} on this line")
            # `setdefault` is atomic: two buses cannot both take the drive
            owner = vars(drive).setdefault("bus", self._bus)
            if owner is not self._bus and owner.is_open:
                raise ValueError(
                    f"{drive.name} is on the bus at {owner.line.port}: detach it there first, or create "
                    "another drive object"
                )
            try:
                drive.take_framing_of(self._bus.line.port)
                self._exchanges.peers.add(drive)
            except BaseException:
                del drive.bus
                raise
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
        """Cancel all calls on the bus. If `stop_on_exit` was called, another thread stops the drives."""
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
