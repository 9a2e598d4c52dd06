"""CommandDesk and StopDesk receive commands and stops in a gateway; CommandSubjects connects them to NATS.

Both act only on lines whose master is this gateway. The command desk checks a command and sends the sender an
offer with a token. If the sender returns the token within a second, measured by this computer's
CLOCK_BOOTTIME, the desk carries out the command. The command is recorded on the disk before it is sent, and
again when it has ended.

A stop needs no confirmation and no entry in `[fleet.may]`: sending a stop twice is harmless, but a late stop
may do harm. The stop is sent first and recorded afterwards.

A gateway subscribes to a line's subjects only while it polls the line. For a line without a master, the
server therefore reports to a sender that its message has no receiver. A gateway is connected to several
servers, and each server delivers each message. The desks recognise copies by the id that the sender chose.
No stream stores these messages.
"""

from __future__ import annotations

import asyncio
import json
import logging
import secrets
import time
from collections.abc import Awaitable, Callable, Coroutine, Mapping, Sequence
from contextlib import suppress
from functools import partial
from hashlib import sha256
from typing import Any

from nats.aio.msg import Msg

from multidrop import Unsupported
from multidrop.control import CommandOutcome, CommandResult, written_by
from multidrop.control.commands import JoinedStops, LineStop, RepeatedStops, begin_command, stop_line
from multidrop.fleet.commands.log import CommandLog
from multidrop.fleet.commands.messages import (
    CommandAnswer,
    CommandRequest,
    Offered,
    StopRequest,
    encode,
    read_command,
    read_json,
    read_stop,
    spelt,
    worst,
)
from multidrop.fleet.commands.offers import HeldLine, HeldLines, Offer, Offers, Prepared, prepare
from multidrop.fleet.lines.lease import boottime_ns
from multidrop.fleet.servers import names
from multidrop.fleet.servers.connections import ServerPath
from multidrop.plant import drive_meant
from multidrop.supervisor import supervisor

HOLD_S = 0.5  # a command or stop that takes longer is answered with "under way"
AWAITED_S = 3.0  # how long the closing of a line waits for its commands in progress
POLL_S = 0.01  # pause between checks whether commands have ended
MOST_WRITES = 8  # limit of concurrent commands on one line; stops are not counted
WAY = "fleet"  # name in the audit log for commands that came through the fleet
STOPS_REMEMBERED = 1000  # limit of remembered stops; the oldest are forgotten
CALLED = "a stop was called"

_log = logging.getLogger("multidrop.fleet")


