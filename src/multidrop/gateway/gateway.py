"""Gateway: polls a plant and serves it to browsers and other programs."""

from __future__ import annotations

import asyncio
import logging
import os
import secrets
import socket
import struct
import time
from collections.abc import Awaitable, Callable, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from typing import Any

import uvicorn

import multidrop
from multidrop import Bus, LineError, Plant, Poller
from multidrop.control import Ledger
from multidrop.core import boottime_ns, now_ns
from multidrop.gateway import utc_ms
from multidrop.gateway.commands import Commands, FleetStops
from multidrop.gateway.http.connections import BACKLOG, Connections, WatchedApp, WatchedProtocol, listen
from multidrop.gateway.http.guard import MOST_HEAD
from multidrop.gateway.http.rights import OwnNames, Tokens
from multidrop.gateway.http.routes import make_app
from multidrop.gateway.live.alarm_file import AlarmFile
from multidrop.gateway.live.alarms import Alarm, AlarmChange, Alarms, Limits, current_values
from multidrop.gateway.live.drive_reads import Identities, ParameterReads, SideReads
from multidrop.gateway.live.frames import Frames, SeenFrames, frame_of, lost_of
from multidrop.gateway.live.hub import SILENT, Hub
from multidrop.gateway.live.recent_statistics import RecentStatistics
from multidrop.gateway.live.views import troubles_of
from multidrop.gateway.parts import LiveParts, PartContext
from multidrop.gateway.reload import ADOPTION_S, Read, Reload
from multidrop.gateway.settings import AUDIT_S, ServeSettings, check_writable
from multidrop.supervisor import Hung, in_time, supervisor

TAKE_S = 0.1  # interval, in s, of taking polled values from the poller: half of LOOK_S
LOOK_S = 0.2  # interval, in s, of checks for alarms; after each check, the pages get a message
TICK_S = 1.0  # interval, in s, of reading the poller's statistics
LOG_S = 60.0  # shortest time, in s, between two log lines about failures of the same part
RESTORE_S = 2.0  # how long to wait, in s, until the alarms of earlier runs are read from the disk
FLEET_LATE_S = 2.0  # how long polled values of a fleet may take to arrive, in s
MOST_ASKED = 16  # limit of concurrent reads of registers that the drives' tables do not declare
ASKED_S = 30.0  # time limit, in s, of one read of an undeclared register
END_S = 4.0  # time limit of shutdown, stops included
GRACE_S = 1  # share of END_S, in s, for finishing HTTP requests in flight
_log = logging.getLogger("multidrop.gateway")


