"""The gateway's part `postgres`: stores all polled values in PostgreSQL, each once.

The table `multidrop.spools` has an entry for each spool, with its position: which messages the database has.
A message's rows and the new position are stored in one transaction.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field

import psycopg
from psycopg.conninfo import conninfo_to_dict

from multidrop import Plant
from multidrop.gateway.forward.forwarder import Forwarding, Outgoing, SpoolPosition
from multidrop.gateway.parts import PartContext
from multidrop.gateway.settings import parsing_mistakes, refuse, secret_in, secret_mistakes
from multidrop.recording import parse_size
from multidrop.samples import SinkError
from multidrop.samples.sample_tables import SampleTables, sentences
from multidrop.toml_check import SIZE

PASSWORDS = {"password", "sslpassword"}  # keys of a connection string that hold secrets
SPOOLS = "multidrop.spools"
COLUMNS = "log text primary key, newest bigint not null, gaps jsonb not null"
FIRST = "insert into multidrop.spools (log, newest, gaps) values (%s, 0, '[]') on conflict do nothing"
FIND = "select newest, gaps from multidrop.spools where log = %s"
MOVE = "update multidrop.spools set newest = %s, gaps = %s where log = %s and newest = %s and gaps = %s"


@dataclass(frozen=True)
class PostgresSettings:
    """The settings in the table `[serve.postgres]`. Raises ValueError with a line for each mistake."""

    database: str = "dbname=multidrop"  # connection string of libpq
    password: str = ""  # path of the file with the password
    spool: str = "spool/postgres"
    most: str = field(default="1 GB", metadata=SIZE)

    def __post_init__(self) -> None:
        wrong = [*parsing_mistakes(self, most=parse_size)]
        try:
            if PASSWORDS & conninfo_to_dict(self.database).keys():
                wrong.append('database has a password in it; write password = "FILE" instead')
        except psycopg.Error:  # do not quote the library's message, which may contain a password
            wrong.append('database is not a connection string; write database = "host=db dbname=plant"')
        refuse(wrong)

    def check(self, plant: Plant) -> Iterator[str]:
        return secret_mistakes("password", self.password, plant)


def build(settings: PostgresSettings, context: PartContext) -> Forwarding:
    """Return the forwarder to PostgreSQL. Raises OSError if the password cannot be read."""
    password = secret_in(settings.password, context.plant)
    login = {"password": password} if password else {}
    tables = SampleTables(settings.database, "multidrop serve", **login)
    folder = context.folder / settings.spool
    return Forwarding(
        "postgres", "the database", folder, settings.most, context.plant, lambda _: PostgresReceiver(tables)
    )


class PostgresReceiver:
    """Stores the rows of each message, and the spool's new position, in one transaction."""

    def __init__(self, tables: SampleTables) -> None:
        self._tables = tables
        self._log = ""
        self._kept = SpoolPosition()  # the spool's position that is stored in the database

    def begin(self, log: str) -> SpoolPosition:
        """Connect again, create missing tables, and return the position of this spool."""
        self._log = log
        with sentences(), self._tables.open().transaction():
            self._tables.prepare(SPOOLS, COLUMNS)
            self._tables.connection.execute(FIRST, (log,))
            found = self._tables.connection.execute(FIND, (log,)).fetchone()
            assert found is not None
            self._kept = SpoolPosition(found[0], tuple((first, last) for first, last in found[1]))
        return self._kept

    def write(self, message: Outgoing, after: SpoolPosition) -> None:
        positions = [(one.newest, json.dumps(one.gaps)) for one in (after, self._kept)]
        with sentences(), self._tables.connection.transaction():
            values = (*positions[0], self._log, *positions[1])
            if self._tables.connection.execute(MOVE, values).rowcount != 1:
                raise SinkError(
                    f"another program has changed the spool {self._log} in the table multidrop.spools"
                )
            self._tables.insert([message.rows])
        self._kept = after

    def close(self) -> None:
        self._tables.close()
