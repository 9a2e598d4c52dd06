"""BatchClient: many answers at a time, which answers are accepted, and what happens if one is missing."""

from __future__ import annotations

import asyncio
import inspect
from typing import Any

import pytest
from nats.aio.client import Client
from nats_clusters import Cluster, connected_path, opened_paths
from tables import table

from multidrop.fleet.errors import OutcomeUnknown
from multidrop.fleet.servers import batch_client, connections
from multidrop.fleet.servers.batch_client import (
    BatchClient,
    DirectGet,
    DirectMessage,
    Request,
    stored_message,
)
from multidrop.fleet.servers.buckets import Bucket, Record
from multidrop.fleet.servers.connections import ServerPath, connect

OWNER = {"gateway": "gw-9", "session": 1, "votes": 1, "turn": 1, "since": 0}
SERVERS = (
    b"Nats-Stream: KV_own_0\r\nNats-Subject: $KV.own_0.a\r\nNats-Sequence: 7\r\nNats-Last-Sequence: 0\r\n\r\n"
)


@pytest.fixture(params=["taken at once", "nats-py's own way", "another nats-py"])
def way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Receive answers directly, through nats-py's queue, or with a changed nats-py.

    Return a prefix for keys.
    """
    if request.param == "nats-py's own way":
        monkeypatch.delattr(BatchClient, "_process_msg")
    elif request.param == "another nats-py":
        process = Client._process_msg

        async def with_more(self: Client, *arguments: Any) -> None:
            await process(self, *arguments[:5])

        monkeypatch.setattr(Client, "_process_msg", with_more)
        monkeypatch.setattr(batch_client, "PROCESSED", 5)
    return f"way-{request.param_index}"


def test_nats_py_still_has_the_method_that_receives_answers() -> None:
    """If this test fails, answers take a slower path. Use the new method, or declare this nats-py too new."""
    names = ["self", "sid", "subject", "reply", "data", "headers"]
    assert list(inspect.signature(Client._process_msg).parameters) == names
    assert inspect.iscoroutinefunction(Client._process_msg)


async def test_answers_to_batch_requests_are_not_handled_by_nats_py(
    one: Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def fail(self: BatchClient, message: object) -> None:
        raise AssertionError("it came in nats-py's own way")

    monkeypatch.setattr(BatchClient, "_take_message", fail)
    client = await connect(one.urls[0], {})
    assert None not in await client.replies([Request("$JS.API.INFO", b"")], 30.0)
    await client.close()


def _rested(path: ServerPath) -> None:
    """Fill the budget for repeated reads of this server connection, as after some time without load."""
    for _ in range(round(connections.MOST_REPEATS / connections.EARNED)):
        path.budget.note(is_late=False)
        path.budget.learn(0.01)


@table(
    "writers",
    [
        b"NATS/1.0\r\n",
        b"NATS/1.0\r\nOf-Another: version\r\n",
        b"NATS/1.0\r\nNats-Subject: $KV.own_0.other\r\nNats-Sequence: 9\r\n",
        b"NATS/1.0 204 EOB\r\n",
        b"NATS/1.0 404 No Messages\r\nNats-Sequence: none\r\n",
    ],
)
def test_server_headers_override_headers_from_the_writer(writers: bytes) -> None:
    assert stored_message(writers + SERVERS, b"x") == DirectMessage("$KV.own_0.a", 7, b"x")


@table(
    "headers",
    [
        b"",
        b"NATS/1.0 204 EOB\r\nNats-Pending: 0\r\nNats-Last-Sequence: 3\r\n\r\n",
        b"NATS/1.0 404 Message Not Found\r\n\r\n",
        b"NATS/1.0\r\nNats-Subject: a\r\nNats-Sequence: -1\r\n\r\n",
    ],
)
def test_stored_message_requires_a_valid_subject_and_sequence(headers: bytes) -> None:
    assert stored_message(headers, b"") is None


async def test_record_that_imitates_the_end_marker_does_not_shorten_an_answer(one: Cluster, way: str) -> None:
    async with connected_path(one) as path:
        bucket = Bucket("own_0", lambda: path)
        await bucket.put(f"{way}-a", OWNER, 0)
        client = await connect(one.urls[0], {})
        headers = b"NATS/1.0 204 EOB\r\nNats-Subject: $KV.own_0.x\r\nNats-Sequence: 1\r\n\r\n"
        await client._send_command(
            b"HPUB $KV.own_0.%s-b %d %d\r\n%s\r\n" % (way.encode(), len(headers), len(headers), headers)
        )
        await client.flush()
        await client.close()
        while f"{way}-b" not in [record.key for record in await bucket.changes(0)]:
            await asyncio.sleep(0.05)  # until the write, which gets no answer, is stored
        await bucket.put(f"{way}-c", OWNER, 0)
        found = await bucket.changes(0)
        keys = [record.key for record in found if record.key.startswith(way)]
        assert keys == [f"{way}-a", f"{way}-b", f"{way}-c"]


async def test_batch_write_replaces_only_records_of_the_expected_revision(one: Cluster, way: str) -> None:
    async with connected_path(one) as path:
        bucket = Bucket("own_1", lambda: path)
        a, b, c = f"{way}-a", f"{way}-b", f"{way}-c"
        known = await bucket.put(b, OWNER, 0)
        value = {**OWNER, "session": 2}
        wanted = [Record(a, 0, value), Record(b, known + 5, value), Record(c, 0, value)]
        stored, refused = await bucket.put_all(wanted)
        assert [record.key for record in stored] == [a, c]
        assert refused == {b}
        found = {record.key: record for record in await bucket.changes(0)}
        assert [found[a], found[c]] == stored
        assert found[b] == Record(b, known, OWNER)
        again = await bucket.put_all([record._replace(value=OWNER) for record in stored])
        assert [record.key for record in again.stored] == [a, c]


@pytest.mark.slow
@pytest.mark.usefixtures("way")
async def test_missing_receiver_is_distinguished_from_a_missing_answer(one: Cluster) -> None:
    client = await connect(one.urls[0], {})
    deaf = await client.subscribe("deaf")
    mute = Request("deaf", b"")
    nobody = Request("nobody.there", b"")
    info = Request("$JS.API.INFO", b"")
    found = await client.replies([mute, nobody, info], 0.2)
    assert found[0] is None
    assert found[1] == b""  # empty: the server reports that the request has no receiver
    assert found[2] is not None
    assert found[2].startswith(b"{")
    with pytest.raises(TimeoutError, match=r"the server sent no message for 0.2 s"):
        await client.batch(mute, DirectGet(), 0.2)
    with pytest.raises(OSError, match="the answer to a read ended with status 503"):
        await client.batch(nobody, DirectGet(), 5.0)
    assert client._takers == {}
    await deaf.unsubscribe()
    await client.close()


@pytest.mark.long
@pytest.mark.parametrize(("deaf_to", "is_told"), [(0, True), (1, True), (4, True), (5, False)])
async def test_unanswered_read_is_repeated_on_the_same_connection(
    one: Cluster, monkeypatch: pytest.MonkeyPatch, deaf_to: int, is_told: bool
) -> None:
    monkeypatch.setattr(connections, "AGAIN_S", (0.1,) * 4 + (30.0 if is_told else 0.1,))
    async with connected_path(one) as path:
        path.others = []
        _rested(path)
        other = await connect(one.urls[0], {})
        asked: list[str] = []

        async def answer(message: Any) -> None:
            asked.append(message.reply)
            if len(asked) > deaf_to:
                status = b"NATS/1.0 404 No Messages\r\n\r\n"
                place = message.reply.encode()
                await other._send_command(b"HPUB %s %d %d\r\n%s\r\n" % (place, *[len(status)] * 2, status))
                await other.flush()

        await other.subscribe("moody", cb=answer)
        # this flush may return before the server has the subscription; the second one cannot
        await other.flush()
        await other.flush()
        if is_told:
            assert await path.collect("moody", b"") == []
        else:
            with pytest.raises(OutcomeUnknown, match="no answer to moody"):
                await path.collect("moody", b"")
        assert len(asked) > deaf_to or not is_told
        await other.close()


async def test_read_is_repeated_on_other_connections_if_one_is_cut_off(one: Cluster) -> None:
    async with opened_paths(one.urls) as paths:
        asked: list[Request] = []

        async def swallow(request: Request, get: DirectGet, silence_s: float) -> None:
            asked.append(request)
            await asyncio.Event().wait()

        _rested(paths[0])
        deaf = paths[0]._client
        assert deaf
        deaf.batch = swallow
        bucket = Bucket("plant", lambda: paths[0])
        assert await asyncio.wait_for(bucket.changes(0), 60) == []
        assert asked


@pytest.mark.usefixtures("way")
async def test_late_answer_is_not_used_for_the_next_request(one: Cluster) -> None:
    client, other = await connect(one.urls[0], {}), await connect(one.urls[0], {})
    asked: asyncio.Queue[str] = asyncio.Queue()

    async def keep(message: object) -> None:
        asked.put_nowait(message.reply)

    await other.subscribe("slow", cb=keep)
    await other.flush()  # this flush may return before the server has the subscription; the second one cannot
    await other.flush()
    assert await client.replies([Request("slow", b"first")], 0.2) == [None]
    second = asyncio.create_task(client.replies([Request("slow", b"second")], 30.0))
    first_inbox, second_inbox = (
        await asyncio.wait_for(asked.get(), 30),
        await asyncio.wait_for(asked.get(), 30),
    )
    await other.publish(first_inbox, b"late")
    await other.publish(second_inbox, b"right")
    assert await second == [b"right"]
    for one_of in (client, other):
        await one_of.close()


async def test_a_client_continues_to_read_after_a_late_pong(one: Cluster) -> None:
    client = await connect(one.urls[0], {})
    given_up = asyncio.get_running_loop().create_future()
    given_up.cancel()  # as when a flush times out
    await client._send_ping(given_up)
    await client.flush(30)
    assert client.is_reading
    assert None not in await client.replies([Request("$JS.API.INFO", b"")], 30.0)
    await client.close()


async def test_connection_is_replaced_after_its_reading_task_has_ended(one: Cluster) -> None:
    async with connected_path(one) as path:
        former = path._client
        assert former
        assert former._reading_task
        former._reading_task.cancel()
        await asyncio.wait([former._reading_task])
        assert former.is_connected
        assert not path.is_open
        await path.check()
        assert path.is_open
        assert path._client is not former


@pytest.mark.usefixtures("way")
async def test_a_single_request_after_a_batch_of_requests_is_answered(one: Cluster) -> None:
    client = await connect(one.urls[0], {})
    assert isinstance(client, BatchClient)
    await client.replies([Request("$JS.API.INFO", b"")], 5.0)
    answer = await client.request("$JS.API.INFO", b"", 5.0, headers={"a": "b"})
    assert answer.data.startswith(b"{")
    await client.close()
