"""The gateway's part `notify`: sends a message for each alarm that starts or ends.

A target of messages is a webhook or a service of the library Apprise. Each has its own thread, so that a
target that hangs delays no other. Addresses of targets contain secrets. Logs and errors show only the scheme
of an address, and the host of a webhook.
"""

from __future__ import annotations

import asyncio
import json
import logging
import re
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from math import inf
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from multidrop import Plant
from multidrop.exposition import MetricFamily
from multidrop.gateway.live.alarms import KINDS, Alarm, AlarmChange
from multidrop.gateway.metrics import counter
from multidrop.gateway.parts import PartContext, missing_library
from multidrop.gateway.sending import Refused, RetryingSender, post
from multidrop.gateway.settings import input_file, refuse
from multidrop.printable import iso_time
from multidrop.supervisor import supervisor

MOST_TARGETS = 20
MOST_BYTES = 65_536  # limit, in bytes, of the file of targets
MOST_WAITING = 1000  # limit of alarms that wait to be sent to one target
MOST_AN_HOUR = 1000
CLOSE_S = 2.0
SCHEME = re.compile(r"[a-z][a-z0-9+.-]*")

_log = logging.getLogger("multidrop.gateway.notify")


class AlarmTarget(NamedTuple):
    """A target of messages. Its `name` shows no secret part of its URL."""

    name: str
    url: str

    @property
    def is_webhook(self) -> bool:
        return urlsplit(self.url).scheme in ("http", "https")


@dataclass(frozen=True)
class NotifySettings:
    """The settings in the table `[serve.notify]`. Raises ValueError with a line for each mistake."""

    targets: str = "targets"  # path of a file with a URL on each line
    # Kinds of alarms about which messages are sent.
    on: tuple[str, ...] = field(default=KINDS, metadata={"items": {"enum": [*KINDS]}})
    # Limit of messages per hour to each target.
    most: int = field(default=60, metadata={"minimum": 1, "maximum": MOST_AN_HOUR})

    def __post_init__(self) -> None:
        wrong = [
            f"on: {kind!r} is not a kind of alarm; the kinds are {', '.join(KINDS)}"
            for kind in self.on
            if kind not in KINDS
        ]
        if not 1 <= self.most <= MOST_AN_HOUR:
            wrong.append(f"most = {self.most} is not 1 to {MOST_AN_HOUR} messages an hour")
        refuse(wrong)

    def check(self, plant: Plant) -> list[str]:
        """Return an error sentence for each mistake in the file of targets, and one if Apprise is missing."""
        path = input_file(self.targets, plant)
        try:
            targets, wrong = read_targets(path)
        except OSError as failure:
            return [f'targets = "{self.targets}": {path} cannot be read: {failure.strerror}']
        if not all(target.is_webhook for target in targets) and find_spec("apprise") is None:
            wrong.append(missing_library("notify", ImportError(name="apprise")))
        return wrong


def read_targets(path: Path) -> tuple[list[AlarmTarget], list[str]]:
    """Return the targets in a file, and an error sentence for each mistake. Raises OSError."""
    with path.open("rb") as file:
        text = file.read(MOST_BYTES).decode("utf-8", "replace")
    found, wrong = [], []
    for number, line in enumerate(text.splitlines(), 1):
        url = line.strip()
        if not url or url.startswith("#"):
            continue
        try:
            found.append(AlarmTarget(f"target {_shown(url)} in line {number} of {path.name}", url))
        except ValueError as mistake:
            wrong.append(f"{path}:{number}: {mistake}")
    if not found and not wrong:
        wrong.append(f"{path} has no target; add a line with a URL")
    if len(found) > MOST_TARGETS:
        wrong.append(f"{path} has {len(found)} targets, but {MOST_TARGETS} at most are allowed")
    return found, wrong


