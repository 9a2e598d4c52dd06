"""Command and stop desks: the line's master sends each command once and in time, or not at all."""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from math import inf
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
from commands import BoundProcess
from fleets import LINE, PATIENCE_S, Desks, desks
from lines import PATIENCE, patient
from tables import every_third, table

from multidrop import InvtCHE, Stopped
from multidrop.control import CommandOutcome, Seen, read_audit, records
from multidrop.control.commands import (
    MOST_STOPS,
    RepeatedStops,
    Results,
    begin_stops,
    stop_drive,
    stop_line,
)
from multidrop.fleet.commands import desk as desk_module
from multidrop.fleet.commands import log as log_module
from multidrop.fleet.commands.desk import MOST_WRITES
from multidrop.fleet.commands.log import CommandLog
from multidrop.fleet.commands.messages import (
    CommandAnswer,
    CommandRequest,
    Offered,
    StopRequest,
    read_answer,
    read_offer,
)
from multidrop.fleet.commands.offers import prepare

DONE, REFUSED, NOT_SENT, UNKNOWN = (
    CommandOutcome.DONE,
    CommandOutcome.REFUSED,
    CommandOutcome.NOT_SENT,
    CommandOutcome.UNKNOWN,
)
SETPOINT = "frequency"


def setpoints(desk: Desks) -> list[int]:
    return [raw for name, raw in desk.writes if name == SETPOINT]


async def test_a_command_is_logged_before_and_after_it_is_carried_out(desk: Desks, tmp_path: Path) -> None:
    token = desk.offered(20.0)
    assert desk.writes == []
    answer = await desk.do(token)
    assert answer.outcome is DONE
    assert answer.held == "20.00 Hz"
    assert setpoints(desk) == [2000]
    begun, over = desk.notes
    assert (begun["step"], begun["by"], begun["what"]) == ("begun", "anna", "pump: frequency = 20.00 Hz")
    assert (over["step"], over["outcome"], over["id"]) == ("over", "done", begun["id"])
    [frame] = read_audit(tmp_path / "audit.jsonl")
    assert (frame["by"], frame["way"]) == ("anna", "fleet")


async def test_command_is_sent_once_if_confirmed_several_times(desk: Desks) -> None:
    token = desk.offered()
    answers = await asyncio.gather(*(desk.do(token) for _ in range(5)))
    desk.clock.pass_s(100)
    answers.append(await desk.do(token))
    assert {(answer.outcome, answer.text) for answer in answers} == {(DONE, answers[0].text)}
    assert setpoints(desk) == [2000]


def test_copies_of_a_command_request_get_the_same_token(desk: Desks) -> None:
    same = {"id": "one", "register": SETPOINT, "value": 20.0}
    assert desk.offered(**same) == desk.offered(**same)
    assert desk.offered(**same) != desk.offered(**(same | {"id": "two"}))


@pytest.mark.parametrize(("late_s", "outcome"), [(0.5, DONE), (1.0, NOT_SENT), (60.0, NOT_SENT)])
async def test_a_late_confirmation_sends_nothing(desk: Desks, late_s: float, outcome: CommandOutcome) -> None:
    token = desk.offered()
    desk.clock.pass_s(late_s)
    answer = await desk.do(token)
    assert answer.outcome is outcome
    assert len(setpoints(desk)) == (outcome is DONE)
    assert ("the command was checked " in answer.text) == (outcome is NOT_SENT)


async def do_after(desk: Desks, deed: Callable[[], object], waited_s: float = 0.0) -> CommandAnswer:
    """Confirm an offer after `waited_s`. The command's thread calls `deed` before it sends the command."""
    token = desk.offered()
    offer = desk.desk.offers.find(token)
    work = offer.prepared.work

    def late() -> CommandAnswer:
        deed()
        return work()

    offer.prepared = offer.prepared._replace(work=late)
    desk.clock.pass_s(waited_s)
    return await desk.do(token)


@patient
async def test_command_is_not_sent_if_a_slow_thread_exceeds_one_second(tmp_path: Path) -> None:
    """A command must be sent within a second of its offer. The bus waits only for the rest of this second."""
    with desks(tmp_path, patience_s=0) as desk:
        answer = await do_after(desk, lambda: time.sleep(0.2), waited_s=0.95)
        assert answer.outcome is NOT_SENT
        assert "did not come within" in answer.text
        assert desk.writes == []


