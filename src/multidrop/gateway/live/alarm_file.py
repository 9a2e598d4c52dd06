"""The file that keeps alarms. A thread of its own uses the disk, so that polling never waits for it."""

from __future__ import annotations

import json
import threading
import time
from collections import deque
from pathlib import Path
from queue import Empty, Full, Queue
from typing import Any

from multidrop.gateway.live.alarms import KINDS, MOST_ENDED, Alarm
from multidrop.whole_file import whole_file

MOST_WAITING = 10_000  # limit of alarms that wait to be written
MOST_BYTES = 4 << 20  # in bytes: a longer file is rewritten with only the newest alarms
SLOW_S = 10.0  # a disk access that takes longer than this (in s) is reported
CLOSE_S = 2.0  # time limit, in s, for writing the last alarms at shutdown


class AlarmFile:
    """A file of alarms as JSON lines. If several lines are about one alarm, the last line counts.

    All disk access is in `run`, which needs its own thread. No method raises.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        # alarms of earlier runs of the gateway; None until they are read
        self.past: list[Alarm] | None = None
        self._failure = ""
        self._since = time.monotonic()  # when the present disk access started, in s; inf if there is none
        self._waiting: Queue[Alarm | None] = Queue(MOST_WAITING)
        self._ended = threading.Event()

    @property
    def trouble(self) -> str:
        """The reason why alarms cannot be written now; "" if they can."""
        if time.monotonic() - self._since > SLOW_S:
            return f"alarms are not kept: {self.path} has not been written for {SLOW_S:g} s"
        return f"alarms are not kept: {self._failure}" if self._failure else ""

    def note(self, alarm: Alarm) -> None:
        """Queue an alarm that started, ended or changed, to be written."""
        try:
            self._waiting.put_nowait(alarm)
        except Full:
            self._failure = f"{MOST_WAITING} alarms wait for {self.path} already"

    def close(self) -> None:
        """Write the queued alarms, waiting at most CLOSE_S for the disk."""
        try:
            self._waiting.put_nowait(None)
        except Full:
            return
        self._ended.wait(CLOSE_S)

    # ---- on the thread ----

    def run(self) -> None:
        """Read the alarms of earlier runs, then write the queued alarms until `close` is called."""
        try:
            self._keep()
        finally:
            self._ended.set()

    def _keep(self) -> None:
        known: dict[str, Alarm] = {}
        try:
            known = _read(self.path)
        except OSError as failure:
            self._note_failure(failure)
        self.past = list(known.values())
        self._since = float("inf")
        while alarms := self._waiting_alarms():
            self._since = time.monotonic()
            changed = [alarm for alarm in alarms if alarm is not None]
            known |= {alarm.id: alarm for alarm in changed}
            known = _newest(known)
            try:
                self._write(changed, known)
                self._failure = ""
            except OSError as failure:
                self._note_failure(failure)
            self._since = float("inf")
            if None in alarms:
                return

    def _note_failure(self, failure: OSError) -> None:
        self._failure = f"{self.path}: {failure.strerror or failure}"

    def _waiting_alarms(self) -> list[Alarm | None]:
        found = [self._waiting.get()]
        while True:
            try:
                found.append(self._waiting.get_nowait())
            except Empty:
                return found

    def _write(self, changed: list[Alarm], known: dict[str, Alarm]) -> None:
        """Append the changed alarms; after a failure, or if the file is too long, rewrite the whole file."""
        is_whole = not self._failure and (not self.path.exists() or self.path.stat().st_size <= MOST_BYTES)
        if is_whole:
            with self.path.open("a", encoding="utf-8") as file:
                file.writelines(map(_line, changed))
            return
        with whole_file(self.path) as part:
            part.write_text("".join(map(_line, known.values())), "utf-8")


def _line(alarm: Alarm) -> str:
    """Return the alarm's line.

    It starts with a newline, because a power cut may have truncated the line before it.
    """
    return f"\n{json.dumps(alarm.as_json())}\n"


def _newest(known: dict[str, Alarm]) -> dict[str, Alarm]:
    """Return the active alarms and the newest ended ones."""
    ended = [name for name, alarm in known.items() if alarm.ended is not None]
    forgotten = {*ended[: max(0, len(ended) - MOST_ENDED)]}
    return {name: alarm for name, alarm in known.items() if name not in forgotten}


def _read(path: Path) -> dict[str, Alarm]:
    found: dict[str, Alarm] = {}
    try:
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - 2 * MOST_BYTES))
            lines: deque[bytes] = deque(file.read(2 * MOST_BYTES).splitlines())
    except FileNotFoundError:
        return found
    for line in lines:
        if (alarm := alarm_in(line)) is not None:
            found.pop(alarm.id, None)
            found[alarm.id] = alarm
    return _newest(found)


def alarm_in(line: bytes) -> Alarm | None:
    """Return the alarm in a line; None if the line is invalid, for example truncated."""
    try:
        given: Any = json.loads(line)
        alarm = Alarm(**{name: given[name] for name in Alarm._fields})
    except (ValueError, TypeError, KeyError, RecursionError):
        return None
    texts = (alarm.drive, alarm.text, alarm.line, alarm.by, alarm.note)
    times = [one for one in (alarm.ended, alarm.acknowledged) if one is not None]
    is_right = all(isinstance(text, str) for text in texts) and alarm.kind in KINDS
    is_timed = all(type(one) is int for one in (alarm.time, *times))
    return alarm if is_right and is_timed else None
