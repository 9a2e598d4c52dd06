"""A whole fleet with the rights that `fleet rights` writes, and the error if a right is missing."""

from __future__ import annotations

import asyncio
import json
import ssl
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from pathlib import Path

import pytest
from commands import Run
from nats_clusters import cluster
from secured_clusters import (
    GATEWAYS,
    PATIENCE_S,
    SecuredCluster,
    SecuredFleet,
    SecuredNode,
    certificates,
    in_one_account,
    multidrop,
    secured_cluster,
    secured_fleet,
    until,
)
from spooled import numbered

from multidrop.fleet.errors import Conflict
from multidrop.fleet.samples.hub import SourceCheck
from multidrop.fleet.samples.samples_stream import (
    DIGEST,
    LOST,
    SEQUENCE,
    StreamMessage,
    digest_of,
    publish,
    read_after,
    samples_path,
    subject_of,
)
from multidrop.fleet.samples.spool import Spool
from multidrop.fleet.servers import names
from multidrop.fleet.servers.buckets import LeaseBucket
from multidrop.fleet.servers.connections import paths_of

AN_HOUR_AHEAD = """
import time
seconds, ns = time.time, time.time_ns
time.time, time.time_ns = lambda: seconds() + 3600, lambda: ns() + 3600 * 10**9
"""
LINE = """
[[line]]
name = "hall-1"
port = "socket://127.0.0.1:4001"
[[line.drive]]
name = "pump-1"
model = "innovert-ibd"
address = 1
"""


@pytest.fixture(scope="module")
def servers(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SecuredCluster]:
    """Yield one server with a fleet's buckets and rights."""
    folder = tmp_path_factory.mktemp("nats")
    (folder / "plant.toml").write_text(LINE)
    with secured_cluster(folder, 1) as running:
        made = multidrop(running, "operator", "fleet", "init", str(folder / "plant.toml"))
        assert made.returncode == 0, made.stderr
        yield running


def told(servers: SecuredCluster, user: str, *words: str) -> str:
    """Return the one sentence with which a command fails."""
    said = multidrop(servers, user, *words)
    assert said.returncode == 1, said
    lines = said.stderr.splitlines()
    assert len(lines) == 1 + (words[0] == "hub")  # a hub logs the sentence too
    return lines[-1]


@pytest.mark.slow  # the longest file of its folder starts first
@pytest.mark.long
def test_a_route_to_a_silent_server_is_dropped_soon(tmp_path: Path) -> None:
    """With its defaults, NATS needs more than a minute, and forwards requests to that server all the time."""

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


NO_RIGHT = "these credentials do not allow to "
NOT_SENT = f"the stop of drive-line-0 was NOT sent: {NO_RIGHT}publish to stop.line-0"
NOT_THEIRS = [
    ("viewer", ["fleet", "init"], NO_RIGHT + "publish to $JS.API.STREAM.INFO.KV_contest"),
    ("hub", ["fleet", "status"], NO_RIGHT + "publish to $JS.API.STREAM.INFO.KV_lease_0"),
    ("viewer", ["fleet", "drain", "gw-a"], NO_RIGHT + "publish to gateway.gw-a.drain"),
    ("gw-a", ["fleet", "serve", "gw-b"], NO_RIGHT + "listen to gateway.gw-b.*"),
    (
        "viewer",
        ["hub", "--parquet", "{folder}", "--once"],
        NO_RIGHT + "publish to $JS.API.STREAM.INFO",
    ),
]


@pytest.mark.long
@pytest.mark.parametrize(("user", "words", "sentence"), NOT_THEIRS)
def test_a_missing_right_is_one_sentence(
    servers: SecuredCluster, tmp_path: Path, user: str, words: list[str], sentence: str
) -> None:
    filled = [word.replace("{folder}", str(tmp_path / "hub")) for word in words]
    if words[0] == "hub":
        filled = [*filled[:1], *servers.urls, *filled[1:]]
    if "serve" in words:
        filled += ["--folder", str(tmp_path / "gateway")]
    assert sentence.lower() in told(servers, user, *filled).lower()


