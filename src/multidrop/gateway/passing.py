"""Passing: the settings of the Modbus server, and the share of a line that its clients may use.

What is not in the cache is asked of the drive: one request at a time on each line, ahead of polling, for a
fifth of the time at most. The time is measured, so a drive that is silent costs its clients their share.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from ipaddress import ip_address, ip_network
from typing import TYPE_CHECKING, Any

from multidrop import Plant
from multidrop.gateway.rights import is_loopback

if TYPE_CHECKING:
    from multidrop.gateway.modbus_server import ModbusServer
    from multidrop.gateway.parts import Inside

MAIN = ""  # the TCP port of all lines that have none of their own
COMMON_LENGTH = 16  # words of the common block

SHARE = 0.2  # of a line's time
BURST_S = 0.2  # of line time that may be used at once after a rest
MOST_WAITING = 8  # requests, on a line
EXPIRY_S = 1.0  # after which a request that waits is not asked any more

PASSING = ("off", "declared", "any")
ROLES = ("look", "stop", "write")


@dataclass(frozen=True)
class ModbusSettings:
    """The table [serve.modbus] of a plant file. Raises ValueError, with a line for each mistake."""

    listen: str = "127.0.0.1:1502"
    passing: str = "declared"  # what is asked of a drive where the cache has it not
    units: Mapping[str, int] = field(default_factory=dict)  # by drive; else its address
    ports: Mapping[str, int] = field(default_factory=dict)  # by line; else that of `listen`
    may: str = "look"  # the role of all clients, which can show no token
    clients: Sequence[str] = ()  # addresses and networks; none: this machine alone
    common: int = 0xF000  # address of the common block

    def __post_init__(self) -> None:
        wrong = [*self._mistakes()]
        if wrong:
            raise ValueError("\n".join(wrong))

    def check(self, plant: Plant) -> list[str]:
        """Return a sentence for each thing that does not fit this plant."""
        from multidrop.gateway.units import Units  # which needs these settings

        try:
            Units(plant, self)
        except ValueError as mistakes:
            return str(mistakes).splitlines()
        return []

    @property
    def host(self) -> str:
        """The address to listen on."""
        return self.listen.rpartition(":")[0].strip("[]")

    @property
    def port(self) -> int:
        """The TCP port of all lines that have none of their own."""
        return int(self.listen.rpartition(":")[2])

    @property
    def common_addresses(self) -> range:
        """Addresses of the common block."""
        return range(self.common, self.common + COMMON_LENGTH)

    def may_connect(self, address: str) -> bool:
        """Return True for the address of a client that may come."""
        host = ip_address(address.partition("%")[0])
        host = getattr(host, "ipv4_mapped", None) or host
        if not self.clients:
            return host.is_loopback
        return any(host in ip_network(network, strict=False) for network in self.clients)

    def _mistakes(self) -> Iterator[str]:
        yield from self._listening_mistakes()
        if self.passing not in PASSING:
            yield f"passing = {self.passing!r} is none of {', '.join(PASSING)}"
        if self.may not in ROLES:
            yield f"may = {self.may!r} is none of {', '.join(ROLES)}"
        for drive, unit in self.units.items():
            if not _is_whole(unit, 1, 255):
                yield f"units: {drive} = {unit!r} is no unit id from 1 to 247 (255 at most)"
        if not _is_whole(self.common, 0, 0x10000 - COMMON_LENGTH):
            yield f"common = {self.common!r} is no address from 0 to {0x10000 - COMMON_LENGTH:#X}"
        for network in self.clients:
            if not _is_network(network):
                yield f"clients: {network!r} is neither an address nor a network such as 10.0.0.0/24"

    def _listening_mistakes(self) -> Iterator[str]:
        host, colon, port = self.listen.rpartition(":")
        host = host.strip("[]")
        is_host = host == "localhost" or _is_address(host)
        if not colon or not is_host or not port.isascii() or not port.isdigit():
            yield f"listen = {self.listen!r} is not ADDRESS:PORT, such as 127.0.0.1:1502"
            return
        if int(port) > 65535:
            yield f"listen = {self.listen!r}: a port is 1 to 65535"
        if not is_loopback(host) and not self.clients:
            yield (
                f"listen = {self.listen!r} lets other machines in, and Modbus knows no tokens: name "
                'those that may come, such as clients = ["10.0.0.5", "10.0.1.0/24"]'
            )
        owners = {int(port): "listen"} if int(port) else {}
        for line, number in self.ports.items():
            if not _is_whole(number, 0, 65535):
                yield f"ports: {line} = {number!r} is no port from 1 to 65535"
            elif number in owners:
                yield f"ports: {line} = {number} is that of {owners[number]} already"
            elif number:
                owners[number] = line


def _is_whole(number: object, least: int, most: int) -> bool:
    return isinstance(number, int) and not isinstance(number, bool) and least <= number <= most


def _is_address(text: str) -> bool:
    try:
        ip_address(text)
    except ValueError:
        return False
    return True


def _is_network(text: object) -> bool:
    try:
        return isinstance(text, str) and bool(ip_network(text, strict=False))
    except ValueError:
        return False


def build(settings: ModbusSettings, inside: Inside) -> ModbusServer:
    """Return the server as a part of the gateway, listening. Raises OSError where a port cannot be had."""
    from multidrop.gateway.modbus_server import ModbusServer  # which needs all else that is here

    server = ModbusServer(inside.plant, inside.hub, inside.commands, settings, inside.ask)
    server.listen()
    return server


class PassingBusy(Exception):
    """A request that is not asked: the queue is full, or its turn did not come in time."""


@dataclass(eq=False)
class _WaitingAsk:
    client: object
    work: Callable[[float], Awaitable[Any]]
    answer: asyncio.Future[Any]
    expires: float  # s, of the loop's clock
    timer: asyncio.TimerHandle | None = None


class LineShare:
    """The requests of all clients to one line: one at a time, a share of its time, the first come first."""

    def __init__(self, share: float = SHARE) -> None:
        self._loop = asyncio.get_running_loop()
        self._share = share
        self._waiting: list[_WaitingAsk] = []
        self._running: asyncio.Task[None] | None = None
        self._left_s = BURST_S  # of line time; below 0 after one that took long
        self._filled = self._loop.time()
        self._timer: asyncio.TimerHandle | None = None
        self.used_s = 0.0  # of line time so far
        self.asked = 0

    def ask(self, client: object, work: Callable[[float], Awaitable[Any]]) -> asyncio.Future[Any]:
        """Queue work, which gets the seconds until it expires; the result is what it returns or raises.

        Raises PassingBusy, or the result does, where its turn does not come. Where the queue is full, the
        client that waits for most loses its last request to one that waits for fewer.
        """
        if len(self._waiting) >= MOST_WAITING:
            self._make_place(client)
        now = self._loop.time()
        asked = _WaitingAsk(client, work, self._loop.create_future(), now + EXPIRY_S)
        asked.timer = self._loop.call_at(asked.expires, self._expire, asked)
        asked.answer.add_done_callback(lambda _: self._forget(asked))
        self._waiting.append(asked)
        self._step()
        return asked.answer

    def _make_place(self, client: object) -> None:
        waiting = Counter(id(asked.client) for asked in self._waiting)
        greediest, most = waiting.most_common(1)[0]
        if most <= waiting[id(client)] + 1:
            raise PassingBusy(f"{len(self._waiting)} requests wait for this line already")
        last = next(asked for asked in reversed(self._waiting) if id(asked.client) == greediest)
        self._refuse(last, "others wait for this line who have asked for less")

    def _expire(self, asked: _WaitingAsk) -> None:
        if asked in self._waiting:
            self._refuse(asked, f"the line was not free for it within {EXPIRY_S:g} s")

    def _refuse(self, asked: _WaitingAsk, why: str) -> None:
        self._waiting.remove(asked)
        if not asked.answer.done():
            asked.answer.set_exception(PassingBusy(why))

    def _forget(self, asked: _WaitingAsk) -> None:
        """Free the place of a request that is answered, or that lost its client."""
        if asked.timer is not None:
            asked.timer.cancel()
        if asked in self._waiting:
            self._waiting.remove(asked)

    # ---- turns ----

    def _step(self) -> None:
        """Begin the next one, now or when the line may be used again."""
        if self._running is not None or not self._waiting:
            return
        now = self._loop.time()
        self._fill(now)
        if self._left_s <= 0:
            if self._timer is None:
                self._timer = self._loop.call_at(now - self._left_s / self._share + 1e-4, self._wake)
            return
        asked = self._waiting.pop(0)
        self._running = self._loop.create_task(self._run(asked))

    def _wake(self) -> None:
        self._timer = None
        self._step()

    def _fill(self, now: float) -> None:
        self._left_s = min(BURST_S, self._left_s + (now - self._filled) * self._share)
        self._filled = now

    async def _run(self, asked: _WaitingAsk) -> None:
        """Ask, also to the end where the client goes meanwhile: the line is used until then."""
        begun = self._loop.time()
        try:
            result = await asked.work(asked.expires - begun)
            if not asked.answer.done():
                asked.answer.set_result(result)
        except Exception as failure:
            if not asked.answer.done():
                asked.answer.set_exception(failure)
        finally:
            ended = self._loop.time()
            self._fill(ended)
            self._left_s -= ended - begun
            self.used_s += ended - begun
            self.asked += 1
            self._running = None
            self._step()

    def close(self) -> None:
        """Ask no more; what is under way is no longer waited for."""
        for asked in list(self._waiting):
            self._refuse(asked, "the gateway ends")
        if self._timer is not None:
            self._timer.cancel()
        if self._running is not None:
            self._running.cancel()