async def test_stop_cancels_a_confirmed_but_unsent_command(desk: Desks) -> None:
    """Right before it sends a command, the bus checks again whether a stop has cancelled the offer."""
    answer = await do_after(desk, lambda: desk.desk.offers.void(LINE, ["pump"], "a stop was called"))
    assert answer.outcome is NOT_SENT
    assert desk.writes == []


@patient
def test_a_command_is_on_the_disk_before_it_is_sent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with desks(tmp_path) as desk:
        # at each sync: number of lines in the log, and of writes to the drive
        synced: list[tuple[int, int]] = []

        def sync(file: int) -> None:
            os.fsync(file)
            synced.append((len(desk.notes), len(desk.writes)))

        monkeypatch.setattr(records, "_sync", sync)
        assert asyncio.run(desk.do(desk.offered())).ok
        assert synced == [(1, 0), (2, 1)]


async def while_noted(desk: Desks, deed: Callable[[], object]) -> CommandAnswer:
    """Call `deed` while the first record of a command is logged, right before the command is sent."""

    def before(record: dict[str, Any]) -> None:
        if record["step"] == "begun":
            deed()

    token = desk.offered()
    desk.log.before = before
    return await desk.do(token)


def let_go_and_take(desk: Desks) -> None:
    desk.lines.shut(LINE)
    desk.take()


MEANWHILE: dict[str, Callable[[Desks], object]] = {
    "a second passes": lambda desk: desk.clock.pass_s(1.0),
    "another is master": lambda desk: setattr(desk, "is_master", False),
    "the line is let go": lambda desk: desk.lines.shut(LINE),
    "it is taken again": let_go_and_take,
    "a stop is called": lambda desk: desk.desk.offers.void(LINE, ["pump"], "a stop was called"),
}


@pytest.mark.parametrize("deed", MEANWHILE)
@pytest.mark.parametrize("is_late", [False, True])
async def test_cancelled_command_is_not_sent(desk: Desks, deed: str, is_late: bool) -> None:
    """The command is cancelled before its sender confirms it, or between the confirmation and the write."""
    if is_late:
        answer = await while_noted(desk, lambda: MEANWHILE[deed](desk))
    else:
        token = desk.offered()
        MEANWHILE[deed](desk)
        answer = await desk.do(token)
    assert answer.outcome is NOT_SENT
    assert desk.writes == []


async def test_a_stop_of_another_drive_does_not_cancel_a_command(desk: Desks) -> None:
    token = desk.offered()
    desk.desk.offers.void(LINE, ["fan"], "a stop was called")
    desk.desk.offers.void("hall-2", None, "a stop was called")
    assert (await desk.do(token)).outcome is DONE


async def test_a_restarted_gateway_rejects_confirmations_of_earlier_commands(
    desk: Desks, tmp_path: Path
) -> None:
    token = desk.offered()
    with desks(tmp_path) as after:
        assert (await after.do(token)).outcome is UNKNOWN
        assert after.writes == []
    assert (await desk.do(f"{token}x")).outcome is UNKNOWN
    assert desk.writes == []


async def test_only_the_master_answers_a_command_or_a_stop(desk: Desks) -> None:
    """A gateway that does not poll the line must stay silent, because the sender uses the first answer."""
    desk.is_master = False
    assert desk.ask(register=SETPOINT, value=20.0) is None
    assert await desk.stop() is None
    desk.is_master = True
    assert isinstance(desk.ask(register=SETPOINT, value=20.0), Offered)


async def test_a_new_master_accepts_stops_but_no_commands_during_the_guard_time(desk: Desks) -> None:
    """During the guard time, frames of the line's previous master may still be on the line."""
    desk.is_guarded = True
    assert desk.ask(register=SETPOINT, value=20.0) is None
    assert (await desk.stop()).outcome is DONE
    assert desk.written == {"control"}


async def test_an_unconfirmed_command_is_cancelled_when_its_result_is_requested(desk: Desks) -> None:
    token = desk.offered()
    assert (await desk.desk.do(json.dumps({"ask": token}).encode())).outcome is NOT_SENT
    assert (await desk.do(token)).outcome is NOT_SENT
    assert desk.writes == []


@patient
async def test_only_stops_are_carried_out_without_a_permission_list(tmp_path: Path) -> None:
    with desks(tmp_path, {}) as desk:
        for what in ({"register": SETPOINT, "value": 20.0}, {"verb": "start"}, {"verb": "emergency_stop"}):
            answer = desk.ask(**what)
            assert isinstance(answer, CommandAnswer)
            assert answer.outcome is REFUSED
            assert "the plant file does not allow " in answer.text
        assert desk.writes == []
        assert (await desk.stop()).outcome is DONE
        assert desk.written == {"control"}


