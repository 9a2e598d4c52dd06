"""Names of NATS things: buckets, subjects, and names of gateways and lines, which go into them."""

from __future__ import annotations

import functools
import re
import zlib

LEASES = tuple(f"lease_{path}" for path in range(3))
OWNERS = tuple(f"own_{part}" for part in range(3))
PLANT = "plant"
BUCKETS = (*LEASES, *OWNERS, PLANT)
_NAME = re.compile(r"[A-Za-z0-9_-]+")


def checked_name(kind: str, name: str) -> str:
    """Return the name. Raises ValueError for one that a subject cannot have."""
    if not isinstance(name, str) or not is_name(name):
        suggestion = re.sub(r"[^A-Za-z0-9_-]+", "-", str(name)).strip("-") or f"{kind}-1"
        raise ValueError(
            f"the {kind}'s name {name!r} may have letters, digits, _ and - alone: write {suggestion}"
        )
    return name


def is_name(text: str) -> bool:
    """Say whether a subject can have this as one of its parts."""
    return _NAME.fullmatch(text) is not None


@functools.lru_cache(1 << 16)
def owner_buckets(line: str) -> tuple[str, ...]:
    """Return the buckets with the records of a line's master, in the order in which they are written."""
    first = zlib.crc32(line.encode()) % len(OWNERS)
    return OWNERS[first:] + OWNERS[:first]


def is_inbox(subject: str) -> bool:
    """Say whether an asker waits for its answer there.

    Servers let whoever is asked answer to any subject that the asker names, also to one that the asker may
    not use: to a record of the plant, say. What a server itself answers comes without such a subject.
    """
    return subject.startswith(("_INBOX.", "_INBOX_"))


def command_subject(line: str) -> str:
    """Return the subject on which a line's master is asked for an offer."""
    return f"cmd.{line}"


def do_subject(gateway: str, run: str) -> str:
    """Return the subject on which one run of a gateway's process is told to do what it has offered."""
    return f"do.{gateway}.{run}"


def stop_subject(line: str) -> str:
    """Return the subject on which a line's master takes stops."""
    return f"stop.{line}"


def gateway_subject(gateway: str, wanted: str) -> str:
    """Return the subject of a request about a gateway itself: "state", "drain", or "*" for all it takes."""
    return f"gateway.{gateway}.{wanted}"
