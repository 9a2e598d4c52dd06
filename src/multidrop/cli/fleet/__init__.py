"""`multidrop fleet`: its actions, and what they share: the options, URLs and connections of NATS servers.

An action has the name of the similar command for a plant without a fleet, if there is one.
"""

from __future__ import annotations

import argparse
import logging
import os
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from multidrop.cli.support.arguments import add_json_argument
from multidrop.cli.support.files import require_extra
from multidrop.cli.support.output import logging_to, warn
from multidrop.cli.support.signals import run_loop
from multidrop.control.eeprom_ledger import default_ledger_path
from multidrop.printable import masked

if TYPE_CHECKING:
    from multidrop.fleet.servers.connections import ServerPath

ACTIONS = {  # each action's module in this package, and its help text
    "demo": ("demo", "kill a gateway of a simulated fleet and show the takeover"),
    "rights": ("setup", "write the servers' configuration, and a key for each user"),
    "init": ("setup", "set the NATS servers up, and store the plant"),
    "serve": ("services", "run the gateway with this name"),
    "drain": ("services", "move all lines of a gateway to the others"),
    "status": ("views", "show all gateways; exit status 1 if a line is not polled"),
    "lines": ("views", "list the lines with their masters"),
    "watch": ("views", "show the fleet live on a terminal"),
    "stop": ("commands", "stop drives, or all of them, without confirmation"),
    "coast": ("commands", "let a motor coast to a stop, without confirmation"),
    "emergency-stop": ("commands", "use a drive's emergency stop, without confirmation"),
    "write": ("commands", "write one register of a drive"),
    "set-frequency": ("commands", "write a drive's frequency setpoint"),
    "start": ("commands", "start a drive's motor"),
    "jog": ("commands", "turn a drive's motor slowly until it is stopped"),
    "reset-fault": ("commands", "reset a drive's fault; never starts the motor"),
}

URLS = "nats://127.0.0.1:4222"
CREDENTIALS, CA = "MULTIDROP_NATS_CREDENTIALS", "MULTIDROP_NATS_CA"
# the result of state_folder() if XDG_STATE_HOME is not set; for help texts
STATE = "~/.local/state/multidrop/fleet"


def add_nats_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--credentials",
        metavar="FILE",
        type=Path,
        help=f"key of `fleet rights`, or .creds; else {CREDENTIALS}",
    )
    parser.add_argument(
        "--ca", metavar="FILE", type=Path, help=f"issuer of the servers' certificates; else {CA}"
    )


def nats_urls(given: str | None) -> list[str]:
    """Return the servers' URLs from a list separated by commas, or from the variable MULTIDROP_NATS.

    Raises ValueError for an empty list, and for a URL that does not start with nats:// or tls://.
    """
    text = given or os.environ.get("MULTIDROP_NATS") or URLS
    found = [url.strip() for url in text.split(",") if url.strip()]
    for url in found:
        if not url.startswith(("nats://", "tls://")):
            raise ValueError(f"{masked(url)} is not an address of a NATS server; write {URLS}")
    if not found:
        raise ValueError(f"{masked(text)!r} contains no address of a NATS server; write {URLS}")
    return found


def nats_options(arguments: argparse.Namespace, urls: Sequence[str]) -> dict[str, Any]:
    """Return nats-py's options for a connection. Raises ValueError if the credentials file has no key."""
    from multidrop.fleet.servers.connections import connect_options

    logging.getLogger("asyncio").addFilter(_is_news)
    credentials = arguments.credentials or _named(CREDENTIALS)
    if credentials:
        require_extra("nkeys", "fleet", "fleet --credentials")
    return connect_options(urls, credentials, arguments.ca or _named(CA))


def _is_news(record: logging.LogRecord) -> bool:
    """Return False for the record that Python 3.11's asyncio logs when a server closes a TLS connection."""
    return "eof_received" not in record.getMessage()


def _named(variable: str) -> Path | None:
    text = os.environ.get(variable)
    return Path(text) if text else None


def add_server_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of every action that connects to the servers and prints a result."""
    add_address_arguments(parser)
    add_json_argument(parser)


def add_address_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--nats", metavar="URLS", help=f"servers, with commas; else MULTIDROP_NATS, or {URLS}"
    )
    add_nats_arguments(parser)


def state_folder() -> Path:
    """Return the folder for the state of this user's gateways and the log of commands.

    The EEPROM ledger is beside this folder. A user without a home folder cannot keep a ledger, but stops do
    not need a ledger.
    """
    return default_ledger_path().parent / "fleet"


def require_fleet(command: str = "fleet") -> None:
    for library in ("nats", "pyarrow"):
        require_extra(library, "fleet", command)


def run_action(work: Callable[[], Coroutine[Any, Any, int]]) -> int:
    """Run an action in its own event loop, and print the fleet's errors."""
    require_fleet()
    with logging_to(warn, "multidrop.fleet", logging.ERROR):
        return run_loop(work())


async def open_path(paths: Sequence[ServerPath]) -> ServerPath:
    """Open all connections; return one that succeeded. Raises FleetError if no server answers."""
    from multidrop.fleet.servers.setup import open_all

    await open_all(paths)
    return next(path for path in paths if path.is_open)


def run_with_paths(arguments: argparse.Namespace, work: Callable[[list[ServerPath]], Awaitable[int]]) -> int:
    """Run an action with three connections to the servers; close the connections afterwards."""

    async def with_paths() -> int:
        from multidrop.fleet.servers.connections import paths_of

        urls = nats_urls(arguments.nats)
        paths = paths_of(urls, nats_options(arguments, urls))
        try:
            return await work(paths)
        finally:
            for path in paths:
                await path.close()

    return run_action(with_paths)
