"""FleetGateway: a process that polls the lines assigned to it and forwards their samples."""

from __future__ import annotations

import asyncio
import json
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from math import inf
from pathlib import Path
from typing import Any

from nats.aio.msg import Msg

from multidrop import Plant, Poller, PollingFailed
from multidrop.core import Mastership
from multidrop.fleet.commands.desk import CommandSubjects
from multidrop.fleet.commands.log import CommandLog
from multidrop.fleet.commands.offers import HeldLines
from multidrop.fleet.errors import FleetError, NoRight
from multidrop.fleet.lines.lease import LifeLock
from multidrop.fleet.lines.line_keeper import LINES_AT_ONCE, SILENT_S, PortLoss
from multidrop.fleet.lines.member import Member
from multidrop.fleet.lines.records import MOST_REPORTED
from multidrop.fleet.lines.rules import SECOND, USUAL
from multidrop.fleet.samples.samples_stream import Forwarder, samples_path
from multidrop.fleet.servers import names
from multidrop.fleet.servers.buckets import Record, misshapen, with_short_texts
from multidrop.fleet.servers.connections import ServerPath, paths_of
from multidrop.fleet.servers.plant_store import line_of
from multidrop.fleet.servers.setup import check_buckets, open_all
from multidrop.samples import PolledUnits, Spool
from multidrop.supervisor import Ended, end_tasks, supervisor

SPOOL_BYTES = 10_000_000_000
STATE = {"state": str, "lines": int, "margin_s": float, "trouble": str, "troubles": dict, "spool": dict}
SPOOL = {"bytes": int, "lost": int, "behind": int | None, "lag_s": float | None, "trouble": str | None}
# time limit at shutdown for forwarding samples; remaining samples are forwarded after the next start
FORWARD_S = 10.0
IN_TROUBLE_S = 3.0  # time limit at shutdown for forwarding samples if the stream has a problem
SYNC_S = 3.0  # time limit at shutdown for writing the last samples to the disk
ENDING_S = 0.05
LOOK_S = 0.2  # pause between checks of the gateway's threads

_log = logging.getLogger("multidrop.fleet")