def _shown(url: str) -> str:
    """Return the part of a target's URL that is not secret. Raises ValueError for an invalid URL."""
    scheme, separator, rest = url.partition("://")
    if not separator or not rest or not SCHEME.fullmatch(scheme):
        raise ValueError("the target is not a URL; write one such as https://HOST/PATH or ntfy://TOPIC")
    if scheme not in ("http", "https"):
        return f"{scheme}://"
    try:
        host, user = urlsplit(url).hostname, urlsplit(url).username
    except ValueError:
        host = user = None
    if not host or user is not None:
        raise ValueError(
            "the webhook is not of the form https://HOST/PATH. "
            "With a user name and password, write json://USER:PASSWORD@HOST/PATH, which Apprise sends"
        )
    return f"{scheme}://{host}"


def build(settings: NotifySettings, context: PartContext) -> Notifications:
    """Return the sender of alarms.

    Raises ImportError if Apprise is needed but missing, OSError if the file of targets is unreadable.
    """
    targets, _ = read_targets(input_file(settings.targets, context.plant))
    describe = partial(message_of, context.plant.path.stem, context.page)
    senders = [
        Sender(target.name, sender_to(target), AlarmQueue(settings.most, time.monotonic()), describe)
        for target in targets
    ]
    return Notifications(senders, settings.on)


# ---- messages ----


def message_of(plant: str, page: str, alarm: Alarm, left_out: int) -> dict[str, Any]:
    """Return the message about an alarm as a JSON object.

    `left_out` is the number of earlier messages that were not sent because of the hourly limit.
    """
    where = alarm.drive or f"line {alarm.line}"
    over = " is over" if alarm.ended is not None else ""
    text = f"{where}: {alarm.kind}{over}: {alarm.text}"
    if left_out:
        text += f" ({left_out} earlier messages were left out)"
    return {
        "event": "begin" if alarm.ended is None else "end",
        "title": f"{plant}: {where}",
        "text": text,
        "plant": plant,
        "line": alarm.line,
        "drive": alarm.drive,
        "kind": alarm.kind,
        "alarm": alarm.text,
        "id": alarm.id,
        "time": iso_time(alarm.time),
        "ended": None if alarm.ended is None else iso_time(alarm.ended),
        "page": page,
    }


class AlarmQueue:
    """The alarms that wait to be sent to one target, the oldest first, and the target's hourly limit.

    `most` messages an hour are allowed. At the limit, only the newest message about each alarm waits. The
    next message states how many messages were left out.
    """

    def __init__(self, most: int, now_s: float) -> None:
        self._most = most
        self._allowed = float(most)
        self._filled_s = now_s
        self._waiting: list[Alarm] = []
        self.left_out = 0

    def __len__(self) -> int:
        return len(self._waiting)

    def put(self, alarm: Alarm) -> None:
        self._waiting.append(alarm)
        if len(self._waiting) > MOST_WAITING:
            self._keep_newest()
            excess = max(0, len(self._waiting) - MOST_WAITING)
            del self._waiting[:excess]
            self.left_out += excess

    def next(self, now_s: float) -> tuple[Alarm | None, float]:
        """Return the alarm to send now, and a waiting time of 0 s.

        If no alarm may be sent now, return None and the waiting time, in s; inf if no alarm waits.
        """
        rate = self._most / 3600
        self._allowed = min(self._most, self._allowed + (now_s - self._filled_s) * rate)
        self._filled_s = now_s
        if not self._waiting:
            return None, inf
        if self._allowed < 1:
            self._keep_newest()
            return None, (1 - self._allowed) / rate
        return self._waiting[0], 0.0

    def note_sent(self, alarm: Alarm, left_out: int) -> None:
        """Remove a sent alarm. Its message stated that `left_out` alarms were not sent."""
        # Meanwhile a full queue may have dropped more alarms. If it dropped this one, do not count it: it was
        # sent.
        is_left_out = all(one is not alarm for one in self._waiting)
        self._remove(alarm)
        self._allowed -= 1
        self.left_out -= left_out + is_left_out

    def drop(self, alarm: Alarm) -> None:
        """Remove an alarm that `next` returned, because the target will never accept its message."""
        self._remove(alarm)
        self.left_out += 1

    def _remove(self, alarm: Alarm) -> None:
        self._waiting = [one for one in self._waiting if one is not alarm]

    def _keep_newest(self) -> None:
        newest = {alarm.key: alarm for alarm in self._waiting}
        self.left_out += len(self._waiting) - len(newest)
        self._waiting = [alarm for alarm in self._waiting if newest[alarm.key] is alarm]


