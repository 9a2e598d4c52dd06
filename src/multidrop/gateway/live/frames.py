"""Frames: what all viewers see, made once for all of them, five times a second at most.

A viewer asks for the next frame when it has the last one: nothing queues for one that is slow. It names the
one that it has, and is sent what changed since that one while it is remembered.
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
from multidrop.gateway.commands import MOST_AGE_S
from multidrop.gateway.live.alarms import Alarms
from multidrop.gateway.live.hub import Hub, KeptRow
from multidrop.gateway.live.recent_statistics import RecentStatistics

LEAST_S = 0.2  # between two frames, on the whole: the page draws no faster
EARLY_S = 0.02  # by which one may come sooner after one that was late
WAIT_S = 20.0  # for which a viewer waits for a frame
MOST_VIEWERS = 200  # that wait at the same time
WHOLE = -1  # the number of no frame: who has none is sent a whole one
REMEMBERED = 6  # frames, the newest among them: a viewer may be a second behind
LOST = ("port lost", "port refused its settings")  # statuses of all rows of a line that is not there

Times = tuple[int, int]  # the same moment in UTC, and by CLOCK_MONOTONIC, both in ns


class Encoded(NamedTuple):
    """A frame as it is sent, whole or as what changed since another one."""

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
    """Return the frame of this moment; `stops` counts those that were called, by drive."""
    return {
        "n": n,
        "revision": revision,
        "time": str(time_ns),
        "drives": {
            polled.drive.name: _drive(hub, polled.drive.name, time_ns)
            | {"stops": stops.get(polled.drive.name, 0)}
            | recent.drive_figures(polled.drive.name)
            for line in hub.plant.lines
            for polled in line.drives
        },
        "lines": {
            line.name: recent.line(line.name) | {"lost": lost_of(hub, line.name)} for line in hub.plant.lines
        },
        "alarms": [alarm.as_json() for alarm in events.shown()],
    }


def _drive(hub: Hub, name: str, time_ns: int) -> dict[str, Any]:
    """Return what a frame says of a drive; of a value that is known now that and the place of its time."""
    shown = hub.seen(name)
    seen, answered_ns = hub.seen_at(name), hub.answered_ns(name)
    now = time_ns, hub.now_ns()
    places = Places()
    values: dict[str, tuple[Any, ...]] = {}
    for register, newest, good, is_fresh in hub.known(name):
        if is_fresh and good is not None and newest is good:
            values[register] = _finite(good[2]), places[good[:2]]
        else:
            values[register] = _unknown(hub, newest, good, places, now)
    return {
        "state": shown.state,
        "fault": shown.fault,
        "why": shown.why_silent,
        "note": shown.note,
        "seen": None if seen is None or answered_ns is None else places[seen, answered_ns],
        "ages_ms": [_age_ms(now, asked) for asked in places],
        "values": values,
    }


def _age_ms(now: Times, asked: Times) -> int:
    """Return the longer time of two clocks: one may have been set back, and the other stops in a sleep."""
    return max(one // 1_000_000 - then // 1_000_000 for one, then in zip(now, asked, strict=True))


class Places(dict[Times, int]):
    """The places of times in a list without doubles: what was read by one request has one time."""

    def __missing__(self, time: Times) -> int:
        self[time] = place = len(self)
        return place


def _unknown(
    hub: Hub, newest: KeptRow | None, good: KeptRow | None, places: Places, now: Times
) -> tuple[Any, ...]:
    """Return null, place of its time, status of what is not known now, and the last value and its time."""
    if newest is None:
        return None, places[now], "not asked yet"
    last = () if good is None else (_finite(good[2]), places[good[:2]])
    if newest[3]:
        return None, places[newest[:2]], hub.status(newest[3]), *last
    return None, places[now], "overdue", *last


def _finite(value: float) -> float | None:
    return value if isfinite(value) else None


def lost_of(hub: Hub, line: str) -> str | None:
    """Return the reason why a line is not there, where all its newest rows say so; None otherwise.

    Of a port that could not be opened it is what the system said.
    """
    statuses = set()
    for polled in hub.plant.find_line(line).drives:
        for poll in polled.polls:
            row = hub.newest(polled.drive.name, poll.register.name)
            if row is None:
                continue
            if row.status not in LOST:
                return None
            statuses.add(row.status)
    return hub.unopened.get(line) or max(statuses, default=None)


def changes(before: dict[str, Any], now: dict[str, Any]) -> dict[str, Any]:
    """Return those keys of `now` whose values are others than in `before`, which has the same keys.

    Of an object in an object it is again those that changed; anything else is there as a whole.
    """
    return {
        key: changes(before[key], value) if isinstance(value, dict) else value
        for key, value in now.items()
        if before[key] != value
    }


class Frames:
    """The newest frames, and those who wait for the next one.

    `clock` gives monotonic seconds. Frames are numbered on from `begin`, so that none that a viewer has of an
    earlier process is taken for one of ours.
    """

    def __init__(
        self, make: Callable[[int], dict[str, Any]], clock: Callable[[], float], begin: int = 0
    ) -> None:
        self._make = make
        self._clock = clock
        self._begin = begin
        self._remembered: deque[dict[str, Any]] = deque(maxlen=REMEMBERED)  # the newest last
        self._encoded: dict[int, Encoded] = {}  # the newest, by the frame since which it tells
        self._due = 0.0
        self._timer: asyncio.TimerHandle | None = None
        self._has_news = True
        self._is_closed = False
        self._waiting: set[asyncio.Future[None]] = set()
        self.made = 0

    @property
    def viewers(self) -> int:
        """Return how many wait at present."""
        return len(self._waiting)

    def note_news(self) -> None:
        """Tell that a frame of now would differ from the newest one."""
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
        """Return a frame other than the n-th as soon as there is one; None after 20 s without one.

        Where the n-th is remembered, that is what changed since then. Raises OverflowError when too many
        wait already.
        """
        if self._has_news and self._clock() >= self._due:
            self._build()
        if (news := self._since(n)) is not None:
            return news
        if len(self._waiting) >= MOST_VIEWERS:
            raise OverflowError(f"{MOST_VIEWERS} viewers wait already")
        if self._is_closed:
            return None
        loop = asyncio.get_running_loop()
        turn: asyncio.Future[None] = loop.create_future()
        self._waiting.add(turn)
        self._build_when_due()
        timer = loop.call_later(WAIT_S, _let_go, turn)  # wait_for would take more turns of the loop
        try:
            await turn
        finally:
            timer.cancel()
            self._waiting.discard(turn)
        return self._since(n)

    def close(self) -> None:
        """Let all waiting viewers go, without a frame."""
        self._is_closed = True
        self._wake()

    def _since(self, n: int) -> Encoded | None:
        """Return the newest frame for one who has the n-th; None where that is the newest."""
        if not self._remembered or self._remembered[-1]["n"] == n:
            return None
        newest = self._remembered[-1]
        known = next((one for one in self._remembered if one["n"] == n), None)
        if known is None or known["revision"] != newest["revision"]:  # another plant has other keys
            n, known = WHOLE, None
        if n not in self._encoded:
            told = newest if known is None else {"n": newest["n"], "since": n, **changes(known, newest)}
            plain = json.dumps(told, separators=(",", ":"), allow_nan=False).encode()
            self._encoded[n] = Encoded(newest["n"], plain, gzip.compress(plain, 9, mtime=0))
        return self._encoded[n]

    def _build(self) -> None:
        self.made += 1
        self._remembered.append(self._make(self._begin + self.made))
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


MOST_AGE_NS = round(MOST_AGE_S * 1e9)
TOO_LATE, OVERTAKEN, DOUBLED = "too late", "a stop was called", "it came before"  # rules of a WriteForbidden
ANOTHER_PLANT = "the plant was read anew"


class SeenFrames:
    """The frames of the last seconds, and the commands that named them.

    `clock` gives ns, and runs on while the machine sleeps. `stopped_ns` returns when the latest stop of a
    drive was called, by that clock; None without one.
    """

    def __init__(self, clock: Callable[[], int], stopped_ns: Callable[[str], int | None]) -> None:
        self.clock = clock
        self._stopped_ns = stopped_ns
        self._made: dict[int, int] = {}  # when, by the frame's number
        self._came: dict[int, set[object]] = {}  # commands, by the frame that they named
        self._newest = -1
        self._newest_before = -1  # the last one that showed another plant

    def note(self, n: int) -> None:
        """Note that a frame of this number is made now."""
        now_ns = self.clock()
        self._newest, self._made[n] = n, now_ns
        for old in [one for one, made_ns in self._made.items() if now_ns - made_ns > MOST_AGE_NS]:
            del self._made[old]
            self._came.pop(old, None)

    def begin_anew(self) -> None:
        """Note that there is another plant: a name of a frame before may be another drive's now."""
        self._newest_before = self._newest

    def admit(self, drive: str, what: str, command: object, seen: int) -> int:
        """Return until when a command may be sent whose sender had seen this frame, by the clock.

        Raises WriteForbidden where it may not, and when the same command names the same frame again.
        """
        made_ns = self._made.get(seen)
        until_ns = 0 if made_ns is None else made_ns + MOST_AGE_NS
        if made_ns is None or self.clock() > until_ns:
            last = f"frame {seen} is none of the last {MOST_AGE_S:g} s"
            raise WriteForbidden(
                f"{what} was not sent: {last}: look again, and confirm it anew", rule=TOO_LATE
            )
        if seen <= self._newest_before:
            since = f"the plant was read anew after frame {seen}"
            raise WriteForbidden(
                f"{what} was not sent: {since}: look again, and confirm it anew", rule=ANOTHER_PLANT
            )
        if (self._stopped_ns(drive) or 0) >= made_ns:
            since = f"a stop was called after frame {seen}"
            raise WriteForbidden(
                f"{what} was not sent: {since}: look again, and confirm it anew", rule=OVERTAKEN
            )
        came = self._came.setdefault(seen, set())
        if command in came:
            first = "the first answer says what became of it"
            raise WriteForbidden(f"{what} was not sent again: it came a second time; {first}", rule=DOUBLED)
        came.add(command)
        return until_ns
