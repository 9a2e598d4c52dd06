"""`multidrop fleet rights` and `init`: write configuration and keys of NATS servers; set the servers up."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from multidrop.cli.fleet import add_server_arguments, nats_urls, require_fleet, run_with_paths
from multidrop.cli.fleet.views import size
from multidrop.cli.support.files import require_extra
from multidrop.cli.support.output import print_json, print_text, warn

if TYPE_CHECKING:
    from multidrop.fleet.servers.buckets import Record
    from multidrop.fleet.servers.connections import ServerPath
    from multidrop.fleet.servers.files import TlsFiles

FOLDER = Path("nats")
KEEP = "10 GB"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    if parser.get_default("command") == "rights":
        parser.add_argument("gateways", metavar="NAMES", help="all gateways, with commas: gw-1,gw-2,gw-3")
        parser.add_argument(
            "--folder", metavar="DIR", type=Path, default=FOLDER, help=f"for the files; {FOLDER} if not given"
        )
        parser.add_argument(
            "--cert", metavar="FILE", type=Path, help="a server's certificate, by its path there"
        )
        parser.add_argument("--key", metavar="FILE", type=Path, help="a server's key, by its path there")
    else:
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
    return _rights(arguments) if arguments.command == "rights" else _init(arguments)


def _rights(arguments: argparse.Namespace) -> int:
    """Write the files, and print on which computer each belongs. Secrets are never printed."""
    require_extra("nkeys", "fleet", "fleet rights")
    from multidrop.fleet.servers.files import write_files

    gateways = [name.strip() for name in arguments.gateways.split(",") if name.strip()]
    if not gateways:
        raise ValueError("name all gateways, such as `multidrop fleet rights gw-1,gw-2,gw-3`")
    folder, urls = arguments.folder, nats_urls(arguments.nats)
    tls = _tls(arguments, urls)
    written = write_files(folder, gateways, urls, tls)
    if arguments.json:
        print_json([str(path) for path in written])
    else:
        print_text(
            f"{folder}: copy rights.conf to each server, with the .conf of its name, and each key of keys/ "
            "only to the machine of its user, for --credentials. A running server must read "
            "them twice: say `nats-server --signal reload` two times"
        )
    if tls is None:
        warn("without TLS anyone on the network can read samples and commands: give --ca, --cert and --key")
    return 0


def _tls(arguments: argparse.Namespace, urls: Sequence[str]) -> TlsFiles | None:
    from multidrop.fleet.servers.files import TlsFiles

    files = (arguments.cert, arguments.key, arguments.ca)
    secure = next((url for url in urls if url.startswith("tls:")), "TLS" if any(files) else None)
    if secure is None:
        return None
    if not all(files):
        raise ValueError(
            f"{secure} needs --ca, --cert and --key. Give each as the file's path on the NATS servers"
        )
    return TlsFiles(*files)


def _init(arguments: argparse.Namespace) -> int:
    from multidrop.fleet.servers.plant_store import read_plant
    from multidrop.recording.segments import parse_size

    keep = parse_size(arguments.keep or KEEP)
    records = read_plant(arguments.plant)[1] if arguments.plant else None
    return run_with_paths(arguments, partial(_set_up, arguments, records, keep))


async def _set_up(
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
        print_json(made)
        return 0
    servers = ", ".join(f"{name} {version}" for name, version in made["servers"].items())
    print_text(f"servers: {servers}; each bucket on {made['replicas']}")
    if records is not None:
        print_text("lines: " + ", ".join(f"{count} {word}" for word, count in made["lines"].items()))
    if made["replicas"] < 3:
        warn("fewer than three servers: when one of them dies, no line is polled until it is back")
    return 0
