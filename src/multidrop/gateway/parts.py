"""Parts: what may be plugged into the gateway, by the name of its table in `[serve]`.

A part is fed with every batch, and may die alone: what it raises is counted and logged, and the others go on.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from multidrop import Batch, Plant
from multidrop.gateway.commands import Commands
from multidrop.gateway.live.hub import Hub


class Part(NamedTuple):
    """A module, with the names in it: of the gateway, or of another client of the library."""

    module: str
    settings: str  # a frozen dataclass: the keys of its table, with their defaults
    build: str  # a function of the settings and of Inside, which returns a Feed
    extra: str  # that installs what it needs; "": nothing


PARTS: Mapping[str, Part] = {
    "fleet": Part("multidrop.fleet.page_part", "FleetSettings", "build", "fleet"),
    "history": Part("multidrop.gateway.historian", "HistorySettings", "build", "history"),
    "modbus": Part("multidrop.gateway.modbus_server.server", "ModbusSettings", "build", ""),
    "mqtt": Part("multidrop.gateway.mqtt.part", "MqttSettings", "build", "mqtt"),
}

# Registers past the table of a drive, by name: function, first address, number, and seconds it may wait.
Ask = Callable[[str, int, int, int, float], Awaitable[list[int]]]


class Inside(NamedTuple):
    """The gateway, as its parts see it."""

    plant: Plant
    hub: Hub
    commands: Commands
    ask: Ask
    folder: Path  # for what is kept: relative paths of settings are relative to it
    version: str
    page: str = ""  # the address of the gateway's page; "": other machines have none


class Feed(Protocol):
    """A part that was built.

    It may have `adopt(plant)`, which is told of another plant once the hub has it, `health()`, which says
    what is not well, and `figures()`, a list of families for the metrics.
    """

    def take(self, batch: Batch) -> None:
        """Take rows, in the loop, within 1 ms."""

    async def run(self) -> None:
        """Live, until cancelled."""

    async def close(self) -> None:
        """End in good order, after the last batch."""


def settings_class(part: Part) -> Any:
    """Return the dataclass of a part's settings. Raises ValueError where this build has no such part."""
    return getattr(_module(part), part.settings)


def build(part: Part, settings: object, inside: Inside) -> Feed:
    """Return the part. Raises ValueError, with the extra to install, where a library is missing."""
    make = getattr(_module(part), part.build)
    try:
        feed: Feed = make(settings, inside)
    except ImportError as missing:
        name = missing.name or str(missing)
        extra = f"pip install 'multidrop[{part.extra}]'" if part.extra else f"install {name}"
        raise ValueError(f"it needs {name}, which is not installed: {extra}") from missing
    return feed


def _module(part: Part) -> Any:
    try:
        return import_module(part.module)
    except ModuleNotFoundError as missing:
        if missing.name != part.module:
            raise
        raise ValueError("this version of multidrop has no such part; leave the table out") from None
