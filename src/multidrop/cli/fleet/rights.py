"""`multidrop fleet rights`: writes configuration files for NATS servers, and a secret key for each user."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from multidrop.cli.fleet.connection import add_server_arguments, require_fleet, urls_of
from multidrop.cli.support.files import require_extra
from multidrop.cli.support.output import print_text, warn

if TYPE_CHECKING:
    from multidrop.fleet.servers.files import TlsFiles

FOLDER = Path("nats")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("gateways", metavar="NAMES", help="all gateways, with commas: gw-1,gw-2,gw-3")
    parser.add_argument(
        "--folder", metavar="DIR", type=Path, default=FOLDER, help=f"for the files; {FOLDER} if not given"
    )
    parser.add_argument("--cert", metavar="FILE", type=Path, help="a server's certificate, by its path there")
    parser.add_argument("--key", metavar="FILE", type=Path, help="a server's key, by its path there")
    add_server_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Write the files, and print on which computer each belongs. Secrets are never printed."""
    require_fleet()
    require_extra("nkeys", "fleet", "fleet rights")
    from multidrop.fleet.servers.files import write_files

    gateways = [name.strip() for name in arguments.gateways.split(",") if name.strip()]
    if not gateways:
        raise ValueError("name all gateways, such as `multidrop fleet rights gw-1,gw-2,gw-3`")
    folder, urls = arguments.folder, urls_of(arguments)
    tls = _tls(arguments, urls)
    written = write_files(folder, gateways, urls, tls)
    if arguments.json:
        print_text(json.dumps([str(path) for path in written], indent=2))
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
        raise ValueError(f"{secure} needs all of --ca, --cert and --key: paths on the servers")
    return TlsFiles(*files)
