"""Frames: messages with the plant's state for all viewers, such as pages, at most five a second.

A viewer requests a message only after it has received the previous one, so no queue builds up for a slow
viewer. The request has the number of the viewer's newest message, and the answer has the changes since that
message. If the gateway has deleted that message, the answer is the whole newest message.
"""

from __future__ import annotations

import asyncio
import gzip
import json
from collections import deque
from collections.abc import Callable, Mapping
from math import isfinite
from typing import Any, NamedTuple

from multidrop import WriteForbidden
from multidrop.gateway.commands import MOST_AGE_S, OVERTAKEN, Commands
from multidrop.gateway.live.alarms import LOST, Alarms
from multidrop.gateway.live.hub import Hub, KeptRow
from multidrop.gateway.live.recent_statistics import RecentStatistics
from multidrop.printable import iso_time

LEAST_S = 0.2  # shortest mean time, in s, between two frames
EARLY_S = 0.02  # in s: after a late message, the next one may be early by at most this time
WAIT_S = 20.0  # longest wait, in s, of a request for a new message
MOST_VIEWERS = 200  # limit of concurrently waiting viewers
WHOLE = -1  # message number in the request of a viewer that has no message yet
KEPT = 6  # number of newest messages that are kept, so that viewers up to a second behind get changes only

Times = tuple[int, int]  # one moment in UTC and by CLOCK_MONOTONIC, both in ns
MOST_AGE_NS = round(MOST_AGE_S * 1e9)
# values of the field `rule` of WriteForbidden
TOO_LATE, DOUBLED = "too late", "it came before"
ANOTHER_PLANT = "the plant was read again"


class Encoded(NamedTuple):
    """A message as it is sent to a viewer: the whole message, or only the changes since an earlier one."""

    n: int
    plain: bytes
    gzipped: bytes


