"""FleetCommands: send commands and stops to the gateway that polls a drive, and wait for their results."""

from __future__ import annotations

import asyncio
import json
import logging
import uuid
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

from multidrop.control import CommandOutcome
from multidrop.fleet.commands.log import CommandLog
from multidrop.fleet.commands.messages import (
    UNNAMED,
    CommandAnswer,
    CommandRequest,
    Offered,
    StopRequest,
    encode,
    read_answer,
    read_offer,
    spelt,
    worst,
)
from multidrop.fleet.errors import FleetError, MayNotSend, NobodyThere, NotDelivered, OutcomeUnknown
from multidrop.fleet.servers import names
from multidrop.fleet.servers.buckets import Bucket, Follower
from multidrop.fleet.servers.connections import ServerPath, paths_of
from multidrop.fleet.servers.setup import open_all
from multidrop.plant import drive_meant
from multidrop.printable import did_you_mean
from multidrop.supervisor import Ended, end_tasks, reason_of, supervisor

LOST_S = 6.0  # time limit without any answer, after which a command's result is reported as unknown
AGAIN_S = 0.2
# how long a stop waits until a gateway polls the line again: this takes 1 s, or 4 s if a gateway died
NO_MASTER_S = 6.0
HARD_WIRED = "use the hard-wired stop"

News = Callable[[CommandAnswer], object]

_log = logging.getLogger("multidrop.fleet")


def _ignore(answer: CommandAnswer) -> None:
    """Ignore a report of a stop's progress."""