@patient
@table("may", ["all", [], {"write": "pump.frequency"}, {"write": [["pump.frequency"]]}])
def test_a_damaged_permission_list_allows_nothing(tmp_path: Path, may: Any) -> None:
    with desks(tmp_path, may) as desk:
        answer = desk.ask(register=SETPOINT, value=20.0)
        assert isinstance(answer, CommandAnswer)
        assert answer.outcome is REFUSED


@pytest.mark.slow
async def test_a_start_command_runs_the_motor_and_a_stop_stops_it(desk: Desks) -> None:
    assert (await desk.do(desk.offered(20.0))).outcome is DONE
    assert (await desk.do(desk.offered(verb="start", options={"direction": "forward"}))).outcome is DONE
    assert (await desk.stop(drives=None)).outcome is DONE
    assert {"begun", "over"} == {note["step"] for note in desk.notes if note["what"] == "stop"}


@pytest.mark.slow
async def test_a_long_stop_reports_its_progress(desk: Desks) -> None:
    """The sender must know early that the stop was sent: a motor may take long to stop."""
    desk.sim["output_frequency"] = 10.0
    data = json.dumps({"id": "one", "by": "anna", "drives": None}).encode()
    sentence = "pump: the stop was confirmed, but the motor is not yet seen to stand"
    async with asyncio.timeout(PATIENCE_S):
        while (answer := await desk.stops.stop(LINE, data)).outcome is CommandOutcome.UNDER_WAY:
            if answer.text.startswith(sentence):
                assert answer.drives["pump"].outcome is CommandOutcome.UNDER_WAY
                assert desk.written == {"control"}
                desk.sim["output_frequency"] = 0.0
    assert answer.outcome is DONE


LOSSES: dict[str, Callable[[Desks], object]] = {
    "the lease": lambda desk: setattr(desk, "is_master", False),
    "the line": lambda desk: desk.lines.shut(LINE),
}


@pytest.mark.parametrize("loss", LOSSES)
def test_gateway_does_not_answer_a_stop_after_losing_the_line(
    desk: Desks, monkeypatch: pytest.MonkeyPatch, loss: str
) -> None:
    """The line's next master gets a copy of the stop, and answers it."""

    def lost(seconds: float | None) -> dict[str, Stopped]:
        LOSSES[loss](desk)
        return {"pump": Stopped("pump", Seen.FAILED, 0.1, "not the master")}

    same = {"id": "one", "drives": None}
    with monkeypatch.context() as patched:
        patched.setattr(desk.bus, "stop_all", lost)
        assert asyncio.run(desk.stop(**same)) is None
    desk.is_master = True
    desk.take()
    assert asyncio.run(desk.stop(**same)).outcome is DONE
    assert desk.written == {"control"}


async def test_copies_of_a_stop_cause_one_stop_and_cancel_waiting_commands(desk: Desks) -> None:
    token = desk.offered()
    copies = await asyncio.gather(*(desk.stop(id="one") for _ in range(3)))
    assert len({copy.text for copy in copies if copy}) == 1
    answer = await desk.do(token)
    assert answer.outcome is NOT_SENT
    assert "a stop was called" in answer.text
    assert len([name for name, _ in desk.writes if name == "control"]) == 1
    assert setpoints(desk) == []


@pytest.mark.parametrize(
    ("failure", "why"),
    [
        (OSError(28, "No space left on device"), "[Errno 28] No space left on device"),
        (SystemExit("killed"), "commands.jsonl: SystemExit: killed"),  # in the log's thread
    ],
)
async def test_a_failed_log_blocks_commands_but_not_stops(
    desk: Desks, failure: BaseException, why: str
) -> None:
    token = desk.offered()
    with patch.object(CommandLog, "_add", side_effect=failure):
        answer = await desk.do(token)
        assert answer.outcome is NOT_SENT
        assert "the log of commands cannot be written" in answer.text
        assert answer.text.endswith(why)
        assert desk.writes == []
        assert (await desk.stop()).outcome is DONE
        assert desk.written == {"control"}


