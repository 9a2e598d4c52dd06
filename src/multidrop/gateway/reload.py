"""Reload: read the plant file again during polling. A file with mistakes changes nothing."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from multidrop import Batch, Plant, PlantError, Poller
from multidrop.gateway.clock import utc_ms
from multidrop.gateway.commands import drives_of
from multidrop.gateway.live.alarms import Limits
from multidrop.gateway.parts import PARTS
from multidrop.gateway.settings import AUDIT_S, check_writable
from multidrop.supervisor import Hung, supervisor

if TYPE_CHECKING:
    from multidrop.gateway.gateway import Gateway
    from multidrop.gateway.settings import ServeSettings

Read = Callable[[], "tuple[Plant, ServeSettings]"]
AT_ONCE = ("names", "tokens", "may", "limit", *PARTS)  # keys of [serve] that need no restart
READ_S = 10.0  # time limit for reading the file
QUICK_S = 1.0  # a later reload cancels a read of the file only after this time
MOST_READS = 8  # limit of concurrent reads, because reads may hang
ADOPTION_S = 60.0  # time limit for adopting a plant, which opens ports and stops drives
RESTART = "takes effect after a restart"
NO_FILE = "this plant has no file to be read again"

_log = logging.getLogger("multidrop.gateway")


class ReloadResult(NamedTuple):
    """The result of a reload: the file's mistakes, or sentences about changes that need a restart."""

    is_done: bool
    text: str
    mistakes: tuple[str, ...] = ()
    restart: tuple[str, ...] = ()


class Reload:
    """Reloads the plant file with `read`, which raises ValueError or OSError for a file with mistakes.

    `read` runs in a thread, so a file system that hangs makes only this reload fail.
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
        self._by = ""  # who started the newest reload
        self._is_overtaken = asyncio.Event()  # set when a later reload was requested
        self.coming: Plant | None = None  # the plant that is being adopted; None otherwise
        self._changed: frozenset[str] = frozenset()  # drives that the adoption changes

    @property
    def has_file(self) -> bool:
        return self._read is not None

    def begin(self, by: str = "a signal") -> None:
        """Start a reload. If one is in progress, start another when it has ended. Call this in the loop."""
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
        """Read the file and poll its plant. If that fails, keep the old plant and return the reason."""
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
        """Return the plant, its settings and the plan of its lines.

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
            raise Hung("a later reload replaces this one")
        return reading.result()

    async def _carry_out(self) -> ReloadResult:
        gateway, poller = self._gateway, self._gateway.poller
        if self._read is None or poller is None:
            return ReloadResult(False, NO_FILE)
        plant, settings, planned = await self._read_within(self._read)
        is_followed = not isinstance(poller, Poller)
        if is_followed and (plant.lines or settings.parts.get("fleet") != gateway.settings.parts["fleet"]):
            raise ValueError(f"[serve.fleet] and [[line]]: a change of either {RESTART}")
        if gateway.audit:  # adopting the plant opens this log
            await supervisor().within("audit log", AUDIT_S, partial(check_writable, gateway.audit))
        await gateway.parts.replace(settings.parts, plant)
        gateway.hand_out(poller)
        self._changed = frozenset() if is_followed else changed_drives(gateway.plant, plant)
        self.coming = plant
        try:
            unopened = await supervisor().thread("adoption", ADOPTION_S, partial(poller.adopt, plant))
            if is_followed:  # the plant file has no lines, but the fleet does
                planned = await supervisor().thread("plan", ADOPTION_S, partial(_planned, poller.plant))
            self._take_up(poller, settings, planned)
            gateway.parts.take_up()
        except Exception:
            # The poller may have changed some lines already: show the lines that it polls.
            if poller.plant.lines != gateway.plant.lines:
                self._take_up(poller, gateway.settings, None)
            await gateway.parts.take_back()
            raise
        finally:
            self.coming = None
            self._changed = frozenset()
        gateway.note_unopened(unopened)
        self.mistakes, self.restart = (), tuple(self._after_restart(plant, settings))
        for sentence in self.restart:
            _log.warning("%s", sentence)
        _log.info("the plant file is in effect")
        return ReloadResult(True, f"{plant.path.name} is in effect", (), self.restart)

    def _take_up(self, poller: Poller, settings: ServeSettings, planned: Mapping[str, Any] | None) -> None:
        """Show the plant that is polled now, and apply those of its settings that need no restart."""
        gateway, plant = self._gateway, poller.plant
        gateway.hand_out(poller)  # remaining rows of the previous plant
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
        self._changed = frozenset()
        gateway.guarded("frames", gateway.frames.note_news)

    def without_changed_drives(self, batch: Batch) -> Batch:
        """Return the batch without the rows of drives that the reload in progress changes.

        It is unknown whether such a row was polled under the old plant or the new one.
        """
        columns = batch.columns() if self._changed else None
        if columns is None or self._changed.isdisjoint(columns.drives):
            return batch
        names = columns.drives
        return batch.at([at for at, drive in enumerate(columns.drive) if names[drive] not in self._changed])

    def _after_restart(self, plant: Plant, settings: ServeSettings) -> Iterator[str]:
        """Yield a sentence for each changed key of [serve] that takes effect only after a restart."""
        before, now = self._begun_with, plant.serve
        for key in dict.fromkeys((*before, *now)):
            is_other = before.get(key) != now.get(key)
            if key == "certificate":  # the file may have changed under the same name
                is_other |= settings.certificate != self._gateway.settings.certificate
            if is_other and key not in AT_ONCE:
                yield f"{key} of [serve] {RESTART}"

    def _take_up_rights(self, settings: ServeSettings) -> None:
        gateway, may = self._gateway, settings.may
        now = gateway.settings
        if (settings.behind_proxy, settings.host) != (now.behind_proxy, now.host):
            # The gateway still listens on the old address: give its clients without a token no new rights.
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
    """Return the names of drives that only one of the plants has, or that differ in type, address, polled
    registers or channels.
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
