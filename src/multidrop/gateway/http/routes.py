"""The routes of the web server, behind the guard."""

from __future__ import annotations

import asyncio
import logging
import re
from collections import deque
from collections.abc import AsyncIterator, Callable, Coroutine, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar
from urllib.parse import parse_qs

from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp, Receive, Scope, Send

from multidrop import WriteForbidden
from multidrop.control import CommandResult, read_audit
from multidrop.exposition import expose_metrics
from multidrop.gateway.clock import utc_ms
from multidrop.gateway.commands import STOPPING, Admit
from multidrop.gateway.http.exports import Exports, parameter_file
from multidrop.gateway.http.guard import COOKIE, HAS_WRONG_TOKEN, SHUT, WRONG, Guard, Needed
from multidrop.gateway.http.messages import (
    Denied,
    JsonResponse,
    body_of,
    caller_of,
    drives_to_stop,
    frame_in,
    number_in,
    span_in,
    text_in,
)
from multidrop.gateway.http.page_files import PageFiles
from multidrop.gateway.http.rights import NEVER_THIS_WAY, NOT_ALLOWED, NOT_LISTED, Right
from multidrop.gateway.live.descriptions import describe
from multidrop.gateway.live.frames import WHOLE, Frames
from multidrop.gateway.live.views import drive_view, health_of, line_views
from multidrop.gateway.metrics import families_of
from multidrop.supervisor import Hung, supervisor

if TYPE_CHECKING:
    from multidrop.gateway.gateway import Gateway


MOST_QUERIES = 2  # concurrent queries of the audit log
AUDIT_S = 20.0  # time limit of one such query
COOKIE_S = 30 * 24 * 3600
MOST_RECORDS = 200  # entries of the audit log in one answer
MOST_NOTE = 500  # characters of an acknowledgement's note
HEAD_S = 0.5  # the head of a stop's answer is sent after this time; it confirms that the stop was accepted
UNBUFFERED = {"x-accel-buffering": "no"}  # proxies forward the head immediately
RIGHTS_RULES = (NOT_ALLOWED, NOT_LISTED, NEVER_THIS_WAY)

NEEDED: Mapping[str, Needed] = {
    "/": Needed("GET", None),
    "/page/": Needed("GET", None),
    "/api/": Needed("GET", Right.LOOK),
    "/health": Needed("GET", Right.LOOK),
    "/metrics": Needed("GET", Right.LOOK),
    "/api/stop": Needed("POST", Right.STOP),
    "/api/fleet/stop": Needed("POST", Right.STOP),
    "/api/act": Needed("POST", Right.STOP),  # Commands checks the verb's own right
    "/api/acknowledge": Needed("POST", Right.STOP),
    "/api/write": Needed("POST", Right.WRITE),
    "/api/reload": Needed("POST", Right.WRITE),
    "/api/token": Needed("POST", None),
    "/api/forget": Needed("POST", None),
}

_UTC = re.compile(r"\d{4}-\d\d-\d\d(T\d\d:\d\d(:\d\d(\.\d+)?)?Z?)?", re.ASCII)  # the time is optional
R = TypeVar("R")
_log = logging.getLogger("multidrop.gateway")
_PLAIN = [(b"content-type", b"application/json"), (b"vary", b"accept-encoding")]
_GZIPPED = [*_PLAIN, (b"content-encoding", b"gzip")]


