"""Damaged or hostile records in buckets: each is ignored with a warning, and affects no other record."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from fleets import Hall, RecordingMastership
from nats.aio.msg import Msg
from nats_clusters import Cluster, connected_path, opened_paths
from tables import table

from multidrop.fleet.errors import FleetError, OutcomeUnknown
from multidrop.fleet.gateway import FleetGateway, ask_gateway
from multidrop.fleet.lines import member as member_module
from multidrop.fleet.lines.lease import boottime_ns
from multidrop.fleet.lines.member import Member
from multidrop.fleet.lines.rules import SECOND, USUAL
from multidrop.fleet.samples import samples_stream
from multidrop.fleet.servers import names, setup
from multidrop.fleet.servers.buckets import LARGE, SMALL, Bucket, LeaseBucket, Record, ServerError, parsed
from multidrop.fleet.servers.connections import ServerPath, paths_of
from multidrop.fleet.servers.leaders import Cluster as Leaders
from multidrop.fleet.servers.leaders import known_cluster, led_clusters
from multidrop.fleet.servers.plant_store import store
from multidrop.fleet.servers.setup import check_buckets, open_all

LEASE = {
    **dict.fromkeys(("session", "began", "pid"), 1),
    **dict.fromkeys(("nonce", "host", "machine", "lock", "lock_id"), "x"),
    **dict.fromkeys(("ended", "draining"), False),
}
OWNER = {"gateway": "gw-9", "session": 1, "votes": 1, "turn": 1, "since": 0}
LINE = {"line": {"name": "line-1"}, "files": {}}
PATIENCE_S = 120.0


def changed(record: dict[str, Any], **more: object) -> bytes:
    return json.dumps({**record, **more}).encode()


STRANGE: dict[str, tuple[str, str, bytes, str]] = {
    "no JSON": ("lease_0", "gw-1", b"\xff{", "not JSON"),
    "deep": ("plant", "line-1", b"[" * 500_000, "not JSON"),
    "a number of 10,000 digits": ("own_0", "line-1", b"9" * 10_000, "not JSON"),
    "a list": ("lease_0", "gw-1", b"[1]", "not a table"),
    "an empty table": ("lease_0", "gw-1", b"{}", "it has no 'session'"),
    "a text": ("own_1", "line-1", changed(OWNER, session="1"), "its 'session' is not a whole number"),
    "three votes": ("own_1", "line-1", changed(OWNER, votes=3), "it has neither one vote nor two"),
    "true": ("lease_1", "gw-1", changed(LEASE, session=True), "its 'session' is not a whole number"),
    "a number": ("lease_1", "gw-1", changed(LEASE, nonce=7), "its 'nonce' is not a text"),
    "null": ("lease_1", "gw-1", changed(LEASE, ended=None), "its 'ended' is not true or false"),
    "an invalid key": ("own_1", "a/../b", changed(OWNER), "its key is not a valid name"),
    "another line": ("plant", "line-2", changed(LINE), "its line has another name than its key"),
    "a file of numbers": ("plant", "line-1", changed(LINE, files={"a": 1}), "one of its files is not text"),
    "huge": ("lease_0", "gw-1", b" " * (SMALL + 1), f"it has {SMALL + 1} bytes, and {SMALL} are the most"),
    "a huge plant": ("plant", "line-1", b" " * (LARGE + 1), f"and {LARGE} are the most"),
}


@table("name", STRANGE)
def test_invalid_records_are_rejected(name: str) -> None:
    bucket, key, data, mistake = STRANGE[name]
    value, found = parsed(bucket, key, data)
    assert value is None
    assert found.endswith(mistake)


@table(
    ("bucket", "key", "value"), [("lease_2", "gw-1", LEASE), ("own_0", "l", OWNER), ("plant", "line-1", LINE)]
)
def test_records_may_have_fields_of_a_newer_version(bucket: str, key: str, value: dict[str, Any]) -> None:
    assert parsed(bucket, key, json.dumps(value).encode()) == (value, "")
    more = {**value, "of another version": [1, 2]}
    assert parsed(bucket, key, json.dumps(more).encode()) == (more, "")
    assert parsed(bucket, key, b"") == (None, "")  # empty: the record was removed


async def test_an_invalid_record_is_logged_once(one: Cluster, caplog: pytest.LogCaptureFixture) -> None:
    async with connected_path(one) as path:
        bucket = Bucket("own_2", lambda: path)
        await path.request("$KV.own_2.bad", b"{}")
        stored = await bucket.put("good", OWNER, 0)
        for _ in range(3):
            found = {record.key: record.value for record in await bucket.changes(0)}
            assert found == {"bad": None, "good": OWNER}
        assert (await bucket.get("bad")).value is None
        assert (await bucket.get("good")).revision == stored

    told = [record.getMessage() for record in caplog.records]
    assert told == ["ignored the record bad of the bucket own_2: it has no 'gateway'"]


async def test_servers_reject_huge_records_and_rollup_headers(one: Cluster) -> None:
    async with connected_path(one) as path:
        bucket = Bucket("own_2", lambda: path)
        await bucket.put("stays", OWNER, 0)
        for data, headers in ((b" " * (SMALL + 1), None), (b"{}", {"Nats-Rollup": "all"})):
            answer = json.loads((await path.request("$KV.own_2.rogue", data, headers)).data)
            assert "error" in answer
        assert (await bucket.get("stays")).value == OWNER


async def test_a_lease_record_written_by_another_gateway_ends_the_session(one: Cluster) -> None:
    async with connected_path(one) as path:
        own, rogue = (LeaseBucket("lease_0", lambda: path, name) for name in ("gw-1", "gw-2"))
        revision = await own.put("gw-1", {**LEASE, "by": "me"}, 0)
        assert (await rogue.get("gw-1")).value == LEASE  # the bucket ignores the writer's "by"
        await rogue.put("gw-1", {**LEASE, "session": 8, "ended": False}, revision)
        ended = {**LEASE, "session": 8, "ended": True, "by": "gw-2"}
        assert (await own.get("gw-1")).value == ended
        assert [record.value for record in await own.changes(revision)] == [ended]


@pytest.mark.long
async def test_a_gateway_survives_invalid_records(one: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before the gateway starts, each bucket has an invalid record of each kind; it gets more later."""
    monkeypatch.setattr(member_module, "SETTLE_S", 1.0)

    async def strew(path: ServerPath, suffix: str) -> None:
        for bucket in names.BUCKETS:
            for number, (_, _, data, _) in enumerate(STRANGE.values()):
                key = f"gw-{number}.rogue" if bucket in names.LEASES else f"line-{number}"
                await path.request(f"$KV.{bucket}.{key}{suffix}", data[:SMALL])

    async with connected_path(one) as path, opened_paths(one.urls) as paths:
        await strew(path, "-before")
        await store(Bucket(names.PLANT, lambda: path), {"line-1": LINE})
        mastership = RecordingMastership(boottime_ns)
        terms = USUAL._replace(lease=10 * SECOND)  # longer than a busy machine may suspend the test
        member = Member("gw-a", paths, Hall().add("gw-a", mastership), mastership, terms=terms)
        task = asyncio.create_task(member.run())

        async def until_polled(*, is_first: bool) -> None:
            while list(member.polled) != ["line-1"] or (member.lease.session == 1) is not is_first:
                await asyncio.wait([task], timeout=0.05)
                assert not task.done(), task.exception()

        await until_polled(is_first=True)
        await strew(path, "-again")
        await asyncio.wait([task], timeout=1.0)
        await until_polled(is_first=True)
        # Two of the gateway's own lease records become invalid. Its session ends, and it starts a new one.
        for bucket in names.LEASES[:2]:
            await path.request(f"$KV.{bucket}.gw-a.rogue", b"{")
        await until_polled(is_first=False)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


