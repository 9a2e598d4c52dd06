"""Commands to drives through a fleet: `multidrop fleet write`, `start`, `stop` and the other verbs."""

from __future__ import annotations

import argparse
import asyncio
import getpass
import os
import socket
import sys
from collections.abc import AsyncIterator, Iterator
from contextlib import AsyncExitStack, asynccontextmanager, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from multidrop.cli import STOPS
from multidrop.cli.fleet import (
    STATE,
    add_server_arguments,
    nats_options,
    nats_urls,
    run_action,
    state_folder,
)
from multidrop.cli.support.output import confirm, print_json, print_text, warn
from multidrop.printable import plain_number, printable

if TYPE_CHECKING:
    from multidrop.fleet.commands.fleet_commands import FleetCommands
    from multidrop.fleet.commands.messages import CommandAnswer

_DIRECTIONS = ("forward", "reverse")
_DIRECTED = ("start", "jog")
# words that follow the drive's name, by command
_FURTHER = {"write": ("REGISTER", "VALUE"), "set-frequency": ("HZ",)}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    action = parser.get_default("command")
    if action == "stop":
        parser.add_argument("drives", metavar="DRIVE", nargs="*", help="by its name in the plant")
        parser.add_argument("--all", action="store_true", help="all drives of the plant, or of --line")
        parser.add_argument("--line", help="the drives' line; then the plant is not looked up")
    else:
        parser.add_argument("drive", metavar="DRIVE", help="by its name in the plant")
    for word in _FURTHER.get(action, ()):
        parser.add_argument(word.lower(), metavar=word)
    if action in _DIRECTED:
        parser.add_argument("--direction", choices=_DIRECTIONS, help="the present one if not given")
    if action not in STOPS:
        parser.add_argument("--yes", action="store_true", help="do not ask; needed without a terminal")
    parser.add_argument("--by", metavar="NAME", help="name for the logs; else USER@HOST")
    parser.add_argument(
        "--audit",
        metavar="FILE",
        type=Path,
        help=f"log of this machine's commands; else commands.jsonl in {STATE}",
    )
    add_server_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    work = _stop if arguments.command == "stop" else _command
    return run_action(partial(work, arguments))


def _asker(arguments: argparse.Namespace) -> FleetCommands:
    from multidrop.fleet.commands.fleet_commands import FleetCommands
    from multidrop.fleet.commands.messages import MOST_CHARACTERS

    by = arguments.by or f"{_user()}@{socket.gethostname()}"
    if arguments.command in STOPS:
        by = printable(by)[:MOST_CHARACTERS]  # a name that is too long must not prevent a stop
    elif not by.isprintable() or len(by) > MOST_CHARACTERS:
        raise ValueError(
            f"--by {by!r} is not a valid name: write 1 to {MOST_CHARACTERS} printable characters"
        )
    log, urls = arguments.audit or state_folder() / "commands.jsonl", nats_urls(arguments.nats)
    return FleetCommands(urls, by=by, log=log, options=nats_options(arguments, urls))


@asynccontextmanager
async def _asking(arguments: argparse.Namespace) -> AsyncIterator[FleetCommands]:
    """Yield a connected client for commands.

    If a stop cannot connect, the error says that the stop was not sent.
    """
    from multidrop.fleet.commands.fleet_commands import HARD_WIRED
    from multidrop.fleet.errors import FleetError

    async with AsyncExitStack() as stack:
        try:
            asker = await stack.enter_async_context(_asker(arguments))
        except (FleetError, ValueError) as failure:
            if arguments.command not in STOPS:
                raise
            kind = FleetError if isinstance(failure, FleetError) else ValueError
            raise kind(f"the {arguments.command} was NOT sent: {failure}; {HARD_WIRED}") from None
        yield asker


def _user() -> str:
    with suppress(OSError, KeyError):  # in a container, the user id may have no name
        return getpass.getuser()
    return str(os.getuid())


def _what(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the arguments for FleetCommands.request. Raises ValueError if HZ is not a number."""
    action = arguments.command
    if action == "write":
        return {"register": arguments.register, "value": arguments.value}
    options: dict[str, Any] = {}
    if action == "set-frequency":
        try:
            options["hz"] = plain_number(arguments.hz)
        except ValueError:
            raise ValueError(f"HZ = {arguments.hz} is not a number; write a number such as 25") from None
    elif getattr(arguments, "direction", None):
        options["direction"] = arguments.direction
    return {"verb": action.replace("-", "_"), "options": options}


async def _command(arguments: argparse.Namespace) -> int:
    """Show the command as the gateway would carry it out, let the user confirm it, and then send it.

    The gateway's preview is valid for only a second. So the confirmed command is sent as a new request.
    """
    from multidrop.fleet.commands.messages import CommandAnswer

    what, agreed = _what(arguments), ""
    if arguments.command not in STOPS and not arguments.yes:
        async with _asking(arguments) as asker:
            preview = await asker.preview(asker.request(arguments.drive, **what))
        if isinstance(preview, CommandAnswer):
            return _show(arguments, preview)
        agreed = preview.text
        confirm(f"{agreed}; carry it out through gateway {preview.gateway}?", arguments)
    async with _asking(arguments) as asker:
        request = asker.request(arguments.drive, **what)
        with _annotating(request.words):
            return _show(arguments, await asker.carry_out(request, agreed))


async def _stop(arguments: argparse.Namespace) -> int:
    drives = arguments.drives
    if bool(drives) == arguments.all:
        ways = "stop takes either drives or --all: `multidrop fleet stop pump-1`"
        raise ValueError(f"the stop was NOT sent: {ways}")
    async with _asking(arguments) as asker:
        with _annotating(f"the stop of {', '.join(drives) or 'all drives'}"):
            answer = await asker.stop(drives or None, line=arguments.line or "", on_news=_show_news)
            return _show(arguments, answer)


@contextmanager
def _annotating(what: str) -> Iterator[None]:
    """On Ctrl-C during the wait for an answer, print that the outcome is unknown."""
    try:
        yield
    except asyncio.CancelledError:
        warn(f"{what}: it is not known whether it was sent; check the drive, and the gateway's log")
        raise


def _show(arguments: argparse.Namespace, answer: CommandAnswer) -> int:
    if arguments.json:
        print_json(answer.as_json())
    else:
        print_text(_sentence(answer), file=sys.stdout if answer.ok else sys.stderr)
    return 0 if answer.ok else 1


def _show_news(answer: CommandAnswer) -> None:
    with suppress(OSError):  # the stop continues after stderr is closed
        print_text(_sentence(answer), file=sys.stderr)


def _sentence(answer: CommandAnswer) -> str:
    gateway = f" ({answer.gateway})" if answer.gateway else ""
    return f"{answer.outcome.value}: {answer.text}{gateway}"