class FleetGateway:
    """A fleet's gateway called `name`. `folder` holds its lock file, spool and logs.

    Raises ValueError for an invalid name, FleetError if another process uses the folder.
    """

    def __init__(
        self,
        name: str,
        urls: Sequence[str],
        folder: Path,
        *,
        options: Mapping[str, Any] | None = None,
        spool_bytes: int = SPOOL_BYTES,
    ) -> None:
        self.name = names.checked_name("gateway", name)
        self.urls = list(urls)
        self.folder = folder
        self._options = dict(options or {})
        folder.mkdir(parents=True, exist_ok=True)
        self.lock = LifeLock(folder / f"{name}.lock")
        self.paths = paths_of(urls, options)
        self.mastership = Mastership(guard_s=USUAL.guard / SECOND)
        units = PolledUnits()
        self.spool = Spool(folder / "spool", name, most=spool_bytes, units=units)
        self.lines = FleetLines(self.mastership, folder, units)
        held = HeldLines(
            self.lines.poller.bus,
            # a lambda, because `self.member` does not exist yet
            may_command=lambda line: self.member.keeper.may_command(line),
            may_stop=lambda line: self.member.keeper.may_stop(line),
        )
        self.log = CommandLog(folder / "commands.jsonl")
        self.log.open()
        self.commands = CommandSubjects(name, self.paths, held, self.log)
        commanded = CommandedLines(self.lines, self.commands, lambda: self.member.lease.left_s > SILENT_S)
        self.member = Member(name, self.paths, commanded, self.mastership, lock=self.lock)
        self.forwarder: Forwarder | None = None
        self._end = asyncio.Event()

    async def run(self, on_ready: Callable[[], object] = lambda: None) -> None:
        """Poll and forward until `end` is called; then close all lines, and forward the remaining samples.

        Raises FleetError if no server answers, or if the fleet was not set up. Raises Ended if polling has
        failed, or if a task or thread that the gateway needs has ended. Ended is raised after an orderly
        shutdown, so other gateways take over the lines.
        """
        try:
            await open_all(self.paths)
            await check_buckets(self.member.best())
            async with samples_path(self.urls, self._options) as path:
                await self._poll_and_forward(path, on_ready)
        finally:
            await self._close()
        supervisor().check()

    async def _poll_and_forward(self, path: ServerPath, on_ready: Callable[[], object]) -> None:
        self.forwarder = Forwarder(self.spool, path)
        forwarding = supervisor().keep("forwarder", self.forwarder.run())
        supervisor().watch("spool", self.spool.is_alive)
        try:
            await self.paths[0].subscribe_or_raise(names.gateway_subject(self.name, "*"), self._answer)
            await self.commands.begin()
            self.lines.poller.on_batch(self.spool.append)
            with self.lines.poller:
                member = supervisor().keep("member", self.member.run())
                looking = supervisor().keep("look", self._look())
                on_ready()
                await self._until_the_end()
                for name in ("look", "member"):
                    supervisor().let_go(name)
                self.member.end()
                await asyncio.wait([member])
                await end_tasks(looking)
                # the supervisor reports these three exceptions
                with suppress(Ended, PollingFailed, asyncio.CancelledError):
                    member.result()
                with suppress(PollingFailed):
                    await self.lines.close()
            await asyncio.to_thread(self.spool.sync, SYNC_S)
            await self._forward_the_rest(forwarding)
        finally:
            supervisor().let_go("forwarder")
            await end_tasks(forwarding)

    async def _until_the_end(self) -> None:
        """Wait until `end` is called; return early if a task or thread that the gateway needs has ended."""
        waits = [asyncio.ensure_future(one.wait()) for one in (self._end, supervisor().has_dead)]
        await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
        await end_tasks(*waits)

    async def _look(self) -> None:
        """Check the threads and the poller repeatedly. If polling has failed, report this and return."""
        while True:
            supervisor().look()
            if failure := self.lines.poller.failure:
                supervisor().note_dead("polling", str(failure), failure.__cause__)
                return
            await asyncio.sleep(LOOK_S)

    def end(self) -> None:
        """Make `run` shut down and return. Call this in the event loop's thread."""
        self._end.set()

    async def _forward_the_rest(self, forwarding: asyncio.Task[None]) -> None:
        assert self.forwarder is not None
        loop = asyncio.get_running_loop()
        begun = loop.time()
        while not forwarding.done():
            is_late = loop.time() - begun > (IN_TROUBLE_S if self.forwarder.trouble else FORWARD_S)
            if is_late or (self.forwarder.last or 0) >= self.spool.state().newest:
                return
            await asyncio.sleep(ENDING_S)

    async def _close(self) -> None:
        """Close everything, even if one part fails to close.

        If the lines fail to close, this process could still send. Then the lock is held until the process
        ends, and the kernel timer that kills this process at the end of its lease stays set.
        """
        with ExitStack() as last, ExitStack() as files:
            files.callback(self.log.close)
            files.callback(self.spool.close)
            try:
                await asyncio.gather(*(path.close() for path in self.paths))
            finally:
                self.lines.poller.close()
                self.mastership.end()
                last.callback(self.lock.close)

    # ---- requests ----

    async def _answer(self, message: Msg) -> None:
        """Answer a request about this gateway.

        If this process has no session, ignore the request, because another gateway of this name may have one.
        """
        if not self.member.lease.session or not names.is_inbox(message.reply):
            return
        if message.subject == names.gateway_subject(self.name, "drain"):
            self.member.drain()
            _log.warning("gateway %s is draining: all its lines go to other gateways", self.name)
        with suppress(Exception):  # the requester may have disconnected
            await message.respond(json.dumps(with_short_texts(self.state())).encode())

    def state(self) -> dict[str, Any]:
        """Return the state of this gateway that `multidrop fleet status` shows."""
        member, spool = self.member, self.spool.state()
        lost = {line: f"port lost: {why}" for line, why in member.keeper.lost.items()}
        failing = {line: f"polling fails: {why}" for line, why in self.lines.poller.line_failures.items()}
        forwarder = self.forwarder
        last = forwarder.last if forwarder else None
        return {
            "gateway": self.name,
            "state": member.state.value,
            "session": member.lease.session,
            "margin_s": max(0.0, round(member.lease.left_s, 3)),
            "paths": [path.server_name for path in self.paths],
            "lines": len(member.polled),
            "moves": member.keeper.moves,
            "troubles": dict(sorted({**member.keeper.troubles, **failing, **lost}.items())),
            "lost": sorted(lost),
            "failing": sorted(failing),
            "unopened": sorted(member.keeper.unopened.named()),
            "trouble": member.trouble,
            "last_moves": [move.as_json() for move in member.records.moves.newest(MOST_REPORTED)],
            "spool": {
                "bytes": spool.stored,
                "rows": spool.written,
                "waiting": spool.waiting,
                "lost": spool.lost,
                "sent": forwarder.sent if forwarder else 0,
                "lag_s": forwarder.lag_s() if forwarder else None,
                "behind": None if last is None else max(0, spool.newest - last),
                "trouble": spool.trouble or (forwarder.trouble if forwarder else None),
            },
        }


