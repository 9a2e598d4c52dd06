"""Damaged or hostile records: each is skipped with a warning, and affects no other record."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import pytest
from fleets import Hall, RecordingMastership
from nats.aio.msg import Msg
from nats_clusters import Cluster, connected_path
from tables import table

from multidrop.fleet.errors import FleetError
from multidrop.fleet.gateway import ask_gateway
from multidrop.fleet.leases import member as member_module
from multidrop.fleet.leases.lease import boottime_ns
from multidrop.fleet.leases.member import Member
from multidrop.fleet.leases.rules import SECOND, USUAL
from multidrop.fleet.servers import names
from multidrop.fleet.servers.buckets import Bucket, LeaseBucket, ServerError
from multidrop.fleet.servers.connections import ServerPath, paths_of
from multidrop.fleet.servers.plant_store import store
from multidrop.fleet.servers.record_shapes import LARGE, SMALL, parsed
from multidrop.fleet.servers.setup import open_all

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


@pytest.mark.parametrize(
    ("bucket", "key", "value"), [("lease_2", "gw-1", LEASE), ("own_0", "l", OWNER), ("plant", "line-1", LINE)]
)
def test_a_valid_record_may_have_further_fields(bucket: str, key: str, value: dict[str, Any]) -> None:
    assert parsed(bucket, key, json.dumps(value).encode()) == (value, "")
    more = {**value, "of another version": [1, 2]}
    assert parsed(bucket, key, json.dumps(more).encode()) == (more, "")
    assert parsed(bucket, key, b"") == (None, "")  # the record was removed


async def test_an_invalid_record_is_logged_once_and_others_are_read(
    one: Cluster, caplog: pytest.LogCaptureFixture
) -> None:
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


async def test_a_record_written_by_another_gateway_is_an_end(one: Cluster) -> None:
    async with connected_path(one) as path:
        own, rogue = (LeaseBucket("lease_0", lambda: path, name) for name in ("gw-1", "gw-2"))
        revision = await own.put("gw-1", {**LEASE, "by": "me"}, 0)
        assert (await rogue.get("gw-1")).value == LEASE  # no other user has written a record
        await rogue.put("gw-1", {**LEASE, "session": 8, "ended": False}, revision)
        ended = {**LEASE, "session": 8, "ended": True, "by": "gw-2"}
        assert (await own.get("gw-1")).value == ended
        assert [record.value for record in await own.changes(revision)] == [ended]


@pytest.mark.long
async def test_no_gateway_ends_by_strange_records(one: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each bucket has an invalid record of each kind before the gateway starts, and gets more later."""
    monkeypatch.setattr(member_module, "SETTLE_S", 1.0)

    async def strew(path: ServerPath, suffix: str) -> None:
        for bucket in names.BUCKETS:
            for number, (_, _, data, _) in enumerate(STRANGE.values()):
                key = f"gw-{number}.rogue" if bucket in names.LEASES else f"line-{number}"
                await path.request(f"$KV.{bucket}.{key}{suffix}", data[:SMALL])

    async with connected_path(one) as path:
        paths = paths_of(one.urls)
        await open_all(paths)
        await strew(path, "-before")
        await store(Bucket(names.PLANT, lambda: path), {"line-1": LINE})
        mastership = RecordingMastership(boottime_ns)
        terms = USUAL._replace(lease=10 * SECOND)  # long enough for a busy machine
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
        for bucket in names.LEASES[:2]:  # our own records: losing them costs only a session
            await path.request(f"$KV.{bucket}.gw-a.rogue", b"{")
        await until_polled(is_first=False)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        for other in paths:
            await other.close()


@pytest.mark.long
async def test_an_early_end_by_another_counts_once_the_lease_has_expired(one: Cluster) -> None:
    """The gateway may hang while its engine polls on: it cannot know that its session was ended."""
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
        holder._leave = _do_nothing  # type: ignore[method-assign]
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
async def test_a_refusal_by_the_servers_is_one_sentence(one: Cluster, tmp_path: Path) -> None:
    async with connected_path(one) as path:
        with pytest.raises(ServerError, match="NATS refuses: "):
            await Bucket("nothing", lambda: path).get("gw-1")
