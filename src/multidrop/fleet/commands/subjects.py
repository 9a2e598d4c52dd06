"""CommandSubjects: receive commands and stops from NATS on all paths of a gateway, and answer them.

A gateway subscribes to a line's subjects only while it polls the line. For a line without a master, the
server therefore reports to a sender that there is no receiver. Each message arrives once on each path;
CommandDesk and StopDesk recognise copies by the id that the sender chose. No stream stores these
messages.
"""

from __future__ import annotations

import asyncio
import json
import logging
import secrets
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

from nats.aio.msg import Msg

from multidrop.fleet.commands.desk import CommandDesk, StopDesk
from multidrop.fleet.commands.held_lines import HeldLines
from multidrop.fleet.commands.log import CommandLog
from multidrop.fleet.commands.messages import CommandAnswer, Offered, encode
from multidrop.fleet.lines.fleet_lines import FleetLines
from multidrop.fleet.lines.line_keeper import PortLoss
from multidrop.fleet.servers import names
from multidrop.fleet.servers.connections import ServerPath
from multidrop.supervisor import supervisor

_log = logging.getLogger("multidrop.fleet")
Heard = Callable[[bytes], Awaitable[Offered | CommandAnswer | None]]


class CommandSubjects:
    """The subscriptions for commands and stops, in one run of a gateway."""

    def __init__(self, gateway: str, paths: Sequence[ServerPath], lines: HeldLines, log: CommandLog) -> None:
        self._paths = paths
        self._lines = lines
        self.desk = CommandDesk(gateway, names.do_subject(gateway, secrets.token_hex(8)), lines, log)
        self._stops = StopDesk(gateway, lines, self.desk.offers, log)

    async def begin(self) -> None:
        """Subscribe to the subject on which senders return this process's tokens."""
        await self._subscribe(self.desk.subject, self.desk.do)

    def open(self, line: str, description: Any) -> None:
        """Accept commands and stops for a line from now on."""
        self._lines.open(line, description)
        self._change(self._subscribe(names.command_subject(line), partial(self._offer, line)))
        self._change(self._subscribe(names.stop_subject(line), partial(self._stops.stop, line)))

    def leave(self, line: str) -> None:
        """Accept only stops for a line from now on."""
        self._lines.leave(line)
        self._change(self._unsubscribe(names.command_subject(line)))

    def shut(self, line: str) -> None:
        """Accept neither commands nor stops for a line from now on."""
        self._lines.shut(line)
        self._change(self._unsubscribe(names.command_subject(line), names.stop_subject(line)))

    async def _offer(self, line: str, data: bytes) -> Offered | CommandAnswer | None:
        return self.desk.offer(line, data)

    async def _subscribe(self, subject: str, heard: Heard) -> None:
        async def take(message: Msg) -> None:
            # in a task, so that messages do not wait for each other
            supervisor().start("answer", _answer(message, heard))

        await asyncio.gather(*(path.subscribe(subject, take) for path in self._paths))

    async def _unsubscribe(self, *subjects: str) -> None:
        await asyncio.gather(*(path.unsubscribe(one) for path in self._paths for one in subjects))

    def _change(self, work: Coroutine[Any, Any, None]) -> None:
        """Change subscriptions in a task. A failure ends the gateway, because it could miss stops."""

        async def change() -> None:
            try:
                await work
            except Exception as failure:
                supervisor().note_dead("commands", f"{type(failure).__name__}: {failure}", failure)

        supervisor().start("subjects", change())


async def _answer(message: Msg, heard: Heard) -> None:
    try:
        answer = await heard(message.data)
    except Exception:
        _log.exception("a message to %s", message.subject)
        return
    if answer is None or not names.is_inbox(message.reply):
        return
    data = json.dumps(answer.as_json()).encode() if isinstance(answer, CommandAnswer) else encode(answer)
    with suppress(Exception):  # the sender may have disconnected
        await message.respond(data)


class CommandedLines:
    """Polls lines, and accepts commands for a line while it is polled.

    `may_wait` returns True until the lines must be closed because the lease is about to expire.
    """

    def __init__(
        self, lines: FleetLines, subjects: CommandSubjects, may_wait: Callable[[], bool] = lambda: False
    ) -> None:
        self._lines = lines
        self._subjects = subjects
        self._may_wait = may_wait

    async def take(self, line: str, description: Any) -> None:
        """Poll a line and accept commands for it. If that raises, the line is closed again."""
        await self._lines.take(line, description)
        try:
            self._subjects.open(line, description)
        except BaseException:
            await self.let_go(line)
            raise

    def port_loss(self, line: str) -> PortLoss | None:
        return self._lines.port_loss(line)

    async def let_go(self, line: str) -> None:
        """Accept no more commands for the line, stop polling it, and close it.

        Closing waits for stops in progress, so that their senders get answers. It also waits a short time for
        commands in progress, because their results would otherwise stay unknown.
        """
        self._subjects.leave(line)
        try:
            await self._subjects.desk.await_commands(line, self._may_wait)
            await self._lines.let_go(line)
        finally:
            self._subjects.shut(line)