@pytest.mark.slow
async def test_concurrent_writes_on_a_line_are_limited(desk: Desks) -> None:
    tokens = [desk.offered(20.0 + number) for number in range(MOST_WRITES + 3)]
    answers = await asyncio.gather(*(desk.do(token) for token in tokens))
    unsent = [answer.text for answer in answers if answer.outcome is NOT_SENT]
    assert sum(f"{MOST_WRITES} other commands are under way" in text for text in unsent) == 3
    assert len(setpoints(desk)) == len(answers) - len(unsent)


HOSTILE = [
    b"",
    b"\xff\xfe",
    b"null",
    b"[]",
    b"[" * 100_000,
    b'{"id": "a"}',
    b'{"a": 1e999}',
    b"x" * 70_000,
    *(
        json.dumps(
            {"id": "a", "by": "b", "drive": "pump", "register": SETPOINT, "value": 1.0} | wrong
        ).encode()
        for wrong in (
            {"id": 7},
            {"id": ""},
            {"id": "a" * 201},
            {"by": "\x1b[31m"},
            {"by": None},
            {"by": " "},
            {"drive": ["pump"]},
            {"drive": "pump.frequency"},
            {"drive": "PUMP"},
            {"register": {}},
            {"register": "control", "value": 1},
            {"register": "__class__"},
            {"value": True},
            {"value": None},
            {"value": float("nan")},
            {"value": float("inf")},
            {"value": 10**400},
            {"value": "ten"},
            {"value": -1},
            {"value": 1e9},
            {"verb": "start"},
            {"register": "", "verb": "stop"},
            {"register": "", "verb": "__init__"},
            {"register": "", "verb": "set_frequency", "options": {"hz": 20}},
            {"register": "", "verb": "start", "options": {"direction": "up"}},
            {"register": "", "verb": "start", "options": {"direction": []}},
            {"register": "", "verb": "start", "options": {"seconds": 1}},
            {"register": "", "verb": "start", "options": [1]},
        )
    ),
]


@table("data", HOSTILE, ids=range(len(HOSTILE)))
def test_invalid_commands_are_each_refused_in_one_sentence(desk: Desks, data: bytes) -> None:
    answer = desk.desk.offer(LINE, data)
    assert isinstance(answer, CommandAnswer)
    assert answer.outcome is REFUSED
    assert answer.text.isprintable()
    told = asyncio.run(desk.desk.do(data))
    assert told.outcome in (REFUSED, UNKNOWN)
    assert desk.writes == []


ODD_STOPS = [  # stop messages that any client may send, or that a network may damage
    b"",
    b"\xff\xfe",
    b"null",
    b"[" * 100_000,
    b"x" * 70_000,
    b"{}",
    *(
        json.dumps({"id": "a", "by": "b", "drives": ["pump"]} | odd).encode()
        for odd in (
            {"id": 7},
            {"id": ""},
            {"id": None},
            {"id": "a" * 201},
            {"id": "\x1b[31m"},
            {"id": ["a"]},
            {"by": "\x1b[31m\nnobody"},
            {"by": "\ud800"},
            {"by": None},
            {"by": " "},
            {"by": 10**400},
            {"by": "b" * 201},
            {"by": {}},
            {"drives": []},
            {"drives": "pump"},
            {"drives": {"pump": 1}},
            {"drives": [7]},
            {"drives": ["pump"] * 1001},
            {"drives": 0},
            {"drives": ["pump", "\ud800", "\x1b[31m"]},
            {"seconds": -1, "more": [1]},
        )
    ),
]


