"""The gateway's part `opcua`: serves the plant to OPC UA clients, which may read values and stop drives.

The server has its own thread with its own event loop, so that its clients' requests delay neither polling nor
stops over other interfaces.
"""

from __future__ import annotations

import asyncio
import gc
import logging
import sys
import time
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from math import inf
from typing import TYPE_CHECKING, Any, ClassVar

from multidrop import NoReply, Plant
from multidrop.control import CommandResult
from multidrop.control.commands import JoinedStops
from multidrop.gateway.commands import drives_of
from multidrop.gateway.http.connections import listen
from multidrop.gateway.http.rights import Caller, Right, Tokens, caller_with, is_loopback
from multidrop.gateway.opcua import FAULT, MEMBERS, PROPERTIES, STATE
from multidrop.gateway.parts import PartContext
from multidrop.supervisor import supervisor
from multidrop.toml_check import ADDRESS, parse_address

if TYPE_CHECKING:
    from multidrop.gateway.opcua.nodes import PlantNodes, VariableState
    from multidrop.gateway.opcua.server import Identity, Visitor

EXAMPLE = "127.0.0.1:4840"
EVERY_S = 0.1  # interval, in s, of passing new values to the server
# in s: while a server runs, a thread must let another one run after this time (sys.setswitchinterval)
SWITCH_S = 0.0005
# the interpreter's default of this time, 5 ms, which applies if no server runs
USUAL_SWITCH_S = sys.getswitchinterval()
# the server gets the drives' states once in this many intervals, because each takes 50 us to compute
STATE_TURNS = 10
# in s: how long the answer to a stop waits for the motor; the client's other requests wait as well
STOP_WAIT_S = 0.4
_unended: set[OpcUa] = set()  # all OPC UA servers in this process that have not ended
_log = logging.getLogger("multidrop.gateway")


@dataclass(frozen=True)
class OpcUaSettings:
    """The settings in the table `[serve.opcua]`. Raises ValueError with a line for each mistake."""

    listen: str = field(default=EXAMPLE, metadata=ADDRESS)
    # path of the server's certificate (PEM), relative to the plant file; "": no encryption
    certificate: str = ""
    key: str = ""  # path of the certificate's RSA key
    # Python libraries that are imported when the server is built
    libraries: ClassVar[tuple[str, ...]] = ("asyncua",)

    def __post_init__(self) -> None:
        if bool(self.certificate) != bool(self.key):
            raise ValueError("certificate and key belong together: give both keys, or neither")
        _ = self.address

    @property
    def address(self) -> tuple[str, int]:
        """The address and the port to listen on. Raises ValueError if `listen` is invalid."""
        return parse_address(self.listen, f'listen = "{EXAMPLE}"')

    @property
    def addresses(self) -> dict[str, tuple[str, int]]:
        """The host and port of the listening socket, by its setting's key."""
        return {"listen": self.address}

    def check(self, plant: Plant) -> Iterator[str]:
        """Yield an error sentence for each mistake.

        These are a missing certificate or key file, an address that other machines reach without a
        certificate and tokens, and a name of a drive or channel that gives two nodes the same id.
        """
        if not is_loopback(self.address[0]) and not (self.certificate and "tokens" in plant.serve):
            yield (
                f'listen = "{self.listen}" is open to other machines: that needs certificate and key here '
                f"and tokens in [serve]; or listen on 127.0.0.1"
            )
        for key, name in (("certificate", self.certificate), ("key", self.key)):
            path = plant.path.parent / name
            if name and not path.is_file():
                yield f'{key} = "{name}": there is no file {path}'
        drives = drives_of(plant)
        channels = {polled.drive.name: {one.name for one in polled.channels} for polled in plant.drives}
        for name in drives:
            parts = name.split(".")
            for at in range(1, len(parts)):
                owner, member, rest = ".".join(parts[:at]), parts[at], ".".join(parts[at + 1 :])
                members = {*drives[owner].registers, *channels[owner], *MEMBERS} if owner in drives else ()
                if member in members and rest in ("", *PROPERTIES):
                    yield f'drive "{name}" has the node id of a value of "{owner}": choose another name'
            for channel in channels[name] & {*MEMBERS}:
                yield f'channel "{channel}" of "{name}" has the node id of another value: choose another name'


def build(settings: OpcUaSettings, context: PartContext) -> OpcUa:
    """Return the OPC UA server, which listens already. Raises ImportError without asyncua.

    Raises OSError if the port cannot be opened, and ValueError for an unsuitable certificate or key.
    """
    server, folder = import_module("multidrop.gateway.opcua.server"), context.plant.path.parent
    files = [folder / name for name in (settings.certificate, settings.key) if name]
    return OpcUa(settings, context, server.read_identity(*files) if files else None)


