"""Rights from the files of `fleet rights`: what servers must refuse, and whole fleets with these rights.

Each attempt to send a forbidden request is made at two servers. The server with these rights must refuse it.
The server on which users may do everything must accept it, which proves that the attempt is valid.
"""

from __future__ import annotations

import asyncio
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from commands import Run
from nats.aio.client import Client
from secured_clusters import GATEWAYS as THREE_GATEWAYS
from secured_clusters import (
    PATIENCE_S,
    SecuredCluster,
    SecuredFleet,
    multidrop,
    secured_cluster,
    secured_fleet,
    until,
)

from multidrop.fleet.errors import Conflict, Denials, MayNotSend, NoRight
from multidrop.fleet.servers import names
from multidrop.fleet.servers.buckets import LeaseBucket
from multidrop.fleet.servers.connections import connect_options, inbox_of, paths_of, public_key
from multidrop.fleet.servers.files import OTHERS, rights_of

GATEWAYS = ("gw-a", "gw-b")
USERS = (*GATEWAYS, *OTHERS)
STREAMS = ("samples", "KV_lease_0", "KV_own_0", "KV_plant")
DEEDS = ("DELETE", "PURGE", "UPDATE", "MSG.DELETE", "SNAPSHOT", "PEER.REMOVE")
CONSUMERS = ("CONSUMER.CREATE.{}", "CONSUMER.CREATE.{}.c.>", "CONSUMER.DURABLE.CREATE.{}.c")
COMMANDS = ("cmd.line-1", "stop.line-1", "do.gw-b.run")

# subjects that are forbidden for one user; NOBODY has those that are forbidden for all users
FORBIDDEN = {
    "gw-a": (
        *("samples.gw-b.log", "samples.gw-c.log", "samples.gw-a"),
        *("$KV.lease_0.gw-b.gw-b", "$KV.lease_1.gw-b.gw-c", "$KV.lease_2.gw-a.gw-b", "$KV.lease_0.gw-b"),
        *("$KV.own_0.line-1.gw-a", "$KV.plant.line-1", "$KV.contest.key.gw-a"),
        *("$JS.API.STREAM.CREATE.samples", "$JS.API.STREAM.CREATE.KV_more"),
        *("$JS.API.DIRECT.GET.samples", "$JS.API.STREAM.MSG.GET.KV_plant"),
        *("$JS.API.STREAM.LEADER.STEPDOWN.samples", "$JS.API.META.LEADER.STEPDOWN"),
        *COMMANDS,
        *("gateway.gw-b.drain", "gateway.gw-b.state", "gateway.gw-a.drain"),
    ),
    "hub": (
        *("samples.gw-a.log", "$KV.lease_0.gw-a.hub", "$KV.own_0.line-1", "$KV.plant.line-1"),
        *("$JS.API.DIRECT.GET.KV_plant", "$JS.API.STREAM.MSG.GET.samples"),
        *COMMANDS,
        *("gateway.gw-a.drain", "gateway.gw-a.state"),
    ),
    "viewer": (
        *("samples.gw-a.log", "$KV.lease_0.gw-a.viewer", "$KV.own_0.line-1", "$KV.plant.line-1"),
        *("$JS.API.DIRECT.GET.samples", "$JS.API.STREAM.LEADER.STEPDOWN.KV_lease_0"),
        *COMMANDS,
        "gateway.gw-a.drain",
    ),
    "commander": (
        *("samples.gw-a.log", "$KV.lease_0.gw-a.gw-a", "$KV.own_0.line-1", "$KV.plant.line-1"),
        *("$JS.API.DIRECT.GET.samples", "$JS.API.STREAM.LEADER.STEPDOWN.KV_lease_0"),
        "gateway.gw-a.drain",
    ),
    "operator": (
        *("samples.gw-a.log", "$KV.lease_0.gw-a.gw-a", "$KV.lease_0.gw-a.operator", "$KV.own_0.line-1"),
        *("$JS.API.STREAM.CREATE.KV_more", "$JS.API.DIRECT.GET.samples"),
        *COMMANDS,
    ),
}
NOBODY = (
    *(f"$JS.API.STREAM.{deed}.{stream}" for deed in DEEDS for stream in STREAMS),
    *(f"$JS.API.{made.format(stream)}" for made in CONSUMERS for stream in STREAMS),
    *(
        "$JS.API.ACCOUNT.PURGE.multidrop",
        "$JS.API.SERVER.REMOVE",
        "$SYS.REQ.SERVER.PING",
        "$JS.API.STREAM.NAMES",
    ),
)
LISTENED = (
    *(">", "*", "samples.>", "samples.gw-a.*", "$KV.>", "$KV.lease_0.>", "$JS.API.>", "$JS.ACK.>", "$SYS.>"),
    *("_INBOX.>", "gateway.>", "gateway.*.*", "do.>", "do.*.*"),
    *("gateway.gw-b.*", "do.gw-b.*"),
)


