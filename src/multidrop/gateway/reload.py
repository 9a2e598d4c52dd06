"""Reload: read the plant file again while polling continues. A file with mistakes does not take effect."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from math import inf
from typing import TYPE_CHECKING, Any, NamedTuple

from multidrop import Batch, Plant, PlantError, Poller
from multidrop.core import now_ns
from multidrop.gateway import utc_ms
from multidrop.gateway.commands import drives_of
from multidrop.gateway.live.alarms import Limits
from multidrop.gateway.parts import PARTS
from multidrop.gateway.settings import AUDIT_S, check_writable
from multidrop.supervisor import Hung, supervisor

if TYPE_CHECKING:
    from multidrop.gateway.gateway import Gateway
    from multidrop.gateway.settings import ServeSettings

Read = Callable[[], "tuple[Plant, ServeSettings]"]
# keys of the table [serve] that a reload can change without a restart
AT_ONCE = ("names", "tokens", "may", "limit", *PARTS)
READ_S = 10.0  # time limit, in s, for reading the plant file
# in s: a later reload cancels a read of the plant file only after this time
QUICK_S = 1.0
MOST_READS = 8  # limit of concurrent reads of the plant file, because each may hang
# time limit, in s, for putting a plant into effect, which opens ports and stops removed drives
ADOPTION_S = 60.0
# after a reload, rows requested under the previous plant may arrive for this long
SETTLED_NS = 60_000_000_000
RESTART = "takes effect after a restart"
NO_FILE = "this plant was not read from a file, so it cannot be reloaded"

_log = logging.getLogger("multidrop.gateway")


class ReloadResult(NamedTuple):
    """The result of a reload: mistakes in the plant file, or changes that need a restart."""

    is_done: bool
    text: str
    mistakes: tuple[str, ...] = ()
    restart: tuple[str, ...] = ()


class Reload:
    """Reloads the plant file.

    `read` reads it, and raises ValueError or OSError for a file with mistakes. `read` runs in a thread, so a
    file system that hangs makes only this reload fail.
    """

    def __init__(self, gateway: Gateway, read: Read | None) -> None:
        self.mistakes: tuple[str, ...] = ()  # mistakes in the file, found by the latest reload
        self.restart: tuple[str, ...] = ()  # sentences about changes in the file that need a restart
        self._gateway = gateway
        self._read = read
        self._begun_with = dict(gateway.plant.serve)
        self._turn = asyncio.Lock()
        self._soon: asyncio.Task[None] | None = None
        self._is_wanted = False
        self._by = ""  # who asked for the newest reload
        self._is_overtaken = asyncio.Event()  # set when a later reload was requested
        self.coming: Plant | None = None  # the new plant while a reload is putting it into effect, else None
        self._changed: frozenset[str] = frozenset()  # drives that the latest reload changes
        # rows of these drives that were requested before this time are dropped (CLOCK_MONOTONIC, ns)
        self._changed_ns: float = 0

    @property
    def has_file(self) -> bool:
        return self._read is not None

    def begin(self, by: str = "a signal") -> None:
        """Start a reload. If one is in progress, start another after it. Call this in the event loop."""
        self._is_wanted = True
        self._by = by
        self._is_overtaken.set()
        if self._soon is None or self._soon.done():
            self._soon = supervisor().start("reload", self._carry_out_wanted())

    async def _carry_out_wanted(self) -> None:
        while self._is_wanted:
            self._is_wanted = False
            await self.carry_out(self._by)

    async def close(self) -> None:
        if self._soon is not None:
            self._soon.cancel()
            await asyncio.gather(self._soon, return_exceptions=True)

    async def carry_out(self, by: str) -> ReloadResult:
        """Read the plant file and poll its plant.

        If that fails, keep the old plant; the result has the reason.
        """
        self._is_overtaken.set()
        async with self._turn:
            _log.info("reload, asked for by %s", by)
            self._gateway.notifier.send_reloading()
            try:
                result = await self._carry_out()
            except Exception as failure:  # the old plant continues after any failure
                result = self._refused(failure)
            self._gateway.notifier.send("READY=1", self._gateway.status)
            return result

    async def _read_within(self, read: Read) -> tuple[Plant, ServeSettings, Mapping[str, Any]]:
        """Read the file; return its plant, its settings, and how the lines will be polled.

        Raises Hung if reading takes too long, or if a later reload is waiting to read the file.
        """

        def work() -> tuple[Plant, ServeSettings, Mapping[str, Any]]:
            plant, settings = read()
            return plant, settings, _planned(plant)

        self._is_overtaken.clear()
        reading = supervisor().start("reload", supervisor().within("reload", READ_S, work, most=MOST_READS))
        overtaken = supervisor().start("reload", self._is_overtaken.wait())
        await asyncio.wait({reading}, timeout=QUICK_S)
        await asyncio.wait({reading, overtaken}, return_when=asyncio.FIRST_COMPLETED)
        overtaken.cancel()
        if not reading.done():
            reading.cancel()
            raise Hung("this reload was replaced by a later reload")
        return reading.result()

    async def _carry_out(self) -> ReloadResult:
        gateway, poller = self._gateway, self._gateway.poller
        if self._read is None or poller is None:
            return ReloadResult(False, NO_FILE)
        plant, settings, planned = await self._read_within(self._read)
        is_followed = not isinstance(poller, Poller)
        if is_followed and (plant.lines or settings.parts.get("fleet") != gateway.settings.parts["fleet"]):
            raise ValueError(f"a change of [serve.fleet] or [[line]] {RESTART}")
        if gateway.audit:  # refuse the reload if the audit log, which `poller.adopt` opens, is not writable
            await supervisor().within("audit log", AUDIT_S, partial(check_writable, gateway.audit))
        await gateway.parts.replace(settings.parts, plant)
        gateway.hand_out(poller)
        self._changed = frozenset() if is_followed else changed_drives(gateway.plant, plant)
        self._changed_ns = inf
        self.coming = plant
        try:
            unopened = await supervisor().thread("adoption", ADOPTION_S, partial(poller.adopt, plant))
            if is_followed:  # the lines come from a fleet, and the plant file has none
                planned = await supervisor().thread("plan", ADOPTION_S, partial(_planned, poller.plant))
            self._take_up(poller, settings, planned)
            gateway.parts.take_up()
        except Exception:
            # The poller may have changed some lines before it failed: show the plant that it polls.
            if poller.plant.lines != gateway.plant.lines:
                self._take_up(poller, gateway.settings, None)
            await gateway.parts.take_back()
            raise
        finally:
            self.coming = None
            self._changed_ns = min(self._changed_ns, now_ns())
        gateway.note_unopened(unopened)
        self.mistakes, self.restart = (), tuple(self._after_restart(plant, settings))
        for sentence in self.restart:
            _log.warning("%s", sentence)
        _log.info("the plant file is in effect")
        return ReloadResult(True, f"{plant.path.name} is in effect", (), self.restart)

    def _take_up(self, poller: Poller, settings: ServeSettings, planned: Mapping[str, Any] | None) -> None:
        """Show the plant that is polled now, and apply its settings, except those that need a restart."""
        gateway, plant = self._gateway, poller.plant
        gateway.hand_out(poller)  # hand out the values that were polled under the previous plant
        lines = {line.name for line in gateway.plant.lines} - {line.name for line in plant.lines}
        for name in {*gateway.hub.drives} - drives_of(plant).keys() | lines:
            gateway.alarms.forget(name, utc_ms())
        gateway.plant = plant
        gateway.revision += 1
        gateway.commands.note_reload()
        self._take_up_rights(settings)
        gateway.side_reads.cancel()
        gateway.guarded("hub", gateway.hub.adopt, plant, planned)
        gateway.guarded("statistics", gateway.recent.adopt, plant, planned)
        gateway.parts.call("adopt", plant)
        self._changed_ns = now_ns()
        gateway.guarded("frames", gateway.frames.note_news)

    def without_changed_drives(self, batch: Batch) -> Batch:
        """Return the batch without rows of changed drives that were requested before the latest reload ended.

        It is unknown whether their values were polled with the old settings or with the new ones.
        """
        columns = batch.columns() if self._changed else None
        if columns is None or self._changed.isdisjoint(columns.drives):
            return batch
        changed = {code for code, name in enumerate(columns.drives) if name in self._changed}
        rows = enumerate(zip(columns.drive, columns.monotonic_ns, strict=True))
        kept = [at for at, (drive, ns) in rows if ns >= self._changed_ns or drive not in changed]
        if min(columns.monotonic_ns, default=0) >= self._changed_ns + SETTLED_NS:
            self._changed = frozenset()
        return batch if len(kept) == len(columns.time) else batch.at(kept)

    def _after_restart(self, plant: Plant, settings: ServeSettings) -> Iterator[str]:
        """Yield a sentence for each changed key of [serve] that takes effect only after a restart."""
        before, now = self._begun_with, plant.serve
        for key in dict.fromkeys((*before, *now)):
            is_other = before.get(key) != now.get(key)
            if key == "certificate":  # certificate or key may have changed in a file of the same name
                is_other |= settings.certificate != self._gateway.settings.certificate
            if is_other and key not in AT_ONCE:
                yield f"{key} of [serve] {RESTART}"

    def _take_up_rights(self, settings: ServeSettings) -> None:
        gateway, may = self._gateway, settings.may
        now = gateway.settings
        if (settings.behind_proxy, settings.host) != (now.behind_proxy, now.host):
            # The gateway still listens on the old address, so clients without a token there get no new
            # rights.
            may = may.bounded_by(now.may)
        gateway.settings = replace(
            gateway.settings, names=settings.names, tokens=settings.tokens, may=may, limits=settings.limits
        )
        gateway.limits = Limits(settings.limits)
        gateway.commands.may = may
        gateway.own_names.replace(settings.names)
        gateway.tokens.replace(settings.tokens)

    def _refused(self, failure: Exception) -> ReloadResult:
        if not isinstance(failure, (ValueError, OSError)):
            _log.exception("a reload failed")
        mistakes = failure.mistakes if isinstance(failure, PlantError) else (_sentence(failure),)
        for mistake in mistakes:
            _log.error("the previous plant stays in use: %s", mistake)
        self.mistakes = tuple(mistakes)
        return ReloadResult(False, "the previous plant stays in use: the file has mistakes", self.mistakes)


def changed_drives(before: Plant, coming: Plant) -> frozenset[str]:
    """Return the names of the drives that differ between two plants.

    These are drives that only one of the plants has, and drives with another type, address, polled registers
    or channels.
    """
    meanings = [
        {
            one.drive.name: (type(one.drive), one.drive.address, one.polls, one.channels)
            for one in plant.drives
        }
        for plant in (before, coming)
    ]
    ours, theirs = meanings
    return frozenset(name for name in ours | theirs if ours.get(name) != theirs.get(name))


def _planned(plant: Plant) -> Mapping[str, Any]:
    planned: Mapping[str, Any] = plant.metadata()["planned"]
    return planned


def _sentence(failure: Exception) -> str:
    return str(failure) or type(failure).__name__