def frame_of(
    hub: Hub,
    events: Alarms,
    recent: RecentStatistics,
    stops: Mapping[str, int],
    *,
    n: int,
    revision: int,
    time_ns: int,
) -> dict[str, Any]:
    """Return a message about the plant's present state. `stops` is the number of stops so far, by drive."""
    return {
        "n": n,
        "revision": revision,
        "time": iso_time(time_ns // 1_000_000),
        "drives": {
            polled.drive.name: _drive(hub, polled.drive.name, time_ns)
            | {"stops": stops.get(polled.drive.name, 0)}
            | recent.drive_figures(polled.drive.name)
            for polled in hub.plant.drives
        },
        "lines": {
            line.name: recent.line(line.name) | {"lost": lost_of(hub, line.name)} for line in hub.plant.lines
        },
        "alarms": [alarm.as_answer() for alarm in events.shown()],
    }


def _drive(hub: Hub, name: str, time_ns: int) -> dict[str, Any]:
    """Return a drive's entry in a frame, the message with the plant's state.

    A fresh value is a pair: the value, and the index of its age in the message's list `ages_ms`.
    """
    shown = hub.seen(name)
    answer = hub.last_answer(name)
    now = time_ns, hub.now_ns()
    times = TimeNumbers()
    values: dict[str, tuple[Any, ...]] = {}
    for register, newest, good, is_current in hub.known(name):
        if is_current and good is not None and newest is good:
            values[register.name] = _finite(good[2]), times[good[:2]]
        else:
            values[register.name] = _unknown(hub, newest, good, times, now)
    return {
        "state": shown.state,
        "fault": shown.fault,
        "why": shown.why_silent,
        "note": shown.note,
        "seen": None if answer is None else times[answer[:2]],
        "ages_ms": [_age_ms(now, asked) for asked in times],
        "values": values,
    }


def _age_ms(now: Times, asked: Times) -> int:
    """Return the age of a request in ms: the larger of its ages by UTC and by CLOCK_MONOTONIC.

    UTC may be set back, and CLOCK_MONOTONIC stops while the computer sleeps. Both make an age too small.
    """
    return max(one // 1_000_000 - then // 1_000_000 for one, then in zip(now, asked, strict=True))


class TimeNumbers(dict[Times, int]):
    """The distinct times at which values were requested, each mapped to its index.

    A lookup of a new time adds it with the next index: 0, 1, 2 and so on.
    """

    def __missing__(self, time: Times) -> int:
        self[time] = number = len(self)
        return number


def _unknown(
    hub: Hub, newest: KeptRow | None, good: KeptRow | None, times: TimeNumbers, now: Times
) -> tuple[Any, ...]:
    """Return what a message says about a register without a fresh value.

    These are None, an index into `ages_ms`, and the reason. If an earlier read succeeded, its value and the
    index of its age follow.
    """
    if newest is None:
        return None, times[now], "not asked yet"
    last = () if good is None else (_finite(good[2]), times[good[:2]])
    if newest[3]:
        return None, times[newest[:2]], hub.status(newest[3]), *last
    return None, times[now], "overdue", *last


def _finite(value: float) -> float | None:
    return value if isfinite(value) else None


def lost_of(hub: Hub, line: str) -> str | None:
    """Return why a line's port is stalled or lost; None if the port works.

    The port counts as lost if the newest reads of all registers of the line failed with a status in LOST.
    """
    if line in hub.stalled:
        return hub.stalled[line]
    statuses = set()
    for polled in hub.plant.find_line(line).drives:
        for poll in polled.polls:
            row = hub.newest(polled.drive.name, poll.register.name)
            if row is None:
                continue
            status = hub.status(row[3])
            if status not in LOST:
                return None
            statuses.add(status)
    return hub.unopened.get(line) or max(statuses, default=None)


def changes(before: dict[str, Any], now: dict[str, Any]) -> dict[str, Any]:
    """Return the entries of `now` whose values differ from those in `before`, which has the same keys.

    Nested objects are compared in the same way.
    """
    return {
        key: changes(before[key], value) if isinstance(value, dict) else value
        for key, value in now.items()
        if before[key] != value
    }


class Frames:
    """The newest frames (messages with the plant's state), and the viewers that wait for the next one.

    `clock` returns monotonic seconds. Message numbers start at `begin`, which must be random, so that a
    message of an earlier process is never mistaken for one of this process.
    """

    def __init__(
        self, make: Callable[[int], dict[str, Any]], clock: Callable[[], float], begin: int = 0
    ) -> None:
        self._make = make
        self._clock = clock
        self._begin = begin
        self._kept: deque[dict[str, Any]] = deque(maxlen=KEPT)  # newest messages, the newest last
        # The newest message as bytes. Under an older message's number: only the changes since that message.
        # Under WHOLE: the whole message.
        self._encoded: dict[int, Encoded] = {}
        self._due = 0.0
        self._timer: asyncio.TimerHandle | None = None
        self._has_news = True
        self._is_closed = False
        self._waiting: set[asyncio.Future[None]] = set()
        self.made = 0

    @property
    def viewers(self) -> int:
        return len(self._waiting)

    def note_news(self) -> None:
        """Note that the plant's state has changed since the newest frame was made."""
        self._has_news = True
        self._build_when_due()

    def _build_when_due(self) -> None:
        if self._timer is not None or not self._waiting or not self._has_news:
            return
        wait = self._due - self._clock()
        if wait <= 0:
            self._build()
        else:
            self._timer = asyncio.get_running_loop().call_later(wait, self._on_timer)

    def _on_timer(self) -> None:
        self._timer = None
        self._build_when_due()

    async def after(self, n: int) -> Encoded | None:
        """Return the newest message as soon as its number is not `n`; None if none is made within WAIT_S.

        If message `n` is still kept, return only the changes since then. Raises OverflowError if too many
        viewers wait.
        """
        if self._has_news and self._clock() >= self._due:
            self._build()
        if (news := self._since(n)) is not None:
            return news
        if len(self._waiting) >= MOST_VIEWERS:
            raise OverflowError(f"too many viewers; the limit is {MOST_VIEWERS}")
        if self._is_closed:
            return None
        loop = asyncio.get_running_loop()
        turn: asyncio.Future[None] = loop.create_future()
        self._waiting.add(turn)
        self._build_when_due()
        timer = loop.call_later(WAIT_S, _let_go, turn)  # cheaper than one asyncio.wait_for for each viewer
        try:
            await turn
        finally:
            timer.cancel()
            self._waiting.discard(turn)
        return self._since(n)

    def close(self) -> None:
        """Answer all waiting viewers now, without a new message."""
        self._is_closed = True
        self._wake()

    def _since(self, n: int) -> Encoded | None:
        """Return the changes from message `n` to the newest message; None if message `n` is the newest.

        If message `n` is deleted, or was made before a reload, return the whole newest message.
        """
        if not self._kept or self._kept[-1]["n"] == n:
            return None
        newest = self._kept[-1]
        known = next((one for one in self._kept if one["n"] == n), None)
        # a message from before a reload may have other keys
        if known is None or known["revision"] != newest["revision"]:
            n, known = WHOLE, None
        if n not in self._encoded:
            frame = newest if known is None else {"n": newest["n"], "since": n, **changes(known, newest)}
            plain = json.dumps(frame, separators=(",", ":"), allow_nan=False).encode()
            self._encoded[n] = Encoded(newest["n"], plain, gzip.compress(plain, 9, mtime=0))
        return self._encoded[n]

    def _build(self) -> None:
        self.made += 1
        self._kept.append(self._make(self._begin + self.made))
        self._encoded.clear()
        self._due = max(self._due + LEAST_S, self._clock() + LEAST_S - EARLY_S)
        self._has_news = False
        self._wake()

    def _wake(self) -> None:
        waiting, self._waiting = self._waiting, set()
        for turn in waiting:
            _let_go(turn)


def _let_go(turn: asyncio.Future[None]) -> None:
    if not turn.done():
        turn.set_result(None)


class SeenFrames:
    """Refuses commands over HTTP that a network has delayed or repeated.

    Viewers get the plant's state in numbered messages, the frames. A write, or a verb that may start a motor,
    contains the number of the newest frame that its sender has received. The command is sent once, within
    MOST_AGE_S after that frame was made. It is refused if the drive was stopped, or the plant file reloaded,
    after the frame was made. Clocks of other computers are not used.

    `clock` returns a time in ns that goes on while the computer sleeps.
    """

    def __init__(self, clock: Callable[[], int], commands: Commands) -> None:
        self.clock = clock
        self._commands = commands
        self._made: dict[int, int] = {}  # time at which a frame was made (ns), by its number
        # admitted commands, by the frame number that they contain
        self._came: dict[int, set[object]] = {}

    def note(self, n: int) -> None:
        """Record that frame `n` is made now."""
        now_ns = self.clock()
        self._made[n] = now_ns
        for old in [one for one, made_ns in self._made.items() if now_ns - made_ns > MOST_AGE_NS]:
            del self._made[old]
            self._came.pop(old, None)

    def admit(self, drive: str, what: str, command: object, seen: int) -> int:
        """Return the time in ns until which a command may be sent.

        `seen` is the number of the newest frame that the command's sender has received. Raises WriteForbidden
        if this frame is too old, or if the plant file was reloaded or the drive stopped after it was made.
        Also raises WriteForbidden if the command repeats another.
        """
        made_ns = self._made.get(seen)
        until_ns = 0 if made_ns is None else made_ns + MOST_AGE_NS
        if made_ns is None or self.clock() > until_ns:
            last = f"the values seen (frame {seen}) are not from the last {MOST_AGE_S:g} s"
            raise WriteForbidden(
                f"{what} was not sent: {last}. Check the drive's values and confirm again", rule=TOO_LATE
            )
        if (self._commands.plant_ns or 0) >= made_ns:  # the drive's name may mean another drive now
            since = f"the plant file was reloaded after the values seen (frame {seen})"
            raise WriteForbidden(
                f"{what} was not sent: {since}. Check the drive's values and confirm again",
                rule=ANOTHER_PLANT,
            )
        if (self._commands.stopped_ns(drive) or 0) >= made_ns:
            since = f"a stop was called after the values seen (frame {seen})"
            raise WriteForbidden(
                f"{what} was not sent: {since}. Check the drive's values and confirm again", rule=OVERTAKEN
            )
        came = self._came.setdefault(seen, set())
        if command in came:
            first = "see the answer to the first request"
            raise WriteForbidden(
                f"{what} was not sent again: it repeats an earlier request; {first}", rule=DOUBLED
            )
        came.add(command)
        return until_ns
