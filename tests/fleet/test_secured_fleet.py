"""A whole fleet with the rights that `fleet rights` writes, and a sentence where they do not suffice."""

from __future__ import annotations

import json
import ssl
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from commands import Run
from nats_clusters import cluster
from peers import require_module

require_module("nats")
require_module("nkeys")
require_module("pyarrow")

from secured_clusters import GATEWAYS, SecuredCluster, certificates, secured_cluster  # noqa: E402
from serial_hall import SerialHall  # noqa: E402

PATIENCE_S = 60.0
LINE = """
[[line]]
name = "hall-1"
port = "socket://127.0.0.1:4001"
[[line.drive]]
name = "pump-1"
model = "innovert-ibd"
address = 1
"""


def multidrop(servers: SecuredCluster, user: str, *words: str) -> subprocess.CompletedProcess[str]:
    """Run a command as this user."""
    return subprocess.run(
        [sys.executable, "-m", "multidrop", *words],
        env=servers.environment(user),
        capture_output=True,
        text=True,
        check=False,
        timeout=PATIENCE_S,
    )


@pytest.fixture(scope="module")
def servers(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SecuredCluster]:
    """Return one server with a fleet's buckets, and rights."""
    folder = tmp_path_factory.mktemp("nats")
    (folder / "plant.toml").write_text(LINE)
    with secured_cluster(folder, 1) as running:
        made = multidrop(running, "operator", "fleet", "init", str(folder / "plant.toml"))
        assert made.returncode == 0, made.stderr
        yield running


def told(servers: SecuredCluster, user: str, *words: str) -> str:
    """Return the one sentence that a command ends with."""
    said = multidrop(servers, user, *words)
    assert said.returncode == 1, said
    lines = said.stderr.splitlines()
    assert len(lines) <= 2, lines  # `serve` tells of a denial when the server does, and then ends
    return lines[-1]


NO_RIGHT = "these credentials do not allow to "
NOT_THEIRS = [
    ("viewer", ["fleet", "init"], NO_RIGHT + "publish to $JS.API.STREAM.INFO.KV_contest"),
    ("hub", ["fleet", "status"], NO_RIGHT + "publish to $JS.API.STREAM.INFO.KV_lease_0"),
    ("viewer", ["fleet", "drain", "gw-a"], NO_RIGHT + "publish to gateway.gw-a.drain"),
    ("gw-a", ["fleet", "serve", "gw-b"], NO_RIGHT + "listen to gateway.gw-b.*"),
    ("viewer", ["hub", "--parquet", "{folder}", "--once"], "the rights of this connection do not suffice"),
]


@pytest.mark.long
@pytest.mark.parametrize(("user", "words", "sentence"), NOT_THEIRS)
def test_what_is_not_ones_right_is_one_sentence(
    servers: SecuredCluster, tmp_path: Path, user: str, words: list[str], sentence: str
) -> None:
    filled = [word.replace("{folder}", str(tmp_path / "hub")) for word in words]
    if words[0] == "hub":
        filled = [*filled[:1], *servers.urls, *filled[1:]]
    if "serve" in words:
        filled += ["--folder", str(tmp_path / "gateway")]
    assert sentence.lower() in told(servers, user, *filled).lower()


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
    from multidrop.fleet.credentials import new_seed

    (folder / "stranger.key").write_text(new_seed())
    return ["--credentials", str(folder / "stranger.key")]


MISTAKES: dict[str, tuple[Callable[[SecuredCluster, Path], list[str]], int, str]] = {
    "another authority": (other_ca, 1, "cannot be believed (unable to get local issuer certificate)"),
    "no such key": (no_key, 2, "none.key: No such file or directory"),
    "a damaged key": (damaged_key, 2, "hub.key is damaged: it is no key that `fleet rights` wrote"),
    "something else": (strange_key, 2, "hub.key has no credentials: name a key of `fleet rights`"),
    "no certificate": (strange_ca, 2, "ca.pem has no certificate: it must be a PEM file"),
    "an unknown key": (unknown_key, 1, "admits nobody who says this, or nothing, of himself"),
}


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
    from multidrop.fleet import samples_stream

    monkeypatch.setattr(samples_stream, "ANSWER_S", 0.5)
    for name, value in servers.environment("viewer").items():
        if name.startswith("MULTIDROP_"):
            monkeypatch.setenv(name, value)
    make, status, sentence = MISTAKES[mistake]
    start = {"status": ["fleet", "status"], "hub": ["hub", *servers.urls, "--parquet", str(tmp_path / "h")]}
    ended, out, err = run(*start[command], *make(servers, tmp_path))
    assert (ended, out) == (status, "")
    [line] = err.splitlines()
    assert sentence in line
    assert status == 1 or not (tmp_path / "h").exists()  # a mistake of the call makes no folder


def test_nothing_is_said_to_a_server_that_does_not_begin_with_tls(
    run: Run, servers: SecuredCluster, tmp_path: Path
) -> None:
    """Else whoever is between could read on, and pass our answer to the server's question on as his own."""
    with cluster(tmp_path / "plain", 1) as plain:
        url = plain.urls[0].replace("nats://", "tls://")
        key, ca = str(servers.key("viewer")), str(servers.tls.ca)
        status, _, err = run("fleet", "status", "--nats", url, "--credentials", key, "--ca", ca)
        assert status == 1
        assert "does not begin with TLS, which these options demand" in err
        status, _, err = run("fleet", "status", "--nats", plain.urls[0], "--ca", ca)
        assert "does not begin with TLS, which these options demand" in err


