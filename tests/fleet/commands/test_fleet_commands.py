"""FleetCommands, the sender of commands, sends each command only once, and reports its real outcome."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Awaitable, Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
from tables import table

from multidrop.control import CommandOutcome, read_audit
from multidrop.fleet.commands import fleet_commands
from multidrop.fleet.commands import log as log_module
from multidrop.fleet.commands.fleet_commands import FleetCommands
from multidrop.fleet.commands.log import CommandLog
from multidrop.fleet.commands.messages import CommandAnswer
from multidrop.fleet.errors import FleetError, MayNotSend, NobodyThere, NotDelivered, OutcomeUnknown
from multidrop.fleet.servers.buckets import Record

DONE, NOT_SENT, UNKNOWN = CommandOutcome.DONE, CommandOutcome.NOT_SENT, CommandOutcome.UNKNOWN
OFFER = {"token": "t", "subject": "do.gw-1.run", "text": "pump-1: frequency = 20.00 Hz", "gateway": "gw-1"}
PLANT = {"hall-1": ["pump-1", "pump-2"], "hall-2": ["fan-1"]}
Given = BaseException | Mapping[str, Any] | bytes


def answer(outcome: str, text: str = "as it is") -> dict[str, str]:
    return {"outcome": outcome, "text": text}


class Said:
    """An answer, with its bytes in `data` as in nats-py's messages."""

    def __init__(self, data: bytes) -> None:
        self.data = data


class ScriptedPath:
    """A fake server connection with a list of answers for each kind of request; the last one repeats."""

    is_open = True

    def __init__(self, **answers: Sequence[Given]) -> None:
        self.answers = {kind: list(given) for kind, given in answers.items()}
        self.asked: list[str] = []

    async def request(self, subject: str, data: bytes) -> Said:
        kind = subject.partition(".")[0]
        if kind == "do":
            kind = next(iter(json.loads(data)))
        self.asked.append(kind)
        given = self.answers[kind]
        found = given.pop(0) if len(given) > 1 else given[0]
        if isinstance(found, BaseException):
            raise found
        return Said(found if isinstance(found, bytes) else json.dumps(found).encode())

    async def close(self) -> None:
        """Do nothing, so that the same answers are given after the client connects again."""


class Plant:
    """A fake copy of the plant. With a `failure`, it cannot be read."""

    def __init__(self, failure: FleetError | None = None) -> None:
        self._failure = failure
        self.records = {
            line: Record(line, 1, {"line": {"drive": [{"name": name} for name in drives]}})
            for line, drives in PLANT.items()
            if failure is None
        }

    async def look(self) -> None:
        if self._failure:
            raise self._failure


def asked(
    folder: Path,
    path: ScriptedPath,
    what: Callable[[FleetCommands], Awaitable[CommandAnswer]],
    plant: Plant | None = None,
    nobody_s: float = 0.01,
) -> CommandAnswer:
    """Return the result of a command or stop from a client that has only this server connection."""

    async def main() -> CommandAnswer:
        client = FleetCommands(["nats://nobody"], by="anna", log=folder / "asked.jsonl")
        client._paths = [path]
        client._plant = plant or Plant()
        try:
            return await what(client)
        finally:
            await client.close()

    with ExitStack() as stack:
        for name, seconds in (("LOST_S", 0.01), ("NO_MASTER_S", nobody_s), ("AGAIN_S", 0.0)):
            stack.enter_context(patch.object(fleet_commands, name, seconds))
        return asyncio.run(main())


def write(client: FleetCommands) -> Awaitable[CommandAnswer]:
    return client.write("pump-1", "frequency", 20.0)


NOBODY, LOST, CUT = NobodyThere("nobody"), OutcomeUnknown("no answer"), NotDelivered("no connection")
NO_RIGHT = MayNotSend("no right")
ANY = FleetError("no right")  # after this error, the gateway may or may not have received the request
UNDER_WAY, TAKEN_BACK, IT_IS_DONE = answer("under way"), answer("not sent"), answer("done")

