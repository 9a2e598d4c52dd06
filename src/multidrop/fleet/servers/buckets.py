"""Buckets of records by key, each in a NATS stream. A record is replaced only at a known revision.

Records are read without a NATS consumer. Any user with write access to a bucket can write any bytes, so each
record is checked. An invalid record is ignored, and does not affect other records.
"""

from __future__ import annotations

import asyncio
import base64
import json
import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any, NamedTuple, get_args

from multidrop.fleet.errors import Conflict, FleetError, OutcomeUnknown
from multidrop.fleet.servers import names
from multidrop.fleet.servers.batch_client import Request
from multidrop.fleet.servers.connections import ANSWER_S, ServerPath

NONE_YET = 0  # revision of a key that has no record
BATCH = 1000  # limit of records in one read
FOLLOW_S = 0.2  # pause between reads of a bucket's changes
MOST_STRANGE = 1000  # limit of logged invalid records in each bucket
_WRONG_REVISION = (10071, 10164)
_NO_MESSAGE = 10037
_NO_STREAM = 10059
_UNAVAILABLE = 10008  # JetStream's error code if a bucket has no leader, and its servers can elect none
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
MOST_TEXT = 300  # limit, in characters, of each text in a gateway's state
# Limits of a record in bytes. The large one is for lines: a line's record contains the files that describe
# its drive families.
SMALL, LARGE = 1 << 14, 1 << 20
_KINDS: Mapping[Any, str] = {
    **{int: "a whole number", float: "a number", str: "a text", bool: "true or false", dict: "a table"},
    **{int | None: "a whole number or null", float | None: "a number or null", str | None: "a text or null"},
}

_log = logging.getLogger("multidrop.fleet")


class Record(NamedTuple):
    """A key's newest value, and the revision (sequence number) that the server gave it.

    The value is None for a removed and for an invalid record.
    """

    key: str
    revision: int
    value: Any


class WriteAnswers(NamedTuple):
    """The outcome of writes: replaced records with their new revisions, and keys of refused records.

    The outcome for all other records is unknown.
    """

    stored: list[Record]
    refused: set[str]


def bucket_settings(name: str, replicas: int) -> dict[str, Any]:
    """Return the settings of a bucket's stream.

    The stream keeps the newest record of each subject on disk. No client may remove a record.
    """
    return {
        "name": f"KV_{name}",
        "subjects": [f"$KV.{name}.>"],
        "max_msgs_per_subject": 1,
        "discard": "new",
        "storage": "file",
        "num_replicas": replicas,
        "allow_rollup_hdrs": False,
        "deny_delete": True,
        "deny_purge": True,
        "max_msg_size": largest(name),
        "allow_direct": True,
        "max_bytes": -1,
        "max_msgs": -1,
        "max_age": 0,
    }


async def ask(
    path: ServerPath, subject: str, data: Mapping[str, Any] | None = None, answer_s: float = ANSWER_S
) -> dict[str, Any]:
    """Return JetStream's answer to a request about streams.

    Raises ServerError for an error, OutcomeUnknown if the servers cannot decide or the answer is invalid.
    """
    sent = json.dumps(data).encode() if data else b""
    message = await path.request(f"$JS.API.{subject}", sent, answer_s=answer_s)
    said = parsed_answer(message.data)
    error = said.get("error")
    if error and error.get("err_code") == _UNAVAILABLE:
        raise OutcomeUnknown(f"{path.url} says: {error.get('description')}")
    if error:
        raise ServerError(error)
    return said


def parsed_answer(data: bytes) -> dict[str, Any]:
    """Return the JSON object in an answer. Raises OutcomeUnknown for any other bytes."""
    with suppress(ValueError, RecursionError):
        found = json.loads(data)
        if isinstance(found, dict) and isinstance(found.get("error") or {}, dict):
            return found
    raise OutcomeUnknown("the answer of NATS is not a JetStream answer")


