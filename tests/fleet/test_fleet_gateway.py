"""One gateway of a fleet: answers to requests, shutdown, part of the web page, and metrics."""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from free_ports import free_ports
from gateways import served, written
from hypothesis import given
from hypothesis import strategies as st
from lines import until
from nats_clusters import Cluster, cluster
from peers import require_module, require_program
from serial_hall import SerialHall
from tables import table

from multidrop import PlantError
from multidrop.exposition import expose_metrics
from multidrop.fleet import gateway as fleet_gateway
from multidrop.fleet.commands.fleet_commands import FleetCommands
from multidrop.fleet.errors import FleetError
from multidrop.fleet.followed import FollowedFleet
from multidrop.fleet.gateway import FleetGateway
from multidrop.fleet.lines.lease import LifeLock
from multidrop.fleet.metrics import MOST_CLIENTS, MOST_HEAD, answer, families_of, listen, serving
from multidrop.fleet.overview import FleetView, FleetWatch
from multidrop.fleet.page_part import FleetPart
from multidrop.fleet.servers import names
from multidrop.fleet.servers.connections import ServerPath
from multidrop.gateway.settings import read_settings
from multidrop.samples import Spool

PATIENCE_S = 60.0


def fail() -> None:
    raise OSError("it fails")


class Asked:
    """A request from NATS, and the answers to it."""

    def __init__(self, wanted: str, reply: str = "_INBOX.asker.1") -> None:
        self.subject = names.gateway_subject("gw-1", wanted)
        self.reply = reply
        self.answers: list[dict[str, Any]] = []

    async def respond(self, data: bytes) -> None:
        self.answers.append(json.loads(data))


async def test_a_gateway_without_a_session_answers_no_requests(tmp_path: Path) -> None:
    """Another gateway of this name may have a session, and answers."""
    gateway = FleetGateway("gw-1", ["nats://127.0.0.1:1"], tmp_path)
    lease = gateway.member.lease
    for wanted in ("state", "drain"):
        asked: Any = Asked(wanted)
        await gateway._answer(asked)
        assert (asked.answers, gateway.member.is_draining) == ([], False)
    lease.session = 7
    asked = Asked("state")
    await gateway._answer(asked)
    assert [answer["session"] for answer in asked.answers] == [7]
    await gateway._close()


async def test_gateway_answers_only_to_nats_inbox_subjects(tmp_path: Path) -> None:
    """Servers send an answer to any subject that a requester names, even one that it may not write to."""
    gateway = FleetGateway("gw-1", ["nats://127.0.0.1:1"], tmp_path)
    gateway.member.lease.session = 7
    for reply in ("", "$KV.plant.line-1", "stop.line-1", "samples.gw-2.log", "_INBOX", "_INBOXES.a"):
        for wanted in ("state", "drain"):
            asked: Any = Asked(wanted, reply)
            await gateway._answer(asked)
            assert (asked.answers, gateway.member.is_draining) == ([], False)
    asked = Asked("drain", "_INBOX_UABC.1")
    await gateway._answer(asked)
    assert gateway.member.is_draining
    assert asked.answers
    await gateway._close()


@pytest.mark.parametrize(("trouble", "is_forwarded"), [(None, True), ("the stream is full", False)])
async def test_shutdown_waits_until_samples_are_forwarded_if_the_stream_works(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, trouble: str | None, is_forwarded: bool
) -> None:
    monkeypatch.setattr(fleet_gateway, "FORWARD_S", PATIENCE_S)
    monkeypatch.setattr(fleet_gateway, "IN_TROUBLE_S", 0.0)
    gateway = FleetGateway("gw-1", ["nats://127.0.0.1:1"], tmp_path)
    taken = iter([0, 0, 1])  # at each check: how many of the spool's two messages are in the stream
    forwarder: Any = type(
        "Forwarding", (), {"trouble": trouble, "last": property(lambda _: next(taken, 2))}
    )()
    spool, gateway.forwarder = gateway.spool, forwarder
    monkeypatch.setattr(gateway, "spool", SimpleNamespace(state=lambda: SimpleNamespace(newest=2)))
    forwarding = asyncio.create_task(asyncio.sleep(PATIENCE_S))
    await gateway._forward_the_rest(forwarding)
    assert (next(taken, None) is None) == is_forwarded
    forwarding.cancel()
    gateway.spool = spool
    await gateway._close()


