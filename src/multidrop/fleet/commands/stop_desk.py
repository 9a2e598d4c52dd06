"""StopDesk: stop drives immediately on the lines of which this gateway is master.

A stop needs no offer and no permission in the plant's list, because a repeated stop is harmless, but a late
one may do harm. It is sent first and recorded afterwards.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Mapping
from functools import partial
from hashlib import sha256
from typing import Any

from multidrop.control import written_by
from multidrop.control.commands import LineStop, RepeatedStops, stop_line
from multidrop.fleet.commands.desk import HOLD_S, WAY
from multidrop.fleet.commands.log import CommandLog
from multidrop.fleet.commands.messages import (
    CommandAnswer,
    CommandOutcome,
    StopRequest,
    read_stop,
    spelt,
    worst,
)
from multidrop.fleet.commands.offers import Offers
from multidrop.fleet.lines.held_lines import HeldLine, HeldLines
from multidrop.plant import drive_meant
from multidrop.supervisor import supervisor

REMEMBERED = 1000  # limit of stops in memory; the oldest are removed
CALLED = "a stop was called"

_log = logging.getLogger("multidrop.fleet")


class StopDesk:
    """Carries out stops on this gateway's lines; each makes earlier offers for its drives void."""

    def __init__(self, gateway: str, lines: HeldLines, offers: Offers, log: CommandLog) -> None:
        self.gateway = gateway
        self._lines = lines
        self._offers = offers
        self._log = log
        self._stops: dict[tuple[int, object], asyncio.Task[CommandAnswer]] = {}  # by line and message
        self._repeated = RepeatedStops()

    async def stop(self, line: str, data: bytes) -> CommandAnswer | None:
        """Stop drives of a line now; return None unless this gateway is its master.

        A damaged message stops all drives. A copy of a message gets the answer of the same stop; a message
        without an id is always a new stop. A stop that takes longer than HOLD_S is answered with "under way"
        and its progress, and the sender asks again. If this gateway has lost or released the line since,
        return None unless the motors have stopped: the next master answers.
        """
        held = self._lines.for_stop(line)
        if held is None:
            return None
        request, why_all = read_stop(data)
        if why_all:
            _log.warning("a stop is one of all drives of line %s, because %s", line, why_all)
        if request.drives is not None:
            request = request._replace(drives=tuple(drive_meant(one, held.drives) for one in request.drives))
        key = (held.number, sha256(data).digest() if request.id else object())
        if key not in self._stops:
            self._stops[key] = supervisor().start("stop", self._stop_or_report(held, request))
            while len(self._stops) > REMEMBERED:
                del self._stops[next(iter(self._stops))]
        task = self._stops[key]
        await asyncio.wait({task}, timeout=HOLD_S)
        if not task.done():
            return self._so_far(held, request)
        answer = task.result()
        is_ours = self._lines.for_stop(line) is held and not held.is_leaving
        return answer if answer.ok or is_ours else None

    def _so_far(self, held: HeldLine, request: StopRequest) -> CommandAnswer:
        names = held.drives if request.drives is None else request.drives
        known = held.bus.stops_under_way()
        drives = {
            name: CommandAnswer(CommandOutcome.UNDER_WAY, known[name]) for name in names if name in known
        }
        text = "; ".join(answer.text for answer in drives.values())
        text = text or f"line {held.name}: a stop is under way"
        return CommandAnswer(CommandOutcome.UNDER_WAY, text, self.gateway, drives=drives)

    async def _stop_or_report(self, held: HeldLine, request: StopRequest) -> CommandAnswer:
        """Carry out a stop. Log an unexpected exception, and return it as the answer."""
        try:
            return await self._stop(held, request)
        except Exception as failure:
            _log.exception("a stop on line %s, asked for by %s", held.name, request.by)
            text = f"it is not known whether the stop was sent: {type(failure).__name__}: {failure}"
            return CommandAnswer(CommandOutcome.UNKNOWN, text, self.gateway)

    async def _stop(self, held: HeldLine, request: StopRequest) -> CommandAnswer:
        """Stop the drives in parallel. If a drive's stop is being repeated already, send one more stop."""
        self._offers.void(held.name, request.drives, CALLED)
        drives = held.drives
        names = list(drives) if request.drives is None else list(dict.fromkeys(request.drives))
        asked = [drives[name] for name in names if name in drives]
        whole = partial(stop_line, lambda: held.bus, [*drives]) if len(asked) == len(drives) else None
        with written_by(request.by, WAY):
            waited = self._repeated.begin([LineStop(asked, whole)])
        printed = [spelt(name) for name in names]
        _log.warning("stop of %s, asked for by %s", ", ".join(printed), request.by)
        record = {"id": request.id, "line": held.name, "what": "stop", "drives": printed, "by": request.by}
        self._note({"step": "begun", **record, "gateway": self.gateway})
        there = f"line {held.name} has no such drive; it has {', '.join(drives) or 'none'}"
        missing = CommandAnswer(CommandOutcome.REFUSED, f"no stop was sent: {there}")
        found = {name: missing for name in names if name not in drives}
        for results in await asyncio.gather(*waited):
            found |= {name: CommandAnswer.of(name, result) for name, result in results.items()}
        text = "; ".join(answer.text for answer in found.values()) or f"line {held.name} has no drives"
        answer = CommandAnswer(worst(list(found.values())), text, self.gateway, drives=found)
        self._note({"step": "over", **record, **answer.as_json()})
        return answer

    def _note(self, record: Mapping[str, Any]) -> None:
        """Write a record in a task; records are in the order of the calls."""
        supervisor().start("note of a stop", self._write(record))

    async def _write(self, record: Mapping[str, Any]) -> None:
        try:
            await self._log.note(record)
        except Exception as failure:
            _log.warning("a stop is not in the log of commands: %s", failure)
