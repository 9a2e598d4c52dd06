"""A command has the number of the newest message to its page. So delayed or repeated commands are refused."""

from __future__ import annotations

import json
import re
import socket
import subprocess
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from http.client import HTTPResponse
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from gateways import Served, served
from lines import PATIENCE, until
from peers import require_program
from tables import table

from multidrop import Drive, WriteForbidden
from multidrop.control import CommandResult
from multidrop.core import boottime_ns
from multidrop.gateway import commands as commands_module
from multidrop.gateway.http.rights import Right
from multidrop.gateway.live.frames import ANOTHER_PLANT, DOUBLED, MOST_AGE_NS, TOO_LATE, SeenFrames

MAY = """[serve.may]
stop = "anyone"
write = ["pump-1.setpoint"]
verbs = ["pump-1.start", "pump-1.jog", "pump-1.reset_fault", "pump-1.set_frequency", "pump-1.coast"]
"""
START = {"drive": "pump-1", "verb": "start", "options": {}}
WRITE = {"drive": "pump-1", "register": "setpoint", "value": 50.0}


class Times:
    """A SeenFrames with a clock and with times of the drives' last stops, which the test sets."""

    def __init__(self) -> None:
        self.now_ns = 10**12
        self.stopped: dict[str, int] = {}
        self.commands: Any = SimpleNamespace(stopped_ns=self.stopped.get, plant_ns=None)
        self.frames = SeenFrames(lambda: self.now_ns, self.commands)

    def rule(self, seen: int, drive: str = "pump-1", command: object = "start") -> str:
        """Return the rule by which a command is refused, or "" if it may be sent."""
        try:
            self.frames.admit(drive, f"{drive}.{command}", command, seen)
        except WriteForbidden as refused:
            return str(refused.rule)
        return ""


@pytest.fixture
def times() -> Times:
    return Times()


def test_a_command_is_refused_if_its_sender_saw_only_old_values(times: Times) -> None:
    times.frames.note(7)
    made_ns = times.now_ns
    times.now_ns += MOST_AGE_NS
    assert times.frames.admit("pump-1", "start", "start", 7) == made_ns + MOST_AGE_NS
    times.now_ns += 1
    assert times.rule(7, command="jog") == TOO_LATE


def test_a_command_is_refused_if_its_message_number_was_never_sent(times: Times) -> None:
    """Each message to the web page has a number. A command states the number of the newest seen message."""
    times.frames.note(7)
    assert [times.rule(seen) for seen in (8, 6, -1, 0)] == [TOO_LATE] * 4


def test_a_stop_of_one_drive_invalidates_only_its_earlier_commands(times: Times) -> None:
    times.frames.note(7)
    times.stopped["pump-1"] = times.now_ns  # the same time as the frame, so the stop may have been later
    assert times.rule(7) == commands_module.OVERTAKEN
    assert times.rule(7, "pump-2") == ""
    times.now_ns += 1
    times.frames.note(8)
    assert times.rule(8) == ""


def test_a_command_is_refused_if_its_sender_saw_no_values_since_a_reload(times: Times) -> None:
    times.frames.note(7)
    times.commands.plant_ns = times.now_ns
    assert times.rule(7) == times.rule(7, "pump-2") == ANOTHER_PLANT
    times.now_ns += 1
    times.frames.note(8)
    assert times.rule(8) == ""
    assert times.rule(7) == ANOTHER_PLANT


def test_a_command_is_refused_if_repeated_with_the_same_message_number(times: Times) -> None:
    """A command states the number of the newest message that its sender saw, here 7 or 8."""
    times.frames.note(7)
    assert [times.rule(7, command=one) for one in ("start", "jog", "start")] == ["", "", DOUBLED]
    times.frames.note(8)
    assert times.rule(8) == ""


def test_the_numbers_of_old_messages_are_forgotten(times: Times) -> None:
    for n in range(1000):
        times.now_ns += 200_000_000
        times.frames.note(n)
        times.rule(n)
    assert len(times.frames._made) == len(times.frames._came) == 26


