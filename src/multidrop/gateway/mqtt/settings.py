"""The table [serve.mqtt] of a plant file."""

from __future__ import annotations

import re
import ssl
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from multidrop import Plant
from multidrop.gateway.commands import drives_of
from multidrop.gateway.http.rights import Caller, Right
from multidrop.gateway.mqtt.broker import Login, parse_broker
from multidrop.gateway.settings import parsing_mistakes, refuse
from multidrop.plant import check_drive_name
from multidrop.recording import parse_size
from multidrop.toml_check import DURATION, SIZE, parse_duration

LEVEL = re.compile(r"[^+#/\x00]+")  # pattern of one level of an MQTT topic
# topics that start with these levels are reserved for Home Assistant's discovery and Sparkplug
OTHERS = ("homeassistant", "spBv1.0")
LEAST_EVERY_S, MOST_EVERY_S = 0.1, 3600.0
BROKER = r"^[Mm][Qq][Tt][Tt][Ss]?://(\[[0-9A-Fa-f:.]+\]|[^@:/?#\[\]]+)(:[0-9]{1,5})?/*$"
PREFIX = rf"^(?!\$)(?!({'|'.join(OTHERS)})(/|$)){LEVEL.pattern}(/{LEVEL.pattern})*$"


@dataclass(frozen=True)
class MqttSettings:
    """The settings in the table `[serve.mqtt]`. Raises ValueError with a line for each mistake."""

    broker: str = field(default="mqtt://localhost:1883", metadata={"pattern": BROKER})
    prefix: str = field(default="multidrop", metadata={"pattern": PREFIX})
    every: str = field(default="1 s", metadata=DURATION)  # interval of publishing a drive's values
    user: str = ""
    password: str = ""  # path of the file that contains the password
    # for mqtts://: path of a file with certificates that verify the broker; "": those of the operating system
    authorities: str = ""
    home_assistant: bool = False
    # Group id of the Sparkplug edge node; "": Sparkplug is off.
    sparkplug: str = field(default="", metadata={"pattern": rf"^(?!STATE$){LEVEL.pattern}$"})
    # Name of the Sparkplug edge node; default: the plant file's name.
    node: str = field(default="", metadata={"pattern": rf"^{LEVEL.pattern}$"})
    # True: publishers may write the registers and send the verbs that [serve.may] lists
    commands: bool = False
    # True: publish all polled values, also those polled without a connection to the broker
    rows: bool = False
    spool: str = "spool"  # folder for the polled values that are not published yet
    most: str = field(default="1 GB", metadata=SIZE)  # limit of the size of the folder `spool`

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
        wrong += parsing_mistakes(self, most=parse_size)
        if self.sparkplug == "STATE":
            wrong.append('sparkplug = "STATE" is reserved for Sparkplug hosts; name another group')
        wrong += [
            f'{key} = "{name}" is not one level of a topic: remove + # and /'
            for key, name in (("sparkplug", self.sparkplug), ("node", self.node))
            if name and not LEVEL.fullmatch(name)
        ]
        refuse(wrong)

    @property
    def every_s(self) -> float:
        return parse_duration(self.every)

    @property
    def caller(self) -> Caller:
        return Caller(self.user or "anyone", "mqtt", parse_broker(self.broker).host, Right.WRITE)

    @property
    def libraries(self) -> tuple[str, ...]:
        """The names of the Python libraries that these settings need."""
        return ("paho", "pyarrow") if self.rows else ("paho",)

    def check(self, plant: Plant) -> Iterator[str]:
        """Yield a sentence for each missing file, and each drive name that cannot be a topic."""
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
                check_drive_name(name)  # a plant that was not read from a file has unchecked names
            except ValueError as mistake:
                yield f"drive {name!r}: {mistake}"
        if self.sparkplug and not self.node and not LEVEL.fullmatch(plant.path.stem):
            name = plant.path.stem
            yield f'the plant file\'s name {name!r} cannot be an edge node; add node = "hall-1"'

    def login(self, plant: Plant) -> Login:
        """Return the user, password and certificates for the broker.

        Raises OSError if the password cannot be read.
        """
        password = _beside(plant, self.password).read_text("utf-8").strip() if self.password else ""
        return Login(self.user, password, str(_beside(plant, self.authorities)) if self.authorities else None)


def _has_certificates(path: Path) -> bool:
    try:
        ssl.create_default_context(cafile=str(path))
    except OSError:  # OSError is also raised if the file has no certificates
        return False
    return True


def _beside(plant: Plant, name: str) -> Path:
    """Return the path of a file whose name is relative to the plant file."""
    return plant.path.parent / name
