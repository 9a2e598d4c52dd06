"""The part `notify`: a message for each alarm that begins or ends, to webhooks and to Apprise's services.

Each target has its own thread, so a target that hangs delays nothing else. Addresses of targets contain
secrets. No message shows more of them than their scheme, and the host of a webhook.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import re
import threading
import time
import urllib.request
from collections.abc import Callable, Collection
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from importlib import import_module
from math import inf
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from multidrop import Batch, Plant
from multidrop.exposition import MetricFamily
from multidrop.gateway.live.alarms import KINDS, Alarm, AlarmChange
from multidrop.gateway.metrics import counter
from multidrop.gateway.parts import PartContext
from multidrop.gateway.settings import Folders
from multidrop.printable import printable
from multidrop.supervisor import supervisor

MOST_TARGETS = 20
MOST_BYTES = 65_536  # limit of the file of targets
MOST_WAITING = 1000  # limit of alarms that wait for a target
MOST_AN_HOUR = 1000
SEND_S = 20.0  # time limit for a webhook that sends no bytes during an attempt
RETRY_S, MOST_RETRY_S = 5.0, 300.0  # pause after the first failed attempt, and the longest pause
CLOSE_S = 2.0
REFUSED = (400, 413, 422)  # HTTP statuses after which a message is not sent again
SCHEME = re.compile(r"[a-z][a-z0-9+.-]*")

_log = logging.getLogger("multidrop.gateway.notify")


class AlarmTarget(NamedTuple):
    """Where messages go; `name` shows no secret."""

    name: str
    url: str

    @property
    def is_webhook(self) -> bool:
        return urlsplit(self.url).scheme in ("http", "https")


@dataclass(frozen=True)
class NotifySettings:
    """The settings in the table `[serve.notify]`. Raises ValueError with a line for each mistake."""

    targets: str = "targets"  # path of a file with a URL on each line
    on: tuple[str, ...] = KINDS  # kinds of alarms that are sent
    most: int = 60  # limit of messages an hour to each target

    def __post_init__(self) -> None:
        wrong = [
            f"on: {kind!r} is not a kind of alarm; the kinds are {', '.join(KINDS)}"
            for kind in self.on
            if kind not in KINDS
        ]
        if not 1 <= self.most <= MOST_AN_HOUR:
            wrong.append(f"most = {self.most} is not 1 to {MOST_AN_HOUR} messages an hour")
        if wrong:
            raise ValueError("\n".join(wrong))

    def check(self, plant: Plant) -> list[str]:
        """Return a sentence for each mistake in the file of targets."""
        path = _path_of(self.targets, plant)
        try:
            return read_targets(path)[1]
        except OSError as failure:
            return [f'targets = "{self.targets}": {path} cannot be read: {failure.strerror}']


Settings = NotifySettings


def _path_of(targets: str, plant: Plant) -> Path:
    """Return the file of targets: among the service's credentials, else beside the plant file."""
    return Folders(plant.path, os.environ).find(targets)


def read_targets(path: Path) -> tuple[list[AlarmTarget], list[str]]:
    """Return the targets in a file, and a sentence for each mistake. Raises OSError."""
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
        raise ValueError("this is not a URL, such as https://HOST/PATH or ntfy://TOPIC")
    if scheme not in ("http", "https"):
        return f"{scheme}://"
    try:
        host, user = urlsplit(url).hostname, urlsplit(url).username
    except ValueError:
        host = user = None
    if not host or user is not None:
        raise ValueError(
            "a webhook is https://HOST/PATH without a user; with a user, write an address of Apprise, "
            "json://USER:PASSWORD@HOST/PATH"
        )
    return f"{scheme}://{host}"


def build(settings: NotifySettings, context: PartContext) -> Notifications:
    """Return the part. Raises ImportError if a target needs Apprise and it is not installed, and OSError."""
    targets, _ = read_targets(_path_of(settings.targets, context.plant))
    describe = partial(message_of, context.plant.path.stem, context.page)
    senders = [
        Sender(target.name, sender_to(target), AlarmQueue(settings.most, time.monotonic()), describe)
        for target in targets
    ]
    return Notifications(senders, settings.on)


