"""Bus: a line with its drives; reads, writes, broadcasts, and the verbs of the drives on it."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar, cast

from multidrop.audit import AuditLog
from multidrop.core import Echo, Message, Respondent
from multidrop.drive import Drive, Read, Script, State, Step, Wait, Write, carry_out
from multidrop.errors import BadReply, BusError, DriveRefused, NoReply, Refused, Unconfirmed
from multidrop.exchanges import LEAST_TIMEOUT, READ_ATTEMPTS, Exchanges, exchange
from multidrop.forks import tell_of_forks
from multidrop.ledger import Ledger
from multidrop.line import Line, now_ns, sleep
from multidrop.outcome import Outcome
from multidrop.parting import Parting
from multidrop.register import Register
from multidrop.rules import check_own, check_plain, raw_count
from multidrop.statistics import LineStatistics, look
from multidrop.stopping import Stopped, stop_together
from multidrop.writing import Writer

__all__ = ["LEAST_TIMEOUT", "READ_ATTEMPTS", "Bus", "exchange"]

D = TypeVar("D", bound=Drive)
T = TypeVar("T", bound=float)


class Bus:
    """A line and the drives on it, which may differ in family, baud rate and format.

    `port` is a device such as /dev/ttyUSB0 or any pyserial URL; `baudrate` and `format` replace the
    families' defaults for drives that are attached without their own, and `silence`, in s, the standard's
    t3.5 between frames, if all of them bear it. `echo` tells whether the adapter repeats what it sends: "on",
    "off", until it does, or "auto", to find out. Raises LineError when the port cannot be opened. Writes
    that may wear an EEPROM are counted in `ledger`, a file that all processes share, and all writes are
    noted in the file `audit`. A write whose turn does not come within `expiry` seconds is not sent.
    Leaving the `with` block closes the port and sends nothing, unless `stop_on_exit` was called.
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
        self._writer = Writer(self._exchanges, book, log, expiry)
        self._parting: Parting | None = None
        self._stopping = 0  # calls of stop_all under way, in which no drive may leave
        self._stopped = threading.Condition()
        self._opened_ns = now_ns()
        self._reset_at = look(0.0, {}, self.line.overruns())
        self._at_last: LineStatistics | None = None  # when it was closed
        tell_of_forks(self)

    def forked(self) -> None:
        """In the child nobody stops drives: the line is closed there."""
        self._stopping, self._stopped = 0, threading.Condition()

    def __enter__(self) -> Bus:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def part(self) -> None:
        """What closing does as long as the port is open: stop the drives, if `stop_on_exit` was called."""
        if self._parting is not None:
            self._parting.now()

    def close(self) -> None:
        self.part()
        overruns = self.line.overruns()
        self.line.close()
        self._at_last = self._at_last or self._counted(overruns)
        self._writer.close()

    def attach(self, drive: D | type[D], address: int | None = None, **details: Any) -> D:
        """Put a drive on the bus: a family with address, name and so on, or a drive made before.

        Nothing is sent: its watchdog is read and logged at the first look. Raises ValueError for
        what the family does not allow, or an address taken.
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
        for other in self.drives:
            if other.address == drive.address:
                raise ValueError(f"address {drive.address} is taken by {other.name}")
        drive.perform = lambda script: self.perform(drive, script)
        drive.introduce = lambda: self.introduce(drive)
        self._exchanges.add(drive)
        self.drives = [*self.drives, drive]  # anew, for others may be going through them
        return drive

    def detach(self, drive: Drive) -> None:
        """Take a drive off the bus: nothing is asked of it any more, and its verbs raise ValueError.

        Nothing is sent: its motor goes on as it is. Waits until `stop_all`, if it is under way, is done.
        """
        with self._stopped:
            self._stopped.wait_for(lambda: not self._stopping)
            self.respondent(drive)
            self.drives = [it for it in self.drives if it is not drive]
            self._exchanges.remove(drive)
            self._writer.acquaintance.forget(drive)

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
        check_plain(drive, register, raw_count(drive, register, value))
        return self._writer.put(drive, Write(register, value))

    def raw(self, drive: Drive, function: int, start: int, data: bytes = b"", *, count: int = 0) -> bytes:
        """Send any request once, past every rule, and return the data of the reply.

        The one deliberate way round: no look at the drive's family, no span, no budget. It may start a
        motor. Raises Unconfirmed when no answer comes, and DriveRefused.
        """
        return self._writer.raw(drive, Message(drive.address, function, start, count, data))

    # ---- who is there ----

    def introduce(self, drive: Drive) -> None:
        """Look, once, whether the drive at this address is of its family; Refused when it is another.

        The first write does this by itself. The first look also logs what the drive's watchdog does.
        """
        acquaintance = self._writer.acquaintance
        if acquaintance.is_known(drive):
            return
        acquaintance.make(drive)
        logging.getLogger("multidrop").info("%s: %s", drive.name, self.watchdog(drive))

    def watchdog(self, drive: Drive) -> str:
        """What becomes of the motor when this client dies, as far as the drive can say."""
        register = drive.registers.get("communication_timeout")
        if register is None or not register.readable:
            return drive.watchdog
        try:
            held = self.read(drive, register)
        except DriveRefused:
            return drive.watchdog
        if held == 0:
            return f"its watchdog ({register.name}) is off: the motor runs on when the client dies"
        return f"its watchdog ({register.name}) acts {register.format(held)} after the last message"

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
            self.introduce(it)
        self._writer.broadcast(drive, register, raw)
        return {it.name: self._look(it) for it in self.drives}

    def _look(self, drive: Drive) -> State | BusError:
        try:
            return cast(State, self.perform(drive, drive.state.script()))
        except BusError as failure:
            return failure

    def stop_all(self) -> dict[str, Stopped]:
        """Stop every drive, ahead of all that is queued; by drive's name, what is known of it.

        By broadcast where all drives are of one family that has it, and known to be; and then each of
        them, in turns, until it is seen to stand. Never raises for one drive: the others go on.
        """
        with self._stopped:
            self._stopping += 1
        try:
            at_once = self._stop_by_broadcast()
            silent_last = sorted(self.drives, key=lambda drive: self.respondent(drive).failures)
            return stop_together(silent_last, self._step, lambda: now_ns() / 1e9, sleep, at_once)
        finally:
            with self._stopped:
                self._stopping -= 1
                self._stopped.notify_all()

    def _stop_by_broadcast(self) -> bool:
        """Whether a stop was broadcast, which it is only where that harms none and all are known."""
        drives = self.drives
        kinds = {(type(drive), drive.settings, drive.framing) for drive in drives}
        known = all(self._writer.acquaintance.is_known(drive) for drive in drives)
        control = drives[0].registers.get("control") if drives else None
        if len(drives) < 2 or len(kinds) != 1 or not known or control is None or not control.broadcast:
            return False
        with suppress(BusError):
            self._writer.broadcast(drives[0], control, control.broadcast[0])
            return True
        return False

    def stop_on_exit(self) -> None:
        """From now on, stop all drives when the `with` block is left or the process ends.

        Also on SIGINT and SIGTERM, at once, and then the signal does what it did before. Without this
        call leaving sends nothing: the motors go on as they are. Call it from the main thread.
        """
        if self._parting is None:
            self._parting = Parting(self.stop_all)

    # ---- verbs ----

    def perform(self, drive: Drive, script: Script[Any]) -> Any:
        """Carry out a verb's steps; the drive's verbs call this.

        What fails to be read after something was written is Unconfirmed: NoReply would say that nothing
        was, and DriveRefused that the drive did not do it.
        """
        written: list[Write] = []
        unseen: list[BusError] = []  # why something was not read

        def do(step: Step) -> Any:
            try:
                result = self._step(drive, step)
            except BusError as failure:
                if isinstance(step, Read):
                    unseen.append(failure)
                raise
            if isinstance(step, Write):
                written.append(step)
            return result

        try:
            return carry_out(script, do)
        except (NoReply, BadReply, DriveRefused) as failure:
            if not written or failure not in unseen:
                raise
            register, value = written[-1].register, written[-1].value
            what = f"{register.name} = {register.format(value)}"
            reason = f"it was confirmed, but its effect could not be seen: {failure}"
            raise Unconfirmed(drive.name, what, reason) from failure

    def _step(self, drive: Drive, step: Step) -> Any:
        if isinstance(step, Wait):
            return sleep(step.seconds)
        if isinstance(step, Read):
            return self.read(drive, step.register)
        return self._writer.put(drive, step).value

    def respondent(self, drive: Drive) -> Respondent:
        """What is known of how this drive answers; ValueError for a drive that is not on this bus."""
        return self._exchanges.respondent(drive)

    @property
    def respondents(self) -> dict[Drive, Respondent]:
        """What is known of each drive that is on this bus now."""
        return self._exchanges.respondents

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
        tallies = {drive.name: it.tally() for drive, it in self.respondents.items()}
        return look((now_ns() - self._opened_ns) / 1e9, tallies, overruns)