@pytest.mark.long
def test_a_server_that_begins_with_tls_is_not_met_in_the_clear(run: Run, servers: SecuredCluster) -> None:
    status, _, err = run("fleet", "status", "--nats", servers.urls[0].replace("tls://", "nats://"))
    assert status == 1
    assert "it said nothing in time; one that begins with TLS is named with tls://" in err


def test_a_context_for_tls_believes_this_authority_alone(servers: SecuredCluster) -> None:
    context = servers.options("hub")["tls"]
    assert context.verify_mode is ssl.CERT_REQUIRED
    assert context.check_hostname
    assert len(context.get_ca_certs()) == 1


# ---- a whole fleet ----


class SecuredFleet:
    """Gateways as processes, each with its own key, and a hall of lines that sees what they send."""

    def __init__(self, folder: Path, servers: SecuredCluster) -> None:
        self.servers, self.folder = servers, folder
        self.hall = SerialHall(6)
        self.running: dict[str, subprocess.Popen[bytes]] = {}
        (folder / "plant.toml").write_text(self.hall.plant())

    def start(self, name: str) -> None:
        words = ["fleet", "serve", name, "--folder", str(self.folder / name)]
        with (self.folder / f"{name}.log").open("ab") as log:
            self.running[name] = subprocess.Popen(
                [sys.executable, "-m", "multidrop", *words],
                env=self.servers.environment(name),
                stdout=log,
                stderr=log,
            )

    def log(self, name: str) -> str:
        return (self.folder / f"{name}.log").read_text()

    def close(self) -> None:
        for process in self.running.values():
            process.kill()
            process.wait()
        self.hall.close()


def until(condition: Callable[[], bool], what: str) -> None:
    ends = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < ends, what
        time.sleep(0.1)


@pytest.mark.long
def test_all_works_with_the_rights_as_written(tmp_path: Path) -> None:
    """Cold start, a dead gateway's lines, a drain, the hub, and no denial in anybody's log."""
    with secured_cluster(tmp_path / "nats") as servers:
        fleet = SecuredFleet(tmp_path, servers)
        try:
            made = multidrop(servers, "operator", "fleet", "init", str(tmp_path / "plant.toml"))
            assert (made.returncode, made.stderr) == (0, "")
            for name in GATEWAYS:
                fleet.start(name)
            until(lambda: fleet.hall.are_polled(0.5), "all lines are polled")

            def status(user: str) -> dict[str, dict[str, dict[str, object]]]:
                found: dict[str, dict[str, dict[str, object]]] = json.loads(
                    multidrop(servers, user, "fleet", "status", "--json").stdout
                )
                return found

            until(lambda: all(one["lines"] for one in status("viewer")["gateways"].values()), "shares")
            assert set(status("commander")["gateways"]) == set(GATEWAYS)
            fleet.running["gw-a"].kill()
            until(lambda: set(status("viewer")["gateways"]) == {"gw-b", "gw-c"}, "its end")
            until(lambda: fleet.hall.are_polled(0.5), "all lines are polled again")
            drained = multidrop(servers, "operator", "fleet", "drain", "gw-b")
            assert (drained.returncode, drained.stderr) == (0, "")
            until(lambda: fleet.hall.are_polled(0.5), "all lines are polled by one")
            fleet.running["gw-c"].terminate()
            fleet.running["gw-c"].wait(PATIENCE_S)
            words = ["--parquet", str(tmp_path / "hub"), "--once", "--json"]
            kept = json.loads(multidrop(servers, "hub", "hub", *servers.urls, *words).stdout)
            assert kept["rows"] > 100
            assert kept["alarms"] == 0
            for name in GATEWAYS:
                assert "do not allow" not in fleet.log(name)
                assert "Traceback" not in fleet.log(name)
        finally:
            fleet.close()


@pytest.mark.long
def test_a_key_that_is_taken_away_is_told_of_and_its_lines_go_on(tmp_path: Path) -> None:
    """The servers read their rights again, and end the connections of who has none any more."""
    with secured_cluster(tmp_path / "nats", 1, ("gw-a", "gw-b")) as servers:
        fleet = SecuredFleet(tmp_path, servers)
        try:
            multidrop(servers, "operator", "fleet", "init", str(tmp_path / "plant.toml"))
            for name in ("gw-a", "gw-b"):
                fleet.start(name)
            until(lambda: fleet.hall.are_polled(0.5), "all lines are polled")
            servers.take_rights_of("gw-a")
            until(lambda: "admits nobody who says this" in fleet.log("gw-a"), "the sentence")
            until(lambda: "no line is polled" in fleet.log("gw-a"), "silence")
            until(lambda: fleet.hall.are_polled(0.5), "the other one polls all lines")
            assert fleet.running["gw-a"].poll() is None  # and tries again
            assert fleet.log("gw-a").count("admits nobody") < 10  # each connection says it once
        finally:
            fleet.close()
