"""Run a Modbus server in a thread with fake rows and commands; a Modbus client on plain sockets."""

from __future__ import annotations

import asyncio
import socket
import struct
import threading
import time
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from multidrop import WriteForbidden
from multidrop.control import CommandOutcome, CommandResult, result_of_failure
from multidrop.drive import Drive
from multidrop.gateway.commands import Admit
from multidrop.gateway.http.rights import Caller
from multidrop.gateway.live.hub import KeptRow
from multidrop.gateway.modbus_server.server import ModbusServer
from multidrop.gateway.modbus_server.settings import MAIN, ModbusSettings
from multidrop.plant.model import Plant, PlantLine, Polled, PolledDrive

PATIENCE = 30.0  # longest wait for an expected event, in s


class FakeHub:
    """Fake rows by drive and register, with an age set by the test; other registers were never polled."""

    def __init__(self) -> None:
        self.values: dict[tuple[str, str], float | None] = {}
        self.ages: dict[tuple[str, str], float] = {}  # age of each row in s, by drive and register
        self.states: dict[str, str] = {}
        self.woken_ns = 0

    def _good(self, drive: str, register: str) -> KeptRow | None:
        value = self.values.get((drive, register))
        age_ns = round(self.ages.get((drive, register), 0.0) * 1e9)
        return None if value is None else (0, time.monotonic_ns() - age_ns, value, 0)

    def fresh(self, drive: str, register: str, since_ns: int = 0) -> KeptRow | None:
        row, now_ns = self._good(drive, register), time.monotonic_ns()
        return row if row and row[1] >= max(since_ns, self.woken_ns, now_ns - 1_000_000_000) else None

    def last_answer(self, drive: str) -> KeptRow | None:
        return max(filter(None, (self._good(*key) for key in self.values if key[0] == drive)), default=None)

    def now_ns(self) -> int:
        return time.monotonic_ns()

    def woke_ns(self) -> int:
        return self.woken_ns

    def state(self, drive: str) -> str:
        return self.states.get(drive, "unknown")


DONE = CommandResult(CommandOutcome.DONE, "done")


class FakeCommands:
    """Fake commands that record their calls and return results set by the test."""

    def __init__(self) -> None:
        self.told: CommandResult | Callable[[], Awaitable[CommandResult]] = DONE
        self.written: list[tuple[str, str, float, Caller]] = []
        self.stopped: list[tuple[Sequence[str] | None, Caller]] = []
        self.refused: list[tuple[str, str, str]] = []  # refused commands: drive, request, reason
        self.ended: dict[str, int] = {}

    async def _end(self, *drives: str) -> CommandResult:
        try:
            return self.told if isinstance(self.told, CommandResult) else await self.told()
        finally:
            self.ended |= dict.fromkeys(drives, time.monotonic_ns())

    async def stop(self, drives: Sequence[str] | None, caller: Caller) -> dict[str, CommandResult]:
        self.stopped.append((drives, caller))
        return dict.fromkeys(drives or (), await self._end(*(drives or ())))

    async def write(
        self, drive: str, register: str, value: float, caller: Caller, admit: Admit
    ) -> CommandResult:
        try:
            admit(f"{drive}.{register}")
        except WriteForbidden as refusal:
            return result_of_failure(refusal)
        self.written.append((drive, register, value, caller))
        return await self._end(drive)

    def note_refused(self, line: str, drive: str, what: str, why: str, caller: Caller) -> None:
        self.refused.append((drive, what, why))

    def ended_ns(self, drive: str) -> int:
        return self.ended.get(drive, 0)


class FakeLine:
    """A fake line for uncached reads: a register holds its own address, a coil its lowest bit."""

    def __init__(self) -> None:
        self.asked: list[tuple[str, int, int, int]] = []
        self.failure: Exception | None = None
        self.seconds = 0.0

    async def ask(self, drive: str, function: int, start: int, count: int, expiry: float) -> list[int]:
        self.asked.append((drive, function, start, count))
        await asyncio.sleep(self.seconds)
        if self.failure is not None:
            raise self.failure
        if not count:
            return [42]  # the data of a request without addresses
        return [(start + at) & (1 if function < 3 else 0xFFFF) for at in range(count)]