# server connection, expected outcome and number of sent confirmations, by case
WRITES: dict[str, tuple[ScriptedPath, CommandOutcome, int]] = {
    "done": (ScriptedPath(cmd=[OFFER], do=[IT_IS_DONE]), DONE, 1),
    "no master": (ScriptedPath(cmd=[NOBODY]), NOT_SENT, 0),
    "no connection": (ScriptedPath(cmd=[CUT]), NOT_SENT, 0),
    "a silent master": (ScriptedPath(cmd=[LOST]), NOT_SENT, 0),
    "a refusal": (ScriptedPath(cmd=[answer("refused")]), CommandOutcome.REFUSED, 0),
    "an invalid offer": (ScriptedPath(cmd=[b"\xff"]), NOT_SENT, 0),
    "the master is gone": (ScriptedPath(cmd=[OFFER], do=[NOBODY]), NOT_SENT, 1),
    "connection lost before sending": (ScriptedPath(cmd=[OFFER], do=[CUT]), NOT_SENT, 1),
    "the answer is lost, and then found": (
        ScriptedPath(cmd=[OFFER], do=[LOST], ask=[LOST, IT_IS_DONE]),
        DONE,
        1,
    ),
    "the confirmation is lost": (ScriptedPath(cmd=[OFFER], do=[LOST], ask=[TAKEN_BACK]), NOT_SENT, 1),
    "a long command": (
        ScriptedPath(cmd=[OFFER], do=[UNDER_WAY], ask=[UNDER_WAY, UNDER_WAY, IT_IS_DONE]),
        DONE,
        1,
    ),
    "the master dies during the command": (
        ScriptedPath(cmd=[OFFER], do=[UNDER_WAY], ask=[NOBODY]),
        UNKNOWN,
        1,
    ),
    "another error": (ScriptedPath(cmd=[OFFER], do=[ANY], ask=[ANY, IT_IS_DONE]), DONE, 1),
    "another error each time": (ScriptedPath(cmd=[OFFER], do=[ANY], ask=[ANY]), UNKNOWN, 1),
    "no right to ask": (ScriptedPath(cmd=[ANY]), NOT_SENT, 0),
    "all is lost": (ScriptedPath(cmd=[OFFER], do=[LOST], ask=[LOST]), UNKNOWN, 1),
    "an invalid result": (ScriptedPath(cmd=[OFFER], do=[b"[]"], ask=[IT_IS_DONE]), DONE, 1),
}


@pytest.mark.parametrize("case", WRITES)
def test_write_command_reports_the_true_outcome(tmp_path: Path, case: str) -> None:
    path, outcome, sent = WRITES[case]
    told = asked(tmp_path, path, write)
    assert told.outcome is outcome
    assert told.text
    assert path.asked.count("do") == sent
    first, last = read_audit(tmp_path / "asked.jsonl")
    assert (first["step"], first["by"]) == ("asked", "anna")
    assert (last["step"], last["outcome"]) == ("over", outcome.value)


def stop(client: FleetCommands) -> Awaitable[CommandAnswer]:
    return client.stop(["pump-1"])


STOPS: dict[str, tuple[ScriptedPath, CommandOutcome, str]] = {
    "stopped": (ScriptedPath(stop=[IT_IS_DONE]), DONE, "as it is"),
    "after a while": (ScriptedPath(stop=[UNDER_WAY, UNDER_WAY, IT_IS_DONE]), DONE, "as it is"),
    "no master": (
        ScriptedPath(stop=[NOBODY]),
        NOT_SENT,
        "the stop of pump-1 was NOT sent: no gateway is master of line hall-1; use the hard-wired stop",
    ),
    "no right": (
        ScriptedPath(stop=[NO_RIGHT, IT_IS_DONE]),
        NOT_SENT,
        "the stop of pump-1 was NOT sent: no right; use the hard-wired stop",
    ),
    "no server": (
        ScriptedPath(stop=[CUT]),
        NOT_SENT,
        "the stop of pump-1 was NOT sent: no connection; use the hard-wired stop",
    ),
    "an answer that is lost": (ScriptedPath(stop=[LOST, IT_IS_DONE]), DONE, "as it is"),
    "a master that dies, and the next one": (
        ScriptedPath(stop=[UNDER_WAY, NOBODY, IT_IS_DONE]),
        DONE,
        "as it is",
    ),
    "silence": (
        ScriptedPath(stop=[LOST]),
        UNKNOWN,
        "the result of the stop of pump-1 is unknown: its gateway no longer answers; "
        "use the hard-wired stop (no answer)",
    ),
    "another error": (ScriptedPath(stop=[ANY]), UNKNOWN, "the result of the stop"),
    "silence, then no master": (ScriptedPath(stop=[LOST, NOBODY]), UNKNOWN, "the result of"),
}


