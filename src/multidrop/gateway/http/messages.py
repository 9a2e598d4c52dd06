"""Messages of the web server: request bodies and their fields, JSON answers, refusals."""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import Mapping
from typing import Any

from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response

from multidrop.gateway.http.rights import Caller
from multidrop.printable import plain_whole

MOST_BYTES = 64 * 1024  # limit of a body
BODY_S = 10.0  # time limit for a body
STOP_BODY_S = 3.0  # time limit for a stop's body, enough for one or two retransmissions
_log = logging.getLogger("multidrop.gateway")


class Denied(Exception):
    """Raised to refuse a request, with the HTTP status and a sentence for the answer."""

    def __init__(self, status: int, sentence: str) -> None:
        super().__init__(sentence)
        self.status = status


class JsonResponse(Response):
    """JSON escaped to ASCII; tolerates lone surrogates, which names from requests and files may have."""

    media_type = "application/json"

    def render(self, content: Any) -> bytes:
        return json.dumps(content, allow_nan=False, separators=(",", ":")).encode()


def caller_of(request: Request) -> Caller:
    caller: Caller = request.scope["caller"]
    return caller


async def body_of(request: Request, seconds: float | None = None) -> dict[str, Any]:
    """Return the JSON object in the body. Raises Denied if it is invalid, too long or too late."""
    data = bytearray()
    seconds = BODY_S if seconds is None else seconds
    try:
        async with asyncio.timeout(seconds):
            async for chunk in request.stream():
                data += chunk
                if len(data) > MOST_BYTES:
                    raise Denied(413, f"the body is longer than {MOST_BYTES} bytes")
    except ClientDisconnect:
        raise Denied(400, "the client has disconnected") from None
    except TimeoutError:
        raise Denied(408, f"the body did not arrive within {seconds:g} s") from None
    try:
        found = json.loads(data)
    except (ValueError, RecursionError):
        raise Denied(400, "the body is not JSON") from None
    if not isinstance(found, dict):
        raise Denied(400, "the body is not a JSON object")
    return found


async def drives_to_stop(request: Request) -> list[str] | None:
    """Return the names of the drives that a stop request names; None for all drives.

    A request whose body is missing, late, truncated, too long, empty or invalid stops all drives: stopping
    too many is harmless, stopping none is not.
    """
    try:
        drives = (await body_of(request, STOP_BODY_S)).get("drives")
    except Denied as unread:
        _log.warning("stopping all drives, because %s", unread)
        return None
    if isinstance(drives, str):
        return [drives]
    if drives is None:
        return None
    if isinstance(drives, list) and drives and all(isinstance(one, str) for one in drives):
        return drives
    _log.warning("stopping all drives, because %.100r is not a list of names", drives)
    return None


def text_in(body: Mapping[str, Any], key: str) -> str:
    value = body.get(key)
    if not isinstance(value, str) or not value:
        raise Denied(400, f"{key} is missing or not a text")
    return value


def frame_in(body: Mapping[str, Any]) -> int:
    """Return the number of the frame that the sender of a command has seen."""
    seen = body.get("seen")
    if isinstance(seen, bool) or not isinstance(seen, int) or not 0 <= seen < 1 << 63:
        raise Denied(400, "seen is missing or not a whole number: give the n of your newest frame")
    return seen


def number_in(text: str, key: str) -> int:
    try:
        return plain_whole(text)
    except ValueError:
        raise Denied(400, f"{key} = {text[:40]!r} is not a whole number") from None


def span_in(query: Mapping[str, str]) -> tuple[int, int]:
    """Return the times `from` and `to` of a query, UTC in ms."""
    begin, end = (number_in(query.get(key, ""), key) for key in ("from", "to"))
    return begin, end
