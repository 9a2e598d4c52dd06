"""IdentityCheck and EchoCheck: find out which device answers at a drive's address.

IdentityCheck confirms that the device is of its declared family. EchoCheck distinguishes the reply to a write
from the adapter's echo: most such replies are, like an echo, copies of their requests.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from typing import Any, NamedTuple

from multidrop.core import PAUSE_NS
from multidrop.drive.family import Drive
from multidrop.drive.register import Register
from multidrop.drive.script import Read, Script, Step, Wait, carry_out
from multidrop.errors import (
    ANOTHER_FAMILY,
    BadReply,
    BusError,
    CheckAgain,
    DriveException,
    LineError,
    NoReply,
    NotAttached,
    NotMaster,
    NoValue,
    WriteForbidden,
)
from multidrop.families import MODELS
from multidrop.families.makes import MAKES, Evidence, Make, easily_mistaken_for, run_by
from multidrop.transport import clock
from multidrop.transport.exchange import READ_ATTEMPTS, WRITE_TIMEOUT, Exchanges

SURE = 2  # number of checks in a row that must find another family before a stop is withheld

Timed = Callable[[], AbstractContextManager[None]]


class Suspicion(NamedTuple):
    """The reason to suspect that a drive is of another family, and the make that it answers as, if known."""

    why: str
    is_certain: bool = False
    make: Make | None = None


class EchoCheck:
    """Reads registers to find out whether the line's adapter echoes the requests."""

    def __init__(self, exchanges: Exchanges) -> None:
        self._exchanges = exchanges

    def read_any(self, drive: Drive, attempts: int, *, insists: bool = False, timeout: float = 0.0) -> None:
        """Read one register, to see whether the drive answers: a read's reply is never a copy of its request.

        A Modbus exception counts as a reply. Does nothing if the drive has no readable register.
        """
        readable = (register for register in drive.registers.values() if register.readable)
        register = drive.echo_probe or next(readable, None)
        if register is not None:
            with suppress(DriveException, NoValue):
                self._exchanges.values(drive, [register], attempts, insists=insists, timeout=timeout)

    def probe(self, drive: Drive, *, insists: bool = False) -> None:
        """Read a register once, so that the line learns whether a received copy of a request was an echo.

        The same request from another client looks like an echo. Without this read, the line would then take
        the drive's confirmations of writes, which are also copies, for echoes and ignore them.
        """
        with suppress(NoReply, BadReply, LineError, NotAttached, NotMaster):
            self.read_any(drive, 1, insists=insists, timeout=WRITE_TIMEOUT)

    def why_doubtful(self, drive: Drive) -> str:
        """Return why the reply to a write may be the adapter's echo; "" if the reply is the drive's own.

        An adapter may start to echo at any time while the drive is dead, so a register is read after the
        write. If the adapter is known to echo, the core has already separated echo and reply.
        """
        line = self._exchanges.line
        if line.has_echo:
            return ""
        try:
            self.read_any(drive, READ_ATTEMPTS)
        except (NoReply, BadReply, LineError, NotAttached, NotMaster) as failure:
            return f"the reply may be the adapter's echo, because the drive has not answered since: {failure}"
        return "the reply was the adapter's echo" if line.has_echo else ""


class _Confirmed(NamedTuple):
    """The state of line and drive when the drive's family was last confirmed."""

    port: object  # the open port's object; reopening creates another one
    silences: int  # number of unanswered requests until then
    pauses: int  # number of pauses of PAUSE_NS or more between the drive's replies until then
    at_ns: int
    slept_ns: int  # time that the computer had slept until then


