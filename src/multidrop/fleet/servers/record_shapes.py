"""Shapes of a fleet's records: what a record must contain before it is used. No I/O.

Any user with write access to a bucket can write any bytes. An invalid record is ignored, and does not affect
other records.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any, get_args

from multidrop.fleet.servers import names

LEASE = {
    **dict.fromkeys(("session", "began", "pid"), int),
    **dict.fromkeys(("nonce", "host", "machine", "lock", "lock_id"), str),
    **dict.fromkeys(("ended", "draining"), bool),
}
OWNER = {"gateway": str, "session": int, "votes": int, "turn": int, "since": int}
LINE = {"line": dict, "files": dict}
SHAPES: Mapping[str, Mapping[str, Any]] = {
    **dict.fromkeys(names.LEASES, LEASE),
    **dict.fromkeys(names.OWNERS, OWNER),
    names.PLANT: LINE,
}
MOST_TEXT = 300  # limit of characters of a text in a gateway's state
SMALL, LARGE = 1 << 14, 1 << 20  # limits of a record's bytes; a line's record contains its family files
_KINDS: Mapping[Any, str] = {
    **{int: "a whole number", float: "a number", str: "a text", bool: "true or false", dict: "a table"},
    **{int | None: "a whole number or null", float | None: "a number or null", str | None: "a text or null"},
}


def largest(bucket: str) -> int:
    """Return the limit of a record's size in this bucket, in bytes."""
    return LARGE if bucket == names.PLANT else SMALL


def parsed(bucket: str, key: str, data: bytes) -> tuple[Any, str]:
    """Return a record's value and "", or None and why it is invalid. A removed record is None and ""."""
    if not data:
        return None, ""
    if not names.is_name(key):
        return None, "its key is not a valid name"
    if len(data) > largest(bucket):
        return None, f"it has {len(data)} bytes, and {largest(bucket)} are the most"
    try:
        value = json.loads(data.decode())  # faster than loads(data), which detects the encoding
    except (ValueError, RecursionError):
        return None, "not JSON"
    mistake = misshapen(value, SHAPES.get(bucket, {})) or _CHECKS.get(bucket, _nothing)(key, value)
    return (None if mistake else value), mistake


def misshapen(value: Any, shape: Mapping[str, Any]) -> str:
    """Return how a value differs from a shape; "" if it fits. Further entries are allowed."""
    if not isinstance(value, dict):
        return "not a table"
    for name, kind in shape.items():
        if name not in value:
            return f"it has no {name!r}"
        if type(value[name]) not in (get_args(kind) or (kind,)):
            return f"its {name!r} is not {_KINDS[kind]}"
    return ""


def with_short_texts(value: Any) -> Any:
    """Return a JSON value with all texts cut to MOST_TEXT characters."""
    if isinstance(value, dict):
        return {key[:MOST_TEXT]: with_short_texts(one) for key, one in value.items()}
    if isinstance(value, list):
        return [*map(with_short_texts, value)]
    return value[:MOST_TEXT] if isinstance(value, str) else value


def _nothing(key: str, value: Any) -> str:
    return ""


def _mistake_of_line(key: str, value: Any) -> str:
    if value["line"].get("name") != key:
        return "its line has another name than its key"
    return "" if set(map(type, value["files"].values())) <= {str} else "one of its files is not text"


def _mistake_of_owner(key: str, value: Any) -> str:
    return "" if value["votes"] in (1, 2) else "it has neither one vote nor two"


_CHECKS: Mapping[str, Callable[[str, Any], str]] = {
    **dict.fromkeys(names.OWNERS, _mistake_of_owner),
    names.PLANT: _mistake_of_line,
}
