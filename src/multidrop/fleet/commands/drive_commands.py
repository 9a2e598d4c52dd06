"""Drive commands: check what a request means for its drive, before it is offered."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from multidrop import Drive, WriteForbidden
from multidrop.control import CommandResult, carry_out_verb, stop_drive_by, typed_value, write_register
from multidrop.drive import verb_arguments, verbs_of
from multidrop.fleet.commands.words import CommandRequest

_MOVING = ("start", "jog", "reset_fault", "set_frequency")


class Prepared(NamedTuple):
    """A checked command: `text` says what it will do, `work` does it once."""

    text: str
    work: Callable[[], CommandResult]


def commands_of(drive: Drive) -> list[str]:
    """Return the verbs that a command may ask for; a stop needs no offer."""
    return [verb for verb in verbs_of(drive) if verb != "stop"]


def prepare(drive: Drive, request: CommandRequest) -> Prepared:
    """Return what a request means for this drive; nothing is sent.

    Raises ValueError (WriteForbidden is one), TypeError or Unsupported if it must not be sent.
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
    next(getattr(drive, verb).script(**arguments), None)  # raises if the family forbids it
    options = "".join(f", {name} = {getattr(value, 'value', value)}" for name, value in arguments.items())
    text = f"{drive.name}: {verb}{options}"
    if verb not in _MOVING:
        return Prepared(text, lambda: stop_drive_by(verb, drive, None)[drive.name])
    return Prepared(text, partial(carry_out_verb, drive, verb, arguments))


def _prepare_write(drive: Drive, request: CommandRequest) -> Prepared:
    register = drive.register(request.register)
    if not register.writable:
        why = register.never or "it can only be read"
        raise WriteForbidden(f"{request.entry} is never written: {why}", register=register.name)
    value = register.decode(register.encode(typed_value(register, request.value)))
    text = f"{drive.name}: {register.name} = {register.format(value)}"
    return Prepared(text, partial(write_register, drive, register.name, request.value))
