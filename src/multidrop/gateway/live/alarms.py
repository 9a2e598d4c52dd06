"""Alarms of drives and lines, and the limits of values that raise alarms. This module does no I/O."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping
from enum import Enum
from math import isfinite
from typing import Any, NamedTuple

from multidrop import Plant
from multidrop.gateway.live.hub import (
    FAULT,
    INCOMPLETE,
    NOT_ASKED,
    RUNS,
    SILENT,
    STANDS,
    UNKNOWN,
    UNNAMED,
    Hub,
    Shown,
)
from multidrop.printable import iso_time
from multidrop.toml_check import DURATION, Key, TomlPlace, duration_of

STOPPED, PORT, LIMIT = "stopped", "port", "limit"  # kinds of alarms, besides FAULT and SILENT
KINDS = (FAULT, STOPPED, LIMIT, PORT, SILENT)  # kinds of alarms, the most serious kind first
UNCALLED = "the motor stopped, and no stop was called here"
# in ms: a motor counts as stopped after this time at rest, because a motor that reverses also passes 0 Hz
STANDS_MS = 2000
MOST_ENDED = 1000  # limit of ended alarms that the gateway remembers
MOST_SHOWN = 20  # limit of ended alarms that clients see
SEPARATOR = "; "  # separates a drive's exceeded limits in an alarm's text
# while a line's port is lost, the status of all its rows starts with one of these texts
LOST = ("port lost", "port refused its settings")
LIMIT_KEYS = {
    "drive": Key(str, 'drive = "pump-1"', needed=True),
    "register": Key(str, 'register = "output_current"', needed=True),
    "above": Key((int, float), "above = 30.0"),
    "below": Key((int, float), "below = 5.0"),
    "for": Key(str, 'for = "5 s"', keywords=DURATION),
    "hysteresis": Key((int, float), "hysteresis = 2.0", keywords={"minimum": 0}),
}


class AlarmChange(Enum):
    """What happened to an alarm: it started, ended or changed."""

    BEGAN = "began"
    CHANGED = "changed"  # the alarm was acknowledged, or its text has changed
    ENDED = "ended"


class Alarm(NamedTuple):
    """A problem of a drive or a line, present or past; times are UTC in ms."""

    time: int
    drive: str  # the drive's name; "" if the alarm is about a line
    text: str
    ended: int | None
    kind: str
    line: str = ""
    is_before: bool = False  # True: `time` is when the alarm was first seen, but it may have started earlier
    acknowledged: int | None = None
    by: str = ""  # name of the caller who acknowledged the alarm
    note: str = ""

    @property
    def id(self) -> str:
        """A unique id, the same after a restart of the gateway."""
        return f"{self.time} {self.kind} {self.drive or self.line}"

    @property
    def key(self) -> tuple[str, str, str]:
        """The line, drive and kind. Only one alarm with the same key is active at a time."""
        return self.line, self.drive, self.kind

    def as_json(self) -> dict[str, Any]:
        """Return the alarm as the file of alarms has it, with times in ms."""
        return {"id": self.id, **self._asdict()}

    def as_answer(self) -> dict[str, Any]:
        """Return the alarm as clients get it, with times as ISO 8601 text."""
        times = {"time": self.time, "ended": self.ended, "acknowledged": self.acknowledged}
        return self.as_json() | {key: ms and iso_time(ms) for key, ms in times.items()}


class Alarms:
    """The active alarms, and the latest ended ones.

    `since` is a UTC time in ms; alarms that ended before it may be missing. `note` is called with each alarm
    that started, ended or changed, and with the kind of change.
    """

    def __init__(
        self, since: int = 0, note: Callable[[Alarm, AlarmChange], object] = lambda alarm, change: None
    ) -> None:
        self.since = since
        self._note = note
        # active alarms, oldest first, by line, drive and kind
        self._lasting: dict[tuple[str, str, str], Alarm] = {}
        self._ended: deque[Alarm] = deque(maxlen=MOST_ENDED)
        self._known: set[tuple[str, str]] = set()  # lines and drives whose state was seen before
        # By drive: the argument `stops` of `look` when the motor was first seen running.
        self._runs: dict[str, int] = {}
        # time at which a motor was first seen at rest after running, by drive
        self._stands: dict[str, int] = {}
        self.begun = 0  # number of alarms that started so far

    # ---- observations ----

    def look(self, time: int, drive: str, shown: Shown, stops: int | None = None) -> None:
        """Note a drive's state, and start or end its alarms. A fault stays active while its drive is silent.

        `stops` is the number of commands so far that can end a run of the motor. If it is None, a stopped
        motor raises no alarm.
        """
        state, words = shown.state, shown.words
        if state == SILENT:
            # if a port is lost, its line has one alarm, and its drives have none
            if not (words or "").startswith(LOST):
                self._begin(time, "", drive, SILENT, words or "no reply")
            return
        if words == NOT_ASKED:
            return
        self._end(time, "", drive, SILENT)
        if state == FAULT:
            self._forget_run(drive)
            self._end(time, "", drive, STOPPED)
            self._begin(time, "", drive, FAULT, words or UNNAMED)
        elif words != INCOMPLETE:
            self._end(time, "", drive, FAULT)
            self._look_at_run(time, drive, state, stops)
            self._known.add(("", drive))

    def _look_at_run(self, time: int, drive: str, state: str, stops: int | None) -> None:
        """Raise an alarm for a motor that stopped without a command and stayed at rest for STANDS_MS."""
        if state == RUNS:
            self._runs.setdefault(drive, stops or 0)
            self._stands.pop(drive, None)
            self._end(time, "", drive, STOPPED)
        elif state in (STANDS, UNKNOWN) and drive in self._runs:
            # the lesser time, in case the clock was set back meanwhile
            since = self._stands[drive] = min(time, self._stands.get(drive, time))
            is_called = stops != self._runs[drive]
            if is_called or time - since >= STANDS_MS:
                self._forget_run(drive)
            if not is_called and time - since >= STANDS_MS:
                self._begin(since, "", drive, STOPPED, UNCALLED)

    def _forget_run(self, drive: str) -> None:
        self._runs.pop(drive, None)
        self._stands.pop(drive, None)

    def look_at_line(self, time: int, line: str, lost: str | None) -> None:
        """Start the alarm about a line's lost port with the reason `lost`, or end it if `lost` is None."""
        if lost is None:
            self._end(time, line, "", PORT)
        else:
            self._begin(time, line, "", PORT, lost)

    def look_at_limits(self, time: int, drive: str, exceeded: Callable[[str], str]) -> None:
        """Start, update or end the alarm about a drive's exceeded limits.

        `exceeded` is called with the active alarm's text ("" if there is none). It returns the new text (""
        if no limit is exceeded).
        """
        lasting = self._lasting.get(("", drive, LIMIT))
        text = exceeded(lasting.text if lasting else "")
        if text:
            self._begin(time, "", drive, LIMIT, text)
        else:
            self._end(time, "", drive, LIMIT)

    def note_there(self, line: str) -> None:
        """Note that a line works: if its port is lost later, the alarm's start time is exact."""
        self._known.add((line, ""))

    def forget(self, name: str, time: int) -> None:
        """End the alarms of a drive or a line that was removed."""
        self._forget_run(name)
        self._known -= {("", name), (name, "")}
        for line, drive, kind in list(self._lasting):
            if name in (line, drive):
                self._end(time, line, drive, kind)

    # ---- acknowledgement, and alarms of earlier runs ----

    def acknowledge(self, id: str, time: int, by: str, note: str = "") -> Alarm:
        """Acknowledge an alarm, and return it. This ends the alarm if its kind is "stopped".

        Raises KeyError for an unknown id.
        """
        found = next((one for one in (*self._lasting.values(), *self._ended) if one.id == id), None)
        if found is None:
            raise KeyError(id)
        changed = found._replace(acknowledged=time, by=by, note=note)
        if found.ended is None:
            self._lasting[found.key] = changed
        else:
            self._ended[self._ended.index(found)] = changed
        self._note(changed, AlarmChange.CHANGED)
        if changed.kind == STOPPED and changed.ended is None:
            self._end(time, *changed.key)
        return changed

    def restore(self, kept: Iterable[Alarm], time: int, names: Collection[str]) -> None:
        """Take over the alarms of an earlier run.

        Alarms of drives and lines that are not in `names` end now.
        """
        kept = sorted(kept, key=lambda alarm: alarm.ended or alarm.time)
        if kept:
            self.since = min(self.since, *(alarm.time for alarm in kept))
        newer = list(self._ended)
        self._ended.clear()
        self._ended.extend([alarm for alarm in kept if alarm.ended is not None])
        self._ended.extend(newer)
        for alarm in kept:
            if alarm.ended is None:
                self._take_up(alarm, time, names)

    def _take_up(self, alarm: Alarm, time: int, names: Collection[str]) -> None:
        """Continue an alarm of an earlier run. End it if its cause, its drive or its line has gone."""
        key = alarm.key
        present = self._lasting.get(key)
        is_seen = key[:2] in self._known and present is None
        if present is not None and present.is_before and present.text in (alarm.text, UNNAMED):
            # both are the same alarm: keep the earlier one, which has the exact start
            self._lasting[key] = alarm
        elif present is not None or is_seen or (alarm.drive or alarm.line) not in names:
            self._ended.append(alarm._replace(ended=time))
            self._note(self._ended[-1], AlarmChange.ENDED)
        else:
            self._lasting[key] = alarm

    # ---- queries ----

    def shown(self) -> list[Alarm]:
        """Return the active alarms, the most serious kind first, followed by the newest ended ones."""
        ended = [*self._ended][-MOST_SHOWN:]
        return [*self.lasting, *sorted(ended, key=lambda alarm: -alarm.time)]

    def between(self, begin: int, end: int) -> list[Alarm]:
        """Return the alarms that were active between two times (UTC, ms), newest first."""
        found = [one for one in (*self._lasting.values(), *self._ended) if one.time <= end]
        # an alarm ends before it starts if the clock was set back meanwhile
        lasting = (one for one in found if one.ended is None or max(one.time, one.ended) >= begin)
        return sorted(lasting, key=lambda alarm: -alarm.time)

    @property
    def lasting(self) -> list[Alarm]:
        """The active alarms: unacknowledged before acknowledged ones, then by kind, then the newest first."""
        return sorted(
            self._lasting.values(),
            key=lambda alarm: (alarm.acknowledged is not None, KINDS.index(alarm.kind), -alarm.time),
        )

    # ---- start and end ----

    def _begin(self, time: int, line: str, drive: str, kind: str, text: str) -> None:
        key = (line, drive, kind)
        before = self._lasting.get(key)
        is_before = key[:2] not in self._known
        self._known.add(key[:2])
        if before is not None and (text in (before.text, UNNAMED) or kind == SILENT):
            return
        is_less = kind == LIMIT and before is not None and _exceeded_in(text) < _exceeded_in(before.text)
        if before is not None and (before.text == UNNAMED or kind == PORT or is_less):
            # the same alarm continues, with a new text
            self._lasting[key] = before._replace(text=text)
            self._note(self._lasting[key], AlarmChange.CHANGED)
            return
        self._end(time, *key)
        self._lasting[key] = Alarm(time, drive, text, None, kind, line, is_before)
        self.begun += 1
        self._note(self._lasting[key], AlarmChange.BEGAN)

    def _end(self, time: int, line: str, drive: str, kind: str) -> None:
        before = self._lasting.pop((line, drive, kind), None)
        if before is not None:
            if len(self._ended) == MOST_ENDED:
                self.since = max(self.since, self._ended[0].ended or 0)
            self._ended.append(before._replace(ended=time))
            self._note(self._ended[-1], AlarmChange.ENDED)


