"""The command `multidrop serve` in its own process, as users and the service manager run it."""

from __future__ import annotations

import http.client
import json
import os
import shutil
import signal
import socket
import ssl
import subprocess
import sys
import time
from contextlib import ExitStack, closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from commands import MULTIDROP, BoundProcess, Run, multidrop
from gateways import (
    Served,
    certificate,
    gateway_of,
    get,
    plant_text,
    running,
    served,
    serving,
    simulated_plant,
    tokens,
    written,
)
from lines import PATIENCE, until
from tables import table

from multidrop import InvtCHE
from multidrop.cli import serve as serve_command
from multidrop.gateway.gateway import Gateway
from multidrop.gateway.http.connections import listen
from multidrop.gateway.http.rights import Right, digest, read_tokens
from multidrop.gateway.settings import read_settings
from multidrop.sim import Simulator, Wire, simulated

UNITS = sorted((Path(__file__).parents[2] / "packaging").glob("*.service"))


@pytest.mark.long
def test_the_service_manager_is_notified_that_the_gateway_is_ready_alive_or_stopping(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.settimeout(PATIENCE)
        with simulated_plant(
            tmp_path, '[serve]\nlisten = "127.0.0.1:0"\n[serve.may]\nstop = "anyone"\n'
        ) as path:
            environment = {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "400000"}
            with serving(path, "--log", "json", **environment) as (process, url):
                told = {manager.recv(1000).decode() for _ in range(6)}
                assert "WATCHDOG=1" in told
                assert any(one.startswith("READY=1\n") for one in told)
                port = int(url.rstrip("/").rpartition(":")[2])
                connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE)
                with closing(connection):
                    connection.request("POST", "/api/stop", "{}", {"content-type": "application/json"})
                    found = json.loads(connection.getresponse().read())
                assert [one["done"] for one in found.values()] == [True, True]
                process.send_signal(signal.SIGTERM)
                out, errors = process.communicate(timeout=PATIENCE)
                assert (process.returncode, out) == (0, "")
                last = b""
                while b"STOPPING=1" not in last:
                    last = manager.recv(1000)
    records = [json.loads(line) for line in errors.splitlines()]
    (stop,) = [one for one in records if one["message"].startswith("stop of all drives")]
    asked = "stop of all drives, asked for by anyone by http from 127.0.0.1 (command "
    assert stop["message"].startswith(asked)
    assert (stop["level"], stop["logger"]) == ("warning", "multidrop.gateway")
    assert all({"time", "level", "logger", "message"} <= one.keys() for one in records)


@pytest.mark.long
def test_sighup_reloads_the_plant_file_and_notifies_systemd(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.settimeout(PATIENCE)
        with simulated_plant(tmp_path, '[serve]\nlisten = "127.0.0.1:0"\n') as path:
            good = path.read_text()
            environment = {"NOTIFY_SOCKET": str(tmp_path / "notify")}
            with serving(path, "--log", "json", **environment) as (process, _):
                assert manager.recv(1000).startswith(b"READY=1\n")
                for text in (good.replace("[[line]]", "[[lin]]"), good.replace("pump-2", "fan-2")):
                    path.write_text(text)
                    before = time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000
                    process.send_signal(signal.SIGHUP)
                    reloading, _, when = manager.recv(1000).decode().partition("\nMONOTONIC_USEC=")
                    assert reloading == "RELOADING=1"
                    assert before <= int(when) <= time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000
                    assert manager.recv(1000) == b"READY=1\nSTATUS=polling 1 lines"
                process.send_signal(signal.SIGTERM)
                _, errors = process.communicate(timeout=PATIENCE)
                assert process.returncode == 0
    messages = [json.loads(line)["message"] for line in errors.splitlines()]
    assert messages.count("reload, asked for by a signal") == 2
    mistake = f"the previous plant stays in use: {path}:1: unknown key 'lin'; did you mean line?"
    assert mistake in messages
    assert "the plant file is in effect" in messages


def test_a_plant_without_a_file_cannot_be_reloaded(tmp_path: Path) -> None:
    with served(tmp_path) as gateway:
        gateway.gateway.reload._read = None
        told = gateway.reload()
        assert (told["done"], told["text"]) == (
            False,
            "this plant was not read from a file, so it cannot be reloaded",
        )


@pytest.mark.long
def test_sigterm_ends_the_gateway_while_viewers_wait_for_values(tmp_path: Path) -> None:
    with ExitStack() as stack:
        path = stack.enter_context(simulated_plant(tmp_path, '[serve]\nlisten = "127.0.0.1:0"\n'))
        process, url = stack.enter_context(serving(path))
        port = int(url.rstrip("/").rpartition(":")[2])
        viewers = []
        for _ in range(20):
            connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE)
            viewers.append(stack.enter_context(closing(connection)))
        newest = json.loads(get(viewers[0], "/api/frame"))["n"]
        for viewer in viewers:
            viewer.request("GET", f"/api/frame?after={newest + 1}")
            assert viewer.getresponse().read()
            viewer.request("GET", f"/api/frame?after={newest + 2}")
        process.send_signal(signal.SIGTERM)
        assert {viewer.getresponse().status for viewer in viewers} <= {200, 304}
        _, errors = process.communicate(timeout=PATIENCE)
        assert process.returncode == 0
        assert "Traceback" not in errors


