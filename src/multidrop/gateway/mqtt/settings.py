"""The table [serve.mqtt] of a plant file, and the published values of a drive."""

from __future__ import annotations

import re
import ssl
from collections.abc import Iterator
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any

from multidrop import Plant, Register
from multidrop.gateway.commands import drives_of
from multidrop.gateway.http.rights import Caller, Right
from multidrop.gateway.live.hub import Hub
from multidrop.gateway.mqtt.broker import Login, parse_broker
from multidrop.plant import check_drive_name
from multidrop.toml_check import parse_duration

LEVEL = re.compile(r"[^+#/\0]+")  # one level of a topic
OTHERS = ("homeassistant", "spBv1.0")  # first levels reserved for discovery and Sparkplug
LEAST_EVERY_S, MOST_EVERY_S = 0.1, 3600.0


@dataclass(frozen=True)
class MqttSettings:
    """The settings of MQTT. Raises ValueError with a line for each mistake."""

    broker: str = "mqtt://localhost:1883"
    prefix: str = "multidrop"
    every: str = "1 s"  # time between two messages of a drive
    user: str = ""
    password: str = ""  # path of the file with the password
    authorities: str = ""  # path of a file of certificates that verify a broker of mqtts://
    home_assistant: bool = False
    sparkplug: str = ""  # the group; "": no Sparkplug
    node: str = ""  # name of the edge node; default: the plant file's name
    commands: bool = False  # allow publishers to write the registers and verbs listed in [serve.may]

    def __post_init__(self) -> None:
        wrong = []
        try:
            parse_broker(self.broker)
        except ValueError as mistake:
            wrong.append(str(mistake))
        try:
            is_right = LEAST_EVERY_S <= self.every_s <= MOST_EVERY_S
        except ValueError:
            is_right = False
        if not is_right:
            wrong.append(f'every = "{self.every}" is not "{LEAST_EVERY_S:g} s" to "{MOST_EVERY_S:g} s"')
        if not all(LEVEL.fullmatch(level) for level in self.prefix.split("/")) or self.prefix[0] == "$":
            wrong.append(f'prefix = "{self.prefix}" is not a valid topic; write prefix = "multidrop"')
        if self.prefix.split("/")[0] in OTHERS:
            wrong.append(f'prefix = "{self.prefix}" is a reserved topic; write prefix = "multidrop"')
        if self.sparkplug == "STATE":
            wrong.append('sparkplug = "STATE" is reserved for Sparkplug hosts; name another group')
        wrong += [
            f'{key} = "{name}" is not one level of a topic: remove + # and /'
            for key, name in (("sparkplug", self.sparkplug), ("node", self.node))
            if name and not LEVEL.fullmatch(name)
        ]
        if wrong:
            raise ValueError("\n".join(wrong))

    @property
    def every_s(self) -> float:
        """Seconds between two messages of a drive."""
        return parse_duration(self.every)

    @property
    def caller(self) -> Caller:
        """The caller of all commands from the broker."""
        return Caller(self.user or "anyone", "mqtt", parse_broker(self.broker).host, Right.WRITE)

    def check(self, plant: Plant) -> list[str]:
        """Return a sentence for each missing file, and each drive name that cannot be a topic."""
        return [*self._mistakes_in(plant)]

    def _mistakes_in(self, plant: Plant) -> Iterator[str]:
        for key, name in (("password", self.password), ("authorities", self.authorities)):
            path = _beside(plant, name)
            if name and not path.is_file():
                yield f'{key} = "{name}": there is no file {path}'
            elif name and key == "authorities" and not _has_certificates(path):
                yield f'authorities = "{name}": {path} has no certificates in PEM'
        for name in drives_of(plant):
            if not LEVEL.fullmatch(name):
                yield f"drive {name!r} cannot be a topic: choose a name without + # and /"
            try:
                check_drive_name(name)  # a plant without a file was not checked
            except ValueError as mistake:
                yield f"drive {name!r}: {mistake}"
        if self.sparkplug and not self.node and not LEVEL.fullmatch(plant.path.stem):
            name = plant.path.stem
            yield f'the plant file\'s name {name!r} cannot be an edge node; add node = "hall-1"'

    def login(self, plant: Plant) -> Login:
        """Return user, password and certificates. Raises OSError if the password cannot be read."""
        password = _beside(plant, self.password).read_text("utf-8").strip() if self.password else ""
        return Login(self.user, password, str(_beside(plant, self.authorities)) if self.authorities else None)


def _has_certificates(path: Path) -> bool:
    try:
        ssl.create_default_context(cafile=str(path))
    except OSError:  # also if the file has no certificates
        return False
    return True


def _beside(plant: Plant, name: str) -> Path:
    """Return the path of a file named relative to the plant file."""
    return plant.path.parent / name


def shown(register: Register[Any], value: float) -> float | str:
    """Return a register's value as published: a number, or the name of a choice."""
    return value if register.values is None else register.format(register.decode(value))


def fresh_values(hub: Hub, drive: str) -> dict[str, float | str | None]:
    """Return the values of a drive's polled registers; None for stale, infinite and missing values."""
    return {
        register.name: shown(register, good[2])
        if is_current and good is not None and newest is good and isfinite(good[2])
        else None
        for register, newest, good, is_current in hub.known(drive)
    }
