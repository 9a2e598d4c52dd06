"""`multidrop start`, `stop` and the other verbs: each is a method of the drive of the same name."""

from __future__ import annotations

import argparse
import json
from typing import Any

from multidrop.bus import Bus
from multidrop.cli.target import add_json_argument, add_target_arguments, drive_of
from multidrop.drive import Direction, Script, State, Write
from multidrop.errors import Unsupported

_DIRECTED = ("start", "jog")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_target_arguments(parser)
    command = parser.get_default("command")
    if command in _DIRECTED:
        parser.add_argument(
            "--direction", choices=[it.value for it in Direction], help="the one in force if not given"
        )
    if command == "set-frequency":
        parser.add_argument("hz", metavar="HZ", type=float, help="the setpoint in Hz")
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    drive = drive_of(arguments)
    verb = getattr(drive, arguments.command.replace("-", "_"))
    given = _given(arguments)
    _rehearse(verb.script(*given))
    with Bus(arguments.port) as bus:
        bus.attach(drive)
        state = verb(*given)
        if not isinstance(state, State):
            try:
                state = drive.state()
            except Unsupported:
                state = None
    if arguments.json:
        print(json.dumps({"drive": drive.name, "done": arguments.command, "state": _json(state)}, indent=2))
    elif arguments.command == "state":
        print(state)
    else:
        print(f"{drive.name}: {arguments.command} done; state: {state or 'the family cannot say'}")
    return 0


def _rehearse(script: Script[Any]) -> None:
    """Work out the first step, so that what the family lacks or forbids is refused with no port opened."""
    step = next(script)
    if isinstance(step, Write):
        step.register.encode(step.value)


def _given(arguments: argparse.Namespace) -> list[Any]:
    """What the verb takes."""
    if arguments.command in _DIRECTED:
        return [Direction(arguments.direction) if arguments.direction else None]
    return [arguments.hz] if arguments.command == "set-frequency" else []


def _json(state: State | None) -> dict[str, Any] | None:
    if state is None:
        return None
    return {
        "condition": state.condition.value,
        "direction": state.direction.value if state.direction else None,
        "fault": state.fault,
        "note": state.note,
    }
