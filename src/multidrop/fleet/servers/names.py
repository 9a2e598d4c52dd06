"""Names in NATS: bucket names, subjects, and the names of gateways and lines that are part of subjects."""

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
    """Return a name that can be one token of a NATS subject. Raises ValueError for any other name."""
    if not isinstance(name, str) or not is_name(name):
        suggestion = re.sub(r"[^A-Za-z0-9_-]+", "-", str(name)).strip("-") or f"{kind}-1"
        raise ValueError(
            f"the {kind}'s name {name!r} may have only letters, digits, _ and -: write {suggestion}"
        )
    return name


def is_name(text: str) -> bool:
    """Return True if the text can be one token of a NATS subject."""
    return _NAME.fullmatch(text) is not None


@functools.lru_cache(1 << 16)
def owner_buckets(line: str) -> tuple[str, ...]:
    """Return the buckets that have the records of a line's owner, in the order of writing."""
    first = zlib.crc32(line.encode()) % len(OWNERS)
    return OWNERS[first:] + OWNERS[:first]


def is_inbox(subject: str) -> bool:
    """Return True if this is an inbox, on which a requester may wait for an answer.

    Servers let a responder answer on any subject that the requester names. The requester may name a
    subject to which it may not publish itself, such as that of a plant's record. So answer only on
    inboxes.
    """
    return subject.startswith(("_INBOX.", "_INBOX_"))


def command_subject(line: str) -> str:
    return f"cmd.{line}"


def do_subject(gateway: str, run: str) -> str:
    """Return the subject on which users confirm commands that a gateway has checked.

    `run` is a random id of the gateway's process.
    """
    return f"do.{gateway}.{run}"


def stop_subject(line: str) -> str:
    return f"stop.{line}"


def gateway_subject(gateway: str, wanted: str) -> str:
    """Return the subject for requests about a gateway: "state", "drain", or "*" for both."""
    return f"gateway.{gateway}.{wanted}"
