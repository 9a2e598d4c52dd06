"""Live parts: each with its task, and what replaces them when the plant file is read again."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from multidrop import Plant
from multidrop.gateway.parts import PARTS, Feed, Inside, build
from multidrop.gateway.reload import beside

if TYPE_CHECKING:
    from multidrop.gateway.gateway import Gateway

END_S = 3.0  # that a part may take to end

_log = logging.getLogger("multidrop.gateway")


class Replacement(NamedTuple):
    """Parts that were built and do not live yet, and the settings of those that ended for them."""

    built: dict[str, Feed]
    wanted: Mapping[str, Any]
    before: Mapping[str, Any]


class LiveParts:
    """The parts of a gateway, by the names of their tables; `feeds` are those that are fed."""

    def __init__(self, gateway: Gateway) -> None:
        self.feeds: dict[str, Feed] = {}
        self._gateway = gateway
        self._settings: dict[str, Any] = {}
        self._tasks: dict[str, asyncio.Task[None]] = {}

    def build(self, wanted: Mapping[str, Any]) -> None:
        """Build the parts that a gateway begins with. Raises ValueError with what cannot be opened."""
        self._build(wanted, self._gateway.plant, self.feeds)
        self._settings = dict(wanted)

    def start(self) -> None:
        """Let all that were built live."""
        for name, feed in self.feeds.items():
            self._start(name, feed)

    async def close(self) -> None:
        """End all of them, after the last batch."""
        for task in self._tasks.values():
            task.cancel()
        await asyncio.gather(*self._tasks.values(), return_exceptions=True)
        for name, feed in self.feeds.items():
            await _closed(name, feed)

    # ---- a plant file that was read again ----

    async def replace(self, wanted: Mapping[str, Any], plant: Plant) -> Replacement:
        """End the parts whose tables changed or are gone, and build those that there are instead.

        Raises ValueError with what cannot be opened; the parts from before live on then.
        """
        changed = [name for name, settings in self._settings.items() if wanted.get(name) != settings]
        before = {name: self._settings[name] for name in changed}
        for name in changed:
            await self._end(name)
        new = {name: settings for name, settings in wanted.items() if name not in self._settings}
        replacement = Replacement({}, new, before)
        try:
            await beside(partial(self._build, new, plant, replacement.built))  # a folder may be large
        except Exception:
            await self.take_back(replacement)
            raise
        return replacement

    def take_up(self, replacement: Replacement) -> None:
        """Let the parts live that were built: the plant is theirs now."""
        for name, feed in replacement.built.items():
            self._take_up(name, feed, replacement.wanted[name])

    async def take_back(self, replacement: Replacement) -> None:
        """Go on with the parts from before."""
        for name, feed in replacement.built.items():
            await _closed(name, feed)
        for name, settings in replacement.before.items():
            again: dict[str, Feed] = {}
            try:
                await beside(partial(self._build, {name: settings}, self._gateway.plant, again))
            except Exception as failure:  # its port may have gone to another program meanwhile
                self._gateway.dead[name] = str(failure)
                _log.error("%s did not come back: %s", name, failure)
            for feed in again.values():
                self._take_up(name, feed, settings)

    # ---- one part ----

    def _build(self, wanted: Mapping[str, Any], plant: Plant, built: dict[str, Feed]) -> None:
        gateway = self._gateway
        folder = gateway.settings.folder
        inside = Inside(plant, gateway.hub, gateway.commands, gateway.ask, folder, gateway.version)
        for name, settings in wanted.items():
            try:
                built[name] = build(PARTS[name], settings, inside)
            except (ValueError, OSError) as failure:
                raise ValueError(f"[serve.{name}]: {failure}") from failure

    def _take_up(self, name: str, feed: Feed, settings: Any) -> None:
        self._gateway.dead.pop(name, None)
        self._settings[name] = settings
        self.feeds[name] = feed
        self._start(name, feed)

    def _start(self, name: str, feed: Feed) -> None:
        self._tasks[name] = asyncio.create_task(self._live(name, feed), name=name)

    async def _live(self, name: str, feed: Feed) -> None:
        try:
            await feed.run()
        except Exception as failure:  # it dies alone
            self._gateway.dead[name] = f"{type(failure).__name__}: {failure}"
            self._gateway.note_failure(name)

    async def _end(self, name: str) -> None:
        feed, task = self.feeds.pop(name), self._tasks.pop(name)
        del self._settings[name]
        self._gateway.dead.pop(name, None)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        await _closed(name, feed)


async def _closed(name: str, feed: Feed) -> None:
    try:
        await asyncio.wait_for(feed.close(), END_S)
    except Exception:  # the others are closed all the same
        _log.exception("%s did not end in good order", name)
