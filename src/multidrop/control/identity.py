"""IdentityCheck: whether the drive at an address is of its family, found out before the first write."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext, suppress

from multidrop.core import Status
from multidrop.drive.family import Drive
from multidrop.drive.script import Read, Step, Wait, carry_out
from multidrop.drives import MODELS
from multidrop.errors import (
    BadReply,
    BusError,
    DriveRefused,
    LineError,
    LookAgain,
    NoReply,
    NotAttached,
    Refused,
)
from multidrop.transport.clock import sleep
from multidrop.transport.exchange import READ_ATTEMPTS, WRITE_TIMEOUT, Exchanges

SURE = 2  # times that a drive answers as another would, before a stop is not sent to it

Timed = Callable[[], AbstractContextManager[None]]


class IdentityCheck:
    """Which drives were looked at, each on the port as it was opened last."""

    def __init__(self, exchanges: Exchanges) -> None:
        self._exchanges = exchanges
        self._known: dict[Drive, object] = {}  # the open port on which it was found to be of its family
        self._glanced: dict[Drive, object] = {}  # or on which a glance proved nothing against a stop
        self._doubts: dict[Drive, tuple[object, tuple[str, bool]]] = {}  # the port, and what the first said

    def is_known(self, drive: Drive) -> bool:
        return self._known.get(drive, self) is self._exchanges.line.queue

    def forget(self, drive: Drive) -> None:
        self._known.pop(drive, None)
        self._glanced.pop(drive, None)
        self._doubts.pop(drive, None)

    def make(self, drive: Drive, timed: Timed = nullcontext) -> None:
        """Look, once; Refused when it is of another family, NoReply when it cannot be heard.

        At least one value is read, so that a line on which an adapter echoes is known to do so before
        a write could take its echo for the drive's confirmation. After the port was opened anew it is
        done again, because something else may be on it. Each look is `timed`.
        """
        if self.is_known(drive):
            return

        def look(step: Step) -> object:
            if isinstance(step, Wait):
                return sleep(step.seconds)
            with timed():
                return self._looked(drive, step, READ_ATTEMPTS)

        port = self._exchanges.line.queue
        try:
            carry_out(drive.identify.script(), look)
        except DriveRefused as refusal:
            kind = drive.title or type(drive).__name__
            raise Refused(
                f"nothing is written to {drive.name}: it refuses what every {kind} answers ({refusal})",
                rule="it does not look like its family",
            ) from refusal
        if not self._exchanges.is_heard(drive):
            with timed():
                self._read_something(drive, READ_ATTEMPTS)
        self._known[drive] = port

    def _looked(self, drive: Drive, step: Step, attempts: int, *, insists: bool = False) -> object:
        if not isinstance(step, Read):
            raise Refused(f"{drive.name}: a look at its identity must not write")
        name = step.register.name
        return self._exchanges.values(drive, [step.register], attempts, insists=insists)[name]

    def _read_something(
        self, drive: Drive, attempts: int, *, insists: bool = False, timeout: float = 0.0
    ) -> None:
        register = drive.telling or next((it for it in drive.registers.values() if it.readable), None)
        if register is not None:
            with suppress(DriveRefused):  # an answer too
                self._exchanges.values(drive, [register], attempts, insists=insists, timeout=timeout)

    def tell_echo(self, drive: Drive, *, insists: bool = False) -> None:
        """Read once, so that the line learns whether what it heard was its adapter's echo.

        Another client that asks the same seems to be one: then the drive's confirmations of writes, which
        are copies too, would not count, until something is read.
        """
        with suppress(NoReply, BadReply, LineError, NotAttached):
            self._read_something(drive, 1, insists=insists, timeout=WRITE_TIMEOUT)

    def why_doubtful(self, drive: Drive) -> str:
        """Return why a reply that is a copy of its request may be the adapter's echo; "" where it is not.

        An echo may begin at any time, and the drive may be dead: so it is to be heard after the write. Where
        the adapter is known to echo the core has told the one from the other.
        """
        line = self._exchanges.line
        if line.has_echo:
            return ""
        try:
            self._read_something(drive, READ_ATTEMPTS)
        except (NoReply, BadReply, LineError, NotAttached) as failure:
            return f"the reply may be the adapter's echo, for nothing was heard of the drive since: {failure}"
        return "the reply was the adapter's echo" if line.has_echo else ""

    # ---- before a stop ----

    def glance(self, drive: Drive) -> None:
        """Look, once and without waiting for anything; only what proves another family is Refused.

        Raises LookAgain after the first answer as another's: call it again, after the stops of others.

        The stop of one family may be another's run. But a look that fails proves nothing, nor does one that
        may have been given the answer to an earlier question: the stop is sent then. It is withheld from a
        drive that answered all that it was ever asked, and SURE times in a row as another would; where it
        refuses to be asked, or its own answers prove little, only if another built-in family is recognised.
        """
        port = self._exchanges.line.queue
        if self.is_known(drive) or self._glanced.get(drive, self) is port:
            return
        look = self._glimpsed_at(drive) if self._is_in_step(drive) else None
        on, before = self._doubts.pop(drive, (port, None))
        if look is not None and (before is None or on is not port):
            self._doubts[drive] = port, look
            raise LookAgain
        if look is not None and look == before:
            (why, is_answered), other = look, self._lookalike(drive)
            if other is not None or (is_answered and not drive.identity_is_inferred):
                raise self._withheld(drive, why, other)  # it is looked at again before the next stop
        self._glanced[drive] = port

    def _is_in_step(self, drive: Drive) -> bool:
        """Whether an answer from its address can only be the one to what is asked now."""
        peer = self._exchanges.peer(drive)
        counters = peer.counters()
        return not (counters.late or counters.ended[Status.NO_REPLY] or peer.late_until_ns)

    def _glimpsed_at(self, drive: Drive) -> tuple[str, bool] | None:
        """Why it is not of its family, and whether each look was answered; None where nothing says so."""
        port, refused = self._exchanges.line.queue, None

        def look(step: Step) -> object:
            nonlocal refused
            if isinstance(step, Wait):
                return None  # a stop waits for nothing
            try:
                return self._looked(drive, step, 1, insists=True)
            except DriveRefused as refusal:
                refused = refusal
                raise

        try:
            carry_out(drive.identify.script(), look)
            if not self._exchanges.is_heard(drive):
                self._read_something(drive, 1, insists=True)
        except (Refused, DriveRefused) as refusal:
            if refused and drive.is_passing(refused.code):
                return None
            return str(refusal), refused is None
        except Exception:  # it cannot be heard; or of the family's own code, which must not keep a stop back
            return None
        if self._is_in_step(drive):
            self._known[drive] = port
        return None

    def _lookalike(self, drive: Drive) -> Drive | None:
        """A drive of the built-in family that would answer as this one does."""
        settings = drive.settings
        for family in MODELS.values():
            if isinstance(drive, family) or family.identity_is_inferred:
                continue
            with suppress(ValueError):  # it could not be on this line
                other = family(
                    drive.address, framing=drive.framing, baudrate=settings.baudrate, format=settings.format
                )
                if all(self._is_one(drive, other) for _ in range(SURE)):
                    return other
            if not self._is_in_step(drive):
                return None
        return None

    def _is_one(self, drive: Drive, other: Drive) -> bool:
        def look(step: Step) -> object:
            if not isinstance(step, Read):
                return None
            return self._exchanges.values_as(other, drive, step.register)[step.register.name]

        try:
            carry_out(other.identify.script(), look)
        except (BusError, ValueError):
            return False
        return True

    @staticmethod
    def _withheld(drive: Drive, why: str, other: Drive | None) -> Refused:
        way = "Use the hard-wired stop, and find out which drive has this address"
        if other is not None:
            way = (
                f"It answers as a {other.title} does. Use the hard-wired stop, or stop it as that: "
                f"`multidrop stop PORT {other.model} {drive.address}`; in a program detach {drive.name} "
                f"first, and attach {type(other).__name__}({drive.address})"
            )
        return Refused(
            f"no stop was sent to {drive.name}: at its address is another drive, as it said twice ({why}), "
            f"which may run at this family's stop. {way}",
            rule="another family is at its address",
        )