@table("case", STOPS)
def test_a_stop_is_sent_until_a_gateway_answers(tmp_path: Path, case: str) -> None:
    path, outcome, text = STOPS[case]
    told = asked(tmp_path, path, stop)
    assert told.outcome is outcome
    assert told.text.startswith(text)


def test_progress_of_a_stop_is_reported_once_per_change(tmp_path: Path) -> None:
    sent, turning = answer("under way", "sent"), answer("under way", "still turning")
    path = ScriptedPath(stop=[sent, sent, LOST, turning, sent, IT_IS_DONE])
    told: list[CommandAnswer] = []
    last = asked(tmp_path, path, lambda client: client.stop(["pump-1"], on_news=told.append))
    assert [(news.outcome, news.text) for news in told] == [
        (CommandOutcome.UNDER_WAY, "sent"),
        (CommandOutcome.UNDER_WAY, "still turning"),
    ]
    assert last.outcome is DONE


def test_stop_reports_a_missing_master_once(tmp_path: Path) -> None:
    told: list[CommandAnswer] = []
    path = ScriptedPath(stop=[NOBODY, NOBODY, CUT, IT_IS_DONE])
    last = asked(tmp_path, path, lambda client: client.stop(["pump-1"], on_news=told.append), nobody_s=60.0)
    assert last.outcome is DONE
    yet = "the stop of pump-1 was NOT sent yet: {}; use the hard-wired stop"
    assert [news.text for news in told] == [
        yet.format("no gateway is master of line hall-1"),
        yet.format("no connection"),
    ]


def test_stop_reports_the_last_answer_if_the_gateway_falls_silent(tmp_path: Path) -> None:
    path = ScriptedPath(
        stop=[{**answer("under way", "pump-1: the stop was sent"), "gateway": "gw-1"}, NOBODY]
    )
    last = asked(tmp_path, path, stop)
    assert last.outcome is UNKNOWN
    assert last.text.endswith("; its last answer: pump-1: the stop was sent")


def test_unanswered_stop_is_reported_before_the_client_gives_up(tmp_path: Path) -> None:
    told: list[CommandAnswer] = []
    path = ScriptedPath(stop=[LOST])
    last = asked(tmp_path, path, lambda client: client.stop(["pump-1"], on_news=told.append))
    assert last.outcome is UNKNOWN
    [news] = told
    assert news.text == "the stop of pump-1: no gateway has answered yet; use the hard-wired stop"


class HangingPath(ScriptedPath):
    """A server connection that never answers."""

    async def request(self, subject: str, data: bytes) -> Said:
        self.asked.append(subject)
        await asyncio.Event().wait()
        raise AssertionError("it hangs")


def test_a_stop_does_not_wait_for_a_hanging_server(tmp_path: Path) -> None:
    hanging, path = HangingPath(), ScriptedPath(stop=[IT_IS_DONE])

    async def stop_on_both(client: FleetCommands) -> CommandAnswer:
        client._paths = [hanging, path]
        return await asyncio.wait_for(client.stop(["pump-1"]), 60)

    assert asked(tmp_path, path, stop_on_both).outcome is DONE
    assert hanging.asked == ["stop.hall-1"]