async def test_gateway_without_a_lease_reports_zero_remaining_lease_time(tmp_path: Path) -> None:
    gateway = FleetGateway("gw-1", ["nats://127.0.0.1:1"], tmp_path)
    assert gateway.state()["margin_s"] == 0.0
    await gateway._close()


async def test_closing_all_lines_cancels_the_kernel_timer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If the timer stayed set, it would later kill the process."""
    gateway = FleetGateway("gw-1", ["nats://127.0.0.1:1"], tmp_path)
    gateway.mastership.extend(time.clock_gettime_ns(time.CLOCK_BOOTTIME) + 3600 * 10**9)
    held: list[bool] = []
    close = gateway.lines.poller.close

    def noted() -> None:
        held.append(gateway.mastership.holds)
        close()

    monkeypatch.setattr(gateway.lines.poller, "close", noted)
    try:
        await gateway._close()
        assert (held, gateway.mastership.until_ns) == ([True], 0)
    finally:
        gateway.mastership.end()


async def test_kernel_timer_is_kept_if_lines_cannot_be_closed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The process could still send, so no other process may believe that it is dead."""
    gateway = FleetGateway("gw-1", ["nats://127.0.0.1:1"], tmp_path)
    gateway.mastership.extend(time.clock_gettime_ns(time.CLOCK_BOOTTIME) + 3600 * 10**9)
    close = gateway.lines.poller.close
    monkeypatch.setattr(gateway.lines.poller, "close", fail)
    with pytest.raises(OSError, match="it fails"):
        await gateway._close()
    try:
        assert gateway.mastership.holds
        with pytest.raises(FleetError, match="another gateway of this machine"):
            LifeLock(tmp_path / "gw-1.lock")
        Spool(tmp_path / "spool", "gw-1").close()
        with pytest.raises(OSError, match="is closed"):
            await gateway.log.note({})
    finally:
        gateway.mastership.end()
        close()
        gateway.lock.close()


@pytest.mark.parametrize("part", ["paths", "spool", "log"])
async def test_gateway_closes_everything_else_after_one_close_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, part: str
) -> None:
    gateway = FleetGateway("gw-1", ["nats://127.0.0.1:1"], tmp_path)
    gateway.mastership.extend(time.clock_gettime_ns(time.CLOCK_BOOTTIME) + 3600 * 10**9)
    failing = gateway.paths[0] if part == "paths" else getattr(gateway, part)
    close = failing.close
    monkeypatch.setattr(failing, "close", fail)
    with pytest.raises(OSError, match="it fails"):
        await gateway._close()
    assert gateway.mastership.until_ns == 0
    LifeLock(tmp_path / "gw-1.lock").close()
    if part == "spool":
        close()
    Spool(tmp_path / "spool", "gw-1").close()


@pytest.mark.long
@pytest.mark.slow
def test_a_gateway_exits_without_error_after_all_servers_have_failed(tmp_path: Path) -> None:
    words = [sys.executable, "-m", "multidrop", "fleet"]
    with cluster(tmp_path / "nats", 1) as one, closing(SerialHall(1)) as hall:
        environment = {**os.environ, "MULTIDROP_NATS": one.urls[0], "XDG_STATE_HOME": str(tmp_path)}
        (tmp_path / "plant.toml").write_text(hall.plant())
        subprocess.run(
            [*words, "init", tmp_path / "plant.toml"], env=environment, check=True, timeout=PATIENCE_S
        )
        log = tmp_path / "gw-1.log"
        with log.open("w") as file:
            gateway = subprocess.Popen([*words, "serve", "gw-1"], env=environment, stderr=file)
        try:
            ends = time.monotonic() + PATIENCE_S
            while not hall.are_polled(0.5):
                assert time.monotonic() < ends, log.read_text()
                time.sleep(0.05)
            one.nodes[0].kill()
            while "all lines are closed" not in log.read_text():
                assert time.monotonic() < ends, log.read_text()
                time.sleep(0.05)
            gateway.terminate()
            assert gateway.wait(PATIENCE_S) == 0, log.read_text()
        finally:
            gateway.kill()
            gateway.wait()


