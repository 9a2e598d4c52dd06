"""Messages of the web server: request bodies and their fields, JSON answers, refusals."""

from __future__ import annotations

import asyncio
import gzip
import json
import logging
import re
from collections.abc import Mapping
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from functools import partial
from typing import Any

from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response, StreamingResponse

from multidrop.drive import chosen_language
from multidrop.gateway.http.rights import Caller
from multidrop.printable import is_whole, plain_whole
from multidrop.supervisor import Hung, supervisor

LEAST_MS, MOST_MS = -62_135_596_800_000, 253_402_300_799_999  # years 1 to 9999, in ms since 1970
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
# answers are compressed if their media type contains one of the words
COMPRESSIBLE = ("text", "json", "javascript", "svg", "toml")
LEAST_COMPRESSED = 1024  # in bytes; shorter answers are not compressed
LEVEL = 6
COMPRESSION_S = 10.0
MOST_BYTES = 64 * 1024  # limit of a request's body
BODY_S = 10.0
STOP_BODY_S = 3.0  # time limit for receiving a stop's body, enough for one or two TCP retransmissions
# a language in Accept-Language, and its weight from 0 to 1
_ACCEPTED = re.compile(r"([A-Za-z][A-Za-z0-9-]*)(?:;q=([01](?:\.[0-9]{0,3})?))?")
_log = logging.getLogger("multidrop.gateway")


class Denied(Exception):
    """Raised to refuse a request, with the HTTP status and a sentence for the answer."""

    def __init__(self, status: int, sentence: str) -> None:
        super().__init__(sentence)
        self.status = status


class JsonResponse(Response):
    """JSON escaped to ASCII, because names from requests and files may have lone surrogates."""

    media_type = "application/json"

    def render(self, content: Any) -> bytes:
        return json.dumps(content, allow_nan=False, separators=(",", ":")).encode()


def takes_gzip(headers: Mapping[str, str]) -> bool:
    return "gzip" in headers.get("accept-encoding", "")


async def compressed(request: Request, response: Response) -> Response:
    """Return a response, compressed if it is a long text and its client accepts gzip.

    A thread compresses it, to keep the event loop free for stops. If no thread is free, the response is not
    compressed.
    """
    kind = response.headers.get("content-type", "")
    if isinstance(response, StreamingResponse) or not any(one in kind for one in COMPRESSIBLE):
        return response
    response.headers.add_vary_header("accept-encoding")
    if len(response.body) < LEAST_COMPRESSED or not takes_gzip(request.headers):
        return response
    work = partial(gzip.compress, response.body, LEVEL, mtime=0)
    with suppress(Hung, RuntimeError, MemoryError):
        response.body = await supervisor().within("compression", COMPRESSION_S, work)
        response.headers["content-length"] = str(len(response.body))
        response.headers["content-encoding"] = "gzip"
    return response


def caller_of(request: Request) -> Caller:
    caller: Caller = request.scope["caller"]
    return caller


def language_of(request: Request) -> str:
    """Return the language of titles: the query's `lang`, else the one that Accept-Language prefers."""
    if "lang" in request.query_params:
        return chosen_language([request.query_params["lang"]])
    header = "".join(request.headers.get("accept-language", "").split())
    accepted = filter(None, map(_ACCEPTED.fullmatch, header.split(",")))
    weights = {found[1]: float(found[2] or 1) for found in accepted}
    return chosen_language(sorted(filter(weights.get, weights), key=weights.__getitem__, reverse=True))


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


async def drives_to_stop(request: Request) -> tuple[list[str] | None, object]:
    """Return the drives that a stop request names (None: all drives), and the request's id.

    A request whose body is missing, late, truncated, too long, empty or invalid stops all drives: stopping
    too many is harmless, stopping none is not.
    """
    try:
        body = await body_of(request, STOP_BODY_S)
    except Denied as unread:
        _log.warning("stopping all drives, because %s", unread)
        return None, None
    drives, given_id = body.get("drives"), body.get("id")
    if isinstance(drives, str):
        return [drives], given_id
    if drives is None:
        return None, given_id
    if isinstance(drives, list) and drives and all(isinstance(one, str) for one in drives):
        return drives, given_id
    _log.warning("stopping all drives, because %.100r is not a list of names", drives)
    return None, given_id


def commander_in(request: Request, body: Mapping[str, Any]) -> Caller:
    """Return the caller, with the command's id from the body, or with a new id if the body has no id."""
    try:
        return caller_of(request).commanding(body.get("id"))
    except ValueError as mistake:
        raise Denied(400, str(mistake)) from None


def text_in(body: Mapping[str, Any], key: str) -> str:
    value = body.get(key)
    if not isinstance(value, str) or not value:
        raise Denied(400, f"key {key!r} is missing or not a text")
    return value


def frame_in(body: Mapping[str, Any]) -> int:
    """Return the number of the newest frame that a command's sender has seen. Raises Denied without one."""
    seen = body.get("seen")
    if not is_whole(seen) or not 0 <= seen < 1 << 63:
        raise Denied(
            400, "key 'seen' is missing or not a whole number: give the number n of the newest frame received"
        )
    return seen


def number_in(text: str, key: str) -> int:
    try:
        return plain_whole(text)
    except ValueError:
        raise Denied(400, f"{key} = {text[:40]!r} is not a whole number") from None


def moment_in(text: str, key: str) -> int:
    """Return a time in ms since 1970, from ISO 8601 text (in UTC unless it has an offset) or digits (ms).

    Raises Denied for any other text, and for a time outside the years 1 to 9999.
    """
    ms = _moment(text, key)
    if not LEAST_MS <= ms <= MOST_MS:
        raise Denied(400, f"{key} = {text[:40]!r} is not a time in the years 1 to 9999")
    return ms


def _moment(text: str, key: str) -> int:
    try:
        return plain_whole(text)
    except ValueError:
        pass
    try:
        found = datetime.fromisoformat(text)
    except ValueError:
        wrong = f"{key} = {text[:40]!r} is not a time"
        raise Denied(400, f"{wrong}, such as 2026-11-22T09:30:00Z or 1795253400000 (ms since 1970)") from None
    utc = found if found.tzinfo else found.replace(tzinfo=UTC)
    return (utc - EPOCH) // timedelta(milliseconds=1)


def span_in(query: Mapping[str, str]) -> tuple[int, int]:
    """Return the times `from` and `to` of a query, UTC in ms."""
    begin, end = (moment_in(query.get(key, ""), key) for key in ("from", "to"))
    return begin, end
