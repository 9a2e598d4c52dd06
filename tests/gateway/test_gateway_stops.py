"""Stops through the gateway are sent and verified, even if other functions of the gateway fail or hang."""

from __future__ import annotations

import asyncio
import http.client
import json
import re
import shlex
import socket
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from errno import ENOSPC
from importlib.resources import files
from pathlib import Path
from time import monotonic, sleep
from types import SimpleNamespace
from typing import Any

import pytest
from broken_part import BrokenFeed
from gateways import Served, served, written
from lines import PATIENCE, until
from tables import table

from multidrop import Drive, PlantError
from multidrop.control import CommandOutcome, CommandResult
from multidrop.control.commands import BEGINNING_S, MOST_STOPS, Results
from multidrop.control.records import AuditLog
from multidrop.gateway import commands, parts
from multidrop.gateway.http import messages
from multidrop.gateway.http.rights import Right
from multidrop.gateway.settings import read_settings

MAY = """[serve.may]
stop = "anyone"
write = ["pump-1.setpoint", "pump-2.setpoint", "pump-1.control"]
verbs = ["pump-1.start", "pump-2.start", "pump-1.set_frequency", "pump-1.jog", "pump-1.coast"]
"""
STOP = b"POST /api/stop HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\ncontent-length: "
BROKEN = f"{MAY}[serve.history]\n[serve.mqtt]\n"


@pytest.fixture
def _broken_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("history", "mqtt"):
        monkeypatch.setitem(parts.PARTS, name, "broken_part:Settings")  # type: ignore[arg-type]


def calling(gateway: Served) -> socket.socket:
    """Return an HTTP connection to a gateway. A `with` block closes it."""
    return socket.create_connection(("127.0.0.1", gateway.gateway.port), PATIENCE)


@pytest.mark.long
@pytest.mark.parametrize(
    ("path", "body"), [("/api/stop", {"drives": None}), ("/api/act", {"drive": "pump-1", "verb": "coast"})]
)
def test_http_answer_headers_are_sent_while_a_stop_is_in_progress(
    gateway: Served, monkeypatch: pytest.MonkeyPatch, path: str, body: dict[str, object]
) -> None:
    """Until the head arrives, the web page assumes that the gateway has not accepted the stop."""
    held = threading.Event()

    async def slow(*args: object, **options: object) -> object:
        await asyncio.to_thread(held.wait, PATIENCE)
        told = CommandResult(CommandOutcome.DONE, "stopped: seen to stand")
        return told if path == "/api/act" else {"pump-1": told}

    monkeypatch.setattr(gateway.gateway.commands, "act" if path == "/api/act" else "stop", slow)
    connection = http.client.HTTPConnection("127.0.0.1", gateway.gateway.port, timeout=PATIENCE)
    connection.request("POST", path, json.dumps(body), {"content-type": "application/json"})
    response = connection.getresponse()  # returns when the head has arrived
    assert (response.status, held.is_set()) == (200, False)
    assert response.getheader("x-accel-buffering") == "no"
    held.set()
    told = json.loads(response.read())
    stopped = told if path == "/api/act" else told["pump-1"]
    assert (stopped["done"], stopped["text"]) == (True, "stopped: seen to stand")
    connection.close()


