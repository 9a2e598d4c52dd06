"""`multidrop fleet drain`: moves all lines of a gateway to the others."""

from __future__ import annotations

import argparse
import asyncio
import json
import time
from functools import partial
from typing import TYPE_CHECKING

from multidrop.cli.fleet.connection import add_server_arguments, open_path, require_fleet, run_with_paths
from multidrop.cli.support.output import print_text
from multidrop.cli.support.values import counted

if TYPE_CHECKING:
    from multidrop.fleet.servers.connections import ServerPath

DRAIN_S = 30.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("gateway", metavar="NAME", help="the gateway's name, such as gw-1")
    add_server_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    require_fleet()
    from multidrop.fleet.servers.names import checked_name

    checked_name("gateway", arguments.gateway)
    return run_with_paths(arguments, partial(_drain, arguments))


async def _drain(arguments: argparse.Namespace, paths: list[ServerPath]) -> int:
    from multidrop.fleet.gateway import ask_gateway
    from multidrop.fleet.servers.setup import check_buckets

    name = arguments.gateway
    path = await open_path(paths)
    await check_buckets(path)
    said = await ask_gateway(path, name, "drain")
    ends = time.monotonic() + DRAIN_S
    while said["lines"] and time.monotonic() < ends:
        await asyncio.sleep(0.1)
        said = await ask_gateway(path, name, "state")
    if arguments.json:
        print_text(json.dumps(said, indent=2))
    else:
        print_text(
            f"{name} has {counted(said['lines'], 'line')} left; it takes none until it is started again"
        )
    return 1 if said["lines"] else 0