class Attempt(NamedTuple):
    user: str
    deed: str  # "publish" or "subscribe"
    subject: str  # {hub} in a subject, for example, stands for the inbox of the user "hub"


def attempts() -> Iterator[Attempt]:
    for user, subjects in FORBIDDEN.items():
        others = [name for name in USERS if name != user]
        for subject in (*subjects, *NOBODY, *(f"{{{name}}}.x" for name in others)):
            yield Attempt(user, "publish", subject)
        for subject in (*LISTENED, *(f"{{{name}}}.>" for name in others)):
            yield Attempt(user, "subscribe", subject)
        if user not in GATEWAYS:
            for subject in ("cmd.*", "stop.*", "cmd.>", "stop.>", "cmd.line-1", "gateway.gw-a.state"):
                yield Attempt(user, "subscribe", subject)


async def refused(servers: SecuredCluster) -> set[Attempt]:
    """Make all attempts, and return those that the server has refused."""
    inboxes = {user: inbox_of(public_key(servers.key(user).read_text().strip())) for user in USERS}
    found: set[Attempt] = set()
    for user in FORBIDDEN:
        told: list[str] = []

        async def note(failure: Exception, told: list[str] = told) -> None:
            told.append(str(failure).lower())

        client = Client()
        await client.connect(servers.urls[0], **servers.options(user), error_cb=note, allow_reconnect=False)
        mine = {attempt: _subject(attempt, inboxes) for attempt in attempts() if attempt.user == user}
        for attempt, subject in mine.items():
            if attempt.deed == "publish":
                await client.publish(subject, b"{}")
            else:
                await client.subscribe(subject)
        # the server may answer the first flush before it has handled all data, but not the second
        for _ in range(2):
            await client.flush()
        await client.close()
        for attempt, subject in mine.items():
            word = "publish" if attempt.deed == "publish" else "subscription"
            if any(f'violation for {word} to "{subject.lower()}"' in text for text in told):
                found.add(attempt)
    return found


def _subject(attempt: Attempt, inboxes: dict[str, str]) -> str:
    return attempt.subject.format(**inboxes) if "{" in attempt.subject else attempt.subject


@pytest.fixture(scope="module")
def as_written(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SecuredCluster]:
    with secured_cluster(tmp_path_factory.mktemp("nats"), 1, GATEWAYS) as running:
        yield running


@pytest.fixture(scope="module")
def refusals(as_written: SecuredCluster) -> set[Attempt]:
    return asyncio.run(asyncio.wait_for(refused(as_written), PATIENCE_S))


@pytest.fixture(scope="module")
def refusals_where_all_is_allowed(tmp_path_factory: pytest.TempPathFactory) -> set[Attempt]:
    def widened(rights: str) -> str:
        return re.sub(r"allow: \[.*\]", 'allow: [">"]', rights)

    with secured_cluster(tmp_path_factory.mktemp("wide"), 1, GATEWAYS, widened) as running:
        return asyncio.run(asyncio.wait_for(refused(running), PATIENCE_S))