@pytest.mark.slow
def test_a_stored_message_directed_into_anothers_samples_is_ignored(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """With one account for all users, servers would send stored messages to any subject named."""

    async def main(servers: SecuredCluster) -> None:
        made = multidrop(servers, "operator", "fleet", "init")
        assert made.returncode == 0, made.stderr
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
    from multidrop.fleet.servers.credentials import new_seed

    (folder / "stranger.key").write_text(new_seed())
    return ["--credentials", str(folder / "stranger.key")]


MISTAKES: dict[str, tuple[Callable[[SecuredCluster, Path], list[str]], int, str]] = {
    "another authority": (other_ca, 1, "is not trusted (unable to get local issuer certificate)"),
    "no such key": (no_key, 2, "none.key: No such file or directory"),
    "a damaged key": (damaged_key, 2, "hub.key is damaged: not a key of `fleet rights`"),
    "something else": (strange_key, 2, "hub.key has no credentials: name a key of `fleet rights`"),
    "no certificate": (strange_ca, 2, "ca.pem has no certificate: it must be a PEM file"),
    "an unknown key": (unknown_key, 1, "refuses these credentials, or the lack of any"),
}


@pytest.mark.long
@pytest.mark.parametrize("command", ["status", "hub"])
@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistaken_credentials_are_one_sentence(
    servers: SecuredCluster,
    run: Run,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    mistake: str,
    command: str,
) -> None:
    for name, value in servers.environment("viewer").items():
        if name.startswith("MULTIDROP_"):
            monkeypatch.setenv(name, value)
    make, status, sentence = MISTAKES[mistake]
    start = {"status": ["fleet", "status"], "hub": ["hub", *servers.urls, "--parquet", str(tmp_path / "h")]}
    ended, out, err = run(*start[command], *make(servers, tmp_path))
    assert (ended, out) == (status, "")
    [line] = err.splitlines()
    assert sentence in line
    assert status == 1 or not (tmp_path / "h").exists()  # a mistake in the command creates no folder


@pytest.mark.long
@pytest.mark.slow
def test_no_data_is_sent_to_a_server_without_tls(run: Run, servers: SecuredCluster, tmp_path: Path) -> None:
    """Otherwise an attacker in between could read and relay the login."""
    with cluster(tmp_path / "plain", 1) as plain:
        url = plain.urls[0].replace("nats://", "tls://")
        key, ca = str(servers.key("viewer")), str(servers.tls.ca)
        status, _, err = run("fleet", "status", "--nats", url, "--credentials", key, "--ca", ca)
        assert status == 1
        assert "does not start with TLS, which these options require" in err
        status, _, err = run("fleet", "status", "--nats", plain.urls[0], "--ca", ca)
        assert "does not start with TLS, which these options require" in err


@pytest.mark.long
def test_a_tls_server_is_not_contacted_without_tls(run: Run, servers: SecuredCluster) -> None:
    status, _, err = run("fleet", "status", "--nats", servers.urls[0].replace("tls://", "nats://"))
    assert status == 1
    assert "no answer in time; write tls:// if it requires TLS" in err


@pytest.mark.long
def test_tls_trusts_only_the_given_authority(servers: SecuredCluster) -> None:
    context = servers.options("hub")["tls"]
    assert context.verify_mode is ssl.CERT_REQUIRED
    assert context.check_hostname
    assert len(context.get_ca_certs()) == 1


# ---- a whole fleet ----


def assert_told_while_it_goes_on(fleet: SecuredFleet) -> None:
    """Check that the sender of a stop hears that the drive refuses it, and then how it ended."""
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
    while "the stop was sent" not in told:  # a busy machine may take more than half a second to send it
        assert told.startswith("under way: "), told
        told = asker.stderr.readline()
    assert told.startswith("under way: drive-line-1: the stop was sent, but is not yet confirmed")
    assert asker.poll() is None
    fleet.hall.refusing.clear()
    out, err = asker.communicate(timeout=PATIENCE_S)
    assert out.startswith("done: drive-line-1: stopped: seen to stand after "), (out, err)


@pytest.mark.long
def test_a_whole_fleet_works_with_the_rights_as_written(tmp_path: Path) -> None:
    """Cold start, a dead gateway's lines, a drain and the hub; no log reports a denial."""
    with secured_fleet(tmp_path) as fleet:
        fleet.wait_for_polling()
        until(lambda: all(one["lines"] for one in fleet.status()["gateways"].values()), "shares")
        assert set(fleet.status("commander")["gateways"]) == set(GATEWAYS)
        for user, told in (("commander", "drive-line-0"), ("viewer", NOT_SENT)):
            said = multidrop(fleet.servers, user, "fleet", "stop", "drive-line-0")
            assert told in said.stdout + said.stderr
            assert ("do not allow" in said.stdout + said.stderr) is (user == "viewer"), said
        assert_told_while_it_goes_on(fleet)
        assert "drive-line-0" in "".join(path.read_text() for path in tmp_path.glob("gw-*/commands.jsonl"))
        fleet.running["gw-a"].kill()
        until(lambda: "gw-a" not in fleet.status()["gateways"], "its end")
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
        for name in GATEWAYS:
            assert "do not allow" not in fleet.log(name)
            assert "Traceback" not in fleet.log(name)


@pytest.mark.long
def test_a_revoked_key_is_logged_and_its_lines_are_taken_over(tmp_path: Path) -> None:
    """The servers reload their rights, and disconnect users that were removed."""
    with secured_fleet(tmp_path, 1, ("gw-a", "gw-b")) as fleet:
        fleet.wait_for_polling()
        fleet.servers.give_rights_to(["gw-b"])
        until(lambda: "refuses these credentials" in fleet.log("gw-a"), "the sentence")
        until(lambda: "all lines are closed" in fleet.log("gw-a"), "silence")
        fleet.wait_for_polling()
        assert fleet.running["gw-a"].poll() is None  # the gateway retries
        assert fleet.log("gw-a").count("admits nobody") < 10  # logged once per connection


@pytest.mark.long
def test_a_new_gateway_shares_the_lines_and_ends_no_session(tmp_path: Path) -> None:
    """The servers read its rights while the other gateways continue, and commands reach it.

    NATS 2.15 gives a new account its imports only at the second reload.
    """
    with secured_fleet(tmp_path, 3, ("gw-a", "gw-b")) as fleet:
        fleet.wait_for_polling()
        fleet.servers.give_rights_to(["gw-a", "gw-b", "gw-c"])
        fleet.servers.reload()
        fleet.start("gw-c")
        until(lambda: bool(fleet.status()["gateways"].get("gw-c", {}).get("lines")), "its share")
        fleet.wait_for_polling()
        taken = fleet.status()["gateways"]
        assert [taken[name]["session"] for name in GATEWAYS] == [1, 1, 1]
        for number in range(6):
            said = multidrop(fleet.servers, "commander", "fleet", "stop", f"drive-line-{number}")
            assert said.returncode == 0, said
        assert (tmp_path / "gw-c" / "commands.jsonl").read_text().count("drive-line-") > 0
        assert fleet.hall.overlaps() == 0
        for name in GATEWAYS:
            assert "do not allow" not in fleet.log(name)


@pytest.mark.long
def test_a_stolen_gateway_key_can_only_silence_lines(tmp_path: Path) -> None:
    """A thief with gw-c's key ends the others' sessions again and again. The others start new sessions."""
    with secured_fleet(tmp_path, 1) as fleet:
        fleet.wait_for_polling()
        fleet.running["gw-c"].kill()
        until(lambda: "gw-c" not in fleet.status()["gateways"], "its end")
        fleet.wait_for_polling()

        async def end_all() -> None:
            path = paths_of(fleet.servers.urls, fleet.servers.options("gw-c"))[0]
            await path.open()
            for name in ("gw-a", "gw-b", "gw-a"):
                for at in names.LEASES:
                    bucket = LeaseBucket(at, lambda: path, "gw-c")
                    record = await bucket.get(name)
                    while True:
                        with suppress(Conflict):
                            await bucket.put(name, {**record.value, "ended": True}, record.revision)
                            break
                        record = await bucket.get(name)
                await asyncio.sleep(5.0)
            await path.close()

        asyncio.run(asyncio.wait_for(end_all(), PATIENCE_S))
        assert "another gateway ended" in fleet.log("gw-a")
        assert "another gateway ended" in fleet.log("gw-b")
        fleet.wait_for_polling()
        assert fleet.hall.overlaps() == 0


# ---- wrong clocks, namesakes, too few servers ----


@pytest.mark.long
def test_clocks_an_hour_apart_are_logged_and_harmless(tmp_path: Path) -> None:
    """One of two gateways is an hour ahead. Each takes over the lines of the other."""
    (tmp_path / "ahead").mkdir()
    (tmp_path / "ahead" / "sitecustomize.py").write_text(AN_HOUR_AHEAD)
    ahead = {"gw-a": {"PYTHONPATH": str(tmp_path / "ahead")}, "gw-b": {}}
    with secured_fleet(tmp_path, 1, ("gw-a", "gw-b"), ahead) as fleet:
        until(lambda: "this machine's clock is 3600 s ahead of that of tls://" in fleet.log("gw-a"), "a word")

        def are_two() -> bool:
            return [one["lines"] > 0 for one in fleet.status()["gateways"].values()] == [True, True]

        until(are_two, "both")
        for name in ("gw-b", "gw-a"):
            fleet.running[name].kill()
            fleet.running[name].wait()
            until(lambda name=name: name not in fleet.status()["gateways"], "its end")  # type: ignore[misc]
            fleet.wait_for_polling()
            fleet.start(name, **ahead[name])
            until(
                lambda: [bool(one["lines"]) for one in fleet.status()["gateways"].values()] == [1, 1], "both"
            )
        assert "this machine's clock" not in fleet.log("gw-b")
        assert fleet.hall.overlaps() == 0


@pytest.mark.long
def test_a_second_machine_with_a_gateways_name_waits_for_it(tmp_path: Path) -> None:
    """The second gateway has another folder, as on another machine. It waits, reports it, and takes over."""
    with secured_fleet(tmp_path, 1, ("gw-a",)) as fleet:
        fleet.wait_for_polling()
        fleet.start("gw-a", "second")
        sentence = "gw-a polls no lines yet: a gateway called gw-a runs on"
        until(lambda: sentence in fleet.log("second"), "the sentence")
        assert fleet.status()["gateways"]["gw-a"]["session"] == 1
        fleet.running["gw-a"].kill()
        until(lambda: fleet.status()["gateways"].get("gw-a", {}).get("session") == 2, "the second one")
        fleet.wait_for_polling()
        assert fleet.log("second").count(sentence) == 1
        assert fleet.hall.overlaps() == 0


@pytest.mark.long
def test_without_a_quorum_each_command_is_one_sentence(tmp_path: Path) -> None:
    with secured_fleet(tmp_path, 3, ("gw-a",)) as fleet:
        fleet.wait_for_polling()
        fleet.running["gw-a"].terminate()
        fleet.running["gw-a"].wait(PATIENCE_S)
        for node in fleet.servers.nodes[1:]:
            node.kill()
        kept = str(tmp_path / "gw-a")
        for user, words in (
            ("viewer", ["status"]),
            ("operator", ["drain", "gw-a"]),
            ("gw-a", ["serve", "gw-a", "--folder", kept]),
        ):
            assert "have no quorum: more than half of them must run" in told(
                fleet.servers, user, "fleet", *words
            )
