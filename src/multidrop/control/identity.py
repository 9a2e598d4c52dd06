"""IdentityCheck and EchoCheck: find out which device answers at a drive's address.

IdentityCheck confirms that the device is of its declared family. EchoCheck distinguishes the reply to a write
from the adapter's echo: most such replies are, like an echo, copies of their requests.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

from multidrop.core import PAUSE_NS, Peer
from multidrop.drive.family import Drive
from multidrop.drive.register import Register
from multidrop.drive.verbs import Read, Script, Step, Wait, carry_out
from multidrop.errors import (
    ANOTHER_FAMILY,
    BusError,
    CheckAgain,
    DriveException,
    NoReply,
    NoValue,
    WriteForbidden,
)
from multidrop.families import MODELS
from multidrop.families.makes import MAKES, Evidence, Make, easily_mistaken_for, run_by
from multidrop.transport import clock
from multidrop.transport.exchange import READ_ATTEMPTS, READ_FAILURES, WRITE_TIMEOUT, Exchanges

SURE = 2  # number of checks in a row that must find another family before a stop is refused

Timed = Callable[[], AbstractContextManager[None]]


class Suspicion(NamedTuple):
    """Why a drive may not be of its declared family.

    `make` is the make that the drive answers as, if its registers show one; `why` is then "".
    """

    why: str
    is_certain: bool = False
    make: Make | None = None


class EchoCheck:
    """Reads registers to find out whether the line's adapter echoes the requests."""

    def __init__(self, exchanges: Exchanges) -> None:
        self._exchanges = exchanges

    def read_any(self, drive: Drive, attempts: int, *, insists: bool = False, timeout: float = 0.0) -> None:
        """Read one register, to find out whether the drive answers.

        An adapter's echo cannot pass for the reply, because a read's reply is never a copy of its request.
        A Modbus exception counts as a reply. Does nothing if the drive has no readable register.
        """
        readable = (register for register in drive.registers.values() if register.readable)
        register = drive.echo_probe or next(readable, None)
        if register is not None:
            with suppress(DriveException, NoValue):
                self._exchanges.values(drive, [register], attempts, insists=insists, timeout=timeout)

    def probe(self, drive: Drive, *, insists: bool = False) -> bool:
        """Read a register once; return True if the drive answers and the adapter does not echo requests.

        A request of another client can look like an echo of our own. The core would then ignore the drive's
        confirmations of writes, because they are copies of our requests. A reply to this read prevents that.
        With `insists`, first reopen a lost port: some servers close the connection after each reply.
        """
        line = self._exchanges.line
        try:
            if insists and line.is_lost:
                line.regain()
            self.read_any(drive, 1, insists=insists, timeout=WRITE_TIMEOUT)
        except READ_FAILURES:
            return False
        return self._exchanges.has_answered(drive) and not line.has_echo

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
        except READ_FAILURES as failure:
            return f"the reply may be the adapter's echo, because the drive has not answered since: {failure}"
        return "the reply was the adapter's echo" if line.has_echo else ""


class _Confirmed(NamedTuple):
    """The drive's state when its family was last confirmed."""

    silences: int  # number of the drive's unanswered requests before the confirmation
    pauses: int  # number of the drive's silences of PAUSE_NS or more before the confirmation
    at_ns: int
    slept_ns: int  # how long the computer had slept since it was started

    def was_heard(self, peer: Peer) -> bool:
        """Return True if the drive was never silent for PAUSE_NS or more since this confirmation."""
        idle_ns = clock.now_ns() - max(self.at_ns, peer.answered_ns)
        return self.pauses == peer.pauses and idle_ns + _slept_ns() - self.slept_ns < PAUSE_NS


class _Findings:
    """Results of a drive's checks since its port was opened."""

    def __init__(self, port: object) -> None:
        self.port = port  # the open port's object; reopening creates another one
        self.confirmed: _Confirmed | None = None
        self.stops: set[float] = set()  # raw counts that `check_before_stop` has allowed
        self.suspicion: Suspicion | None = None  # result of the previous check before a stop
        self.doubt = ""  # why the drive seemed to be of another family when a stop was sent


