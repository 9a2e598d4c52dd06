"""Left behind: what a broker still keeps of drives of which the gateway says nothing any more.

A gateway that was killed took nothing back, and its plant file may have lost a drive since. A broker may tell
anything: only topics that such a drive has under this prefix are named, and only so many of them. Pure.
"""

from __future__ import annotations

import json
from collections.abc import Collection
from typing import NamedTuple

from multidrop.gateway.mqtt.home_assistant import DISCOVERY, discovery_topic, object_id

ONLINE, OFFLINE = b"online", b"offline"
MOST_KEPT = 256  # messages of a connection that are looked at; what is more waits for the next one
MOST_DISCOVERY = 1 << 18  # bytes of a configuration


class KeptTopic(NamedTuple):
    """A topic of a drive, of which the broker keeps a message."""

    drive: str
    topic: str


class LeftBehind:
    """Looks for such topics among the messages that a broker kept."""

    def __init__(self, prefix: str, *, home_assistant: bool) -> None:
        self._prefix = prefix
        self._home_assistant = home_assistant
        self.begin()

    def begin(self) -> None:
        """Begin anew, on a new connection."""
        self._is_alone = False  # the gateway of before is gone, and no other one has this prefix
        self._found: list[KeptTopic] = []
        self._looked_at = 0

    def topics(self) -> list[str]:
        """Return what is to be listened to."""
        kept = [f"{self._prefix}/gateway", f"{self._prefix}/+/available"]
        return [*kept, f"{DISCOVERY}/device/+/config"] if self._home_assistant else kept

    def hear(self, topic: str, payload: bytes, there: Collection[str]) -> list[str]:
        """Take a message that was kept; return the topics to be taken back now. `there` are the drives."""
        if topic == f"{self._prefix}/gateway":
            self._is_alone = payload == OFFLINE
        elif self._looked_at < MOST_KEPT:
            self._found += self._topics_of(topic, payload, there)
        if not self._is_alone:
            return []
        found, self._found = self._found, []
        return [one.topic for one in found if one.drive not in there]

    def _topics_of(self, topic: str, payload: bytes, there: Collection[str]) -> list[KeptTopic]:
        """Return the topics of which a message tells that a drive has them that is not there."""
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
            return []  # another gateway's, whose prefix and drive make the same beginning
        return [KeptTopic(drive, topic)]

    def _drive_in(self, topic: str) -> str | None:
        """Return the drive whose values are on this topic."""
        drive = topic.removeprefix(f"{self._prefix}/")
        return drive if drive and topic == f"{self._prefix}/{drive}" and "/" not in drive else None


def _state_topic(payload: bytes) -> str:
    """Return where a drive's values are, as its discovery says; "" where it says nothing of it."""
    if len(payload) > MOST_DISCOVERY:
        return ""
    try:
        said = json.loads(payload)
    except (ValueError, RecursionError):
        return ""
    parts = said.get("cmps") if isinstance(said, dict) else None
    state = parts.get("state") if isinstance(parts, dict) else said  # the whole device had one once
    found = state.get("state_topic") if isinstance(state, dict) else None
    return found if isinstance(found, str) else ""
