"""The forwarder stores each message once and in order in real NATS servers, even if the network loses it."""

from __future__ import annotations

import asyncio
import importlib
import logging
import random
import re
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, closing, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from nats_clusters import Cluster, cluster
from peers import require_module
from spooled import empty_stream, exchanges_in, numbered, rows_of
from tables import table

from multidrop import History
from multidrop.fleet.errors import FleetError, NoRight, OutcomeUnknown
from multidrop.fleet.samples import samples_stream
from multidrop.fleet.samples.hub import HubState, ParquetSink, SampleHub, SourceCheck
from multidrop.fleet.samples.samples_stream import (
    Forwarder,
    StreamMessage,
    create_stream,
    digest_of,
    last_of,
    publish,
    read_after,
    samples_path,
    stream_info,
    subject_of,
)
from multidrop.fleet.servers.connections import ServerPath
from multidrop.samples.message import MOST_BYTES, unpack
from multidrop.samples.spool import Spool, SpoolState
from multidrop.supervisor import end_tasks

PATIENCE_S = 30.0


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(samples_stream, "AGAIN_S", 0.02)


@asynccontextmanager
async def forwarding(spool: Spool, path: Any) -> AsyncIterator[Forwarder]:
    forwarder = Forwarder(spool, path)
    task = asyncio.create_task(forwarder.run())
    try:
        yield forwarder
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task


async def until(is_so: Any) -> None:
    async with asyncio.timeout(PATIENCE_S):
        while not is_so():
            await asyncio.sleep(0.005)


async def stored(path: ServerPath) -> list[StreamMessage]:
    """Return all messages in the stream."""
    found: list[StreamMessage] = []
    while more := await read_after(path, found[-1].place if found else 0, 3, 1 << 20):
        found += more
    return found


def filled(folder: Path, messages: int) -> Spool:
    spool = Spool(folder, "gateway-1")
    for number in range(messages):
        spool.append(numbered(number * 5, 5))
        assert spool.sync(PATIENCE_S)
    return spool


async def store(spool: Spool, first: int) -> None:
    """Append five exchanges to the spool, and wait until they are on the disk as one message."""
    spool.append(numbered(first, 5))
    assert await asyncio.to_thread(spool.sync, PATIENCE_S)


@table("name", ["", "a.b", "a b", "*", ">", "ä", "a/b"])
def test_gateway_name_with_invalid_characters_is_rejected(name: str) -> None:
    spool: Any = SimpleNamespace(gateway=name, log="00112233aabbccdd")
    with pytest.raises(ValueError, match="may have only letters, digits, _ and -"):
        Forwarder(spool, spool)


class SwallowingPath:
    """A server connection whose answer arrives just when the request is cancelled."""

    async def request(self, *_: object, **__: object) -> Any:
        with suppress(asyncio.CancelledError):
            await asyncio.Event().wait()
        return SimpleNamespace(data=b'{"seq": 1, "message": {"seq": 1}}')

    gather = request


@pytest.mark.parametrize(
    "request_of",
    [
        lambda path: publish(path, "samples.a.b", b"", {}),
        lambda path: last_of(path, "samples.a.b"),
        lambda path: read_after(path, 0, 1, 1),
    ],
    ids=["publish", "last_of", "read_after"],
)
async def test_a_cancelled_request_ends_its_task_even_if_the_answer_arrives(request_of: Any) -> None:
    task = asyncio.create_task(request_of(SwallowingPath()))
    await asyncio.sleep(0)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task


async def test_the_forwarder_stores_the_spools_messages_in_order(running: Cluster, tmp_path: Path) -> None:
    spool = filled(tmp_path / "spool", 7)
    async with empty_stream(running) as path, forwarding(spool, path) as forwarder:
        await until(lambda: forwarder.last == 7)
        await store(spool, 35)
        await until(lambda: forwarder.last == 8)
        assert (forwarder.sent, forwarder.last, forwarder.trouble) == (8, 8, None)
        assert spool.state().acknowledged == 8
        found = await stored(path)
    assert [(one.gateway, one.log, one.sequence, one.lost) for one in found] == [
        ("gateway-1", spool.log, number, 0) for number in range(1, 9)
    ]
    rows = [row for one in found for row in rows_of(unpack(one.data))]
    assert exchanges_in(rows) == list(range(40))
    spool.close()


async def test_a_restarted_gateway_continues_after_the_last_message(running: Cluster, tmp_path: Path) -> None:
    async with empty_stream(running) as path:
        for run in range(3):
            spool = Spool(tmp_path / "spool", "gateway-1")
            spool.append(numbered(run * 10, 10))
            assert await asyncio.to_thread(spool.sync, PATIENCE_S)
            async with forwarding(spool, path) as forwarder:
                await until(lambda forwarder=forwarder, run=run: forwarder.last == run + 1)
                assert forwarder.sent == 1
            spool.close()
        assert [one.sequence for one in await stored(path)] == [1, 2, 3]