class Gateway:
    """A polled plant and its interfaces.

    Raises ValueError or OSError if an interface cannot be opened, after closing the other interfaces. A
    serial port that cannot be opened raises no error: its line counts as lost, and the port is retried.
    """

    clock = staticmethod(time.monotonic)

    def __init__(
        self, plant: Plant, settings: ServeSettings, *, ledger: Ledger | None = None, read: Read | None = None
    ) -> None:
        self.plant = plant
        self.settings = settings
        self.version = multidrop.__version__
        self.revision = secrets.randbits(32)  # version of the plant: random at the start, +1 at each reload
        self.failures: dict[str, int] = {}
        self.audit = settings.audit
        self.unaudited = ""  # why the audit log is not written; "" if it is written
        self.parts = LiveParts(self)
        self.feeds = self.parts.feeds
        self.guard_clock: Callable[[], float] = self.clock
        self._logged: dict[str, float] = {}
        self.begun = self.clock()
        self._looked = 0.0
        self._has_news = False  # True: the plant's state has changed since the newest frame was made
        self.ledger = ledger or Ledger()
        self.poller: Poller | None = None  # None before polling starts
        self._made: Poller | None = None  # the poller, also while it is still starting
        self._end = asyncio.Event()
        self.listener = listen(settings.host, settings.port)
        self.connections = self.listener.connections = Connections(self.clock)
        self.port: int = self.listener.getsockname()[1]
        self.own_names = OwnNames(settings.names, settings.host, self.port)
        self.tokens = Tokens(settings.tokens)
        self.hub = Hub(plant, now_and_slept_ns, late_s=0.0 if plant.lines else FLEET_LATE_S)
        self.limits = Limits(settings.limits)
        self.alarms = Alarms(utc_ms(), self._note_alarm)
        self.alarm_file = AlarmFile(settings.alarms) if settings.alarms else None
        self._is_restored = self.alarm_file is None
        self.recent = RecentStatistics(plant)
        self.notifier = Notifier()
        self.reload = Reload(self, read)
        self.commands = (
            Commands(self, settings.may, lambda drive: self.hub.note_reset(drive))
            if plant.lines
            else FleetStops(self, settings.may, lambda: self.feeds.get("fleet"))
        )
        self.seen_frames = SeenFrames(boottime_ns, self.commands)
        self.frames = Frames(self._frame, self.clock, begin=secrets.randbits(48))
        self.side_reads = SideReads(self.bus, self._is_there, self.clock, utc_ms)
        self.parameter_reads = ParameterReads()
        self.identities = Identities(
            lambda: self.plant, self.bus, self._is_there, lambda: self.note_failure("identities")
        )

    # ---- start and end ----

    async def run(self, on_ready: Callable[[], object] = lambda: None) -> None:
        """Poll and serve until `end` is called; then return within END_S, even if a disk hangs.

        If an exception interrupts `run`, polling is ended before the exception propagates. Raises
        RuntimeError if the web server ends by itself.
        """
        try:
            await self._run(on_ready)
        except BaseException:
            self.listener.close()
            if self._made is not None:
                with suppress(Exception):  # an exception of `close` must not replace the first one
                    in_time("polling", END_S, self._made.close)
            raise

    async def _run(self, on_ready: Callable[[], object]) -> None:
        nothing = replace(self.plant, lines=())
        server = _Server(self._server_config())
        end = supervisor().start("end", self._end.wait())
        try:
            if self.alarm_file is not None:
                supervisor().keep_thread("alarms", self.alarm_file.run)
            await self.parts.build(self.settings.parts, self.plant)
            await self._find_audit()
            poller = self._made = self._source() or Poller(nothing, ledger=self.ledger, audit=self.audit)
            # not a `with` block: `_close` closes the poller in a thread, because closing may take long
            self.poller = poller.__enter__()
            adopting = supervisor().thread("adoption", ADOPTION_S, partial(poller.adopt, self.plant))
            either: set[asyncio.Future[Any]] = {end, adopting}
            await asyncio.wait(either, return_when=asyncio.FIRST_COMPLETED)
            if not adopting.done():
                return
            self.note_unopened(adopting.result())
            self.plant = poller.plant
            self.parts.take_up()
            supervisor().keep("polling", self._take_all())
            supervisor().keep("statistics", self._tick())
            supervisor().keep("identities", self.identities.run())
            serving = supervisor().keep("web", server.serve([self.listener]))
            while not server.started and not serving.done():
                await asyncio.sleep(0.005)
            if not serving.done():
                on_ready()
                self.notifier.send("READY=1", self.status)
            await asyncio.wait({end, serving}, return_when=asyncio.FIRST_COMPLETED)
            if not self._end.is_set():
                raise RuntimeError(f"the web server has ended: {supervisor().dead.get('web')}")
        finally:
            end.cancel()
            await self._close(server)

    def _source(self) -> Any:
        """Return the source of a fleet's lines and values; None if the plant file has lines itself.

        Raises OSError if the gateway's part `fleet`, which supplies them, is not built yet.
        """
        if self.plant.lines:
            return None
        source = self.parts.source()
        if source is None:
            raise OSError(
                "the plant file has no lines, and the files that [serve.fleet] names cannot be read yet"
            )
        source.on_change = partial(self.reload.begin, "the fleet")
        return source

    async def _close(self, server: _Server) -> None:
        """Shut down within END_S; log and abandon work that hangs."""
        ends = self.clock() + END_S

        def left_s(kept_s: float) -> float:
            return max(0.1, ends - self.clock() - kept_s)

        self.notifier.send("STOPPING=1")
        self.frames.close()
        await self._end_of("web", left_s(2.4), self._end_server(server))
        await self._end_of("side reads", left_s(2.4), self.side_reads.close())
        await self._end_of("parameter reads", left_s(2.4), self.parameter_reads.close())
        await self._end_of("reload", left_s(2.4), self.reload.close())
        if self.poller is not None:
            closing = supervisor().within("polling", END_S, self.poller.close)
            await self._end_of("polling", left_s(1.0), closing)
            await supervisor().release("polling", "statistics", "identities")
            # hand out the values that were received during shutdown
            self.guarded("hub", self.hand_out, self.poller)
        await self._end_of("parts", left_s(0.2), self.parts.close(left_s(0.4)))
        if self.alarm_file is not None:
            supervisor().let_go("alarms")
            await self._end_of(
                "alarms", left_s(0.1), supervisor().within("alarm file", END_S, self.alarm_file.close)
            )
        self.listener.close()
        for name in dict.fromkeys(supervisor().under_way):
            _log.error("%s is still running at shutdown, and is abandoned", name)

    async def _end_server(self, server: _Server) -> None:
        server.should_exit = True
        if (serving := supervisor().let_go("web")) is not None and server.started:
            await serving

    async def _end_of(self, name: str, seconds: float, work: Awaitable[object]) -> None:
        try:
            await asyncio.wait_for(work, seconds)
        except TimeoutError:
            _log.error("%s did not end in time", name)
        except Exception:
            _log.exception("ending %s failed", name)

    async def _find_audit(self) -> None:
        """Use the audit log only if its disk answers now, because a disk that hangs would block polling."""
        self.audit, path = self.settings.audit, self.settings.audit
        if path is None:
            return
        try:
            await supervisor().within("audit log", AUDIT_S, partial(check_writable, path))
        except Hung as failure:
            self.audit, self.unaudited = None, f"{failure} Restart to try again"
            self.commands.withheld = self.unaudited
            _log.error("only stops are sent: %s", self.unaudited)

    def end(self) -> None:
        """Make `run` shut down and return. Call this in the event loop's thread."""
        self._end.set()

    def _server_config(self) -> uvicorn.Config:
        context = self.settings.tls
        return uvicorn.Config(
            WatchedApp(make_app(self), self.connections),
            backlog=BACKLOG,
            http=WatchedProtocol,
            h11_max_incomplete_event_size=MOST_HEAD,  # limit, in bytes, of an incomplete HTTP head
            ws="none",
            lifespan="off",
            log_config=None,
            access_log=False,
            server_header=False,
            proxy_headers=False,
            timeout_keep_alive=30,
            timeout_graceful_shutdown=GRACE_S,
            ssl_context_factory=None if context is None else lambda config, default: context,
        )

    # ---- rows ----

    async def _take_all(self) -> None:
        dead = supervisor().dead
        while True:
            try:
                if self.poller is not None:
                    self.hand_out(self.poller)
                dead.pop("polling", None)
            except Exception as failure:  # for example, the poller has ended or memory is short
                dead["polling"] = f"{type(failure).__name__}: {failure}"
                self.note_failure("polling")
            await asyncio.sleep(TAKE_S)

    def hand_out(self, poller: Poller) -> None:
        """Give all new polled values to the hub and to each part. If one fails, the others still get them."""
        while batch := poller.take():
            self._has_news = True
            batch = self.reload.without_changed_drives(batch)
            self.guarded("hub", self.hub.take, batch)
            self.parts.call("take", batch)
        if self.clock() - self._looked >= LOOK_S:
            self._looked = self.clock()
            self.guarded("events", self._look_for_events)
            if self._has_news:
                self._has_news = False
                self.guarded("frames", self.frames.note_news)

    def _look_for_events(self) -> None:
        if not self._is_restored and not self._restore_alarms():
            return
        now = utc_ms()
        for name in self.hub.drives:
            stops = None if self.hub.is_set_to_zero(name) else self.commands.halts(name)
            self.alarms.look(now, name, self.hub.seen(name), stops)
            values = current_values(self.hub, name) if name in self.limits else {}
            self.alarms.look_at_limits(now, name, partial(self.limits.exceeded, self.clock(), name, values))
        for line in self.plant.lines:
            lost = lost_of(self.hub, line.name)
            self.alarms.look_at_line(now, line.name, lost)
            if lost is None and any(self.hub.last_answer(polled.drive.name) for polled in line.drives):
                self.alarms.note_there(line.name)
            if lost is None and self.hub.taken:
                self.hub.unopened.pop(line.name, None)  # the port works now: forget why it did not open

    def _restore_alarms(self) -> bool:
        """Continue the alarms of earlier runs.

        Return False until they are read, but not for longer than RESTORE_S.
        """
        # a plant whose lines come from a fleet has none until the fleet's files are read
        if not self.plant.lines:
            return False
        past = self.alarm_file.past if self.alarm_file is not None else []
        if past is None and self.clock() - self.begun < RESTORE_S:
            return False
        if past is not None:
            names = [line.name for line in self.plant.lines]
            self.alarms.restore(past, utc_ms(), {*names, *self.hub.drives})
            self._is_restored = True
        return True

    def _note_alarm(self, alarm: Alarm, change: AlarmChange) -> None:
        where = alarm.drive or f"line {alarm.line}"
        if alarm.ended is not None:
            _log.info("alarm of %s is over: %s: %s", where, alarm.kind, alarm.text)
        elif alarm.acknowledged is not None:
            note = f": {alarm.note}" if alarm.note else ""
            _log.info("alarm of %s, %s, acknowledged by %s%s", where, alarm.text, alarm.by, note)
        else:
            _log.warning("alarm of %s: %s: %s", where, alarm.kind, alarm.text)
        if self.alarm_file is not None:
            self.alarm_file.note(alarm)
        self.parts.call("note_alarm", alarm, change)

    def guarded(self, name: str, work: Callable[..., object], *arguments: object) -> None:
        try:
            work(*arguments)
        # a user's drive class may raise either exception; polling and stops continue
        except (Exception, SystemExit):
            self.note_failure(name)

    def note_failure(self, name: str) -> None:
        """Count the exception that is being handled, and log it at most once every LOG_S seconds."""
        self.count_failure(name)
        if self.clock() - self._logged.get(name, -LOG_S) >= LOG_S:
            self._logged[name] = self.clock()
            _log.exception("%s failed, %d times so far; the other parts continue", name, self.failures[name])

    def count_failure(self, name: str) -> None:
        self.failures[name] = self.failures.get(name, 0) + 1

    async def _tick(self) -> None:
        notifier = self.notifier
        every = min(TICK_S, (notifier.watchdog_s or 4 * TICK_S) / 4)
        while True:
            if self.poller is not None:
                self.guarded("statistics", self._read_statistics, self.poller)
            self.guarded("minute", self.hub.note_minute)
            self.guarded("connections", self.connections.sweep)
            supervisor().look()
            # send a message even without new values: its time shows viewers that the gateway is alive
            self._has_news = True
            if notifier.watchdog_s:
                notifier.send("WATCHDOG=1")
            await asyncio.sleep(every)

    def _read_statistics(self, poller: Poller) -> None:
        self.recent.tick(self.clock(), utc_ms(), poller.statistics())
        buses = poller.buses
        failing = {line: why for line, bus in buses.items() if (why := bus.why_lost)}
        self.hub.stalled = {line: why for line, why in failing.items() if not buses[line].line.is_lost}
        self.hub.unopened |= failing

    def note_unopened(self, failures: Mapping[str, LineError]) -> None:
        """Log and remember the lines whose ports could not be opened, with the reasons."""
        for line, failure in failures.items():
            _log.warning("line %s is lost and will be retried: %s", line, failure)
        there = [line.name for line in self.plant.lines]
        before = {line: why for line, why in self.hub.unopened.items() if line in there}
        self.hub.unopened = before | {line: str(failure) for line, failure in failures.items()}

    @property
    def status(self) -> str:
        """The line about the gateway's state that the service manager shows."""
        lost = len(self.hub.unopened)
        return f"STATUS=polling {len(self.plant.lines) - lost} lines" + (f"; {lost} lost" if lost else "")

    @property
    def plant_now(self) -> Plant:
        """The plant that is polled now. During a reload, some of its lines may already be new."""
        return self.plant if self.poller is None or self.plant_coming is None else self.poller.plant

    @property
    def plant_coming(self) -> Plant | None:
        return self.reload.coming

    # ---- for commands, parts and pages ----

    def _is_there(self, drive: str) -> bool:
        return self.hub.state(drive) != SILENT

    def bus(self, line: str) -> Bus:
        """Return a line's bus. Raises ValueError for an unknown line, or before polling starts."""
        if self.poller is None:
            raise ValueError("polling has not started yet")
        return self.poller.bus(line)

    async def ask(self, drive: str, function: int, start: int, count: int, expiry_s: float) -> list[int]:
        """Read `count` 16-bit words or bits of a drive, from the address `start` on; see `Drive.read_raw`.

        For a Modbus function without addresses, return the bytes of the reply's data.
        """
        _, known = self.plant.find_drive(drive)
        work = partial(known.read_raw, function, start, count, expiry=expiry_s)
        data = await supervisor().within("passed requests", ASKED_S, work, most=MOST_ASKED)
        if function in (1, 2):
            return [data[bit // 8] >> bit % 8 & 1 for bit in range(count)]
        if function not in (3, 4):
            return list(data)
        return list(struct.unpack(f">{count}H", data))

    def part_context(self, plant: Plant) -> PartContext:
        """Return the objects of the gateway that one of its parts may use with this plant."""
        folder, page = self.settings.folder, self.settings.page
        return PartContext(
            plant, self.hub, self.commands, self.ask, folder, self.version, self.alarms, self.tokens, page
        )

    def _frame(self, n: int) -> dict[str, Any]:
        self.seen_frames.note(n)
        stops = self.commands.stops
        frame = frame_of(
            self.hub, self.alarms, self.recent, stops, n=n, revision=self.revision, time_ns=time.time_ns()
        )
        return frame | {"troubles": troubles_of(self)}


def now_and_slept_ns() -> tuple[int, int]:
    """Return the monotonic time, and how long the computer has slept since its boot, both in ns."""
    booted_ns = boottime_ns()  # read first, so that a pause between the two reads never counts as sleep
    monotonic_ns = now_ns()
    return monotonic_ns, booted_ns - monotonic_ns


class _Server(uvicorn.Server):
    """A web server that installs no signal handlers, because the gateway installs its own."""

    @contextmanager
    def capture_signals(self) -> Any:
        yield


# ---- messages to the service manager by sd_notify(3): ready, alive, reloading, stopping ----


class Notifier:
    """Sends messages to the service manager's socket; without a socket, all calls are ignored."""

    def __init__(self, address: str | None = None) -> None:
        self._address = os.environ.get("NOTIFY_SOCKET", "") if address is None else address

    @property
    def watchdog_s(self) -> float | None:
        """The longest allowed time between two WATCHDOG=1 messages, in s; None: any time."""
        asked = os.environ.get("WATCHDOG_USEC", "")
        mine = os.environ.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        return int(asked) / 1e6 if asked.isdigit() and int(asked) > 0 and mine else None

    def send_reloading(self) -> None:
        """Report that a reload starts, and when. A later READY=1 reports its end."""
        self.send("RELOADING=1", f"MONOTONIC_USEC={now_ns() // 1000}")

    def send(self, *lines: str) -> None:
        """Send lines such as READY=1, without waiting; they are lost if the manager's queue is full."""
        if not self._address:
            return
        abstract = self._address.startswith("@")
        address = "\0" + self._address[1:] if abstract else self._address
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
            manager.setblocking(False)
            manager.sendto("\n".join(lines).encode(), address)