class CommandDesk:
    """Checks commands for this gateway's lines, and carries them out once their sender has confirmed them.

    For a valid command, the desk returns an offer with a token. The sender confirms the command by publishing
    the token on the NATS subject `subject`.
    """

    def __init__(
        self,
        gateway: str,
        subject: str,
        lines: HeldLines,
        log: CommandLog,
        clock: Callable[[], int] = boottime_ns,
    ) -> None:
        self.gateway = gateway
        self.subject = subject
        self.offers = Offers(clock)
        self._lines = lines
        self._log = log
        self._under_way: dict[str, int] = {}  # number of commands in progress by line

    # ---- offering a command ----

    def offer(self, line: str, data: bytes) -> Offered | CommandAnswer | None:
        """Check the command in a message, and return this gateway's offer to carry it out.

        The command is sent only after its sender has accepted the offer. If it must not be sent, return an
        answer with the reason. Return None if another gateway is the line's master.
        """
        held = self._lines.for_command(line)
        if held is None:
            return None
        try:
            request = read_command(data)
            offer = self.offers.make(request, _prepared(held, request), held)
        except (ValueError, TypeError, OverflowError, Unsupported) as mistake:
            return CommandAnswer(CommandOutcome.REFUSED, str(mistake), self.gateway)
        return Offered(offer.token, self.subject, offer.prepared.text, self.gateway)

    # ---- carrying out an offered command ----

    async def do(self, data: bytes) -> CommandAnswer:
        """Carry out an offered command once and return its result.

        A message with `ask` instead of `do` only requests the result. If no `do` came before, the command is
        cancelled and the answer is "not sent".
        """
        try:
            message = read_json(data)
        except ValueError as mistake:
            return CommandAnswer(CommandOutcome.REFUSED, str(mistake), self.gateway)
        token = message.get("do", message.get("ask"))
        offer = self.offers.find(token) if isinstance(token, str) else None
        if offer is None:
            sentence = "no offer with this token is known here, so nothing is sent now"
            return CommandAnswer(CommandOutcome.UNKNOWN, sentence, self.gateway)
        if "do" not in message:
            self.offers.withdraw(offer, "the client asked for the result before it confirmed the offer")
        elif self.offers.take(offer):
            supervisor().start("command", self._carry_out(offer))
        with suppress(TimeoutError):
            await asyncio.wait_for(offer.has_ended.wait(), HOLD_S)
        found = offer.answer or CommandAnswer(CommandOutcome.UNDER_WAY, f"{offer.prepared.text}: under way")
        return found._replace(gateway=self.gateway)

    async def await_commands(self, line: str, may_wait: Callable[[], bool]) -> None:
        """Wait for a line's commands to end, at most AWAITED_S and only while `may_wait()` is True."""
        loop = asyncio.get_running_loop()
        ends = loop.time() + AWAITED_S
        while self._under_way.get(line) and loop.time() < ends and may_wait():
            await asyncio.sleep(POLL_S)

    async def _carry_out(self, offer: Offer) -> None:
        line = offer.held.name
        self._under_way[line] = self._under_way.get(line, 0) + 1
        sentence = f"{offer.prepared.text}: it is not known whether it was sent, because the gateway failed"
        answer = CommandAnswer(CommandOutcome.UNKNOWN, sentence)
        try:
            answer = await self._once(offer)
        except Exception:
            _log.exception("%s", offer.request.words)
        finally:
            self._under_way[line] -= 1
            self.offers.end(offer, answer)

    async def _once(self, offer: Offer) -> CommandAnswer:
        why = self._why_not(offer)
        if why:
            return offer.unsent(why)
        try:
            await self._note(offer, "begun", {})
        except OSError as failure:
            return offer.unsent(f"the log of commands cannot be written: {failure}")
        with written_by(offer.request.by, WAY):
            result = await begin_command(
                offer.prepared.work, lambda: self._limit_ns(offer), lambda: self._refusal(offer)
            )
        answer = CommandAnswer.of(offer.request.drive, result)
        _log.info("%s, asked for by %s: %s", offer.request.words, offer.request.by, answer.text)
        try:
            await self._note(offer, "over", answer.as_json())
        except OSError as failure:
            _log.warning("the log of commands cannot be written: %s", failure)
        return answer

    def _limit_ns(self, offer: Offer) -> float:
        """Return the deadline for sending the command (CLOCK_MONOTONIC, ns); 0 if it was cancelled."""
        # read before CLOCK_BOOTTIME, because a pause between the two reads must not make the deadline later
        now_ns = time.monotonic_ns()
        return 0 if offer.why_void else now_ns + self.offers.left_ns(offer)

    def _refusal(self, offer: Offer) -> CommandResult | None:
        why = self._why_not(offer)
        return CommandResult(CommandOutcome.NOT_SENT, offer.unsent(why).text) if why else None

    def _why_not(self, offer: Offer) -> str:
        """Return why the command must not be sent now; "" if it may be sent."""
        line = offer.held.name
        if offer.why_void:
            return offer.why_void
        if self._lines.for_command(line) is not offer.held:
            return f"line {line} was released, or its plant has changed, since the offer"
        if self._under_way[line] > MOST_WRITES:
            return f"{MOST_WRITES} other commands are under way on line {line}"
        return self.offers.why_late(offer)

    async def _note(self, offer: Offer, step: str, more: Mapping[str, Any]) -> None:
        request = offer.request
        record = {"step": step, "id": request.id, "line": offer.held.name, "drive": request.drive}
        await self._log.note(
            record | {"what": offer.prepared.text, "by": request.by, **more, "gateway": self.gateway}
        )