class Lossy:
    """A server connection that loses messages, or the stream's answers to them, as `fates` says."""

    def __init__(self, path: ServerPath, fates: str) -> None:
        self._path, self._fates = path, iter(fates)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._path, name)

    async def request(self, subject: str, data: bytes = b"", *details: Any, **more: Any) -> Any:
        fate = next(self._fates, "ok") if not subject.startswith("$JS") else "ok"
        if fate == "b":  # the message is lost
            raise OutcomeUnknown("no answer")
        if fate == "l":  # late: the message arrives after its copy
            asyncio.get_running_loop().call_later(0.05, self._late, subject, data, *details)
            raise OutcomeUnknown("no answer")
        answer = await self._path.request(subject, data, *details, **more)
        if fate == "a":  # the answer is lost
            raise OutcomeUnknown("no answer")
        return answer

    def _late(self, subject: str, data: bytes, headers: dict[str, str], _: float) -> None:
        assert self._path._client
        self.task = asyncio.create_task(self._path._client.publish(subject, data, headers=headers))


@pytest.mark.parametrize("fates", ["aaaaaaa", "bbabab", "ababaaabb", "llaboabl", "alolalolb"])
async def test_forwarder_stores_each_message_once_despite_lost_answers(
    running: Cluster, tmp_path: Path, fates: str
) -> None:
    spool = filled(tmp_path / "spool", 6)
    async with empty_stream(running) as path, forwarding(spool, Lossy(path, fates)) as forwarder:
        await until(lambda: forwarder.last == 6)
        await asyncio.sleep(0.1)  # waits until late messages have been refused
        assert [one.sequence for one in await stored(path)] == [1, 2, 3, 4, 5, 6]
    spool.close()


async def test_forwarder_ignores_server_answers_among_its_samples(running: Cluster, tmp_path: Path) -> None:
    """Any client may direct a server's answer to the subject of a gateway's samples."""
    spool = filled(tmp_path / "spool", 2)
    subject = subject_of("gateway-1", spool.log)
    answers = [{}, {"Nats-Stream": "KV_own_0", samples_stream.SEQUENCE: "99"}]
    async with empty_stream(running) as path, forwarding(spool, path) as forwarder:
        await until(lambda: forwarder.last == 2)
        for number, headers in enumerate(answers, 3):
            assert await publish(path, subject, b"{}", headers)
            await store(spool, number * 5)
            await until(lambda number=number: forwarder.last == number)
        assert (forwarder.sent, spool.state().acknowledged) == (4, 4)
        sequences = [one.sequence for one in await stored(path) if one.data != b"{}"]
        assert sequences == [1, 2, 3, 4]
    spool.close()


class Refusing(Lossy):
    """A server connection on which the stream refuses the first messages, as if the disk was full."""

    async def request(self, subject: str, data: bytes = b"", *details: Any, **more: Any) -> Any:
        if not subject.startswith("$JS") and next(self._fates, ""):
            return SimpleNamespace(data=b'{"error":{"err_code":10023,"description":"no room"}}')
        return await self._path.request(subject, data, *details, **more)


