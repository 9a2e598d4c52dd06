"""The table of all HTTP routes: the router, the guard and `openapi.json` are made from it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from multidrop.gateway.http import schemas
from multidrop.gateway.http.connections import MAY_STOP
from multidrop.gateway.http.files import TYPES
from multidrop.gateway.http.guard import RouteAccess
from multidrop.gateway.http.rights import Right
from multidrop.gateway.http.schemas import Schema

ANY: Schema = {}
WITH_BODY = (400, 408, 413)  # HTTP statuses for a body that is invalid, arrives too late or is too long
FRAME = "/api/frame"
HEADERS_TOO_LONG = 431  # HTTP status; not used for stops, because the length of their headers is not checked
REASONS = {
    304: "The client has the newest version.",
    400: "A parameter or the body is invalid.",
    401: "A token is needed, or it is wrong.",
    403: "The caller lacks the right, or a page of another site sent the request.",
    404: "Unknown path, drive or alarm, or the plant file lacks the table for this route.",
    408: "The body did not arrive in time.",
    409: "The parameters are not read yet.",
    413: "The body is too long.",
    415: "The body must be application/json.",
    421: "The Host header does not name this gateway.",
    429: "Too many wrong tokens came from this address.",
    HEADERS_TOO_LONG: "The headers are too long.",
    503: "The gateway is shutting down, a disk does not answer, or too many other requests wait.",
}


class Operation(NamedTuple):
    """One HTTP route: who may use it, the method of `Pages` that answers it, and its description for clients.

    `answer` has the schema of a successful answer, by media type. `refusals` has the HTTP statuses of other
    answers, except those with which the guard may refuse any request.
    """

    path: str  # `{name}` matches the rest of a request's path
    handler: str
    right: Right | None  # None: no token is checked
    summary: str
    answer: Mapping[str, Schema]
    refusals: tuple[int, ...] = ()
    query: Mapping[str, Schema] = {}
    required: tuple[str, ...] = ()  # names of the parameters in `query` that a request must have
    body: Schema | None = None  # the body of a POST; None: the route is a GET

    @property
    def method(self) -> str:
        return "GET" if self.body is None else "POST"


def json_of(schema: Schema) -> dict[str, Schema]:
    return {"application/json": schema}


SPAN = {"from": schemas.MOMENT, "to": schemas.MOMENT}
SERIES = {"series": schemas.listed({"type": "string", "examples": ["pump-1.output_frequency"]})}
FILE: Schema = {"type": "string", "format": "binary"}

OPERATIONS = (
    Operation("/", "index", None, "The page.", {"text/html": ANY}, (304, 404)),
    Operation(
        "/page/{name}",
        "file",
        None,
        "A file of the page.",
        dict.fromkeys(("text/plain", *TYPES.values()), ANY),
        (304, 404),
    ),
    Operation("/openapi.json", "openapi", None, "This description.", json_of({"type": "object"})),
    Operation(
        "/api/plant",
        "plant",
        Right.LOOK,
        "Lines, drives and registers, and what the caller may do.",
        json_of(schemas.PLANT),
        query={"lang": schemas.LANGUAGE},
    ),
    Operation(
        FRAME,
        "frame",
        Right.LOOK,
        "Wait for a frame, a snapshot of all polled values, after the frame with this number.",
        json_of(schemas.FRAME),
        (304, 400),
        {"after": {"type": "integer"}},
    ),
    Operation(
        "/api/drive/{name}",
        "drive",
        Right.LOOK,
        "Delays, misses, EEPROM writes and unpolled registers of a drive.",
        json_of(schemas.DRIVE),
        (404,),
    ),
    Operation(
        "/api/parameters/{name}",
        "parameters",
        Right.LOOK,
        "A drive's parameters, or with `format` a file of them. With `read`, start to read them first.",
        json_of(schemas.PARAMETERS) | {"application/toml": FILE, "text/csv": FILE},
        (400, 404, 409),
        {"read": ANY, "format": {"enum": ["toml", "csv"]}},
    ),
    Operation(
        "/api/lines",
        "lines",
        Right.LOOK,
        "Misses by reason for each of the last 60 minutes, and delays by drive.",
        json_of(schemas.LINES),
    ),
    Operation(
        "/api/minute",
        "minute",
        Right.LOOK,
        "The last minute of each drive's frequency.",
        json_of(schemas.MINUTE),
    ),
    Operation(
        "/api/fleet",
        "fleet",
        Right.LOOK,
        "Gateways and lines of a fleet.",
        json_of({"type": "object"}),
        (404,),
    ),
    Operation(
        "/api/modbus-map",
        "modbus_map",
        Right.LOOK,
        "The addresses of all values of the Modbus server, for import into SCADA systems.",
        json_of(schemas.MODBUS_MAP) | {"text/csv": FILE},
        (400, 404),
        {"format": {"enum": ["json", "csv"], "default": "json"}},
    ),
    Operation(
        "/api/history",
        "history",
        Right.LOOK,
        "Recorded values, reduced to `points` buckets of each series.",
        json_of(schemas.HISTORY),
        (400, 404),
        SERIES | SPAN | {"points": {"type": "integer", "default": 800}},
        ("series", "from", "to"),
    ),
    Operation(
        "/api/export",
        "export",
        Right.LOOK,
        "Recorded rows of these series, or of all, as a file.",
        {"text/csv": FILE, "application/vnd.apache.parquet": FILE},
        (400, 404),
        SERIES | SPAN | {"format": {"enum": ["csv", "parquet"], "default": "csv"}},
        ("from", "to"),
    ),
    Operation(
        "/api/audit",
        "audit",
        Right.LOOK,
        "Records of writes and stops, newest first.",
        json_of(schemas.AUDIT),
        (400,),
        {"before": schemas.MOMENT, "count": {"type": "integer", "default": 200}},
    ),
    Operation(
        "/api/alarms",
        "alarms",
        Right.LOOK,
        "Alarms, newest first; complete from `since` on.",
        json_of(schemas.ALARMS),
        (400,),
        SPAN,
        ("from", "to"),
    ),
    Operation(
        "/api/triggers",
        "triggers",
        Right.LOOK,
        "The last trigger of each name, newest first.",
        json_of(schemas.TRIGGERS),
    ),
    Operation(
        "/health",
        "health",
        Right.LOOK,
        "The gateway's health. The status is 503 if it has failed.",
        json_of(schemas.HEALTH),
    ),
    Operation(
        "/metrics",
        "metrics",
        Right.LOOK,
        "Metrics for Prometheus.",
        {"text/plain": ANY, "application/openmetrics-text": ANY},
    ),
    Operation(
        "/api/stop",
        "stop",
        Right.STOP,
        "Stop drives. An invalid or missing body stops all of them.",
        json_of(schemas.STOPPED),
        (404,),
        body=schemas.STOP,
    ),
    Operation(
        "/api/fleet/stop",
        "stop_fleet",
        Right.STOP,
        "Stop all drives of the fleet.",
        json_of(schemas.FLEET_STOPPED),
        (404,),
        body=ANY,
    ),
    Operation(
        "/api/write",
        "write",
        Right.WRITE,
        "Write a register once.",
        json_of(schemas.COMMANDED),
        (404, *WITH_BODY),
        body=schemas.WRITE,
    ),
    Operation(
        "/api/act",
        "act",
        # the right to stop is enough for stop verbs; `Commands` checks the right that each verb needs
        Right.STOP,
        "Carry out a verb once.",
        json_of(schemas.COMMANDED),
        (404, *WITH_BODY),
        body=schemas.ACT,
    ),
    Operation(
        "/api/acknowledge",
        "acknowledge",
        Right.STOP,
        "Mark an alarm as seen.",
        json_of(schemas.ALARM),
        (404, *WITH_BODY),
        body=schemas.ACKNOWLEDGE,
    ),
    Operation(
        "/api/reload",
        "reload",
        Right.WRITE,
        "Reload the plant file.",
        json_of(schemas.RELOADED),
        WITH_BODY,
        body=schemas.RELOAD,
    ),
    Operation(
        "/api/token",
        "token",
        None,
        "Store a token in a cookie.",
        json_of(schemas.LOGGED_IN),
        (401, 429, *WITH_BODY),
        body=schemas.TOKEN,
    ),
    Operation("/api/forget", "forget", None, "Remove the cookie with the token.", json_of(ANY), body=ANY),
)

NEEDED: Mapping[str, RouteAccess] = {
    "/api/": RouteAccess("GET", Right.LOOK),  # for paths under /api/ that have no route
    **{one.path.partition("{")[0]: RouteAccess(one.method, one.right) for one in OPERATIONS},
}


def openapi(version: str) -> dict[str, Any]:
    """Return the description of all routes as an OpenAPI 3.1 document."""
    paths: dict[str, Any] = {}
    for one in OPERATIONS:
        paths.setdefault(one.path, {})[one.method.lower()] = _described(one)
    return {
        "openapi": "3.1.0",
        "info": {"title": "multidrop serve", "version": version},
        "paths": paths,
        "components": {
            "schemas": {"Error": schemas.ERROR},
            "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}},
        },
    }


def _described(one: Operation) -> dict[str, Any]:
    in_path = {"name": schemas.GIVEN} if "{name}" in one.path else {}
    parameters = [
        {"name": name, "in": place, "required": name in (*in_path, *one.required), "schema": schema}
        for place, found in (("path", in_path), ("query", one.query))
        for name, schema in found.items()
    ]
    found: dict[str, Any] = {
        "operationId": one.handler,
        "summary": one.summary,
        "parameters": parameters,
        "responses": _responses(one),
    }
    if one.body is not None:
        found["requestBody"] = {"required": True, "content": {"application/json": {"schema": one.body}}}
    if one.right is not None:
        # a token is optional, because the plant file may let anyone look or stop
        found["security"] = [{}, {"token": []}]
        found["description"] = f"Needs the right `{one.right.name.lower()}`."
    return found


def _responses(one: Operation) -> dict[str, Any]:
    error = {"application/json": {"schema": {"$ref": "#/components/schemas/Error"}}}
    found: dict[str, Any] = {"200": {"description": "Done.", "content": _content(one.answer)}}
    for status in sorted({*one.refusals, *_of_the_guard(one)}):
        described: dict[str, Any] = {"description": REASONS[status]}
        found[str(status)] = described if status == 304 else {**described, "content": error}
    if one.handler == "health":
        found["503"]["content"] = _content(one.answer)
    return found


def _content(answer: Mapping[str, Schema]) -> dict[str, Any]:
    return {media: {"schema": schema} for media, schema in answer.items()}


def _of_the_guard(one: Operation) -> set[int]:
    """Return the HTTP statuses with which the guard may refuse a request to this route."""
    found = {403, 421, 503}
    if one.right is not None:
        found |= {401}
    if one.path not in MAY_STOP:
        found |= {HEADERS_TOO_LONG}
        found |= {429} if one.right is not None else set()
    return found | ({415} if one.method == "POST" else set())
