"""LeaseBucket: sessions of gateways, with subjects by which servers know who wrote a record.

The subject of a record is `<gateway>.<writer>`; the newest of all writers' counts, and each is replaced at
its revision alone. A gateway may write in its own name only, so what another one writes is the end of a
session, whatever it says.
"""

from __future__ import annotations

from collections.abc import Callable

from multidrop.fleet.errors import Conflict
from multidrop.fleet.servers.buckets import Bucket, Record
from multidrop.fleet.servers.connections import ServerPath


class LeaseBucket(Bucket):
    """A bucket of leases, written to in the name of `writer`."""

    def __init__(self, name: str, path: Callable[[], ServerPath], writer: str) -> None:
        super().__init__(name, path)
        self.writer = writer

    def _subject(self, key: str) -> str:
        return f"$KV.{self.name}.{key}.{self.writer}"

    def _all_of(self, key: str) -> str:
        return f"$KV.{self.name}.{key}.*"

    def _record(self, subject: str, revision: int, data: bytes) -> Record:
        key, _, writer = subject.removeprefix(f"$KV.{self.name}.").rpartition(".")
        value = self._value(key, data)
        if value is not None:
            value = {name: one for name, one in value.items() if name != "by"}
            if writer != key:
                value |= {"ended": True, "by": writer}
        return Record(key, revision, value)


async def put_end(bucket: Bucket, end: Record) -> None:
    """Replace our own record by this end of its session. Raises Conflict and FleetError as `put` does.

    A renewal whose answer nobody waited for any more may have been stored meanwhile. It is replaced too.
    """
    try:
        await bucket.put(end.key, end.value, end.revision)
    except Conflict:
        newest = await bucket.get(end.key)
        if not newest.value or newest.value["ended"] or newest.value["nonce"] != end.value["nonce"]:
            raise
        await bucket.put(end.key, end.value, newest.revision)
