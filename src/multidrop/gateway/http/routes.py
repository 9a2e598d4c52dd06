"""The functions that answer the web server's routes. The guard has checked each request before."""

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
from multidrop.control import CommandOutcome, CommandResult, read_audit
from multidrop.control.commands import JoinedStops
from multidrop.exposition import expose_metrics
from multidrop.gateway import utc_ms
from multidrop.gateway.commands import STOPPING, Admit, UnknownDrive
from multidrop.gateway.http.files import KINDS, Exports, PageFiles, attachment, parameter_file
from multidrop.gateway.http.guard import COOKIE, HAS_WRONG_TOKEN, SHUT, WRONG, Guard
from multidrop.gateway.http.messages import (
    Denied,
    JsonResponse,
    body_of,
    caller_of,
    commander_in,
    compressed,
    drives_to_stop,
    frame_in,
    language_of,
    moment_in,
    number_in,
    span_in,
    takes_gzip,
    text_in,
)
from multidrop.gateway.http.operations import FRAME_PATH, NEEDED, OPERATIONS, Operation, openapi
from multidrop.gateway.http.rights import NEVER_THIS_WAY, NOT_ALLOWED, NOT_LISTED, Caller
from multidrop.gateway.live.frames import WHOLE, Frames
from multidrop.gateway.live.views import describe, drive_view, health_of, line_views
from multidrop.gateway.metrics import families_of
from multidrop.gateway.modbus_server.address_map import to_csv, to_json
from multidrop.printable import is_number, iso_time
from multidrop.supervisor import Hung, supervisor

if TYPE_CHECKING:
    from multidrop.gateway.gateway import Gateway


MOST_QUERIES = 2  # limit of concurrent queries of the audit log
AUDIT_S = 20.0  # time limit of a query of the audit log
COOKIE_S = 30 * 24 * 3600
MAP_S = 20.0  # time limit, in s, for making the Modbus address map
MOST_RECORDS = 200  # limit of the audit log's entries in one answer
MOST_NOTE = 500  # limit, in characters, of the note on an acknowledged alarm
# in s: if a stop takes longer than this, the head of its answer is sent before the stop ends
HEAD_S = 0.5
# header that makes proxies forward the head of an answer immediately
UNBUFFERED = {"x-accel-buffering": "no"}
RIGHTS_RULES = (NOT_ALLOWED, NOT_LISTED, NEVER_THIS_WAY)

# a date, or a date and a time of day (ISO 8601, UTC)
_UTC = re.compile(r"\d{4}-\d\d-\d\d(T\d\d:\d\d(:\d\d(\.\d+)?)?Z?)?", re.ASCII)
R = TypeVar("R")
_log = logging.getLogger("multidrop.gateway")
_PLAIN = [(b"content-type", b"application/json"), (b"vary", b"accept-encoding")]
_GZIPPED = [*_PLAIN, (b"content-encoding", b"gzip")]


def make_app(gateway: Gateway) -> ASGIApp:
    """Return the ASGI application of all routes, behind the guard."""
    pages = Pages(gateway)
    routes = [
        Route(one.path.replace("{name}", "{name:path}"), _endpoint(pages, one), methods=[one.method])
        for one in OPERATIONS
    ]
    handlers: Any = {
        Denied: _denied,
        Hung: lambda request, failure: _error(503, str(failure)),
        404: lambda request, failure: _error(404, "unknown path"),
        500: lambda request, failure: _error(500, "internal error; see the gateway's log"),
    }
    others = Starlette(routes=routes, exception_handlers=handlers)

    async def app(scope: Scope, receive: Receive, send: Send) -> None:
        """Answer without the router if the path is FRAME_PATH, because most requests have this path."""
        await (pages.frame if scope["path"] == FRAME_PATH else others)(scope, receive, send)

    return Guard(
        app,
        needed=NEEDED,
        names=gateway.own_names,
        tokens=gateway.tokens,
        may=lambda: gateway.settings.may,
        behind_proxy=gateway.settings.behind_proxy,
        clock=lambda: gateway.guard_clock(),
    )


def _endpoint(pages: Pages, operation: Operation) -> Any:
    """Return the function that answers a route. It compresses answers to GET that are not compressed yet."""
    handler = getattr(pages, operation.handler)
    if operation.method == "POST" or operation.path == FRAME_PATH:
        return handler

    async def answer(request: Request) -> Response:
        return await compressed(request, await handler(request))

    return answer


def _error(status: int, sentence: str) -> Response:
    return JsonResponse({"error": sentence}, status)


async def _denied(request: Request, failure: Exception) -> Response:
    return _error(getattr(failure, "status", 400), str(failure))


def _fields(result: CommandResult, caller: Caller) -> dict[str, Any]:
    return {"done": result.ok, "text": result.text, "id": caller.command}


