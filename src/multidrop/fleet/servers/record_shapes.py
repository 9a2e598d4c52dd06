"""Shapes of a fleet's records: what each must have before anything of it is believed. Pure.

Whoever may write to a bucket may write anything. What is none of ours is no record, and harms nobody else's.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

from multidrop.fleet.servers import names

LEASE = {
    **dict.fromkeys(("session", "began", "pid"), int),
    **dict.fromkeys(("nonce", "host", "machine", "lock", "lock_id"), str),
    **dict.fromkeys(("ended", "draining"), bool),
}
OWNER = {"gateway": str, "session": int, "votes": int, "turn": int, "since": int}
LINE = {"line": dict, "files": dict}
SHAPES: Mapping[str, Mapping[str, type]] = {
    **dict.fromkeys(names.LEASES, LEASE),
    **dict.fromkeys(names.OWNERS, OWNER),
    names.PLANT: LINE,
}
SMALL, LARGE = 1 << 14, 1 << 20  # bytes of a record; a line's has the files of its families
_KINDS = {int: "a whole number", float: "a number", str: "a text", bool: "true or false"}
_KINDS |= {dict: "a table", list: "a list"}


def largest(bucket: str) -> int:
    """Return how many bytes a record of this bucket may have."""
    return LARGE if bucket == names.PLANT else SMALL


def parsed(bucket: str, key: str, data: bytes) -> tuple[Any, str]:
    """Return the value of a record, and why it is none of ours, or "". A removed one has the value None."""
    if not data:
        return None, ""
    if not names.is_name(key):
        return None, "its key is no name"
    if len(data) > largest(bucket):
        return None, f"it has {len(data)} bytes, and {largest(bucket)} are the most"
    try:
        value = json.loads(data.decode())  # else other encodings are looked for, in each of thousands
    except (ValueError, RecursionError):
        return None, "it is no JSON"
    mistake = misshapen(value, SHAPES.get(bucket, {})) or _CHECKS.get(bucket, _nothing)(key, value)
    return (None if mistake else value), mistake


def misshapen(value: Any, shape: Mapping[str, type]) -> str:
    """Return what a value lacks of a shape; "" where it lacks nothing. It may have more."""
    if not isinstance(value, dict):
        return "it is no table"
    for name, kind in shape.items():
        if name not in value:
            return f"it has no {name!r}"
        if type(value[name]) is not kind:
            return f"its {name!r} is not {_KINDS[kind]}"
    return ""


def _nothing(key: str, value: Any) -> str:
    return ""


def _mistake_of_line(key: str, value: Any) -> str:
    if value["line"].get("name") != key:
        return "it describes another line than its key names"
    return "" if set(map(type, value["files"].values())) <= {str} else "one of its files is no text"


def _mistake_of_owner(key: str, value: Any) -> str:
    return "" if value["votes"] in (1, 2) else "it has neither one vote nor two"


_CHECKS: Mapping[str, Callable[[str, Any], str]] = {
    **dict.fromkeys(names.OWNERS, _mistake_of_owner),
    names.PLANT: _mistake_of_line,
}