# ---- the part `fleet` of `serve`: its settings, its health, and its view of a real fleet ----


@table(
    ("table", "sentence"),
    [
        ("nats = []", "nats = [] is not right; write nats = ["),
        (
            'nats = ["10.0.0.1"]',
            "nats: '10.0.0.1' is not an address of a NATS server; write nats = [\"nats://127",
        ),
        ("nats = [5]", "nats: 5 is not an address of a NATS server"),
        ('nats = "nats://a:4222"', "nats = 'nats://a:4222' is not right; write nats = ["),
        ("every = 5", "every"),
    ],
)
def test_each_mistake_in_the_fleet_table_is_reported(tmp_path: Path, table: str, sentence: str) -> None:
    with pytest.raises(PlantError) as raised:
        read_settings(written(tmp_path, f"[serve.fleet]\n{table}\n"), {})
    assert sentence in str(raised.value)


def test_a_missing_nats_library_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.split(".")[0] == "nats"]:
        monkeypatch.setitem(sys.modules, name, None)
    for name in [name for name in sys.modules if name.startswith("multidrop.fleet")]:
        monkeypatch.delitem(sys.modules, name)
    with pytest.raises(PlantError, match=r"the library nats is not installed: pip install 'nats-py"):
        read_settings(written(tmp_path, "[serve.fleet]\n"), {})


@pytest.mark.parametrize("dying", ["path", "watch", "commander", "path of samples", "rows", "lines"])
def test_fleet_page_ends_if_one_of_its_tasks_fails(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, dying: str
) -> None:
    """If the part did not end, the page would show an old view of the fleet forever."""

    async def go_on(*details: object) -> None:
        await asyncio.Event().wait()

    async def fail(*details: object) -> None:
        raise ZeroDivisionError

    path = ServerPath([])
    watch = FleetWatch(FleetView(path))
    source = FollowedFleet(ServerPath([]), watch)
    part = FleetPart(path, watch, lambda: FleetCommands([], by="page", log=tmp_path / "log"), source)
    works: dict[str, tuple[Any, str]] = {
        "path": (path, "keep"),
        "watch": (watch, "run"),
        "commander": (part, "_keep_commander"),
        "path of samples": (source.path, "keep"),
        "rows": (source, "_read_rows"),
        "lines": (source, "_watch_lines"),
    }
    for name, (owner, method) in works.items():
        monkeypatch.setattr(owner, method, fail if dying == name else go_on)
    with pytest.raises(ZeroDivisionError):
        asyncio.run(part.run())


class Looks(FleetView):
    """A view of a fleet. While `failure` is set, reading it fails."""

    failure: OSError | None = None

    async def look(self) -> None:
        if self.failure:
            raise self.failure


def test_the_fleet_page_is_unhealthy_if_its_data_is_older_than_5_s() -> None:
    now = [0.0]
    view = Looks(ServerPath([]))
    watch = FleetWatch(view, lambda: now[0])
    part = FleetPart(ServerPath([]), watch)

    def health_after(seconds: float) -> str:
        now[0] += seconds
        return part.health()

    assert health_after(0) == "the fleet was never read: the first read is in progress"
    view.failure = OSError("no server")
    asyncio.run(watch.look())
    assert health_after(0) == "the fleet was never read: no server"
    view.failure = None
    asyncio.run(watch.look())
    assert health_after(5) == ""
    assert health_after(1) == "the fleet was read 6 s ago: the first read is in progress"
    view.failure = OSError("no server")
    asyncio.run(watch.look())
    assert health_after(0) == "the fleet was read 6 s ago: no server"
    assert watch.state()["age_s"] == 6.0