def _revision(said: Mapping[str, Any]) -> int:
    revision = said.get("seq")
    if type(revision) is not int:
        raise OutcomeUnknown("the answer of NATS has no sequence number")
    return revision


class ServerError(FleetError):
    """An error reported by JetStream, with its error code."""

    def __init__(self, error: Mapping[str, Any]) -> None:
        super().__init__(f"NATS refuses: {error.get('description', error)}")
        self.code = error.get("err_code", 0)

    @property
    def is_missing(self) -> bool:
        return self.code in (_NO_STREAM, _NO_MESSAGE)


class Bucket:
    """A bucket of records on NATS servers. `path` returns the server connection to use for each request."""

    def __init__(self, name: str, path: Callable[[], ServerPath]) -> None:
        self.name = name
        self.path = path
        self._strange: set[str] = set()  # keys of invalid records that were already logged

    async def put(self, key: str, value: Any, revision: int) -> int:
        """Replace the record if it has exactly this revision, and return its new revision.

        Raises Conflict if it has another revision, OutcomeUnknown if the outcome is unknown.
        """
        message = await self.path().request(*self._put(Record(key, revision, value)))
        said = parsed_answer(message.data)
        error = said.get("error")
        if not error:
            return _revision(said)
        if error.get("err_code") in _WRONG_REVISION:
            raise Conflict(f"the record {self.name}.{key} has changed since revision {revision}")
        raise OutcomeUnknown(f"NATS did not store {self.name}.{key}: {error.get('description')}")

    async def put_all(self, records: Sequence[Record]) -> WriteAnswers:
        """Replace each record that still has its given revision. All requests are sent together."""
        answers = await self.path().request_all([self._put(record) for record in records])
        written = WriteAnswers([], set())
        for record, answer in zip(records, answers, strict=True):
            with suppress(OutcomeUnknown):
                said = parsed_answer(answer or b"")
                if not said.get("error"):
                    written.stored.append(record._replace(revision=_revision(said)))
                elif said["error"].get("err_code") in _WRONG_REVISION:
                    written.refused.add(record.key)
        return written

    def _put(self, record: Record) -> Request:
        value = record.value
        return Request(
            self._subject(record.key),
            b"" if value is None else json.dumps(value, separators=(",", ":")).encode(),
            {
                "Nats-Expected-Last-Subject-Sequence": str(record.revision),
                "Nats-Expected-Last-Subject-Sequence-Subject": self._pattern(record.key),
            },
        )

    async def get(self, key: str) -> Record:
        """Return a key's record, read from the bucket's leader; a missing record has revision 0."""
        wanted = {"last_by_subj": self._pattern(key)}
        try:
            said = await ask(self.path(), f"STREAM.MSG.GET.KV_{self.name}", wanted)
        except ServerError as failure:
            if failure.code == _NO_MESSAGE:
                return Record(key, NONE_YET, None)
            raise
        try:
            found = said["message"]
            subject, data = str(found["subject"]), base64.b64decode(found.get("data", ""))
        except (AttributeError, KeyError, TypeError, ValueError):
            raise OutcomeUnknown(f"the answer of NATS about {self.name}.{key} is not a record") from None
        return self._record(subject, _revision(found), data)

    async def changes(self, after: int) -> list[Record]:
        """Return at most 1000 records whose revision is above `after`, in the order of revisions.

        Any server may answer, so some records may be out of date. The server keeps no state between calls.
        """
        return await self._direct_get({"seq": after + 1, "batch": BATCH, "next_by_subj": ">"})

    async def newest(self, keys: Sequence[str]) -> list[Record]:
        """Return the records of at most 1000 keys. Any server may answer, so some may be out of date."""
        return await self._direct_get({"multi_last": [self._pattern(key) for key in keys]})

    async def _direct_get(self, wanted: Mapping[str, Any]) -> list[Record]:
        subject = f"$JS.API.DIRECT.GET.KV_{self.name}"
        messages = await self.path().collect(subject, json.dumps(wanted).encode())
        return [self._record(*message) for message in messages]

    def _subject(self, key: str) -> str:
        return f"$KV.{self.name}.{key}"

    def _pattern(self, key: str) -> str:
        """Return a pattern that matches each NATS subject on which the key's record may be written."""
        return self._subject(key)

    def _record(self, subject: str, revision: int, data: bytes) -> Record:
        key = subject.removeprefix(f"$KV.{self.name}.")
        return Record(key, revision, self._value(key, data))

    def _value(self, key: str, data: bytes) -> Any:
        """Return a record's value; None for an invalid record, which is logged once."""
        value, mistake = parsed(self.name, key, data)
        if not mistake:
            self._strange.discard(key)
        elif key not in self._strange and len(self._strange) < MOST_STRANGE:
            self._strange.add(key)
            _log.warning("ignored the record %s of the bucket %s: %s", key, self.name, mistake)
        return value


