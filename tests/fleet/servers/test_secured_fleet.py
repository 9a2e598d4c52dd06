"""Servers with the rights that `fleet rights` writes: errors for missing rights, and where answers may go."""

from __future__ import annotations

import asyncio
import json
import ssl
import time
import urllib.request
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Set
from contextlib import asynccontextmanager, closing
from fnmatch import fnmatchcase
from pathlib import Path

import pytest
from commands import Run
from fleets import plant_text
from nats.aio.client import Client
from nats.aio.msg import Msg
from nats_clusters import cluster, initialised, opened_paths
from secured_clusters import (
    PATIENCE_S,
    SecuredCluster,
    SecuredNode,
    certificates,
    in_one_account,
    multidrop,
    secured_cluster,
    until,
)
from spooled import numbered

from multidrop.fleet.samples.hub import SourceCheck
from multidrop.fleet.samples.samples_stream import (
    DIGEST,
    LOST,
    SEQUENCE,
    STREAM,
    StreamMessage,
    create_stream,
    digest_of,
    publish,
    read_after,
    samples_path,
    subject_of,
)
from multidrop.fleet.servers import setup
from multidrop.fleet.servers.connections import inbox_of, new_seed, public_key
from multidrop.fleet.servers.files import OTHERS, rights_of
from multidrop.samples.spool import Spool


@pytest.fixture(scope="module")
def servers(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SecuredCluster]:
    """Yield one server with a fleet's buckets and rights."""
    folder = tmp_path_factory.mktemp("nats")
    (folder / "plant.toml").write_text(plant_text())
    with secured_cluster(folder, 1) as running:
        made = multidrop(running, "operator", "fleet", "init", str(folder / "plant.toml"))
        assert made.returncode == 0, made.stderr
        yield running


@pytest.mark.slow  # marked as slow because slow tests start first, and this file takes longest
@pytest.mark.long
def test_a_route_to_a_silent_server_is_dropped_soon(tmp_path: Path) -> None:
    """With default settings, NATS forwards requests to the silent server for more than a minute."""

    def routes(node: SecuredNode) -> int:
        with urllib.request.urlopen(f"http://127.0.0.1:{node.monitor}/routez", timeout=5) as answer:
            return int(json.load(answer)["num_routes"])

    with secured_cluster(tmp_path, 2) as running:
        one, other = running.nodes
        until(lambda: routes(one) > 0, "there are routes")
        begun = time.monotonic()
        other.pause()
        until(lambda: routes(one) == 0, "its routes are left")
        assert time.monotonic() - begun < 30
        other.go_on()
        until(lambda: routes(one) > 0, "there are routes again")


NO_RIGHT = "these credentials do not allow "
NOT_THEIRS = [
    ("viewer", ["fleet", "init"], NO_RIGHT + "publishing to $JS.API.STREAM.INFO.KV_contest"),
    ("hub", ["fleet", "status"], NO_RIGHT + "publishing to $JS.API.STREAM.INFO.KV_lease_0"),
    ("viewer", ["fleet", "drain", "gw-a"], NO_RIGHT + "publishing to gateway.gw-a.drain"),
    ("gw-a", ["fleet", "serve", "gw-b"], NO_RIGHT + "listening to gateway.gw-b.*"),
    ("viewer", ["hub", "--once"], NO_RIGHT + "publishing to $JS.API.STREAM.INFO"),
]


@pytest.mark.long
@pytest.mark.parametrize(("user", "words", "sentence"), NOT_THEIRS)
def test_a_missing_right_is_reported_in_one_sentence(
    servers: SecuredCluster, tmp_path: Path, user: str, words: list[str], sentence: str
) -> None:
    folder = {"serve": ["--folder", f"{tmp_path}/gateway"], "--once": ["--parquet", f"{tmp_path}/hub"]}
    said = multidrop(servers, user, *words, *folder.get(words[1], ()))
    assert said.returncode == 1
    lines = said.stderr.splitlines()
    assert len(lines) == 1 + (words[0] == "hub")  # the hub also logs the sentence, so it prints two lines
    assert sentence.lower() in lines[-1].lower()


