"""`fleet rights`: the configuration of a fleet's NATS servers, and a key for each of its users."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from multidrop.cli.support.extras import require_extra
from multidrop.cli.support.output import print_text, warn

if TYPE_CHECKING:
    from multidrop.fleet.server_files import TlsFiles

FOLDER = Path("nats")


def write_rights(arguments: argparse.Namespace, urls: list[str]) -> int:
    """Write the files, and say what is to be done with them; no secret is shown."""
    require_extra("nkeys", "fleet", "fleet rights")
    from multidrop.fleet.server_files import write_files

    gateways = [name.strip() for name in (arguments.what or "").split(",") if name.strip()]
    if not gateways:
        raise ValueError("name all gateways, such as `multidrop fleet rights gw-1,gw-2,gw-3`")
    folder = arguments.folder or FOLDER
    tls = _tls(arguments)
    written = write_files(folder, gateways, urls, tls)
    if arguments.json:
        print_text(json.dumps([str(path) for path in written], indent=2))
    else:
        print_text(
            f"{folder}: copy rights.conf to each server, with the .conf of its name, and each key of keys/ "
            "to the machine of its user alone, where --credentials names it"
        )
    if tls is None:
        warn("without TLS the network reads samples and commands too: give --ca, --cert and --key")
    return 0


def _tls(arguments: argparse.Namespace) -> TlsFiles | None:
    from multidrop.fleet.server_files import TlsFiles

    files = (arguments.cert, arguments.key, arguments.ca)
    if not any(files):
        return None
    if not all(files):
        raise ValueError("TLS needs all of --ca, --cert and --key: paths on the servers")
    return TlsFiles(*files)