def make_app(gateway: Gateway) -> ASGIApp:
    """Return the ASGI application of all routes, behind the guard."""
    pages, files = _Pages(gateway), PageFiles()
    routes = [
        Route("/", files.index),
        Route("/page/{name:path}", files.file),
        Route("/api/plant", pages.plant),
        Route("/api/drive/{name:path}", pages.drive),
        Route("/api/parameters/{name:path}", pages.parameters),
        Route("/api/lines", pages.lines),
        Route("/api/minute", pages.minute),
        Route("/api/fleet", pages.fleet),
        Route("/api/history", pages.history),
        Route("/api/export", pages.export),
        Route("/api/audit", pages.audit),
        Route("/api/alarms", pages.alarms),
        Route("/health", pages.health),
        Route("/metrics", pages.metrics),
        Route("/api/stop", pages.stop, methods=["POST"]),
        Route("/api/fleet/stop", pages.stop_fleet, methods=["POST"]),
        Route("/api/write", pages.write, methods=["POST"]),
        Route("/api/act", pages.act, methods=["POST"]),
        Route("/api/acknowledge", pages.acknowledge, methods=["POST"]),
        Route("/api/reload", pages.reload, methods=["POST"]),
        Route("/api/token", pages.token, methods=["POST"]),
        Route("/api/forget", pages.forget, methods=["POST"]),
    ]
    handlers: Any = {
        Denied: _denied,
        Hung: lambda request, failure: _error(503, str(failure)),
        404: lambda request, failure: _error(404, "unknown path"),
        500: lambda request, failure: _error(500, "internal error; see the gateway's log"),
    }
    others = Starlette(routes=routes, exception_handlers=handlers)
    frames = FrameRoute(gateway.frames)

    async def app(scope: Scope, receive: Receive, send: Send) -> None:
        """Answer requests for frames without the router, because they are by far the most frequent."""
        await (frames if scope["path"] == "/api/frame" else others)(scope, receive, send)

    return Guard(
        app,
        needed=NEEDED,
        names=gateway.own_names,
        tokens=gateway.tokens,
        may=lambda: gateway.settings.may,
        behind_proxy=gateway.settings.behind_proxy,
        clock=lambda: gateway.guard_clock(),
    )


def _error(status: int, sentence: str) -> Response:
    return JsonResponse({"error": sentence}, status)


async def _denied(request: Request, failure: Exception) -> Response:
    return _error(getattr(failure, "status", 400), str(failure))


def _fields(result: CommandResult) -> dict[str, Any]:
    return {"done": result.ok, "text": result.text}


def _answer(result: CommandResult) -> Response:
    """Return the HTTP answer with a command's outcome: status 403 if a right was missing, else 200."""
    is_denied = isinstance(result.error, WriteForbidden) and result.error.rule in RIGHTS_RULES
    return JsonResponse(
        _fields(result) | ({"error": result.text} if is_denied else {}), 403 if is_denied else 200
    )


def _answer_all(results: Mapping[str, CommandResult]) -> Response:
    return JsonResponse({name: _fields(one) for name, one in results.items()})


def _answer_fleet(results: Mapping[str, tuple[bool, str]]) -> Response:
    return JsonResponse({name: {"done": done, "text": text} for name, (done, text) in results.items()})


def _time_asked(query: Mapping[str, str]) -> str:
    """Return the parameter `before` of a query, "" without one. Raises Denied if it is not a UTC time."""
    if "before" in query and not _UTC.fullmatch(query["before"]):
        wrong = query["before"][:40]
        raise Denied(400, f"before = {wrong!r} is not a time in UTC, such as 2026-11-22 or 2026-11-22T09:30")
    return query.get("before", "")


def newest_records(path: Path | None, before: str = "", count: int = MOST_RECORDS) -> dict[str, Any]:
    """Return the newest `count` entries of an audit log before this time (ISO 8601, UTC; "": now).

    The newest entry is first. `more` is True if there are older entries. Raises OSError if the log cannot be
    read.
    """
    count = max(1, min(count, MOST_RECORDS))
    found: deque[dict[str, Any]] = deque(maxlen=count + 1)
    if path is not None and path.exists():
        found += (record for record in read_audit(path) if not before or str(record.get("time", "")) < before)
    newest = list(reversed(found))
    return {"entries": newest[:count], "more": len(newest) > count}


async def _answer_stop(work: Coroutine[Any, Any, R], respond: Callable[[R], Response]) -> Response:
    """Return the answer to a stop, which continues even if its client disconnects.

    If the stop takes longer than HEAD_S, the answer starts before its end. A client that gets no head knows
    that its stop was not accepted.
    """
    task = supervisor().start("stop", work)
    await asyncio.wait({task}, timeout=HEAD_S)
    if task.done():
        return respond(task.result())

    async def body() -> AsyncIterator[bytes]:
        yield bytes(respond(await asyncio.shield(task)).body)

    return StreamingResponse(body(), media_type="application/json", headers=UNBUFFERED)


