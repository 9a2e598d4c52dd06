"""The commands that an MQTT broker delivers: which commands are carried out, and the report of each result.

A broker may delay, retain and duplicate messages. So a write or a verb is carried out only if it is not a
copy and was sent at most MOST_AGE_S ago. It must also have been sent after the latest stop of its drive and
the latest reload of the plant file. A verb that stops the motor is always carried out.
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import Callable, Coroutine, Mapping, Sequence
from typing import Any

from multidrop.control import CommandOutcome, CommandResult
from multidrop.control.commands import JoinedStops
from multidrop.core import boottime_ns
from multidrop.gateway.commands import MOST_AGE_S, Commands
from multidrop.gateway.http.rights import Caller
from multidrop.supervisor import supervisor

# age limit of commands, in ms: a broker that was suspended delivers many old messages when it resumes
MOST_AGE_MS = round(MOST_AGE_S * 1e3)
MOST_AHEAD_MS = 2_000  # in ms: how far a sender's clock may be ahead of the gateway's
MOST_COMMANDS = 16  # limit of concurrent commands; stops are not counted
KEPT_COMMANDS = 1_000  # number of newest commands that are kept, to recognise copies

_log = logging.getLogger("multidrop.gateway.mqtt.part")
# a function that is called with the drive, the command's text, its result and its id
Report = Callable[[str, str, CommandResult, str], None]


class BrokerCommands:
    """Checks commands and carries them out. `report` is called with each result.

    `utc_ms` returns the present time (UTC) in ms.
    """

    def __init__(self, commands: Commands, caller: Caller, utc_ms: Callable[[], int], report: Report) -> None:
        self._commands = commands
        self._caller = caller
        self._utc_ms = utc_ms
        self._report = report
        self._came: deque[object] = deque(maxlen=KEPT_COMMANDS)
        self._under_way = 0
        self._stops = JoinedStops()

    def stop(self, drives: Sequence[str] | None, given_id: object = None) -> None:
        """Stop these drives, or all drives if None."""
        caller = self._caller.stopping(given_id)
        self._stops.begin(("stop", drives and tuple(drives)), lambda: self._begin(self._stop(drives, caller)))

    def stop_by(self, drive: str, verb: str, options: Mapping[str, object], given_id: object = None) -> None:
        """Carry out a verb that stops the motor, however old the command is."""
        caller = self._caller.stopping(given_id)

        def start() -> asyncio.Task[None]:
            return self._begin(
                self._do(drive, verb, caller, self._commands.act(drive, verb, options, caller))
            )

        self._stops.begin((verb, drive), start)

    def write(self, drive: str, register: str, value: float, time_ms: int, given_id: object = None) -> None:
        """Write a register, or report why the command is refused, for example because it is too old.

        Raises ValueError for an invalid id.
        """
        what, caller = f"{register} = {value!r}", self._caller.commanding(given_id)
        until_ns = self._admit(drive, what, (drive, register, value, time_ms), time_ms, caller)
        if until_ns is not None:
            work = self._commands.write(drive, register, value, caller, lambda what: until_ns)
            self._begin(self._counted(self._do(drive, what, caller, work)))

    def act(
        self, drive: str, verb: str, options: Mapping[str, object], time_ms: int, given_id: object = None
    ) -> None:
        """Carry out a verb, or report why the command is refused, for example because it is too old.

        Raises ValueError for an invalid id.
        """
        caller = self._caller.commanding(given_id)
        until_ns = self._admit(drive, verb, (drive, verb, repr(options), time_ms), time_ms, caller)
        if until_ns is not None:
            work = self._commands.act(drive, verb, options, caller, lambda what: until_ns)
            self._begin(self._counted(self._do(drive, verb, caller, work)))

    def refuse(self, drive: str, what: str, why: str, given_id: object = None) -> None:
        """Report that a command was not carried out, and why."""
        command = self._caller.stopping(given_id).command
        _log.warning("%s of %s (command %s) was not carried out: %s", what, drive, command, why)
        self._report(drive, what, CommandResult(CommandOutcome.FAILED, f"not sent: {why}"), command)

    @staticmethod
    def _may_be_before(at_ns: int | None, now_ns: int, age_ms: int) -> bool:
        """Return True if a command that is `age_ms` old at `now_ns` may have been sent before `at_ns`.

        The sender's clock may be ahead by MOST_AHEAD_MS. If `at_ns` is None, return False.
        """
        if at_ns is None:
            return False
        return (now_ns - at_ns) // 1_000_000 <= age_ms + MOST_AHEAD_MS

    def _admit(self, drive: str, what: str, command: object, time_ms: int, caller: Caller) -> float | None:
        """Return the deadline for sending a command (CLOCK_BOOTTIME, ns).

        If the command must not be sent, report why, and return None.
        """
        now_ns = boottime_ns()  # read before UTC, so that a pause in between makes the command older
        age_ms = self._utc_ms() - time_ms
        why = self._why_not(drive, command, now_ns, age_ms)
        if why:
            self.refuse(drive, what, why, caller.command)
            return None
        self._came.append(command)
        self._under_way += 1  # counted before the task starts, because many commands may arrive at once
        return now_ns + (MOST_AGE_MS - age_ms) * 1_000_000

    def _why_not(self, drive: str, command: object, now_ns: int, age_ms: int) -> str:
        """Return why a command that is `age_ms` old now must not be carried out; "" if it may be.

        `now_ns` is the present time of CLOCK_BOOTTIME.
        """
        if not -MOST_AHEAD_MS <= age_ms <= MOST_AGE_MS:
            clocks = "by the clocks of sender and gateway"
            return f"the command was sent {age_ms / 1000:.1f} s ago {clocks}"
        if self._may_be_before(self._commands.stopped_ns(drive), now_ns, age_ms):
            return "the command may have been sent before the latest stop: send it again"
        if self._may_be_before(self._commands.plant_ns, now_ns, age_ms):
            return "the command may have been sent before the plant was reloaded: send it again"
        if command in self._came:
            return "the command is a copy of an earlier one"
        if self._under_way >= MOST_COMMANDS:
            return f"{MOST_COMMANDS} other commands are under way"
        return ""

    async def _stop(self, drives: Sequence[str] | None, caller: Caller) -> None:
        for drive, result in (await self._commands.stop(drives, caller)).items():
            self._report(drive, "stop", result, caller.command)

    async def _do(
        self, drive: str, what: str, caller: Caller, work: Coroutine[Any, Any, CommandResult]
    ) -> None:
        self._report(drive, what, await work, caller.command)

    async def _counted(self, work: Coroutine[Any, Any, None]) -> None:
        try:
            await work
        finally:
            self._under_way -= 1

    def _begin(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        return supervisor().start("broker command", work)
