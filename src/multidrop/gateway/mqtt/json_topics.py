"""JSON topics: the topic PREFIX/DRIVE has a drive's newest values, and null for each value that is not fresh.

PREFIX/DRIVE/available and PREFIX/gateway have "online" or "offline". PREFIX/DRIVE/told has the results of
commands.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Collection, Mapping
from functools import partial
from typing import Any, NamedTuple

from multidrop import Plant
from multidrop.control import CommandResult
from multidrop.gateway.commands import STOPPING, drives_of
from multidrop.gateway.live.hub import SILENT, published_values
from multidrop.gateway.mqtt.broker import Publication
from multidrop.gateway.mqtt.broker_commands import BrokerCommands
from multidrop.gateway.mqtt.home_assistant import DISCOVERY, discovery, discovery_topic, object_id
from multidrop.gateway.mqtt.settings import MqttSettings
from multidrop.gateway.parts import PartContext
from multidrop.plant import drive_meant
from multidrop.printable import is_number, is_whole

ONLINE, OFFLINE = b"online", b"offline"
MOST_KEPT = 256  # limit of retained messages that are examined on one connection
MOST_DISCOVERY = 1 << 18  # limit, in bytes, of a discovery message that is read
EXAMPLES = {
    "set": '{"value": 25.0, "time": UTC in ms}',
    "act": '{"verb": "start", "drive": "pump-1", "time": UTC in ms}',
}
MOST_BYTES = 65_536  # limit, in bytes, of the message with a write or a verb
NOTHING = b""  # the payload of a message that deletes the topic's retained message
_log = logging.getLogger("multidrop.gateway.mqtt.part")


class KeptTopic(NamedTuple):
    """A topic with a retained message, and the drive that the message is about."""

    drive: str
    topic: str


class RetainedTopics:
    """Finds retained MQTT messages about drives that were removed from the plant.

    Such messages remain if a gateway is killed, and a drive is removed from its plant file before the next
    start. The methods return only topics under the gateway's own prefix, and at most MOST_KEPT topics.
    """

    def __init__(self, prefix: str, *, home_assistant: bool) -> None:
        self._prefix = prefix
        self._home_assistant = home_assistant
        self.begin()

    def begin(self) -> None:
        """Forget the messages that the previous connection brought. Called when a new connection starts."""
        self._is_alone = False  # True: no other gateway is online under this prefix
        self._found: list[KeptTopic] = []
        self._looked_at = 0

    def topics(self) -> list[str]:
        kept = [f"{self._prefix}/gateway", f"{self._prefix}/+/available"]
        return [*kept, f"{DISCOVERY}/device/+/config"] if self._home_assistant else kept

    def hear(self, topic: str, payload: bytes, there: Collection[str]) -> list[str]:
        """Process a retained message, and return the topics whose retained messages must be deleted now.

        `there` has the names of the plant's drives.
        """
        if topic == f"{self._prefix}/gateway":
            self._is_alone = payload == OFFLINE
        elif self._looked_at < MOST_KEPT:
            self._found += self._topics_of(topic, payload, there)
        if not self._is_alone:
            return []
        found, self._found = self._found, []
        return [one.topic for one in found if one.drive not in there]

    def _topics_of(self, topic: str, payload: bytes, there: Collection[str]) -> list[KeptTopic]:
        """Return the topics of a removed drive if this message is about one; else an empty list."""
        if payload in (ONLINE, OFFLINE):
            drive = self._drive_in(topic.removesuffix("/available"))
            if drive is None or drive in there or topic != f"{self._prefix}/{drive}/available":
                return []
            self._looked_at += 1
            return [KeptTopic(drive, topic.removesuffix("/available")), KeptTopic(drive, topic)]
        if not topic.startswith(f"{DISCOVERY}/device/{object_id(self._prefix, '')}"):
            return []
        self._looked_at += 1
        drive = self._drive_in(_state_topic(payload))
        if drive is None or drive in there or topic != discovery_topic(self._prefix, drive):
            # the plant has this drive, or another gateway published the message
            return []
        return [KeptTopic(drive, topic)]

    def _drive_in(self, topic: str) -> str | None:
        """Return the drive whose values are published on this topic; None for any other topic."""
        drive = topic.removeprefix(f"{self._prefix}/")
        return drive if drive and topic == f"{self._prefix}/{drive}" and "/" not in drive else None


def _state_topic(payload: bytes) -> str:
    """Return the topic of a drive's values that a discovery message contains; "" if there is none."""
    if len(payload) > MOST_DISCOVERY:
        return ""
    try:
        message = json.loads(payload)
    except (ValueError, RecursionError):
        return ""
    parts = message.get("cmps") if isinstance(message, dict) else None
    # in messages of earlier versions, the state topic is at the top level
    state = parts.get("state") if isinstance(parts, dict) else message
    found = state.get("state_topic") if isinstance(state, dict) else None
    return found if isinstance(found, str) else ""