class _Pages:
    """The functions that answer the routes."""

    def __init__(self, gateway: Gateway) -> None:
        self._gateway = gateway
        self._exports = Exports()

    # ---- queries ----

    async def plant(self, request: Request) -> Response:
        return JsonResponse(describe(self._gateway, caller_of(request).role))

    async def drive(self, request: Request) -> Response:
        try:
            return JsonResponse(await drive_view(self._gateway, request.path_params["name"]))
        except ValueError as unknown:
            return _error(404, str(unknown))

    async def parameters(self, request: Request) -> Response:
        """Return a drive's parameters as JSON, or with `format` as a file; with `read`, read them first."""
        reads, query, name = self._gateway.parameter_reads, request.query_params, request.path_params["name"]
        try:
            read = (reads.begin if "read" in query else reads.of)(self._gateway.plant, name)
        except ValueError as unknown:
            return _error(404, str(unknown))
        if "format" not in query:
            return JsonResponse({"state": "none"} if read is None else read.as_json())
        if read is None or read.found is None:
            return _error(409, "the parameters are not read yet")
        return parameter_file(read, query["format"])

    async def lines(self, request: Request) -> Response:
        return JsonResponse(line_views(self._gateway))

    async def minute(self, request: Request) -> Response:
        return JsonResponse(self._gateway.hub.last_minute())

    async def fleet(self, request: Request) -> Response:
        part: Any = self._gateway.feeds.get("fleet")
        if part is None:
            return _error(404, "this gateway shows no fleet; add [serve.fleet] to the plant file")
        return JsonResponse(part.state())

    async def health(self, request: Request) -> Response:
        health = health_of(self._gateway)
        return JsonResponse(health, 503 if health["status"] == "failed" else 200)

    async def metrics(self, request: Request) -> Response:
        kind, text = expose_metrics(families_of(self._gateway), request.headers.get("accept", ""))
        return PlainTextResponse(text, headers={"content-type": kind, "vary": "accept"})

    async def audit(self, request: Request) -> Response:
        query = request.query_params
        before, count = _time_asked(query), number_in(query.get("count", str(MOST_RECORDS)), "count")
        work = partial(newest_records, self._gateway.settings.audit, before, count)
        return JsonResponse(await supervisor().within("audit queries", AUDIT_S, work, most=MOST_QUERIES))

    async def alarms(self, request: Request) -> Response:
        alarms = self._gateway.alarms
        found = [alarm.as_json() for alarm in alarms.between(*span_in(request.query_params))]
        return JsonResponse({"alarms": found, "since": alarms.since})

    async def acknowledge(self, request: Request) -> Response:
        """Acknowledge an alarm, with the caller's note."""
        body = await body_of(request)
        alarm, note = text_in(body, "alarm"), body.get("note", "")
        if not isinstance(note, str) or len(note) > MOST_NOTE or not note.isprintable():
            raise Denied(400, f"note must be a text of at most {MOST_NOTE} printable characters")
        try:
            found = self._gateway.alarms.acknowledge(alarm, utc_ms(), caller_of(request).by, note.strip())
        except KeyError:
            raise Denied(404, "unknown alarm; the list may have changed") from None
        self._gateway.frames.note_news()
        return JsonResponse(found.as_json())

    # ---- history ----

    async def history(self, request: Request) -> Response:
        part = self._history()
        query = request.query_params
        points = number_in(query.get("points", "800"), "points")
        try:
            found = await part.series(query.getlist("series"), *span_in(query), points)
        except ValueError as mistake:
            return _error(400, str(mistake))
        return Response(found, media_type="application/json")

    async def export(self, request: Request) -> Response:
        part, query = self._history(), request.query_params
        kind = query.get("format", "csv")
        return await self._exports.respond(part, query.getlist("series"), *span_in(query), kind)

    def _history(self) -> Any:
        part = self._gateway.feeds.get("history")
        if part is None:
            raise Denied(404, "this gateway records no history; add [serve.history] to the plant file")
        return part

    # ---- commands ----

    async def stop(self, request: Request) -> Response:
        drives = await drives_to_stop(request)
        return await _answer_stop(self._gateway.commands.stop(drives, caller_of(request)), _answer_all)

    async def stop_fleet(self, request: Request) -> Response:
        """Stop all drives of the fleet, with the commander's key of `[serve.fleet]`."""
        part: Any = self._gateway.feeds.get("fleet")
        if part is None or not part.can_stop:
            raise Denied(404, "this gateway cannot stop the fleet; add commander to [serve.fleet]")
        caller = caller_of(request)
        _log.warning("stop of the whole fleet, asked for by %s", caller.by)
        return await _answer_stop(part.stop(caller.by), _answer_fleet)

    async def write(self, request: Request) -> Response:
        body = await body_of(request)
        value = body.get("value")
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise Denied(400, "value is missing or not a number")
        drive, register = text_in(body, "drive"), text_in(body, "register")
        caller = caller_of(request)
        admit = self._admission(drive, (register, value, caller), body)
        return _answer(await self._gateway.commands.write(drive, register, value, caller, admit))

    async def act(self, request: Request) -> Response:
        body = await body_of(request)
        drive, verb = text_in(body, "drive"), text_in(body, "verb")
        if HAS_WRONG_TOKEN in request.scope and verb not in STOPPING:
            raise Denied(401, WRONG)
        options = {} if verb in STOPPING else body.get("options", {})  # wrong options must not prevent a stop
        if not isinstance(options, dict):
            raise Denied(400, "options is not a JSON object")
        caller = caller_of(request)
        admit = self._admission(drive, (verb, repr(options), caller), body)
        acting = self._gateway.commands.act(drive, verb, options, caller, admit)
        return await _answer_stop(acting, _answer) if verb in STOPPING else _answer(await acting)

    def _admission(self, drive: str, command: object, body: Mapping[str, Any]) -> Admit:
        """Return a function that checks a command against the frame its sender saw. Stops are not checked."""
        frames = self._gateway.seen_frames
        return lambda what: frames.admit(drive, what, (drive, command), frame_in(body))

    async def reload(self, request: Request) -> Response:
        if (await body_of(request)).get("confirm") is not True:
            raise Denied(400, 'a reload changes what is polled: confirm it with {"confirm": true}')
        result = await self._gateway.reload.carry_out(caller_of(request).by)
        return JsonResponse(
            {
                "done": result.is_done,
                "text": result.text,
                "mistakes": result.mistakes,
                "restart": result.restart,
            }
        )

    # ---- tokens ----

    async def token(self, request: Request) -> Response:
        """Store a token in a cookie that scripts cannot read.

        After several wrong tokens, an address must wait before its next attempt, unless it wants to stop.
        """
        gateway, caller = self._gateway, caller_of(request)
        body = await body_of(request)
        secret = text_in(body, "token")
        is_shut = gateway.tokens.is_shut(caller.address, gateway.guard_clock())
        if is_shut and body.get("to") != "stop":
            raise Denied(429, SHUT)
        token = gateway.tokens.find(secret)
        if token is None:
            gateway.tokens.note_wrong(caller.address, secret, gateway.guard_clock())
            _log.warning("wrong token from %s", caller.address)
            raise Denied(401, WRONG)
        response = JsonResponse({"name": token.name, "role": token.right.name.lower()})
        is_secure = gateway.settings.tls is not None or gateway.settings.behind_proxy
        response.set_cookie(
            COOKIE, secret, max_age=COOKIE_S, httponly=True, samesite="strict", secure=is_secure
        )
        return response

    async def forget(self, request: Request) -> Response:
        response = JsonResponse({})
        response.delete_cookie(COOKIE, httponly=True, samesite="strict")
        return response


class FrameRoute:
    """Answers `/api/frame?after=N` as soon as there is a frame with another number than N."""

    def __init__(self, frames: Frames) -> None:
        self._frames = frames

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            asked = parse_qs(scope["query_string"].decode("latin-1"), keep_blank_values=True)
            frame = await self._frames.after(number_in(asked.get("after", [str(WHOLE)])[-1], "after"))
        except Denied as denied:
            await JsonResponse({"error": str(denied)}, denied.status)(scope, receive, send)
            return
        except OverflowError as full:
            await JsonResponse({"error": str(full)}, 503)(scope, receive, send)
            return
        status, headers, body = 304, list[tuple[bytes, bytes]](), b""
        if frame is not None:
            takes_gzip = "gzip" in Headers(scope=scope).get("accept-encoding", "")
            status, headers = 200, _GZIPPED if takes_gzip else _PLAIN
            body = frame.gzipped if takes_gzip else frame.plain
            headers = [*headers, (b"content-length", str(len(body)).encode())]
        await send({"type": "http.response.start", "status": status, "headers": headers})
        await send({"type": "http.response.body", "body": body})