@pytest.mark.slow
def test_hub_ignores_samples_forged_by_another_gateway(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """With one NATS account for all users, servers would send stored messages to any reply subject."""

    async def main(servers: SecuredCluster) -> None:
        await make_streams(servers)
        with closing(Spool(tmp_path / "spool", "gw-b")) as spool:
            spool.append(numbered(0, 10))
            assert spool.sync(PATIENCE_S)
            stored = spool.following(0)
            assert stored
            data, subject = stored.path.read_bytes(), subject_of("gw-b", spool.log)
        async with samples_path(servers.urls, servers.options("gw-a")) as path:
            headers = {SEQUENCE: "1", DIGEST: digest_of(data), LOST: "0"}
            assert await publish(path, "$KV.own_0.any", data, headers)
            wanted = json.dumps({"last_by_subj": "$KV.own_0.any"}).encode()
            assert path._client
            await path._client.publish("$JS.API.DIRECT.GET.KV_own_0", wanted, reply=subject)
            await path._client.flush()
        found: list[StreamMessage] = []
        async with samples_path(servers.urls, servers.options("hub")) as path:
            while not found:
                found = await read_after(path, 0, 10, 1 << 20)
        [message] = found
        assert (message.gateway, message.data, message.sequence) == ("gw-b", data, 0)
        assert not SourceCheck({}).take(message)

    with secured_cluster(tmp_path / "nats", 1, change=in_one_account) as servers:
        asyncio.run(asyncio.wait_for(main(servers), PATIENCE_S))
    assert "has no number and is ignored" in caplog.text


def other_ca(servers: SecuredCluster, folder: Path) -> list[str]:
    return ["--ca", str(certificates(folder / "other").ca)]


def no_key(servers: SecuredCluster, folder: Path) -> list[str]:
    return ["--credentials", str(folder / "none.key")]


def damaged_key(servers: SecuredCluster, folder: Path) -> list[str]:
    (folder / "hub.key").write_text("SUDDENLY")
    return ["--credentials", str(folder / "hub.key")]


def strange_key(servers: SecuredCluster, folder: Path) -> list[str]:
    (folder / "hub.key").write_bytes(b"\xff\x00 password")
    return ["--credentials", str(folder / "hub.key")]


def strange_ca(servers: SecuredCluster, folder: Path) -> list[str]:
    (folder / "ca.pem").write_text("no certificate")
    return ["--ca", str(folder / "ca.pem")]


def unknown_key(servers: SecuredCluster, folder: Path) -> list[str]:
    (folder / "stranger.key").write_text(new_seed())
    return ["--credentials", str(folder / "stranger.key")]


MISTAKES: dict[str, tuple[Callable[[SecuredCluster, Path], list[str]], int, str]] = {
    "another authority": (other_ca, 1, "is not trusted (unable to get local issuer certificate)"),
    "no such key": (no_key, 2, "none.key: No such file or directory"),
    "a damaged key": (damaged_key, 2, "hub.key is not a valid key file of `multidrop fleet rights`"),
    "something else": (
        strange_key,
        2,
        "hub.key has no credentials: name a key file of `multidrop fleet rights`",
    ),
    "no certificate": (strange_ca, 2, "ca.pem has no certificate: it must be a PEM file"),
    "an unknown key": (unknown_key, 1, "refuses these credentials, or the lack of any"),
}


@pytest.mark.long
@pytest.mark.parametrize("command", ["status", "hub"])
@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistaken_credentials_are_reported_in_one_sentence(
    servers: SecuredCluster, tmp_path: Path, mistake: str, command: str
) -> None:
    make, status, sentence = MISTAKES[mistake]
    start = {"status": ["fleet", "status"], "hub": ["hub", *servers.urls, "--parquet", str(tmp_path / "h")]}
    ended, out, err = multidrop(servers, "viewer", *start[command], *make(servers, tmp_path))
    assert (ended, out) == (status, "")
    [line] = err.splitlines()
    assert sentence in line
    # a mistake in the options is found before a folder is created
    assert status == 1 or not (tmp_path / "h").exists()


@pytest.mark.long
@pytest.mark.slow
def test_no_data_is_sent_to_a_server_without_tls(run: Run, servers: SecuredCluster, tmp_path: Path) -> None:
    """An attacker between client and server could read and relay the login."""
    with cluster(tmp_path / "plain", 1) as plain:
        url = plain.urls[0].replace("nats://", "tls://")
        key, ca = str(servers.key("viewer")), str(servers.tls.ca)
        status, _, err = run("fleet", "status", "--nats", url, "--credentials", key, "--ca", ca)
        assert status == 1
        assert "does not start with TLS, which these options require" in err
        status, _, err = run("fleet", "status", "--nats", plain.urls[0], "--ca", ca)
        assert "does not start with TLS, which these options require" in err


@pytest.mark.long
def test_error_for_a_client_without_tls_says_that_tls_is_required(run: Run, servers: SecuredCluster) -> None:
    status, _, err = run("fleet", "status", "--nats", servers.urls[0].replace("tls://", "nats://"))
    assert status == 1
    assert "no answer in time; write tls:// if it requires TLS" in err


@pytest.mark.long
def test_a_client_trusts_only_certificates_of_the_given_authority(servers: SecuredCluster) -> None:
    context = servers.options("hub")["tls"]
    assert context.verify_mode is ssl.CERT_REQUIRED
    assert context.check_hostname
    assert len(context.get_ca_certs()) == 1


@pytest.mark.long
def test_fleet_commands_report_a_missing_server_quorum(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with secured_cluster(tmp_path / "nats", 3) as servers:
        asyncio.run(make_streams(servers))
        for node in servers.nodes[1:]:
            node.kill()
        monkeypatch.setattr(setup, "WAIT_S", 1.0)
        for user, words in (
            ("viewer", ["status"]),
            ("operator", ["drain", "gw-a"]),
            ("gw-a", ["serve", "gw-a", "--folder", str(tmp_path / "gw-a")]),
        ):
            status, out, err = multidrop(servers, user, "fleet", *words)
            assert (status, out, err.count("\n")) == (1, "", 1)
            assert "have no quorum: more than half of them must run" in err


# ---- requests whose answers would go to another user's subjects: no answer leaves the user's account ----


ANSWERS_S = 60.0
TWO_GATEWAYS = ("gw-a", "gw-b")
USERS = ("gw-a", *OTHERS)
STREAMS = ("KV_plant", "KV_lease_0", "KV_own_0", STREAM)


def elsewhere(user: str, inboxes: Mapping[str, str]) -> list[str]:
    """Return subjects of other users, to which `user` may ask servers to send answers."""
    return [
        *(f"$KV.plant.{user}", f"$KV.lease_0.{user}.gw-b", f"$KV.own_0.{user}", f"{STREAM}.gw-b.{user}"),
        *(f"stop.{user}", f"cmd.{user}", f"do.gw-b.{user}", f"gateway.gw-b.{user}"),
        *(f"{inbox}.{user}" for other, inbox in inboxes.items() if other != user),
    ]


async def make_streams(servers: SecuredCluster) -> None:
    await initialised(servers.urls, **servers.options("operator"))
    async with opened_paths(servers.urls, **servers.options("operator")) as operator:
        await create_stream(operator[0], replicas=len(servers.nodes))


@asynccontextmanager
async def connected(servers: SecuredCluster, url: str) -> AsyncIterator[Mapping[str, Client]]:
    """Yield a connection to this server for each user."""
    clients = {user: Client() for user in (*TWO_GATEWAYS, *OTHERS)}
    try:
        for user, client in clients.items():
            await client.connect(url, allow_reconnect=False, **servers.options(user))
        yield clients
    finally:
        for client in clients.values():
            await client.close()


def questions(user: str) -> Iterator[tuple[str, bytes]]:
    """Yield the requests for stored data that this user may send. The servers answer each request."""
    stream, key = (STREAM, f"{STREAM}.gw-b.log") if user == "hub" else ("KV_own_0", "$KV.own_0.last")
    yield f"$JS.API.DIRECT.GET.{stream}", json.dumps({"last_by_subj": key}).encode()
    yield f"$JS.API.STREAM.INFO.{stream}", b""
    if user in TWO_GATEWAYS:
        wanted = {"last_by_subj": "$KV.lease_0.gw-b.gw-b"}
        yield "$JS.API.STREAM.MSG.GET.KV_lease_0", json.dumps(wanted).encode()
        yield f"$KV.own_1.of-{user}", b"{}"


def all_inboxes(servers: SecuredCluster) -> dict[str, str]:
    public = {user: public_key(servers.key(user).read_text().strip()) for user in (*TWO_GATEWAYS, *OTHERS)}
    return {user: inbox_of(key) for user, key in public.items()}


def foreign(servers: SecuredCluster) -> dict[str, list[str]]:
    """Return, for each user, the reply subjects to which that user may not publish."""
    rights, inboxes = rights_of(TWO_GATEWAYS), all_inboxes(servers)
    return {
        user: [
            subject
            for subject in elsewhere(user, inboxes)
            if not any(fnmatchcase(subject, one) for one in rights[user].publish)
        ]
        for user in USERS
    }


async def arrivals(servers: SecuredCluster, wanted: Set[str]) -> set[str]:
    """Let each user request answers on subjects to which it may not publish; return those that got an answer.

    Requests go to each server. The function waits for answers on the `wanted` subjects, because servers do
    not answer in order.
    """
    await make_streams(servers)
    return set[str]().union(*[await arrivals_at(servers, url, wanted) for url in servers.urls])


async def arrivals_at(servers: SecuredCluster, url: str, wanted: Set[str]) -> set[str]:
    """Make the requests of `arrivals` at one server; return the subjects that got an answer."""
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
                await clients[user].request(subject, data, ANSWERS_S)
        ends = time.monotonic() + ANSWERS_S
        while True:
            for client in clients.values():
                await client.flush()
            found = heard.union(*[await stored(clients["operator"], stream) for stream in STREAMS])
            if wanted <= found or time.monotonic() > ends:
                return found


async def stored(client: Client, stream: str) -> set[str]:
    answer = await client.request(f"$JS.API.STREAM.INFO.{stream}", b'{"subjects_filter": ">"}', ANSWERS_S)
    return set(json.loads(answer.data)["state"].get("subjects", ()))


@pytest.mark.slow
@pytest.mark.parametrize("number", [1, pytest.param(3, marks=pytest.mark.long)])
def test_servers_send_no_answer_to_another_users_subject(tmp_path: Path, number: int) -> None:
    with secured_cluster(tmp_path, number, TWO_GATEWAYS) as servers:
        assert asyncio.run(arrivals(servers, set())) == set()


@pytest.mark.slow
@pytest.mark.parametrize("number", [1, pytest.param(3, marks=pytest.mark.long)])
def test_answers_reach_other_users_if_all_users_share_one_account(tmp_path: Path, number: int) -> None:
    with secured_cluster(tmp_path, number, TWO_GATEWAYS, in_one_account) as servers:
        wanted = {subject for subjects in foreign(servers).values() for subject in subjects}
        assert asyncio.run(arrivals(servers, wanted)) == wanted