@pytest.mark.long
def test_a_stop_is_sent_while_nobody_reads_the_log_output(tmp_path: Path) -> None:
    """The log is not read while a user has pressed Ctrl-S in the terminal, or while the journal hangs."""
    with simulated_plant(tmp_path, '[serve]\nlisten = "127.0.0.1:0"\n[serve.may]\nstop = "anyone"\n') as path:
        unread, log = os.pipe()
        patient = f"from multidrop.cli import main, serve; serve.END_S = {PATIENCE}; raise SystemExit(main())"
        words = [sys.executable, "-c", patient, "serve", str(path)]
        with (
            os.fdopen(unread),
            os.fdopen(log, "wb"),
            BoundProcess(words, stdout=subprocess.PIPE, stderr=log, text=True) as process,
        ):
            assert process.stdout is not None
            port = int(process.stdout.readline().rstrip("/\n").rpartition(":")[2])
            os.set_blocking(log, False)  # so that the test can fill the pipe without hanging
            with suppress(BlockingIOError):
                while True:
                    os.write(log, bytes(1))
            os.set_blocking(log, True)
            connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE)
            with closing(connection):
                connection.request("POST", "/api/stop", "{}", {"content-type": "application/json"})
                found = json.loads(connection.getresponse().read())
            assert [one["done"] for one in found.values()] == [True, True]
            process.send_signal(signal.SIGTERM)
            assert process.wait(PATIENCE) == 0


@pytest.mark.long
def test_a_gateway_with_tls_answers_over_https(tmp_path: Path) -> None:
    certificate(tmp_path, "own")
    serve = '[serve]\nlisten = "127.0.0.1:0"\ncertificate = "own.pem"\nkey = "own.key"\ntokens = "tokens"\n'
    (tmp_path / "tokens").write_text(f"anna stop {digest('secret')}\n")
    with simulated_plant(tmp_path, serve) as path, serving(path) as (_, url):
        assert url.startswith("https://127.0.0.1:")
        port = int(url.rstrip("/").rpartition(":")[2])
        context = ssl.create_default_context(cafile=str(tmp_path / "own.pem"))
        silent = socket.create_connection(("127.0.0.1", port))  # a client that never sends its TLS handshake
        connection = http.client.HTTPSConnection("localhost", port, context=context, timeout=PATIENCE)
        connection.request("POST", "/api/token", '{"token": "secret"}', {"content-type": "application/json"})
        response = connection.getresponse()
        assert json.loads(response.read()) == {"name": "anna", "role": "stop"}
        assert "Secure" in str(response.getheader("set-cookie"))
        silent.close()
        connection.close()


@pytest.mark.long
def test_an_http_port_in_use_is_reported_in_one_sentence(tmp_path: Path) -> None:
    with listen("127.0.0.1", 0) as taken:
        port = taken.getsockname()[1]
        written(tmp_path, f'[serve]\nlisten = "127.0.0.1:{port}"\n')
        done = multidrop("serve", tmp_path / "plant.toml")
    assert done.returncode == 1
    assert (
        done.stderr
        == f"multidrop: listen: 127.0.0.1:{port} cannot be opened: another program listens there\n"
    )