def _exceeded_in(text: str) -> set[str]:
    return {*text.split(SEPARATOR)}


# ---- limits of values (`[[serve.limit]]` of a plant file) ----


class Limit(NamedTuple):
    """An upper or lower limit of a polled value.

    The limit is exceeded if the value has been beyond it for `lasting_s` seconds. It stays exceeded until
    the value is back by at least `hysteresis`, in the register's unit.
    """

    drive: str
    register: str
    unit: str
    is_above: bool  # True: an upper limit; False: a lower limit
    bound: float
    lasting_s: float = 0.0
    hysteresis: float = 0.0

    def __str__(self) -> str:
        side = "above" if self.is_above else "below"
        return f"{self.register} {side} {self.bound:g} {self.unit}".rstrip()

    def is_beyond(self, value: float, margin: float) -> bool:
        """Return True if the value is beyond the limit, or within it by less than `margin`."""
        return value > self.bound - margin if self.is_above else value < self.bound + margin


class Limits:
    """The limits of a plant's values, and for each limit the time when its value went beyond it."""

    def __init__(self, limits: Iterable[Limit]) -> None:
        self._of: dict[str, list[Limit]] = {}
        self._since_s: dict[Limit, float] = {}
        for limit in limits:
            self._of.setdefault(limit.drive, []).append(limit)

    def __contains__(self, drive: str) -> bool:
        return drive in self._of

    def exceeded(self, now_s: float, drive: str, values: Mapping[str, float], before: str) -> str:
        """Return a text with the drive's exceeded limits; "" if there are none.

        `values` has the current values by register. While a value is missing, its limit stays as it was,
        exceeded or not. The time that the value has been beyond the limit is then counted from 0 again.
        `before` is the text that the previous call returned, or an alarm's text from an earlier run.
        """
        found = []
        for limit in self._of.get(drive, ()):
            was = str(limit) in before.split(SEPARATOR)
            value = values.get(limit.register)
            if value is None:
                self._since_s.pop(limit, None)
                is_exceeded = was
            elif limit.is_beyond(value, limit.hysteresis if was else 0.0):
                since_s = self._since_s.setdefault(limit, now_s)
                is_exceeded = was or now_s - since_s >= limit.lasting_s
            else:
                self._since_s.pop(limit, None)
                is_exceeded = False
            found += [str(limit)] if is_exceeded else []
        return SEPARATOR.join(found)