@pytest.mark.parametrize("user", FORBIDDEN)
def test_server_refuses_each_request_without_the_needed_right(
    user: str, refusals: set[Attempt], refusals_where_all_is_allowed: set[Attempt]
) -> None:
    wanted = {attempt for attempt in attempts() if attempt.user == user}
    assert len(wanted) > 60
    assert wanted - refusals == set()
    assert refusals_where_all_is_allowed == set()


async def test_missing_credentials_are_refused(as_written: SecuredCluster) -> None:
    options = as_written.options("hub")
    everybody: list[dict[str, Any]] = [{}, {"user": "operator", "password": ""}, {"token": "x"}]
    tls = {"tls": options["tls"], "tls_handshake_first": True}
    for user in everybody:
        with pytest.raises(Exception, match="Authorization Violation"):
            await Client().connect(as_written.urls[0], allow_reconnect=False, error_cb=_ignore, **tls, **user)


async def _ignore(_: Exception) -> None:
    pass


@pytest.mark.parametrize(
    ("names", "sentence"),
    [
        (["gw.1"], "the gateway's name 'gw.1' may have only letters"),
        (["gw-1", "gw-1"], "the gateway name 'gw-1' is used twice or reserved"),
        (["hub"], "the gateway name 'hub' is used twice or reserved"),
    ],
)
def test_invalid_names_of_gateways_are_rejected(names: list[str], sentence: str) -> None:
    with pytest.raises(ValueError, match=re.escape(sentence)):
        rights_of(names)


def test_secret_files_are_readable_only_by_their_owner(as_written: SecuredCluster) -> None:
    keys = as_written.folder / "keys"
    assert {path.name for path in keys.iterdir()} == {*(f"{user}.key" for user in USERS), "routes"}
    assert [oct(path.stat().st_mode & 0o777) for path in (keys, *keys.iterdir())] == ["0o700", *["0o600"] * 7]
    assert oct((as_written.folder / "n1.conf").stat().st_mode & 0o777) == "0o600"
    public = (as_written.folder / "rights.conf").read_text()
    for path in keys.iterdir():
        assert path.read_text().strip() not in public


def test_adding_a_gateway_keeps_all_existing_keys(tmp_path: Path) -> None:
    from multidrop.fleet.servers.files import write_files

    urls = ["nats://a:4222", "nats://b:4222"]

    def text(name: str) -> str:
        return (tmp_path / name).read_text()

    write_files(tmp_path, ["gw-1"], urls, None)
    before = {name: text(name) for name in ("keys/gw-1.key", "keys/hub.key", "n1.conf", "n2.conf")}
    write_files(tmp_path, ["gw-1", "gw-2"], urls, None)
    assert {name: text(name) for name in before} == before
    assert text("keys/gw-2.key") != text("keys/gw-1.key")
    write_files(tmp_path, ["gw-2"], urls, None)
    assert public_key(text("keys/gw-1.key").strip()) not in text("rights.conf")
    (tmp_path / "keys/hub.key").write_text("SUNKEN")
    before = {str(path): path.read_text() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(
        ValueError, match=r"hub\.key is damaged: delete it and run the command again, which writes a new key"
    ):
        write_files(tmp_path, ["gw-3"], urls, None)
    assert {str(path): path.read_text() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_ipv6_addresses_of_servers_are_in_brackets(tmp_path: Path) -> None:
    from multidrop.fleet.servers.files import write_files

    write_files(tmp_path, ["gw-1"], ["nats://[::1]:4222", "nats://[::1]:4223"], None)
    text = (tmp_path / "n1.conf").read_text()
    assert 'listen: "[::1]:4222"' in text
    assert 'listen: "[::1]:6222"' in text
    assert "@[::1]:6223" in text


def test_the_rights_command_prints_no_secret(run: Run, tmp_path: Path) -> None:
    words = [
        "fleet",
        "rights",
        "gw-1,gw-2",
        "--nats",
        "tls://a:4222,tls://b:4222",
        "--folder",
        tmp_path / "nats",
    ]
    files = ["--ca", "/etc/nats/ca.pem", "--cert", "/etc/nats/own.pem", "--key", "/etc/nats/own.key"]
    status, out, err = run(*words, *files)
    assert (status, err) == (0, "")
    assert "copy rights.conf to each server" in out
    _, told, _ = run(*words, *files, "--json")
    assert len(json.loads(told)) == 6 + 1 + 2 + 1
    for path in (tmp_path / "nats" / "keys").iterdir():
        assert path.read_text().strip() not in out + told
    text = (tmp_path / "nats" / "n2.conf").read_text()
    assert 'listen: "b:4222"' in text
    assert 'listen: "b:6222"' in text
    assert text.count('cert_file: "/etc/nats/own.pem", key_file: "/etc/nats/own.key"') == 2


def test_rights_without_tls_cause_a_warning(run: Run, tmp_path: Path) -> None:
    status, _, err = run("fleet", "rights", "gw-1", "--nats", "nats://a:4222", "--folder", tmp_path)
    assert (status, len(err.splitlines())) == (0, 1)
    assert "without TLS anyone on the network can read samples and commands" in err
    assert "tls" not in (tmp_path / "n1.conf").read_text()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ([], "are required: NAMES; see `multidrop fleet rights --help`"),
        (["gw-1,gw.2"], "the gateway's name 'gw.2' may have only letters"),
        (["gw-1,operator"], "the gateway name 'operator' is used twice or reserved"),
        (
            ["gw-1", "--ca", "ca.pem"],
            "TLS needs --ca, --cert and --key. Give each as the file's path on the NATS servers",
        ),
        (["gw-1", "--nats", "tls://a:4222"], "tls://a:4222 needs --ca, --cert and --key"),
        (["gw-1", "--nats", "nats://a:64000"], "nats://a:64000 is not an address of a NATS server"),
        (["gw-1", "--nats", "nats://a:port"], "nats://a:port is not an address of a NATS server"),
    ],
)
def test_invalid_arguments_write_no_file(run: Run, tmp_path: Path, words: list[str], sentence: str) -> None:
    status, out, err = run("fleet", "rights", *words, "--folder", tmp_path / "nats")
    assert (status, out) == (2, "")
    [line] = err.splitlines()
    assert sentence in line
    assert not (tmp_path / "nats").exists()