async def test_refusal_of_messages_by_the_stream_is_logged_once(
    running: Cluster, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    spool = filled(tmp_path / "spool", 2)
    async with empty_stream(running) as path, forwarding(spool, Refusing(path, "12345")) as forwarder:
        await until(lambda: forwarder.last == 2)
        await until(lambda: forwarder.trouble is None)
    spool.close()
    assert [record.getMessage() for record in caplog.records] == [
        "samples are not forwarded: the stream 'samples' refuses a message: no room",
        "samples are forwarded again, after message 1",
    ]


async def test_the_forwarder_skips_messages_removed_from_the_spool(running: Cluster, tmp_path: Path) -> None:
    filled(tmp_path / "spool", 5).close()
    spool = Spool(tmp_path / "spool", "gateway-1", most=1)
    await store(spool, 25)
    await until(lambda: spool.state().oldest == 6)
    async with empty_stream(running) as path, forwarding(spool, path) as forwarder:
        await until(lambda: forwarder.last == 6)
        (found,) = await stored(path)
    assert (found.sequence, found.lost) == (6, 250)
    spool.close()


async def test_messages_of_a_restored_backup_folder_are_not_forwarded(
    running: Cluster, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    spool = filled(tmp_path / "spool", 2)
    async with empty_stream(running) as path:
        async with forwarding(spool, path) as forwarder:
            await until(lambda: forwarder.last == 2)
        spool.close()
        (tmp_path / "spool" / "000000000002-50.arrows").unlink()
        spool = Spool(tmp_path / "spool", "gateway-1")
        for number in (100, 200):  # first the spool has as many messages as the stream, then more
            async with forwarding(spool, path) as forwarder:
                await until(lambda forwarder=forwarder: forwarder.trouble)
            await store(spool, number)
        async with forwarding(spool, path) as forwarder:
            await until(lambda: forwarder.trouble)
        assert [one.sequence for one in await stored(path)] == [1, 2]
        spool.close()
    told = [record.getMessage() for record in caplog.records if record.levelno == logging.ERROR]
    ends = ": its folder was copied or set back; move it away to start a new log"
    assert len(told) == 3
    assert all(sentence.endswith(ends) for sentence in told)
    assert "the spool has no such message" in told[0]
    assert "the spool has another one" in told[1]


@pytest.mark.long
async def test_forwarding_continues_after_an_outage(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    spool = filled(tmp_path / "spool", 3)
    with cluster(tmp_path / "nats", 1) as servers:
        async with empty_stream(servers) as path, forwarding(spool, path) as forwarder:
            await until(lambda: forwarder.last == 3)
            servers.nodes[0].kill()
            spool.append(numbered(15, 5))
            await until(lambda: forwarder.trouble)
            servers.nodes[0].start()
            await until(lambda: forwarder.last == 4)
            assert [one.sequence for one in await stored(path)] == [1, 2, 3, 4]
    spool.close()
    told = [record.getMessage() for record in caplog.records if "forwarder" in record.name]
    assert told[0].startswith("samples are not forwarded: ")
    # The servers may have stored message 4 before they ended, without answering.
    assert re.fullmatch("samples are forwarded again, after message [34]", told[-1])


@pytest.mark.slow
async def test_the_largest_message_is_stored_and_read_back(running: Cluster) -> None:
    async with empty_stream(running) as path:
        data = random.Random(1).randbytes(MOST_BYTES)
        headers = {samples_stream.SEQUENCE: "7", samples_stream.DIGEST: digest_of(data)}
        for place in (1, 2, 3):
            assert await publish(path, "samples.a.b", data, headers) == place
        assert await last_of(path, "samples.a.b") == (3, 7, digest_of(data))
        assert [one.data == data for one in await stored(path)] == [True] * 3


@pytest.mark.slow
async def test_the_forwarder_waits_for_a_missing_stream(running: Cluster, tmp_path: Path) -> None:
    async with empty_stream(running) as path:
        await samples_stream._ask(path, "STREAM.DELETE.samples", {})
        for asked in (stream_info(path), last_of(path, "samples.a.b")):
            with pytest.raises(FleetError, match="there is no stream 'samples': create it with"):
                await asked
        with pytest.raises(FleetError, match="there is no stream 'samples', or it has no leader now"):
            await read_after(path, 0, 10, 1000)
        with pytest.raises(FleetError, match=r"no stream stores samples\.a\.b"):
            await publish(path, subject_of("a", "b"), b"", {})
        spool = filled(tmp_path / "spool", 1)
        async with forwarding(spool, path) as forwarder:
            await until(lambda: forwarder.trouble)
            await create_stream(path, replicas=1)
            await until(lambda: forwarder.last == 1)
        spool.close()


@pytest.mark.long
async def test_insufficient_rights_are_reported_in_one_sentence(tmp_path: Path) -> None:
    with cluster(tmp_path, 1) as servers:
        path = tmp_path / "n1.conf"
        servers.nodes[0].kill()
        rights = (
            '{ user: gateway-2, password: x, permissions: { publish: ["samples.gateway-2.>", "$JS.API.>"] } }'
        )
        path.write_text(path.read_text() + f"authorization {{ users: [ {rights} ] }}\n")
        servers.nodes[0].start()
        servers.wait()
        wrong, right = ({"user": "gateway-2", "password": word} for word in ("wrong", "x"))
        with pytest.raises(FleetError, match="refuses these credentials, or the lack of any"):
            async with samples_path(servers.urls, wrong):
                pass
        async with samples_path(servers.urls, right) as path:
            await create_stream(path, replicas=1)
            assert await publish(path, subject_of("gateway-2", "b"), b"", {}) == 1
            with pytest.raises(NoRight, match=r"do not allow publishing to samples\.gateway-1"):
                await publish(path, subject_of("gateway-1", "b"), b"", {})


# ---- kills of every process between a poller and the sinks: no reported sample is lost or duplicated ----


ROOT = Path(__file__).parents[3]


@pytest.fixture
def chaos(monkeypatch: pytest.MonkeyPatch) -> Any:
    require_module("duckdb")
    monkeypatch.syspath_prepend(str(ROOT))
    return importlib.import_module("bench.questions.fleet.chaos")


def test_chaos_tool_finds_lost_and_duplicated_rows(chaos: Any) -> None:
    told = {"gateway-1": {0: 4, 1_000_000: 2}, "gateway-2": {0: 3}}
    whole = {
        # rows 4 and 5 were stored, although the gateway was killed before it had reported them
        "gateway-1": Counter([0, 1, 2, 3, 4, 5, 1_000_000, 1_000_001]),
        "gateway-2": Counter([0, 1, 2]),
    }
    assert chaos.compare(told, whole) == (9, 0, 0, 0)
    lost = {**whole, "gateway-2": Counter([0, 1])}
    assert chaos.compare(told, lost) == (9, 1, 0, 0)
    hole = {**whole, "gateway-1": Counter([0, 1, 2, 3, 5, 1_000_000, 1_000_001])}
    assert chaos.compare(told, hole) == (9, 0, 1, 0)
    doubled = {**whole, "gateway-2": Counter([0, 1, 1, 2])}
    assert chaos.compare(told, doubled) == (9, 0, 0, 1)


def test_chaos_tool_finds_alarms_in_the_hub_log(
    chaos: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    check = SourceCheck({})
    for sequence in (1, 3, 3):
        check.take(StreamMessage(sequence, "gateway-1", "log", sequence, 0, b""))
    (tmp_path / "hub.log").write_text("".join(f"{record.getMessage()}\n" for record in caplog.records))
    assert [line.partition(": message")[2] for line in chaos.alarms(tmp_path)] == [
        "s 2 to 2 are missing",
        " 3 came again after 3 and is ignored",
    ]


@pytest.mark.long
@pytest.mark.slow
def test_no_sample_is_lost_when_processes_are_killed_at_random(chaos: Any, tmp_path: Path) -> None:
    wrong = chaos.run(tmp_path, 12.0, random.Random(2))
    print(*(f"{path.name}: {path.read_text()[-2000:]}" for path in tmp_path.glob("*.log")), sep="\n")
    assert wrong == 0
    assert chaos.alarms(tmp_path) == []


# ---- a long outage: the spool keeps as much as its limit allows, and the hub knows which rows are lost ----


MESSAGES, EXCHANGES = 40, 5
LONG_PATIENCE_S = 60.0


async def forwarded(spool: Spool, servers: Cluster) -> None:
    async with samples_path(servers.urls) as path, asyncio.timeout(LONG_PATIENCE_S):
        forwarder = Forwarder(spool, path)
        task = asyncio.create_task(forwarder.run())
        while forwarder.last != spool.state().newest:
            await asyncio.sleep(0.01)
        await end_tasks(task)


async def kept(folder: Path, servers: Cluster) -> HubState:
    async with samples_path(servers.urls) as path:
        with closing(ParquetSink(folder)) as sink:
            hub = SampleHub(path, sink)
            await hub.run(once=True)
        return hub.state()


def filled_from(folder: Path, first: int, most: int) -> Spool:
    spool = Spool(folder, "gateway-1", most=most)
    for number in range(first, first + MESSAGES):
        spool.append(numbered(number * EXCHANGES, EXCHANGES))
        assert spool.sync(LONG_PATIENCE_S)
    return spool


@pytest.fixture
def most(tmp_path: Path) -> int:
    """Return the size, in bytes, of about ten messages."""
    spool = Spool(tmp_path / "one", "gateway-1")
    spool.append(numbered(0, EXCHANGES))
    assert spool.sync(LONG_PATIENCE_S)
    spool.close()
    return 10 * spool.state().stored


def settled(spool: Spool, most: int) -> SpoolState:
    while spool.state().stored > most:
        pass
    return spool.state()


@pytest.mark.long
async def test_rows_are_stored_or_counted_as_lost_after_a_long_outage(tmp_path: Path, most: int) -> None:
    """The spool cannot hold all rows of the outage."""
    require_module("duckdb")
    with cluster(tmp_path / "nats", 1) as servers:

        async def live() -> tuple[HubState, SpoolState]:
            async with samples_path(servers.urls) as path:
                await create_stream(path, replicas=1)
            spool = await asyncio.to_thread(filled_from, tmp_path / "spool", 0, most)
            settled(spool, most)
            await forwarded(spool, servers)
            spool.close()
            return await kept(tmp_path / "hub", servers), spool.state()

        state, spooled = await live()
    assert 8 <= 40 - state.missing <= 10
    assert state.rows + spooled.lost == MESSAGES * EXCHANGES * 10
    assert (state.alarms, state.doubled) == (2, 0)  # one alarm for missing messages, one for lost rows
    with History(tmp_path / "hub") as history:
        rows = sorted(tuple(row) for batch in history.read() for row in batch)
    assert exchanges_in(rows) == list(range(state.missing * EXCHANGES, MESSAGES * EXCHANGES))