def _status(result: CommandResult) -> int:
    """Return HTTP status 4xx if the command was invalid or the caller lacks the right; else 200."""
    error = result.error
    if isinstance(error, UnknownDrive):
        return 404
    if isinstance(error, WriteForbidden):
        return 403 if error.rule in RIGHTS_RULES else 200
    return 400 if isinstance(error, ValueError) and result.outcome is CommandOutcome.REFUSED else 200


def _answer(caller: Caller, result: CommandResult) -> Response:
    status = _status(result)
    error = {} if status == 200 else {"error": result.text}
    return JsonResponse(_fields(result, caller) | error, status)


def _answer_all(caller: Caller, results: Mapping[str, CommandResult]) -> Response:
    """Return the HTTP answer with each drive's result; its status is 404 if all drives are unknown."""
    if results and all(isinstance(one.error, UnknownDrive) for one in results.values()):
        return _error(404, "; ".join(one.text for one in results.values()))
    return JsonResponse({name: _fields(one, caller) for name, one in results.items()})


def _answer_fleet(results: Mapping[str, tuple[bool, str]]) -> Response:
    return JsonResponse({name: {"done": done, "text": text} for name, (done, text) in results.items()})


def _time_asked(query: Mapping[str, str]) -> str:
    """Return the query's parameter `before` as ISO 8601 text; "" if missing. Raises Denied if invalid."""
    if "before" not in query or _UTC.fullmatch(query["before"]):
        return query.get("before", "")
    return iso_time(moment_in(query["before"], "before"))


def newest_records(path: Path | None, before: str = "", count: int = MOST_RECORDS) -> dict[str, Any]:
    """Return the newest `count` entries of an audit log from before a time (ISO 8601, UTC; "": now).

    The newest entry is first. In the answer, `more` is True if there are older entries. Raises OSError if the
    log cannot be read.
    """
    count = max(1, min(count, MOST_RECORDS))
    found: deque[dict[str, Any]] = deque(maxlen=count + 1)
    if path is not None and path.exists():
        found += (record for record in read_audit(path) if not before or str(record.get("time", "")) < before)
    newest = list(reversed(found))
    return {"entries": newest[:count], "more": len(newest) > count}


async def _answer_stop(stopping: asyncio.Future[R], respond: Callable[[R], Response]) -> Response:
    """Wait for a stop, and return its answer. The stop continues even if its client disconnects.

    If the stop takes longer than HEAD_S, the head of the answer is sent before the stop ends. So a client
    that gets no head knows that its stop was not accepted.
    """
    await asyncio.wait({stopping}, timeout=HEAD_S)
    if stopping.done():
        return respond(stopping.result())

    async def body() -> AsyncIterator[bytes]:
        yield bytes(respond(await asyncio.shield(stopping)).body)

    return StreamingResponse(body(), media_type="application/json", headers=UNBUFFERED)


