"""The HTTP API as data: all routes, and the JSON schemas of their bodies and answers.

The router, the guard and `openapi.json` are made from the table OPERATIONS.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from multidrop.gateway.commands import STOPPING
from multidrop.gateway.http.connections import MAY_STOP
from multidrop.gateway.http.files import TYPES
from multidrop.gateway.http.guard import RouteAccess
from multidrop.gateway.http.rights import COMMAND_ID, Right
from multidrop.gateway.live.alarms import KINDS
from multidrop.gateway.live.hub import STATES

Schema = Mapping[str, Any]


def record(texts: str = "", /, **fields: Schema) -> Schema:
    """Return the schema of an object whose keys are required. `texts` names the keys with string values."""
    return {**some(texts, **fields), "required": [*texts.split(), *fields]}


def some(texts: str = "", /, **fields: Schema) -> Schema:
    """Return the schema of an object whose keys are optional. `texts` names the keys with string values."""
    return {"type": "object", "properties": dict.fromkeys(texts.split(), TEXT) | fields}


def listed(schema: Schema) -> Schema:
    return {"type": "array", "items": schema}


def by_name(schema: Schema) -> Schema:
    """Return the schema of an object whose keys are names, such as those of drives."""
    return {"type": "object", "additionalProperties": schema}


def maybe(schema: Schema) -> Schema:
    return {"anyOf": [schema, {"type": "null"}]}


TEXT: Schema = {"type": "string"}
GIVEN: Schema = {"type": "string", "minLength": 1}
NUMBER: Schema = {"type": "number"}
WHOLE: Schema = {"type": "integer"}
FLAG: Schema = {"type": "boolean"}
ANY: Schema = {}
TEXTS = listed(TEXT)
TEXT_BY_NAME = by_name(TEXT)
COUNTS = by_name(WHOLE)
NUMBERS = listed(maybe(NUMBER))
TIME: Schema = {"type": "string", "format": "date-time"}
MS: Schema = {"type": "integer", "description": "UTC in ms since 1970"}
MOMENT: Schema = {
    "anyOf": [{"type": "integer"}, {"type": "string", "format": "date"}, TIME],
    "description": "ISO 8601 text, in UTC unless it has an offset, or ms since 1970",
    "examples": ["2026-11-22T09:30:00Z", "1795253400000"],
}
ID: Schema = {
    "type": "string",
    "pattern": f"^{COMMAND_ID.pattern}$",
    "description": "The command's id, of your choice or made by the gateway, also in log and audit log",
}
SEEN: Schema = {
    "type": "integer",
    "minimum": 0,
    "maximum": (1 << 63) - 1,
    "description": "The number n of the newest frame that you have received",
}
ERROR = record("error")

# ---- plant ----

LANGUAGE: Schema = {
    **TEXT,
    "description": "The language of the registers' titles; by default that of the header Accept-Language",
    "examples": ["ru"],
}
_REGISTER = record(
    "name title unit access place note",
    digits=maybe(WHOLE),
    kind={"enum": ["number", "bits", "words"]},
    words=TEXT_BY_NAME,
    least=maybe(NUMBER),
    most=maybe(NUMBER),
    at_least=maybe(TEXT),
    at_most=maybe(TEXT),
    step=maybe(NUMBER),
    period_s=maybe(NUMBER),
    holds_s=maybe(NUMBER),
)
_DRIVE = record(
    "name family title speed",
    address=WHOLE,
    key=record(frequency=maybe(TEXT), current=maybe(TEXT), setpoint=maybe(TEXT)),
    registers=listed(_REGISTER),
    verbs=TEXTS,
)
PLANT = record(
    "version name",
    revision=WHOLE,
    demo=FLAG,
    file=FLAG,
    history=FLAG,
    fleet=FLAG,
    fleet_stop=FLAG,
    mistakes=TEXTS,
    may=record(role=maybe({"enum": ["look", "stop", "write"]}), write=TEXTS, verbs=TEXTS),
    lines=listed(record("name port speed", drives=listed(_DRIVE))),
)

# ---- live values ----

ALARM = record(
    "id drive text line by note",
    time=TIME,
    ended=maybe(TIME),
    kind={"enum": [*KINDS]},
    is_before=FLAG,
    acknowledged=maybe(TIME),
)
ALARMS = record(alarms=listed(ALARM), since=TIME)
_VALUE: Schema = {
    "type": "array",
    "items": {"type": ["number", "string", "null"]},
    "minItems": 2,
    "maxItems": 5,
    "description": "value, index of its age; of a missing value also status, last value, index of its age",
}
_SHOWN = some(
    "note",
    state={"enum": [*STATES]},
    fault=maybe(TEXT),
    why=maybe(TEXT),
    seen=maybe(WHOLE),
    ages_ms=listed(WHOLE),
    values=by_name(_VALUE),
    stops=WHOLE,
    missed=maybe(NUMBER),
    p99=maybe(NUMBER),
)
_LINE = some(
    used=maybe(NUMBER),
    planned=NUMBER,
    rate=maybe(NUMBER),
    p99=maybe(NUMBER),
    misses=maybe(WHOLE),
    lost=maybe(TEXT),
)
FRAME: Schema = {
    **some(
        n=WHOLE,
        since=WHOLE,
        revision=WHOLE,
        time=TIME,
        drives=by_name(_SHOWN),
        lines=by_name(_LINE),
        alarms=listed(ALARM),
        troubles=TEXTS,
    ),
    "required": ["n"],
    "description": "With `since`, only what has changed since that frame",
}
_USUAL = {"p50": maybe(NUMBER), "p99": maybe(NUMBER)}
DRIVE = record(
    "drive",
    delays=maybe(record(**_USUAL, longest=NUMBER, replies=WHOLE, counts=listed(listed(NUMBER)))),
    misses=COUNTS,
    asked=WHOLE,
    timeout_ms=maybe(NUMBER),
    values=by_name(
        {
            **listed({"type": ["number", "string", "null"]}),
            "minItems": 3,
            "maxItems": 3,
            "description": 'value or null, UTC in ms, "ok" or the reason',
        }
    ),
    ledger=listed(record("register", year=WHOLE, budget=WHOLE, total=WHOLE)),
)
LINES = by_name(
    record(
        lost=maybe(TEXT),
        minutes=listed(record(time=MS, asked=WHOLE, misses=COUNTS)),
        drives=by_name(maybe(record(**_USUAL, asked=WHOLE, missed=WHOLE))),
    )
)
MINUTE = by_name(by_name(listed({**NUMBERS, "description": "UTC in ms, and the value or null"})))
PARAMETERS: Schema = {
    **some(
        "error saved",
        state={"enum": ["none", "reading", "failed", "read"]},
        done=WHOLE,
        total=WHOLE,
        parameters=listed({"type": "object"}),
    ),
    "required": ["state"],
}
MODBUS_MAP = listed(
    record(
        "line drive name title format order bits unit unknown note",
        tcp_port=WHOLE,
        unit_id=WHOLE,
        status_address=WHOLE,
        access={"enum": ["read", "write", "read and write"]},
        function=maybe(WHOLE),
        write_function=maybe(WHOLE),
        address=WHOLE,
        words=WHOLE,
        step=maybe(NUMBER),
        offset=NUMBER,
        scale_address=maybe(WHOLE),
        source={"enum": ["polled", "drive", "gateway"]},
    )
)
HEALTH = record(
    "version audit",
    status={"enum": ["ok", "degraded", "failed"]},
    uptime_s=NUMBER,
    newest_row=maybe(TIME),
    lines=TEXT_BY_NAME,
    parts=TEXT_BY_NAME,
    dead=TEXT_BY_NAME,
    hung=TEXT_BY_NAME,
    mistakes=TEXTS,
    restart=TEXTS,
    failures=COUNTS,
)

# ---- recorded ----

HISTORY = record(
    step_ms=NUMBER,
    series=by_name(
        record(
            time=listed(MS),
            least=NUMBERS,
            mean=NUMBERS,
            most=NUMBERS,
            missed=listed(WHOLE),
            unit=maybe(TEXT),
            left_out=TEXTS,
        )
    ),
)
TRIGGERS = record(
    triggers=listed(
        record(
            "name condition",
            time=TIME,
            **{"from": TIME, "to": TIME},
            signals=listed(record("drive register")),
        )
    )
)
AUDIT = record(entries=listed({"type": "object"}), more=FLAG)

# ---- commands ----

STOP: Schema = {
    "properties": {"drives": ANY, "id": ANY},
    "examples": [{"drives": ["pump-1"]}, {"drives": None}],
    "description": "drives: a name, a list of names, or null for all drives",
}
WRITE: Schema = {
    **some(drive=GIVEN, register=GIVEN, value=NUMBER, seen=SEEN, id=maybe(ID)),
    "required": ["drive", "register", "value", "seen"],
}


def _act(verbs: list[str], options: Schema, *required: str) -> Schema:
    fields = some(drive=GIVEN, verb={"enum": verbs}, options=options, seen=SEEN, id=maybe(ID))
    return {**fields, "required": ["drive", "verb", *required]}


_NO_OPTIONS: Schema = {"type": "object", "additionalProperties": False}
_TURN = {**some(direction={"enum": ["forward", "reverse", None]}), "additionalProperties": False}
_HERTZ = {**record(hz=NUMBER), "additionalProperties": False}
ACT: Schema = {
    "oneOf": [
        _act(["start", "jog"], _TURN, "seen"),
        _act(["set_frequency"], _HERTZ, "options", "seen"),
        _act(["reset_fault"], _NO_OPTIONS, "seen"),
        {**some(drive=GIVEN, verb={"enum": sorted(STOPPING)}), "required": ["drive", "verb"]},
    ]
}
COMMANDED = record("text", done=FLAG, id=ID)
STOPPED = by_name(COMMANDED)
FLEET_STOPPED = by_name(record("text", done=FLAG))
ACKNOWLEDGE: Schema = {**some(alarm=GIVEN, note={"type": "string", "maxLength": 500}), "required": ["alarm"]}
RELOAD: Schema = record(confirm={"const": True})
RELOADED = record("text", done=FLAG, mistakes=TEXTS, restart=TEXTS)
TOKEN = record(token=GIVEN)
LOGGED_IN = record("name", role={"enum": ["look", "stop", "write"]})

# ---- routes ----

WITH_BODY = (400, 408, 413)  # HTTP statuses for a body that is invalid, arrives too late or is too long
FRAME_PATH = "/api/frame"
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
    """One HTTP route: the method of `Pages` that answers it, who may use it, and its description for clients.

    `refusals` has the HTTP statuses of other answers, except those with which the guard may refuse any
    request.
    """

    path: str  # `{name}` matches the rest of a request's path
    handler: str
    summary: str
    answer: Schema | None  # a successful answer in JSON; None: the answer has another media type
    refusals: tuple[int, ...] = ()
    right: Right | None = Right.LOOK  # None: no token is checked
    others: Mapping[str, Schema] = {}  # successful answers of other media types
    query: Mapping[str, Schema] = {}
    required: tuple[str, ...] = ()  # names of the parameters in `query` that a request must have
    body: Schema | None = None  # the body of a POST; None: the route is a GET

    @property
    def method(self) -> str:
        return "GET" if self.body is None else "POST"


SPAN = {"from": MOMENT, "to": MOMENT}
SERIES = {"series": listed({"type": "string", "examples": ["pump-1.output_frequency"]})}
FILE: Schema = {"type": "string", "format": "binary"}

OPERATIONS = (
    Operation("/", "index", "The page.", None, (304, 404), None, {"text/html": ANY}),
    Operation(
        "/page/{name}",
        "file",
        "A file of the page.",
        None,
        (304, 404),
        right=None,
        others=dict.fromkeys(("text/plain", *TYPES.values()), ANY),
    ),
    Operation("/openapi.json", "openapi", "This description.", {"type": "object"}, right=None),
    Operation(
        "/api/plant",
        "plant",
        "Lines, drives and registers, and what the caller may do.",
        PLANT,
        query={"lang": LANGUAGE},
    ),
    Operation(
        FRAME_PATH,
        "frame",
        "Wait for a frame, a snapshot of all polled values, after the frame with this number.",
        FRAME,
        (304, 400),
        query={"after": {"type": "integer"}},
    ),
    Operation(
        "/api/drive/{name}",
        "drive",
        "Delays, misses, EEPROM writes and unpolled registers of a drive.",
        DRIVE,
        (404,),
    ),
    Operation(
        "/api/parameters/{name}",
        "parameters",
        "A drive's parameters, or with `format` a file of them. With `read`, start to read them first.",
        PARAMETERS,
        (400, 404, 409),
        others={"application/toml": FILE, "text/csv": FILE},
        query={"read": ANY, "format": {"enum": ["toml", "csv"]}},
    ),
    Operation(
        "/api/lines",
        "lines",
        "Misses by reason for each of the last 60 minutes, and delays by drive.",
        LINES,
    ),
    Operation("/api/minute", "minute", "The last minute of each drive's frequency.", MINUTE),
    Operation("/api/fleet", "fleet", "Gateways and lines of a fleet.", {"type": "object"}, (404,)),
    Operation(
        "/api/modbus-map",
        "modbus_map",
        "The addresses of all values of the Modbus server, for import into SCADA systems.",
        MODBUS_MAP,
        (400, 404),
        others={"text/csv": FILE},
        query={"format": {"enum": ["json", "csv"], "default": "json"}},
    ),
    Operation(
        "/api/history",
        "history",
        "Recorded values, reduced to `points` buckets of each series.",
        HISTORY,
        (400, 404),
        query=SERIES | SPAN | {"points": {"type": "integer", "default": 800}},
        required=("series", "from", "to"),
    ),
    Operation(
        "/api/export",
        "export",
        "Recorded rows of these series, or of all, as a file.",
        None,
        (400, 404),
        others={"text/csv": FILE, "application/vnd.apache.parquet": FILE},
        query=SERIES | SPAN | {"format": {"enum": ["csv", "parquet"], "default": "csv"}},
        required=("from", "to"),
    ),
    Operation(
        "/api/audit",
        "audit",
        "Records of writes and stops, newest first.",
        AUDIT,
        (400,),
        query={"before": MOMENT, "count": {"type": "integer", "default": 200}},
    ),
    Operation(
        "/api/alarms",
        "alarms",
        "Alarms, newest first; complete from `since` on.",
        ALARMS,
        (400,),
        query=SPAN,
        required=("from", "to"),
    ),
    Operation("/api/triggers", "triggers", "The last trigger of each name, newest first.", TRIGGERS),
    Operation("/health", "health", "The gateway's health. The status is 503 if it has failed.", HEALTH),
    Operation(
        "/metrics",
        "metrics",
        "Metrics for Prometheus.",
        None,
        others={"text/plain": ANY, "application/openmetrics-text": ANY},
    ),
    Operation(
        "/api/stop",
        "stop",
        "Stop drives. An invalid or missing body stops all of them.",
        STOPPED,
        (404,),
        Right.STOP,
        body=STOP,
    ),
    Operation(
        "/api/fleet/stop",
        "stop_fleet",
        "Stop all drives of the fleet.",
        FLEET_STOPPED,
        (404,),
        Right.STOP,
        body=ANY,
    ),
    Operation(
        "/api/write",
        "write",
        "Write a register once.",
        COMMANDED,
        (404, *WITH_BODY),
        Right.WRITE,
        body=WRITE,
    ),
    # the right to stop is enough for stop verbs; `Commands` checks the right that each verb needs
    Operation(
        "/api/act", "act", "Carry out a verb once.", COMMANDED, (404, *WITH_BODY), Right.STOP, body=ACT
    ),
    Operation(
        "/api/acknowledge",
        "acknowledge",
        "Mark an alarm as seen.",
        ALARM,
        (404, *WITH_BODY),
        Right.STOP,
        body=ACKNOWLEDGE,
    ),
    Operation(
        "/api/reload", "reload", "Reload the plant file.", RELOADED, WITH_BODY, Right.WRITE, body=RELOAD
    ),
    Operation(
        "/api/token",
        "token",
        "Store a token in a cookie.",
        LOGGED_IN,
        (401, 429, *WITH_BODY),
        None,
        body=TOKEN,
    ),
    Operation("/api/forget", "forget", "Remove the cookie with the token.", ANY, right=None, body=ANY),
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
            "schemas": {"Error": ERROR},
            "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}},
        },
    }


def _described(one: Operation) -> dict[str, Any]:
    in_path = {"name": GIVEN} if "{name}" in one.path else {}
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
    found: dict[str, Any] = {"200": {"description": "Done.", "content": _content(one)}}
    for status in sorted({*one.refusals, *_of_the_guard(one)}):
        described: dict[str, Any] = {"description": REASONS[status]}
        found[str(status)] = described if status == 304 else {**described, "content": error}
    if one.handler == "health":
        found["503"]["content"] = _content(one)
    return found


def _content(one: Operation) -> dict[str, Any]:
    in_json = {} if one.answer is None else {"application/json": one.answer}
    return {media: {"schema": schema} for media, schema in {**in_json, **one.others}.items()}


def _of_the_guard(one: Operation) -> set[int]:
    """Return the HTTP statuses with which the guard may refuse a request to this route."""
    found = {403, 421, 503}
    if one.right is not None:
        found |= {401}
    if one.path not in MAY_STOP:
        found |= {HEADERS_TOO_LONG}
        found |= {429} if one.right is not None else set()
    return found | ({415} if one.method == "POST" else set())
