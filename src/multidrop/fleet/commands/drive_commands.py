"""Drive commands: the verbs and writes that a fleet carries out on a drive, and what is known of each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from multidrop import (
    BadReply,
    Bus,
    CancelledByStop,
    Drive,
    DriveException,
    Expired,
    LineError,
    NoReply,
    NotAttached,
    NotMaster,
    NotVerified,
    Register,
    Seen,
    Stopped,
    Unsupported,
    WriteForbidden,
)
from multidrop.control import Effect
from multidrop.drive import verb_arguments, verbs_of
from multidrop.fleet.commands.words import CommandAnswer, CommandOutcome, CommandRequest

_MOVING = ("start", "jog", "reset_fault", "set_frequency")


class Prepared(NamedTuple):
    """A command that its drive's family has: what it will do, and the doing, once."""

    text: str
    work: Callable[[], CommandAnswer]


def commands_of(drive: Drive) -> list[str]:
    """Return the verbs that a command may ask for; `stop` goes a way of its own."""
    return [verb for verb in verbs_of(drive) if verb != "stop"]


def prepare(drive: Drive, request: CommandRequest) -> Prepared:
    """Return what a request means for this drive; nothing is sent.

    Raises ValueError (or WriteForbidden, which is one), TypeError or Unsupported for what is never sent.
    """
    return _prepare_write(drive, request) if request.register else _prepare_verb(drive, request)


def _prepare_verb(drive: Drive, request: CommandRequest) -> Prepared:
    verb = request.verb
    if verb not in commands_of(drive):
        known = ", ".join(commands_of(drive)) or "none"
        raise ValueError(f"{drive.name} has no verb {verb!r}; it has {known}")
    arguments = verb_arguments(verb, request.options)
    if verb in _MOVING:
        drive.check_confirmed(verb)
    next(getattr(drive, verb).script(**arguments), None)  # raises for what the family forbids
    told = "".join(f", {name} = {getattr(value, 'value', value)}" for name, value in arguments.items())

    def work() -> CommandAnswer:
        try:
            getattr(drive, verb)(**arguments)
        except Exception as failure:  # whatever it is: the asker must know
            return (answer_of if verb in _MOVING else answer_of_stop)(failure)
        return CommandAnswer(CommandOutcome.DONE, f"{drive.name}: {verb} is done")

    return Prepared(f"{drive.name}: {verb}{told}", work)


def _prepare_write(drive: Drive, request: CommandRequest) -> Prepared:
    register = drive.register(request.register)
    if not register.writable:
        why = register.never or "it can only be read"
        raise WriteForbidden(f"{request.entry} is never written: {why}", register=register.name)
    value = register.decode(register.encode(_typed(register, request.value)))

    def work() -> CommandAnswer:
        bus: Bus | None = drive.bus
        if bus is None:
            return CommandAnswer(CommandOutcome.NOT_SENT, f"{drive.name} is on no line any more")
        try:
            outcome = bus.try_write(drive, register, value)
        except Exception as failure:  # whatever it is: the asker must know
            return answer_of(failure)
        if outcome.failure is not None:
            return answer_of(outcome.failure)
        held = register.format(outcome.asked if outcome.held is None else outcome.held)
        found = CommandOutcome.DONE if outcome.effect is Effect.DONE else CommandOutcome.FAILED
        return CommandAnswer(found, str(outcome), held=held)

    return Prepared(f"{drive.name}: {register.name} = {register.format(value)}", work)


def _typed(register: Register[Any], value: float | str) -> Any:
    """Return a value as the register takes it: a choice by its name or its raw count, never rounded."""
    if isinstance(value, str):
        return register.parse(value)
    if register.values is None:
        return value
    if value != int(value):
        raise ValueError(f"{register.name} takes a choice's name or its whole number, not {value!r}")
    return register.decode(value)


# ---- what became of it ----

_OUTCOMES: tuple[tuple[type[BaseException], CommandOutcome], ...] = (  # by the first that fits
    (WriteForbidden, CommandOutcome.REFUSED),
    (Unsupported, CommandOutcome.REFUSED),
    (NotAttached, CommandOutcome.NOT_SENT),
    (Expired, CommandOutcome.NOT_SENT),
    (CancelledByStop, CommandOutcome.NOT_SENT),
    (DriveException, CommandOutcome.FAILED),
    (NotVerified, CommandOutcome.FAILED),
    (NoReply, CommandOutcome.NOT_SENT),  # of a read before anything was written
    (BadReply, CommandOutcome.NOT_SENT),
)


def answer_of(failure: Exception) -> CommandAnswer:
    """Return what a library's error means; unknown where it does not say for certain."""
    text = str(failure) or type(failure).__name__
    if isinstance(failure, (LineError, NotMaster)):  # both say whether something had begun to leave
        outcome = CommandOutcome.UNKNOWN if failure.is_sent else CommandOutcome.NOT_SENT
        return CommandAnswer(outcome, text)
    found = (outcome for kind, outcome in _OUTCOMES if isinstance(failure, kind))
    return CommandAnswer(next(found, CommandOutcome.UNKNOWN), text)


# ---- stops ----


def stop_drive(drive: Drive, seconds: float | None) -> dict[str, CommandAnswer]:
    """Stop one drive, for so many seconds or the usual ones; by its name, what is known. Never raises."""
    try:
        drive.stop(seconds=seconds)
    except DriveException as failure:  # each time that it was sent
        return {drive.name: CommandAnswer(CommandOutcome.FAILED, str(failure))}
    except Exception as failure:  # whatever it is: everybody must see it
        return {drive.name: answer_of_stop(failure)}
    return {drive.name: CommandAnswer(CommandOutcome.DONE, f"{drive.name}: stopped: seen to stand")}


def answer_of_stop(failure: Exception) -> CommandAnswer:
    """Return what the failure of a stop means: it is sent again and again, so most say nothing certain."""
    if isinstance(failure, (WriteForbidden, NotMaster, Unsupported)):
        return answer_of(failure)
    return CommandAnswer(CommandOutcome.UNKNOWN, str(failure) or type(failure).__name__)


def answers_of_stops(found: Mapping[str, Stopped]) -> dict[str, CommandAnswer]:
    """Return what is known of the stops of a whole line."""
    outcomes = {
        Seen.STOPPED: CommandOutcome.DONE,
        Seen.SENT: CommandOutcome.UNKNOWN,
        Seen.REFUSED: CommandOutcome.FAILED,
        Seen.FAILED: CommandOutcome.NOT_SENT,
    }
    return {name: CommandAnswer(outcomes[one.seen], str(one)) for name, one in found.items()}