@pytest.mark.long
async def test_wrongly_ended_session_keeps_its_lines_until_the_lease_expires(
    one: Cluster,
) -> None:
    """The gateway's process may hang. Its engine then continues to poll until the lease expires."""
    async with connected_path(one) as path:
        await store(Bucket(names.PLANT, lambda: path), {"line-1": LINE})
        hall, members, tasks = Hall(), {}, {}
        for name in ("gw-p", "gw-q"):
            paths = paths_of(one.urls)
            await open_all(paths)
            mastership = RecordingMastership(boottime_ns)
            members[name] = Member(name, paths, hall.add(name, mastership), mastership)
            tasks[name] = asyncio.create_task(members[name].run())
        while not any(member.polled for member in members.values()):
            await asyncio.sleep(0.05)
        holder, other = sorted(members.values(), key=lambda member: not member.polled)
        holder._leave = _do_nothing
        tasks[holder.name].cancel()
        await asyncio.gather(tasks[holder.name], return_exceptions=True)
        for bucket in names.LEASES:
            rogue = LeaseBucket(bucket, lambda: path, "rogue")
            record = await rogue.get(holder.name)
            await rogue.put(holder.name, record.value, record.revision)
        while not other.polled:
            await asyncio.sleep(0.05)
        assert hall.overlaps == []
        tasks[other.name].cancel()
        await asyncio.gather(tasks[other.name], return_exceptions=True)
        for member in members.values():
            for opened in member.paths:
                await opened.close()


