"""The optional parts of the gateway, such as the history, MQTT, databases and the OPC UA server.

Each part has a table in `[serve]` of the plant file. If a part fails, the failure is counted and logged, and
the other parts continue.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable, Mapping, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from multidrop import Plant
from multidrop.gateway.commands import Commands
from multidrop.gateway.http.rights import Tokens
from multidrop.gateway.live.alarms import Alarms
from multidrop.gateway.live.hub import Hub
from multidrop.printable import install_command
from multidrop.supervisor import supervisor

BUILD_S = 3.0  # in s: how long a start or a reload waits for parts that are being built
END_S = 3.0  # time limit, in s, for closing one part, such as MQTT

# The Python module of each part, and the class of its settings, by the name of the part's table. A module is
# imported if the plant file has the table. The class is a frozen dataclass of the table's keys and their
# defaults. The module's function `build(settings, context)` returns a Part.
PARTS: Mapping[str, str] = {
    "fleet": "multidrop.fleet.page_part:FleetSettings",
    "history": "multidrop.gateway.historian:HistorySettings",
    "influx": "multidrop.gateway.forward.http:InfluxSettings",
    "modbus": "multidrop.gateway.modbus_server.server:ModbusSettings",
    "mqtt": "multidrop.gateway.mqtt.part:MqttSettings",
    "notify": "multidrop.gateway.notifications:NotifySettings",
    "opcua": "multidrop.gateway.opcua.part:OpcUaSettings",
    "postgres": "multidrop.gateway.forward.postgres:PostgresSettings",
    "tool": "multidrop.gateway.modbus_server.tool_ports:ToolSettings",
    "trigger": "multidrop.gateway.live.triggers:TriggerSettings",
    "upload": "multidrop.gateway.forward.http:UploadSettings",
}
# extras of multidrop, by the library that they install
EXTRAS = {"pyarrow": "parquet", "psycopg": "postgres"}

# A function that reads any registers of a drive, whether the drive declares them or not. Its arguments are
# the drive, the Modbus function, the first address, the count, and the expiry in s.
Ask = Callable[[str, int, int, int, float], Awaitable[list[int]]]

_log = logging.getLogger("multidrop.gateway")


class PartContext(NamedTuple):
    """The objects of the gateway that a part may use."""

    plant: Plant
    hub: Hub
    commands: Commands
    ask: Ask
    folder: Path  # folder to which paths in the settings are relative
    version: str
    alarms: Alarms
    tokens: Tokens
    page: str = ""  # address of the gateway's page; "": unknown


class Part(Protocol):
    """A part of the gateway, which is an optional interface or service, such as MQTT.

    Five more methods are optional. `take(batch)` is called with each batch of polled values, in the event
    loop, and must return within 1 ms. `adopt(plant)` is called after a reload, and `note_alarm(alarm,
    change)` when an alarm starts, changes or ends. `health()` returns a problem or "", and `figures()`
    returns metric families. The part `fleet` may have the attribute `source`, from which the gateway then
    gets values instead of polling lines.
    """

    async def run(self) -> None:
        """Do the work of the part until this task is cancelled."""

    async def close(self) -> None:
        """Close the part. Called after the last batch of polled values."""


class PartHost(Protocol):
    """The methods and attributes of the gateway that LiveParts uses."""

    plant: Plant

    def part_context(self, plant: Plant) -> PartContext: ...
    def guarded(self, name: str, work: Callable[..., object], *arguments: object) -> None: ...
    def count_failure(self, name: str) -> None: ...


def build(name: str, settings: object, context: PartContext) -> Part:
    """Build the part with this table and settings, and return it.

    If a library is missing, raises ValueError with the name of the extra that installs it.
    """
    try:
        module, _, _ = PARTS[name].partition(":")
        part: Part = import_module(module).build(settings, context)
    except ImportError as missing:
        raise ValueError(missing_library(name, missing)) from missing
    return part


def missing_library(name: str, missing: ImportError) -> str:
    """Return the error message if a library that this part needs is not installed."""
    library = missing.name or str(missing)
    extra = EXTRAS.get(library.partition(".")[0], name)
    return f"the library {library} is not installed: {install_command(extra)}"


class Building(NamedTuple):
    """An optional part of the gateway, such as MQTT, that a thread is building or has built.

    Building may take long if a disk does not answer.
    """

    settings: Any
    part: asyncio.Future[Part]


class LiveParts:
    """The optional parts of the gateway, such as MQTT, from their start to their end.

    `feeds` has the running parts by name. A part's name is that of its table in `[serve]` of the plant file.
    If a part's files are on a disk that does not answer, the gateway starts without the part, which is in
    `pending` until it is built.
    """

    def __init__(self, host: PartHost) -> None:
        self.feeds: dict[str, Part] = {}
        self.dead: dict[str, str] = {}  # reasons why parts could not start, by part
        self.pending: dict[str, Building] = {}
        self._host = host
        self._settings: dict[str, Any] = {}
        self._built: dict[str, Building] = {}  # parts that are being built, or are built but not started
        # previous settings of parts that the present reload has closed, by part
        self._replaced: dict[str, Any] = {}

    def source(self) -> Any:
        """Return the source of values that replaces polling: `source` of a part that is not started yet.

        Return None if no such part has it; then the gateway polls lines.
        """
        built = [one.part.result() for one in self._built.values() if one.part.done()]
        sources = (getattr(part, "source", None) for part in built)
        return next((source for source in sources if source is not None), None)

    def call(self, method: str, *arguments: object) -> None:
        """Call this method of each running part that has it.

        If the call fails for one part, continue with the others.
        """
        for name, part in self.feeds.items():
            if hasattr(part, method):
                self._host.guarded(name, getattr(part, method), *arguments)

    def take_up(self) -> None:
        """Start the new parts. Called when the plant for which they were built is in effect."""
        built, self._built, self._replaced = self._built, {}, {}
        for name, building in built.items():
            self._settings[name] = building.settings
            self.dead.pop(name, None)
            if building.part.done():
                self._start(name, building.part.result())
            else:
                _log.warning("%s starts later, when the disk with its files answers", name)
                self.pending[name] = building
                supervisor().start(f"{name} pending", self._start_when_built(name, building))

    async def close(self, seconds: float) -> None:
        """Close all parts concurrently within `seconds`. Call this after the last batch of polled values."""
        await self._discard()
        await self._drop([*self._settings], seconds)

    # ---- reload ----

    async def replace(self, wanted: Mapping[str, Any], plant: Plant) -> None:
        """Use the settings of a changed plant file; `wanted` has them by part.

        Parts with unchanged settings continue. Changed and removed parts are closed, and then changed and new
        parts are built. If one cannot be opened, start the previous parts again, and raise ValueError.
        """
        self._replaced = {name: one for name, one in self._settings.items() if wanted.get(name) != one}
        await self._drop([*self._replaced], END_S)
        new = {name: settings for name, settings in wanted.items() if name not in self._settings}
        try:
            await self.build(new, plant)
        except Exception:
            await self.take_back()
            raise

    async def take_back(self) -> None:
        """Undo `replace`: close the parts that it built, and start again those that it closed."""
        replaced = self._replaced
        await self._discard()
        for name, settings in replaced.items():
            try:
                await self.build({name: settings}, self._host.plant)
                self.take_up()
            except Exception as failure:  # for example, another program has opened the part's port
                self.dead[name] = str(failure)
                _log.error("%s could not be restarted: %s", name, failure)

    async def build(self, wanted: Mapping[str, Any], plant: Plant) -> None:
        """Build these parts concurrently, and wait up to BUILD_S.

        Raises ValueError if a part cannot be opened.
        """
        context, threads = self._host.part_context(plant), supervisor()
        self._built = {
            name: Building(settings, threads.thread(name, BUILD_S, partial(build, name, settings, context)))
            for name, settings in wanted.items()
        }
        if self._built:
            await asyncio.wait([one.part for one in self._built.values()], timeout=BUILD_S)
        for name, building in self._built.items():
            failure = building.part.exception() if building.part.done() else None
            if failure is not None:
                await self._discard()
                if isinstance(failure, (ValueError, OSError)):
                    raise ValueError(f"[serve.{name}]: {failure}") from failure
                raise failure

    async def _discard(self) -> None:
        """Close the parts of the gateway that `take_up` has not started.

        A part that a thread is still building is closed when it is built.
        """
        built, self._built = self._built, {}
        await _close_when_built(built)

    # ---- one part ----

    async def _start_when_built(self, name: str, building: Building) -> None:
        """Start a part as soon as it is built, unless a reload or the shutdown has removed it meanwhile."""
        await asyncio.wait([building.part])
        if self.pending.get(name) is not building:
            return
        del self.pending[name]
        failure = building.part.exception()
        if failure is None:
            part: Any = building.part.result()
            if hasattr(part, "adopt"):  # a reload may have changed the plant while the part was built
                self._host.guarded(name, part.adopt, self._host.plant)
            self._start(name, part)
            return
        self.dead[name] = str(failure)
        _log.error("%s cannot start: %s", name, failure)

    def _start(self, name: str, part: Part) -> None:
        self.feeds[name] = part
        supervisor().keep(name, self._run(name, part))

    async def _run(self, name: str, part: Part) -> None:
        try:
            await part.run()
        except Exception:
            self._host.count_failure(name)
            raise

    async def _drop(self, names: Sequence[str], seconds: float) -> None:
        """Remove the parts with these names, and close them concurrently."""
        for name in names:
            del self._settings[name]
            self.dead.pop(name, None)
        await _close_when_built({name: self.pending.pop(name) for name in names if name in self.pending})
        parts = {name: self.feeds.pop(name) for name in names if name in self.feeds}
        await supervisor().release(*names)
        await asyncio.gather(*(_close(name, part, seconds) for name, part in parts.items()))


async def _close_when_built(built: Mapping[str, Building]) -> None:
    """Close the parts that are built, and the others as soon as they are built."""

    async def close(name: str, part: asyncio.Future[Part]) -> None:
        await asyncio.wait([part])
        if part.exception() is None:
            await _close(name, part.result(), END_S)

    closing = {
        name: supervisor().start(f"{name} closing", close(name, one.part)) for name, one in built.items()
    }
    await asyncio.gather(*(closing[name] for name, one in built.items() if one.part.done()))


async def _close(name: str, part: Part, seconds: float) -> None:
    try:
        await asyncio.wait_for(part.close(), seconds)
    except Exception:
        _log.exception("closing %s failed", name)
