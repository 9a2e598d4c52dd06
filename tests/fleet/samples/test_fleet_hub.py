"""The hub stores each row of the stream once, together with its stream position, and reports errors."""

from __future__ import annotations

import asyncio
import itertools
import logging
import os
from collections.abc import Iterator, Mapping
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import pytest
from nats_clusters import Cluster
from peers import require_module
from postgres_clusters import Postgres, postgres
from spooled import NOON, STEP, empty_stream, exchanges_in, numbered, rows_of

from multidrop import History
from multidrop.fleet.errors import FleetError
from multidrop.fleet.samples import hub as hub_module
from multidrop.fleet.samples import samples_stream
from multidrop.fleet.samples.hub import (
    Commit,
    HubState,
    NotThisHubs,
    ParquetSink,
    SampleHub,
    SampleSink,
    StoredPosition,
)
from multidrop.fleet.samples.postgres_sink import PostgresSink
from multidrop.fleet.samples.samples_stream import StreamMessage, publish
from multidrop.fleet.servers.connections import ServerPath
from multidrop.samples.message import RowBuffer, SinkError, unpack

LOG = "00112233aabbccdd"
PATIENCE_S = 60.0


@pytest.fixture(scope="module")
def database() -> Iterator[Postgres]:
    with postgres() as one:
        yield one


@pytest.fixture
def empty(database: Postgres) -> Postgres:
    database.ask("drop schema if exists multidrop cascade")
    return database


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hub_module, "AGAIN_S", 0.02)
    monkeypatch.setattr(hub_module, "LOOKING_S", 0.01)


def message(first: int, count: int = 5) -> bytes:
    buffer = RowBuffer()
    assert buffer.add(numbered(first, count).columns())
    (one,) = buffer.messages()
    return one.data


async def say(
    path: ServerPath, sequence: int, data: bytes, source: str = f"gateway-1.{LOG}", lost: int = 0
) -> None:
    headers = {samples_stream.SEQUENCE: str(sequence), samples_stream.LOST: str(lost)}
    assert await publish(path, f"samples.{source}", data, headers)


async def say_all(path: ServerPath, first: int, end: int) -> None:
    """Publish the messages number `first` to `end` - 1, each with five exchanges."""
    for number in range(first, end):
        await say(path, number, message(number * 5))


class Memory:
    """A sink in memory. In `fates`, "b" is a failure before a commit is stored, and "a" one after it."""

    def __init__(self, fates: str = "") -> None:
        self.commits: list[Commit] = []
        self.fates = iter(fates)
        self.begun = 0

    def begin(self, stream: str) -> StoredPosition:
        self.begun += 1
        return (
            StoredPosition(self.commits[-1].last, self.commits[-1].sources)
            if self.commits
            else StoredPosition(0, {})
        )

    def write(self, commit: Commit) -> None:
        fate = next(self.fates, "ok")
        if fate == "b":
            raise SinkError("lost before")
        assert commit.first == self.begin("").place + 1
        self.commits.append(commit)
        if fate == "a":
            raise SinkError("lost afterwards")

    def close(self) -> None:
        pass

    def rows(self) -> list[tuple[Any, ...]]:
        return [row for commit in self.commits for table in commit.tables for row in rows_of(table)]


async def read_all(path: ServerPath, sink: SampleSink, place: int, every: float = 0.02) -> HubState:
    """Run a hub until it has stored the message at stream position `place`; return its state."""
    hub = SampleHub(path, sink, every=every)
    task = asyncio.create_task(hub.run())
    try:
        async with asyncio.timeout(PATIENCE_S):
            while hub.state().place < place and not task.done():
                await asyncio.sleep(0.005)
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task
    return hub.state()


