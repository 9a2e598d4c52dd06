"""`multidrop start`, `stop` and the other verbs: each calls the drive's method of the same name."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from multidrop.bus import Bus
from multidrop.cli import DONE, HARD_WIRED, MISTAKE, STOPS
from multidrop.cli.stop_plant import add_plant_stop_arguments, names_plant, stop_plant
from multidrop.cli.support.arguments import add_json_argument, add_writing_arguments, duration, number
from multidrop.cli.support.confirm import confirm
from multidrop.cli.support.interruption import telling_what_was_sent
from multidrop.cli.support.output import command_line, print_text, warn
from multidrop.cli.support.target import Target, add_target_arguments, check_words, number_of, target_of
from multidrop.cli.support.values import as_json, nearest_value
from multidrop.control.audit_log import AuditLog
from multidrop.control.stop_attempt import LEAST_S
from multidrop.drive.family import Drive
from multidrop.drive.script import Script, Write
from multidrop.drive.state import Direction, State
from multidrop.errors import LineError, Unsupported

_DIRECTED = ("start", "jog")
_FURTHER = {"set-frequency": ("HZ",)}  # arguments of commands behind the drive
_SHOWING_WATCHDOG = ("state", *_DIRECTED)  # they print what the motor does when the client dies
_QUESTIONS = {  # asked before anything is sent; a stop needs no confirmation
    "start": "Start the motor of",
    "jog": "Turn the motor of",
    "reset-fault": "Reset the fault of",
    "set-frequency": "Change the frequency setpoint of",
    "release-control": "Give the command over the motor back to panel and terminals of",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    command = parser.get_default("command")
    add_target_arguments(parser, *_FURTHER.get(command, ()))
    if command == "stop":
        add_plant_stop_arguments(parser)
    if command in _DIRECTED:
        parser.add_argument(
            "--direction",
            choices=[direction.value for direction in Direction],
            help="the one in force if not given",
        )
    if command == "start":
        parser.add_argument("--frequency", metavar="HZ", type=number, help="write this setpoint first")
    if command in STOPS:
        parser.add_argument(
            "--seconds",
            metavar="S",
            type=_stop_time,
            help="repeat it for so long until the motor stands; for 30 s at least if not given",
        )
    if command != "state":
        add_writing_arguments(parser, asks=command in _QUESTIONS)
    add_json_argument(parser)


def _stop_time(text: str) -> float | None:
    """Parse a number of seconds above 0; what is none is told, and keeps no stop back."""
    try:
        return duration(text)
    except argparse.ArgumentTypeError as mistake:
        warn(f"--seconds: {mistake}: the stop is repeated for {LEAST_S:g} s at least, as without it")
        return None


def run(arguments: argparse.Namespace) -> int:
    if names_plant(arguments):
        return stop_plant(arguments, _audit_file(arguments))
    target, words = _target(arguments)
    if words and arguments.command not in STOPS:
        arguments.frequency = number_of(arguments, "HZ", words[0])
    drive = target.drive
    verb = getattr(drive, arguments.command.replace("-", "_"))
    parameters = _parameters(arguments)
    _rehearse(verb.script(*parameters))
    hz = getattr(arguments, "frequency", None)
    setpoint = None if hz is None else _setpoint(drive, hz)
    if arguments.command in _QUESTIONS:
        drive.check_confirmed(arguments.command)
        how = _details(arguments)
        confirm(f"{_QUESTIONS[arguments.command]} {drive.name} on {target.port}{how}?", arguments)
    limit = {"seconds": arguments.seconds} if arguments.command in STOPS else {}
    with _annotating(arguments.command, target) as known, _opened(target, arguments) as bus:
        known.clear()
        if hz is not None and arguments.command != "set-frequency":
            drive.set_frequency(hz)
        state = verb(*parameters, **limit)
        known.append(f"{drive.name}: {arguments.command} is done")
        watchdog = bus.watchdog(drive) if arguments.command in _SHOWING_WATCHDOG else ""
        if not isinstance(state, State):
            try:
                state = drive.state()
            except Unsupported:
                state = None
    if arguments.json:
        print_text(json.dumps(_record(arguments.command, drive, state, setpoint, watchdog), indent=2))
    elif arguments.command == "state":
        print_text(f"{state}\nwatchdog: {watchdog}")
    else:
        print_text(_sentence(arguments.command, drive, state, setpoint, watchdog))
    return MISTAKE if words and arguments.command in STOPS else DONE


def _target(arguments: argparse.Namespace) -> tuple[Target, list[str]]:
    """Return the drive that is named, and the words behind it, of which a stop uses none and says so."""
    command = arguments.command
    if command not in STOPS:
        target, words = target_of(arguments)
        check_words(arguments, words, _FURTHER.get(command, ()))
        return target, words
    try:
        target, words = target_of(arguments)
    except (ValueError, TypeError) as mistake:
        raise ValueError(f"the {command} was NOT sent: {mistake}") from mistake
    if words:
        warn(f"left out, for {command} takes one drive, and that is {target.drive.name}: {' '.join(words)}")
    return target, words


def _opened(target: Target, arguments: argparse.Namespace) -> Bus:
    """Open the drive's line; of a stop whose port cannot be had, say that it was not sent."""
    audit = _audit_file(arguments)
    try:
        return target.open_bus(audit)
    except LineError as failure:
        if arguments.command not in STOPS:
            raise
        raise OSError(f"the {arguments.command} was NOT sent: {failure}; {HARD_WIRED}") from failure


