"""Requests whose answers would go to another user's subjects: no answer leaves the user's account.

Each attempt is made twice: with the accounts as written, and with one account for all users, in which every
answer arrives. The second run proves that the attempts are valid.
"""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator, Iterator, Mapping, Set
from contextlib import asynccontextmanager
from fnmatch import fnmatchcase
from pathlib import Path

import pytest
from nats.aio.client import Client
from nats.aio.msg import Msg
from secured_clusters import SecuredCluster, in_one_account, secured_cluster

from multidrop.fleet.samples.samples_stream import STREAM, create_stream
from multidrop.fleet.servers.connections import paths_of
from multidrop.fleet.servers.credentials import inbox_of, public_key
from multidrop.fleet.servers.rights import OTHERS, rights_of
from multidrop.fleet.servers.setup import set_up

PATIENCE_S = 60.0
GATEWAYS = ("gw-a", "gw-b")
USERS = ("gw-a", *OTHERS)
STREAMS = ("KV_plant", "KV_lease_0", "KV_own_0", STREAM)


def elsewhere(user: str, inboxes: Mapping[str, str]) -> list[str]:
    """Return subjects of other users to give as reply subjects. Each contains the name of `user`."""
    return [
        *(f"$KV.plant.{user}", f"$KV.lease_0.{user}.gw-b", f"$KV.own_0.{user}", f"{STREAM}.gw-b.{user}"),
        *(f"stop.{user}", f"cmd.{user}", f"do.gw-b.{user}", f"gateway.gw-b.{user}"),
        *(f"{inbox}.{user}" for other, inbox in inboxes.items() if other != user),
    ]


async def make_streams(servers: SecuredCluster) -> None:
    """Create a fleet's buckets and its stream of samples."""
    operator = paths_of(servers.urls, servers.options("operator"))
    await set_up(operator)
    await create_stream(operator[0], replicas=len(servers.nodes))
    for path in operator:
        await path.close()


@asynccontextmanager
async def connected(servers: SecuredCluster, url: str) -> AsyncIterator[Mapping[str, Client]]:
    """Yield a connection to this server for each user."""
    clients = {user: Client() for user in (*GATEWAYS, *OTHERS)}
    try:
        for user, client in clients.items():
            await client.connect(url, allow_reconnect=False, **servers.options(user))
        yield clients
    finally:
        for client in clients.values():
            await client.close()


def questions(user: str) -> Iterator[tuple[str, bytes]]:
    """Yield the requests to stored data that a user may send. Each of them is answered."""
    stream, key = (STREAM, f"{STREAM}.gw-b.log") if user == "hub" else ("KV_own_0", "$KV.own_0.last")
    yield f"$JS.API.DIRECT.GET.{stream}", json.dumps({"last_by_subj": key}).encode()
    yield f"$JS.API.STREAM.INFO.{stream}", b""
    if user in GATEWAYS:
        wanted = {"last_by_subj": "$KV.lease_0.gw-b.gw-b"}
        yield "$JS.API.STREAM.MSG.GET.KV_lease_0", json.dumps(wanted).encode()
        yield f"$KV.own_1.of-{user}", b"{}"


def all_inboxes(servers: SecuredCluster) -> dict[str, str]:
    """Return the prefix of each user's inboxes."""
    public = {user: public_key(servers.key(user).read_text().strip()) for user in (*GATEWAYS, *OTHERS)}
    return {user: inbox_of(key) for user, key in public.items()}


def foreign(servers: SecuredCluster) -> dict[str, list[str]]:
    """Return the reply subjects for each user to which that user may not publish."""
    rights, inboxes = rights_of(GATEWAYS), all_inboxes(servers)
    return {
        user: [
            subject
            for subject in elsewhere(user, inboxes)
            if not any(fnmatchcase(subject, one) for one in rights[user].publish)
        ]
        for user in USERS
    }


async def arrivals(servers: SecuredCluster, wanted: Set[str]) -> set[str]:
    """Let each user request answers on forbidden subjects; return the subjects that got one.

    Requests go to each server. Answers on the `wanted` subjects are waited for, because servers do not answer
    in order.
    """
    await make_streams(servers)
    return set[str]().union(*[await arrivals_at(servers, url, wanted) for url in servers.urls])


async def arrivals_at(servers: SecuredCluster, url: str, wanted: Set[str]) -> set[str]:
    """Return the subjects that got an answer, like `arrivals`, for requests to one server."""
    heard: set[str] = set()

    async def hear(message: Msg) -> None:
        heard.add(message.subject)

    async with connected(servers, url) as clients:
        for user, subject in (
            *(("gw-b", subject) for subject in ("stop.*", "cmd.*", "do.gw-b.*", "gateway.gw-b.*")),
            *((user, f"{inbox}.*") for user, inbox in all_inboxes(servers).items()),
        ):
            await clients[user].subscribe(subject, cb=hear)
            await clients[user].flush()
        for user, subjects in foreign(servers).items():
            for subject, data in questions(user):
                for other in subjects:
                    await clients[user].publish(subject, data, reply=other)
                await clients[user].request(subject, data, PATIENCE_S)
        ends = time.monotonic() + PATIENCE_S
        while True:
            for client in clients.values():
                await client.flush()
            found = heard.union(*[await stored(clients["operator"], stream) for stream in STREAMS])
            if wanted <= found or time.monotonic() > ends:
                return found


async def stored(client: Client, stream: str) -> set[str]:
    """Return all subjects in a stream."""
    answer = await client.request(f"$JS.API.STREAM.INFO.{stream}", b'{"subjects_filter": ">"}', PATIENCE_S)
    return set(json.loads(answer.data)["state"].get("subjects", ()))


@pytest.mark.slow
@pytest.mark.parametrize("number", [1, pytest.param(3, marks=pytest.mark.long)])
def test_no_answer_leaves_the_requesters_account(tmp_path: Path, number: int) -> None:
    with secured_cluster(tmp_path, number, GATEWAYS) as servers:
        assert asyncio.run(arrivals(servers, set())) == set()


@pytest.mark.parametrize("number", [1, pytest.param(3, marks=pytest.mark.long)])
def test_in_one_account_for_all_each_answer_arrives(tmp_path: Path, number: int) -> None:
    with secured_cluster(tmp_path, number, GATEWAYS, in_one_account) as servers:
        wanted = {subject for subjects in foreign(servers).values() for subject in subjects}
        assert asyncio.run(arrivals(servers, wanted)) == wanted