def test_a_password_in_a_servers_url_is_never_shown() -> None:
    view = Looks(ServerPath([]))
    view.failure = OSError("no NATS server can be reached at nats://anna:s3cret@a:4222, tls://t0ken@b:4222")
    watch = FleetWatch(view)
    asyncio.run(watch.look())
    assert watch.state()["trouble"] == "no NATS server can be reached at nats://a:4222, tls://b:4222"


@pytest.mark.long
def test_the_page_shows_a_real_fleet_and_reports_a_missing_fleet(fleet: Cluster, tmp_path: Path) -> None:
    urls = ", ".join(f'"{url}"' for url in fleet.urls)
    with served(tmp_path, f"[serve.fleet]\nnats = [{urls}]\n") as gateway:
        assert gateway.get("/api/plant").json["fleet"] is True
        told: dict[str, Any] = {}

        def is_seen() -> bool:
            told.update(gateway.get("/api/fleet").json)
            return told["age_s"] is not None and told["trouble"] is None

        until(is_seen)
        assert (told["gateways"], told["lines"], told["moves"]) == ({}, {}, [])
        until(lambda: gateway.get("/health").json["parts"] == {"fleet": "ok"})
    with served(tmp_path) as gateway:
        assert gateway.get("/api/plant").json["fleet"] is False
        answer = gateway.get("/api/fleet")
        assert (answer.status, answer.json["error"]) == (
            404,
            "this gateway shows no fleet; add [serve.fleet] to the plant file",
        )