@pytest.mark.parametrize("others", [[NOBODY, NOBODY], [NOBODY, CUT], [LOST, NOBODY]])
def test_stop_outcome_is_unknown_only_if_an_answer_is_lost(tmp_path: Path, others: list[Given]) -> None:
    paths = [ScriptedPath(stop=[given]) for given in (NOBODY, *others)]

    async def stop_on_all(client: FleetCommands) -> CommandAnswer:
        client._paths = paths
        return await client.stop(["pump-1"])

    told = asked(tmp_path, paths[0], stop_on_all)
    assert told.outcome is (UNKNOWN if LOST in others else NOT_SENT)
    assert [path.asked[:1] for path in paths] == [["stop"]] * 3


@pytest.mark.parametrize(
    ("spoil", "why"),
    [
        (lambda log: log.symlink_to("/dev/full"), "No space left on device"),
        (lambda log: log.mkdir(), "Is a directory"),
    ],
)
def test_an_unwritable_log_blocks_commands_but_not_stops(
    tmp_path: Path, spoil: Callable[[Path], object], why: str
) -> None:
    path = ScriptedPath(cmd=[OFFER], do=[IT_IS_DONE], stop=[IT_IS_DONE])
    spoil(tmp_path / "asked.jsonl")
    told = asked(tmp_path, path, write)
    assert told.outcome is NOT_SENT
    assert told.text.endswith(f"asked.jsonl: {why}")
    assert asked(tmp_path, path, stop).outcome is DONE
    assert path.asked == ["stop"]


def test_a_hanging_disk_blocks_commands_but_no_stop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = threading.Event()
    path = ScriptedPath(cmd=[OFFER], do=[IT_IS_DONE], stop=[IT_IS_DONE])
    monkeypatch.setattr(CommandLog, "_add", lambda *record: disk.wait())

    async def stop_and_write(client: FleetCommands) -> CommandAnswer:
        try:
            async with asyncio.timeout(60):
                assert [(await stop(client)).outcome for _ in range(2)] == [DONE] * 2
                assert path.asked == ["stop"] * 2
                monkeypatch.setattr(log_module, "WRITING_S", 0.0)
                return await write(client)
        finally:
            disk.set()

    told = asked(tmp_path, path, stop_and_write)
    assert told.outcome is NOT_SENT
    assert told.text.endswith("asked.jsonl: not written within 0 s; does the disk answer?")
    assert path.asked == ["stop"] * 2


def test_command_is_not_sent_if_the_preview_has_changed(tmp_path: Path) -> None:
    path = ScriptedPath(cmd=[OFFER], do=[IT_IS_DONE])

    async def agreed(client: FleetCommands) -> CommandAnswer:
        request = client.request("pump-1", register="frequency", value=20.0)
        return await client.carry_out(request, "pump-1: frequency = 2.00 Hz")

    told = asked(tmp_path, path, agreed)
    assert told.outcome is NOT_SENT
    assert "the plant has changed, and the command would be pump-1: frequency = 20.00 Hz now" in told.text
    assert path.asked == ["cmd"]


def test_stop_of_all_lines_returns_the_worst_outcome(tmp_path: Path) -> None:
    path = ScriptedPath(stop=[{**IT_IS_DONE, "drives": {"pump-1": IT_IS_DONE}}, NOBODY])
    told = asked(tmp_path, path, lambda client: client.stop())
    assert told.outcome is NOT_SENT
    assert "the stop of all drives of line hall-2 was NOT sent" in told.text
    assert told.drives["pump-1"].outcome is DONE


def test_the_drives_of_one_line_are_stopped_by_one_message(tmp_path: Path) -> None:
    path = ScriptedPath(stop=[IT_IS_DONE])
    asked(tmp_path, path, lambda client: client.stop(["pump-1", "fan-1", "pump-2"]))
    assert path.asked == ["stop", "stop"]