def _audit_file(arguments: argparse.Namespace) -> str | None:
    """Return the audit log's path; None, with a warning, where it cannot be opened for a stop.

    A log that cannot be written holds no stop back.
    """
    audit: str | None = getattr(arguments, "audit", None)
    if audit and arguments.command in STOPS:
        try:
            AuditLog(audit).close()
        except OSError as failure:
            warn(f"{audit}: {failure.strerror}: the {arguments.command} is sent and not noted there")
            return None
    return audit


@contextmanager
def _annotating(command: str, target: Target) -> Iterator[list[str]]:
    """Add notes to an interruption: what is known of the verb, and the command that stops the motor."""
    try:
        with telling_what_was_sent(target.drive, command) as known:
            yield known
    except KeyboardInterrupt as interruption:
        if command != "state":
            interruption.add_note(f"to stop it, type: {command_line(('multidrop', 'stop', *target.words))}")
        raise


def _setpoint(drive: Drive, hz: float) -> Write | None:
    """Return what set_frequency writes; None where its script begins with a read."""
    step = next(drive.set_frequency.script(hz))
    if not isinstance(step, Write):
        return None
    return Write(step.register, nearest_value(step.register, step.value))


def _rehearse(script: Script[Any]) -> None:
    """Make the script's first step: raise for what the family lacks or forbids, before a port is opened."""
    step = next(script)
    if isinstance(step, Write):
        step.register.encode(step.value)


def _details(arguments: argparse.Namespace) -> str:
    """Return what a question says of the setpoint and the direction that were asked for."""
    hz, direction = (getattr(arguments, name, None) for name in ("frequency", "direction"))
    at = "to" if arguments.command == "set-frequency" else "at"
    return ("" if hz is None else f" {at} {hz:g} Hz") + (f", {direction}" if direction else "")


def _parameters(arguments: argparse.Namespace) -> list[Any]:
    if arguments.command in _DIRECTED:
        return [Direction(arguments.direction) if arguments.direction else None]
    return [arguments.frequency] if arguments.command == "set-frequency" else []


# ---- what became of it ----


def _sentence(command: str, drive: Drive, state: State | None, setpoint: Write | None, watchdog: str) -> str:
    at = f" at {setpoint.register.name} = {setpoint.register.format(setpoint.value)}" if setpoint else ""
    done = f"{drive.name}: {command} done{at}; state: {state or 'the family cannot say'}"
    return done + (f"; watchdog: {watchdog}" if watchdog else "")


def _record(
    command: str, drive: Drive, state: State | None, setpoint: Write | None, watchdog: str
) -> dict[str, Any]:
    record: dict[str, Any] = {"drive": drive.name, "done": command, "state": _as_json(state)}
    if setpoint:
        register = setpoint.register
        record["setpoint"] = {"register": register.name} | as_json(register, setpoint.value)
    return record | ({"watchdog": watchdog} if watchdog else {})


def _as_json(state: State | None) -> dict[str, Any] | None:
    if state is None:
        return None
    return {
        "condition": state.condition.value,
        "direction": state.direction.value if state.direction else None,
        "fault": state.fault,
        "note": state.note,
    }