class OpcUa:
    """The OPC UA server of a plant."""

    def __init__(self, settings: OpcUaSettings, context: PartContext, identity: Identity | None) -> None:
        self._identity = identity
        self._context = context
        self._listener = listen(*settings.address)
        self.port: int = self._listener.getsockname()[1]
        self._plant = context.plant
        self._adopted: Plant | None = None  # the plant whose nodes the server shows
        self._turn = 0  # number of calls of `_changes` so far
        # state that was passed to the server last, by drive and variable
        self._seen: dict[str, dict[str, Any]] = {}
        # wrong tokens that were logged, so that each is logged once; used only in the server's thread
        self._wrong = Tokens()
        self._stops = JoinedStops()  # used only in the server's thread
        self._loop: asyncio.AbstractEventLoop | None = None
        self._serving: asyncio.Future[None] | None = None  # done when the server's thread has ended
        self._opened: tuple[asyncio.AbstractEventLoop, asyncio.Event, PlantNodes] | None = None
        self._is_over = False  # True: the server ends, or will end as soon as it has started
        # pending while the server takes over a new plant or new values
        self._writing: Future[None] | None = None

    # ---- in the gateway's loop ----

    def adopt(self, plant: Plant) -> None:
        """Use another plant. `run` then passes it to the server, before any values of this plant."""
        self._plant = plant

    async def run(self) -> None:
        """Serve until cancelled. Raises the exception that ends the server's thread."""
        self._loop = asyncio.get_running_loop()
        self._serving = supervisor().thread("opcua server", inf, lambda: asyncio.run(self._serve()))
        due = self._loop.time()
        try:
            while not self._serving.done():
                self._hand_over()
                due = max(due + EVERY_S, self._loop.time())
                await asyncio.wait([self._serving], timeout=due - self._loop.time())
            self._serving.result()
        finally:
            self._end_server()  # without this, clients would still read the last values as current ones

    async def close(self) -> None:
        """Disconnect all clients; stops in progress continue."""
        while self._serving is not None and not self._serving.done():
            self._end_server()
            await asyncio.wait([self._serving], timeout=EVERY_S)
        self._listener.close()

    @property
    def is_ready(self) -> bool:
        """True as soon as clients see the plant's drives."""
        return self._writing is not None and self._writing.done()

    def _end_server(self) -> None:
        self._is_over = True
        if self._opened is not None:
            loop, ended, _ = self._opened
            with suppress(RuntimeError):  # the server's event loop is closed already
                loop.call_soon_threadsafe(ended.set)

    def _hand_over(self) -> None:
        """Pass a new plant or changed states to the server, unless it still takes over the previous ones."""
        if self._opened is None or (self._writing is not None and not self._writing.done()):
            return
        loop, _, nodes = self._opened
        if self._writing is not None:
            self._writing.result()
        if self._adopted is not self._plant:
            self._adopted, self._seen = self._plant, {}
            self._writing = asyncio.run_coroutine_threadsafe(nodes.adopt(self._plant), loop)
        elif states := self._changes():
            self._writing = asyncio.run_coroutine_threadsafe(nodes.write(states), loop)

    def _changes(self) -> list[VariableState]:
        """Return the states of all variables that changed since the last call."""
        from multidrop.gateway.opcua.nodes import GOOD, VariableState, fault_of, state_of

        hub, seen, states = self._context.hub, self._seen, []
        self._turn += 1
        for number, drive in enumerate(hub.drives):
            given = seen.setdefault(drive, {})
            for register, newest, good, is_current in hub.known(drive):
                before = given.get(register.name)
                if before is None or before[0] is not newest or before[1] is not is_current:
                    given[register.name] = newest, is_current
                    reason = "" if newest is None or newest is good else hub.status(newest[3])
                    states.append(state_of(drive, register.name, newest, good, is_current, reason))
            if number % STATE_TURNS != self._turn % STATE_TURNS:
                continue
            shown = hub.seen(drive)
            for name, code, text in (STATE, GOOD, shown.state), (FAULT, *fault_of(shown)):
                if given.get(name) != (code, text):
                    given[name] = code, text
                    states.append(VariableState(drive, name, code, text, time.time_ns()))
        return states

    async def _stop(self, drive: str | None, caller: Caller) -> CommandResult:
        """Stop a drive, or all drives if `drive` is None.

        Return the drive's result; for all drives, return the first failure if there is one.
        """
        try:
            results = await self._context.commands.stop(None if drive is None else [drive], caller)
        except Exception:
            _log.exception("stop of %s by an OPC UA client", drive or "all drives")
            raise
        return next((one for one in results.values() if not one.ok), next(iter(results.values())))

    # ---- in the server's thread ----

    async def _serve(self) -> None:
        from multidrop.gateway.opcua.nodes import PlantNodes, lasting
        from multidrop.gateway.opcua.server import PlantServer

        server = PlantServer(self._listener, lambda *given: self._caller(*given) is not None, self._call)
        with self._quick_process():
            with lasting():
                await server.open(self._context.version, self._identity)
                nodes, ended = PlantNodes(server.internal), asyncio.Event()
                await nodes.make()
                await server.start()
            try:
                self._opened = asyncio.get_running_loop(), ended, nodes
                if not self._is_over:
                    await ended.wait()
            finally:
                await server.stop()

    @contextmanager
    def _quick_process(self) -> Iterator[None]:
        """Shorten the time slices of threads while a server runs.

        When the last server has ended, restore the usual time slices, and let the garbage collector examine
        all objects again. During a reload, two servers may run for a moment.
        """
        _unended.add(self)
        sys.setswitchinterval(SWITCH_S)
        try:
            yield
        finally:
            _unended.discard(self)
            if not _unended:
                sys.setswitchinterval(USUAL_SWITCH_S)
                gc.unfreeze()

    def _caller(self, visitor: Visitor, needed: Right) -> Caller | None:
        """Return a session's user with their present rights; None if the user lacks the right `needed`.

        A user with a wrong token has no rights, except to stop if anyone may stop.
        """
        tokens, may, address = self._context.tokens, self._context.commands.may, visitor.address
        token = None
        if visitor.secret and tokens:  # a gateway without tokens ignores the token that a user sends
            token = tokens.find(visitor.secret)
            if token is None:
                self._note_wrong(visitor)
                if needed is not Right.STOP:
                    return None
        free = may.without_token(is_loopback=is_loopback(address))
        caller = caller_with(token, free, "opcua", address)
        return caller if caller is not None and caller.role >= needed else None

    def _note_wrong(self, visitor: Visitor) -> None:
        now, address = time.monotonic(), visitor.address
        if not self._wrong.is_shut(address, now) and self._wrong.note_wrong(address, visitor.secret, now):
            _log.warning("wrong token by opcua from %s", address)

    async def _call(self, call: Any, visitor: Visitor) -> Any:
        """Call a method, which is always a stop. Answer within STOP_WAIT_S, even if the stop takes longer.

        If the method belongs to another object than the one in the request, the stop is carried out, but the
        answer is BadMethodInvalid. Otherwise the client could believe that the drive of the object in the
        request was stopped.
        """
        from asyncua import ua

        from multidrop.gateway.opcua.nodes import object_of

        assert self._opened is not None
        stops = self._opened[2].stops
        if call.MethodId not in stops:
            return ua.CallMethodResult(ua.StatusCode(ua.StatusCodes.BadMethodInvalid))
        drive, caller = stops[call.MethodId], self._caller(visitor, Right.STOP)
        if caller is None:
            return ua.CallMethodResult(ua.StatusCode(ua.StatusCodes.BadUserAccessDenied))
        stopping = self._stops.begin(drive, partial(self._begin_stop, drive, caller))
        if call.ObjectId != object_of(drive):
            return _answer(ua.StatusCodes.BadMethodInvalid, "this method belongs to another object")
        await asyncio.wait([stopping], timeout=STOP_WAIT_S)
        if not stopping.done():
            return _answer(ua.StatusCodes.GoodCompletesAsynchronously, "the stop is in progress")
        result = stopping.result()
        if result.ok:
            return _answer(ua.StatusCodes.Good, result.text)
        is_silent = isinstance(result.error, NoReply)
        return _answer(
            ua.StatusCodes.BadNoCommunication if is_silent else ua.StatusCodes.BadUnexpectedError, result.text
        )

    def _begin_stop(self, drive: str | None, caller: Caller) -> asyncio.Future[CommandResult]:
        assert self._loop is not None
        work = self._stop(drive, caller)
        return asyncio.wrap_future(asyncio.run_coroutine_threadsafe(work, self._loop))


def _answer(code: int, text: str) -> Any:
    from asyncua import ua

    return ua.CallMethodResult(ua.StatusCode(code), OutputArguments=[ua.Variant(text, ua.VariantType.String)])
