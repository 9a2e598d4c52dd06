"""Commands to drives through a fleet: `multidrop fleet write`, `start`, `stop` and the other verbs."""

from __future__ import annotations

import argparse
import asyncio
import getpass
import json
import os
import socket
import sys
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from multidrop.cli.support.confirm import confirm
from multidrop.cli.support.nats import nats_options
from multidrop.cli.support.output import print_text, warn

if TYPE_CHECKING:
    from multidrop.fleet.command_words import CommandAnswer
    from multidrop.fleet.fleet_commands import FleetCommands

_DIRECTIONS = ("forward", "reverse")


def add_command_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what the actions of this file take beside a drive."""
    parser.add_argument(
        "words",
        metavar="MORE",
        nargs="*",
        help="REGISTER VALUE for write, HZ for set-frequency, DRIVEs for stop",
    )
    parser.add_argument("--direction", choices=_DIRECTIONS, help="of start and jog: as in force if not given")
    parser.add_argument("--all", action="store_true", help="of stop: all drives of the plant, or of --line")
    parser.add_argument("--line", help="of stop: the drives' line; then the plant is not looked up")
    parser.add_argument("--yes", action="store_true", help="do not ask; needed where no terminal is")
    parser.add_argument("--by", metavar="NAME", help="whom the logs name; else USER@HOST")
    parser.add_argument(
        "--audit", metavar="FILE", type=Path, help="where this machine notes what was asked for"
    )


def check_words(arguments: argparse.Namespace) -> None:
    """Raise ValueError where an action that commands nothing was given more than a name."""
    if arguments.words and arguments.action not in ACTIONS:
        raise ValueError(f"{arguments.action} takes one name, and was given {' '.join(arguments.words)} too")


def _asker(arguments: argparse.Namespace, urls: Sequence[str], folder: Path) -> FleetCommands:
    from multidrop.fleet.fleet_commands import FleetCommands

    by = arguments.by or f"{_user()}@{socket.gethostname()}"
    if not by.isprintable() or len(by) > 200:
        raise ValueError(f"--by {by!r} is not 1 to 200 printable characters")
    log = arguments.audit or folder / "commands.jsonl"
    return FleetCommands(urls, by=by, log=log, options=nats_options(arguments, urls))


def _user() -> str:
    with suppress(OSError, KeyError):  # an id without a name, as in a container
        return getpass.getuser()
    return str(os.getuid())


def _wanted(arguments: argparse.Namespace, *words: str) -> tuple[str, list[str]]:
    """Return the drive and the further words. Raises ValueError where they are not these."""
    given = [arguments.what, *arguments.words] if arguments.what else []
    if len(given) != 1 + len(words):
        usage = " ".join(("DRIVE", *words))
        raise ValueError(f"{arguments.action} takes {usage}: `multidrop fleet {arguments.action} {usage}`")
    return given[0], given[1:]


async def _write(arguments: argparse.Namespace, urls: Sequence[str], folder: Path) -> int:
    drive, (register, value) = _wanted(arguments, "REGISTER", "VALUE")
    return await _command(arguments, urls, folder, drive, register=register, value=value)


async def _verb(arguments: argparse.Namespace, urls: Sequence[str], folder: Path) -> int:
    drive, _ = _wanted(arguments)
    directed = arguments.direction and arguments.action in ("start", "jog")
    options = {"direction": arguments.direction} if directed else {}
    verb = arguments.action.replace("-", "_")
    return await _command(arguments, urls, folder, drive, verb=verb, options=options)


async def _set_frequency(arguments: argparse.Namespace, urls: Sequence[str], folder: Path) -> int:
    drive, (hz,) = _wanted(arguments, "HZ")
    try:
        options = {"hz": float(hz)}
    except ValueError:
        raise ValueError(f"HZ = {hz} is no number; write 25") from None
    return await _command(arguments, urls, folder, drive, verb="set_frequency", options=options)


async def _command(
    arguments: argparse.Namespace, urls: Sequence[str], folder: Path, drive: str, **what: Any
) -> int:
    """Ask what would be done, let a person agree, and have it done by a new offer: the first is too old."""
    from multidrop.fleet.command_words import CommandAnswer

    agreed = ""
    if not arguments.yes and arguments.action not in _STOPPING:
        async with _asker(arguments, urls, folder) as asker:
            preview = await asker.preview(asker.request(drive, **what))
        if isinstance(preview, CommandAnswer):
            return _show(arguments, preview)
        agreed = preview.text
        confirm(f"{agreed}; gateway {preview.gateway} is to do it?", arguments)
    async with _asker(arguments, urls, folder) as asker:
        request = asker.request(drive, **what)
        with _annotating(request.words):
            return _show(arguments, await asker.carry_out(request, agreed))


async def _stop(arguments: argparse.Namespace, urls: Sequence[str], folder: Path) -> int:
    drives = [arguments.what, *arguments.words] if arguments.what else []
    if bool(drives) == arguments.all:
        raise ValueError("stop takes either drives or --all: `multidrop fleet stop pump-1`")
    async with _asker(arguments, urls, folder) as asker:
        with _annotating(f"the stop of {', '.join(drives) or 'all drives'}"):
            return _show(arguments, await asker.stop(drives or None, line=arguments.line or ""))


@contextmanager
def _annotating(what: str) -> Iterator[None]:
    """Say what an interruption leaves open: Ctrl-C cancels what waits for the answer."""
    try:
        yield
    except asyncio.CancelledError:
        warn(f"{what}: it is not known whether it was sent; look at the drive, and at the gateway's log")
        raise


def _show(arguments: argparse.Namespace, answer: CommandAnswer) -> int:
    if arguments.json:
        print_text(json.dumps(answer.as_json(), indent=2))
    else:
        gateway = f" ({answer.gateway})" if answer.gateway else ""
        text = f"{answer.outcome.value}: {answer.text}{gateway}"
        print_text(text, file=sys.stdout if answer.is_done else sys.stderr)
    return 0 if answer.is_done else 1


Action = Callable[[argparse.Namespace, Sequence[str], Path], Awaitable[int]]

_STOPPING = ("coast", "emergency-stop")  # these ask nobody, as `stop`
ACTIONS: dict[str, Action] = {
    "stop": _stop,
    "write": _write,
    "start": _verb,
    "jog": _verb,
    "reset-fault": _verb,
    "set-frequency": _set_frequency,
    "coast": _verb,
    "emergency-stop": _verb,
}
