"""Make a CommandResult of a write's outcome, a stop's result, or the error that a command raised. No I/O."""

from __future__ import annotations

from multidrop.control.outcome import Effect, Outcome, Seen, Stopped
from multidrop.drive.command_result import CommandOutcome, CommandResult
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

_OUTCOMES: tuple[tuple[type[BaseException], CommandOutcome], ...] = (  # the first match counts
    (WriteForbidden, CommandOutcome.REFUSED),
    (Unsupported, CommandOutcome.REFUSED),
    (NotAttached, CommandOutcome.NOT_SENT),
    (Expired, CommandOutcome.NOT_SENT),
    (CancelledByStop, CommandOutcome.NOT_SENT),
    (DriveException, CommandOutcome.FAILED),
    (NotVerified, CommandOutcome.FAILED),
    (NoReply, CommandOutcome.NOT_SENT),  # raised only by a read before the first write
    (BadReply, CommandOutcome.NOT_SENT),
)
_STOP_OUTCOMES = {
    Seen.STOPPED: CommandOutcome.DONE,
    Seen.SENT: CommandOutcome.UNKNOWN,
    Seen.REFUSED: CommandOutcome.FAILED,
    Seen.FAILED: CommandOutcome.NOT_SENT,
}
SURE_OF_A_STOP = (WriteForbidden, NotMaster, Unsupported)


def result_of_failure(failure: BaseException) -> CommandResult:
    """Return the result of a command that raised this; UNKNOWN unless the error is certain."""
    return _failed(failure, _outcome_of(failure))


def result_of_failed_stop(failure: BaseException) -> CommandResult:
    """Return the result of a stop that raised this.

    A stop is repeated, so its last error says little about the frames before it.
    """
    if isinstance(failure, DriveException):  # the drive refused the stop each time
        return _failed(failure, CommandOutcome.FAILED)
    is_certain = isinstance(failure, SURE_OF_A_STOP)
    return _failed(failure, _outcome_of(failure) if is_certain else CommandOutcome.UNKNOWN)


def result_of_stop(stopped: Stopped) -> CommandResult:
    """Return the result of one drive's stop."""
    outcome = _STOP_OUTCOMES[stopped.seen]
    if outcome is CommandOutcome.DONE:
        return CommandResult(outcome, f"stopped: seen to stand after {stopped.seconds:.1f} s")
    return CommandResult(outcome, f"{stopped.seen.value}: {stopped.why}", BusError(stopped.why))


def result_of_write(outcome: Outcome) -> CommandResult:
    """Return the result of a plain write."""
    text = str(outcome)
    if outcome.failure is not None:
        return CommandResult(_outcome_of(outcome.failure), text, outcome.failure)
    held = outcome.register.format(outcome.asked if outcome.held is None else outcome.held)
    if outcome.effect is Effect.DONE:
        return CommandResult(CommandOutcome.DONE, text, held=held)
    return CommandResult(CommandOutcome.FAILED, text, BusError(text), held)


def with_name(drive: str, text: str) -> str:
    """Return a result's text with the drive's name in front, once."""
    return text if text.startswith(f"{drive}: ") else f"{drive}: {text}"


def _failed(failure: BaseException, outcome: CommandOutcome) -> CommandResult:
    if not isinstance(failure, (BusError, ValueError)):
        failure = ValueError(str(failure) or type(failure).__name__)
    return CommandResult(outcome, str(failure) or type(failure).__name__, failure)


def _outcome_of(failure: BaseException) -> CommandOutcome:
    if isinstance(failure, (LineError, NotMaster)):  # these errors say whether a frame may have been sent
        return CommandOutcome.UNKNOWN if failure.is_sent else CommandOutcome.NOT_SENT
    found = (outcome for kind, outcome in _OUTCOMES if isinstance(failure, kind))
    return next(found, CommandOutcome.UNKNOWN)