class FleetCommands:
    """A client that commands the drives of a fleet.

    `by` is the client's name in its own log and in the gateways' logs; `log` is the path of its own log. A
    command is sent once, and only after it was written to `log`. A stop is repeated until a gateway answers,
    even if `log` cannot be written. Raises FleetError if no server can be reached.
    """

    def __init__(
        self, urls: Sequence[str], *, by: str, log: Path, options: Mapping[str, Any] | None = None
    ) -> None:
        self.by = by
        self._paths = paths_of(urls, options)
        self._log = CommandLog(log)
        self._keeping: list[asyncio.Task[None]] = []
        self._noting: set[asyncio.Task[None]] = set()  # records that are being written
        self._plant = Follower(Bucket(names.PLANT, self._path))

    async def __aenter__(self) -> Self:
        try:
            await open_all(self._paths)
        except BaseException:
            await self.close()
            raise
        self._keeping = [asyncio.create_task(path.keep()) for path in self._paths]
        return self

    async def stay(self) -> None:
        """Stay connected until cancelled. Raises Ended if a task that keeps a connection open has ended."""
        ended, _ = await asyncio.wait(self._keeping, return_when=asyncio.FIRST_COMPLETED)
        for task in ended:
            failure = None if task.cancelled() else task.exception()
            raise Ended(f"a connection to the fleet has ended: {reason_of(failure)}") from failure

    async def __aexit__(self, *error: object) -> None:
        await self.close()

    async def close(self) -> None:
        await end_tasks(*self._keeping)
        for path in self._paths:
            await path.close()
        if self._noting:
            await asyncio.wait(self._noting)
        self._log.close()

    # ---- commands ----

    async def preview(self, request: CommandRequest) -> Offered | CommandAnswer:
        """Ask a gateway to check a command; return its offer to carry it out, or its refusal.

        The command is not sent to the drive.
        """
        return await self._offer(await self._line_of(request.drive), request)

    async def write(self, drive: str, register: str, value: float | str) -> CommandAnswer:
        """Write a register once. `value` may be a number, or the name of a value such as "forward".

        Raises ValueError if the drive is not in the plant, FleetError if the plant cannot be read.
        """
        return await self.carry_out(self.request(drive, register=register, value=value))

    async def act(self, drive: str, verb: str, **options: object) -> CommandAnswer:
        """Carry out a verb once, such as "start" with direction="forward". Raises the errors of `write`."""
        return await self.carry_out(self.request(drive, verb=verb, options=options))

    def request(self, drive: str, **what: Any) -> CommandRequest:
        """Return a new command, for `preview` or `carry_out`."""
        return CommandRequest(uuid.uuid4().hex, self.by, drive, **what)

    async def carry_out(self, request: CommandRequest, agreed: str = "") -> CommandAnswer:
        """Send a command once, and return its result. Raises the errors of `write`.

        `agreed` is the preview's text that a person has confirmed. The command is not sent if the gateway's
        offer has another text.
        """
        line = await self._line_of(request.drive)
        record = {"id": request.id, "line": line, "what": request.words, "by": request.by}
        try:
            await self._log.note({"step": "asked", **record})
        except OSError as failure:
            why = f"{request.words} was not sent: {self._log.path}: {failure.strerror or failure}"
            return CommandAnswer(CommandOutcome.NOT_SENT, why)
        offered = await self._offer(line, request)
        if isinstance(offered, CommandAnswer):
            answer = offered
        elif agreed and offered.text != agreed:
            why = f"{agreed} was not sent: the plant has changed, and the command would be {offered.text} now"
            answer = CommandAnswer(CommandOutcome.NOT_SENT, why)
        else:
            answer = await self._do(offered)
        self._note_aside({"step": "over", **answer.as_json(), **record})
        return answer

    async def _offer(self, line: str, request: CommandRequest) -> Offered | CommandAnswer:
        """Ask the line's gateway to check a command, over one server connection after another.

        The gateway then offers to carry it out. It does so only if the offer is accepted.
        """
        why = ""
        for path in self._paths:
            try:
                message = await path.request(names.command_subject(line), encode(request))
                return read_offer(message.data)
            except NobodyThere:
                why = f"no gateway is master of line {line} now"
            except OutcomeUnknown:
                why = f"the master of line {line} gives no answer"
            except FleetError as failure:
                why = why or str(failure)
            except ValueError as mistake:
                why = f"a gateway of line {line} gives an invalid answer: {mistake}"
        return CommandAnswer(CommandOutcome.NOT_SENT, f"{request.words} was not sent: {why}")

    async def _do(self, offered: Offered) -> CommandAnswer:
        """Confirm an offered command once, and return its result."""
        path = self._path()
        try:
            message = await path.request(offered.subject, json.dumps({"do": offered.token}).encode())
            answer = read_answer(message.data)
        except NotDelivered:
            why = f"{offered.text} was not sent: {offered.gateway} is gone since its offer"
            return CommandAnswer(CommandOutcome.NOT_SENT, why)
        except (FleetError, ValueError):  # the gateway may have received the confirmation
            answer = CommandAnswer(CommandOutcome.UNDER_WAY, "")
        asked = json.dumps({"ask": offered.token}).encode()
        lost = f"{offered.text}: it is not known whether it was sent: {offered.gateway} no longer answers"
        return await self._end_of(answer, offered.subject, asked, lost)

    async def _end_of(
        self, answer: CommandAnswer, subject: str, asked: bytes, lost: str, on_news: News = _ignore
    ) -> CommandAnswer:
        """Request a command's result over each server connection in turn until it is final.

        Return UNKNOWN after LOST_S without answers.
        """
        loop = asyncio.get_running_loop()
        ends, at = loop.time() + LOST_S, 0
        reported = {""}
        while answer.outcome is CommandOutcome.UNDER_WAY:
            if answer.text not in reported:
                reported.add(answer.text)
                on_news(answer)
            at += 1
            try:
                message = await self._paths[at % len(self._paths)].request(subject, asked)
                answer = read_answer(message.data)
                ends = loop.time() + LOST_S
            except (FleetError, ValueError) as failure:
                if loop.time() > ends:
                    heard = f"; its last answer: {answer.text}" if answer.gateway else ""
                    return CommandAnswer(CommandOutcome.UNKNOWN, f"{lost} ({failure}){heard}")
                await asyncio.sleep(AGAIN_S)
        return answer

    # ---- stops ----

    async def stop(
        self, drives: Sequence[str] | None = None, *, line: str = "", on_news: News = _ignore, by: str = ""
    ) -> CommandAnswer:
        """Stop these drives, or all drives of the plant if None; the lines are stopped in parallel.

        With `line`, only drives of that line are stopped, and the plant is not read. `by` replaces this
        object's `by` in the logs. If a stop takes longer than half a second, `on_news` is called in the event
        loop with the stop's progress, and again whenever it changes. A drive that is not in the plant gets
        the answer "refused"; the other drives are stopped.

        Raises ValueError if none of the drives is in the plant, FleetError if the plant cannot be read. In
        both cases no stop was sent.
        """
        drives = [drives] if isinstance(drives, str) else drives
        wanted, unknown = await self._lines_of(drives, line)
        asked = spelt(by or self.by) or UNNAMED  # a stop is sent even if its sender's name is invalid
        answers = await asyncio.gather(*(self._stop(one, wanted[one], on_news, asked) for one in wanted))
        answers += unknown
        if len(answers) == 1:
            return answers[0]
        text = "\n".join(answer.text for answer in answers) or "the plant has no lines"
        found = {name: one for answer in answers for name, one in answer.drives.items()}
        return CommandAnswer(worst(answers), text, drives=found)

    async def _lines_of(
        self, drives: Sequence[str] | None, line: str
    ) -> tuple[dict[str, list[str] | None], list[CommandAnswer]]:
        """Return the drives to stop for each line, and an answer for each drive that is not in the plant."""
        if line:
            return {line: None if drives is None else list(drives)}, []
        await self._read_plant(f"the stop was NOT sent; {HARD_WIRED}")
        if drives is None:
            return dict.fromkeys(self._drives_by_line()), []
        found: dict[str, list[str] | None] = {}
        unknown: list[CommandAnswer] = []
        there = [name for line in self._drives_by_line().values() for name in line]
        for drive in [drive_meant(drive, there) for drive in drives]:
            try:
                here = found.setdefault(self._find(drive), [])
            except ValueError as mistake:
                refused = CommandAnswer(CommandOutcome.REFUSED, f"no stop was sent: {mistake}")
                unknown.append(refused._replace(drives={drive: refused}))
            else:
                assert here is not None
                here.append(drive)
        if unknown and not found:
            raise ValueError(unknown[0].text)
        return found, unknown

    async def _stop(self, line: str, drives: list[str] | None, on_news: News, by: str) -> CommandAnswer:
        request = StopRequest(uuid.uuid4().hex, by, None if drives is None else tuple(drives))
        what = f"the stop of {', '.join(drives) if drives else f'all drives of line {line}'}"
        record = {"id": request.id, "line": line, "what": what, "by": by}
        self._note_aside({"step": "asked", **record})
        answer = await _first_answer(self._paths, line, request, what, on_news)
        lost = f"the result of {what} is unknown: its gateway no longer answers; {HARD_WIRED}"
        answer = await self._end_of(answer, names.stop_subject(line), encode(request), lost, on_news)
        self._note_aside({"step": "over", **answer.as_json(), **record})
        return answer

    # ---- the plant, and the log ----

    def _path(self) -> ServerPath:
        return next((path for path in self._paths if path.is_open), self._paths[0])

    def _drives_by_line(self) -> dict[str, list[str]]:
        found = {}
        for name, record in self._plant.records.items():
            line = record.value.get("line") if isinstance(record.value, dict) else None
            drives = line.get("drive", []) if isinstance(line, dict) else None
            if isinstance(drives, list):
                found[name] = [str(drive.get("name")) for drive in drives if isinstance(drive, dict)]
        return found

    async def _line_of(self, drive: str) -> str:
        await self._read_plant("nothing was sent")
        return self._find(drive)

    async def _read_plant(self, otherwise: str) -> None:
        """Update the local copy of the plant from the servers.

        If no server answers, keep the old copy: the gateways check each command against their own. Without an
        old copy, raise FleetError; its message starts with `otherwise`.
        """
        try:
            await self._plant.look()
        except FleetError as failure:
            if not self._plant.records:
                raise FleetError(f"{otherwise}: the fleet's plant cannot be read: {failure}") from None

    def _find(self, drive: str) -> str:
        lines = self._drives_by_line()
        for line, drives in lines.items():
            if drive in drives:
                return line
        names = [name for drives in lines.values() for name in drives]
        hint = did_you_mean(drive, names, "`multidrop fleet lines` lists its lines")
        raise ValueError(f"the fleet's plant has no drive {drive!r}; {hint}")

    def _note_aside(self, record: Mapping[str, Any]) -> None:
        """Log a record in a task, so that a slow disk delays no stop and no result."""
        noting = supervisor().start("record of a command", self._note(record))
        self._noting.add(noting)
        noting.add_done_callback(self._noting.discard)

    async def _note(self, record: Mapping[str, Any]) -> None:
        try:
            await self._log.note(record)
        except OSError as failure:
            _log.warning(
                "a record of a command or stop was not written to %s: %s",
                self._log.path,
                failure.strerror or failure,
            )