@pytest.mark.slow
@pytest.mark.parametrize("is_behind_for", [3, 10_000], ids=["looks", "ever"])
def test_the_hub_waits_if_a_server_lacks_the_newest_messages(
    running: Cluster, monkeypatch: pytest.MonkeyPatch, is_behind_for: int
) -> None:
    looks = itertools.count()
    read_after = hub_module.read_after

    async def late(path: ServerPath, place: int, *most: int) -> list[StreamMessage]:
        return [] if next(looks) < is_behind_for else await read_after(path, place, *most)

    monkeypatch.setattr(hub_module, "read_after", late)
    monkeypatch.setattr(hub_module, "BEHIND_S", 0.2 if is_behind_for > 3 else PATIENCE_S)

    async def live() -> list[tuple[Any, ...]]:
        async with empty_stream(running) as path:
            await say(path, 1, message(5))
            sink = Memory()
            await SampleHub(path, sink).run(once=True)
            return sink.rows()

    if is_behind_for > 3:
        with pytest.raises(FleetError, match=r"messages 1 to 1 of the stream cannot be read now"):
            asyncio.run(live())
    else:
        assert exchanges_in(asyncio.run(live())) == list(range(5, 10))


@pytest.mark.long
@pytest.mark.parametrize("fates", ["", "bababb", "aaaa"])
async def test_each_row_is_stored_once_despite_failed_writes(running: Cluster, fates: str) -> None:
    async with empty_stream(running) as path:
        await say_all(path, 1, 31)
        sink = Memory(fates)
        state = await read_all(path, sink, 30)
    assert exchanges_in(sorted(sink.rows())) == list(range(5, 155))
    assert state[:5] == (30, 0, 30 * 50 if not fates else state.rows, 0, 0)
    assert sink.commits[-1].sources == {f"gateway-1.{LOG}": 30}


@pytest.mark.slow
async def test_hub_stores_messages_once_if_read_in_several_parts(
    running: Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hub_module, "MOST_READ", 3)
    async with empty_stream(running) as path:
        await say_all(path, 1, 12)
        sink = Memory()
        hub = SampleHub(path, sink)
        await hub.run(once=True)
        assert hub.state().place == 11
        assert exchanges_in(sorted(sink.rows())) == list(range(5, 60))


@pytest.mark.long
@pytest.mark.parametrize("is_good", [True, False], ids=["rows", "garbage"])
async def test_the_memory_for_one_transaction_of_the_hub_is_limited(
    running: Cluster, monkeypatch: pytest.MonkeyPatch, is_good: bool
) -> None:
    """Even few rows need much memory if their names are long. Ignored messages need memory too."""
    monkeypatch.setattr(hub_module, "MOST_READ", 1)
    monkeypatch.setattr(hub_module, "MOST_BYTES", 1000)
    sink = Memory()
    async with empty_stream(running) as path:
        for sequence in (1, 2, 3):
            await say(path, sequence, message(sequence) if is_good else b"?" * 1000)
        await read_all(path, sink, 3, every=3600.0)
    assert [commit.last for commit in sink.commits] == [1, 2, 3]
    assert len(sink.rows()) == (150 if is_good else 0)


@pytest.mark.slow
@pytest.mark.parametrize("fates", ["", "bab"], ids=["at once", "after failures"])
async def test_the_hub_counts_each_missing_or_repeated_message_once(
    running: Cluster, caplog: pytest.LogCaptureFixture, fates: str
) -> None:
    async with empty_stream(running) as path:
        for sequence, source in ((1, "a.x"), (3, "b.x"), (2, "a.x"), (5, "a.x"), (5, "a.x"), (4, "a.x")):
            await say(path, sequence, message(sequence * 5), source)
        await say(path, 6, b"no message", "a.x")
        await say(path, 7, message(0), "a.x", lost=70)
        await say(path, 8, message(5), "a.x", lost=70)
        assert await publish(path, "samples.c.x", message(0), {})
        sink = Memory(fates)
        state = await read_all(path, sink, 10)
        assert sum(commit.rows for commit in sink.commits) == 6 * 50
        assert sink.commits[-1].sources == {"a.x": 8, "b.x": 3}
    assert (state.alarms, state.missing, state.doubled) == (7, 4, 2)
    errors = [record.getMessage() for record in caplog.records if record.levelno == logging.ERROR]
    told = [error for error in errors if "samples are not stored" not in error]
    assert told[:4] == [
        "b.x: messages 1 to 2 are missing",
        "a.x: messages 3 to 4 are missing",
        "a.x: message 5 came again after 5 and is ignored",
        "a.x: message 4 came again after 5 and is ignored",
    ]
    assert told[4].startswith("a.x: message 6 is ignored: 10 bytes are not a message of samples")
    assert told[5:] == [
        "a.x: its spool has lost 70 rows since its start",
        "message 10 of the stream, by c.x, has no number and is ignored",
    ]