def plant_of(*drives: tuple[str, Drive], polled: bool = True) -> Plant:
    """Return a plant that polls all readable registers of the drives, each given with its line's name."""
    lines: dict[str, list[PolledDrive]] = {}
    for line, drive in drives:
        registers = [register for register in drive.registers.values() if register.readable and polled]
        lines.setdefault(line, []).append(
            PolledDrive(drive, tuple(Polled(register, None) for register in registers))
        )
    made = [PlantLine(name, f"/dev/{name}", drives=tuple(found)) for name, found in lines.items()]
    return Plant(tuple(made), Path("plant.toml"))


@contextmanager
def in_thread(make: Callable[[], ModbusServer]) -> Iterator[ModbusServer]:
    """Run a server in a thread with its own event loop until the block ends."""
    ready: list[ModbusServer] = []
    failures: list[BaseException] = []
    begun = threading.Event()
    loop = asyncio.new_event_loop()

    async def main() -> None:
        server = make()
        server.listen()
        ready.append(server)
        begun.set()
        try:
            await server.run()
        finally:
            await server.close()

    async def guarded() -> None:
        try:
            await main()
        except asyncio.CancelledError:
            pass
        except BaseException as failure:
            failures.append(failure)
        finally:
            begun.set()

    task = loop.create_task(guarded())
    thread = threading.Thread(target=lambda: loop.run_until_complete(task))
    thread.start()
    try:
        assert begun.wait(PATIENCE)
        if failures:
            raise failures[0]
        yield ready[0]
    finally:
        loop.call_soon_threadsafe(task.cancel)
        thread.join()
        loop.run_until_complete(loop.shutdown_asyncgens())
        for left in asyncio.all_tasks(loop):
            left.cancel()
            loop.run_until_complete(asyncio.gather(left, return_exceptions=True))
        loop.close()


class Gateway(NamedTuple):
    server: ModbusServer
    hub: FakeHub
    commands: FakeCommands
    line: FakeLine

    def client(self, port: str = MAIN) -> RawClient:
        return RawClient(self.server.ports[port])


@contextmanager
def serving(plant: Plant, settings: ModbusSettings) -> Iterator[Gateway]:
    """Run a server for this plant with fake rows, commands and lines."""
    hub, commands, line = FakeHub(), FakeCommands(), FakeLine()
    fakes: Any = plant, hub, commands
    with in_thread(lambda: ModbusServer(*fakes, settings, line.ask)) as server:
        yield Gateway(server, hub, commands, line)


def request(transaction: int, unit: int, function: int, *words: int, data: bytes = b"") -> bytes:
    """Return a Modbus TCP request frame, packed after the messaging guide."""
    body = struct.pack(f">BB{len(words)}H", unit, function, *words) + data
    return struct.pack(">HHH", transaction, 0, len(body)) + body


class RawReply(NamedTuple):
    transaction: int
    unit: int
    function: int
    data: bytes

    @property
    def code(self) -> int | None:
        """Return the exception code, or None for a normal reply."""
        return self.data[0] if self.function & 0x80 else None

    @property
    def words(self) -> list[int]:
        return list(struct.unpack(f">{(len(self.data) - 1) // 2}H", self.data[1:]))


class RawClient:
    """A Modbus TCP client that can send arbitrary bytes."""

    def __init__(self, port: int) -> None:
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=PATIENCE)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._stream = self.socket.makefile("rb")

    def __enter__(self) -> RawClient:
        return self

    def __exit__(self, *error: object) -> None:
        self._stream.close()
        self.socket.close()

    def send(self, data: bytes) -> None:
        self.socket.sendall(data)

    def receive(self) -> RawReply | None:
        """Return the next reply, or None if the connection is closed."""
        try:
            header = self._stream.read(8)
            if len(header) < 8:
                return None
            transaction, protocol, length, unit, function = struct.unpack(">HHHBB", header)
            assert protocol == 0
            return RawReply(transaction, unit, function, self._stream.read(length - 2))
        except ConnectionResetError:
            return None

    def ask(self, unit: int, function: int, *words: int, data: bytes = b"") -> RawReply:
        self.send(request(7, unit, function, *words, data=data))
        reply = self.receive()
        assert reply is not None
        assert (reply.transaction, reply.unit, reply.function & 0x7F) == (7, unit, function)
        return reply