def test_the_command_serve_check_reports_mistakes_in_the_plant_file(run: Run, tmp_path: Path) -> None:
    plant = written(tmp_path, '[serve]\nlisten = "localhost:80"\n')
    assert run("serve", "--check", plant.path) == (
        0,
        f"{plant.path}: no mistake found; http://localhost:80/, parts: none\n",
        "",
    )
    written(tmp_path, "[serve]\nlisten = 80\n[serve.may]\nstop = 1\n")
    status, out, errors = run("serve", "--check", plant.path)
    assert (status, out) == (2, "")
    assert errors.splitlines() == [
        f'multidrop: {plant.path}:18: [serve]: listen = 80 is not right; write listen = "127.0.0.1:8750"',
        f'multidrop: {plant.path}:20: [serve.may]: stop = 1 is not right; write stop = "token"',
    ]
    plant.path.write_text(plant.path.read_text().replace("address = 2", "address = 1"))
    _, _, also = run("serve", "--check", plant.path)
    assert len(also.splitlines()) == 3
    assert set(errors.splitlines()) < set(also.splitlines())


@pytest.mark.parametrize("command", ["check", "plan"])
def test_commands_other_than_serve_ignore_the_serve_table(run: Run, tmp_path: Path, command: str) -> None:
    plant = written(tmp_path, '[serve]\nlisten = "localhost:80"\nnot_known = 1\n')
    status, out, errors = run(command, plant.path)
    assert (status, errors) == (0, "")
    if command == "check":
        found = f"No mistake found in {plant.path}: 1 line, 2 drives"
        assert out == f"{found}; `multidrop serve --check` checks its [serve].\n"


def test_a_newly_made_token_is_shown_once(run: Run) -> None:
    status, line, told = run("serve", "--new-token", "stop", "--for", "anna")
    assert status == 0
    (token,), _ = read_tokens(line)
    assert (token.name, token.right) == ("anna", Right.STOP)
    assert told.startswith("multidrop: the token of anna, shown this once: ")
    assert digest(told.rpartition(" ")[2].strip()) == token.sha256


@table(
    ("words", "sentence"),
    [
        ((), "name a plant file, or try `multidrop serve --demo`"),
        (("--demo", "plant.toml"), "--demo uses its own plant: give no plant file"),
        (("--demo", "--port", "hall=x"), "--demo uses its own plant: remove --port"),
        (
            ("--new-token", "stop"),
            "a new token needs a role and an owner, such as `multidrop serve --new-token stop --for anna`",
        ),
        (
            ("--new-token", "stop", "--for", "a b"),
            "invalid owner 'a b': use up to 64 letters, digits and . _ @ -, a letter or digit first",
        ),
    ],
)
def test_invalid_options_of_serve_are_refused(run: Run, words: tuple[str, ...], sentence: str) -> None:
    assert run("serve", *words) == (2, "", f"multidrop: {sentence}\n")


def test_the_web_demo_refuses_options_for_recordings(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serve_command, "serve_demo", lambda **_: 0)
    code, printed, warned = run("demo", "--web")
    assert (code, printed.split()[0], warned) == (0, "Next:", "")
    why = "multidrop: --web serves until Ctrl-C and records nothing: remove"
    assert run("demo", "--web", "--out", "run.csv") == (2, "", f"{why} --out\n")
    assert run("demo", "--web", "--seconds", 3, "--json") == (2, "", f"{why} --seconds and --json\n")


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("words", [["demo", "--web"], ["serve", "--demo"]])
def test_a_web_demo_shows_live_values_and_lets_local_users_write(words: list[str]) -> None:
    with BoundProcess([*MULTIDROP, *words, "--no-browser"], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        port = int(process.stdout.readline().strip().rstrip("/").rpartition(":")[2])

        def read(path: str) -> dict[str, Any]:
            with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE)) as connection:
                found: dict[str, Any] = json.loads(get(connection, path))
                return found

        plant = read("/api/plant")
        assert plant["demo"] is True
        assert plant["may"]["role"] == "write"
        until(lambda: all(one["seen"] is not None for one in dict(read("/api/frame")["drives"]).values()))
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE) == 0


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")
@pytest.mark.parametrize("path", UNITS, ids=lambda path: path.stem)
def test_the_systemd_unit_file_is_valid_and_restricts_the_service(tmp_path: Path, path: Path) -> None:
    unit = tmp_path / path.name.replace("@", "@hall")
    unit.write_text(path.read_text().replace("/opt/multidrop/bin/multidrop", "/bin/true"))
    verified = subprocess.run(["systemd-analyze", "verify", unit], capture_output=True, text=True)
    assert (verified.returncode, verified.stderr) == (0, "")
    judge = ["systemd-analyze", "security", "--offline=true", "--threshold=20", "--no-pager", str(unit)]
    judged = subprocess.run(judge, capture_output=True, text=True)
    assert judged.returncode == 0, judged.stdout


