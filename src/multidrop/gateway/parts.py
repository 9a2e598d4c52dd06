"""The optional parts of the gateway, such as the history, MQTT, databases and the OPC UA server.

Each part has a table in `[serve]`. If a part fails, the failure is counted and logged, and the other parts
continue.
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

BUILD_S = 3.0  # how long a start or a reload waits for parts whose disks do not answer
END_S = 3.0  # time limit for closing a part

# Module of each part, imported when its table is used. The module has `Settings`, a frozen dataclass of the
# table's keys and their defaults, and `build(settings, context)`, which returns a Part.
PARTS: Mapping[str, str] = {
    "fleet": "multidrop.fleet.page_part",
    "history": "multidrop.gateway.historian",
    "influx": "multidrop.gateway.forward.influx",
    "modbus": "multidrop.gateway.modbus_server.server",
    "mqtt": "multidrop.gateway.mqtt.part",
    "notify": "multidrop.gateway.notifications",
    "opcua": "multidrop.gateway.opcua.part",
    "postgres": "multidrop.gateway.forward.postgres",
    "tool": "multidrop.gateway.modbus_server.tool_ports",
    "trigger": "multidrop.gateway.live.triggers",
    "upload": "multidrop.gateway.forward.upload",
}
# by library: the extra of multidrop that installs it; lists only libraries that several parts need
EXTRAS = {"pyarrow": "parquet", "psycopg": "postgres"}

# A function that reads any registers of a drive, declared or not. Its arguments: drive, Modbus function,
# first address, count, expiry in s.
Ask = Callable[[str, int, int, int, float], Awaitable[list[int]]]

_log = logging.getLogger("multidrop.gateway")


class PartContext(NamedTuple):
    """The objects of the gateway that a part may use."""

    plant: Plant
    hub: Hub
    commands: Commands
    ask: Ask
    folder: Path  # base of relative paths in the settings
    version: str
    alarms: Alarms
    tokens: Tokens
    page: str = ""  # address of the gateway's page; "": unknown


class Part(Protocol):
    """The methods of a part, which is one interface of the gateway, such as MQTT.

    Five more methods are optional. `take(batch)` is called with each batch of rows, in the event loop, and
    must return within 1 ms. `adopt(plant)` is called after a reload, and `note_alarm(alarm, change)` when an
    alarm starts, changes or ends. `health()` returns a problem or "", and `figures()` returns metric
    families. The part `fleet` may have the attribute `source`, which the gateway uses instead of a poller.
    """

    async def run(self) -> None:
        """Do the part's work until this task is cancelled."""

    async def close(self) -> None:
        """Close the part. Called after the last batch."""


class PartHost(Protocol):
    """The methods of the gateway that LiveParts uses."""

    plant: Plant

    def part_context(self, plant: Plant) -> PartContext: ...
    def guarded(self, name: str, work: Callable[..., object], *arguments: object) -> None: ...
    def count_failure(self, name: str) -> None: ...


def build(name: str, settings: object, context: PartContext) -> Part:
    """Build and return the part of this table.

    If a library is missing, raises ValueError with the name of the extra that installs it.
    """
    try:
        part: Part = import_module(PARTS[name]).build(settings, context)
    except ImportError as missing:
        raise ValueError(missing_library(name, missing)) from missing
    return part


def missing_library(name: str, missing: ImportError) -> str:
    """Return the error message for this part: a library that it needs is not installed."""
    library = missing.name or str(missing)
    extra = EXTRAS.get(library.partition(".")[0], name)
    return f"it needs {library}, which is not installed: {install_command(extra)}"


class Building(NamedTuple):
    """A part that a thread builds, because the part's files may be on a disk that does not answer."""

    settings: Any
    part: asyncio.Future[Part]


class LiveParts:
    """The running parts, in `feeds` by the name of their table.

    If a part's files are on a disk that does not answer, the gateway starts without that part. The part
    stays in `pending` until it is built.
    """

    def __init__(self, host: PartHost) -> None:
        self.feeds: dict[str, Part] = {}
        self.dead: dict[str, str] = {}  # parts that could not start, and why
        self.pending: dict[str, Building] = {}
        self._host = host
        self._settings: dict[str, Any] = {}
        self._built: dict[str, Building] = {}  # parts that are not started yet
        self._replaced: dict[str, Any] = {}  # settings of the parts that the reload in progress closed

    def source(self) -> Any:
        """Return the attribute `source` of a new part; None if no new part has it."""
        built = [one.part.result() for one in self._built.values() if one.part.done()]
        sources = (getattr(part, "source", None) for part in built)
        return next((source for source in sources if source is not None), None)

    def call(self, method: str, *arguments: object) -> None:
        """Call this method of each running part that has it. If a part's method fails, continue."""
        for name, part in self.feeds.items():
            if hasattr(part, method):
                self._host.guarded(name, getattr(part, method), *arguments)

    def take_up(self) -> None:
        """Start the new parts, because the plant for which they were built is in effect now."""
        built, self._built, self._replaced = self._built, {}, {}
        for name, building in built.items():
            self._settings[name] = building.settings
            self.dead.pop(name, None)
            if building.part.done():
                self._start(name, building.part.result())
            else:
                _log.warning("%s is not ready: it starts when its files answer", name)
                self.pending[name] = building
                supervisor().start(f"{name} pending", self._start_when_built(name, building))

    async def close(self, seconds: float) -> None:
        """Close all parts together within `seconds`, after the last batch."""
        await self._discard()
        await self._drop([*self._settings], seconds)

    # ---- reload ----

    async def replace(self, wanted: Mapping[str, Any], plant: Plant) -> None:
        """Close the parts whose tables were changed or removed, and build the new parts.

        If a new part cannot be opened, the previous parts are started again, and ValueError is raised.
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
        """Discard the new parts and start the previous ones again."""
        replaced = self._replaced
        await self._discard()
        for name, settings in replaced.items():
            try:
                await self.build({name: settings}, self._host.plant)
                self.take_up()
            except Exception as failure:  # for example, another program uses the part's port now
                self.dead[name] = str(failure)
                _log.error("%s did not start again: %s", name, failure)

    async def build(self, wanted: Mapping[str, Any], plant: Plant) -> None:
        """Build parts concurrently, waiting up to BUILD_S. Raises ValueError if a part cannot be opened."""
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
        """Close the parts that were not started; a part still under construction is closed later."""
        built, self._built = self._built, {}
        await _close_when_built(built)

    # ---- one part ----

    async def _start_when_built(self, name: str, building: Building) -> None:
        """Start a part once it is built, unless a reload or the shutdown has removed the part by then."""
        await asyncio.wait([building.part])
        if self.pending.get(name) is not building:
            return
        del self.pending[name]
        failure = building.part.exception()
        if failure is None:
            part: Any = building.part.result()
            if hasattr(part, "adopt"):  # the plant may have been reloaded in the meantime
                self._host.guarded(name, part.adopt, self._host.plant)
            self._start(name, part)
            return
        self.dead[name] = str(failure)
        _log.error("%s does not start: %s", name, failure)

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
    """Close the parts that are built; let each part that is still being built be closed afterwards."""

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
    except Exception:  # continue: the other parts must be closed too
        _log.exception("closing %s failed", name)