def test_denial_of_an_earlier_request_does_not_affect_later_requests() -> None:
    """Rights may change while a connection is open, so the denial of an earlier request proves nothing."""
    denials = Denials()
    denied = Exception('nats: permissions violation for publish to "stop.line-1"')
    asyncio.run(denials.note(denied))
    before = denials.of_request("stop.Line-1")
    denials.check_request("stop.Line-1", "_INBOX", before)
    asyncio.run(denials.note(denied))
    with pytest.raises(MayNotSend, match=r"these credentials do not allow publishing to stop\.Line-1"):
        denials.check_request("stop.Line-1", "_INBOX", before)
    asyncio.run(denials.note(Exception('nats: permissions violation for subscription to "_inbox.x.*"')))
    with pytest.raises(NoRight, match=r"do not allow listening to _inbox\.x"):
        denials.check_request("stop.line-2", "_INBOX", 0)


@pytest.mark.slow
def test_the_path_of_a_creds_file_is_passed_to_nats_py(tmp_path: Path) -> None:
    path = tmp_path / "gw-1.creds"
    path.write_text("-----BEGIN NATS USER JWT-----\ney\n------END NATS USER JWT------\n")
    assert connect_options(["nats://a"], path) == {"user_credentials": str(path)}
    assert connect_options(["nats://a"]) == {}
    assert connect_options(["tls://a"])["tls_handshake_first"]


# ---- whole fleets with these rights: gateways join and die, keys are revoked and stolen ----


NOT_SENT = "the stop of drive-line-0 was NOT sent: these credentials do not allow publishing to stop.line-0"
AN_HOUR_AHEAD = """
import time
seconds, ns = time.time, time.time_ns
time.time, time.time_ns = lambda: seconds() + 3600, lambda: ns() + 3600 * 10**9
"""