async def _do_nothing() -> None:
    pass


SPOOL = {"bytes": 0, "lost": 0, "behind": None, "lag_s": 1.5, "trouble": None}
STATE = {"state": "working", "lines": 1, "margin_s": 2.0, "trouble": "", "troubles": {}, "spool": SPOOL}


@pytest.mark.parametrize(
    ("answer", "mistake"),
    [
        (b"{", "it has no 'state'"),
        (b"[[[]]]", "not a table"),
        (b"[" * 500_000, "it has no 'state'"),
        (json.dumps({**STATE, "lines": "1"}).encode(), "its 'lines' is not a whole number"),
        (json.dumps({**STATE, "margin_s": None}).encode(), "its 'margin_s' is not a number"),
        (json.dumps({**STATE, "trouble": 5}).encode(), "its 'trouble' is not a text"),
        (json.dumps({**STATE, "spool": {"bytes": 0}}).encode(), "it has no 'lost'"),
        (
            json.dumps({**STATE, "spool": {**SPOOL, "lag_s": "2 s"}}).encode(),
            "its 'lag_s' is not a number or",
        ),
    ],
)
async def test_an_invalid_gateway_state_is_reported(one: Cluster, answer: bytes, mistake: str) -> None:
    async with connected_path(one) as path:

        async def lie(message: Msg) -> None:
            await message.respond(answer)

        await path.subscribe("gateway.liar.*", lie)
        with pytest.raises(FleetError, match=f"the answer of liar is not a gateway's state: {mistake}"):
            await ask_gateway(path, "liar", "state")


@pytest.mark.slow
async def test_a_refused_request_is_reported_in_one_sentence(one: Cluster, tmp_path: Path) -> None:
    async with connected_path(one) as path:
        with pytest.raises(ServerError, match="NATS refuses: "):
            await Bucket("nothing", lambda: path).get("gw-1")


# ---- invalid answers instead of JetStream's: each is reported in one sentence, and ends no task ----


STRANGE_ANSWERS = {
    "nothing": b"",
    "truncated": b'{"stream": "KV_own_0", "se',
    "no text": b"\xff\xfe\x00",
    "deep": b"[" * 500_000,
    "a number of 10,000 digits": b'{"seq": ' + b"9" * 10_000 + b"}",
    "a list": b"[1]",
    "null": b"null",
    "an error that is none": b'{"error": "no"}',
    "an error that is a list": b'{"error": [1]}',
}
PARTS = {
    "without a sequence": b"{}",
    "a text for a sequence": b'{"seq": "one"}',
    "a list for a sequence": b'{"seq": [1]}',
    "a message that is none": b'{"message": 5, "seq": null}',
    "a message of nothing": b'{"message": {}, "seq": null}',
    "no base 64": b'{"message": {"subject": "$KV.own_0.a", "seq": 1, "data": "QUI", "hdrs": "QUI"}}',
    "data of another kind": b'{"message": {"subject": "$KV.own_0.a", "seq": 1, "data": 5, "hdrs": 5}}',
    "a sequence that is none": b'{"message": {"subject": "$KV.own_0.a", "seq": "x"}, "config": 5}',
}
CLUSTERS = {
    "a text": b'{"cluster": "n1"}',
    "a list": b'{"cluster": [1]}',
    "null": b'{"cluster": null}',
    "replicas that are a table": b'{"cluster": {"leader": "n1", "replicas": {"name": "n2"}}}',
    "replicas that are texts": b'{"cluster": {"leader": "n1", "replicas": ["n2", "n3"]}}',
    "a replica without a name": b'{"cluster": {"leader": "n1", "replicas": [{"current": true}]}}',
    "a list for a time": b'{"cluster": {"leader": "n1", "replicas": [{"name": "n2", "active": [1]}]}}',
}
TIMES = {
    "none": b"{}",
    "a number": b'{"ts": 5}',
    "a text that is none": b'{"ts": "now"}',
    "the year one": b'{"ts": "0001-01-01T00:00:00"}',
}