class IdentityCheck:
    """Checks drives against their declared family, and remembers the results until the port is reopened."""

    def __init__(self, exchanges: Exchanges, echo: EchoCheck) -> None:
        self._exchanges = exchanges
        self._echo = echo
        self._known: dict[Drive, _Confirmed] = {}  # drives whose family was confirmed
        self._stoppable: dict[
            Drive, tuple[object, set[float]]
        ] = {}  # the open port, and the raw counts of stops that were allowed
        self._doubted: dict[Drive, tuple[object, str]] = {}  # the open port, and why it may be another make
        self._suspected: dict[Drive, tuple[object, Suspicion]] = {}  # the open port, and the first suspicion

    def is_known(self, drive: Drive) -> bool:
        last = self._known.get(drive)
        return last is not None and last.port is self._exchanges.line.queue

    def _was_heard(self, drive: Drive) -> bool:
        """Return True if the family was confirmed on this port, and no silence of PAUSE_NS came since."""
        last = self._known.get(drive)
        if last is None or last.port is not self._exchanges.line.queue:
            return False
        peer = self._exchanges.peer(drive)
        idle_ns = clock.now_ns() - max(last.at_ns, peer.answered_ns)
        return last.pauses == peer.pauses and idle_ns + _slept_ns() - last.slept_ns < PAUSE_NS

    def _has_answered_all(self, drive: Drive) -> bool:
        """Return True if the drive answered every request since its family was confirmed."""
        last = self._known.get(drive)
        return last is not None and last.silences == self._exchanges.peer(drive).silences

    def forget(self, drive: Drive) -> None:
        self._known.pop(drive, None)
        self._stoppable.pop(drive, None)
        self._doubted.pop(drive, None)
        self._suspected.pop(drive, None)

    # ---- before a write that may move a motor ----

    def check(self, drive: Drive, timed: Timed = nullcontext) -> None:
        """Check that the drive is of its declared family, unless the last check still holds.

        Raises WriteForbidden if the drive is of another family, NoReply if it does not answer. A check no
        longer holds if the port was reopened, a reply was missing, or the drive was silent for PAUSE_NS: it
        may have been replaced. Reads at least one value, so that an adapter's echo is detected before it
        could pass for the drive's confirmation. Each read is within a block of `timed`.
        """
        was_heard = self._was_heard(drive)
        if was_heard and self._has_answered_all(drive):
            return  # the drive cannot have been replaced since its last check

        def do(step: Step) -> object:
            if isinstance(step, Wait):
                return clock.sleep(step.seconds)
            with timed():
                return self._read(drive, step, READ_ATTEMPTS)

        port, silences = self._exchanges.line.queue, self._exchanges.peer(drive).silences
        try:
            carry_out(drive.identify.script(), do)
        except WriteForbidden as refusal:
            with timed():
                make = self._shown(drive, _of_same_register(drive))
            if make is None:
                raise
            raise WriteForbidden(f"{refusal}; {_declare(make)}", rule=refusal.rule) from refusal
        except DriveException as refusal:
            kind = drive.title or type(drive).__name__
            raise WriteForbidden(
                f"nothing is written to {drive.name}: it refuses what every {kind} answers ({refusal})",
                rule="it does not answer like its family",
            ) from refusal
        if drive.identity_is_weak and (rivals := easily_mistaken_for(drive)):
            with timed():
                make = self._shown(drive, rivals)
            if make is not None:
                why = f"nothing is written to {drive.name}: {_declare(make)}"
                raise WriteForbidden(why, rule="it shows another make")
        if not self._exchanges.has_answered(drive):
            with timed():
                self._echo.read_any(drive, READ_ATTEMPTS)
        self._know(drive, port, silences, was_heard=was_heard)

    def _know(self, drive: Drive, port: object, silences: int, *, was_heard: bool) -> None:
        """Record that the family was confirmed; `was_heard` is False if the drive was silent before."""
        before, pauses = self._known.get(drive), self._exchanges.peer(drive).pauses
        if not was_heard or before is None or before.pauses != pauses:
            _forget_setpoint(drive)
        self._known[drive] = _Confirmed(port, silences, pauses, clock.now_ns(), _slept_ns())

    def _read(self, drive: Drive, step: Step, attempts: int, *, insists: bool = False) -> object:
        if not isinstance(step, Read):
            raise WriteForbidden(f"{drive.name}: an identity check must not write")
        return self._exchanges.value(drive, step.register, attempts, insists=insists)

    # ---- before a stop ----

    def check_before_stop(self, drive: Drive, register: Register[Any], count: float) -> None:
        """Check the family once per open port, without waits. Raises WriteForbidden on proof of another make.

        Raises CheckAgain after the first suspicion: call this again after the stops of other drives.

        The raw count that stops one family may run the motor of another. But a failed check is not proof: a
        parameter such as an address or a baud rate may hold a value that is not in force yet, and a reply may
        belong to an earlier request. In such a case the stop is sent. The stop is withheld only if `identify`
        fails SURE times in a row, every request was answered so far, and one of these conditions is true:
        another built-in family recognises the drive; the drive answers as a make whose motor this raw count
        would run; or `identify` is certain (it raised WriteForbidden with the rule ANOTHER_FAMILY).
        """
        port = self._exchanges.line.queue
        on_port, allowed = self._stoppable.get(drive, (None, set()))
        if self.is_known(drive) or (on_port is port and count in allowed):
            return
        rivals = run_by(register, count)
        suspicion = self._suspicion(drive, rivals) if self._is_in_step(drive) else None
        on, before = self._suspected.pop(drive, (port, None))
        if suspicion is not None and suspicion.make is not None:  # it answered as this make several times
            raise _withheld(drive, suspicion.why, suspicion.make)
        if suspicion is not None and (before is None or on is not port):
            self._suspected[drive] = port, suspicion
            raise CheckAgain
        if suspicion is not None and suspicion == before:
            other = self._lookalike(drive, register, count) or self._shown(drive, rivals)
            if other is not None or suspicion.is_certain:
                raise _withheld(drive, suspicion.why, other)  # the next stop checks the drive again
        if suspicion is not None:
            self._doubted[drive] = port, suspicion.why
        self._stoppable[drive] = port, (allowed if on_port is port else set()) | {count}

    def doubt(self, drive: Drive) -> str:
        """Return why a drive that was sent a stop may be of another family; "" if nothing suggests it."""
        port, why = self._doubted.get(drive, (None, ""))
        return why if port is self._exchanges.line.queue and not self.is_known(drive) else ""

    def _is_in_step(self, drive: Drive) -> bool:
        """Return True if a reply from the drive's address can only belong to the present request."""
        peer = self._exchanges.peer(drive)
        return not (peer.counters().late or peer.silences or peer.late_until_ns)

    def _suspicion(self, drive: Drive, rivals: Sequence[Make]) -> Suspicion | None:
        """Run the family's `identify` once; return None unless it, or evidence, suggests another family.

        Evidence of `rivals` is read only if the family's identity is weak.
        """
        port, refused = self._exchanges.line.queue, None
        silences = self._exchanges.peer(drive).silences

        def do(step: Step) -> object:
            nonlocal refused
            if isinstance(step, Wait):
                return None  # a stop does not wait
            try:
                return self._read(drive, step, 1, insists=True)
            except DriveException as refusal:
                refused = refusal
                raise

        try:
            carry_out(drive.identify.script(), do)
            if shown := self._rival(drive, rivals):
                return shown
            if not self._exchanges.has_answered(drive):
                self._echo.read_any(drive, 1, insists=True)
        except (WriteForbidden, DriveException) as refusal:
            if refused and drive.is_temporary(refused.code):
                return None
            is_certain = isinstance(refusal, WriteForbidden) and refusal.rule == ANOTHER_FAMILY
            return Suspicion(str(refusal), is_certain)
        except Exception:  # no reply, or an error in the family's own code: the stop is sent
            return self._rival(drive, rivals)
        if self._is_in_step(drive):
            self._know(drive, port, silences, was_heard=False)  # a known drive is not checked before a stop
        return None

    def _rival(self, drive: Drive, rivals: Sequence[Make]) -> Suspicion | None:
        """Return a suspicion if the family's identity is weak and the drive answers as one of these makes."""
        make = self._shown(drive, rivals) if drive.identity_is_weak else None
        return None if make is None else Suspicion(_declare(make), make=make)

    def _shown(self, drive: Drive, makes: Iterable[Make]) -> Make | None:
        """Return the first of these makes that the drive answers as, SURE times; None if there is none.

        After a request without a reply, only makes that may leave a request unanswered are still tried.
        """
        try:
            probe = Evidence(
                drive.address,
                framing=drive.framing,
                baudrate=drive.settings.baudrate,
                format=drive.settings.format,
            )
        except ValueError:  # the drive does not speak Modbus
            return None
        is_silent = False
        for make in makes:
            if is_silent and not make.may_be_silent:
                continue
            try:
                if all(self._reads_as(probe, drive, make.shows(drive)) for _ in range(SURE)):
                    return make
            except NoReply:
                is_silent = True
            if not self._is_in_step(drive):
                return None
        return None

    def _lookalike(self, drive: Drive, register: Register[Any], count: float) -> Drive | None:
        """Return a drive object of the built-in family that recognises this drive SURE times; else None.

        Families in which the same raw count at this register is also a stop are skipped.
        """
        settings = drive.settings
        for family in MODELS.values():
            if isinstance(drive, family) or not family.identify_recognises or _stops(family, register, count):
                continue
            with suppress(ValueError):  # a drive of that family cannot be on this line
                other = family(
                    drive.address, framing=drive.framing, baudrate=settings.baudrate, format=settings.format
                )
                if all(self._answers_as(drive, other) for _ in range(SURE)):
                    return other
            if not self._is_in_step(drive):
                return None
        return None

    def _answers_as(self, drive: Drive, other: Drive) -> bool:
        try:
            return self._reads_as(other, drive, other.identify.script()) is not False
        except NoReply:
            return False

    def _reads_as(self, other: Drive, drive: Drive, script: Script[Any]) -> Any:
        """Return the result of a script that reads registers of `other` from this drive; False if it fails.

        Raises NoReply if the drive does not answer.
        """

        def do(step: Step) -> object:
            if not isinstance(step, Read):
                return None
            return self._exchanges.value_as(other, drive, step.register)

        try:
            return carry_out(script, do)
        except NoReply:
            raise
        except (BusError, ValueError):
            return False


