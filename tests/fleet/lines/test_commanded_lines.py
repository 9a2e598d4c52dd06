"""A line that is being closed accepts no further commands, and answers stops until it is closed."""

from __future__ import annotations

import asyncio
import json
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest
from fleets import LINE, MAY, PATIENCE_S, Desks
from lines import until
from tables import table

from multidrop.control import CommandOutcome
from multidrop.core import UNASKED, Mastership
from multidrop.families import InnovertIBD
from multidrop.fleet.commands import desk as command_desk
from multidrop.fleet.commands.desk import CommandSubjects
from multidrop.fleet.commands.messages import CommandAnswer
from multidrop.fleet.gateway import CommandedLines
from multidrop.fleet.servers import names
from multidrop.plant.loader import load_plant
from multidrop.plant.model import Plant, PlantLine
from multidrop.poller import Poller
from multidrop.polling.batch import Row
from multidrop.sim import SimulatedDrive, Simulator, Wire
from multidrop.sim.memory import MemoryCell
from multidrop.supervisor import supervisor


class HeardPath:
    """A fake server connection, which records the function for each subscribed subject."""

    def __init__(self) -> None:
        self.heard: dict[str, Callable[[Any], Any]] = {}

    async def subscribe(self, subject: str, called: Callable[[Any], Any]) -> None:
        self.heard[subject] = called

    async def unsubscribe(self, subject: str) -> None:
        self.heard.pop(subject, None)

    async def ask(self, subject: str, **what: Any) -> dict[str, Any]:
        """Send a request to the function subscribed to a subject, and return the answer."""
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
        pass

    async def let_go(self, line: str) -> None:
        self.is_going = True
        await self.closes.wait()


async def settled(subjects: CommandSubjects) -> None:
    await asyncio.gather(*supervisor().started)


async def test_gateway_answers_stops_while_a_line_is_closing(desk: Desks) -> None:
    path, lines = HeardPath(), SlowLines()
    subjects = CommandSubjects("gw-1", [path], desk.lines, desk.log)
    commanded = CommandedLines(lines, subjects)
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


async def test_stop_is_answered_only_on_nats_inbox_subjects(desk: Desks) -> None:
    """If a requester names a plant record's subject for the answer, the answer would replace the record."""
    answered: list[str] = []

    path = HeardPath()
    subjects = CommandSubjects("gw-1", [path], desk.lines, desk.log)
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
async def test_closing_a_line_waits_for_the_running_command_if_allowed(
    desk: Desks, monkeypatch: pytest.MonkeyPatch, may_wait: bool
) -> None:
    """The sender must get the command's result before the line is closed."""
    begun, go_on = threading.Event(), threading.Event()

    monkeypatch.setattr(command_desk, "AWAITED_S", PATIENCE_S)
    lines = SlowLines()
    lines.closes.set()
    subjects = CommandSubjects("gw-1", [HeardPath()], desk.lines, desk.log)
    subjects.desk = desk.desk
    commanded = CommandedLines(lines, subjects, lambda: may_wait)
    await commanded.take(LINE, {"may": MAY})
    first, second = desk.offered(20.0), desk.offered(30.0)
    offer = desk.desk.offers.find(first)
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
    """Lines whose buses are closed already, while their gateway still counts them as polled."""

    def __init__(self, close: Callable[[], None]) -> None:
        super().__init__()
        self._close = close
        self.are_closed = asyncio.Event()

    async def let_go(self, line: str) -> None:
        await asyncio.to_thread(self._close)
        self.are_closed.set()
        await super().let_go(line)


@pytest.mark.parametrize("drives", [None, ["pump"]])
async def test_gateway_does_not_answer_a_stop_if_the_bus_is_closed(
    desk: Desks, drives: list[str] | None
) -> None:
    """If this gateway refused the stop, the sender would not try another gateway."""

    lines = ClosedLines(desk.bus.close)
    subjects = CommandSubjects("gw-1", [HeardPath()], desk.lines, desk.log)
    commanded = CommandedLines(lines, subjects)
    await commanded.take(LINE, {"may": MAY})
    going = asyncio.create_task(commanded.let_go(LINE))
    await lines.are_closed.wait()
    assert await desk.stop(drives=drives) is None
    lines.closes.set()
    await going
    await settled(subjects)


# ---- requests in flight while a line is handed over: each request gets its row ----


NUMBERED = "motor_speed"  # this register has no scale, so its value is the raw count


class NumberedDrive(SimulatedDrive):
    """A drive whose register `motor_speed` counts how often it was read."""

    answers = 0

    def refresh(self, cell: MemoryCell) -> None:
        super().refresh(cell)
        if cell.name == NUMBERED:
            self.answers += 1
            cell.raw = self.answers


class Verdict(NamedTuple):
    """Counts of a drive's replies: without a row, with two rows, or later than their request's row."""

    lost: int = 0
    doubled: int = 0
    late: int = 0


def judge_drive(numbers: Sequence[int | None], answered: int) -> Verdict:
    """Compare the numbers that a drive has sent with the numbers in its rows.

    `numbers` is in the order of the requests; None is a row without a value. `answered` is the number of
    replies.
    """
    late = lost = doubled = misses = last = 0
    for number in (*numbers, answered + 1):  # the appended number reveals rows that are missing at the end
        if number is None:
            misses += 1
        elif number <= last:
            doubled += 1
        else:
            explained = min(number - last - 1, misses)
            late += explained
            lost += number - last - 1 - explained
            last, misses = number, 0
    return Verdict(lost, doubled, late)