# ---- stops that wait for a master ----


async def _first_answer(
    paths: Sequence[ServerPath], line: str, request: StopRequest, what: str, on_news: News
) -> CommandAnswer:
    """Send a stop until a gateway answers, and return the answer; UNDER_WAY if the answer was lost.

    Return NOT_SENT if no gateway has received the stop within NO_MASTER_S, or if this client may not send
    stops. Until a gateway has received it, `on_news` gets a report that the stop is not sent yet.
    """
    loop = asyncio.get_running_loop()
    ends, reported = loop.time() + NO_MASTER_S, ""
    while True:
        try:
            return await _ask_all(paths, line, request, what)
        except NotDelivered as failure:
            why = f"no gateway is master of line {line}" if isinstance(failure, NobodyThere) else str(failure)
            if loop.time() > ends or isinstance(failure, MayNotSend):
                sentence = f"{what} was NOT sent: {why}; {HARD_WIRED}"
                return CommandAnswer(CommandOutcome.NOT_SENT, sentence)
        if why != reported:
            reported = why
            sentence = f"{what} was NOT sent yet: {why}; {HARD_WIRED}"
            on_news(CommandAnswer(CommandOutcome.UNDER_WAY, sentence))
        await asyncio.sleep(AGAIN_S)


async def _ask_all(paths: Sequence[ServerPath], line: str, request: StopRequest, what: str) -> CommandAnswer:
    """Send a stop on all server connections in parallel, and return the first answer.

    Return UNDER_WAY if a gateway may have received the stop but no answer came. Raises NobodyThere if no
    connection delivered the stop, and a server reports that the line has no master. Raises NotDelivered if
    all connections failed for other reasons.
    """
    subject, data = names.stop_subject(line), encode(request)
    asking = [asyncio.create_task(path.request(subject, data)) for path in paths]
    failures: list[NotDelivered] = []
    try:
        for asked in asyncio.as_completed(asking):
            try:
                return read_answer((await asked).data)
            except NotDelivered as failure:
                failures.append(failure)
            except (FleetError, ValueError):
                pass
    finally:
        await end_tasks(*asking)
    if len(failures) == len(paths):
        raise min(failures, key=lambda failure: not isinstance(failure, NobodyThere))
    return CommandAnswer(CommandOutcome.UNDER_WAY, f"{what}: no gateway has answered yet; {HARD_WIRED}")