def test_a_stop_continues_after_its_client_disconnects(
    gateway: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    ends: list[str] = []
    held = threading.Event()

    async def slow(*args: object, **options: object) -> dict[str, CommandResult]:
        try:
            await asyncio.to_thread(held.wait, PATIENCE)
            ends.append("over")
        except asyncio.CancelledError:
            ends.append("cancelled")
            raise
        return {}

    monkeypatch.setattr(gateway.gateway.commands, "stop", slow)
    with calling(gateway) as leaving:
        leaving.sendall(STOP + b'16\r\n\r\n{"drives": null}')
        assert leaving.recv(64).startswith(b"HTTP/1.1 200")
    gateway.frame()
    held.set()
    until(lambda: ends)
    assert ends == ["over"]


@pytest.mark.slow
def test_a_stop_of_all_drives_is_sent_and_verified(gateway: Served) -> None:
    gateway.start("pump-1", "pump-2")
    gateway.await_state("pump-1", "runs")
    told = gateway.post("/api/stop", {"drives": None}).json
    assert {name: one["done"] for name, one in told.items()} == {"pump-1": True, "pump-2": True}
    assert all("seen to stand" in one["text"] for one in told.values())
    assert gateway.stands("pump-1")
    assert gateway.stands("pump-2")
    gateway.await_state("pump-1", "stands")


@pytest.mark.slow
def test_the_command_in_the_page_without_javascript_stops_all_drives(tmp_path: Path) -> None:
    page = (files("multidrop.gateway") / "page" / "index.html").read_text("utf-8")
    without = page[page.index("<noscript") : page.index("</noscript")]
    said, token = (shlex.split(command) for command in re.findall("<code>(.+)</code>", without))
    with served(tmp_path, "") as gateway:  # with these settings, a stop needs a token
        assert said[:2] == ["curl", "-H"]
        name, value = said[2].split(": ")
        assert said[3] == "-d"
        address, path = said[-1].split("/", 1)
        assert (address, token[0]) == ("ADDRESS", "-H")
        key, bearer = token[1].replace("TOKEN", gateway.secrets[Right.STOP]).split(": ")
        headers = {name.replace("-", "_"): value, key: bearer}
        told = gateway.request("POST", f"/{path}", said[4].encode(), **headers).json
        assert {name: one["done"] for name, one in told.items()} == {"pump-1": True, "pump-2": True}


UNREADABLE = {
    "late": b"100\r\n\r\n{",
    "longer than any list of drives": b"%d\r\n\r\n%s" % (70_000, b" " * 70_000),
    "no JSON": b"4\r\n\r\nstop",
    "no body": b"0\r\n\r\n",
    "no object": b"2\r\n\r\n[]",
    "a number": b"13\r\n\r\n" + b'{"drives": 1}',
    "an empty list": b"14\r\n\r\n" + b'{"drives": []}',
    "no names": b"15\r\n\r\n" + b'{"drives": [1]}',
}


@pytest.fixture
def gateway(tmp_path: Path) -> Iterator[Served]:
    with served(tmp_path, MAY) as gateway:
        yield gateway


@pytest.mark.long
@pytest.mark.slow
@table("body", UNREADABLE.values(), ids=UNREADABLE)
def test_a_stop_with_an_unreadable_body_stops_all_drives(
    gateway: Served, monkeypatch: pytest.MonkeyPatch, body: bytes
) -> None:
    monkeypatch.setattr(messages, "STOP_BODY_S", 0.1)
    with calling(gateway) as client:
        gateway.start("pump-1", "pump-2")
        client.sendall(STOP + body)
        response = http.client.HTTPResponse(client)
        response.begin()
        told = json.loads(response.read())
        assert {name: one["done"] for name, one in told.items()} == {"pump-1": True, "pump-2": True}
        assert gateway.stands("pump-1")
        assert gateway.stands("pump-2")


@pytest.mark.slow
@table("drives", ["pump-1", ["pump-1"], ["pump-1", "\ud800", "\x1b[2J\n", "PUMP-2", "", "pump-9"]])
def test_a_stop_stops_only_the_named_drives(gateway: Served, drives: str | list[str]) -> None:
    """Names of other drives: a lone surrogate, an escape sequence for terminals, a name in capitals."""
    gateway.start("pump-1", "pump-2")
    told = gateway.post("/api/stop", {"drives": drives}).json
    assert [*told] == ([drives] if isinstance(drives, str) else drives)
    assert [name for name, one in told.items() if one["done"]] == ["pump-1"]
    assert [told[name]["text"] for name in told if name == "pump-9"] == ["there is no drive 'pump-9'"] * (
        "pump-9" in drives
    )
    assert gateway.stands("pump-1")
    assert not gateway.stands("pump-2")


@pytest.mark.long
@table("verb", ["stop", "coast"])
@table("options", [None, [], "now", {"direction": "forward"}])
def test_a_stop_verb_with_wrong_options_is_sent(gateway: Served, verb: str, options: object) -> None:
    """Some programs send null instead of an empty object."""
    gateway.start("pump-1")
    body = {"drive": "pump-1", "verb": verb, "options": options}
    assert gateway.post("/api/act", body).json["done"] is True
    assert gateway.stands("pump-1")


@pytest.mark.slow
def test_a_stop_with_a_truncated_body_is_sent(gateway: Served) -> None:
    gateway.start("pump-1", "pump-2")
    with calling(gateway) as client:
        client.sendall(STOP + b'100\r\n\r\n{"drives": ["pump-1", "pu')
    until(lambda: gateway.stands("pump-1") and gateway.stands("pump-2"))


@pytest.mark.slow
def test_a_stop_by_a_client_without_the_right_to_stop_is_not_sent(tmp_path: Path) -> None:
    with served(tmp_path, MAY.replace('stop = "anyone"\n', "")) as gateway, calling(gateway) as client:
        gateway.start("pump-1", "pump-2")
        client.sendall(STOP + UNREADABLE["late"])
        assert client.recv(1000).startswith(b"HTTP/1.1 401 ")
        assert gateway.gateway.commands.stops == {}


@pytest.mark.slow
@pytest.mark.usefixtures("_broken_parts")
def test_a_stop_works_while_mqtt_and_history_fail(tmp_path: Path) -> None:
    with served(tmp_path, BROKEN) as gateway:
        assert isinstance(gateway.gateway.feeds["mqtt"], BrokenFeed)
        gateway.start("pump-1", "pump-2")
        until(lambda: gateway.gateway.failures.get("history", 0) > 3)
        told = gateway.post("/api/stop").json
        assert [one["done"] for one in told.values()] == [True, True]
        health = gateway.get("/health")
        assert health.status == 503
        assert health.json["status"] == "failed"
        assert health.json["parts"] == health.json["dead"]
        assert health.json["dead"] == {
            "history": "RuntimeError: no broker",
            "mqtt": "RuntimeError: no broker",
        }
        gateway.await_state("pump-1", "stands")
        assert 'multidrop_part_failures_total{part="history"}' in gateway.get("/metrics").body.decode()


@pytest.mark.slow
def test_a_stop_works_while_values_cannot_be_shown(gateway: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    gateway.start("pump-1", "pump-2")

    def fail(*arguments: object, **more: object) -> None:
        raise ZeroDivisionError

    for broken in ("hub.take", "hub.seen", "alarms.look", "frames.note_news", "recent.tick"):
        name, method = broken.split(".")
        monkeypatch.setattr(getattr(gateway.gateway, name), method, fail)
    until(lambda: gateway.gateway.failures.get("hub", 0) > 3)
    gateway.gateway.frames._has_news = True  # without new values, no message to the page is made
    assert gateway.get("/api/frame").status == 500
    assert [one["done"] for one in gateway.post("/api/stop").json.values()] == [True, True]


@pytest.mark.slow
def test_a_stop_does_not_wait_for_hanging_writes(gateway: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    """MOST_WRITES writes hang, so further writes are refused; stops are still sent."""
    held, entered = threading.Event(), []
    gateway.start("pump-1", "pump-2")
    pump = gateway.gateway.bus("hall").drives[0]

    def hang(*arguments: object) -> None:
        entered.append(arguments)
        held.wait()
        raise ValueError("it was held up")

    monkeypatch.setattr(type(pump), "try_write", hang)
    found: list[str] = []

    def write(value: float) -> None:
        found.append(gateway.write("pump-1", "setpoint", value)["text"])

    writes = [threading.Thread(target=write, args=(float(value),)) for value in range(12)]
    try:
        for write in writes:
            write.start()
        until(lambda: len(entered) == 8 and len(found) == 4)
        coast = {"drive": "pump-1", "verb": "coast", "options": {}}
        assert gateway.post("/api/act", coast).json["done"]
        assert [one["done"] for one in gateway.post("/api/stop").json.values()] == [True, True]
    finally:
        held.set()
    for write in writes:
        write.join()
    refused = [text for text in found if text != "it was held up"]
    assert len(refused) == 4
    assert all(
        text.endswith(" was not sent: 8 other commands are under way on line hall") for text in refused
    )


@pytest.mark.slow
def test_waiting_commands_are_not_sent_after_a_later_stop(gateway: Served) -> None:
    """The thread of each command starts only after the stop was called."""
    begun: list[threading.Thread] = []

    class Late(threading.Thread):
        def start(self) -> None:
            begun.append(self)

    commands = gateway.gateway.commands
    gateway.start("pump-1")
    told: list[str] = []
    asked = threading.Thread(target=lambda: told.append(gateway.act("pump-1", "start")["text"]))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("multidrop.supervisor.threading", SimpleNamespace(Thread=Late))
        asked.start()
        until(lambda: len(begun) == 1)
    assert gateway.post("/api/stop").json["pump-1"]["done"] is True
    threading.Thread.start(begun[0])
    asked.join()
    assert told == ["pump-1.start was not sent: a stop was called"]
    assert gateway.stands("pump-1")
    assert commands.called == 4


@pytest.mark.slow
def test_a_stop_is_sent_although_no_thread_can_be_started(gateway: Served) -> None:
    class NoThread(threading.Thread):
        def start(self) -> None:
            raise RuntimeError("can't start new thread")

    gateway.start("pump-1")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("multidrop.supervisor.threading", SimpleNamespace(Thread=NoThread))
        told = gateway.write("pump-1", "setpoint", 10.0)
        assert (told["done"], told["text"]) == (False, "can't start new thread")
        assert gateway.post("/api/stop").json["pump-1"]["done"] is True
    assert gateway.stands("pump-1")


@pytest.mark.long
def test_many_stops_of_a_silent_drive_do_not_delay_the_stop_of_another(gateway: Served) -> None:
    """Of the 40 stops, the gateway repeats only one and joins most, so it can send the other drive's stop."""
    with ThreadPoolExecutor(40) as callers:
        gateway.start("pump-1", "pump-2")
        gateway.sims["pump-2"].deaf_until = float("inf")
        calls = [callers.submit(gateway.post, "/api/stop", {"drives": ["pump-2"]}) for _ in range(40)]
        until(lambda: gateway.gateway.commands.stops["pump-2"] > MOST_STOPS)
        begun = monotonic()
        assert gateway.post("/api/stop", {"drives": ["pump-1"]}).json["pump-1"]["done"] is True
        assert monotonic() - begun < 12.0  # s; the motor's ramp takes 3 s
        gateway.sims["pump-2"].deaf_until = 0.0
        assert [call.result().json["pump-2"]["done"] for call in calls] == [True] * 40
        assert gateway.stands("pump-2")


@pytest.mark.slow
def test_only_one_of_nine_coast_commands_is_repeated_to_a_silent_drive(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    repeated: list[float | None] = []
    stop = commands.stop_drive

    def noted(drive: Drive, seconds: float | None, verb: str) -> Results:
        repeated.append(seconds)
        return stop(drive, seconds, verb)

    monkeypatch.setattr(commands, "stop_drive", noted)
    coast = {"drive": "pump-1", "verb": "coast", "options": {}}
    with served(tmp_path, MAY) as gateway, ThreadPoolExecutor(9) as callers:
        gateway.sims["pump-1"].deaf_until = float("inf")
        calls = [callers.submit(gateway.post, "/api/act", coast)]
        until(lambda: "pump-1" in gateway.gateway.bus("hall").stops_under_way())
        calls += [callers.submit(gateway.post, "/api/act", coast) for _ in range(8)]
        stops = gateway.gateway.commands._repeated["coast"]
        # If the repeated command succeeded before all others have failed, it would be repeated again.
        until(lambda: len(stops._tasks) == 8 and not stops._sent and not stops._waiting)
        assert gateway.gateway.commands.stops["pump-1"] == 9
        gateway.sims["pump-1"].deaf_until = 0.0
        assert [call.result().json["done"] for call in calls] == [True] * 9
    assert repeated.count(None) == 1


@pytest.mark.long
def test_a_new_stop_is_sent_if_a_stopped_motor_was_started_again(gateway: Served) -> None:
    """The first stop is still repeated to the silent drive, but has ended for the other."""
    with ThreadPoolExecutor(1) as caller:
        gateway.start("pump-1", "pump-2")
        gateway.sims["pump-2"].deaf_until = float("inf")
        whole = caller.submit(gateway.post, "/api/stop", {})
        motor = gateway.sims["pump-1"].motor  # type: ignore[attr-defined]
        bus = gateway.gateway.bus("hall")
        until(lambda: not motor.goal and set(bus.stops_under_way()) == {"pump-2"})
        sleep(BEGINNING_S)  # until then, a stop counts as not begun, and a new one waits for its result
        motor.run()  # a person starts the motor at the drive's own panel
        until(lambda: motor.goal)
        told = gateway.post("/api/stop", {"drives": ["pump-1"]}).json["pump-1"]
        assert told["done"]
        assert told["text"].startswith("stopped: seen to stand after")
        assert gateway.stands("pump-1")
        assert not whole.done()
        gateway.sims["pump-2"].deaf_until = 0.0
        assert [one["done"] for one in whole.result().json.values()] == [True, True]
        assert gateway.stands("pump-2")


@pytest.mark.slow
def test_verbs_and_writes_are_answered_with_their_results(gateway: Served) -> None:
    def act(verb: str, **options: object) -> str:
        return str(gateway.act("pump-1", verb, **options)["text"])

    def write(value: float) -> str:
        return str(gateway.write("pump-1", "setpoint", value)["text"])

    assert write(50.0) == "pump-1: setpoint = 50.00 %: done (read back)"
    assert write(150.0) == (
        "pump-1: setpoint = 150 is outside 0 to 100 % (manual: CHE100 manual v1.4, p. 117)"
    )
    assert "takes a finite number, not nan" in write(float("nan"))
    told = gateway.write("pump-1", "control", 1.5)
    assert told["text"] == "control takes the name or the number of a choice, not 1.5"
    told = gateway.write("pump-1", "control", 1)
    assert told["done"] is False
    assert "start" in told["text"]
    assert gateway.stands("pump-1")
    assert act("fly") == (
        "there is no verb 'fly'; there are start, jog, reset_fault, set_frequency, coast, "
        "emergency_stop, stop"
    )
    assert act("start", direction="up") == "direction = 'up' is neither forward nor reverse"
    assert act("start", at=5) == "start has no option 'at'; it has direction"
    assert act("set_frequency") == "set_frequency needs a frequency: hz = 20.0"
    assert act("set_frequency", hz="fast") == "hz = 'fast' is not a number"
    assert act("set_frequency", hz=10**400).endswith("0 is not a number")
    assert act("set_frequency", hz=None) == "set_frequency needs a frequency: hz = 20.0"
    assert act("set_frequency", hz=20) == (
        "pump-1 takes its setpoint in percent of P0.04, the maximum frequency: write maximum_frequency = HZ "
        "below its [[line.drive]]"
    )


def test_only_stops_are_sent_if_the_audit_log_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(log: AuditLog, *record: object) -> None:
        raise OSError(ENOSPC, "No space left on device")

    with served(tmp_path, f'[serve]\naudit = "audit.jsonl"\n{MAY}') as gateway:
        commands: list[Callable[[], Any]] = [
            lambda: gateway.write("pump-1", "setpoint", 50.0),
            lambda: gateway.act("pump-1", "start"),
        ]
        assert gateway.write("pump-1", "setpoint", 40.0)["done"] is True
        with monkeypatch.context() as full:
            full.setattr(AuditLog, "add", fail)
            before = len(gateway.sims["pump-1"].counters.writes)
            for command in commands:
                told = command()
                assert told["done"] is False
                assert told["text"].endswith(
                    " was not sent: the audit log cannot be written: No space left on device"
                )
            assert len(gateway.sims["pump-1"].counters.writes) == before
            assert [one["done"] for one in gateway.post("/api/stop").json.values()] == [True, True]
            assert len(gateway.sims["pump-1"].counters.writes) > before
            assert gateway.get("/health").json["audit"].endswith("No space left on device")
        assert [command()["done"] for command in commands] == [True, True]
        assert gateway.get("/health").json["audit"] == "ok"


@pytest.mark.usefixtures("_broken_parts")
def test_a_gateway_part_that_cannot_start_is_reported_in_one_sentence(tmp_path: Path) -> None:
    for how, sentence in (
        ("library", r"\[serve.mqtt\]: the library nosuch is not installed: pip install 'paho-mqtt"),
        ("port", r"\[serve.mqtt\]: 127.0.0.1:1502 cannot be had"),
    ):
        with pytest.raises(ValueError, match=sentence), served(tmp_path, f'[serve.mqtt]\nbreaks = "{how}"\n'):
            pass
    plant = written(tmp_path, '[serve.mqtt]\nbreaks = "somehow"\n[serve.history]\nbreks = 1\n')
    with pytest.raises(PlantError) as wrong:
        read_settings(plant, {})
    assert [one.partition(": ")[2] for one in wrong.value.mistakes] == [
        "[serve.history]: unknown key 'breks'; did you mean breaks?",
        "[serve.mqtt]: breaks = 'somehow' is no way to break",
        "[serve.mqtt]: nor would another one be",
    ]