def test_only_stops_accept_another_unicode_form_of_a_drives_name(tmp_path: Path) -> None:
    """Keyboards differ: a u with two dots is one character (U+00FC) or two (U+0075 U+0308)."""
    fan, spelt = "L\u00fcfter", "Lu\u0308fter"
    plant = Plant()
    plant.records["hall-3"] = Record("hall-3", 1, {"line": {"drive": [{"name": fan}]}})
    path = ScriptedPath(stop=[IT_IS_DONE])
    asked(tmp_path, path, lambda client: client.stop([spelt]), plant)
    assert f"the stop of {fan}" in {note["what"] for note in read_audit(tmp_path / "asked.jsonl")}
    with pytest.raises(ValueError, match="has no drive"):
        asked(tmp_path, path, lambda client: client.write(spelt, "frequency", 20.0), plant)
    assert path.asked == ["stop"]


@pytest.mark.parametrize(
    ("by", "noted"), [("\x1b[31m", r"\x1b[31m"), ("\ud800", r"\ud800"), ("", "somebody"), (None, "somebody")]
)
def test_stop_is_sent_even_if_the_sender_name_is_invalid(tmp_path: Path, by: Any, noted: str) -> None:
    path = ScriptedPath(stop=[IT_IS_DONE])

    async def stopped(client: FleetCommands) -> CommandAnswer:
        client.by = by
        # not in a list: the name must not be read as a sequence of letters
        return await client.stop("pump-1")

    assert asked(tmp_path, path, stopped).outcome is DONE
    assert path.asked == ["stop"]
    assert {note["by"] for note in read_audit(tmp_path / "asked.jsonl")} == {noted}


@pytest.mark.parametrize("what", [write, lambda client: client.stop(["pump-1"])])
def test_no_command_or_stop_is_sent_if_the_plant_cannot_be_read(tmp_path: Path, what: Any) -> None:
    with pytest.raises(FleetError, match="no server"):
        asked(tmp_path, ScriptedPath(), what, Plant(FleetError("no server")))


def test_a_client_uses_its_older_copy_of_the_plant_if_reading_fails(tmp_path: Path) -> None:
    plant = Plant()
    plant._failure = FleetError("no server")
    path = ScriptedPath(cmd=[OFFER], do=[IT_IS_DONE], stop=[IT_IS_DONE])
    assert asked(tmp_path, path, write, plant).outcome is DONE
    assert asked(tmp_path, path, stop, plant).outcome is DONE


def test_stop_of_a_named_line_needs_no_readable_plant(tmp_path: Path) -> None:
    path = ScriptedPath(stop=[IT_IS_DONE])
    plant = Plant(FleetError("no server"))
    told = asked(tmp_path, path, lambda client: client.stop(["pump-1"], line="hall-1"), plant)
    assert told.outcome is DONE
    with pytest.raises(
        FleetError, match="the stop was NOT sent; use the hard-wired stop: the fleet's plant cannot"
    ):
        asked(tmp_path, path, stop, plant)


def test_known_drives_are_stopped_despite_an_unknown_drive_name(tmp_path: Path) -> None:
    path = ScriptedPath(stop=[{**IT_IS_DONE, "drives": {"pump-1": IT_IS_DONE}}])
    told = asked(tmp_path, path, lambda client: client.stop(["pmp-2", "pump-1"]))
    assert path.asked == ["stop"]
    assert told.outcome is CommandOutcome.REFUSED
    assert "no stop was sent: the fleet's plant has no drive 'pmp-2'; did you mean pump-2" in told.text
    assert {name: one.outcome for name, one in told.drives.items()} == {
        "pump-1": DONE,
        "pmp-2": CommandOutcome.REFUSED,
    }


@pytest.mark.parametrize("what", ["write", "stop"])
def test_an_unknown_drive_is_rejected_with_suggestions(tmp_path: Path, what: str) -> None:
    path = ScriptedPath()
    calls: dict[str, Callable[[FleetCommands], Awaitable[CommandAnswer]]] = {
        "write": lambda client: client.write("pump1", "frequency", 20.0),
        "stop": lambda client: client.stop(["pump1"]),
    }
    with pytest.raises(ValueError, match=r"has no drive 'pump1'; did you mean pump-\d or pump-\d\?"):
        asked(tmp_path, path, calls[what])
    assert path.asked == []
