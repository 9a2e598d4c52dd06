"""IdentityCheck: finds out before a write that the drive at an address is of its declared family."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext, suppress
from typing import NamedTuple

from multidrop.control.echo_check import EchoCheck
from multidrop.core import PAUSE_NS
from multidrop.drive.family import Drive
from multidrop.drive.script import Read, Step, Wait, carry_out
from multidrop.errors import ANOTHER_FAMILY, BusError, CheckAgain, DriveException, WriteForbidden
from multidrop.families import MODELS
from multidrop.transport import clock
from multidrop.transport.exchange import READ_ATTEMPTS, Exchanges

SURE = 2  # times that a drive must answer as another would, before a stop is withheld from it

Timed = Callable[[], AbstractContextManager[None]]
Suspicion = tuple[str, bool]  # why it may be of another family, and whether that is certain


class _Look(NamedTuple):
    """The state of things when a drive was found to be of its family."""

    port: object  # as it was opened
    silences: int  # times that it had not answered before
    pauses: int  # in which it was not asked, until then
    at_ns: int
    slept_ns: int  # for which the machine had slept before


class IdentityCheck:
    """The drives that were checked, each on the port as it was opened last."""

    def __init__(self, exchanges: Exchanges, echo: EchoCheck) -> None:
        self._exchanges = exchanges
        self._echo = echo
        self._known: dict[Drive, _Look] = {}  # those that were found to be of their families
        self._stoppable: dict[Drive, object] = {}  # the open port on which nothing was found against a stop
        self._suspected: dict[Drive, tuple[object, Suspicion]] = {}  # the port, and the first suspicion

    def is_known(self, drive: Drive) -> bool:
        look = self._known.get(drive)
        return look is not None and look.port is self._exchanges.line.queue

    def _was_heard(self, drive: Drive) -> bool:
        """Return True where it was known on this port, and PAUSE_NS without an answer never passed since."""
        look = self._known.get(drive)
        if look is None or look.port is not self._exchanges.line.queue:
            return False
        peer = self._exchanges.peer(drive)
        idle_ns = clock.now_ns() - max(look.at_ns, peer.answered_ns)
        return look.pauses == peer.pauses and idle_ns + _slept_ns() - look.slept_ns < PAUSE_NS

    def _has_answered_all(self, drive: Drive) -> bool:
        """Return True where it answered all that it was asked since it was known."""
        look = self._known.get(drive)
        return look is not None and look.silences == self._exchanges.peer(drive).silences

    def forget(self, drive: Drive) -> None:
        self._known.pop(drive, None)
        self._stoppable.pop(drive, None)
        self._suspected.pop(drive, None)

    # ---- before a write that may move a motor ----

    def check(self, drive: Drive, timed: Timed = nullcontext) -> None:
        """Check once; WriteForbidden when it is of another family, NoReply when it does not answer.

        At least one value is read, so that the echo of an adapter is known before it could be taken for
        the drive's confirmation of a write. It is checked again after the port was opened again, after it
        did not answer, and after PAUSE_NS without an answer: something else may be there. Each read is
        within `timed`.
        """
        was_heard = self._was_heard(drive)
        if was_heard and self._has_answered_all(drive):
            return  # nobody has changed it

        def do(step: Step) -> object:
            if isinstance(step, Wait):
                return clock.sleep(step.seconds)
            with timed():
                return self._read(drive, step, READ_ATTEMPTS)

        port, silences = self._exchanges.line.queue, self._exchanges.peer(drive).silences
        try:
            carry_out(drive.identify.script(), do)
        except DriveException as refusal:
            kind = drive.title or type(drive).__name__
            raise WriteForbidden(
                f"nothing is written to {drive.name}: it refuses what every {kind} answers ({refusal})",
                rule="it does not look like its family",
            ) from refusal
        if not self._exchanges.has_answered(drive):
            with timed():
                self._echo.read_any(drive, READ_ATTEMPTS)
        self._know(drive, port, silences, was_heard=was_heard)

    def _know(self, drive: Drive, port: object, silences: int, *, was_heard: bool) -> None:
        """Know it by what it has just answered; it `was_heard` all the time until then."""
        before, pauses = self._known.get(drive), self._exchanges.peer(drive).pauses
        if not was_heard or before is None or before.pauses != pauses:
            _forget_setpoint(drive)
        self._known[drive] = _Look(port, silences, pauses, clock.now_ns(), _slept_ns())

    def _read(self, drive: Drive, step: Step, attempts: int, *, insists: bool = False) -> object:
        if not isinstance(step, Read):
            raise WriteForbidden(f"{drive.name}: a look at its identity must not write")
        return self._exchanges.value(drive, step.register, attempts, insists=insists)

    # ---- before a stop ----

    def check_before_stop(self, drive: Drive) -> None:
        """Check once, without waiting for anything; only proof of another family is WriteForbidden.

        Raises CheckAgain after the first suspicion: call this again, after the stops of other drives.

        The stop of one family may be another's run. But a failed check proves nothing: a parameter such as
        an address or a baud rate may hold a value that is not in force, and a reply may be the answer to an
        earlier request. The stop is sent then. It is withheld only if `identify` fails SURE times in a row,
        every request was answered so far, and either the drive is recognised as one of another built-in
        family, or `identify` itself is certain: it raised WriteForbidden by the rule ANOTHER_FAMILY.
        """
        port = self._exchanges.line.queue
        if self.is_known(drive) or self._stoppable.get(drive, self) is port:
            return
        suspicion = self._suspicion(drive) if self._is_in_step(drive) else None
        on, before = self._suspected.pop(drive, (port, None))
        if suspicion is not None and (before is None or on is not port):
            self._suspected[drive] = port, suspicion
            raise CheckAgain
        if suspicion is not None and suspicion == before:
            (why, is_certain), other = suspicion, self._lookalike(drive)
            if other is not None or is_certain:
                raise _withheld(drive, why, other)  # it is checked again before the next stop
        self._stoppable[drive] = port

    def _is_in_step(self, drive: Drive) -> bool:
        """Return True where an answer from its address can only belong to the request sent now."""
        peer = self._exchanges.peer(drive)
        return not (peer.counters().late or peer.silences or peer.late_until_ns)

    def _suspicion(self, drive: Drive) -> Suspicion | None:
        """Run the family's `identify` once; None where nothing says that it is another."""
        port, refused = self._exchanges.line.queue, None
        silences = self._exchanges.peer(drive).silences

        def do(step: Step) -> object:
            nonlocal refused
            if isinstance(step, Wait):
                return None  # a stop waits for nothing
            try:
                return self._read(drive, step, 1, insists=True)
            except DriveException as refusal:
                refused = refusal
                raise

        try:
            carry_out(drive.identify.script(), do)
            if not self._exchanges.has_answered(drive):
                self._echo.read_any(drive, 1, insists=True)
        except (WriteForbidden, DriveException) as refusal:
            if refused and drive.is_passing(refused.code):
                return None
            return str(refusal), isinstance(refusal, WriteForbidden) and refusal.rule == ANOTHER_FAMILY
        except Exception:  # no answer; or the family's own code failed, which must not keep a stop back
            return None
        if self._is_in_step(drive):
            self._know(drive, port, silences, was_heard=False)  # else it was known
        return None

    def _lookalike(self, drive: Drive) -> Drive | None:
        """Return a drive of the built-in family whose identity check this drive passes SURE times."""
        settings = drive.settings
        for family in MODELS.values():
            if isinstance(drive, family) or not family.identify_recognises:
                continue
            with suppress(ValueError):  # it could not be on this line
                other = family(
                    drive.address, framing=drive.framing, baudrate=settings.baudrate, format=settings.format
                )
                if all(self._answers_as(drive, other) for _ in range(SURE)):
                    return other
            if not self._is_in_step(drive):
                return None
        return None

    def _answers_as(self, drive: Drive, other: Drive) -> bool:
        def do(step: Step) -> object:
            if not isinstance(step, Read):
                return None
            return self._exchanges.value_as(other, drive, step.register)

        try:
            carry_out(other.identify.script(), do)
        except (BusError, ValueError):
            return False
        return True


def _forget_setpoint(drive: Drive) -> None:
    """Forget what a drive cannot say: unheard for so long, asked or not, it may have lost its power."""
    if drive.setpoint_name in drive.registers and not drive.register(drive.setpoint_name).readable:
        drive.commanded = None


def _slept_ns() -> int:
    """Return for how long the machine has slept so far."""
    return int(clock.boottime_ns() - clock.now_ns())


def _withheld(drive: Drive, why: str, other: Drive | None) -> WriteForbidden:
    way = "Use the hard-wired stop, and find out which drive has this address"
    if other is not None:
        way = (
            f"It answers as a {other.title} does. Use the hard-wired stop, or stop it as that: "
            f"`multidrop stop PORT {other.model} {drive.address}`; in a program detach {drive.name} "
            f"first, and attach {type(other).__name__}({drive.address})"
        )
    return WriteForbidden(
        f"no stop was sent to {drive.name}: at its address is another drive, as it said twice ({why}), "
        f"which may run at this family's stop. {way}",
        rule=ANOTHER_FAMILY,
    )