# ---- if a port is missing when the gateway starts, its line is lost, and the other lines are polled ----


SERVE = '[serve]\nlisten = "127.0.0.1:0"\n[serve.may]\nstop = "anyone"\n'


@pytest.mark.slow
def test_a_line_is_polled_as_soon_as_its_missing_port_appears(tmp_path: Path) -> None:
    port = tmp_path / "late"
    sims = [simulated(InvtCHE(1, name=name, baudrate=38400)) for name in ("pump-1", "fan-1")]
    with Simulator([Wire([sim], unpaced=True) for sim in sims]) as simulator:
        text = plant_text(simulator.wires[0].path, ["pump-1"])
        text += plant_text(str(port), ["fan-1"], SERVE).replace('"hall"', '"roof"')
        (tmp_path / "plant.toml").write_text(text)
        gateway = gateway_of(tmp_path / "plant.toml")
        with running(gateway):
            served = Served(gateway, dict(zip(("pump-1", "fan-1"), sims, strict=True)), tokens()[0])
            served.await_state("pump-1", "stands")
            served.await_state("fan-1", "silent")
            lost = served.frame()["lines"]["roof"]["lost"]
            assert lost == f"{port}: there is no such port"
            assert served.get("/api/lines").json["roof"]["lost"] == lost
            health = served.get("/health")
            assert (health.status, health.json["status"]) == (200, "degraded")
            assert health.json["lines"] == {"hall": "ok", "roof": lost}
            metrics = served.get("/metrics").body.decode()
            assert 'multidrop_line_up{line="hall"} 1.0\n' in metrics
            assert 'multidrop_line_up{line="roof"} 0.0\n' in metrics
            assert served.post("/api/stop", {"drives": ["pump-1"]}).json["pump-1"]["done"] is True

            port.symlink_to(simulator.wires[1].path)
            served.await_state("fan-1", "stands")
            assert served.get("/health").json["lines"] == {"hall": "ok", "roof": "ok"}
            until(lambda: 'multidrop_line_up{line="roof"} 1.0\n' in served.get("/metrics").body.decode())
            until(lambda: not gateway.hub.unopened)
            assert served.get("/health").json["status"] == "ok"


@pytest.mark.slow
def test_the_health_report_says_why_a_port_was_lost_after_the_start(tmp_path: Path) -> None:
    port = tmp_path / "hall"
    gateway = gateway_of(written(tmp_path, SERVE, port=str(port)).path)
    with ExitStack() as stack:
        with Simulator([Wire([simulated(InvtCHE(1, baudrate=38400))], unpaced=True, port=str(port))]):
            stack.enter_context(running(gateway))
            served = Served(gateway, {}, tokens()[0])
            served.await_state("pump-1", "stands")
        told = {"hall": f"{port}: there is no such port"}
        until(lambda: served.get("/health").json["lines"] == told)
        until(lambda: gateway.status == "STATUS=polling 0 lines; 1 lost")
        assert served.get("/health").json["status"] == "degraded"


def test_an_invalid_port_leaves_no_socket_open(tmp_path: Path) -> None:
    plant = written(tmp_path, SERVE)
    # reading a plant file would refuse this port
    plant = replace(plant, lines=(plant.lines[0].at("nosuch://port"),))
    gateway = Gateway(plant, read_settings(plant, {}))
    with pytest.raises(ValueError, match="nosuch"), running(gateway):
        pass
    assert gateway.listener.fileno() == -1
