"""`multidrop hub`: store the samples of a fleet in Parquet files or in PostgreSQL."""

from __future__ import annotations

import argparse
import asyncio
import json
import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

from multidrop.cli.fleet import (
    URLS,
    add_nats_arguments,
    nats_options,
    nats_urls,
    require_fleet,
)
from multidrop.cli.support.arguments import add_json_argument, duration
from multidrop.cli.support.files import require_extra
from multidrop.cli.support.log_thread import add_log_argument, logging_to_stderr
from multidrop.cli.support.output import print_text
from multidrop.cli.support.signals import end_signals_cancel
from multidrop.cli.support.values import counted
from multidrop.supervisor import end_tasks, supervisor

if TYPE_CHECKING:
    from multidrop.fleet.samples.hub import HubState, SampleSink

EVERY_S = 10.0  # default of `--every`
LEVELS = dict.fromkeys(("multidrop.fleet", "multidrop.supervisor"), logging.INFO)


def add_arguments(parser: argparse.ArgumentParser) -> None:
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
        default=EVERY_S,
        help="seconds of samples in a commit; 10 if not given",
    )
    parser.add_argument("--once", action="store_true", help="end once all present samples are stored")
    add_log_argument(parser)
    add_nats_arguments(parser)
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    require_fleet("hub")
    if arguments.postgres:
        require_extra("psycopg", "postgres", "hub")
    arguments.servers = nats_urls(",".join(arguments.servers))
    options = {"name": "multidrop hub", **nats_options(arguments, arguments.servers)}
    sink = _sink(arguments)
    try:
        with logging_to_stderr(arguments.log, LEVELS):
            state = asyncio.run(_read(arguments, sink, options))
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
    with end_signals_cancel():
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
