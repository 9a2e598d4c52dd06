"""`multidrop fleet init`: prepares the NATS servers for a fleet, and stores the plant there."""

from __future__ import annotations

import argparse
import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from multidrop.cli.fleet.connection import (
    add_server_arguments,
    require_fleet,
    run_with_paths,
)
from multidrop.cli.fleet.tables import size
from multidrop.cli.support.output import print_text, warn

if TYPE_CHECKING:
    from multidrop.fleet.servers.buckets import Record
    from multidrop.fleet.servers.connections import ServerPath


KEEP = "10 GB"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "plant",
        metavar="PLANT.toml",
        nargs="?",
        type=Path,
        help="the plant to store; without it the stored one stays",
    )
    parser.add_argument(
        "--keep",
        metavar="SIZE",
        help=f"limit of the samples on each server, if their stream is new; {KEEP} if not given",
    )
    add_server_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    require_fleet()
    from multidrop.fleet.servers.plant_store import read_plant
    from multidrop.recording.segments import parse_size

    keep = parse_size(arguments.keep or KEEP)
    records = read_plant(arguments.plant)[1] if arguments.plant else None
    return run_with_paths(arguments, partial(_init, arguments, records, keep))


async def _init(
    arguments: argparse.Namespace, records: dict[str, Record] | None, keep: int, paths: list[ServerPath]
) -> int:
    from multidrop.fleet.samples.samples_stream import create_stream
    from multidrop.fleet.servers import names
    from multidrop.fleet.servers.buckets import Bucket
    from multidrop.fleet.servers.plant_store import store
    from multidrop.fleet.servers.setup import set_up

    made = await set_up(paths)
    kept = await create_stream(paths[0], replicas=made["replicas"], most_bytes=keep)
    made["samples_bytes"] = None if kept < 0 else kept
    if records is not None:
        made["lines"] = await store(Bucket(names.PLANT, lambda: paths[0]), records)
    if kept < 0 or (arguments.keep and kept != keep):
        word = (
            "has no limit: when it fills the servers, no line is polled"
            if kept < 0
            else f"still keeps {size(kept)}"
        )
        warn(f"the stream of samples {word}; `nats stream edit samples --max-bytes {keep}` changes that")
    if arguments.json:
        print_text(json.dumps(made, indent=2))
        return 0
    servers = ", ".join(f"{name} {version}" for name, version in made["servers"].items())
    print_text(f"servers: {servers}; each bucket on {made['replicas']}")
    if records is not None:
        print_text("lines: " + ", ".join(f"{count} {word}" for word, count in made["lines"].items()))
    if made["replicas"] < 3:
        warn("fewer than three servers: when one of them dies, no line is polled until it is back")
    return 0
