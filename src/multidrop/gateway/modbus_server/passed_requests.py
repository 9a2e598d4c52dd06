"""Requests of Modbus clients and vendors' tools that are passed on to drives: reads, writes and stops.

Reads are sent one at a time, before polls, within a share of the line's time. Their duration is measured, so
timeouts of a silent drive count too. Writes obey the same rules as all commands, and never start a motor.
"""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from math import inf
from typing import Any, Protocol

from multidrop import Register, WriteForbidden
from multidrop.control.commands import JoinedStops
from multidrop.core import boottime_ns
from multidrop.drive import Carrier
from multidrop.gateway.commands import MOST_AGE_S, STOOD_STILL, Commands
from multidrop.gateway.http.rights import Caller, Right
from multidrop.gateway.modbus_server.protocol import (
    WRITES,
    Declined,
    MbapRequest,
    ModbusCode,
    PassingBusy,
    code_of,
)
from multidrop.gateway.modbus_server.settings import StopWrite, Unit
from multidrop.gateway.modbus_server.words import STOP
from multidrop.supervisor import supervisor

SHARE = 0.2  # default share of a line's bus time for requests of clients
BURST_S = 0.2  # limit, in s, of unused bus time that is saved for later requests
MOST_WAITING = 8  # limit of the requests that wait for one line
EXPIRY_S = 1.0  # in s: a request that has waited for this long is dropped
CLOSED = "the gateway is shutting down, or has read its plant file again"
# in s: after a pause of the whole gateway, such as the computer's sleep, it refuses writes for this long
SETTLE_S = 1.0
# in s: how long the answer to a stop waits for the motor; less than the usual timeout of clients
STOP_WAIT_S = 0.4
REFUSAL_S = 1.0  # in s: shortest time between two entries in the audit log about refused writes on one line
_log = logging.getLogger("multidrop.gateway")


@dataclass(eq=False)
class _WaitingRead:
    client: object
    work: Callable[[float], Awaitable[Any]]
    answer: asyncio.Future[Any]
    expires: float  # when the request is dropped, in s of the event loop's clock
    timer: asyncio.TimerHandle | None = None


class LineShare:
    """Sends the requests of clients on one line, one at a time, within a share of the bus time."""

    def __init__(self, share: float = SHARE) -> None:
        self._loop = asyncio.get_running_loop()
        self.share = share
        self._waiting: list[_WaitingRead] = []
        self._running: asyncio.Task[None] | None = None
        self._left_s = BURST_S  # bus time, in s, that requests may use now; negative after a long request
        self._filled = self._loop.time()
        self._timer: asyncio.TimerHandle | None = None

    def ask(self, client: object, work: Callable[[float], Awaitable[Any]]) -> asyncio.Future[Any]:
        """Queue a request, and return a future of its result.

        `work` sends the request; it is called with the seconds until the request expires. If the queue is
        full, one request is dropped: the last one of the client with the most waiting requests, if that
        client has at least two more than `client` has. Otherwise the new request is dropped. The future of a
        dropped request raises PassingBusy; for the new request this call itself raises it.
        """
        if len(self._waiting) >= MOST_WAITING:
            self._make_place(client)
        now = self._loop.time()
        asked = _WaitingRead(client, work, self._loop.create_future(), now + EXPIRY_S)
        asked.timer = self._loop.call_at(asked.expires, self._expire, asked)
        asked.answer.add_done_callback(lambda _: self._forget(asked))
        self._waiting.append(asked)
        self._step()
        return asked.answer

    def _make_place(self, client: object) -> None:
        waiting = Counter(id(asked.client) for asked in self._waiting)
        greediest, most = waiting.most_common(1)[0]
        if most <= waiting[id(client)] + 1:
            raise PassingBusy(f"{len(self._waiting)} requests are waiting for this line already")
        last = next(asked for asked in reversed(self._waiting) if id(asked.client) == greediest)
        self._refuse(last, "other clients with fewer requests wait for this line")

    def _expire(self, asked: _WaitingRead) -> None:
        if asked in self._waiting:
            self._refuse(asked, f"the line was not free for it within {EXPIRY_S:g} s")

    def _refuse(self, asked: _WaitingRead, why: str) -> None:
        self._waiting.remove(asked)
        if not asked.answer.done():
            asked.answer.set_exception(PassingBusy(why))

    def _forget(self, asked: _WaitingRead) -> None:
        """Remove a request from the queue, because it is answered or its client has disconnected."""
        if asked.timer is not None:
            asked.timer.cancel()
        if asked in self._waiting:
            self._waiting.remove(asked)

    # ---- sending the requests one after the other ----

    def _step(self) -> None:
        """Start the next request now, or later if the clients' requests have used up their bus time."""
        if self._running is not None or not self._waiting:
            return
        now = self._loop.time()
        self._fill(now)
        if self._left_s <= 0:
            if self._timer is None:
                self._timer = self._loop.call_at(now - self._left_s / self.share + 1e-4, self._wake)
            return
        asked = self._waiting.pop(0)
        self._running = supervisor().start("passed request", self._run(asked))

    def _wake(self) -> None:
        self._timer = None
        self._step()

    def _fill(self, now: float) -> None:
        self._left_s = min(BURST_S, self._left_s + (now - self._filled) * self.share)
        self._filled = now

    async def _run(self, asked: _WaitingRead) -> None:
        """Carry out a request to its end, even if its client disconnects: the line is busy until then."""
        begun = self._loop.time()
        try:
            result = await asked.work(asked.expires - begun)
            if not asked.answer.done():
                asked.answer.set_result(result)
        except asyncio.CancelledError:
            if not asked.answer.done():
                asked.answer.set_exception(PassingBusy(CLOSED))
            raise
        except Exception as failure:
            if not asked.answer.done():
                asked.answer.set_exception(failure)
        finally:
            ended = self._loop.time()
            self._fill(ended)
            self._left_s -= ended - begun
            self._running = None
            self._step()

    def close(self) -> None:
        """Drop all waiting requests, and cancel the current one."""
        for asked in list(self._waiting):
            self._refuse(asked, CLOSED)
        if self._timer is not None:
            self._timer.cancel()
        if self._running is not None:
            self._running.cancel()