def _prepared(held: HeldLine, request: CommandRequest) -> Prepared:
    drive = held.drive(request.drive)
    if request.verb == "stop":
        raise ValueError("a stop needs no confirmation; send it to the line's subject for stops")
    kind = "write" if request.register else "verbs"
    if request.entry not in held.may[kind]:
        raise ValueError(
            f'the plant file does not allow {request.entry} for the fleet. Add {kind} = ["{request.entry}"] '
            "to its table [fleet.may], and run `multidrop fleet init` again"
        )
    return prepare(drive, request)


class StopDesk:
    """Stops drives of this gateway's lines, and cancels the drives' commands that wait for confirmation."""

    def __init__(self, gateway: str, lines: HeldLines, offers: Offers, log: CommandLog) -> None:
        self.gateway = gateway
        self._lines = lines
        self._offers = offers
        self._log = log
        # running stops, by the line's `HeldLine.number` and the bytes of the stop's message
        self._stops: dict[tuple[int, object], asyncio.Future[CommandAnswer]] = {}
        self._joined = JoinedStops()
        self._repeated = RepeatedStops()

    async def stop(self, line: str, data: bytes) -> CommandAnswer | None:
        """Stop drives of a line now; return None unless this gateway is the line's master.

        A damaged message stops all drives of the line. A copy of a message gets the answer to the first copy;
        a message without an id is always a new stop.

        A stop that takes longer than HOLD_S is answered with "under way" and its progress; the sender then
        asks again. Return None if a motor still runs and this gateway has released or lost the line: the
        line's next master answers.
        """
        held = self._lines.for_stop(line)
        if held is None:
            return None
        request, why_all = read_stop(data)
        if why_all:
            _log.warning(
                "stopping all drives of line %s, because a stop message is damaged: %s", line, why_all
            )
        if request.drives is not None:
            request = request._replace(drives=tuple(drive_meant(one, held.drives) for one in request.drives))
        key = (held.number, sha256(data).digest() if request.id else object())
        if key not in self._stops:
            self._offers.void(held.name, request.drives, CALLED)
            self._stops[key] = self._joined.begin(
                (held.number, request.drives),
                lambda: supervisor().start("stop", self._stop_or_report(held, request)),
            )
            while len(self._stops) > STOPS_REMEMBERED:
                del self._stops[next(iter(self._stops))]
        task = self._stops[key]
        await asyncio.wait({task}, timeout=HOLD_S)
        if not task.done():
            return self._so_far(held, request)
        answer = task.result()
        is_ours = self._lines.for_stop(line) is held and not held.is_leaving
        return answer if answer.ok or is_ours else None

    def _so_far(self, held: HeldLine, request: StopRequest) -> CommandAnswer:
        asked = held.drives if request.drives is None else request.drives
        known = held.bus.stops_under_way()
        drives = {
            name: CommandAnswer(CommandOutcome.UNDER_WAY, known[name]) for name in asked if name in known
        }
        text = "; ".join(answer.text for answer in drives.values())
        text = text or f"line {held.name}: a stop is under way"
        return CommandAnswer(CommandOutcome.UNDER_WAY, text, self.gateway, drives=drives)

    async def _stop_or_report(self, held: HeldLine, request: StopRequest) -> CommandAnswer:
        try:
            return await self._stop(held, request)
        except Exception as failure:
            _log.exception("a stop on line %s, asked for by %s", held.name, request.by)
            text = f"it is not known whether the stop was sent: {type(failure).__name__}: {failure}"
            return CommandAnswer(CommandOutcome.UNKNOWN, text, self.gateway)

    async def _stop(self, held: HeldLine, request: StopRequest) -> CommandAnswer:
        """Stop the drives in parallel.

        If an earlier stop of a drive is still being repeated, send one more stop command.
        """
        drives = held.drives
        asked = list(drives) if request.drives is None else list(dict.fromkeys(request.drives))
        stopped = [drives[name] for name in asked if name in drives]
        whole = partial(stop_line, lambda: held.bus, [*drives]) if len(stopped) == len(drives) else None
        with written_by(request.by, WAY):
            waited = self._repeated.begin([LineStop(stopped, whole)])
        printed = [spelt(name) for name in asked]
        _log.warning("stop of %s, asked for by %s", ", ".join(printed), request.by)
        record = {"id": request.id, "line": held.name, "what": "stop", "drives": printed, "by": request.by}
        self._note({"step": "begun", **record, "gateway": self.gateway})
        there = f"line {held.name} has no such drive; it has {', '.join(drives) or 'none'}"
        missing = CommandAnswer(CommandOutcome.REFUSED, f"no stop was sent: {there}")
        found = {name: missing for name in asked if name not in drives}
        for results in await asyncio.gather(*waited):
            found |= {name: CommandAnswer.of(name, result) for name, result in results.items()}
        text = "; ".join(answer.text for answer in found.values()) or f"line {held.name} has no drives"
        answer = CommandAnswer(worst(list(found.values())), text, self.gateway, drives=found)
        self._note({"step": "over", **record, **answer.as_json()})
        return answer

    def _note(self, record: Mapping[str, Any]) -> None:
        """Log a record of a stop in a task, after all earlier records."""
        supervisor().start("note of a stop", self._write(record))

    async def _write(self, record: Mapping[str, Any]) -> None:
        try:
            await self._log.note(record)
        except Exception as failure:
            _log.warning("a stop was not written to the log of commands: %s", failure)


