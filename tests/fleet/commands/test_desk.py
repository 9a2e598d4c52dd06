"""Commands at a gateway: the line's master sends each command once and in time, or not at all."""

from __future__ import annotations

import asyncio
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from command_desks import LINE, PATIENCE_S, Desks, desks
from examples import every_third
from lines import patient
from tables import table

from multidrop import InvtCHE, Stopped
from multidrop.control import Seen, audit_log, read_audit
from multidrop.fleet.commands import desk as desk_module
from multidrop.fleet.commands.desk import MOST_WRITES
from multidrop.fleet.commands.messages import (
    CommandAnswer,
    CommandOutcome,
    CommandRequest,
    Offered,
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

pytestmark = patient  # writes are counted here, and a stop is repeated if its reply is late


def setpoints(desk: Desks) -> list[int]:
    return [raw for name, raw in desk.writes if name == SETPOINT]


def test_a_command_is_offered_then_done_and_logged_before_and_after(desk: Desks, tmp_path: Path) -> None:
    token = desk.offered(20.0)
    assert desk.writes == []
    answer = asyncio.run(desk.do(token))
    assert answer.outcome is DONE
    assert answer.held == "20.00 Hz"
    assert setpoints(desk) == [2000]
    begun, over = desk.notes
    assert (begun["step"], begun["by"], begun["what"]) == ("begun", "anna", "pump: frequency = 20.00 Hz")
    assert (over["step"], over["outcome"], over["id"]) == ("over", "done", begun["id"])
    [frame] = read_audit(tmp_path / "audit.jsonl")
    assert (frame["by"], frame["way"]) == ("anna", "fleet")


def test_a_duplicated_confirmation_is_carried_out_once_with_one_answer(desk: Desks) -> None:
    token = desk.offered()

    async def twice() -> list[CommandAnswer]:
        together = await asyncio.gather(*(desk.do(token) for _ in range(5)))
        desk.clock.pass_s(100)
        return [*together, await desk.do(token)]

    answers = asyncio.run(twice())
    assert {(answer.outcome, answer.text) for answer in answers} == {(DONE, answers[0].text)}
    assert setpoints(desk) == [2000]


def test_copies_of_a_request_get_the_same_offer(desk: Desks) -> None:
    same = {"id": "one", "register": SETPOINT, "value": 20.0}
    assert desk.offered(**same) == desk.offered(**same)
    assert desk.offered(**same) != desk.offered(**(same | {"id": "two"}))


@pytest.mark.parametrize(("seconds", "outcome"), [(0.5, DONE), (1.0, NOT_SENT), (60.0, NOT_SENT)])
def test_a_late_confirmation_sends_nothing(desk: Desks, seconds: float, outcome: CommandOutcome) -> None:
    token = desk.offered()
    desk.clock.pass_s(seconds)
    answer = asyncio.run(desk.do(token))
    assert answer.outcome is outcome
    assert len(setpoints(desk)) == (outcome is DONE)
    assert ("s have passed since the offer" in answer.text) == (outcome is NOT_SENT)


def test_a_command_delayed_in_its_thread_is_not_sent(tmp_path: Path) -> None:
    """The bus waits only for the rest of the second until it must send."""
    with desks(tmp_path, patience_s=0) as desk:
        _is_held_up(desk)


def _is_held_up(desk: Desks) -> None:
    token = desk.offered()
    offer = desk.desk.offers.find(token)
    assert offer is not None
    work = offer.prepared.work

    def held_up() -> CommandAnswer:
        time.sleep(0.2)
        return work()

    offer.prepared = offer.prepared._replace(work=held_up)
    desk.clock.pass_s(0.95)
    answer = asyncio.run(desk.do(token))
    assert answer.outcome is NOT_SENT
    assert "did not come within" in answer.text
    assert desk.writes == []


def test_a_command_voided_by_a_stop_in_its_thread_is_not_sent(tmp_path: Path) -> None:
    """The bus checks again right before it sends."""
    with desks(tmp_path) as desk:
        token = desk.offered()
        offer = desk.desk.offers.find(token)
        assert offer is not None
        work = offer.prepared.work

        def made_void() -> CommandAnswer:
            desk.desk.offers.void(LINE, ["pump"], "a stop was called")
            return work()

        offer.prepared = offer.prepared._replace(work=made_void)
        assert asyncio.run(desk.do(token)).outcome is NOT_SENT
        assert desk.writes == []


def test_a_command_is_on_the_disk_before_it_is_sent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with desks(tmp_path) as desk:
        synced: list[tuple[int, int]] = []  # lines in the log, and writes received by the drive by then

        def sync(file: int) -> None:
            os.fsync(file)
            synced.append((len(desk.notes), len(desk.writes)))

        monkeypatch.setattr(audit_log, "_sync", sync)
        assert asyncio.run(desk.do(desk.offered())).ok
        assert synced == [(1, 0), (2, 1)]


def while_noted(desk: Desks, deed: Callable[[], object]) -> CommandAnswer:
    """Call `deed` while a command's first record is being logged: the last moment before it is sent."""

    def before(record: dict[str, Any]) -> None:
        if record["step"] == "begun":
            deed()

    token = desk.offered()
    desk.log.before = before
    return asyncio.run(desk.do(token))


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
def test_a_command_is_not_sent_after_a_change_since_its_offer(desk: Desks, deed: str, is_late: bool) -> None:
    """The change comes before the confirmation, or between the confirmation and the sending."""
    if is_late:
        answer = while_noted(desk, lambda: MEANWHILE[deed](desk))
    else:
        token = desk.offered()
        MEANWHILE[deed](desk)
        answer = asyncio.run(desk.do(token))
    assert answer.outcome is NOT_SENT
    assert desk.writes == []


def test_a_stop_of_another_drive_does_not_void_the_offer(desk: Desks) -> None:
    token = desk.offered()
    desk.desk.offers.void(LINE, ["fan"], "a stop was called")
    desk.desk.offers.void("hall-2", None, "a stop was called")
    assert asyncio.run(desk.do(token)).outcome is DONE


def test_a_restarted_master_rejects_earlier_tokens(desk: Desks, tmp_path: Path) -> None:
    token = desk.offered()
    with desks(tmp_path) as after:
        assert asyncio.run(after.do(token)).outcome is UNKNOWN
        assert after.writes == []
    assert asyncio.run(desk.do(f"{token}x")).outcome is UNKNOWN
    assert desk.writes == []


def test_only_the_master_answers_commands_and_stops(desk: Desks) -> None:
    """Another gateway may be the master, and the sender uses the first answer."""
    desk.is_master = False
    assert desk.ask(register=SETPOINT, value=20.0) is None
    assert asyncio.run(desk.stop()) is None
    desk.is_master = True
    assert isinstance(desk.ask(register=SETPOINT, value=20.0), Offered)


def test_a_command_waits_for_the_guard_and_a_stop_does_not(desk: Desks) -> None:
    """A new master accepts only stops in its first second."""
    desk.is_guarded = True
    assert desk.ask(register=SETPOINT, value=20.0) is None
    stopped = asyncio.run(desk.stop())
    assert stopped is not None
    assert stopped.outcome is DONE
    assert desk.written == {"control"}


def test_asking_for_the_result_withdraws_the_offer(desk: Desks) -> None:
    token = desk.offered()

    async def main() -> list[CommandAnswer]:
        asked = await desk.desk.do(json.dumps({"ask": token}).encode())
        return [asked, await desk.do(token)]

    assert [answer.outcome for answer in asyncio.run(main())] == [NOT_SENT, NOT_SENT]
    assert desk.writes == []


def test_without_a_permission_list_only_stops_are_carried_out(tmp_path: Path) -> None:
    with desks(tmp_path, {}) as desk:
        for what in ({"register": SETPOINT, "value": 20.0}, {"verb": "start"}, {"verb": "emergency_stop"}):
            answer = desk.ask(**what)
            assert isinstance(answer, CommandAnswer)
            assert answer.outcome is REFUSED
            assert "is not in the plant's list" in answer.text
        assert desk.writes == []
        stopped = asyncio.run(desk.stop())
        assert stopped is not None
        assert stopped.outcome is DONE
        assert desk.written == {"control"}


@pytest.mark.parametrize("may", ["all", [], {"write": "pump.frequency"}, {"write": [["pump.frequency"]]}])
def test_a_damaged_permission_list_allows_nothing(tmp_path: Path, may: Any) -> None:
    with desks(tmp_path, may) as desk:
        answer = desk.ask(register=SETPOINT, value=20.0)
        assert isinstance(answer, CommandAnswer)
        assert answer.outcome is REFUSED


@pytest.mark.slow
def test_a_start_runs_the_motor_and_a_stop_stops_it(desk: Desks) -> None:
    async def main() -> list[CommandOutcome]:
        found = [(await desk.do(desk.offered(20.0))).outcome]
        found.append((await desk.do(desk.offered(verb="start", options={"direction": "forward"}))).outcome)
        stopped = await desk.stop(drives=None)
        assert stopped is not None
        return [*found, stopped.outcome]

    assert asyncio.run(main()) == [DONE, DONE, DONE]
    assert {"begun", "over"} == {note["step"] for note in desk.notes if note["what"] == "stop"}


@pytest.mark.slow
def test_a_long_stop_reports_its_progress(desk: Desks) -> None:
    """The sender learns that the stop was sent long before the motor has stopped."""
    desk.sim["output_frequency"] = 10.0
    data = json.dumps({"id": "one", "by": "anna", "drives": None}).encode()
    sentence = "pump: the stop was confirmed, but the motor is not yet seen to stand"

    async def main() -> CommandAnswer:
        while True:
            answer = await desk.stops.stop(LINE, data)
            assert answer is not None
            if answer.outcome is not CommandOutcome.UNDER_WAY:
                return answer
            if answer.text.startswith(sentence):
                assert answer.drives["pump"].outcome is CommandOutcome.UNDER_WAY
                assert desk.written == {"control"}
                desk.sim["output_frequency"] = 0.0

    assert asyncio.run(asyncio.wait_for(main(), PATIENCE_S)).outcome is DONE


LOSSES: dict[str, Callable[[Desks], object]] = {
    "the lease": lambda desk: setattr(desk, "is_master", False),
    "the line": lambda desk: desk.lines.shut(LINE),
}


@pytest.mark.parametrize("loss", LOSSES)
def test_a_gateway_that_loses_the_line_does_not_answer_its_stop(
    desk: Desks, monkeypatch: pytest.MonkeyPatch, loss: str
) -> None:
    """The next master may have got a copy of the stop. If we are master again, we answer the next copy."""

    def lost(seconds: float | None) -> dict[str, Stopped]:
        LOSSES[loss](desk)
        return {"pump": Stopped("pump", Seen.FAILED, 0.1, "not the master")}

    same = {"id": "one", "drives": None}
    with monkeypatch.context() as patched:
        patched.setattr(desk.bus(LINE), "stop_all", lost)
        assert asyncio.run(desk.stop(**same)) is None
    desk.is_master = True
    desk.take()
    again = asyncio.run(desk.stop(**same))
    assert again is not None
    assert again.outcome is DONE
    assert desk.written == {"control"}


def test_copies_of_a_stop_are_sent_once_and_void_offers(desk: Desks) -> None:
    token = desk.offered()

    async def main() -> CommandAnswer:
        copies = await asyncio.gather(*(desk.stop(id="one") for _ in range(3)))
        assert len({copy.text for copy in copies if copy}) == 1
        return await desk.do(token)

    answer = asyncio.run(main())
    assert answer.outcome is NOT_SENT
    assert "a stop was called" in answer.text
    assert len([name for name, _ in desk.writes if name == "control"]) == 1
    assert setpoints(desk) == []


def full_disk(record: Any) -> None:
    raise OSError(28, "No space left on device")


def test_a_full_disk_blocks_commands_but_not_stops(desk: Desks) -> None:
    token = desk.offered()
    desk.log.before = full_disk
    answer = asyncio.run(desk.do(token))
    assert answer.outcome is NOT_SENT
    assert "the log of commands cannot be written" in answer.text
    assert desk.writes == []
    stopped = asyncio.run(desk.stop())
    assert stopped is not None
    assert stopped.outcome is DONE


@pytest.mark.slow
def test_concurrent_writes_on_a_line_are_limited(desk: Desks) -> None:
    async def main() -> list[CommandAnswer]:
        tokens = [desk.offered(20.0 + number) for number in range(MOST_WRITES + 3)]
        return await asyncio.gather(*(desk.do(token) for token in tokens))

    answers = asyncio.run(main())
    unsent = [answer.text for answer in answers if answer.outcome is NOT_SENT]
    assert sum(f"{MOST_WRITES} others are under way" in text for text in unsent) == 3
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
def test_hostile_commands_are_refused_in_one_sentence(desk: Desks, data: bytes) -> None:
    answer = desk.desk.offer(LINE, data)
    assert isinstance(answer, CommandAnswer)
    assert answer.outcome is REFUSED
    assert answer.text.isprintable()
    told = asyncio.run(desk.desk.do(data))
    assert told.outcome in (REFUSED, UNKNOWN)
    assert desk.writes == []


ODD_STOPS = [  # messages that any client may send, or that a network may damage
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
def test_a_malformed_stop_is_carried_out(
    desk: Desks,
    data: bytes,
    caplog: pytest.LogCaptureFixture,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The stop is logged as printable text. If it names no drives, it stops all drives of the line."""
    # A repeated request without an id would be a new stop.
    monkeypatch.setattr(desk_module, "HOLD_S", PATIENCE_S)
    answer = asyncio.run(desk.stop_by(data))
    assert answer is not None
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
def test_a_stop_with_another_id_is_another_stop(
    desk: Desks, first: dict[str, Any], then: dict[str, Any]
) -> None:
    asyncio.run(desk.stop_by(json.dumps(first).encode()))
    before = len(desk.writes)
    asyncio.run(desk.stop_by(json.dumps(then).encode()))
    assert len(desk.writes) == before + 1


def test_a_stop_with_an_unknown_drive_stops_the_others(desk: Desks) -> None:
    answer = asyncio.run(desk.stop(drives=["pump", "fan"]))
    assert answer is not None
    assert answer.outcome is REFUSED
    assert {name: one.outcome for name, one in answer.drives.items()} == {"pump": DONE, "fan": REFUSED}


def test_a_stop_finds_its_drive_by_another_spelling_and_a_command_does_not(tmp_path: Path) -> None:
    """Depending on the keyboard, a u with two dots is one character (U+00FC) or two (U+0075 U+0308)."""
    fan, spelt = "L\u00fcfter", "Lu\u0308fter"
    with desks(tmp_path, {"write": [f"{spelt}.frequency"]}, name=fan) as desk:
        told = desk.ask(drive=spelt, register="frequency", value=20.0)
        assert isinstance(told, CommandAnswer)
        assert told.outcome is REFUSED
        answer = asyncio.run(desk.stop(drives=[spelt, fan]))
        assert answer is not None
        assert {name: one.outcome for name, one in answer.drives.items()} == {fan: DONE}
        assert desk.writes == [("control", 0xC000)]


@table("data", [b"", b"[]", b'{"outcome": "maybe", "text": ""}', b'{"outcome": "done"}'])
def test_a_sender_rejects_invalid_answers(data: bytes) -> None:
    with pytest.raises(ValueError, match=r"is not|must be"):
        read_answer(data) if data.startswith((b"{", b"[")) else read_offer(data)


def test_a_command_to_a_drive_that_has_left_its_line_is_not_sent() -> None:
    drive = InvtCHE(1, name="mill", maximum_frequency=50)
    for request in (
        CommandRequest("1", "anna", "mill", register="setpoint", value=10.0),
        CommandRequest("2", "anna", "mill", verb="start"),
    ):
        answer = prepare(drive, request).work()
        assert answer.outcome is CommandOutcome.NOT_SENT
        assert answer.text.startswith("mill is ")


def test_an_offer_keeps_the_known_setpoint() -> None:
    """The offered command may never be sent. A changed setpoint would affect the next start."""
    drive = InvtCHE(1, name="mill", maximum_frequency=50)
    drive.commanded = 40.0
    prepare(drive, CommandRequest("1", "anna", "mill", verb="set_frequency", options={"hz": 10.0}))
    assert drive.commanded == 40.0