# ---- writes and stops ----


class Standstill:
    """Detects pauses of the gateway of more than MOST_AGE_S, and refuses writes for SETTLE_S after each.

    For example, the computer may have slept. Writes that arrive afterwards may be old, and a Modbus
    request contains no time that would show it.

    `clock` returns CLOCK_BOOTTIME in ns.
    """

    def __init__(self, clock: Callable[[], int] = boottime_ns) -> None:
        self._clock = clock
        self._ran_ns = clock()
        self._until_ns = 0  # writes are refused until this time (CLOCK_BOOTTIME, ns)

    def note(self) -> None:
        """Note that the event loop runs. Call this at least once a second."""
        now_ns = self._clock()
        if now_ns - self._ran_ns > MOST_AGE_S * 1e9:
            self._until_ns = now_ns + round(SETTLE_S * 1e9)
        self._ran_ns = now_ns

    def admit(self, what: str) -> float:
        """Return the deadline for sending a write that is received now (CLOCK_BOOTTIME, ns).

        Raises WriteForbidden within SETTLE_S after a pause of the gateway, because the write may be old.
        """
        self.note()
        if self._ran_ns < self._until_ns:
            reason = f"it may be older than {MOST_AGE_S:g} s, because {STOOD_STILL}"
            raise WriteForbidden(f"{what} was not sent: {reason}", rule=STOOD_STILL)
        return self._ran_ns + MOST_AGE_S * 1e9


class WritingClient(Protocol):
    """The client that sent a request."""

    @property
    def address(self) -> str: ...
    @property
    def is_full(self) -> bool:
        """True while so many requests of this client are in progress that it must not start another."""


