"""`multidrop fleet serve` and `drain`, and `multidrop hub`: run a gateway of a fleet, or store samples."""

from __future__ import annotations

import argparse
import asyncio
import json
import logging
import time
from contextlib import AsyncExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from multidrop.cli.fleet import (
    STATE,
    URLS,
    add_address_arguments,
    add_nats_arguments,
    add_server_arguments,
    nats_options,
    nats_urls,
    open_path,
    require_fleet,
    run_with_paths,
    state_folder,
)
from multidrop.cli.support.arguments import add_json_argument, duration
from multidrop.cli.support.files import require_extra
from multidrop.cli.support.log_thread import add_log_argument, logging_to_stderr
from multidrop.cli.support.output import print_json, print_text
from multidrop.cli.support.signals import cancel_at_end_signals, on_end_signals, run_loop
from multidrop.cli.support.values import counted
from multidrop.supervisor import end_tasks, supervisor

if TYPE_CHECKING:
    from multidrop.fleet.samples.hub import HubState, SampleSink
    from multidrop.fleet.servers.connections import ServerPath

DRAIN_S = 30.0
GATEWAY_LEVELS = {"multidrop": logging.INFO, "asyncio": logging.WARNING}
HUB_LEVELS = dict.fromkeys(("multidrop.fleet", "multidrop.supervisor"), logging.INFO)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    {"serve": _add_serve, "drain": _add_drain, "hub": _add_hub}[parser.get_default("command")](parser)


def run(arguments: argparse.Namespace) -> int:
    return {"serve": _run_serve, "drain": _run_drain, "hub": _run_hub}[arguments.command](arguments)


# ---- serve ----


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
    with logging_to_stderr(arguments.log, GATEWAY_LEVELS):
        return run_loop(_serve(arguments))


async def _serve(arguments: argparse.Namespace) -> int:
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
    async with AsyncExitStack() as stack:
        if listener:
            release = version("multidrop")
            await stack.enter_async_context(serving(listener, lambda: families_of(gateway.state(), release)))
            host, port, *_ = listener.getsockname()
            print_text(f"metrics http://{host}:{port}/metrics", flush=True)
        await gateway.run(lambda: print_text(f"ready {name}", flush=True))
    return 0


# ---- drain ----


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


# ---- hub ----


def _add_hub(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "servers", metavar="URL", nargs="*", help=f"servers of NATS; else MULTIDROP_NATS, or {URLS}"
    )
    sinks = parser.add_mutually_exclusive_group(required=True)
    sinks.add_argument(
        "--parquet", metavar="FOLDER", type=Path, help="store samples as Parquet files in this folder"
    )
    sinks.add_argument(
        "--postgres", metavar="WHERE", help="store samples in PostgreSQL: 'host=db dbname=plant'"
    )
    parser.add_argument(
        "--every",
        metavar="S",
        type=duration,
        default=10.0,
        help="seconds of samples in a commit; 10 if not given",
    )
    parser.add_argument("--once", action="store_true", help="end once all present samples are stored")
    add_log_argument(parser)
    add_nats_arguments(parser)
    add_json_argument(parser)


def _run_hub(arguments: argparse.Namespace) -> int:
    require_fleet("hub")
    if arguments.postgres:
        require_extra("psycopg", "postgres", "hub")
    arguments.servers = nats_urls(",".join(arguments.servers))
    options = {"name": "multidrop hub", **nats_options(arguments, arguments.servers)}
    sink = _sink(arguments)
    try:
        with logging_to_stderr(arguments.log, HUB_LEVELS):
            state = run_loop(_read(arguments, sink, options))
    finally:
        sink.close()
    if arguments.json:
        print_text(json.dumps(state._asdict()))
    else:
        print_text(
            f"{counted(state.rows, 'row')} kept, to message {state.place} of the stream; "
            f"{counted(state.alarms, 'alarm')}, {counted(state.missing, 'message')} missing, "
            f"{state.doubled} left out because they came twice"
        )
    return int(state.alarms > 0)


def _sink(arguments: argparse.Namespace) -> SampleSink:
    if arguments.postgres:
        from multidrop.fleet.samples.postgres_sink import PostgresSink

        return PostgresSink(arguments.postgres)
    from multidrop.fleet.samples.hub import ParquetSink

    return ParquetSink(arguments.parquet)


async def _read(arguments: argparse.Namespace, sink: SampleSink, options: dict[str, Any]) -> HubState:
    """Store samples until a signal comes, or with --once until all present samples are stored."""
    cancel_at_end_signals()
    from multidrop.fleet.samples.hub import SampleHub, compact_for_ever
    from multidrop.fleet.samples.samples_stream import samples_path

    async with samples_path(arguments.servers, options) as path:
        hub = SampleHub(path, sink, every=arguments.every)
        if arguments.parquet:  # only Parquet files need compaction, PostgreSQL does not
            supervisor().keep("compaction", compact_for_ever(arguments.parquet))
        reading = asyncio.ensure_future(hub.run(once=arguments.once))
        failing = asyncio.ensure_future(supervisor().has_dead.wait())
        try:
            await asyncio.wait([reading, failing], return_when=asyncio.FIRST_COMPLETED)
            supervisor().check()
            reading.result()
        finally:
            await supervisor().release("compaction")
            await end_tasks(reading, failing)
        return hub.state()
