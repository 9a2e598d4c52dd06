"""Answers of NATS that an asker wants sent where he may not write: none leaves his own account.

Each attempt is made twice: with the accounts as written, and with one account for all, where each arrives.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager
from fnmatch import fnmatchcase
from pathlib import Path

import pytest
from peers import require_module

require_module("nats")
require_module("nkeys")
require_module("pyarrow")

from nats.aio.client import Client  # noqa: E402
from nats.aio.msg import Msg  # noqa: E402
from secured_clusters import SecuredCluster, in_one_account, secured_cluster  # noqa: E402

from multidrop.fleet.credentials import inbox_of, public_key  # noqa: E402
from multidrop.fleet.rights import OTHERS, rights_of  # noqa: E402
from multidrop.fleet.samples_stream import STREAM, connect, create_stream  # noqa: E402
from multidrop.fleet.servers import paths_of  # noqa: E402
from multidrop.fleet.setup import set_up  # noqa: E402

PATIENCE_S = 60.0
GATEWAYS = ("gw-a", "gw-b")
USERS = ("gw-a", *OTHERS)
WRITERS = {  # of a record of their own, in each stream that an answer could be stored in
    "$KV.plant.last": "operator",
    "$KV.lease_0.gw-b.gw-b": "gw-b",
    "$KV.own_0.last": "gw-b",
    f"{STREAM}.gw-b.log": "gw-b",
}
STORED = (*WRITERS, "$KV.plant.line-1", "$KV.own_0.line-1")
HEARD = ("stop.line-1", "cmd.line-1", "do.gw-b.run", "gateway.gw-b.drain", "gateway.gw-b.state")


async def make_streams(servers: SecuredCluster) -> None:
    """Make a fleet's buckets and its stream of samples."""
    operator = paths_of(servers.urls, servers.options("operator"))
    await set_up(operator)
    for path in operator:
        await path.close()
    client = await connect(servers.urls, **servers.options("operator"))
    await create_stream(client, replicas=len(servers.nodes))
    await client.close()


@asynccontextmanager
async def connected(servers: SecuredCluster, url: str) -> AsyncIterator[Mapping[str, Client]]:
    """Yield a connection of each user, all to one server: so what they send is stored in that order."""
    clients = {user: Client() for user in (*GATEWAYS, *OTHERS)}
    try:
        for user, client in clients.items():
            await client.connect(url, allow_reconnect=False, **servers.options(user))
        yield clients
    finally:
        for client in clients.values():
            await client.close()


def questions(user: str) -> Iterator[tuple[str, bytes]]:
    """Yield what a user may ask the store, each of which is answered."""
    stream, key = ("samples", "samples.gw-b.log") if user == "hub" else ("KV_own_0", "$KV.own_0.last")
    yield f"$JS.API.DIRECT.GET.{stream}", json.dumps({"last_by_subj": key}).encode()
    yield f"$JS.API.STREAM.INFO.{stream}", b""
    if user in GATEWAYS:
        wanted = {"last_by_subj": "$KV.lease_0.gw-b.gw-b"}
        yield "$JS.API.STREAM.MSG.GET.KV_lease_0", json.dumps(wanted).encode()
        yield f"$KV.own_1.of-{user}", b"{}"


def foreign(user: str, inboxes: Mapping[str, str]) -> Iterator[str]:
    """Yield subjects that a user may not publish to."""
    allowed: Sequence[str] = rights_of(GATEWAYS)[user].publish
    for subject in (*STORED, *HEARD, *(inboxes[other] for other in inboxes if other != user)):
        if not any(fnmatchcase(subject, one) for one in allowed):
            yield subject


def all_inboxes(servers: SecuredCluster) -> dict[str, str]:
    """Return a subject of each user's inbox."""
    public = {user: public_key(servers.key(user).read_text().strip()) for user in (*GATEWAYS, *OTHERS)}
    return {user: f"{inbox_of(key)}.x" for user, key in public.items()}


async def arrivals(servers: SecuredCluster) -> dict[str, set[str]]:
    """Let each user ask each server for answers everywhere.

    Return where one was heard, and a key of each stream that stored one.
    """
    found: dict[str, set[str]] = {user: set() for user in USERS}
    await make_streams(servers)
    for url in servers.urls:
        for user, subjects in (await arrivals_at(servers, url)).items():
            found[user] |= subjects
    return found


async def arrivals_at(servers: SecuredCluster, url: str) -> dict[str, set[str]]:
    """Do that at one server."""
    found: dict[str, set[str]] = {}
    inboxes = all_inboxes(servers)
    async with connected(servers, url) as clients:
        heard: asyncio.Queue[str] = asyncio.Queue()

        async def hear(message: Msg) -> None:
            heard.put_nowait(message.subject)

        for user, subject in (
            *(("gw-b", subject) for subject in ("stop.*", "cmd.*", "do.gw-b.*", "gateway.gw-b.*")),
            *((user, inboxes[user]) for user in inboxes),
        ):
            await clients[user].subscribe(subject, cb=hear)
            await clients[user].flush()
        last = {subject: await stored(clients[user], subject) for subject, user in WRITERS.items()}
        for user in USERS:
            for subject, data in questions(user):
                for elsewhere in foreign(user, inboxes):
                    await clients[user].publish(subject, data, reply=elsewhere)
                await clients[user].request(subject, data, PATIENCE_S)  # the servers answer in order
            found[user] = set()
            for subject, writer in WRITERS.items():
                now = await stored(clients[writer], subject)
                if now != last[subject] + 1:
                    found[user].add(subject)
                last[subject] = now
            for client in clients.values():
                await client.flush()
            await clients["commander"].publish("stop.end")
            while (subject := await asyncio.wait_for(heard.get(), PATIENCE_S)) != "stop.end":
                found[user].add(subject)
    return found


def key_of_its_stream(subject: str) -> str:
    """Return what stands for all of a stream, and a subject that none stores as it is."""
    name = subject.rpartition(".")[0].removesuffix(".gw-b")
    return next((key for key in WRITERS if key.startswith(f"{name}.")), subject)


async def stored(client: Client, subject: str) -> int:
    """Store a record, and return its sequence."""
    answer = await client.request(subject, b"{}", PATIENCE_S)
    return int(json.loads(answer.data)["seq"])


@pytest.mark.parametrize("number", [1, pytest.param(3, marks=pytest.mark.long)])
def test_no_answer_leaves_its_askers_account(tmp_path: Path, number: int) -> None:
    with secured_cluster(tmp_path, number, GATEWAYS) as servers:
        found = asyncio.run(asyncio.wait_for(arrivals(servers), PATIENCE_S))
    assert found == {user: set() for user in USERS}


@pytest.mark.parametrize("number", [1, pytest.param(3, marks=pytest.mark.long)])
def test_in_one_account_each_answer_arrives(tmp_path: Path, number: int) -> None:
    with secured_cluster(tmp_path, number, GATEWAYS, in_one_account) as servers:
        found = asyncio.run(asyncio.wait_for(arrivals(servers), PATIENCE_S))
        inboxes = all_inboxes(servers)
    for user in USERS:
        assert found[user] == {key_of_its_stream(subject) for subject in foreign(user, inboxes)}
