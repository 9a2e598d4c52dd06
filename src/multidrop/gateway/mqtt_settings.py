"""Settings of MQTT, the table [serve.mqtt] of a plant file, and the values that are said of a drive."""

from __future__ import annotations

import re
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from multidrop import Plant, Register
from multidrop.gateway.broker import Login, parse_broker
from multidrop.gateway.hub import Hub

LEVEL = re.compile(r"[^+#/\0]+")  # one level of a topic
LEAST_EVERY_S, MOST_EVERY_S = 0.1, 3600.0


@dataclass(frozen=True)
class MqttSettings:
    """The table [serve.mqtt]. Raises ValueError with a sentence in a line for each mistake."""

    broker: str = "mqtt://localhost:1883"
    prefix: str = "multidrop"
    every: float = 1.0  # s between two messages of a drive
    user: str = ""
    password: str = ""  # a file that has it
    authorities: str = ""  # a file of certificates, by which a broker of mqtts:// is known
    home_assistant: bool = False
    sparkplug: str = ""  # the group; "": no Sparkplug
    node: str = ""  # the edge node's name; "": that of the plant file
    commands: bool = False  # whoever may publish to the broker may then write what [serve.may] lists

    def __post_init__(self) -> None:
        wrong = []
        try:
            parse_broker(self.broker)
        except ValueError as mistake:
            wrong.append(str(mistake))
        if not LEAST_EVERY_S <= self.every <= MOST_EVERY_S:
            wrong.append(f"every = {self.every:g} is not {LEAST_EVERY_S:g} to {MOST_EVERY_S:g} s")
        if not all(LEVEL.fullmatch(level) for level in self.prefix.split("/")) or self.prefix[0] == "$":
            wrong.append(f'prefix = "{self.prefix}" is no topic; write prefix = "multidrop"')
        wrong += [
            f'{key} = "{name}" is not one level of a topic: it has none of + # and /'
            for key, name in (("sparkplug", self.sparkplug), ("node", self.node))
            if name and not LEVEL.fullmatch(name)
        ]
        wrong += [
            f'{key} = "{name}" cannot be read'
            for key, name in (("password", self.password), ("authorities", self.authorities))
            if name and not Path(name).is_file()
        ]
        if wrong:
            raise ValueError("\n".join(wrong))

    def check(self, plant: Plant) -> list[str]:
        """Return a sentence for each drive whose name cannot be a level of a topic."""
        names = [polled.drive.name for line in plant.lines for polled in line.drives]
        return [
            f"drive {name!r} cannot be a topic: give it a name without + # and /"
            for name in names
            if not LEVEL.fullmatch(name) or name == "gateway"
        ]

    def login(self) -> Login:
        """Return what the broker wants to know. Raises OSError where the password cannot be read."""
        password = Path(self.password).read_text("utf-8").strip() if self.password else ""
        return Login(self.user, password, self.authorities or None)


def utc_ms() -> int:
    """Return the time of day."""
    return time.time_ns() // 1_000_000


def shown(register: Register[Any], value: float) -> float | str:
    """Return a number, or the name of a choice."""
    return value if register.values is None else register.format(register.decode(value))


def fresh_values(hub: Hub, drive: str) -> dict[str, float | str | None]:
    """Return the values of a drive's polled registers; None for one that is not fresh."""
    found: dict[str, float | str | None] = {}
    for register in hub.polled(drive):
        newest = hub.newest(drive, register.name) if hub.is_fresh(drive, register.name) else None
        value = newest.value if newest else None
        found[register.name] = None if value is None else shown(register, value)
    return found
