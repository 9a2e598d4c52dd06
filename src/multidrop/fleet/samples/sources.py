"""SourceCheck: the check that no message of a log is missing, or there twice."""

from __future__ import annotations

import logging
from collections.abc import Mapping

from multidrop.fleet.samples.sample_reader import StreamMessage

_log = logging.getLogger("multidrop.fleet.samples.hub")


class SourceCheck:
    """The last sequence of each log; alarms are logged as errors and counted."""

    def __init__(self, last: Mapping[str, int]) -> None:
        self.last = dict(last)  # by "gateway.log id"
        self.alarms = 0
        self.missing = 0  # messages
        self.doubled = 0  # messages that were left out
        self._lost: dict[str, int] = {}  # rows, by what each gateway says of itself

    def take(self, message: StreamMessage) -> bool:
        """Return True for a message that is to be kept; one that was there already is left out."""
        name = f"{message.gateway}.{message.log}"
        if message.sequence == 0:
            self.alarm(f"message {message.place} of the stream, by {name}, has no number and is left out")
            return False
        before = self.last.get(name, 0)
        if message.sequence <= before:
            self.doubled += 1
            self.alarm(f"{name}: message {message.sequence} came again behind {before} and is left out")
            return False
        if message.sequence > before + 1:
            self.missing += message.sequence - before - 1
            self.alarm(f"{name}: messages {before + 1} to {message.sequence - 1} are missing")
        if message.lost > self._lost.get(name, 0):
            self.alarm(f"{name}: its spool has lost {message.lost} rows since it began")
        self._lost[name] = message.lost
        self.last[name] = message.sequence
        return True

    def alarm(self, sentence: str) -> None:
        """Log and count something that must never happen."""
        self.alarms += 1
        _log.error("%s", sentence)
