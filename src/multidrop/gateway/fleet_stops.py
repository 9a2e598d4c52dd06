"""FleetStops: the commands of a gateway whose lines are polled by a fleet. The only command is a stop."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from math import inf
from typing import Any

from multidrop import Plant, WriteForbidden
from multidrop.control import CommandOutcome, CommandResult
from multidrop.gateway.commands import Admit, Commands, PolledLines, denied, drives_of
from multidrop.gateway.http.rights import NOT_LISTED, Caller, May, Right

ONLY_STOPS = "this page only stops a fleet's drives; use `multidrop fleet {}`"
NOT_STARTED = "the stop was NOT sent: the fleet's part has not started; use the hard-wired stop"
WHOLE = "the fleet"  # key of the whole fleet's result in the answer to a stop


class FleetStops(Commands):
    """Stops the drives of a fleet through the gateway's part `fleet`; refuses all other commands.

    `part` returns the part `fleet`, or None before that part has started.
    """

    def __init__(self, lines: PolledLines, may: May, part: Callable[[], Any]) -> None:
        super().__init__(lines, may)
        self._part = part

    def halts(self, drive: str) -> int | None:
        """Return None: the number of stops is unknown, because other programs stop these motors too.

        Without this number, the gateway raises no alarm when a motor stops.
        """
        return None

    async def stop(self, drives: Sequence[str] | None, caller: Caller) -> dict[str, CommandResult]:
        """Stop these drives. If `drives` is None, stop the whole fleet, even drives unknown to the page."""
        if drives is not None or caller.role < Right.STOP:
            return await super().stop(drives, caller)
        self.called += 1
        self._note_stop(drives_of(self._lines.plant))
        results = await self._stop_by_fleet(None, caller.commanding())
        self._note_end(drives_of(self._lines.plant))
        return results

    async def _stop(self, plant: Plant, wanted: Iterable[str], caller: Caller) -> dict[str, CommandResult]:
        names = list(dict.fromkeys(wanted))
        self._note_stop(names)
        found = await self._stop_by_fleet(names, caller)
        self._note_end(names)
        missing = found.get(WHOLE)
        if missing is None or missing.ok:  # the fleet's answer does not say whether this drive is stopped
            missing = CommandResult(CommandOutcome.UNKNOWN, "the fleet gives no answer for it")
        return {name: found.get(name, missing) for name in names}

    async def _stop_by_fleet(self, drives: Sequence[str] | None, caller: Caller) -> dict[str, CommandResult]:
        part = self._part()
        if part is None:
            return {WHOLE: CommandResult(CommandOutcome.FAILED, NOT_STARTED)}
        answers: Mapping[str, tuple[bool, str]] = await part.stop(caller.by, drives)
        return {
            name: CommandResult(CommandOutcome.DONE if is_done else CommandOutcome.FAILED, text)
            for name, (is_done, text) in answers.items()
        }

    async def write(
        self, drive: str, register: str, value: float, caller: Caller, admit: Admit = lambda what: inf
    ) -> CommandResult:
        """Refuse the write, because a fleet's page can only stop drives."""
        if caller.role < Right.WRITE:
            return denied(caller, Right.WRITE, f"a write of {drive}.{register}")
        return _refused(ONLY_STOPS.format("write"))

    async def act(
        self,
        drive: str,
        verb: str,
        options: Mapping[str, object],
        caller: Caller,
        admit: Admit = lambda what: inf,
    ) -> CommandResult:
        """Carry out a stop; refuse any other verb."""
        if verb == "stop":
            return await super().act(drive, verb, options, caller, admit)
        return _refused(ONLY_STOPS.format(verb.replace("_", "-")))


def _refused(sentence: str) -> CommandResult:
    return CommandResult(CommandOutcome.REFUSED, sentence, WriteForbidden(sentence, rule=NOT_LISTED))
