"""The hub's sink in PostgreSQL: rows and the position in the stream, stored in one transaction.

The table `multidrop.hub` has one row: the stream, the position of the last stored message, and the
sources. If another hub has changed that position, the transaction is refused. Only one hub writes at a
time; other hubs wait until it ends. The other tables are those of `samples/sample_tables.py`.
"""

from __future__ import annotations

import json

import psycopg

from multidrop.fleet.samples.hub import Commit, NotThisHubs, StoredPosition
from multidrop.samples import SinkError
from multidrop.samples.sample_tables import SampleTables, sentences

# Take a lock that only one hub at a time can hold, for as long as its connection lasts. The server drops a
# dead connection after 25 s.
TAKEN = """
set tcp_keepalives_idle = 10; set tcp_keepalives_interval = 5; set tcp_keepalives_count = 3;
set lock_timeout = '3s'; select pg_advisory_lock(hashtext('multidrop hub that writes')); set lock_timeout = 0
"""
POSITION = "multidrop.hub"
COLUMNS = (
    "id boolean primary key default true check (id),"
    " stream text not null, place bigint not null, sources jsonb not null"
)
MOVE = "update multidrop.hub set place = %s, sources = %s where stream = %s and place = %s"


class PostgresSink:
    """Writes the hub's samples to a PostgreSQL database, each call's rows in one transaction.

    `where` is a connection string, such as "dbname=plant".
    """

    def __init__(self, where: str) -> None:
        self._tables = SampleTables(where, "multidrop hub")

    def close(self) -> None:
        self._tables.close()

    def begin(self, stream: str) -> StoredPosition:
        """Reconnect and create missing tables. Return the stream position up to which samples are stored."""
        with sentences():
            connection = self._tables.open()
            try:
                connection.execute(TAKEN)
            except psycopg.errors.LockNotAvailable as failure:
                raise SinkError("another hub writes into this database; waiting until it ends") from failure
            with connection.transaction():
                return self._begin(stream)

    def _begin(self, stream: str) -> StoredPosition:
        self._tables.prepare(POSITION, COLUMNS)
        first = (
            "insert into multidrop.hub (stream, place, sources) values (%s, 0, '{}') on conflict do nothing"
        )
        self._tables.connection.execute(first, (stream,))
        found = self._tables.connection.execute("select stream, place, sources from multidrop.hub").fetchone()
        assert found is not None
        if found[0] != stream:
            raise NotThisHubs(
                f"the database holds samples of a stream created at {found[0]}, but the present stream was "
                f"created at {stream}: name another database"
            )
        return StoredPosition(found[1], found[2])

    def write(self, commit: Commit) -> None:
        with sentences(), self._tables.connection.transaction():
            moved = self._tables.connection.execute(
                MOVE, (commit.last, json.dumps(commit.sources), commit.stream, commit.first - 1)
            )
            if moved.rowcount != 1:
                raise SinkError("another hub writes into this database: stop one of them")
            self._tables.insert(commit.tables)