def _of_same_register(drive: Drive) -> list[Make]:
    """Return the makes whose control register has the same address as this drive's."""
    control = drive.registers.get("control")
    return [make for make in MAKES if control is not None and make.control == control.address]


def _stops(family: type[Drive], register: Register[Any], count: float) -> bool:
    """Return True if a raw count at this register is harmless in the family, such as its own stop."""
    control = family.registers.get("control")
    return (
        control is not None
        and (control.table, control.address) == (register.table, register.address)
        and count in (control.harmless or ())
    )


def _declare(make: Make) -> str:
    return f"it answers as an {make.title} does; if it is one, declare model {make.model}"


def _forget_setpoint(drive: Drive) -> None:
    """Forget the setpoint if the drive cannot report it: it may have lost power while it was silent."""
    if drive.setpoint_name in drive.registers and not drive.register(drive.setpoint_name).readable:
        drive.commanded = None


def _slept_ns() -> int:
    """Return how long the computer has slept since it was started, in ns."""
    return int(clock.boottime_ns() - clock.now_ns())


def _withheld(drive: Drive, why: str, other: Drive | Make | None) -> WriteForbidden:
    way = "Use the hard-wired stop, and find out which drive has this address"
    if other is not None:
        attach = f"{type(other).__name__}({drive.address})" if isinstance(other, Drive) else other.model
        way = (
            f"It answers as a {other.title} does. Use the hard-wired stop, or stop it as that: "
            f"`multidrop stop PORT {other.model} {drive.address}`; in a program detach {drive.name} "
            f"first, and attach {attach}"
        )
    return WriteForbidden(
        f"no stop was sent to {drive.name}: at its address is another drive, as it said twice ({why}), "
        f"which may run at this family's stop. {way}",
        rule=ANOTHER_FAMILY,
    )