class ClientWrites:
    """Carries out the writes of clients that share a role and an interface, such as "modbus".

    `common` has the addresses of the registers that every drive has in the same form, or is None without such
    registers. `standstill` refuses writes that may have waited during a pause of the gateway.
    """

    def __init__(
        self, commands: Commands, role: Right, way: str, common: range | None, standstill: Standstill
    ) -> None:
        self._commands = commands
        self._role = role
        self._way = way
        self._admit = standstill.admit
        self._common = common or range(0)
        self._common_stop = common.start + STOP if common else None
        self._stops = JoinedStops()
        # time of the latest audit entry about a refused write, by line
        self._recorded: dict[str, float] = {}

    def begin(
        self, unit: Unit, request: MbapRequest, client: WritingClient, stop_wait_s: float = STOP_WAIT_S
    ) -> Awaitable[bytes]:
        """Start a write or a stop, and return an awaitable of its answer.

        A stop is answered after `stop_wait_s` at the latest. Raises Declined for a request that is not
        allowed.
        """
        if self._role < Right.STOP:
            raise Declined(ModbusCode.ILLEGAL_FUNCTION)
        carrier, address, count, data = written = WRITES[request.function](request)
        register = unit.writable(carrier, address)
        is_one = count == (register.words if register else 1)
        if not is_one and unit.has_stop_in(written, self._common_stop):
            self._begin_stop(unit, client)
            # refuse the rest of the words, because they may start a motor
            raise Declined(ModbusCode.ILLEGAL_VALUE)
        if carrier is Carrier.WORD and address in self._common:
            if address != self._common_stop:
                raise Declined(ModbusCode.ILLEGAL_ADDRESS)
            if count != 1 or data == b"\0\0":
                raise Declined(ModbusCode.ILLEGAL_VALUE)
            return self._stop_and_answer(unit, request, client, stop_wait_s)
        if register is None:
            raise Declined(
                ModbusCode.ILLEGAL_ADDRESS if self._role >= Right.WRITE else ModbusCode.ILLEGAL_FUNCTION
            )
        raw = register.coding.raw_in(data, 0) if is_one else None
        if raw is not None and StopWrite(register.name, raw) in unit.stops:
            return self._stop_and_answer(unit, request, client, stop_wait_s)
        if self._role < Right.WRITE:
            raise Declined(ModbusCode.ILLEGAL_FUNCTION)
        if raw is None or register.commands:
            raise Declined(ModbusCode.ILLEGAL_VALUE)
        if client.is_full:
            raise Declined(ModbusCode.BUSY)
        write = self._write_one(unit, register, raw, request, client)
        return self._later(request, supervisor().start("modbus write", write), None)

    def _stop_and_answer(
        self, unit: Unit, request: MbapRequest, client: WritingClient, wait_s: float
    ) -> Awaitable[bytes]:
        """Start a stop. If it is joined with others, answer "acknowledge" now, so that no answers pile up."""
        is_joined = self._stops.joins(unit.drive.name)
        stopping = self._begin_stop(unit, client)
        if is_joined:
            raise Declined(ModbusCode.ACKNOWLEDGE)
        return self._later(request, stopping, wait_s)

    async def _later(self, request: MbapRequest, task: asyncio.Future[int], wait_s: float | None) -> bytes:
        """Return the answer to a command.

        If it takes longer than `wait_s`, return "acknowledge"; the command continues.
        """
        done, _ = await asyncio.wait([task], timeout=wait_s)
        # "acknowledge" means that the command is still in progress
        code = task.result() if done else ModbusCode.ACKNOWLEDGE
        return request.exception(code) if code else request.reply(request.data[:4])

    async def _write_one(
        self, unit: Unit, register: Register[Any], raw: float, request: MbapRequest, client: WritingClient
    ) -> int:
        """Write a register; return 0 if it succeeded, else an exception code."""
        value = raw if register.values is not None else register.decode(raw)
        name, caller = unit.drive.name, self._caller(client)
        result = await self._commands.write(name, register.name, value, caller, self._admit)
        if isinstance(result.error, ValueError):  # includes WriteForbidden
            self.note_refused(unit.line, name, request, result.text, client)
        return 0 if result.ok else code_of(result.error)

    def note_refused(
        self, line: str, drive: str, request: MbapRequest, why: str, client: WritingClient
    ) -> None:
        """Make an entry in the audit log about a refused write, at most one in REFUSAL_S for each line."""
        now = asyncio.get_running_loop().time()
        if now - self._recorded.get(line, -inf) >= REFUSAL_S:
            self._recorded[line] = now
            what = f"request {request.text}"
            self._commands.note_refused(line, drive, what, why, self._caller(client))

    def _begin_stop(self, unit: Unit, client: WritingClient) -> asyncio.Future[int]:
        """Start a stop. If many stops of the drive are in progress, start one common stop a little later."""

        def start() -> asyncio.Task[int]:
            return supervisor().start("modbus stop", self._stop_one(unit, self._caller(client)))

        return self._stops.begin(unit.drive.name, start)

    async def _stop_one(self, unit: Unit, caller: Caller) -> int:
        name = unit.drive.name
        try:
            result = (await self._commands.stop([name], caller))[name]
        except Exception:
            _log.exception("stop of %s by way of %s", name, self._way)
            return ModbusCode.NO_RESPONSE
        if result.ok:
            return 0
        code = code_of(result.error)
        return ModbusCode.NO_RESPONSE if code == ModbusCode.DEVICE_FAILURE else code

    def _caller(self, client: WritingClient) -> Caller:
        return Caller("anyone", self._way, client.address, self._role)