def current_values(hub: Hub, drive: str) -> dict[str, float]:
    """Return the newest values of a drive's polled registers by name, without values that are too old."""
    return {
        register.name: good[2]
        for register, _, good, is_current in hub.known(drive)
        if is_current and good is not None
    }


def read_limits(tables: Any, plant: Plant, place: TomlPlace) -> tuple[Limit, ...]:
    """Return the limits in the tables `[[serve.limit]]` of a plant file; add mistakes to `place`."""
    units = {
        (polled.drive.name, poll.register.name): poll.register.unit
        for polled in plant.drives
        for poll in polled.series
    }
    found = []
    for table, inside in place.inside("limit", tables):
        before = len(place.config_errors)
        given = inside.check(table, LIMIT_KEYS)
        lasting_s = duration_of(given, "for", inside) or 0.0
        if len(place.config_errors) == before:
            found.append(inside.attempt(_limit, given, lasting_s, units if plant.lines else None))
    return tuple(limit for limit in found if limit is not None)


def _limit(given: Mapping[str, Any], lasting_s: float, units: Mapping[tuple[str, str], str] | None) -> Limit:
    """Return the limit in one table `[[serve.limit]]`.

    `units` has the unit of each polled register, or is None if the plant has no lines. Raises ValueError for
    an invalid limit.
    """
    drive, register = given["drive"], given["register"]
    if units is not None and (drive, register) not in units:
        raise ValueError(f"{drive}.{register} is not polled: only polled values can have a limit")
    sides = [side for side in ("above", "below") if side in given]
    if len(sides) != 1:
        raise ValueError(
            "give either key 'above' or key 'below'. For both limits, write two tables [[serve.limit]]"
        )
    bound, hysteresis = float(given[sides[0]]), float(given.get("hysteresis", 0.0))
    if not isfinite(bound) or not 0 <= hysteresis < float("inf"):
        raise ValueError(f"{sides[0]} and hysteresis must be finite numbers, and hysteresis 0 or more")
    unit = units[drive, register] if units is not None else ""
    return Limit(drive, register, unit, sides[0] == "above", bound, lasting_s, hysteresis)