OnTake = Callable[[Record | None, Record], object]


class Follower:
    """A local copy of a bucket's records by key.

    `on_take` is called with the former and the new record whenever a newer record was read.
    """

    def __init__(self, bucket: Bucket, on_take: OnTake = lambda *_: None) -> None:
        self.bucket = bucket
        self._on_take = on_take
        self.records: dict[str, Record] = {}
        self._after = 0

    async def look(self) -> list[Record]:
        """Read all changes since the last call, and return them."""
        changed: list[Record] = []
        while True:
            found = await self.bucket.changes(self._after)
            changed += [record for record in found if self.take(record)]
            if found:
                self._after = found[-1].revision
            if len(found) < BATCH:
                return changed

    async def rest(self) -> None:
        await asyncio.sleep(FOLLOW_S)

    def take(self, record: Record) -> bool:
        """Store a record in `records` unless a newer record of its key was read before.

        Return True if it was stored.
        """
        before = self.records.get(record.key)
        if before is not None and before.revision >= record.revision:
            return False
        self.records[record.key] = record
        self._on_take(before, record)
        return True


class LeaseBucket(Bucket):
    """A bucket of leases, to which the gateway `writer` writes records.

    A record's subject is `<gateway>.<writer>`: the gateway whose lease it is, and the gateway that has
    written it. Servers let a gateway write only with its own name as the writer. The newest record of a
    gateway is the valid one, whoever has written it. A write must state the revision of that record. If the
    newest record is from another gateway, it ends the session, whatever it contains.
    """

    def __init__(self, name: str, path: Callable[[], ServerPath], writer: str) -> None:
        super().__init__(name, path)
        self.writer = writer

    def _subject(self, key: str) -> str:
        return f"$KV.{self.name}.{key}.{self.writer}"

    def _pattern(self, key: str) -> str:
        return f"$KV.{self.name}.{key}.*"

    def _record(self, subject: str, revision: int, data: bytes) -> Record:
        key, _, writer = subject.removeprefix(f"$KV.{self.name}.").rpartition(".")
        value = self._value(key, data)
        if value is not None:
            value = {name: one for name, one in value.items() if name != "by"}
            if writer != key:
                value |= {"ended": True, "by": writer}
        return Record(key, revision, value)


# ---- the shapes of records ----


def largest(bucket: str) -> int:
    """Return the limit of a record's size in this bucket, in bytes."""
    return LARGE if bucket == names.PLANT else SMALL


def parsed(bucket: str, key: str, data: bytes) -> tuple[Any, str]:
    """Return a record's value and ""; for an invalid record, None and the reason.

    For a removed record, return None and "".
    """
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
    mistake = misshapen(value, SHAPES.get(bucket, {}))
    if not mistake and bucket in _CHECKS:
        mistake = _CHECKS[bucket](key, value)
    return (None if mistake else value), mistake


def misshapen(value: Any, shape: Mapping[str, Any]) -> str:
    """Return how a JSON value differs from a required shape; "" if it fits. Further entries are allowed."""
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