@pytest.fixture(scope="module")
def secured(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Yield a fleet with rights, whose gateway polls all lines."""
    from secured_clusters import secured_fleet

    with secured_fleet(tmp_path_factory.mktemp("secured"), 1, ("gw-a",)) as fleet:
        fleet.wait_for_polling()
        yield fleet


def fleet_table(fleet: Any, key: str, user: str) -> str:
    """Return a table [serve.fleet] of a plant file. Its entry `key` is the key file of this user."""
    servers = fleet.servers
    ca = f'ca = "{servers.tls.ca}"'
    return f'[serve.fleet]\nnats = ["{servers.urls[0]}"]\n{ca}\n{key} = "{servers.key(user)}"\n'


@pytest.mark.long
def test_the_page_can_show_the_fleet_with_only_a_viewers_key(secured: Any, tmp_path: Path) -> None:
    with served(tmp_path, fleet_table(secured, "credentials", "viewer")) as gateway:
        until(lambda: gateway.get("/api/fleet").json["lines"].keys() == secured.hall.lines.keys())
        until(lambda: gateway.get("/health").json["parts"] == {"fleet": "ok"})


@pytest.mark.long
@pytest.mark.parametrize("user", ["viewer", "commander"])
def test_the_page_stops_the_fleet_only_with_a_commanders_key(secured: Any, tmp_path: Path, user: str) -> None:
    may = '[serve.may]\nstop = "anyone"\n'
    with served(tmp_path, f"{fleet_table(secured, 'commander', user)}{may}") as gateway:
        assert gateway.get("/api/plant").json["fleet_stop"] is True
        part: Any = gateway.gateway.feeds["fleet"]
        until(lambda: part._commands is not None)
        told = gateway.post("/api/fleet/stop", {}).json
    drives = {name: one["done"] for name, one in told.items()}
    if user == "viewer":
        assert drives == {"the fleet": False}
        assert "NOT sent" in told["the fleet"]["text"]
    else:
        assert drives == {f"drive-{line}": True for line in secured.hall.lines}, told


def test_the_page_cannot_stop_the_fleet_without_a_commanders_key_or_servers(tmp_path: Path) -> None:
    with served(tmp_path, '[serve.may]\nstop = "anyone"\n') as gateway:
        assert gateway.get("/api/plant").json["fleet_stop"] is False
        answer = gateway.post("/api/fleet/stop", {})
        assert answer.status == 404
        assert "add key 'commander' to [serve.fleet]" in answer.json["error"]
    path: Any = ServerPath([])
    nobody: Any = object
    part = FleetPart(path, FleetWatch(Looks(path)), nobody)
    told = asyncio.run(part.stop("anna"))
    assert told == {
        "the fleet": (
            False,
            "the stop was NOT sent: no server of the fleet has answered yet; use the hard-wired stop",
        )
    }


@pytest.mark.slow
def test_missing_fleet_servers_are_reported_on_the_page(tmp_path: Path) -> None:
    [port] = free_ports(1)
    with served(tmp_path, f'[serve.fleet]\nnats = ["nats://127.0.0.1:{port}"]\n') as gateway:
        wanted = f"the fleet was never read: no NATS server can be reached at nats://127.0.0.1:{port}"
        until(lambda: wanted == gateway.get("/health").json["parts"]["fleet"])
        assert gateway.get("/api/fleet").json["age_s"] is None
        assert gateway.frame()["drives"]  # the gateway's own drives are still shown


# ---- its metrics: valid for promtool, only for this computer, robust against any request ----


OPEN = "application/openmetrics-text"
STATE: dict[str, Any] = {
    "gateway": "gw-1",
    "state": "working",
    "session": 7,
    "margin_s": 1.9,
    "paths": ["n1", "n2", "n1"],
    "lines": 4,
    "moves": 12,
    "troubles": {"hall-1": "no answer"},
    "lost": ["hall-1"],
    "failing": [],
    "unopened": ["hall-2", "hall-3"],
    "spool": {
        "bytes": 81234,
        "rows": 900,
        "waiting": 20,
        "lost": 0,
        "sent": 9,
        "behind": 2,
        "lag_s": 1.5,
        "trouble": None,
    },
}


def samples(state: dict[str, Any]) -> dict[str, float]:
    text = expose_metrics(families_of(state, "1.0"), "")[1]
    found = (line.rpartition(" ") for line in text.splitlines() if not line.startswith("#"))
    return {name.removeprefix("multidrop_fleet_"): float(value) for name, _, value in found}


def test_metrics_show_the_state_of_a_gateway() -> None:
    found = samples(STATE)
    assert found['gateway_info{gateway="gw-1",version="1.0"}'] == 1
    assert found['gateway_state{multidrop_fleet_gateway_state="working"}'] == 1
    assert found['gateway_state{multidrop_fleet_gateway_state="draining"}'] == 0
    expected = {"lease_margin_seconds": 1.9, "session": 7, "servers": 2, "troubled_lines": 1, "lines": 4}
    expected |= {"moves_total": 12, "spool_bytes": 81234, "spool_rows_total": 900, "spool_waiting_rows": 20}
    expected |= {"spool_lost_rows_total": 0, "sent_messages_total": 9, "behind_messages": 2}
    expected |= {"behind_seconds": 1.5, "lost_lines": 1, "failing_lines": 0, "unopened_lines": 2}
    assert {name: value for name, value in found.items() if "{" not in name} == expected


def test_metrics_omit_unknown_figures() -> None:
    spool = STATE["spool"] | {"behind": None, "lag_s": None}
    found = samples(STATE | {"session": 0, "margin_s": 0.0, "state": "no lease", "spool": spool})
    missing = {"lease_margin_seconds", "session", "behind_messages", "behind_seconds"}
    assert missing & found.keys() == set()
    assert found["lines"] == 4


def test_promtool_accepts_the_metrics() -> None:
    program = require_program("promtool")
    text = expose_metrics(families_of(STATE, "1.0"), "*/*")[1]
    checked = subprocess.run([program, "check", "metrics"], input=text.encode(), capture_output=True)
    assert (checked.returncode, checked.stdout, checked.stderr) == (0, b"", b"")


def test_an_openmetrics_parser_accepts_the_metrics() -> None:
    parser = require_module("prometheus_client.openmetrics.parser")
    text = expose_metrics(families_of(STATE, "1.0"), OPEN)[1]
    found = {one.name: one.type for one in parser.text_string_to_metric_families(text)}
    assert found["multidrop_fleet_gateway_state"] == "stateset"
    assert found["multidrop_fleet_moves"] == "counter"


def asked(line: str = "GET /metrics HTTP/1.1", host: str = "localhost:9464", *more: str) -> bytes:
    return "\r\n".join([line, f"Host: {host}", *more, "", ""]).encode("latin-1")


def said(head: bytes) -> tuple[int, str, str]:
    """Return the status, content type and text of the HTTP response to a request."""
    text = answer(head, lambda: families_of(STATE, "1.0")).decode()
    head_text, _, body = text.partition("\r\n\r\n")
    fields = dict(line.split(": ", 1) for line in head_text.split("\r\n")[1:])
    assert int(fields["content-length"]) == len(body.encode())
    return int(head_text.split()[1]), fields["content-type"], body


def test_metrics_are_served_in_prometheus_and_openmetrics_format() -> None:
    status, kind, text = said(asked())
    assert (status, kind) == (200, "text/plain; version=0.0.4; charset=utf-8")
    assert "multidrop_fleet_lines 4.0\n" in text
    status, kind, text = said(asked("GET /metrics HTTP/1.1", "127.0.0.1:1", f"Accept: {OPEN};version=1.0.0"))
    assert (status, kind) == (200, "application/openmetrics-text; version=1.0.0; charset=utf-8")
    assert text.endswith("# EOF\n")


@table(
    ("head", "status"),
    [
        (asked("GET / HTTP/1.1"), 404),
        (asked("GET /metricsx HTTP/1.1"), 404),
        (asked("POST /metrics HTTP/1.1"), 405),
        (asked("GET /metrics"), 400),
        (asked("GET /metrics GOPHER/1"), 400),
        (asked(host="plant.example"), 403),
        (asked(host="localhost.plant.example"), 403),
        (b"GET /metrics HTTP/1.1\r\n\r\n", 403),
        (asked(host="[::1]:9464"), 200),
        (asked("GET /metrics?x=1 HTTP/1.0"), 200),
    ],
)
def test_the_metrics_port_refuses_requests_for_anything_but_metrics(head: bytes, status: int) -> None:
    assert said(head)[0] == status


@given(st.binary(max_size=200))
def test_the_metrics_port_answers_any_bytes_with_an_http_response(data: bytes) -> None:
    assert said(data + b"\r\n\r\n")[0] in (400, 403, 404, 405)


OPEN_TO_OTHERS = "is open to other machines, without tokens or TLS"
INVALID = r"is not an address and port; write --metrics 127\.0\.0\.1:9464"


@table(
    ("address", "sentence"),
    [
        *(
            (one, OPEN_TO_OTHERS)
            for one in ("0.0.0.0:9464", "192.0.2.1:9464", "plant.example:9464", "[::]:9464")
        ),
        *((one, INVALID) for one in ("9464", "127.0.0.1", "127.0.0.1:x", ":9464", "127.0.0.1:99999")),
    ],
)
def test_invalid_or_remote_metrics_address_is_rejected(address: str, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        listen(address)


def test_a_metrics_port_in_use_is_reported_in_one_sentence() -> None:
    with closing(listen("127.0.0.1:0")) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(OSError, match=f"--metrics 127.0.0.1:{port} is not available: "):
            listen(f"127.0.0.1:{port}")


async def test_number_of_clients_of_the_metrics_port_is_limited() -> None:
    """Clients beyond the limit, and clients that send too much, are disconnected."""

    async def ask(port: int, data: bytes) -> bytes:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        try:
            writer.write(data)
            return await reader.read()
        except ConnectionError:
            return b""
        finally:
            writer.close()

    listener = listen("127.0.0.1:0")
    port = listener.getsockname()[1]
    async with serving(listener, lambda: families_of(STATE, "1.0")):
        assert (await ask(port, asked())).startswith(b"HTTP/1.1 200 OK\r\n")
        assert await ask(port, b"x" * 4 * MOST_HEAD) == b""
        silent = [await asyncio.open_connection("127.0.0.1", port) for _ in range(MOST_CLIENTS)]
        assert await ask(port, asked()) == b""
        silent.pop()[1].close()
        while not await ask(port, asked()):
            await asyncio.sleep(0.01)
    for _, writer in silent:
        writer.close()