class JsonTopics:
    """Publishes values as JSON, and their description for Home Assistant's discovery."""

    kind = "json"

    def __init__(self, settings: MqttSettings, context: PartContext, utc_ms: Callable[[], int]) -> None:
        self.outbox: Any = None
        self._settings = settings
        self._context = context
        self._hub = context.hub
        self._plant = context.plant
        self._commands = BrokerCommands(context.commands, settings.caller, utc_ms, self._report)
        self._available: dict[str, bytes] = {}
        self._left: set[str] = set()  # removed drives whose retained messages must still be deleted
        self._retained_topics = RetainedTopics(settings.prefix, home_assistant=settings.home_assistant)

    def _topic(self, *levels: str) -> str:
        return "/".join((self._settings.prefix, *levels))

    @staticmethod
    def _retained(topic: str, payload: bytes) -> Publication:
        return Publication(topic, lambda: payload, is_retained=True)

    # ---- the methods of Messages ----

    def will(self) -> Publication:
        return self._retained(self._topic("gateway"), OFFLINE)

    def topics(self) -> list[tuple[str, int]]:
        kept = [(topic, 0) for topic in self._retained_topics.topics()]
        if not self._settings.commands:
            return kept
        once = [(self._topic("+", "set", "+"), 0), (self._topic("+", "act"), 0)]
        return [(self._topic("+", "stop"), 1), (self._topic("stop"), 1), *once, *kept]

    def connected(self) -> None:
        self._available.clear()
        self._retained_topics.begin()
        self.outbox.put(self._retained(self._topic("gateway"), ONLINE))
        # repeat the deletions, because the previous connection may have broken before the broker got them
        self._take_back()
        if self._settings.home_assistant:
            for drive in self._hub.drives:
                self._discover(drive)
        self.publish_alarms()
        self.publish()

    def received(self, topic: str, payload: bytes, *, is_retained: bool) -> None:
        levels = topic.removeprefix(self._settings.prefix + "/").split("/")
        is_stop = levels == ["stop"] or levels[1:] == ["stop"]
        if not (is_stop or levels[1:] == ["act"] or (levels[1:2] == ["set"] and len(levels) == 3)):
            if is_retained:
                self._look_back(topic, payload)
        elif not self._settings.commands:
            _log.warning("the broker sent a command, but commands are off: %.100r", topic)
        elif is_stop:
            self._commands.stop(None if levels == ["stop"] else [levels[0]], _id_in(payload))
        else:
            self._command(levels, payload, is_retained=is_retained)

    def _look_back(self, topic: str, payload: bytes) -> None:
        """If this retained message belongs to a removed drive, delete the drive's retained messages."""
        if not self._plant.lines:  # the plant of a fleet has no lines until the fleet's files are read
            return
        for left in self._retained_topics.hear(topic, payload, drives_of(self._plant)):
            self.outbox.put(self._retained(left, NOTHING))

    def _command(self, levels: list[str], payload: bytes, *, is_retained: bool) -> None:
        drive, *what = levels
        try:
            given = _read(payload)
        except ValueError as mistake:
            if what[0] == "act" and any(f'"{verb}"'.encode() in payload for verb in STOPPING):
                self._commands.stop([drive])  # an invalid message must not prevent a stop
            else:
                self._refuse(drive, what, mistake)
            return
        named = given.get("id")
        try:
            if what[0] == "act" and str(given.get("verb")) in STOPPING:
                for one in self._to_stop(drive, given):
                    # wrong options must not prevent a stop, so options are ignored
                    self._commands.stop_by(one, given["verb"], {}, named)
            elif is_retained:  # the broker would deliver a retained command again on every connection
                kept = "it was retained; publish it without retain"
                self._commands.refuse(drive, "/".join(what), kept, named)
            elif what[0] == "set":
                self._commands.write(drive, what[1], *_read_write(given), named)
            else:
                self._commands.act(drive, *_read_act(drive, given), named)
        except ValueError as mistake:
            self._refuse(drive, what, mistake, named)

    def _refuse(self, drive: str, what: list[str], mistake: ValueError, named: object = None) -> None:
        why = f"the message is not {EXAMPLES[what[0]]}: {mistake}"
        self._commands.refuse(drive, "/".join(what), why, named)

    def _to_stop(self, drive: str, given: Mapping[str, Any]) -> list[str]:
        """Return the drive that the topic names, and another drive if the message names one.

        Stopping too many drives is harmless, stopping none is not.
        """
        named, there = given.get("drive"), drives_of(self._plant).keys()
        other = drive_meant(named, there) if isinstance(named, str) else drive
        return [drive, other] if other in there - {drive_meant(drive, there)} else [drive]

    def adopt(self, plant: Plant) -> None:
        """Use another plant, and delete the retained messages of removed drives."""
        self._left = (self._left | drives_of(self._plant).keys()) - drives_of(plant).keys()
        self._plant = plant
        self._take_back()

    def _take_back(self) -> None:
        for drive in sorted(self._left):
            self._available.pop(drive, None)
            topics = [self._topic(drive), self._topic(drive, "available")]
            if self._settings.home_assistant:
                topics.append(discovery_topic(self._settings.prefix, drive))
            for topic in topics:
                self.outbox.put(self._retained(topic, NOTHING))

    # ---- published messages ----

    def publish_alarms(self) -> None:
        self.outbox.put(Publication(self._topic("alarms"), self._active_alarms, is_retained=True))

    def _active_alarms(self) -> bytes:
        return json.dumps([one.as_json() for one in self._context.alarms.lasting]).encode()

    def publish(self) -> None:
        for drive in self._hub.drives:
            self.outbox.put(Publication(self._topic(drive), partial(self._state, drive), is_retained=True))
            available = OFFLINE if self._hub.state(drive) == SILENT else ONLINE
            if self._available.get(drive) != available:
                self._available[drive] = available
                self.outbox.put(self._retained(self._topic(drive, "available"), available))

    def leave(self) -> None:
        """Publish that the gateway and all drives are offline.

        Otherwise a drive that is removed from the plant file before the next start would stay "online".
        """
        self.outbox.put(self.will())
        for drive in self._available:
            self.outbox.put(self._retained(self._topic(drive, "available"), OFFLINE))
        self._available.clear()

    def _state(self, drive: str) -> bytes:
        answer = self._hub.last_answer(drive)
        shown = self._hub.seen(drive)
        payload = {
            "time": None if answer is None else answer[0] // 1_000_000,
            "state": shown.state,
            "fault": shown.fault,
            "values": published_values(self._hub, drive),
        }
        return json.dumps(payload, ensure_ascii=False).encode()

    def _report(self, drive: str, what: str, result: CommandResult, command: str) -> None:
        outcome = {"what": what, "done": result.ok, "text": result.text, "id": command}
        payload = json.dumps(outcome, ensure_ascii=False)
        self.outbox.put(Publication(self._topic(drive, "told"), payload.encode))

    def _discover(self, name: str) -> None:
        _, drive = self._plant.find_drive(name)
        may = self._context.commands.may.write
        writable = [register for register in drive.registers if f"{name}.{register}" in may]
        topics = {
            "state": self._topic(name),
            "gateway": self._topic("gateway"),
            "available": self._topic(name, "available"),
            "set": self._topic(name, "set"),
            "stop": self._topic(name, "stop"),
        }
        payload = discovery(
            drive,
            [register for register, *_ in self._hub.known(name)],
            topics,
            prefix=self._settings.prefix,
            version=self._context.version,
            every_s=self._settings.every_s,
            writable=writable,
            takes_commands=self._settings.commands,
            page=self._context.page,
        )
        self.outbox.put(self._retained(discovery_topic(self._settings.prefix, name), payload))


