"""Options of commands that speak with a fleet's NATS servers: URLs, credentials and a certificate."""

from __future__ import annotations

import argparse
import logging
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from multidrop.cli.support.files import require_extra
from multidrop.printable import masked

URLS = "nats://127.0.0.1:4222"
CREDENTIALS, CA = "MULTIDROP_NATS_CREDENTIALS", "MULTIDROP_NATS_CA"


def add_nats_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--credentials",
        metavar="FILE",
        type=Path,
        help=f"key of `fleet rights`, or .creds; else {CREDENTIALS}",
    )
    parser.add_argument(
        "--ca", metavar="FILE", type=Path, help=f"certificate that the servers' are signed by; else {CA}"
    )


def nats_urls(given: str | None) -> list[str]:
    """Return the servers' URLs: those given, with commas, or else MULTIDROP_NATS.

    Raises ValueError for none, and for one that is not nats:// or tls://.
    """
    text = given or os.environ.get("MULTIDROP_NATS") or URLS
    found = [url.strip() for url in text.split(",") if url.strip()]
    for url in found:
        if not url.startswith(("nats://", "tls://")):
            raise ValueError(f"{masked(url)} is not an address of a NATS server; write {URLS}")
    if not found:
        raise ValueError(f"{masked(text)!r} names no NATS server; write {URLS}")
    return found


def nats_options(arguments: argparse.Namespace, urls: Sequence[str]) -> dict[str, Any]:
    """Return the options of a connection. Raises ValueError for a file that holds no key."""
    from multidrop.fleet.servers.credentials import connect_options

    logging.getLogger("asyncio").addFilter(_is_news)
    credentials = arguments.credentials or _named(CREDENTIALS)
    if credentials:
        require_extra("nkeys", "fleet", "fleet --credentials")
    return connect_options(urls, credentials, arguments.ca or _named(CA))


def _is_news(record: logging.LogRecord) -> bool:
    """Leave out what asyncio of Python 3.11 says of each TLS connection that its far end closes."""
    return "eof_received" not in record.getMessage()


def _named(variable: str) -> Path | None:
    text = os.environ.get(variable)
    return Path(text) if text else None
