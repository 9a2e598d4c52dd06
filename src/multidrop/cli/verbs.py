"""`multidrop start`, `stop` and the other verbs: each calls the drive's method of the same name.

`multidrop stop PLANT.toml` stops all drives of a plant, or with --line those of one line.
"""

from __future__ import annotations

import argparse
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from queue import SimpleQueue
from typing import Any

from multidrop.bus import Bus
from multidrop.cli import DONE, FAILED, HARD_WIRED, MISTAKE, STOPS
from multidrop.cli.support.arguments import (
    Target,
    add_json_argument,
    add_target_arguments,
    add_writing_arguments,
    check_words,
    duration,
    is_plant,
    number,
    number_of,
    plant_of,
    target_of,
)
from multidrop.cli.support.output import (
    command_line,
    confirm,
    print_json,
    print_text,
    reporting_interruption,
    warn,
)
from multidrop.cli.support.values import as_json, nearest_value
from multidrop.control.call import written_before
from multidrop.control.outcome import Seen, Stopped
from multidrop.control.records import AuditLog
from multidrop.control.stops import LEAST_S
from multidrop.drive.family import Drive
from multidrop.drive.verbs import Direction, Script, State, Write
from multidrop.errors import LineError, Unsupported
from multidrop.plant.model import Plant, PlantLine
from multidrop.transport import clock