@pytest.mark.parametrize("fates", ["", "bb"], ids=["at once", "after failures"])
async def test_the_hub_reports_removed_messages_once(
    running: Cluster, caplog: pytest.LogCaptureFixture, fates: str
) -> None:
    async with empty_stream(running) as path:
        await say_all(path, 1, 6)
        await samples_stream._ask(path, "STREAM.PURGE.samples", {"seq": 4})
        state = await read_all(path, Memory(fates), 5)
        assert (state.alarms, state.missing) == (2, 3)
    assert "messages 1 to 3 of the stream were removed before they were read" in caplog.text
    assert f"gateway-1.{LOG}: messages 1 to 3 are missing" in caplog.text


async def test_hub_refuses_a_stream_without_the_messages_stored_last(running: Cluster) -> None:
    async with empty_stream(running) as path:
        await say(path, 1, message(0))
        sink = Memory()
        sink.commits.append(Commit("", 1, 5, {}, [], 0))
        with pytest.raises(
            NotThisHubs,
            match="the stream ends at message 1, but the hub has stored message 5",
        ):
            await SampleHub(path, sink).run()


def kept_in_files(path: ServerPath, folder: Path, place: int) -> Any:
    async def live() -> HubState:
        with closing(ParquetSink(folder)) as sink:
            return await read_all(path, sink, place)

    return live()


@pytest.mark.long
async def test_hub_files_are_read_by_history_and_duckdb(running: Cluster, tmp_path: Path) -> None:
    duckdb = require_module("duckdb")
    async with empty_stream(running) as path:
        await say_all(path, 1, 6)
        assert (await kept_in_files(path, tmp_path, 5)).rows == 250
        await say_all(path, 6, 9)
        assert (await kept_in_files(path, tmp_path, 8)).rows == 150
    files = sorted((tmp_path / "rows").glob("*.parquet"))
    ranges = [tuple(map(int, file.name.split(".")[0].split("-"))) for file in files]
    assert ranges[0][0] == 1
    assert ranges[-1][1] == 8
    assert all(one[1] + 1 == other[0] for one, other in itertools.pairwise(ranges))
    wanted = sorted(row[:7] for number in range(1, 9) for row in rows_of(unpack(message(number * 5))))
    with History(tmp_path) as history:
        found = [tuple(row) for rows in history.read() for row in rows]
        assert sorted(found, key=lambda row: (row[0], row[4])) == sorted(
            wanted, key=lambda row: (row[0], row[4])
        )
        buckets = history.buckets("pump-2.value_3", NOON, NOON + 60 * STEP, points=1)["pump-2.value_3"]
    of = [row for row in wanted if row[3:5] == ("pump-2", "value_3")]
    values = [row[5] for row in of if row[5] is not None]
    assert (sum(buckets.n), sum(buckets.missed)) == (len(values), len(of) - len(values))
    assert max(one for one in buckets.most if one is not None) == max(values)
    ask = f"select count(*), count(value), sum(value) from '{tmp_path}/rows/*.parquet' where drive = 'pump-2'"
    (told,) = duckdb.sql(ask).fetchall()
    one_drive = [row[5] for row in wanted if row[3] == "pump-2"]
    assert told == (len(one_drive), sum(v is not None for v in one_drive), sum(filter(None, one_drive)))


