"""`multidrop fleet serve` and `drain`: run a gateway of a fleet, or move its lines to other gateways."""

from __future__ import annotations

import argparse
import asyncio
import logging
import time
from contextlib import AsyncExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from multidrop.cli.fleet import (
    STATE,
    add_address_arguments,
    add_server_arguments,
    nats_options,
    nats_urls,
    open_path,
    require_fleet,
    run_with_paths,
    state_folder,
)
from multidrop.cli.support.log_thread import LogThread, add_log_argument, logging_to_stderr
from multidrop.cli.support.output import print_json, print_text
from multidrop.cli.support.signals import on_end_signals, run_loop
from multidrop.cli.support.values import counted
from multidrop.supervisor import supervisor

if TYPE_CHECKING:
    from multidrop.fleet.servers.connections import ServerPath

DRAIN_S = 30.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    {"serve": _add_serve, "drain": _add_drain}[parser.get_default("command")](parser)


def run(arguments: argparse.Namespace) -> int:
    return {"serve": _run_serve, "drain": _run_drain}[arguments.command](arguments)


def _add_serve(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("gateway", metavar="NAME", help="its name, such as gw-1, unique in the fleet")
    parser.add_argument(
        "--folder",
        metavar="DIR",
        type=Path,
        help=f"for its spool, logs and lock; NAME in {STATE} if not given",
    )
    parser.add_argument(
        "--keep", metavar="SIZE", default="10 GB", help="size limit of the spool; 10 GB if not given"
    )
    parser.add_argument("--metrics", metavar="HOST:PORT", help="answer GET /metrics there")
    add_log_argument(parser)
    add_address_arguments(parser)


def _run_serve(arguments: argparse.Namespace) -> int:
    require_fleet()
    with logging_to_stderr(arguments.log, {"multidrop": logging.INFO, "asyncio": logging.WARNING}) as log:
        return run_loop(_serve(arguments, log))


async def _serve(arguments: argparse.Namespace, log: LogThread) -> int:
    from importlib.metadata import version

    from multidrop.fleet.gateway import FleetGateway
    from multidrop.fleet.metrics import families_of, listen, serving
    from multidrop.recording.segments import parse_size

    name = arguments.gateway
    listener = listen(arguments.metrics) if arguments.metrics else None
    folder = arguments.folder or state_folder() / name
    urls = nats_urls(arguments.nats)
    options = nats_options(arguments, urls)
    gateway = FleetGateway(name, urls, folder, options=options, spool_bytes=parse_size(arguments.keep))
    on_end_signals(gateway.end)
    supervisor().watch("log", log.is_alive)
    async with AsyncExitStack() as stack:
        if listener:
            release = version("multidrop")
            await stack.enter_async_context(serving(listener, lambda: families_of(gateway.state(), release)))
            host, port, *_ = listener.getsockname()
            print_text(f"metrics http://{host}:{port}/metrics", flush=True)
        await gateway.run(lambda: print_text(f"ready {name}", flush=True))
    return 0


def _add_drain(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("gateway", metavar="NAME", help="the gateway's name, such as gw-1")
    add_server_arguments(parser)


def _run_drain(arguments: argparse.Namespace) -> int:
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
    answer = await ask_gateway(path, name, "drain")
    ends = time.monotonic() + DRAIN_S
    while answer["lines"] and time.monotonic() < ends:
        await asyncio.sleep(0.1)
        answer = await ask_gateway(path, name, "state")
    if arguments.json:
        print_json(answer)
    else:
        print_text(
            f"{name} has {counted(answer['lines'], 'line')} left; it takes none until it is started again"
        )
    return 1 if answer["lines"] else 0