def _read_write(given: Mapping[str, Any]) -> tuple[float, int]:
    """Return the value and the time (UTC, ms) in the message of a write.

    Raises ValueError for an invalid message.
    """
    _check_keys(given, "value", "time")
    value = given["value"]
    if not is_number(value):
        raise ValueError(f"key 'value' is {value!r}, not a number")
    return value, _time(given)


def _read_act(drive: str, given: Mapping[str, Any]) -> tuple[str, dict[str, object], int]:
    """Return the verb, its options and the time (UTC, ms) in the message of a verb.

    Raises ValueError if the message is invalid, or names another drive than the topic.
    """
    _check_keys(given, "verb", "drive", "time")
    return str(given["verb"]), _options(drive, given), _time(given)


def _options(drive: str, given: Mapping[str, Any]) -> dict[str, object]:
    if given.get("drive", drive) != drive:
        raise ValueError(f"the message names drive {given['drive']!r}, but its topic names {drive!r}")
    options = given.get("options", {})
    if not isinstance(options, dict):
        raise ValueError("key 'options' is not a JSON object")
    return options


def _time(given: Mapping[str, Any]) -> int:
    time: object = given["time"]
    if not is_whole(time):
        raise ValueError("key 'time' is not a whole number of ms")
    return time


def _read(payload: bytes) -> dict[str, Any]:
    if len(payload) > MOST_BYTES:
        raise ValueError(f"the message has {len(payload)} bytes; the limit is {MOST_BYTES}")
    try:
        given = json.loads(payload)
    except RecursionError:
        raise ValueError("the message is nested too deeply") from None
    if not isinstance(given, dict):
        raise ValueError("the message is not a JSON object")
    return given


def _id_in(payload: bytes) -> object:
    """Return the command's id in the message of a stop; None if the message is invalid or has no id."""
    try:
        return _read(payload).get("id")
    except ValueError:
        return None


def _check_keys(given: Mapping[str, Any], *keys: str) -> None:
    for key in keys:
        if key not in given:
            raise ValueError(f"{key} is missing")
