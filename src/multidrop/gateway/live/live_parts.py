"""Live parts: each with its task, and what replaces them when the plant file is read again."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from multidrop import Plant
from multidrop.gateway.parts import PARTS, Feed, Inside, build
from multidrop.supervisor import supervisor

if TYPE_CHECKING:
    from multidrop.gateway.gateway import Gateway

START_S = 2.0  # for which a start waits for parts whose files do not answer
BUILD_S = 5.0  # for which a reload waits for them
END_S = 3.0  # that a part may take to end

_log = logging.getLogger("multidrop.gateway")


class Replacement(NamedTuple):
    """Parts that were built and not started, and the settings of the parts that they replace."""

    built: dict[str, Building]
    before: Mapping[str, Any]


class Building(NamedTuple):
    """A part that a thread builds: its files may be on a disk that does not answer."""

    settings: Any
    plant: Plant
    feed: asyncio.Future[Feed]


class LiveParts:
    """The parts of a gateway, by the names of their tables; `feeds` are those that are fed.

    A part whose files do not answer delays nothing: it is in `coming` until it is built.
    """

    def __init__(self, gateway: Gateway) -> None:
        self.feeds: dict[str, Feed] = {}
        self.dead: dict[str, str] = {}  # parts that could not start, and why
        self.coming: dict[str, Building] = {}
        self._gateway = gateway
        self._settings: dict[str, Any] = {}
        self._built: dict[str, Building] = {}  # and not started

    async def build(self, wanted: Mapping[str, Any]) -> dict[str, Building]:
        """Build the parts that a gateway begins with. Raises ValueError with what cannot be opened."""
        self._built = await self._build(wanted, self._gateway.plant, START_S)
        return self._built

    def take_up(self, built: Mapping[str, Building]) -> None:
        """Let these parts live: the plant is theirs now."""
        self._built = {}
        for name, building in built.items():
            self._settings[name] = building.settings
            self.dead.pop(name, None)
            if building.feed.done():
                self._begin(name, building.feed.result())
            else:
                _log.warning("%s is not there yet: it begins when its files have answered", name)
                self.coming[name] = building
                supervisor().start(f"{name} comes", self._come(name, building))

    async def close(self, seconds: float) -> None:
        """End all of them at once, after the last batch, within so many seconds."""
        await _discard(self._built)
        await self._drop([*self._settings], seconds)

    # ---- a plant file that was read again ----

    async def replace(self, wanted: Mapping[str, Any], plant: Plant) -> Replacement:
        """End the parts whose tables changed or are gone, and build those that there are instead.

        Raises ValueError with what cannot be opened; the parts from before live on then.
        """
        before = {name: one for name, one in self._settings.items() if wanted.get(name) != one}
        await self._drop([*before], END_S)
        new = {name: settings for name, settings in wanted.items() if name not in self._settings}
        try:
            return Replacement(await self._build(new, plant), before)
        except Exception:
            await self.take_back(Replacement({}, before))
            raise

    async def take_back(self, replacement: Replacement) -> None:
        """Go on with the parts from before."""
        await _discard(replacement.built)
        for name, settings in replacement.before.items():
            try:
                self.take_up(await self._build({name: settings}, self._gateway.plant))
            except Exception as failure:  # its port may have gone to another program meanwhile
                self.dead[name] = str(failure)
                _log.error("%s did not come back: %s", name, failure)

    # ---- one part ----

    async def _build(
        self, wanted: Mapping[str, Any], plant: Plant, seconds: float = BUILD_S
    ) -> dict[str, Building]:
        """Build parts side by side; wait so long for them. Raises ValueError with what cannot be opened."""
        gateway, threads = self._gateway, supervisor()
        folder, page = gateway.settings.folder, gateway.settings.page
        inside = Inside(plant, gateway.hub, gateway.commands, gateway.ask, folder, gateway.version, page)
        built = {
            name: Building(
                settings, plant, threads.thread(name, BUILD_S, partial(build, PARTS[name], settings, inside))
            )
            for name, settings in wanted.items()
        }
        try:
            if built:
                await asyncio.wait([one.feed for one in built.values()], timeout=seconds)
        except asyncio.CancelledError:
            await _discard(built)
            raise
        for name, building in built.items():
            failure = building.feed.exception() if building.feed.done() else None
            if failure is not None:
                await _discard(built)
                if isinstance(failure, (ValueError, OSError)):
                    raise ValueError(f"[serve.{name}]: {failure}") from failure
                raise failure
        return built

    async def _come(self, name: str, building: Building) -> None:
        """Begin a part when its files have answered, unless it is no longer wanted."""
        await asyncio.wait([building.feed])
        if self.coming.get(name) is not building:
            return  # it was dropped
        del self.coming[name]
        failure = building.feed.exception()
        if failure is None:
            feed: Any = building.feed.result()
            if building.plant is not self._gateway.plant and hasattr(feed, "adopt"):
                self._gateway.guarded(name, feed.adopt, self._gateway.plant)
            self._begin(name, feed)
            return
        self.dead[name] = str(failure)
        _log.error("%s does not begin: %s", name, failure)

    def _begin(self, name: str, feed: Feed) -> None:
        self.feeds[name] = feed
        supervisor().keep(name, self._live(name, feed))

    async def _live(self, name: str, feed: Feed) -> None:
        try:
            await feed.run()
        except Exception:
            self._gateway.count_failure(name)
            raise

    async def _drop(self, names: Sequence[str], seconds: float) -> None:
        """End parts side by side."""
        for name in names:
            del self._settings[name]
            self.dead.pop(name, None)
        await _discard({name: self.coming.pop(name) for name in names if name in self.coming})
        feeds = {name: self.feeds.pop(name) for name in names if name in self.feeds}
        await supervisor().release(*names)
        await asyncio.gather(*(_closed(name, feed, seconds) for name, feed in feeds.items()))


async def _discard(built: Mapping[str, Building]) -> None:
    """Close parts that do not live, each as soon as it is built."""
    closing = [supervisor().start(f"{name} goes", _close_built(name, one)) for name, one in built.items()]
    there = [task for task, one in zip(closing, built.values(), strict=True) if one.feed.done()]
    await asyncio.gather(*there)


async def _close_built(name: str, building: Building) -> None:
    await asyncio.wait([building.feed])
    if building.feed.exception() is None:
        await _closed(name, building.feed.result(), END_S)


async def _closed(name: str, feed: Feed, seconds: float) -> None:
    try:
        await asyncio.wait_for(feed.close(), seconds)
    except Exception:  # the others are closed all the same
        _log.exception("%s did not end in good order", name)