async def ask_gateway(path: ServerPath, gateway: str, wanted: str) -> dict[str, Any]:
    """Return a gateway's answer to "state" or "drain". Raises FleetError if no answer comes."""
    try:
        message = await path.request(names.gateway_subject(gateway, wanted))
    except NoRight:
        raise
    except FleetError:
        raise FleetError(
            f"no gateway called {gateway} answers; `multidrop fleet status` lists them"
        ) from None
    try:
        found: dict[str, Any] = with_short_texts(json.loads(message.data))
    except (ValueError, RecursionError):
        found = {}
    if mistake := misshapen(found, STATE) or misshapen(found["spool"], SPOOL):
        raise FleetError(f"the answer of {gateway} is not a gateway's state: {mistake}")
    return found


class FleetLines:
    """The lines that a gateway polls, in one Poller that sends only while the lease is valid.

    Lines are added and removed in threads, because each call waits for the line's port.
    """

    def __init__(self, mastership: Mastership, folder: Path, units: PolledUnits) -> None:
        self.poller = Poller(
            Plant((), folder, totals=folder / "totals.json"),
            mastership=mastership,
            audit=folder / "audit.jsonl",
        )
        self._folder = folder / "lines"
        self._units = units
        self._free = asyncio.Semaphore(LINES_AT_ONCE)

    async def take(self, line: str, description: Any) -> None:
        """Open the line and poll it. If that raises, the line is not polled and its port is closed.

        Raises LineError if its port does not exist, and ValueError for a mistake in its description. Drive
        classes that users have written may raise other errors.
        """
        await self._in_thread(self._take, Record(line, 0, description))

    async def _in_thread(self, act: Callable[..., object], *details: object) -> None:
        """Call `act` in a daemon thread.

        Convert SystemExit, which would end the event loop, to RuntimeError.
        """
        async with self._free:
            await supervisor().thread("line", inf, partial(act, *details))

    def _take(self, record: Record) -> None:
        line = line_of(record, self._folder)
        polled = {drive.name for bus in self.poller.buses.values() for drive in bus.drives}
        # `add_line` will refuse a line that has a drive of a polled line
        if not any(one.drive.name in polled for one in line.drives):
            # units must be known before the line's first sample arrives
            self._units.note(line, time.monotonic_ns())
        before = self.poller.buses.get(line.name)
        try:
            self.poller.add_line(line)
        except BaseException:  # a half-open line must be closed: another gateway may soon be its master
            if self.poller.buses.get(line.name) is not before:
                self.poller.remove_line(line.name)
            raise

    async def let_go(self, line: str) -> None:
        await self._in_thread(self._let_go, line)

    def _let_go(self, line: str) -> None:
        try:
            self.poller.remove_line(line)
        except PollingFailed:  # the poller has stopped on all lines, so only the port must be closed
            self.poller.bus(line).close()

    def port_loss(self, line: str) -> PortLoss | None:
        bus = self.poller.bus(line)
        if not bus.line.is_lost:
            return None
        replied_ns = max((bus.peer(drive).answered_ns for drive in bus.drives), default=0)
        silent_ns = time.monotonic_ns() - replied_ns if replied_ns else None
        return PortLoss(bus.why_lost, silent_ns)

    async def close(self) -> None:
        """Stop polling and deliver the last samples. Raises PollingFailed if polling had failed."""
        await self._in_thread(self.poller.close)


class CommandedLines:
    """Polls lines, and accepts commands for each polled line.

    `may_wait` returns False when the lines must be closed because the lease is about to expire.
    """

    def __init__(
        self, lines: FleetLines, subjects: CommandSubjects, may_wait: Callable[[], bool] = lambda: False
    ) -> None:
        self._lines = lines
        self._subjects = subjects
        self._may_wait = may_wait

    async def take(self, line: str, description: Any) -> None:
        """Poll a line and accept commands for it. If that raises, the line is closed again."""
        await self._lines.take(line, description)
        try:
            self._subjects.open(line, description)
        except BaseException:
            await self.let_go(line)
            raise

    def port_loss(self, line: str) -> PortLoss | None:
        return self._lines.port_loss(line)

    async def let_go(self, line: str) -> None:
        """Accept no more commands for the line, stop polling it, and close it.

        Closing waits for stops in progress, so that their senders get answers. Before that, wait a short time
        for commands in progress, because their results would otherwise stay unknown.
        """
        self._subjects.leave(line)
        try:
            await self._subjects.desk.await_commands(line, self._may_wait)
            await self._lines.let_go(line)
        finally:
            self._subjects.shut(line)