class Pages(PageFiles):
    """The methods that answer the routes; the table `OPERATIONS` names the method of each route."""

    def __init__(self, gateway: Gateway) -> None:
        super().__init__()
        self._gateway = gateway
        self._exports = Exports()
        self._stops = JoinedStops()
        self.frame = FrameRoute(gateway.frames)

    async def openapi(self, request: Request) -> Response:
        return JsonResponse(openapi(self._gateway.version))

    # ---- queries ----

    async def plant(self, request: Request) -> Response:
        content = describe(self._gateway, caller_of(request).role, language_of(request))
        return JsonResponse(content, headers={"vary": "accept-language"})

    async def drive(self, request: Request) -> Response:
        try:
            return JsonResponse(await drive_view(self._gateway, request.path_params["name"]))
        except ValueError as unknown:
            return _error(404, str(unknown))

    async def parameters(self, request: Request) -> Response:
        """Return a drive's parameters as JSON, or as a file if the query has `format`.

        If the query has `read`, read them from the drive first.
        """
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

    async def modbus_map(self, request: Request) -> Response:
        part: Any = self._gateway.feeds.get("modbus")
        if part is None:
            return _error(404, "this gateway is not a Modbus server; add [serve.modbus] to the plant file")
        kind = request.query_params.get("format", "json")
        if kind not in ("json", "csv"):
            raise Denied(400, f"format = {kind[:20]!r} is neither json nor csv")

        def made() -> Response:
            rows = part.address_map()
            if kind == "json":
                return Response(to_json(rows), media_type=JsonResponse.media_type)
            return Response(to_csv(rows), media_type=KINDS["csv"], headers=attachment("modbus-map.csv"))

        return await supervisor().within("address maps", MAP_S, made)

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
        found = [alarm.as_answer() for alarm in alarms.between(*span_in(request.query_params))]
        return JsonResponse({"alarms": found, "since": iso_time(alarms.since)})

    async def triggers(self, request: Request) -> Response:
        part: Any = self._gateway.feeds.get("trigger")
        return JsonResponse({"triggers": [] if part is None else part.as_answer()})

    async def acknowledge(self, request: Request) -> Response:
        body = await body_of(request)
        alarm, note = text_in(body, "alarm"), body.get("note", "")
        if not isinstance(note, str) or len(note) > MOST_NOTE or not note.isprintable():
            raise Denied(400, f"key 'note' must be a text of at most {MOST_NOTE} printable characters")
        try:
            found = self._gateway.alarms.acknowledge(alarm, utc_ms(), caller_of(request).by, note.strip())
        except KeyError:
            raise Denied(404, "unknown alarm; the list may have changed") from None
        self._gateway.frames.note_news()
        return JsonResponse(found.as_answer())

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
        is_gzipped = kind == "csv" and takes_gzip(request.headers)
        span = span_in(query)
        return await self._exports.respond(part, query.getlist("series"), *span, kind, is_gzipped=is_gzipped)

    def _history(self) -> Any:
        part = self._gateway.feeds.get("history")
        if part is None:
            raise Denied(404, "this gateway records no history; add [serve.history] to the plant file")
        return part

    # ---- commands ----

    async def stop(self, request: Request) -> Response:
        drives, given_id = await drives_to_stop(request)
        caller = caller_of(request).stopping(given_id)
        work = partial(self._gateway.commands.stop, drives, caller)
        stopping = self._begin_stop(("stop", drives and tuple(drives)), work)
        return await _answer_stop(stopping, partial(_answer_all, caller))

    async def stop_fleet(self, request: Request) -> Response:
        """Stop all drives of the fleet. This needs the key file that `commander` in `[serve.fleet]` names."""
        part: Any = self._gateway.feeds.get("fleet")
        if part is None or not part.can_stop:
            raise Denied(
                404,
                "this gateway cannot stop the fleet; add key 'commander' to [serve.fleet] in the plant file",
            )
        caller = caller_of(request)
        _log.warning("stop of the whole fleet, asked for by %s", caller.by)
        return await _answer_stop(self._begin_stop("fleet", partial(part.stop, caller.by)), _answer_fleet)

    async def write(self, request: Request) -> Response:
        body = await body_of(request)
        value = body.get("value")
        if not is_number(value):
            raise Denied(400, "key 'value' is missing or not a number")
        drive, register = text_in(body, "drive"), text_in(body, "register")
        caller = commander_in(request, body)
        admit = self._admission(drive, (register, value, caller_of(request)), body)
        return _answer(caller, await self._gateway.commands.write(drive, register, value, caller, admit))

    async def act(self, request: Request) -> Response:
        body = await body_of(request)
        drive, verb = text_in(body, "drive"), text_in(body, "verb")
        if HAS_WRONG_TOKEN in request.scope and verb not in STOPPING:
            raise Denied(401, WRONG)
        # wrong options must not prevent a stop, so a stop ignores all options
        options = {} if verb in STOPPING else body.get("options", {})
        if not isinstance(options, dict):
            raise Denied(400, "key 'options' is not a JSON object")
        sender = caller_of(request)
        caller = sender.stopping(body.get("id")) if verb in STOPPING else commander_in(request, body)
        admit = self._admission(drive, (verb, repr(options), sender), body)
        acting = partial(self._gateway.commands.act, drive, verb, options, caller, admit)
        if verb in STOPPING:
            return await _answer_stop(self._begin_stop((verb, drive), acting), partial(_answer, caller))
        return _answer(caller, await acting())

    def _begin_stop(self, what: object, work: Callable[[], Coroutine[Any, Any, R]]) -> asyncio.Future[R]:
        """Start a stop; `what` says which drives it stops, and how."""
        return self._stops.begin(what, lambda: supervisor().start("stop", work()))

    def _admission(self, drive: str, command: object, body: Mapping[str, Any]) -> Admit:
        """Return a function that admits a command only if its sender has seen recent values of the plant."""
        frames = self._gateway.seen_frames
        return lambda what: frames.admit(drive, what, (drive, command), frame_in(body))

    async def reload(self, request: Request) -> Response:
        if (await body_of(request)).get("confirm") is not True:
            raise Denied(
                400, 'a reload can change the polled drives: confirm it with {"confirm": true} in the body'
            )
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
        """Log in: store the request's token in a cookie that scripts cannot read.

        After several wrong tokens, an address must wait before its next attempt. A request whose body says
        that the token is for a stop is answered at once.
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
    """Answers `/api/frame?after=N` as soon as the newest message has another number than N."""

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
            is_gzipped = takes_gzip(Headers(scope=scope))
            status, headers = 200, _GZIPPED if is_gzipped else _PLAIN
            body = frame.gzipped if is_gzipped else frame.plain
            headers = [*headers, (b"content-length", str(len(body)).encode())]
        await send({"type": "http.response.start", "status": status, "headers": headers})
        await send({"type": "http.response.body", "body": body})