# ---- messages ----


def message_of(plant: str, page: str, alarm: Alarm, left_out: int) -> dict[str, Any]:
    """Return the JSON object for an alarm; `left_out` earlier messages were not sent."""
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
        "time": _iso(alarm.time),
        "ended": None if alarm.ended is None else _iso(alarm.ended),
        "page": page,
    }


def _iso(time_ms: int) -> str:
    return datetime.fromtimestamp(time_ms / 1000, UTC).isoformat(timespec="milliseconds")


class AlarmQueue:
    """Alarms that wait for one target, oldest first, and the number of messages that the target may get now.

    `most` messages an hour are allowed. Above that rate, only the newest message of each alarm waits; it also
    states how many messages were left out.
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
        """Add an alarm that began or ended."""
        self._waiting.append(alarm)
        if len(self._waiting) > MOST_WAITING:
            self._keep_newest()
            excess = max(0, len(self._waiting) - MOST_WAITING)
            del self._waiting[:excess]
            self.left_out += excess

    def next(self, now_s: float) -> tuple[Alarm | None, float]:
        """Return the alarm to send now, or None and the seconds until the next one (inf: none waits)."""
        rate = self._most / 3600
        self._allowed = min(self._most, self._allowed + (now_s - self._filled_s) * rate)
        self._filled_s = now_s
        if not self._waiting:
            return None, inf
        if self._allowed < 1:
            self._keep_newest()
            return None, (1 - self._allowed) / rate
        return self._waiting[0], 0.0

    def note_sent(self, alarm: Alarm) -> None:
        """Remove an alarm that `next` returned: its message was sent."""
        self._waiting = [one for one in self._waiting if one is not alarm]
        self._allowed -= 1
        self.left_out = 0

    def drop(self, alarm: Alarm) -> None:
        """Remove an alarm that `next` returned, because the target will never accept its message."""
        self._waiting = [one for one in self._waiting if one is not alarm]
        self.left_out += 1

    def _keep_newest(self) -> None:
        newest = {(alarm.line, alarm.drive, alarm.kind): alarm for alarm in self._waiting}
        self.left_out += len(self._waiting) - len(newest)
        self._waiting = [alarm for alarm in self._waiting if newest.get(_key(alarm)) is alarm]


def _key(alarm: Alarm) -> tuple[str, str, str]:
    return alarm.line, alarm.drive, alarm.kind


# ---- targets ----


class _NoRedirects(urllib.request.HTTPRedirectHandler):
    """Refuses redirects: they would change a POST to a GET, and could name any host."""

    def redirect_request(self, *arguments: Any) -> None:
        return None


def sender_to(target: AlarmTarget) -> Callable[[dict[str, Any]], None]:
    """Return a function that sends a message to this target, and raises OSError if it was not taken."""
    if target.is_webhook:
        return partial(_post, urllib.request.build_opener(_NoRedirects), target.url)
    apprise: Any = import_module("apprise")
    logging.getLogger("apprise").propagate = False  # its log lines may contain addresses
    service = apprise.Apprise()
    if not service.add(target.url):
        raise ValueError(f"{target.name} is not an address that Apprise knows")
    return partial(_notify, service)


def _post(opener: urllib.request.OpenerDirector, url: str, message: dict[str, Any]) -> None:
    body = json.dumps(message).encode()
    headers = {"content-type": "application/json", "user-agent": "multidrop"}
    with opener.open(urllib.request.Request(url, body, headers), timeout=SEND_S):
        pass  # the opener raises HTTPError, an OSError, unless the status is 2xx


def _notify(service: Any, message: dict[str, Any]) -> None:
    if not service.notify(title=message["title"], body=message["text"]):
        raise OSError("the service did not take the message")


class Sender:
    """Sends messages to one target. Only `run`, which has its own thread, waits for the target."""

    def __init__(
        self,
        name: str,
        send: Callable[[dict[str, Any]], None],
        queue: AlarmQueue,
        describe: Callable[[Alarm, int], dict[str, Any]],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.name = name
        self.trouble = ""  # why the target does not take messages now
        self.sent = 0
        self._send = send
        self._queue = queue
        self._describe = describe
        self._clock = clock
        self._retry_s = RETRY_S
        self._sending_since_s = inf
        self._changed = threading.Condition()
        self._is_closed = False

    @property
    def problem(self) -> str:
        """Why the target accepts no messages now; "" if it accepts them."""
        if self._clock() - self._sending_since_s > 2 * SEND_S:
            return f"{self.name} has not answered for {2 * SEND_S:g} s"
        return self.trouble

    def put(self, alarm: Alarm) -> None:
        """Queue a message for an alarm that began or ended."""
        with self._changed:
            self._queue.put(alarm)
            self._changed.notify()

    def close(self) -> None:
        """End `run` once the messages that may be sent now are sent."""
        with self._changed:
            self._is_closed = True
            self._changed.notify()

    def run(self) -> None:
        """Send queued messages until `close`."""
        while True:
            pause_s = self.step()
            with self._changed:
                if pause_s == inf:
                    self._changed.wait_for(lambda: self._is_closed or len(self._queue))
                elif pause_s > 0:
                    self._changed.wait_for(lambda: self._is_closed, pause_s)
                if self._is_closed and (0 < pause_s < inf or not len(self._queue)):
                    return

    def step(self) -> float:
        """Send the next message, and return the seconds until the next attempt (inf: until `put`)."""
        with self._changed:
            alarm, wait_s = self._queue.next(self._clock())
            left_out = self._queue.left_out
        if alarm is None:
            return wait_s
        self._sending_since_s = self._clock()
        try:
            self._send(self._describe(alarm, left_out))
        except Exception as failure:  # the library of any service may raise anything
            self._note_failure(failure)
            if isinstance(failure, ValueError) or getattr(failure, "code", 0) in REFUSED:
                with self._changed:
                    self._queue.drop(alarm)  # otherwise this alarm would block all later messages
            pause_s, self._retry_s = self._retry_s, min(2 * self._retry_s, MOST_RETRY_S)
            return pause_s
        finally:
            self._sending_since_s = inf
        self.trouble, self._retry_s = "", RETRY_S
        self.sent += 1
        with self._changed:
            self._queue.note_sent(alarm)
        return 0.0

    def _note_failure(self, failure: Exception) -> None:
        reason = str(failure) if isinstance(failure, OSError) else type(failure).__name__
        trouble = f"{self.name} takes no messages: {printable(reason)[:200]}"
        if trouble != self.trouble:
            self.trouble = trouble
            _log.warning("%s", trouble)


class Notifications:
    """The part of the gateway: passes alarms on to all targets."""

    def __init__(self, senders: list[Sender], kinds: Collection[str]) -> None:
        self._senders = senders
        self._kinds = kinds
        self._threads: list[asyncio.Future[None]] = []

    def take(self, batch: Batch) -> None:
        """Ignore the batch: alarms arrive by `note_alarm`."""

    def note_alarm(self, alarm: Alarm, change: AlarmChange) -> None:
        """Queue a message for an alarm that began or ended, but none for an acknowledgement or a new text."""
        if alarm.kind in self._kinds and change is not AlarmChange.CHANGED:
            for sender in self._senders:
                sender.put(alarm)

    async def run(self) -> None:
        """Run the senders, each in its own thread, until cancelled."""
        self._threads = [supervisor().thread(one.name, inf, one.run) for one in self._senders]
        await asyncio.gather(*map(asyncio.shield, self._threads))

    async def close(self) -> None:
        """Send the messages that may be sent now, for at most CLOSE_S."""
        for sender in self._senders:
            sender.close()
        if self._threads:
            await asyncio.wait(self._threads, timeout=CLOSE_S)

    def health(self) -> str:
        """Return why messages cannot be sent; "" if sending works."""
        return next((one.problem for one in self._senders if one.problem), "")

    def figures(self) -> list[MetricFamily]:
        """Return a metric: messages sent since the start."""
        sent = sum(one.sent for one in self._senders)
        return [counter("multidrop_notifications_sent", "Messages about alarms that targets took.", sent)]