# ---- targets ----


def sender_to(target: AlarmTarget) -> Callable[[dict[str, Any]], None]:
    """Return a function that sends a message to this target. The function raises OSError if that fails."""
    if target.is_webhook:
        return partial(_post, target.url)
    apprise: Any = import_module("apprise")
    # Apprise's log lines may contain addresses of targets, which are secret
    logging.getLogger("apprise").propagate = False
    service = apprise.Apprise()
    if not service.add(target.url):
        raise ValueError(f"{target.name} is not an address that Apprise knows")
    return partial(_notify, service)


def _post(url: str, message: dict[str, Any]) -> None:
    post(url, json.dumps(message).encode(), {"content-type": "application/json"})


def _notify(service: Any, message: dict[str, Any]) -> None:
    if not service.notify(title=message["title"], body=message["text"]):
        raise OSError("the service did not accept the message")


class Sender(RetryingSender):
    """Sends messages about alarms to one target."""

    log = _log
    first_pause_s, most_pause_s = 5.0, 300.0

    def __init__(
        self,
        name: str,
        send: Callable[[dict[str, Any]], None],
        queue: AlarmQueue,
        describe: Callable[[Alarm, int], dict[str, Any]],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__(name, clock)
        self.sent = 0
        self._send = send
        self._queue = queue
        self._describe = describe

    def put(self, alarm: Alarm) -> None:
        with self._changed:
            self._queue.put(alarm)
        self.announce()

    def _may_end(self, pause_s: float) -> bool:
        # before the end, send all messages that the hourly limit allows
        return pause_s > 0 and not self._has_news

    def step(self) -> float:
        """Send the next message. Return the seconds until the next attempt; inf if no message waits."""
        with self._changed:
            self._has_news = False
            alarm, wait_s = self._queue.next(self._clock())
        return wait_s if alarm is None else super().step()

    def _send_next(self) -> float:
        with self._changed:
            alarm, _ = self._queue.next(self._clock())
            left_out = self._queue.left_out
        assert alarm is not None  # `step` found an alarm, and only this thread takes alarms out
        try:
            self._send(self._describe(alarm, left_out))
        except (ValueError, Refused):
            with self._changed:
                self._queue.drop(alarm)  # an alarm that the target refuses would block all later messages
            raise
        self.sent += 1
        with self._changed:
            self._queue.note_sent(alarm, left_out)
        return 0.0


class Notifications:
    """The gateway's part `notify`: passes alarms on to all targets."""

    def __init__(self, senders: list[Sender], kinds: Collection[str]) -> None:
        self._senders = senders
        self._kinds = kinds
        self._threads: list[asyncio.Future[None]] = []

    def note_alarm(self, alarm: Alarm, change: AlarmChange) -> None:
        """Queue a message if an alarm started or ended, but not if it was acknowledged or got a new text."""
        if alarm.kind in self._kinds and change is not AlarmChange.CHANGED:
            for sender in self._senders:
                sender.put(alarm)

    async def run(self) -> None:
        """Run the senders, each in its own thread, until cancelled."""
        self._threads = [supervisor().thread(one.name, inf, one.run) for one in self._senders]
        await asyncio.gather(*map(asyncio.shield, self._threads))

    async def close(self) -> None:
        """Send the messages that the hourly limits still allow, for at most CLOSE_S seconds."""
        for sender in self._senders:
            sender.close()
        if self._threads:
            await asyncio.wait(self._threads, timeout=CLOSE_S)

    def health(self) -> str:
        return next((one.problem for one in self._senders if one.problem), "")

    def figures(self) -> list[MetricFamily]:
        sent = sum(one.sent for one in self._senders)
        return [counter("multidrop_notifications_sent", "Messages about alarms that targets took.", sent)]
