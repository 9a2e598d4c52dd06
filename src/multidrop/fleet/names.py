"""Names of NATS things: buckets, subjects, and names of gateways and lines, which go into them."""

from __future__ import annotations

import re
import zlib

LEASES = tuple(f"lease_{path}" for path in range(3))
OWNERS = tuple(f"own_{part}" for part in range(3))
PLANT = "plant"
BUCKETS = (*LEASES, *OWNERS, PLANT)

_NAME = re.compile(r"[A-Za-z0-9_-]+")


def check_name(kind: str, name: str) -> str:
    """Return the name of a gateway or a line; ValueError where it could not be a part of a subject."""
    if not _NAME.fullmatch(name):
        raise ValueError(
            f"the {kind} {name!r} cannot be named in NATS; use letters, digits, - and _, such as hall-1"
        )
    return name


def owner_bucket(line: str) -> str:
    """Return the bucket with the record of a line's master."""
    return OWNERS[zlib.crc32(line.encode()) % len(OWNERS)]


def command_subject(line: str) -> str:
    """Return the subject on which a line's master is asked for an offer."""
    return f"cmd.{line}"


def gateway_subject(gateway: str) -> str:
    """Return the subject on which a gateway takes requests about itself."""
    return f"gateway.{gateway}"
