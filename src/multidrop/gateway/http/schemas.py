"""JSON schemas of the bodies and answers of the HTTP routes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from multidrop.gateway.commands import STOPPING
from multidrop.gateway.http.rights import COMMAND_ID
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
REASONS = by_name(TEXT)
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
    words=REASONS,
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
    lines=REASONS,
    parts=REASONS,
    dead=REASONS,
    hung=REASONS,
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
