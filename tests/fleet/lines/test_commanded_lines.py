"""A line that is being closed: commands end immediately, and stops are answered until it is closed."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from command_desks import LINE, MAY, PATIENCE_S, Desks

from multidrop.fleet.commands import desk as command_desk
from multidrop.fleet.commands.messages import CommandAnswer, CommandOutcome
from multidrop.fleet.commands.subjects import CommandedLines, CommandSubjects
from multidrop.fleet.servers import names
from multidrop.supervisor import supervisor


class HeardPath:
    """A path without a server, which records the subscribed functions by subject."""

    def __init__(self) -> None:
        self.heard: dict[str, Callable[[Any], Any]] = {}

    async def subscribe(self, subject: str, called: Callable[[Any], Any]) -> None:
        self.heard[subject] = called

    async def unsubscribe(self, subject: str) -> None:
        self.heard.pop(subject, None)

    async def ask(self, subject: str, **what: Any) -> dict[str, Any]:
        """Send a request to a subscribed function, and return the answer."""
        answered: asyncio.Future[bytes] = asyncio.get_running_loop().create_future()

        class Asked:
            data = json.dumps({"id": "one", "by": "anna", **what}).encode()
            reply = "_INBOX.anna.1"

            async def respond(self, data: bytes) -> None:
                answered.set_result(data)

        await self.heard[subject](Asked())
        found: dict[str, Any] = json.loads(await asyncio.wait_for(answered, 60))
        return found


class SlowLines:
    """Lines that are closed only when the test allows it."""

    def __init__(self) -> None:
        self.closes = asyncio.Event()
        self.is_going = False

    async def take(self, line: str, description: Any) -> None:
        """Do nothing."""

    async def let_go(self, line: str) -> None:
        self.is_going = True
        await self.closes.wait()


async def settled(subjects: CommandSubjects) -> None:
    await asyncio.gather(*supervisor().started)


async def test_a_closing_line_answers_its_stops_until_it_is_closed(desk: Desks) -> None:
    path, lines = HeardPath(), SlowLines()
    subjects = CommandSubjects("gw-1", [path], desk.lines, desk.log)  # type: ignore[list-item]
    commanded = CommandedLines(lines, subjects)  # type: ignore[arg-type]
    await commanded.take(LINE, {"may": MAY})
    await settled(subjects)
    offered = desk.offered()
    going = asyncio.create_task(commanded.let_go(LINE))
    await asyncio.sleep(0)
    await settled(subjects)
    assert path.heard.keys() == {names.stop_subject(LINE)}
    assert desk.ask(register="frequency", value=20.0) is None
    assert "was released" in (await desk.do(offered)).text
    while (told := await path.ask(names.stop_subject(LINE), drives=None))["outcome"] == "under way":
        pass
    assert told["outcome"] == "done"
    lines.closes.set()
    await going
    await settled(subjects)
    assert path.heard == {}
    assert await desk.stop() is None
    assert desk.written == {"control"}


async def test_a_stop_is_answered_only_on_an_inbox(desk: Desks) -> None:
    """An answer that is stored as a record of the plant would take the line from all gateways."""
    answered: list[str] = []

    path = HeardPath()
    subjects = CommandSubjects("gw-1", [path], desk.lines, desk.log)  # type: ignore[list-item]
    subjects.open(LINE, {"may": MAY})
    await settled(subjects)
    for number, reply in enumerate(("$KV.plant.line-1", "", "_INBOX_UABC.1")):

        async def respond(data: bytes, reply: str = reply) -> None:
            answered.append(reply)

        data = json.dumps({"id": f"stop {number}", "by": "anna", "drives": None}).encode()
        await path.heard[names.stop_subject(LINE)](
            SimpleNamespace(data=data, subject="", reply=reply, respond=respond)
        )
        await settled(subjects)
        assert "control" in desk.written
    assert answered == ["_INBOX_UABC.1"]


@pytest.mark.parametrize("may_wait", [True, False])
async def test_closing_a_line_waits_for_its_command_if_the_lease_leaves_time(
    desk: Desks, monkeypatch: pytest.MonkeyPatch, may_wait: bool
) -> None:
    """The sender gets the result before the line is closed."""
    begun, go_on = threading.Event(), threading.Event()

    monkeypatch.setattr(command_desk, "AWAITED_S", PATIENCE_S)
    lines = SlowLines()
    lines.closes.set()
    subjects = CommandSubjects("gw-1", [HeardPath()], desk.lines, desk.log)  # type: ignore[list-item]
    subjects.desk = desk.desk
    commanded = CommandedLines(lines, subjects, lambda: may_wait)  # type: ignore[arg-type]
    await commanded.take(LINE, {"may": MAY})
    first, second = desk.offered(20.0), desk.offered(30.0)
    offer = desk.desk.offers.find(first)
    assert offer is not None
    work = offer.prepared.work

    def held_up() -> CommandAnswer:
        begun.set()
        assert go_on.wait(PATIENCE_S)
        return work()

    offer.prepared = offer.prepared._replace(work=held_up)
    doing = asyncio.create_task(desk.do(first))
    await asyncio.to_thread(begun.wait, PATIENCE_S)
    going = asyncio.create_task(commanded.let_go(LINE))
    for _ in range(10):
        await asyncio.sleep(0.002)
    assert lines.is_going is not may_wait
    assert (await desk.do(second)).outcome is CommandOutcome.NOT_SENT
    go_on.set()
    assert (await doing).outcome is CommandOutcome.DONE
    await going
    assert lines.is_going
    assert [raw for name, raw in desk.writes if name == "frequency"] == [2000]


class ClosedLines(SlowLines):
    """Lines whose buses close before their gateway notes that."""

    def __init__(self, close: Callable[[], None]) -> None:
        super().__init__()
        self._close = close
        self.are_closed = asyncio.Event()

    async def let_go(self, line: str) -> None:
        await asyncio.to_thread(self._close)
        self.are_closed.set()
        await super().let_go(line)


@pytest.mark.parametrize("drives", [None, ["pump"]])
async def test_a_stop_on_a_closed_line_is_left_to_the_next_master(
    desk: Desks, drives: list[str] | None
) -> None:
    """The sender would accept a refusal, and ask no other gateway."""

    lines = ClosedLines(desk.bus(LINE).close)
    subjects = CommandSubjects("gw-1", [HeardPath()], desk.lines, desk.log)  # type: ignore[list-item]
    commanded = CommandedLines(lines, subjects)  # type: ignore[arg-type]
    await commanded.take(LINE, {"may": MAY})
    going = asyncio.create_task(commanded.let_go(LINE))
    await lines.are_closed.wait()
    assert await desk.stop(drives=drives) is None
    lines.closes.set()
    await going
    await settled(subjects)