SENDING_S = 30.0  # s; longest time from the user's confirmation to the first write, port opening included
_DIRECTED = ("start", "jog")
_FURTHER = {"set-frequency": ("HZ",)}  # words that follow the drive's name, by command
_SHOWING_WATCHDOG = ("state", *_DIRECTED)  # commands that print how the motor reacts if this program dies
_QUESTIONS = {  # questions asked before the first request of a verb; stops need no confirmation
    "start": "Start the motor of",
    "jog": "Turn the motor of",
    "reset-fault": "Reset the fault of",
    "set-frequency": "Change the frequency setpoint of",
    "release-control": "Return control of the motor to panel and terminals of",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    command = parser.get_default("command")
    add_target_arguments(parser, *_FURTHER.get(command, ()))
    if command == "stop":
        parser.usage = f"{parser.usage}\n       {parser.prog} PLANT.toml [--line LINE] [options]"
        parser.add_argument(
            "--all", action="store_true", help="all drives of the plant; the default if no drive is named"
        )
        parser.add_argument("--line", metavar="LINE", help="all drives of this line of the plant")
    if command in _DIRECTED:
        directions = [direction.value for direction in Direction]
        parser.add_argument("--direction", choices=directions, help="default: the current direction")
    if command == "start":
        parser.add_argument("--frequency", metavar="HZ", type=number, help="write this setpoint first")
    if command in STOPS:
        parser.add_argument(
            "--seconds",
            metavar="S",
            type=_stop_time,
            help="repeat it up to this long until the motor has stopped; default: at least 30 s",
        )
    if command != "state":
        add_writing_arguments(parser, asks=command in _QUESTIONS)
    add_json_argument(parser)


def _stop_time(text: str) -> float | None:
    """Parse a number of seconds. For an invalid text, only warn and return None: the stop must be sent."""
    try:
        return duration(text)
    except argparse.ArgumentTypeError as mistake:
        warn(f"--seconds: {mistake}: ignored; the stop is repeated for at least {LEAST_S:g} s")
        return None


def run(arguments: argparse.Namespace) -> int:
    if _names_plant(arguments):
        return _stop_plant(arguments, _audit_file(arguments))
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
    until_ns = clock.now_ns() + round(SENDING_S * 1e9)
    with (
        written_before(lambda: until_ns),
        _annotating(arguments.command, target) as known,
        _opened(target, arguments) as bus,
    ):
        known.clear()
        if hz is not None and arguments.command != "set-frequency":
            state = _start_at(drive, hz, *parameters)
        else:
            state = verb(*parameters, **limit)
        known.append(f"{drive.name}: {arguments.command} is done")
        watchdog = bus.watchdog(drive) if arguments.command in _SHOWING_WATCHDOG else ""
        if not isinstance(state, State):
            try:
                state = drive.state()
            except Unsupported:
                state = None
    if arguments.json:
        print_json(_record(arguments.command, drive, state, setpoint, watchdog))
    elif arguments.command == "state":
        print_text(f"{state}\nwatchdog: {watchdog}")
    else:
        print_text(_sentence(arguments.command, drive, state, setpoint, watchdog))
    return MISTAKE if words and arguments.command in STOPS else DONE


def _start_at(drive: Drive, hz: float, direction: Direction | None) -> object:
    """Write the setpoint and start the motor in one call, so that the start expires if the process sleeps."""

    def script() -> Script[None]:
        yield from drive.set_frequency.script(hz)
        yield from drive.start.script(direction)

    return drive.carry_out_move(script(), drive.begin_call("start", drive.stops_called[0]))


def _target(arguments: argparse.Namespace) -> tuple[Target, list[str]]:
    """Return the named drive and the words after it. For a stop, warn of such words and ignore them."""
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
        warn(f"{command} takes one drive, which is {target.drive.name}: ignored {' '.join(words)}")
    return target, words


def _opened(target: Target, arguments: argparse.Namespace) -> Bus:
    """Open the drive's port and return the bus.

    If the port cannot be opened, raises OSError for a stop command, and LineError for others.
    """
    audit = _audit_file(arguments)
    try:
        return target.open_bus(audit)
    except LineError as failure:
        if arguments.command not in STOPS:
            raise
        raise OSError(f"the {arguments.command} was NOT sent: {failure}; {HARD_WIRED}") from failure


def _audit_file(arguments: argparse.Namespace) -> str | None:
    """Return the path of the audit log; None without one.

    If the log cannot be opened for a stop, warn and return None: the stop is sent anyway.
    """
    audit: str | None = getattr(arguments, "audit", None)
    if audit and arguments.command in STOPS:
        try:
            AuditLog(audit).close()
        except OSError as failure:
            warn(f"{audit}: {failure.strerror or failure}: the {arguments.command} is sent, not logged")
            return None
    return audit


@contextmanager
def _annotating(command: str, target: Target) -> Iterator[list[str]]:
    """Add notes to a KeyboardInterrupt: the requests sent so far, and the command that stops the motor."""
    try:
        with reporting_interruption(target.drive, command) as known:
            yield known
    except KeyboardInterrupt as interruption:
        if command != "state":
            interruption.add_note(f"to stop it, type: {command_line(('multidrop', 'stop', *target.words))}")
        raise


def _setpoint(drive: Drive, hz: float) -> Write | None:
    """Return the first write of set_frequency, with a value that the register can hold.

    Return None if the verb's first request is a read.
    """
    step = next(drive.set_frequency.script(hz))
    if not isinstance(step, Write):
        return None
    return Write(step.register, nearest_value(step.register, step.value))


def _rehearse(script: Script[Any]) -> None:
    """Check the first request of a command, without a port.

    Raises Unsupported or ValueError if the drive lacks the command, or if it may not be sent.
    """
    step = next(script)
    if isinstance(step, Write):
        step.register.encode(step.value)


def _details(arguments: argparse.Namespace) -> str:
    hz, direction = (getattr(arguments, name, None) for name in ("frequency", "direction"))
    at = "to" if arguments.command == "set-frequency" else "at"
    return ("" if hz is None else f" {at} {hz:g} Hz") + (f", {direction}" if direction else "")


def _parameters(arguments: argparse.Namespace) -> list[Any]:
    if arguments.command in _DIRECTED:
        return [Direction(arguments.direction) if arguments.direction else None]
    return [arguments.frequency] if arguments.command == "set-frequency" else []


# ---- results ----


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


# ---- the stop of a whole plant ----


def _names_plant(arguments: argparse.Namespace) -> bool:
    """Return True if the words name a whole plant or one of its lines, not a single drive."""
    if arguments.command != "stop" or not arguments.words or not is_plant(arguments.words[0]):
        return False
    return len(arguments.words) == 1 or arguments.all or arguments.line is not None


def _stop_plant(arguments: argparse.Namespace, audit: str | None) -> int:
    """Stop the lines in parallel; print the results of each line's drives when the line is done.

    Raises ValueError if the plant file has no drive that can be stopped, or if the named line does not exist.
    Then no stop is sent.
    """
    try:
        lines = _lines(plant_of(arguments.words[0], arguments), arguments)
    except (ValueError, TypeError) as mistake:
        raise ValueError(f"the stop was NOT sent: {mistake}") from mistake
    stops = [_LineStop(line, audit, arguments.seconds) for line in lines]
    finished: SimpleQueue[_LineStop] = SimpleQueue()
    try:
        _start_stops(stops, finished)
        for _ in stops:
            stop = finished.get()
            if not arguments.json:
                print_text("\n".join(stop.so_far()))
    except KeyboardInterrupt as interruption:
        for note in (note for stop in stops for note in stop.so_far()):
            interruption.add_note(note)
        raise
    if arguments.json:
        print_json([record for stop in stops for record in stop.records()])
    results = [result for stop in stops for result in stop.results]
    return DONE if all(result.ok for result in results) and not arguments.is_partial else FAILED


def _lines(plant: Plant, arguments: argparse.Namespace) -> Sequence[PlantLine]:
    """Return the lines to stop. Raises ValueError if a drive is given as well as --all or --line."""
    if arguments.words[1:]:
        option = "--all" if arguments.all else "--line"
        raise ValueError(
            f"{' '.join(arguments.words[1:])} and {option} contradict each other: give one of them"
        )
    if arguments.all and arguments.line is not None:
        raise ValueError("--all and --line contradict each other: give one of them")
    return plant.lines if arguments.line is None else [plant.find_line(arguments.line)]


def _start_stops(stops: Sequence[_LineStop], finished: SimpleQueue[_LineStop]) -> None:
    """Stop each line in its own thread, so that no line waits for another line's port or motors.

    If no more threads can be started, stop the remaining lines here, one after another.
    """
    without_thread = []
    for stop in stops:
        try:
            threading.Thread(target=stop.run, args=[finished], daemon=True).start()
        except RuntimeError:
            without_thread.append(stop)
    for stop in without_thread:
        stop.run(finished)


@dataclass(eq=False)
class _LineStop:
    """The stop of one line: opens its port and stops all its drives."""

    line: PlantLine
    audit: str | None
    seconds: float | None
    results: list[Stopped] = field(default_factory=list)
    bus: Bus | None = None

    def run(self, finished: SimpleQueue[_LineStop]) -> None:
        try:
            self._run()
        except Exception as failure:
            known = {result.drive for result in self.results}
            why = str(failure) or type(failure).__name__
            failed = [Stopped(name, Seen.FAILED, 0.0, why) for name in self._names if name not in known]
            self.results += failed
        finally:
            finished.put(self)

    def _run(self) -> None:
        line = self.line
        with Bus(
            line.port, echo=line.echo, transaction=line.transaction, rs485=line.rs485, audit=self.audit
        ) as self.bus:
            for polled in line.drives:
                self.bus.attach(polled.drive)
            self.results += self.bus.stop_all(self.seconds).values()

    def so_far(self) -> list[str]:
        """Return a sentence for each drive: its result, or the state of its stop."""
        known = {result.drive: stop_sentence(result) for result in self.results}
        if not known and self.bus:
            known = self.bus.stops_under_way()
        return [known.get(name, f"{name}: the stop was NOT sent") for name in self._names]

    def records(self) -> list[dict[str, Any]]:
        return [
            {"line": self.line.name, "drive": result.drive, "seen": result.seen.value}
            | {"seconds": round(result.seconds, 3), "why": result.why}
            for result in self.results
        ]

    @property
    def _names(self) -> list[str]:
        return [polled.drive.name for polled in self.line.drives]


def stop_sentence(result: Stopped) -> str:
    """Return a stop's result as a sentence, with advice if no stop could be sent."""
    if result.seen is Seen.FAILED:
        return f"{result.drive}: the stop was NOT sent: {result.why}; {HARD_WIRED}"
    return str(result)
