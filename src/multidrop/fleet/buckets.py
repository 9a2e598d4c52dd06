"""Buckets: records by key, replaced only at a known revision, and followed without a consumer on a server."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from nats.aio.msg import Msg

from multidrop.fleet.errors import Conflict, FleetError, Unsure
from multidrop.fleet.servers import ServerPath

NONE_YET = 0  # the revision of a key without a record
BATCH = 1000  # records asked for at a time
_WRONG_REVISION = (10071, 10164)
_NO_MESSAGE = 10037
_NO_STREAM = 10059


class Record(NamedTuple):
    """A key's newest value, and the sequence at which the server stored it; None: removed."""

    key: str
    revision: int
    value: Any


def bucket_settings(name: str, replicas: int) -> dict[str, Any]:
    """Return the stream that a bucket is: the newest record of each key, on disk, on so many servers."""
    return {
        "name": f"KV_{name}",
        "subjects": [f"$KV.{name}.>"],
        "max_msgs_per_subject": 1,
        "discard": "new",
        "storage": "file",
        "num_replicas": replicas,
        "allow_rollup_hdrs": True,
        "deny_delete": True,
        "allow_direct": True,
        "max_bytes": -1,
        "max_msgs": -1,
        "max_age": 0,
    }


async def ask(path: ServerPath, subject: str, data: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return what JetStream says to a request about streams; FleetError with its own words for an error."""
    message = await path.request(f"$JS.API.{subject}", json.dumps(data).encode() if data else b"")
    said: dict[str, Any] = json.loads(message.data)
    if "error" in said:
        raise ServerError(said["error"])
    return said


class ServerError(FleetError):
    """JetStream's refusal, with its code."""

    def __init__(self, error: Mapping[str, Any]) -> None:
        super().__init__(f"NATS refuses: {error.get('description', error)}")
        self.code = error.get("err_code", 0)

    @property
    def is_missing(self) -> bool:
        return self.code in (_NO_STREAM, _NO_MESSAGE)


class Bucket:
    """One bucket; the path on which it is reached is looked up each time."""

    def __init__(self, name: str, path: Callable[[], ServerPath]) -> None:
        self.name = name
        self.path = path

    async def put(self, key: str, value: Any, revision: int) -> int:
        """Replace the record at this very revision, and return the new one.

        Raises Conflict where it has another, Unsure where it may or may not have been replaced.
        """
        headers = {"Nats-Expected-Last-Subject-Sequence": str(revision)}
        data = b"" if value is None else json.dumps(value, separators=(",", ":")).encode()
        message = await self.path().request(f"$KV.{self.name}.{key}", data, headers)
        said = json.loads(message.data)
        error = said.get("error")
        if error is None:
            return int(said["seq"])
        if error.get("err_code") in _WRONG_REVISION:
            raise Conflict(f"{self.name}.{key} has another revision than {revision}")
        raise Unsure(f"NATS did not store {self.name}.{key}: {error.get('description')}")

    async def get(self, key: str) -> Record:
        """Return the record as the bucket's leader has it; revision 0 for none."""
        wanted = {"last_by_subj": f"$KV.{self.name}.{key}"}
        try:
            said = await ask(self.path(), f"STREAM.MSG.GET.KV_{self.name}", wanted)
        except ServerError as failure:
            if failure.code == _NO_MESSAGE:
                return Record(key, NONE_YET, None)
            raise
        found = said["message"]
        return Record(key, int(found["seq"]), _value(base64.b64decode(found.get("data", ""))))

    async def changes(self, after: int) -> list[Record]:
        """Return the records with a higher revision, as any of the servers has them: some may be old.

        At most 1000 at a time, in order. Nothing is kept for it on a server.
        """
        wanted = {"seq": after + 1, "batch": BATCH, "next_by_subj": f"$KV.{self.name}.>"}
        subject = f"$JS.API.DIRECT.GET.KV_{self.name}"
        messages = await self.path().collect(subject, json.dumps(wanted).encode(), _is_end)
        return [_record(message, self.name) for message in messages]


class Follower:
    """The records of a bucket, by key, as far as they were read."""

    def __init__(self, bucket: Bucket) -> None:
        self.bucket = bucket
        self.records: dict[str, Record] = {}
        self._after = 0

    async def look(self) -> list[Record]:
        """Read all that changed since, and return it."""
        changed: list[Record] = []
        while True:
            found = await self.bucket.changes(self._after)
            changed += [record for record in found if self.take(record)]
            if found:
                self._after = found[-1].revision
            if len(found) < BATCH:
                return changed

    def take(self, record: Record) -> bool:
        """Keep a record unless a newer one is known."""
        before = self.records.get(record.key)
        if before is not None and before.revision >= record.revision:
            return False
        self.records[record.key] = record
        return True


def _is_end(message: Msg) -> bool:
    headers = message.headers or {}
    return headers.get("Status") in ("204", "404", "408")


def _record(message: Msg, bucket: str) -> Record:
    headers = message.headers or {}
    key = headers["Nats-Subject"].removeprefix(f"$KV.{bucket}.")
    return Record(key, int(headers["Nats-Sequence"]), _value(message.data))


def _value(data: bytes) -> Any:
    """Return the value; None for a record that was removed, or that is no JSON of ours."""
    try:
        return json.loads(data) if data else None
    except ValueError:
        return None