class IdentityCheck:
    """Checks drives against their declared family, and keeps the results until the port is reopened."""

    def __init__(self, exchanges: Exchanges, echo: EchoCheck) -> None:
        self._exchanges = exchanges
        self._echo = echo
        # weak: a drive that was detached during its check must not stay in memory
        self._all_findings: WeakKeyDictionary[Drive, _Findings] = WeakKeyDictionary()

    def _findings(self, drive: Drive) -> _Findings:
        port = self._exchanges.line.queue
        findings = self._all_findings.get(drive)
        if findings is None or findings.port is not port:
            findings = self._all_findings[drive] = _Findings(port)
        return findings

    def is_known(self, drive: Drive) -> bool:
        return self._findings(drive).confirmed is not None

    def forget(self, drive: Drive) -> None:
        self._all_findings.pop(drive, None)

    # ---- before a write that may move a motor ----

    def check(self, drive: Drive, timed: Timed = nullcontext) -> None:
        """Check that the drive is of its declared family, unless the last check still holds.

        Raises WriteForbidden if the drive is of another family, NoReply if it does not answer. A check no
        longer holds if the port was reopened, a reply was missing, or the drive was silent for PAUSE_NS: then
        the drive may have been replaced. Reads at least one value, so that an adapter's echo is detected
        before it could pass for the drive's confirmation. Each read runs within its own `timed()` block.
        """
        findings = self._findings(drive)
        last, peer = findings.confirmed, self._exchanges.peers.of(drive)
        silences = peer.silences
        was_heard = last is not None and last.was_heard(peer)
        if last and was_heard and last.silences == silences:
            return  # the drive cannot have been replaced since its last check

        def do(step: Step) -> object:
            if isinstance(step, Wait):
                clock.sleep(step.seconds)
                return None
            with timed():
                return self._read(drive, step, READ_ATTEMPTS)

        try:
            carry_out(drive.identify.script(), do)
        except WriteForbidden as refusal:
            make = self._shown(drive, _of_same_register(drive), timed)
            if make is None:
                raise
            why = f"{refusal}; the drive {_described(make)}"
            raise WriteForbidden(why, rule=refusal.rule) from refusal
        except DriveException as refusal:
            kind = drive.title or type(drive).__name__
            raise WriteForbidden(
                f"nothing is written to {drive.name}: the drive refuses a read that every {kind} answers "
                f"({refusal})",
                rule="it does not answer like its family",
            ) from refusal
        if drive.identity_is_weak and (rivals := easily_mistaken_for(drive)):
            silences = self._exclude(drive, rivals, timed, silences)
        if not self._exchanges.has_answered(drive):
            with timed():
                self._echo.read_any(drive, READ_ATTEMPTS)
        self._know(drive, findings, silences, was_heard=was_heard)

    def _exclude(self, drive: Drive, makes: Sequence[Make], timed: Timed, silences: int) -> int:
        """Raise WriteForbidden if the drive's registers show an excluded make.

        A missing reply has two possible causes. The drive may lack the register that was read, or the drive
        may be of an excluded make and its reply was lost. So the check is repeated after a missing reply.
        Returns `silences`, plus the number of replies that are missing because the drive lacks the registers.
        """
        peer = self._exchanges.peers.of(drive)
        for _ in range(SURE):
            before = peer.silences
            make = self._shown(drive, makes, timed)
            if make is not None:
                why = f"nothing is written to {drive.name}: the drive {_described(make)}"
                raise WriteForbidden(why, rule="it shows another make")
            if peer.silences == before:
                break
            silences += peer.silences - before
        else:
            with timed():
                self._echo.read_any(drive, READ_ATTEMPTS)
        return silences

    def _know(self, drive: Drive, findings: _Findings, silences: int, *, was_heard: bool) -> None:
        """Record that the family was confirmed; `was_heard` is False if the drive had been silent before."""
        before, pauses = findings.confirmed, self._exchanges.peers.of(drive).pauses
        if not was_heard or before is None or before.pauses != pauses:
            _forget_setpoint(drive)
        findings.confirmed = _Confirmed(silences, pauses, clock.now_ns(), _slept_ns())

    def _read(self, drive: Drive, step: Step, attempts: int, *, insists: bool = False) -> object:
        if not isinstance(step, Read):
            raise WriteForbidden(f"{drive.name}: an identity check must not write")
        return self._exchanges.value(drive, step.register, attempts, insists=insists)

    # ---- before a stop ----

    def check_before_stop(self, drive: Drive, register: Register[Any], count: float) -> None:
        """Check the family once per open port, without waits.

        Raises WriteForbidden if the drive is surely of another make. Raises CheckAgain after the first
        suspicion: call this again after the stops of other drives.

        The raw count that stops one family may run the motor of another. But a failed check does not prove
        that the drive is of another family. A parameter such as an address or a baud rate may hold a value
        that is not in force yet, and a reply may belong to an earlier request. In such a case the stop is
        sent. It is refused only if `identify` fails SURE times in a row, every request was answered so
        far, and there is more evidence. Any one of these is enough: another built-in family recognises the
        drive; the drive answers as a make whose motor this raw count would run; `identify` raised
        WriteForbidden with the rule ANOTHER_FAMILY.
        """
        findings = self._findings(drive)
        if findings.confirmed or count in findings.stops:
            return
        rivals = run_by(register, count)
        suspicion = self._suspicion(drive, rivals) if self._is_in_step(drive) else None
        before, findings.suspicion = findings.suspicion, None
        # `make` is set only after SURE checks in a row, so no other check is needed
        if suspicion is not None and suspicion.make is not None:
            raise _withheld(drive, suspicion.why, suspicion.make)
        if suspicion is not None and before is None:
            findings.suspicion = suspicion
            raise CheckAgain
        if suspicion is not None and suspicion == before:
            other = self._lookalike(drive, register, count) or self._shown(
                drive, self._while_in_step(drive, rivals)
            )
            if other is not None or suspicion.is_certain:
                # not added to `findings.stops`, so the next stop checks the drive again
                raise _withheld(drive, suspicion.why, other)
        if suspicion is not None:
            findings.doubt = suspicion.why
        findings.stops.add(count)

    def doubt(self, drive: Drive) -> str:
        """Return why the drive may be of another family although a stop was sent to it; "" if no reason."""
        findings = self._findings(drive)
        return "" if findings.confirmed else findings.doubt

    def _is_in_step(self, drive: Drive) -> bool:
        """Return True if the drive has answered every request in time so far."""
        peer = self._exchanges.peers.of(drive)
        return not (peer.counters().late or peer.silences or peer.late_until_ns)

    def _suspicion(self, drive: Drive, rivals: Sequence[Make]) -> Suspicion | None:
        """Run the family's `identify` once; return a suspicion if the drive seems to be of another family.

        If `identify` alone cannot exclude other makes (`identity_is_weak`), also read the registers that show
        the makes in `rivals`.
        """
        findings, silences = self._findings(drive), self._exchanges.peers.of(drive).silences
        refused = None

        def do(step: Step) -> object:
            nonlocal refused
            if isinstance(step, Wait):
                return None  # skipped: a stop must not be delayed
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
            self._know(drive, findings, silences, was_heard=False)
        return None

    def _rival(self, drive: Drive, rivals: Sequence[Make]) -> Suspicion | None:
        """Return a suspicion if `identify` cannot exclude these makes and the drive answers like one."""
        makes = self._while_in_step(drive, rivals)
        make = self._shown(drive, makes) if drive.identity_is_weak else None
        return None if make is None else Suspicion("", make=make)

    def _shown(self, drive: Drive, makes: Iterable[Make], timed: Timed = nullcontext) -> Make | None:
        """Check the drive's registers for each make; return the first make that fits, or None.

        A make fits if SURE checks in a row show it. After a missing reply, makes that answer every request
        are skipped.
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
                if all(self._reads_as(probe, drive, make.shows(drive), timed) for _ in range(SURE)):
                    return make
            except NoReply:
                is_silent = True
        return None

    def _while_in_step(self, drive: Drive, makes: Iterable[Make]) -> Iterator[Make]:
        """Yield these makes as long as the drive answers each request in time.

        After a late reply, a later reply could be mistaken for the answer to another request.
        """
        for make in makes:
            yield make
            if not self._is_in_step(drive):
                return

    def _lookalike(self, drive: Drive, register: Register[Any], count: float) -> Drive | None:
        """Return the drive as an object of another built-in family that recognises it, or None.

        The other family must recognise it SURE times. Families in which the same raw count at this register
        is also a stop are skipped.
        """
        settings = drive.settings
        for family in MODELS.values():
            if isinstance(drive, family) or not family.identify_recognises:
                continue
            if _is_harmless_in(family, register, count):
                continue
            with suppress(ValueError):  # raised if this family does not allow the drive's line settings
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

    def _reads_as(self, other: Drive, drive: Drive, script: Script[Any], timed: Timed = nullcontext) -> Any:
        """Run a script of `other` on `drive`; return its result, or False if a read fails.

        Raises NoReply if the drive does not answer.
        """

        def do(step: Step) -> object:
            if not isinstance(step, Read):
                return None
            with timed():
                return self._exchanges.value_as(other, drive, step.register)

        try:
            return carry_out(script, do)
        except NoReply:
            raise
        except (BusError, ValueError):
            return False


def _of_same_register(drive: Drive) -> list[Make]:
    """Return the makes whose control register has the same address as this drive's control register."""
    control = drive.registers.get("control")
    return [make for make in MAKES if control is not None and make.control == control.address]


def _is_harmless_in(family: type[Drive], register: Register[Any], count: float) -> bool:
    """Return True if this write is harmless to a drive of the family, because it is the family's stop."""
    control = family.registers.get("control")
    return (
        control is not None
        and (control.table, control.address) == (register.table, register.address)
        and count in (control.harmless or ())
    )


def _described(make: Make) -> str:
    return f"{_answers_as(make.title)}. If it is one, declare model = {make.model}"


def _answers_as(title: str) -> str:
    return f"answers as {'an' if title[0] in 'AEIO' else 'a'} {title} does"


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
        why = "; ".join(filter(None, (why, f"it {_answers_as(other.title)}")))
        way = (
            f"Use the hard-wired stop, or `multidrop stop PORT {other.model} {drive.address}`; in a program, "
            f"detach {drive.name}, attach {attach} and stop that"
        )
    return WriteForbidden(
        f"no stop was sent to {drive.name}: two checks found another drive at its address, which this stop "
        f"may start ({why}). {way}",
        rule=ANOTHER_FAMILY,
    )