@pytest.fixture(scope="module")
def gateway(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with served(tmp_path_factory.mktemp("frames"), MAY) as found:
        yield found


@contextmanager
def held_up(gateway: Served, path: str, body: object) -> Iterator[socket.socket]:
    """Send a request without its last byte; `answer` sends that byte."""
    data = json.dumps(body).encode()
    head = (
        f"POST {path} HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\n"
        f"authorization: {gateway.bearer(Right.WRITE)}\r\ncontent-length: {len(data)}\r\n\r\n"
    )
    with socket.create_connection(("127.0.0.1", gateway.gateway.port), PATIENCE) as client:
        client.sendall(head.encode() + data[:-1])
        yield client


def answer(client: socket.socket, last: bytes = b"}") -> str:
    """Send the last byte of a held request, and return the gateway's answer."""
    client.sendall(last)
    with closing(HTTPResponse(client)) as response:  # the answer is chunked if a stop takes longer than usual
        response.begin()
        assert response.status == 200
        told = json.loads(response.read())
    return str(told.get("text") or told["pump-1"]["text"])


def pass_time(gateway: Served, ns: int) -> None:
    """Advance the clocks that the gateway uses for messages to the page and for commands."""
    gateway.gateway.seen_frames.clock = lambda: boottime_ns() + ns


def commands(gateway: Served) -> list[tuple[str, float]]:
    """Return the writes that the drive has received so far."""
    return [(write.name, write.raw) for write in gateway.sims["pump-1"].counters.writes]


@pytest.mark.parametrize(("path", "body"), [("/api/act", START), ("/api/write", WRITE)])
def test_a_delayed_command_is_not_sent(tmp_path: Path, path: str, body: dict[str, object]) -> None:
    with served(tmp_path, MAY) as gateway:
        seen = gateway.frame_number()
        with held_up(gateway, path, {**body, "seen": seen}) as client:
            pass_time(gateway, MOST_AGE_NS)
            told = answer(client)
        assert told.endswith(
            f"the values seen (frame {seen}) are not from the last 5 s. "
            "Check the drive's values and confirm again"
        )
        assert told.startswith("pump-1.")
        assert commands(gateway) == []


def test_a_stop_is_sent_after_any_network_delay(tmp_path: Path) -> None:
    with served(tmp_path, MAY) as gateway:
        gateway.start("pump-1")
        with held_up(gateway, "/api/stop", {"drives": None}) as client:
            pass_time(gateway, 10 * MOST_AGE_NS)
            assert "seen to stand" in answer(client)
        assert gateway.stands("pump-1")


def test_a_start_is_not_sent_if_its_sender_saw_no_values_since_a_stop(tmp_path: Path) -> None:
    """A proxy that repeats or delays a start must not start a motor after a stop."""
    with served(tmp_path, MAY) as gateway:
        writer = gateway.writer
        seen = gateway.frame_number()
        start = {**START, "seen": seen}
        assert gateway.post("/api/write", {**WRITE, "seen": seen}, **writer).json["done"] is True
        assert gateway.post("/api/act", start, **writer).json["done"] is True
        doubled = gateway.post("/api/act", start, **writer).json["text"]
        assert "it repeats an earlier request" in doubled
        assert gateway.post("/api/stop", {"drives": ["pump-1"]}).json["pump-1"]["done"] is True
        sent = commands(gateway)
        overtaken = gateway.post("/api/act", start, **writer).json["text"]
        assert overtaken == (
            f"pump-1.start was not sent: a stop was called after the values seen (frame {seen}). "
            "Check the drive's values and confirm again"
        )
        assert commands(gateway) == sent
        assert gateway.act("pump-1", "start")["done"] is True


def test_a_command_is_not_sent_if_its_thread_starts_too_late(tmp_path: Path) -> None:
    begun: list[threading.Thread] = []

    class Late(threading.Thread):
        def start(self) -> None:
            begun.append(self)

    with served(tmp_path, MAY) as gateway:
        gateway.gateway.seen_frames.clock = lambda: boottime_ns() - MOST_AGE_NS + 50_000_000
        start = {**START, "seen": gateway.frame_number()}
        gateway.gateway.seen_frames.clock = lambda: 0  # so that the request itself is not refused as too old
        with pytest.MonkeyPatch.context() as patch, held_up(gateway, "/api/act", start) as client:
            patch.setattr("multidrop.supervisor.threading", SimpleNamespace(Thread=Late))
            client.sendall(b"}")
            until(lambda: begun)
            due_ns = boottime_ns() + 50_000_000
            until(lambda: boottime_ns() > due_ns)
            threading.Thread.start(begun[0])
            assert "start was not sent: its turn did not come" in answer(client, b"")
        assert commands(gateway) == []


def test_a_start_is_not_sent_if_a_stop_was_called_just_before(
    gateway: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    act, before = commands_module.carry_out_verb, commands(gateway)

    def act_after_a_stop(drive: Drive, **given: Any) -> CommandResult:
        gateway.gateway.commands._note_stop([drive.name])
        return act(drive, **given)

    monkeypatch.setattr(commands_module, "carry_out_verb", act_after_a_stop)
    told = gateway.act("pump-1", "start")
    assert (told["done"], "start was not sent" in told["text"]) == (False, True)
    assert commands(gateway) == before


@pytest.mark.slow
def test_a_command_is_refused_if_its_message_number_is_from_before_a_restart(tmp_path: Path) -> None:
    with served(tmp_path, MAY) as gateway:
        seen = gateway.frame_number()
    with served(tmp_path, MAY) as gateway:
        assert gateway.frame_number() != seen
        body = {**START, "seen": seen}
        told = gateway.post("/api/act", body, **gateway.writer).json
        assert (told["done"], "are not from the last 5 s" in told["text"]) == (False, True)
        assert commands(gateway) == []


@table("wrong", [{}, {"seen": None}, {"seen": "7"}, {"seen": True}, {"seen": 1.5}, {"seen": 10**300}])
def test_a_command_is_refused_without_the_number_of_the_last_seen_message(
    gateway: Served, wrong: dict[str, Any]
) -> None:
    before, called = commands(gateway), gateway.gateway.commands.called
    verbs = {"start": {}, "jog": {}, "reset_fault": {}, "set_frequency": {"hz": 20.0}}
    acts = [{"drive": "pump-1", "verb": verb, "options": options} for verb, options in verbs.items()]
    for path, body in (("/api/write", WRITE), *(("/api/act", act) for act in acts)):
        found = gateway.post(path, {**body, **wrong}, **gateway.writer)
        assert (found.status, found.json["error"].partition(" or")[0]) == (400, "key 'seen' is missing")
    assert (commands(gateway), gateway.gateway.commands.called) == (before, called)


def test_a_stop_is_accepted_without_the_number_of_the_last_seen_message(gateway: Served) -> None:
    for verb in ("stop", "coast"):
        told = gateway.post("/api/act", {"drive": "pump-1", "verb": verb, "options": {}}).json
        assert told["done"] is True


@pytest.mark.slow
def test_the_start_command_in_the_documentation_works_from_a_shell(tmp_path: Path) -> None:
    for program in ("curl", "jq"):
        require_program(program)
    page = (Path(__file__).parents[3] / "docs/gateway/serve.md").read_text("utf-8")
    block = next(text for text in re.findall(r"```sh\n(.*?)```", page, re.DOTALL) if "jq" in text)
    with served(tmp_path, MAY) as gateway:
        assert gateway.write("pump-1", "setpoint", 50.0)["done"]
        login = f"authorization: {gateway.bearer(Right.WRITE)}\ncontent-type: application/json\n"
        (tmp_path / "login").write_text(login)
        script = block.replace("localhost:8750", f"localhost:{gateway.gateway.port}")
        ran = subprocess.run(["sh", "-c", script], cwd=tmp_path, stdout=subprocess.PIPE, check=True)
        assert json.loads(ran.stdout)["text"] == "pump-1: start is done"


def test_the_web_page_gets_the_number_of_stops_of_each_drive(gateway: Served) -> None:
    def stops() -> list[int]:
        return [gateway.frame()["drives"][name]["stops"] for name in ("pump-1", "pump-2")]

    first, second = stops()
    gateway.post("/api/stop", {"drives": ["pump-1"]})
    until(lambda: stops() == [first + 1, second])
    gateway.post("/api/stop")
    until(lambda: stops() == [first + 2, second + 1])