async def test_the_hub_ignores_an_unfinished_file(running: Cluster, tmp_path: Path) -> None:
    """A killed hub leaves an unfinished file. The next hub reads the file's rows again from the stream."""
    async with empty_stream(running) as path:
        await say(path, 1, message(5))
        await kept_in_files(path, tmp_path, 1)
        part = tmp_path / "rows" / ".00000002-00000003.20261121T120000Z-20261121T120001Z.parquet.tmp"
        part.write_bytes(b"PAR1")
        await say(path, 2, message(10))
        state = await kept_in_files(path, tmp_path, 2)
        assert (state.rows, state.alarms) == (50, 0)
        assert not part.exists()


def commit_of(
    stream: str = "then", first: int = 1, last: int = 1, sources: Mapping[str, int] | None = None
) -> Commit:
    table = unpack(message(5))
    return Commit(stream, first, last, sources or {"a.x": last}, [table], len(table))


def test_a_parquet_file_is_synced_before_its_rename(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A power cut must not leave an incomplete file."""
    calls: list[str] = []
    really_synced, really_renamed = os.fsync, Path.replace

    def fsync(file: int) -> None:
        calls.append(f"fsync {Path(f'/proc/self/fd/{file}').readlink().name[:9]}")
        really_synced(file)

    def rename(path: Path, other: Path) -> Path:
        calls.append(f"rename {path.name[:9]}")
        return really_renamed(path, other)

    with closing(ParquetSink(tmp_path)) as sink:
        sink.begin("then")
        monkeypatch.setattr(os, "fsync", fsync)
        monkeypatch.setattr(Path, "replace", rename)
        sink.write(commit_of())
    assert calls == ["fsync .00000001", "rename .00000001", "fsync rows"]


def test_the_hub_refuses_a_folder_of_another_stream_or_program(tmp_path: Path) -> None:
    sink = ParquetSink(tmp_path)
    assert sink.begin("then") == StoredPosition(0, {})
    sink.write(commit_of())
    assert sink.begin("then") == StoredPosition(1, {"a.x": 1})
    with pytest.raises(
        NotThisHubs, match="of a stream created at then, but the present stream was created at now: name"
    ):
        sink.begin("now")
    with pytest.raises(NotThisHubs, match=f"another hub writes into {tmp_path}"):
        ParquetSink(tmp_path)
    sink.close()
    (tmp_path / "rows.00000001.arrows").write_bytes(b"")
    with pytest.raises(NotThisHubs, match=r"holds 'rows.00000001.arrows', not written by `multidrop hub`"):
        ParquetSink(tmp_path)


def test_hub_refuses_an_unwritable_folder(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(SinkError, match="cannot be written: Not a directory"):
        ParquetSink(tmp_path / "file")


SAMPLES = """select time_ns, uncertainty_us, drive, register, value, status,
extract(epoch from time) * 1000000 from multidrop.samples order by time_ns, drive, register"""


@pytest.mark.long
async def test_postgresql_stores_the_same_rows_as_the_stream(running: Cluster, empty: Postgres) -> None:
    async with empty_stream(running) as path:
        await say_all(path, 1, 6)
        sink = PostgresSink(empty.where)
        state = await read_all(path, sink, 5)
        assert (state.rows, state.alarms) == (250, 0)
        sink.close()
    wanted = sorted(row for number in range(1, 6) for row in rows_of(unpack(message(number * 5))))
    told = [
        (row[0], row[2] and row[2] // 1000, *row[3:7], row[0] // 1000)
        for row in sorted(wanted, key=lambda row: (row[0], row[3], row[4]))
    ]
    assert empty.ask(SAMPLES) == told
    assert empty.ask("select place, sources from multidrop.hub") == [(5, {f"gateway-1.{LOG}": 5})]
    assert empty.ask("select count(*) from multidrop.exchanges") == [(25,)]


@pytest.mark.long
def test_exchanges_with_some_missing_values_are_read_back_from_postgresql(empty: Postgres) -> None:
    sink = PostgresSink(empty.where)
    sink.begin("then")
    table = unpack(message(0, 1))
    import pyarrow as pa

    status = pa.DictionaryArray.from_arrays(
        pa.array([0] * 9 + [1], pa.int32()), pa.array(["ok", "no valid value"])
    )
    values = pa.array([*map(float, range(9)), None])
    for name, column in (("value", values), ("status", status)):
        at = table.schema.get_field_index(name)
        table = table.set_column(at, table.schema.field(at), column)
    sink.write(Commit("then", 1, 1, {}, [table], 10))
    sink.close()
    found = empty.ask("select register, value, status from multidrop.samples")
    assert found[:9] == [(f"value_{at + 1}", float(at), "ok") for at in range(9)]
    assert found[9] == ("value_10", None, "no valid value")


@pytest.mark.slow
def test_samples_in_postgresql_have_their_units(empty: Postgres) -> None:
    import pyarrow as pa

    sink = PostgresSink(empty.where)
    sink.begin("then")
    for number, units in enumerate((None, "V", "A"), 1):
        table = unpack(message(5 * number, 1))
        at = table.schema.get_field_index("unit")
        texts = pa.array([units, *[None] * 9], pa.utf8()).dictionary_encode()
        table = table.set_column(at, table.schema.field(at), texts)
        sink.write(Commit("then", number, number, {}, [table], 10))
    sink.close()
    of_one = "select unit from multidrop.samples where register = 'value_1' order by time"
    assert empty.ask(of_one) == [(None,), ("V",), ("A",)]
    assert empty.ask("select count(*), count(unit) from multidrop.samples") == [(30, 2)]
    assert empty.ask("select count(*) from multidrop.register_sets") == [(3,)]


@pytest.mark.slow
def test_a_second_hub_waits_until_the_first_one_has_left_the_database(empty: Postgres) -> None:
    one, other = PostgresSink(empty.where), PostgresSink(empty.where)
    assert one.begin("then") == StoredPosition(0, {})
    with pytest.raises(SinkError, match="another hub writes into this database; waiting until it ends"):
        other.begin("then")
    one.write(commit_of())
    assert one.begin("then") == StoredPosition(1, {"a.x": 1})  # a hub asks again after a failure
    one.close()
    assert other.begin("then") == StoredPosition(1, {"a.x": 1})
    with pytest.raises(
        NotThisHubs, match="created at then, but the present stream was created at now: name another database"
    ):
        other.begin("now")
    other.close()


@pytest.mark.slow
def test_hub_stops_writing_if_another_hub_changed_the_stored_position(empty: Postgres) -> None:
    """Behind a connection pooler, several hubs may share one lock, so the database checks the position."""
    sink = PostgresSink(empty.where)
    sink.begin("then")
    empty.ask("update multidrop.hub set place = 7 returning place")
    # messages 1 and 7 are stored already; a commit from message 9 on would skip message 8
    for first in (1, 7, 9):
        with pytest.raises(SinkError, match="another hub writes into this database: stop one of them"):
            sink.write(commit_of(first=first, last=first))
    sink.close()
    assert empty.ask("select count(*) from multidrop.exchanges") == [(0,)]


@pytest.mark.slow
def test_a_missing_database_is_reported_in_one_sentence(empty: Postgres) -> None:
    sink = PostgresSink(f"{empty.where} connect_timeout=2".replace(f"port={empty.port}", "port=1"))
    with pytest.raises(SinkError, match=r"PostgreSQL: .*Connection refused"):
        sink.begin("then")
    with pytest.raises(SinkError, match=r'PostgreSQL: .*database "nope" does not exist'):
        PostgresSink(empty.where.replace("dbname=postgres", "dbname=nope")).begin("then")


@pytest.mark.long
def test_insufficient_database_rights_are_reported_in_one_sentence(empty: Postgres) -> None:
    empty.ask("drop role if exists reader; create role reader login")
    sink = PostgresSink(empty.where.replace("user=multidrop", "user=reader"))
    with pytest.raises(SinkError, match="PostgreSQL: permission denied for database postgres"):
        sink.begin("then")
    sink.close()
    empty.ask("drop role reader")