class Liar:
    """A server connection or client that gives the answer `said` to every request."""

    url = "nats://liar"
    server_name = "liar"

    def __init__(self, answer: bytes) -> None:
        self.answer = answer
        self.asked: list[str] = []

    async def request(self, subject: str, *_: Any, **__: Any) -> Any:
        self.asked.append(subject)
        return SimpleNamespace(data=self.answer)

    async def request_all(self, requests: Sequence[Any]) -> list[bytes]:
        return [self.answer for _ in requests]


@pytest.mark.parametrize("name", [*STRANGE_ANSWERS, *PARTS])
async def test_an_invalid_answer_of_a_server_raises_a_fleet_error(name: str) -> None:
    """Gateway, forwarder and hub retry after a FleetError. Any other exception would end them."""
    path: Any = Liar({**STRANGE_ANSWERS, **PARTS}[name])
    bucket = Bucket("own_0", lambda: path)
    for request in (bucket.put("a", {}, 1), bucket.get("a")):
        with pytest.raises(OutcomeUnknown, match="the answer of NATS "):
            await request
    assert await bucket.put_all([Record("a", 1, {})]) == ([], set())
    for request in (
        samples_stream.stream_info(path),
        samples_stream.last_of(path, "samples.gw.log"),
        samples_stream.publish(path, "samples.gw.log", b"", {}),
    ):
        with pytest.raises(FleetError, match="the answer of NATS "):
            await request


@pytest.mark.parametrize("name", CLUSTERS)
async def test_an_invalid_answer_about_servers_changes_no_leader(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Exceptions would end the gateway's tasks that read the states of clusters."""
    monkeypatch.setattr(setup, "WAIT_S", 0.0)  # the test does not wait for an election
    path: Any = Liar(CLUSTERS[name])
    with pytest.raises(FleetError, match="the answer of NATS about a bucket's servers is invalid"):
        await check_buckets(path)
    assert await known_cluster(path, names.OWNERS[0]) == Leaders()
    assert await led_clusters(path) == {}
    assert {subject.split(".KV_")[0] for subject in path.asked} == {"$JS.API.STREAM.INFO"}


@pytest.mark.parametrize("name", TIMES)
async def test_an_invalid_time_in_a_servers_answer_is_reported(name: str) -> None:
    path: Any = Liar(TIMES[name])
    with pytest.raises(
        OutcomeUnknown, match="the answer of nats://liar about a bucket has no valid time stamp"
    ):
        await check_buckets(path)


LONG = {**STATE, "trouble": "x" * 10**6, "troubles": {"hall": "y" * 10**6}}


async def test_long_texts_in_a_gateway_state_are_shortened() -> None:
    """NATS limits the size of an answer, and the page shows each text of an answer without shortening it."""
    answers: list[bytes] = []

    async def respond(data: bytes) -> None:
        answers.append(data)

    member = SimpleNamespace(lease=SimpleNamespace(session=1))
    gateway: Any = SimpleNamespace(name="gw-1", member=member, state=lambda: LONG)
    message: Any = SimpleNamespace(reply="_INBOX.a.b", subject="gateway.gw-1.state", respond=respond)
    await FleetGateway._answer(gateway, message)
    assert len(answers[0]) < 2000
    path: Any = Liar(json.dumps(LONG).encode())
    found = await ask_gateway(path, "gw-1", "state")
    assert found["troubles"] == {"hall": "y" * 300}
    assert len(json.dumps(found)) < 2000