def check_that_a_stop_reports_its_progress(fleet: SecuredFleet) -> None:
    """Check that the sender of a stop first gets the drive's refusal, and later the stop's outcome."""
    fleet.hall.refusing.add("line-1")
    asker = subprocess.Popen(
        [sys.executable, "-m", "multidrop", "fleet", "stop", "drive-line-1"],
        env=fleet.servers.environment("commander"),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert asker.stderr
    told = asker.stderr.readline()
    while "the stop was sent" not in told:  # a busy machine may need more than half a second to send the stop
        assert told.startswith("under way: "), told
        told = asker.stderr.readline()
    assert told.startswith("under way: drive-line-1: the stop was sent, but is not yet confirmed")
    assert asker.poll() is None
    fleet.hall.refusing.clear()
    out, err = asker.communicate(timeout=PATIENCE_S)
    assert out.startswith("done: drive-line-1: stopped: seen to stand after "), (out, err)


@pytest.mark.slow
@pytest.mark.long
def test_a_whole_fleet_works_with_the_generated_rights(tmp_path: Path) -> None:
    """The steps: cold start, a new gateway, a dead gateway, a drain and the hub. No log reports a denial.

    The servers read the new gateway's rights while the other gateways continue. NATS 2.15 gives a new account
    its imports only at the second reload.
    """
    with secured_fleet(tmp_path, 3, THREE_GATEWAYS[:2]) as fleet:
        fleet.wait_for_polling()
        fleet.servers.give_rights_to(THREE_GATEWAYS)
        fleet.servers.reload()
        fleet.start("gw-c")
        until(lambda: bool(fleet.status()["gateways"].get("gw-c", {}).get("lines")), "gw-c has lines")
        fleet.wait_for_polling()
        taken = fleet.status("commander")["gateways"]
        assert {name: one["session"] for name, one in taken.items()} == dict.fromkeys(THREE_GATEWAYS, 1)
        assert all(one["lines"] for one in taken.values())
        stopped = multidrop(fleet.servers, "commander", "fleet", "stop", "--all")
        assert stopped.returncode == 0, stopped
        assert "drive-line-" in (tmp_path / "gw-c" / "commands.jsonl").read_text()
        for user, told in (("commander", "drive-line-0"), ("viewer", NOT_SENT)):
            said = multidrop(fleet.servers, user, "fleet", "stop", "drive-line-0")
            assert told in said.stdout + said.stderr
            assert ("do not allow" in said.stdout + said.stderr) is (user == "viewer"), said
        check_that_a_stop_reports_its_progress(fleet)
        assert "drive-line-0" in "".join(path.read_text() for path in tmp_path.glob("gw-*/commands.jsonl"))
        fleet.kill("gw-a")
        until(lambda: "gw-a" not in fleet.status()["gateways"], "gw-a has left")
        fleet.wait_for_polling()
        drained = multidrop(fleet.servers, "operator", "fleet", "drain", "gw-b")
        assert (drained.returncode, drained.stderr) == (0, "")
        fleet.wait_for_polling()
        fleet.running["gw-c"].terminate()
        fleet.running["gw-c"].wait(PATIENCE_S)
        words = ["--parquet", str(tmp_path / "hub"), "--once", "--json"]
        kept = json.loads(multidrop(fleet.servers, "hub", "hub", *fleet.servers.urls, *words).stdout)
        assert kept["rows"] > 100
        assert kept["alarms"] == 0
        assert fleet.hall.overlaps() == 0
        for name in THREE_GATEWAYS:
            assert "do not allow" not in fleet.log(name)
            assert "Traceback" not in fleet.log(name)


@pytest.mark.slow
@pytest.mark.long
def test_other_gateways_take_the_lines_of_a_gateway_with_a_revoked_key(tmp_path: Path) -> None:
    """When the servers reload their rights, they disconnect users that were removed."""
    with secured_fleet(tmp_path, 1, ("gw-a", "gw-b")) as fleet:
        fleet.wait_for_polling()
        fleet.servers.give_rights_to(["gw-b"])
        until(lambda: "refuses these credentials" in fleet.log("gw-a"), "gw-a logs it")
        until(lambda: "all lines are closed" in fleet.log("gw-a"), "gw-a closes its lines")
        fleet.wait_for_polling()
        assert fleet.running["gw-a"].poll() is None  # the gateway continues to run, and retries
        # the refusal is logged once per connection, not at each attempt
        assert fleet.log("gw-a").count("admits nobody") < 10


async def end_session(servers: SecuredCluster, name: str) -> None:
    """End a gateway's session with the key of gw-c."""
    path = paths_of(servers.urls, servers.options("gw-c"))[0]
    await path.open()
    for at in names.LEASES:
        bucket, is_ended = LeaseBucket(at, lambda: path, "gw-c"), False
        while not is_ended:
            record = await bucket.get(name)
            with suppress(Conflict):
                await bucket.put(name, {**record.value, "ended": True}, record.revision)
                is_ended = True
    await path.close()


@pytest.mark.slow
@pytest.mark.long
def test_a_thief_with_a_gateways_key_can_only_interrupt_polling(tmp_path: Path) -> None:
    """A thief with the key of gw-c ends the sessions of other gateways, which then start new sessions."""
    with secured_fleet(tmp_path, 1, THREE_GATEWAYS[:2]) as fleet:
        fleet.servers.give_rights_to(THREE_GATEWAYS)
        fleet.servers.reload()
        fleet.wait_for_polling()
        until(lambda: len(fleet.status()["gateways"]) == 2, "both gateways have joined")

        def session(name: str) -> int:
            return int(fleet.status()["gateways"].get(name, {"session": 0})["session"])

        def has_new_session(name: str, before: int) -> bool:
            return session(name) > before

        for name in THREE_GATEWAYS[:2]:
            before = session(name)
            asyncio.run(asyncio.wait_for(end_session(fleet.servers, name), PATIENCE_S))
            until(partial(has_new_session, name, before), "a new session")
            assert "another gateway ended" in fleet.log(name)
        fleet.wait_for_polling()
        assert fleet.hall.overlaps() == 0


@pytest.mark.slow
@pytest.mark.long
def test_fleet_works_with_clocks_an_hour_apart(tmp_path: Path) -> None:
    """The clock of one of two gateways is an hour ahead. Each gateway takes over the lines of the other."""
    (tmp_path / "ahead").mkdir()
    (tmp_path / "ahead" / "sitecustomize.py").write_text(AN_HOUR_AHEAD)
    ahead = {"gw-a": {"PYTHONPATH": str(tmp_path / "ahead")}, "gw-b": {}}
    with secured_fleet(tmp_path, 1, ("gw-a", "gw-b"), ahead) as fleet:
        until(
            lambda: "this machine's clock is 3600 s ahead of the clock of tls://" in fleet.log("gw-a"),
            "gw-a logs it",
        )

        def are_two() -> bool:
            return [bool(one["lines"]) for one in fleet.status()["gateways"].values()] == [True, True]

        until(are_two, "both gateways have lines")
        for name in ("gw-b", "gw-a"):
            fleet.kill(name)
            until(lambda name=name: name not in fleet.status()["gateways"], "it has left")
            fleet.wait_for_polling()
            if name == "gw-b":
                fleet.start(name)
                until(are_two, "both gateways have lines")
        assert "this machine's clock" not in fleet.log("gw-b")
        assert fleet.hall.overlaps() == 0


@pytest.mark.slow
@pytest.mark.long
def test_a_second_gateway_of_the_same_name_waits_until_the_first_one_ends(tmp_path: Path) -> None:
    """The second gateway has another folder, as on another machine."""
    with secured_fleet(tmp_path, 1, ("gw-a",)) as fleet:
        fleet.wait_for_polling()
        fleet.start("gw-a", "second")
        sentence = "gw-a polls no lines yet: a gateway called gw-a runs on"
        until(lambda: sentence in fleet.log("second"), "it logs that it waits")
        assert fleet.status()["gateways"]["gw-a"]["session"] == 1
        fleet.kill("gw-a")
        until(
            lambda: fleet.status()["gateways"].get("gw-a", {}).get("session") == 2,
            "the second gateway takes over",
        )
        fleet.wait_for_polling()
        assert fleet.log("second").count(sentence) == 1
        assert fleet.hall.overlaps() == 0
