"""CommandDesk: carry out commands on the lines of which this gateway is master, each once.

The gateway checks a command and offers to carry it out. It does so if the sender returns the offer's token
within a second of this computer's CLOCK_BOOTTIME. The command is recorded on the disk before it is sent, and
again at its end.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

from multidrop import Unsupported
from multidrop.control import CommandResult, written_by
from multidrop.control.commands import begin_command
from multidrop.fleet.commands.log import CommandLog
from multidrop.fleet.commands.messages import (
    CommandAnswer,
    CommandOutcome,
    CommandRequest,
    Offered,
    read_command,
    read_json,
)
from multidrop.fleet.commands.offers import Offer, Offers, Prepared, prepare
from multidrop.fleet.leases.lease import boottime_ns
from multidrop.fleet.lines.held_lines import HeldLine, HeldLines
from multidrop.supervisor import supervisor

HOLD_S = 0.5  # wait this long for the result before answering "under way"
AWAITED_S = 3.0  # releasing a line waits this long for commands; most writes and read-backs are faster
POLL_S = 0.01  # between checks whether these commands have ended
MOST_WRITES = 8  # concurrent writes on one line; stops are not counted
WAY = "fleet"  # the sender's way in the audit log

_log = logging.getLogger("multidrop.fleet")


class CommandDesk:
    """Offers and carries out commands on this gateway's lines; senders return tokens on `subject`."""

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
        self._under_way: dict[str, int] = {}  # number of commands in progress, by line

    # ---- offering a command ----

    def offer(self, line: str, data: bytes) -> Offered | CommandAnswer | None:
        """Return an offer or a refusal; None unless this gateway is the line's master.

        The sender uses the first answer, so only the master may give one.
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

    # ---- carrying it out ----

    async def do(self, data: bytes) -> CommandAnswer:
        """Carry out an offered command once; a copy of the message gets the same answer.

        A message with `ask` instead of `do` asks for the result. If it comes before any `do`, the offer is
        withdrawn, so that the answer "not sent" stays true.
        """
        try:
            message = read_json(data)
        except ValueError as mistake:
            return CommandAnswer(CommandOutcome.REFUSED, str(mistake), self.gateway)
        token = message.get("do", message.get("ask"))
        offer = self.offers.find(token) if isinstance(token, str) else None
        if offer is None:
            sentence = "no offer with this token is known here, and nothing is sent for it now"
            return CommandAnswer(CommandOutcome.UNKNOWN, sentence, self.gateway)
        if "do" not in message:
            self.offers.withdraw(offer, "its asker asked for the result before confirming it")
        elif self.offers.take(offer):
            supervisor().start("command", self._carry_out(offer))
        with suppress(TimeoutError):
            await asyncio.wait_for(offer.over.wait(), HOLD_S)
        found = offer.answer or CommandAnswer(CommandOutcome.UNDER_WAY, f"{offer.prepared.text}: under way")
        return found._replace(gateway=self.gateway)

    async def await_commands(self, line: str, may_wait: Callable[[], bool]) -> None:
        """Wait for the commands in progress on a line that is being released.

        Wait for AWAITED_S at most, and only while `may_wait` returns True.
        """
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
        """Return until when the command may be sent (CLOCK_MONOTONIC, ns); 0 once its offer is void."""
        now_ns = time.monotonic_ns()  # read first, so a pause before the next read shortens the limit
        return 0 if offer.why_void else now_ns + self.offers.left_ns(offer)

    def _refusal(self, offer: Offer) -> CommandResult | None:
        why = self._why_not(offer)
        return CommandResult(CommandOutcome.NOT_SENT, offer.unsent(why).text) if why else None

    def _why_not(self, offer: Offer) -> str:
        """Return why the command must not be sent now; "" if it may."""
        line = offer.held.name
        if offer.why_void:
            return offer.why_void
        if self._lines.for_command(line) is not offer.held:
            return f"since the offer line {line} was released, or its plant has changed"
        if self._under_way[line] > MOST_WRITES:
            return f"{MOST_WRITES} others are under way on line {line}"
        return self.offers.why_late(offer)

    async def _note(self, offer: Offer, step: str, more: Mapping[str, Any]) -> None:
        request = offer.request
        record = {"step": step, "id": request.id, "line": offer.held.name, "drive": request.drive}
        await self._log.note(
            record | {"what": offer.prepared.text, "by": request.by, **more, "gateway": self.gateway}
        )


def _prepared(held: HeldLine, request: CommandRequest) -> Prepared:
    """Check a request, and return the command. Raises ValueError if the plant does not allow it."""
    drive = held.drive(request.drive)
    if request.verb == "stop":
        raise ValueError("a stop needs no offer: it goes to the line's own subject of stops")
    kind = "write" if request.register else "verbs"
    if request.entry not in held.may[kind]:
        raise ValueError(
            f'{request.entry} is not in the plant\'s list; add it to {kind} = ["{request.entry}"] of '
            "[fleet.may], and run `multidrop fleet init` again"
        )
    return prepare(drive, request)