@pytest.mark.parametrize("data", every_third(ODD_STOPS))
async def test_a_malformed_stop_is_carried_out(
    desk: Desks,
    data: bytes,
    caplog: pytest.LogCaptureFixture,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The name of its sender is logged as printable text. Without drives, it stops all drives of the line."""
    # the test must not repeat a stop that has no id, because each repetition would be a new stop
    monkeypatch.setattr(desk_module, "HOLD_S", PATIENCE_S)
    answer = await desk.stop_by(data)
    assert answer.drives["pump"].outcome is DONE
    assert desk.written == {"control"}
    assert all(record.getMessage().isprintable() for record in caplog.records)
    begun, over = desk.notes
    assert (begun["step"], over["step"]) == ("begun", "over")
    assert begun["by"]
    assert "".join((begun["by"], begun["id"], *begun["drives"])).isprintable()
    assert {frame["by"] for frame in read_audit(tmp_path / "audit.jsonl")} == {begun["by"]}


@pytest.mark.slow
@table(
    ("first", "then"),
    [
        ({"id": "\x1b"}, {"id": r"\x1b"}),
        ({"id": "a" * 201}, {"id": "a" * 202}),
        ({}, {}),
        ({"id": "one", "drives": ["fan"]}, {"id": "one", "drives": ["pump"]}),
    ],
)
def test_a_stop_with_a_new_id_is_a_new_stop(desk: Desks, first: dict[str, Any], then: dict[str, Any]) -> None:
    asyncio.run(desk.stop_by(json.dumps(first).encode()))
    before = len(desk.writes)
    asyncio.run(desk.stop_by(json.dumps(then).encode()))
    assert len(desk.writes) == before + 1


async def test_known_drives_stop_even_if_the_stop_names_an_unknown_drive(desk: Desks) -> None:
    answer = await desk.stop(drives=["pump", "fan"])
    assert answer.outcome is REFUSED
    assert {name: one.outcome for name, one in answer.drives.items()} == {"pump": DONE, "fan": REFUSED}


@patient
async def test_only_stops_accept_another_unicode_form_of_a_drives_name(tmp_path: Path) -> None:
    """Keyboards differ: a u with two dots is one character (U+00FC) or two (U+0075 U+0308)."""
    fan, spelt = "L\u00fcfter", "Lu\u0308fter"
    with desks(tmp_path, {"write": [f"{spelt}.frequency"]}, name=fan) as desk:
        told = desk.ask(drive=spelt, register="frequency", value=20.0)
        assert isinstance(told, CommandAnswer)
        assert told.outcome is REFUSED
        answer = await desk.stop(drives=[spelt, fan])
        assert {name: one.outcome for name, one in answer.drives.items()} == {fan: DONE}
        assert desk.writes == [("control", 0xC000)]


@table("data", [b"", b"[]", b'{"outcome": "maybe", "text": ""}', b'{"outcome": "done"}'])
def test_invalid_answer_to_a_command_raises_value_error(data: bytes) -> None:
    with pytest.raises(ValueError, match=r"is not|must be"):
        read_answer(data) if data.startswith((b"{", b"[")) else read_offer(data)


def test_command_is_not_sent_to_a_drive_without_a_line() -> None:
    drive = InvtCHE(1, name="mill", maximum_frequency=50)
    for request in (
        CommandRequest("1", "anna", "mill", register="setpoint", value=10.0),
        CommandRequest("2", "anna", "mill", verb="start"),
    ):
        answer = prepare(drive, request).work()
        assert answer.outcome is CommandOutcome.NOT_SENT
        assert answer.text.startswith("mill is ")


def test_checking_a_command_does_not_change_the_stored_setpoint() -> None:
    """A checked command may never be sent. A changed setpoint would affect the next start."""
    drive = InvtCHE(1, name="mill", maximum_frequency=50)
    drive.commanded = 40.0
    prepare(drive, CommandRequest("1", "anna", "mill", verb="set_frequency", options={"hz": 10.0}))
    assert drive.commanded == 40.0


@pytest.mark.long
async def test_stop_cancels_waiting_commands_even_beyond_the_limit_of_stops(
    desk: Desks, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, silent = list[str](), asyncio.Event()

    async def stop(held: Any, request: StopRequest) -> CommandAnswer:
        begun.append(request.id)
        await silent.wait()
        return CommandAnswer(DONE, "it stands")

    monkeypatch.setattr(desk.stops, "_stop_or_report", stop)
    called = [asyncio.create_task(desk.stop()) for _ in range(MOST_STOPS)]
    await asyncio.sleep(0)
    token = desk.offered()
    called += [asyncio.create_task(desk.stop()) for _ in range(5)]
    await asyncio.sleep(0)
    assert (await desk.do(token)).outcome is NOT_SENT
    silent.set()
    assert {answer.outcome for answer in await asyncio.gather(*called) if answer} == {DONE}
    assert len(begun) == MOST_STOPS + 1


# ---- the log of commands on disks that hang or fail, and after its thread was killed ----


HANGING_LOG = """
import asyncio, sys, threading
from pathlib import Path
from multidrop.fleet.commands.log import CommandLog

async def main():
    log = CommandLog(Path(sys.argv[1]))
    log._add = lambda record, now_ns: threading.Event().wait()
    asyncio.create_task(log.note({}))
    await asyncio.sleep(0.05)
    log.close()

asyncio.run(main())
"""
HANGING_LINE = """
import asyncio, sys, threading
from pathlib import Path
from multidrop.core import Mastership
from multidrop.fleet.gateway import FleetLines
from multidrop.samples.message import PolledUnits

async def main():
    lines = FleetLines(Mastership(), Path(sys.argv[1]).parent, PolledUnits())
    lines._take = lambda record: threading.Event().wait()
    asyncio.create_task(lines.take("hall", {}))
    await asyncio.sleep(0.05)
    await lines.close()

asyncio.run(main())
"""


async def test_command_log_keeps_records_in_order_until_closed(tmp_path: Path) -> None:
    log = CommandLog(tmp_path / "commands.jsonl")
    await asyncio.gather(*(log.note({"step": number}) for number in range(5)))
    log.close()
    with pytest.raises(OSError, match=r"commands\.jsonl is closed"):
        await log.note({})
    lines = (tmp_path / "commands.jsonl").read_text().splitlines()
    assert [line.partition('"step": ')[2] for line in lines] == ["0}", "1}", "2}", "3}", "4}"]


async def test_command_logs_share_one_thread(tmp_path: Path) -> None:
    """The thread never ends, so a thread for each client would use up the threads of the system."""
    threads: list[int] = []
    with patch.object(CommandLog, "_add", lambda *record: threads.append(threading.get_ident())):
        for name in ("first", "second"):
            log = CommandLog(tmp_path / name)
            await log.note({})
            log.close()
    assert threads == [threads[0]] * 2


async def test_command_log_refuses_records_while_too_many_wait_for_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, disk, log = threading.Event(), threading.Event(), CommandLog(tmp_path / "commands.jsonl")
    monkeypatch.setattr(log_module, "MOST_WAITING", 2)
    with patch.object(CommandLog, "_add", lambda *record: begun.set() or disk.wait()):
        waiting = [asyncio.create_task(log.note({}))]
        assert await asyncio.to_thread(begun.wait, PATIENCE_S)
        waiting += [asyncio.create_task(log.note({})) for _ in range(2)]
        await asyncio.sleep(0)
        with pytest.raises(
            OSError, match=r"commands\.jsonl: 2 records are already waiting; does the disk answer"
        ):
            await log.note({})
        disk.set()
        await asyncio.gather(*waiting)
        await log.note({})
    log.close()


@pytest.mark.slow
@pytest.mark.parametrize("script", [HANGING_LOG, HANGING_LINE], ids=["log", "line"])
def test_a_hanging_disk_or_port_does_not_block_the_gateways_exit(tmp_path: Path, script: str) -> None:
    words = [sys.executable, "-c", script, str(tmp_path / "commands.jsonl")]
    with BoundProcess(words, stderr=subprocess.PIPE, text=True) as process:
        _, errors = process.communicate(timeout=PATIENCE)
        assert process.returncode == 0, errors


# ---- stops of one silent drive: the gateway repeats one of the stops, and sends each of the others once ----


@pytest.mark.slow
def test_simultaneous_stops_share_one_repeated_stop(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Eight stops arrive while the first is being repeated. All nine get the result of a repeated stop."""
    repeated: list[float | None] = []

    are_all_called = threading.Event()

    def noted(*details: Any, stop: Callable[..., Results]) -> Results:
        repeated.append(details[-1])
        if repeated[1:]:
            are_all_called.wait(PATIENCE)
        return stop(*details)

    monkeypatch.setattr(desk_module, "stop_line", partial(noted, stop=stop_line))
    monkeypatch.setattr(
        RepeatedStops.__init__, "__defaults__", (partial(noted, stop=stop_drive), begin_stops)
    )

    async def stopped(desk: Desks) -> list[CommandAnswer | None]:
        desk.sim.deaf_until = inf
        called = [asyncio.create_task(desk.stop())]
        async with asyncio.timeout(PATIENCE):
            while not desk.lines.for_stop(LINE).bus.stops_under_way():
                await asyncio.sleep(0.002)
            called += [asyncio.create_task(desk.stop()) for _ in range(8)]
            while len(desk.stops._repeated._tasks) < 8:
                await asyncio.sleep(0.002)
            are_all_called.set()
            while len(repeated) < 3 or desk.stops._repeated._sent:
                await asyncio.sleep(0.002)
        desk.sim.deaf_until = 0.0
        return await asyncio.gather(*called)

    with desks(tmp_path) as desk:
        answers = asyncio.run(stopped(desk))
    assert [answer.outcome for answer in answers if answer] == [CommandOutcome.DONE] * 9
    # Only three stops were sent. Seven of the nine calls share the third one.
    assert repeated == [None, 0.0, 0.0]