if sys.platform != "linux":
    pytest.skip("masterships are Linux's", allow_module_level=True)

SECOND = 1_000_000_000
HOUR_NS = 3600 * SECOND


@contextmanager
def simulated_line(folder: Path, delay: float) -> Iterator[tuple[list[NumberedDrive], PlantLine]]:
    """Yield two drives that answer after `delay` seconds, and their line."""
    drives = [
        NumberedDrive(InnovertIBD(address=at, name=f"drive-{at}"), response_delay=delay) for at in (1, 2)
    ]
    with Simulator([Wire(drives, name="line", port="tcp://127.0.0.1:0")]) as simulator:
        path = folder / "plant.toml"
        path.write_text(
            f'[[line]]\nname = "line"\nport = "{simulator.wires[0].path}"\n'
            + "".join(
                f'[[line.drive]]\nname = "drive-{at}"\nmodel = "{InnovertIBD.model}"\naddress = {at}\n'
                f'poll = ["{NUMBERED}"]\nevery = "100 ms"\n'
                for at in (1, 2)
            )
        )
        yield drives, load_plant(path).lines[0]


class Gateway:
    """A gateway's poller, and its rows of requests that were really sent."""

    def __init__(self, folder: Path) -> None:
        self.mastership = Mastership(guard_s=0.01)
        self.mastership.extend(time.clock_gettime_ns(time.CLOCK_BOOTTIME) + HOUR_NS)
        self.rows: list[Row] = []
        self.poller = Poller(Plant((), folder), mastership=self.mastership)
        self.poller.on_batch(lambda batch: self.rows.extend(row for row in batch if is_asked(row)))

    def close(self) -> None:
        self.poller.close()
        self.mastership.end()


def is_asked(row: Row) -> bool:
    return not row.status.startswith(UNASKED)


@pytest.fixture
def gateways(tmp_path: Path) -> Iterator[list[Gateway]]:
    made = [Gateway(tmp_path) for _ in range(2)]
    for gateway in made:
        gateway.poller.__enter__()
    yield made
    for gateway in made:
        gateway.close()


def hand_over(gateway: Gateway, drives: list[NumberedDrive], line: PlantLine) -> None:
    """Poll until a drive has received a request, and close the line before the drive answers."""
    gateway.poller.add_line(line)
    begun = sum(drive.answers for drive in drives)
    until(lambda: sum(drive.answers for drive in drives) > begun)
    gateway.poller.remove_line("line")


def judge(drives: list[NumberedDrive], gateways: list[Gateway]) -> list[Verdict]:
    for gateway in gateways:
        gateway.close()
    rows = sorted((row for gateway in gateways for row in gateway.rows), key=lambda row: row.time_ns)
    numbers: dict[str, list[int | None]] = {drive.drive.name: [] for drive in drives}
    for row in rows:
        numbers[row.drive].append(None if row.value is None else round(row.value))
    return [judge_drive(numbers[drive.drive.name], drive.answers) for drive in drives]


@pytest.mark.slow
def test_no_row_is_lost_when_a_line_moves_between_gateways(tmp_path: Path, gateways: list[Gateway]) -> None:
    with simulated_line(tmp_path, delay=0.1) as (drives, line):
        for turn in range(8):
            hand_over(gateways[turn % 2], drives, line)
        judged = judge(drives, gateways)
    assert sum(drive.answers for drive in drives) >= 8
    assert [(one.lost, one.doubled) for one in judged] == [(0, 0), (0, 0)]


def test_unanswered_request_has_status_poll_ended_after_polling_ends(
    tmp_path: Path, gateways: list[Gateway], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("multidrop.polling.line_set.ENDING_NS", 0)
    with simulated_line(tmp_path, delay=1.0) as (drives, line):
        hand_over(gateways[0], drives, line)
        hand_over(gateways[1], drives, line)
        judged = judge(drives, gateways)
    assert [(one.lost, one.doubled) for one in judged] == [(0, 0), (0, 0)]
    assert {row.status for gateway in gateways for row in gateway.rows} == {"poll ended"}


@table(
    ("numbers", "answered", "expected"),
    [
        ((1, 2, 3), 3, Verdict()),
        ((), 0, Verdict()),
        ((1, None, 3), 3, Verdict(late=1)),
        ((1, None, 2), 2, Verdict()),
        ((1, 3), 3, Verdict(lost=1)),
        ((1, None, 4), 4, Verdict(late=1, lost=1)),
        ((1, 2), 3, Verdict(lost=1)),
        ((1, 2, 2, 3), 3, Verdict(doubled=1)),
    ],
)
def test_lost_late_and_doubled_replies_are_counted(
    numbers: Sequence[int | None], answered: int, expected: Verdict
) -> None:
    assert judge_drive(numbers, answered) == expected


@pytest.mark.long
def test_a_late_reply_has_a_row_marked_as_late(tmp_path: Path, gateways: list[Gateway]) -> None:
    with simulated_line(tmp_path, delay=0.02) as (drives, line):
        gateways[0].poller.add_line(line)
        for delay in (0.02, 0.45, 0.02, 0.9, 0.02):
            drives[0].response_delay = delay
            begun = drives[0].answers
            until(lambda begun=begun: drives[0].answers >= begun + 3)
        judged = judge(drives, gateways)
    assert [(one.lost, one.doubled) for one in judged] == [(0, 0), (0, 0)]
    assert judged[0].late > 0
