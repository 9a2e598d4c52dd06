"""The servers of a fleet: their addresses, and the paths to them that an action has."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Awaitable, Callable, Coroutine
from pathlib import Path
from typing import TYPE_CHECKING, Any

from multidrop.cli.fleet.nats import URLS, add_nats_arguments, nats_options, nats_urls
from multidrop.cli.support.arguments import add_json_argument
from multidrop.cli.support.files import require_extra
from multidrop.cli.support.output import logging_to, warn
from multidrop.cli.support.signals import run_loop
from multidrop.control.eeprom_ledger import default_path

if TYPE_CHECKING:
    from multidrop.fleet.servers.connections import ServerPath

STATE = "~/.local/state/multidrop/fleet"  # state_folder(), where XDG_STATE_HOME is not set


def add_server_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what every action takes that speaks with the servers, and says something of what it did."""
    add_address_arguments(parser)
    add_json_argument(parser)


def add_address_arguments(parser: argparse.ArgumentParser) -> None:
    """Add where the servers are, and who asks."""
    parser.add_argument(
        "--nats", metavar="URLS", help=f"servers, with commas; else MULTIDROP_NATS, or {URLS}"
    )
    add_nats_arguments(parser)


def urls_of(arguments: argparse.Namespace) -> list[str]:
    """Return the servers' URLs. Raises ValueError for none, and for one that is not nats:// or tls://."""
    return nats_urls(arguments.nats)


def state_folder() -> Path:
    """Return the folder of this user's gateways, and of the log of commands that this user asked for.

    It is beside the ledger: a user without a home has one that cannot be kept, and a stop needs none.
    """
    return default_path().parent / "fleet"


def require_fleet() -> None:
    """Raise ValueError where a library is missing that every action needs."""
    for library in ("nats", "pyarrow"):
        require_extra(library, "fleet", "fleet")


def run_action(work: Callable[[], Coroutine[Any, Any, int]]) -> int:
    """Run an action in an event loop of its own, and print the errors that the fleet logs."""
    require_fleet()
    with logging_to(warn, "multidrop.fleet", logging.ERROR):
        return run_loop(work())


def run_with_paths(arguments: argparse.Namespace, work: Callable[[list[ServerPath]], Awaitable[int]]) -> int:
    """Run an action with three paths to the servers, which are closed afterwards."""

    async def with_paths() -> int:
        from multidrop.fleet.servers.connections import paths_of

        urls = urls_of(arguments)
        paths = paths_of(urls, nats_options(arguments, urls))
        try:
            return await work(paths)
        finally:
            for path in paths:
                await path.close()

    return run_action(with_paths)
