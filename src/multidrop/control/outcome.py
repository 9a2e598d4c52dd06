"""Outcome and Stopped: the known effect of a write and of a stop; conversion of both to CommandResult."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any

from multidrop.drive.register import Register
from multidrop.drive.verbs import CommandOutcome, CommandResult
from multidrop.errors import (
    BadReply,
    BusError,
    CancelledByStop,
    DriveException,
    Expired,
    LineError,
    NoReply,
    NotAttached,
    NotMaster,
    NotVerified,
    Unsupported,
    WriteForbidden,
)


class Effect(Enum):
    DONE = "done"
    TAKEN_AS = "taken as"  # the drive holds another value than the one that was written
    REFUSED = "refused by the drive"
    UNCONFIRMED = "unconfirmed"  # no reply: the write may have had its effect


@dataclass(frozen=True)
class Outcome:
    """The effect of one write.

    `asked` is the value written, `held` the value read back (None if it could not be read). `failure` is the
    error that `Drive.write` raises for this outcome.
    """

    drive: str
    register: Register[Any]
    asked: Any
    effect: Effect
    held: Any = None
    failure: BusError | None = None

    @property
    def ok(self) -> bool:
        """True if the drive has accepted the value."""
        return self.effect is Effect.DONE

    @property
    def value(self) -> Any:
        """The value that the drive holds, as far as it is known. Raises `failure` if there is one."""
        if self.failure is not None:
            raise self.failure
        return self.asked if self.held is None else self.held

    def __str__(self) -> str:
        return f"{self.drive}: {self.register.name} = {self.register.format(self.asked)}: {self._in_words()}"

    def _in_words(self) -> str:
        if self.failure is not None:
            return f"{self.effect.value}: {self.failure}"
        if self.effect is Effect.TAKEN_AS:
            return f"taken as {self.register.format(self.held)}"
        return "done (cannot be read back)" if self.held is None else "done (read back)"


class Seen(Enum):
    STOPPED = "stopped"  # the motor was seen to be at rest
    SENT = "sent but unknown"
    REFUSED = "refused by the drive"  # the drive refused every repetition of the stop
    FAILED = "failed"  # no stop was sent
    NO_MOTOR = "has no motor"  # no stop was needed


# the reason in the result of a stop whose script has no read after its last write
UNSEEN = "confirmed, but not seen to stand"


@dataclass(frozen=True)
class Stopped:
    """The result of one drive's stop, its duration in s, and why the motor was not seen to stop."""

    drive: str
    seen: Seen
    seconds: float
    why: str = ""

    @property
    def ok(self) -> bool:
        """True if the motor was seen to be at rest, or the device has no motor.

        The stop script of your own drive class may read nothing after its last write. Its stop has the result
        STOPPED once the drive has confirmed it, and `ok` is True.
        """
        return self.seen in (Seen.STOPPED, Seen.NO_MOTOR)

    def __str__(self) -> str:
        if self.seen is Seen.NO_MOTOR:
            return f"{self.drive}: {self.seen.value}"
        why = f": {self.why}" if self.why else ""
        return f"{self.drive}: {self.seen.value} after {self.seconds:.1f} s{why}"


# ---- results of commands ----


# the first matching type of exception decides
_OUTCOMES: tuple[tuple[type[BaseException], CommandOutcome], ...] = (
    (WriteForbidden, CommandOutcome.REFUSED),
    (Unsupported, CommandOutcome.REFUSED),
    (NotAttached, CommandOutcome.NOT_SENT),
    (Expired, CommandOutcome.NOT_SENT),
    (CancelledByStop, CommandOutcome.NOT_SENT),
    (DriveException, CommandOutcome.FAILED),
    (NotVerified, CommandOutcome.FAILED),
    # raised only by a read before the first write, so no write was sent
    (NoReply, CommandOutcome.NOT_SENT),
    (BadReply, CommandOutcome.NOT_SENT),
)
_STOP_OUTCOMES = {
    Seen.STOPPED: CommandOutcome.DONE,
    Seen.SENT: CommandOutcome.UNKNOWN,
    Seen.REFUSED: CommandOutcome.FAILED,
    Seen.FAILED: CommandOutcome.NOT_SENT,
    Seen.NO_MOTOR: CommandOutcome.DONE,
}
SURE_OF_A_STOP = (WriteForbidden, NotMaster, Unsupported)


def result_of_failure(failure: BaseException) -> CommandResult:
    """Return the result of a command that raised `failure`; UNKNOWN unless the error shows what happened."""
    return _failed(failure, _outcome_of(failure))


def result_of_failed_stop(failure: BaseException) -> CommandResult:
    """Return the result of a stop that raised `failure`.

    A stop is repeated, so its last error says little about the frames before it.
    """
    if isinstance(failure, DriveException):  # the drive refused the stop each time
        return _failed(failure, CommandOutcome.FAILED)
    is_certain = isinstance(failure, SURE_OF_A_STOP)
    return _failed(failure, _outcome_of(failure) if is_certain else CommandOutcome.UNKNOWN)


def result_of_stop(stopped: Stopped) -> CommandResult:
    outcome = _STOP_OUTCOMES[stopped.seen]
    if stopped.seen is Seen.NO_MOTOR:
        return CommandResult(outcome, stopped.seen.value)
    if outcome is CommandOutcome.DONE and stopped.why:
        return CommandResult(outcome, f"stopped: {stopped.why}")
    if outcome is CommandOutcome.DONE:
        return CommandResult(outcome, f"stopped: seen to stand after {stopped.seconds:.1f} s")
    return CommandResult(outcome, f"{stopped.seen.value}: {stopped.why}", BusError(stopped.why))


def result_of_write(outcome: Outcome) -> CommandResult:
    text = str(outcome)
    if outcome.failure is not None:
        return CommandResult(_outcome_of(outcome.failure), text, outcome.failure)
    held = outcome.register.format(outcome.asked if outcome.held is None else outcome.held)
    if outcome.effect is Effect.DONE:
        return CommandResult(CommandOutcome.DONE, text, held=held)
    return CommandResult(CommandOutcome.FAILED, text, BusError(text), held)


def with_name(drive: str, text: str) -> str:
    """Return a result's text with the drive's name in front, unless the text already starts with it."""
    return text if text.startswith(f"{drive}: ") else f"{drive}: {text}"


def _failed(failure: BaseException, outcome: CommandOutcome) -> CommandResult:
    if not isinstance(failure, (BusError, ValueError)):
        failure = ValueError(str(failure) or type(failure).__name__)
    return CommandResult(outcome, str(failure) or type(failure).__name__, failure)


def _outcome_of(failure: BaseException) -> CommandOutcome:
    if isinstance(failure, (LineError, NotMaster)):  # `is_sent`: a frame may have been sent
        return CommandOutcome.UNKNOWN if failure.is_sent else CommandOutcome.NOT_SENT
    found = (outcome for kind, outcome in _OUTCOMES if isinstance(failure, kind))
    return next(found, CommandOutcome.UNKNOWN)