# ---- NATS ----

Handler = Callable[[bytes], Awaitable[Offered | CommandAnswer | None]]


class CommandSubjects:
    """A gateway's NATS subscriptions for commands and stops."""

    def __init__(self, gateway: str, paths: Sequence[ServerPath], lines: HeldLines, log: CommandLog) -> None:
        self._paths = paths
        self._lines = lines
        self.desk = CommandDesk(gateway, names.do_subject(gateway, secrets.token_hex(8)), lines, log)
        self._stops = StopDesk(gateway, lines, self.desk.offers, log)

    async def begin(self) -> None:
        """Subscribe to the subject on which users confirm the commands that this gateway has checked."""
        await self._subscribe(self.desk.subject, self.desk.do)

    def open(self, line: str, description: Any) -> None:
        self._lines.open(line, description)
        self._change(self._subscribe(names.command_subject(line), partial(self._offer, line)))
        self._change(self._subscribe(names.stop_subject(line), partial(self._stops.stop, line)))

    def leave(self, line: str) -> None:
        self._lines.leave(line)
        self._change(self._unsubscribe(names.command_subject(line)))

    def shut(self, line: str) -> None:
        self._lines.shut(line)
        self._change(self._unsubscribe(names.command_subject(line), names.stop_subject(line)))

    async def _offer(self, line: str, data: bytes) -> Offered | CommandAnswer | None:
        return self.desk.offer(line, data)

    async def _subscribe(self, subject: str, handler: Handler) -> None:
        async def take(message: Msg) -> None:
            # in a task, so that a slow answer does not delay the next message
            supervisor().start("answer", _answer(message, handler))

        await asyncio.gather(*(path.subscribe(subject, take) for path in self._paths))

    async def _unsubscribe(self, *subjects: str) -> None:
        await asyncio.gather(*(path.unsubscribe(one) for path in self._paths for one in subjects))

    def _change(self, work: Coroutine[Any, Any, None]) -> None:
        """Change subscriptions in a task. If this fails, the gateway ends, because it could miss stops."""

        async def change() -> None:
            try:
                await work
            except Exception as failure:
                supervisor().note_dead("commands", f"{type(failure).__name__}: {failure}", failure)

        supervisor().start("subjects", change())


async def _answer(message: Msg, handler: Handler) -> None:
    try:
        answer = await handler(message.data)
    except Exception:
        _log.exception("a message to %s", message.subject)
        return
    if answer is None or not names.is_inbox(message.reply):
        return
    data = json.dumps(answer.as_json()).encode() if isinstance(answer, CommandAnswer) else encode(answer)
    with suppress(Exception):  # the sender may have disconnected
        await message.respond(data)
