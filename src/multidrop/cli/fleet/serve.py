"""`multidrop fleet serve`: runs one gateway of a fleet."""

from __future__ import annotations

import argparse
import logging
from contextlib import AsyncExitStack
from pathlib import Path

from multidrop.cli.fleet.connection import (
    STATE,
    add_address_arguments,
    nats_options,
    require_fleet,
    state_folder,
    urls_of,
)
from multidrop.cli.support.log_thread import LogThread, add_log_argument, logging_to_stderr
from multidrop.cli.support.output import print_text
from multidrop.cli.support.signals import on_end_signals, run_loop
from multidrop.supervisor import supervisor


def add_arguments(parser: argparse.ArgumentParser) -> None:
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


def run(arguments: argparse.Namespace) -> int:
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
    urls = urls_of(arguments)
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
