"""Modbus TCP clients: each gets only its own answers, and a stop waits for no other request or answer."""

from __future__ import annotations

import asyncio
import random
import socket
import struct
import threading
from collections.abc import Awaitable, Callable, Iterator
from typing import cast

import pytest
from controlled_loop import ControlledLoop
from controlled_loop import run_controlled as run_test
from modbus_gateway import DONE, PATIENCE, FakeLine, Gateway, RawClient, RawReply, plant_of, request, serving
from tables import usually

from multidrop import Drive, reading
from multidrop.control import CommandResult
from multidrop.families import InvtCHE
from multidrop.gateway.modbus_server import clients as modbus_clients
from multidrop.gateway.modbus_server.clients import ModbusClient, ModbusPort
from multidrop.gateway.modbus_server.passed_requests import BURST_S, EXPIRY_S, MOST_WAITING, SHARE, LineShare
from multidrop.gateway.modbus_server.protocol import MbapRequest, PassingBusy, take_request
from multidrop.gateway.modbus_server.settings import ModbusSettings

UNREAD = 150_000  # so many requests that their answers do not fit into the socket buffers of both sides


class FakeTransport(asyncio.Transport):
    """A transport that stores the bytes written to it."""

    def __init__(self, address: str = "127.0.0.1") -> None:
        super().__init__({"peername": (address, 40000)})
        self.written = bytearray()
        self.taken = 0  # number of stored bytes that the client has read
        self.is_reading = True  # type: ignore[assignment, method-assign]
        self.ended = ""

    def write(self, data: bytes) -> None:  # type: ignore[override]
        self.written += data

    def get_write_buffer_size(self) -> int:
        return len(self.written) - self.taken

    def is_closing(self) -> bool:
        return bool(self.ended)

    def pause_reading(self) -> None:
        self.is_reading = False  # type: ignore[assignment, method-assign]

    def resume_reading(self) -> None:
        self.is_reading = True  # type: ignore[assignment, method-assign]

    def close(self) -> None:
        self.ended = self.ended or "closed"

    def abort(self) -> None:
        self.ended = self.ended or "aborted"


def words(found: MbapRequest, client: ModbusClient) -> bytes:
    return found.reply(b"\x02\0\x05")


def connected(port: ModbusPort, address: str = "127.0.0.1") -> tuple[ModbusClient, FakeTransport]:
    client, transport = ModbusClient(port), FakeTransport(address)
    client.connection_made(transport)
    return client, transport


def port_of(
    serve: Callable[[MbapRequest, ModbusClient], bytes | Awaitable[bytes] | None] = words,
) -> ModbusPort:
    return ModbusPort(serve, lambda address: not address.startswith("10."), asyncio.get_running_loop().time)


def transactions(written: bytes) -> list[int]:
    buffer, found = bytearray(written), []
    while taken := take_request(buffer):
        found.append(taken.transaction)
    return found


async def test_modbus_answers_are_sent_in_the_order_they_become_ready() -> None:
    async def slow(found: MbapRequest) -> bytes:
        await asyncio.sleep(found.transaction)
        return found.reply(bytes([found.transaction]))

    client, transport = connected(port_of(lambda found, _: slow(found)))
    client.data_received(b"".join(request(number, 1, 3, 0, 1) for number in (3, 1, 2)))
    await asyncio.sleep(5)
    assert transactions(transport.written) == [1, 2, 3]
    assert [transport.written[at + 8] for at in (0, 9, 18)] == [1, 2, 3]


async def test_an_internal_error_is_answered_with_a_modbus_exception(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async def fails(found: MbapRequest) -> bytes:
        raise RuntimeError("a mistake of ours")

    client, transport = connected(port_of(lambda found, _: fails(found)))
    client.data_received(request(9, 1, 3, 0, 1))
    await asyncio.sleep(1)
    assert transport.written == bytes.fromhex("00 09 00 00 00 03 01 83 04")
    assert "a mistake of ours" in caplog.text


async def test_a_flooding_client_does_not_delay_other_clients() -> None:
    port = port_of()
    flood, flooded = connected(port)
    other, answered = connected(port)
    flood.data_received(b"".join(request(number, 1, 3, 0, 1) for number in range(1000)))
    assert len(transactions(flooded.written)) == modbus_clients.SLICE
    other.data_received(request(1, 1, 3, 0, 1))
    assert transactions(answered.written) == [1]
    await asyncio.sleep(1)
    assert transactions(flooded.written) == list(range(1000))


def slowly(found: MbapRequest, _: ModbusClient) -> bytes:
    """Return an answer, and advance the event loop's clock by 0.5 ms."""
    cast(ControlledLoop, asyncio.get_running_loop()).passing.now += 0.0005
    return found.reply(b"")


async def test_all_busy_modbus_clients_share_one_time_slice_per_loop_cycle() -> None:
    """A stop may have to wait for one cycle, in which each client has a turn."""
    share = modbus_clients.RoundShare()
    clock = cast(ControlledLoop, asyncio.get_running_loop()).passing
    ports = [ModbusPort(slowly, lambda _: True, lambda: clock.now, share) for _ in range(2)]
    block = b"".join(request(number, 1, 3, 0, 1) for number in range(100))
    clients = [connected(port) for port in ports for _ in range(30)]
    for client, _ in clients:
        client.data_received(block)
    begun = clock.now
    for client, _ in clients:  # one round
        client._drain()
    assert clock.now - begun < 60 * 2 * modbus_clients.SLICE_S / 3
    for client, transport in clients:
        while client._waiting:
            client._drain()
        assert transactions(transport.written) == list(range(100))
    assert share.slice_s == modbus_clients.SLICE_S


async def test_invalid_bytes_close_a_modbus_connection_after_earlier_answers() -> None:
    port = port_of()
    client, transport = connected(port)
    _, other = connected(port)
    client.data_received(request(1, 1, 3, 0, 1) + b"GET / HTTP/1.1\r\n" + request(2, 1, 3, 0, 1))
    assert transactions(transport.written) == [1]
    assert (transport.ended, other.ended) == ("closed", "")


async def test_a_modbus_client_is_disconnected_if_it_reads_no_answers() -> None:
    port = port_of()
    client, transport = connected(port)
    client.pause_writing()
    await asyncio.sleep(modbus_clients.STALLED_S - 0.1)
    port.sweep()
    assert not transport.ended
    await asyncio.sleep(0.2)
    port.sweep()
    assert transport.ended == "aborted"

    client, transport = connected(port)
    client.pause_writing()
    client.resume_writing()
    await asyncio.sleep(modbus_clients.STALLED_S + 1)
    port.sweep()
    assert not transport.ended


def reads(first: int, end: int) -> bytes:
    return b"".join(request(number, 1, 3, 0, 1) for number in range(first, end))


READ_SIZE = len(reads(0, 1))


def writes(first: int, end: int) -> bytes:
    return b"".join(request(number, 1, 6, 0xF00A, 1) for number in range(first, end))


@pytest.mark.parametrize("is_stalled", [False, True])
async def test_modbus_writes_start_before_waiting_reads_of_the_same_client(is_stalled: bool) -> None:
    begun: list[int] = []

    def noted(found: MbapRequest, _: ModbusClient) -> bytes:
        begun.append(found.transaction)
        return found.reply(b"")

    client, transport = connected(port_of(noted))
    if is_stalled:
        client.pause_writing()
    client.data_received(reads(0, 500) + writes(500, 502))
    assert begun[:2] == [500, 501]
    assert len(begun) == (2 if is_stalled else 2 + modbus_clients.SLICE)
    client.resume_writing()
    await asyncio.sleep(1)
    assert begun == transactions(transport.written) == [500, 501, *range(500)]


@pytest.mark.parametrize("frames", [reads, writes])
async def test_a_long_queue_of_requests_is_answered_in_several_steps(
    frames: Callable[[int, int], bytes],
) -> None:
    client, transport = connected(port_of(slowly))
    client.data_received(frames(0, 100))
    assert len(transactions(transport.written)) < 10
    assert transport.is_reading is (frames is reads)
    await asyncio.sleep(1)
    assert transactions(transport.written) == list(range(100))
    assert transport.is_reading


def test_excess_read_requests_are_dropped_if_a_client_reads_no_answers(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(modbus_clients, "MOST_UNTAKEN", 4096)
    monkeypatch.setattr(modbus_clients, "MOST_BEHIND", 1000 * READ_SIZE)

    async def main() -> None:
        begun = 0

        def noted(found: MbapRequest, _: ModbusClient) -> bytes:
            nonlocal begun
            begun += found.function == 6
            return words(found, client)

        client, transport = connected(port_of(noted))
        client.pause_writing()
        for first in range(0, 6000, 1000):
            client.data_received(reads(first, first + 500) + writes(first + 500, first + 1000))
        await asyncio.sleep(1)
        assert (begun, transport.is_reading) == (3000, True)
        kept = len(transport.written)
        assert kept < modbus_clients.MOST_UNTAKEN + 500 * len(request(1, 1, 6, 0, 1))
        transport.taken = kept
        client.resume_writing()
        await asyncio.sleep(1)
        answered = transactions(transport.written[kept:])
        assert answered == [*range(500), *range(1000, 1500)]  # the other reads did not fit into the queue
        client.data_received(reads(7, 8))
        assert transactions(transport.written)[-1] == 7

    run_test(main())
    assert caplog.text.count("does not read its answers") == 1


async def test_requests_beyond_the_queue_limit_are_answered_busy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(modbus_clients, "MOST_BEHIND", 1000 * READ_SIZE)
    client, transport = connected(port_of())
    client.data_received(reads(0, 1002))
    await asyncio.sleep(1)
    busy, rest = transport.written[:18], transport.written[18:]
    assert busy == bytes.fromhex("03 E8 00 00 00 03 01 83 06 03 E9 00 00 00 03 01 83 06")
    assert transactions(rest) == list(range(1000))


async def test_an_idle_client_is_disconnected_unless_it_waits_for_an_answer() -> None:
    never = asyncio.get_running_loop().create_future()
    port = port_of(lambda found, _: never if found.transaction == 9 else found.reply(b""))
    connections = [connected(port) for _ in range(3)]
    connections[1][0].data_received(request(9, 1, 3, 0, 1))
    await asyncio.sleep(modbus_clients.IDLE_S - 1)
    connections[2][0].data_received(request(1, 1, 3, 0, 1))
    await asyncio.sleep(2)
    port.sweep()
    assert [transport.ended for _, transport in connections] == ["closed", "", ""]
    never.cancel()


async def test_a_new_client_replaces_the_longest_idle_client_at_the_limit() -> None:
    port = port_of()
    found = []
    for _ in range(modbus_clients.MOST_CLIENTS):
        found.append(connected(port)[1])
        await asyncio.sleep(0.1)
    refused = connected(port)[1]
    # refused instead of replacing another, because no other client was idle for 10 s
    assert refused.ended == "aborted"
    await asyncio.sleep(modbus_clients.FORGETTABLE_S - 6.35)
    assert not connected(port)[1].ended
    assert [transport.ended for transport in found[:2]] == ["aborted", ""]
    assert len(port.clients) == modbus_clients.MOST_CLIENTS
    assert port.refused == 1


async def test_a_modbus_client_is_refused_if_its_address_is_not_listed() -> None:
    port = port_of()
    assert connected(port, "10.0.0.1")[1].ended == "aborted"
    assert not port.clients


async def test_an_answer_in_progress_is_cancelled_if_its_client_disconnects() -> None:
    happened = []

    async def slow(found: MbapRequest) -> bytes:
        happened.append("begun")
        try:
            await asyncio.sleep(10)
        except asyncio.CancelledError:
            happened.append("cancelled")
            raise
        return b""

    port = port_of(lambda found, _: slow(found))
    client, transport = connected(port)
    client.data_received(request(1, 1, 3, 0, 1))
    client.connection_lost(None)
    await asyncio.sleep(1)
    assert happened == ["begun", "cancelled"]
    assert (transport.written, port.clients) == (b"", set())


async def test_a_client_gets_answers_after_closing_its_sending_side() -> None:
    async def slow(found: MbapRequest) -> bytes:
        await asyncio.sleep(1)
        return found.reply(b"")

    client, transport = connected(port_of(lambda found, _: slow(found)))
    client.data_received(request(5, 1, 3, 0, 1))
    assert client.eof_received() is True
    await asyncio.sleep(2)
    assert transactions(transport.written) == [5]
    assert transport.ended == "closed"
    assert connected(port_of())[0].eof_received() is False


def test_invalid_bytes_of_one_client_do_not_affect_another() -> None:
    plant = plant_of(("hall", InvtCHE(1, name="mill")))
    with serving(plant, ModbusSettings(listen="127.0.0.1:0")) as gateway, gateway.client() as good:
        gateway.hub.values["mill", "output_voltage"] = 231.0
        for junk in (
            b"\xff" * 300,
            b"GET / HTTP/1.1\r\nHost: x\r\n\r\n",
            bytes(64),
            b"\0\1\0\0\0\6\0\3\0\0\0\1",
        ):
            with gateway.client() as bad:
                bad.send(junk)
                assert bad.receive() is None
            assert good.ask(1, 3, 0x3003, 1).words == [231]


def test_reset_connections_do_not_affect_other_clients() -> None:
    plant = plant_of(("hall", InvtCHE(1, name="mill")))
    with serving(plant, ModbusSettings(listen="127.0.0.1:0")) as gateway, gateway.client() as good:
        gateway.hub.values["mill", "output_voltage"] = 231.0
        for _ in range(20):
            with RawClient(gateway.server.ports[""]) as bad:
                bad.send(request(1, 1, 3, 0x3003, 1) * 50)
                bad.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        assert good.ask(1, 3, 0x3003, 1).words == [231]


@pytest.mark.long
def test_a_stop_is_sent_although_its_client_reads_no_answers() -> None:
    plant = plant_of(("hall", InvtCHE(1, name="mill")))
    with serving(plant, ModbusSettings(listen="127.0.0.1:0", may="stop")) as gateway:
        stopped = threading.Event()

        async def stop() -> CommandResult:
            stopped.set()
            return DONE

        gateway.commands.told = stop
        with socket.socket() as client:
            client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            client.settimeout(PATIENCE)
            client.connect(("127.0.0.1", gateway.server.ports[""]))
            for _ in range(UNREAD // 1000):
                client.sendall(b"".join(request(number, 1, 3, 0xF000, 16) for number in range(1000)))
            client.sendall(request(1, 1, 6, 0xF00A, 1))
            assert stopped.wait(PATIENCE)


# numbers of a drive's registers: polled ones, and those that are read from the drive for each request
POLLED, PASSED = 500, 40
CLIENTS = 3
WINDOW = 200  # requests sent before the client reads their answers


class Ramp(Drive):
    """A drive whose registers all hold different numbers."""


Wide = type("Wide", (Ramp,), {f"level_{at}": reading(at) for at in range(POLLED + PASSED)})


def value(unit: int, address: int) -> int:
    """Return the number in a register, by unit id and address."""
    return (7919 * address + 20011 * unit) % 0x10000


class SlowLine(FakeLine):
    """A line that returns the registers' numbers. It answers some later requests before earlier ones."""

    async def ask(self, drive: str, function: int, start: int, count: int, expiry: float) -> list[int]:
        await asyncio.sleep(0.001 * (start % 5))
        return [value(int(drive), start + at) for at in range(count)]


@pytest.fixture
def gateway(monkeypatch: pytest.MonkeyPatch) -> Iterator[Gateway]:
    monkeypatch.setattr("modbus_gateway.FakeLine", SlowLine)
    units = range(1, CLIENTS + 1)
    plant = plant_of(*((f"line-{unit}", Wide(unit, name=str(unit))) for unit in units))
    with serving(plant, ModbusSettings(listen="127.0.0.1:0", passing="any")) as found:
        for unit in units:
            for address in range(POLLED):
                found.hub.values[str(unit), f"level_{address}"] = float(value(unit, address))
        yield found


def expected(unit: int, start: int, count: int) -> list[int]:
    return [value(unit, start + at) for at in range(count)]


def drawn(chance: random.Random) -> tuple[int, int]:
    """Return a random address and count. One range in fifty is not polled, but read from the drive."""
    if chance.random() < 0.02:
        return POLLED + chance.randrange(PASSED - 4), chance.randint(1, 4)
    return chance.randrange(POLLED - 4), chance.randint(1, 4)


def pipeline(client: RawClient, unit: int, requests: int) -> int:
    """Pipeline requests and check each reply; return how many requests were passed on to the line."""
    chance = random.Random(unit)
    passed = 0
    for first in range(0, requests, WINDOW):
        asked = {(first + at) % 0x10000: drawn(chance) for at in range(WINDOW)}
        client.send(b"".join(request(number, unit, 3, *where) for number, where in asked.items()))
        for _ in range(WINDOW):
            reply = client.receive()
            assert isinstance(reply, RawReply)
            start, count = asked.pop(reply.transaction)
            assert reply.unit == unit
            if start >= POLLED and reply.code == 6:
                continue  # the share of bus time that clients may use is used up
            assert (reply.function, reply.words) == (3, expected(unit, start, count))
            passed += start >= POLLED
        assert asked == {}
    return passed


def all_clients(gateway: Gateway, requests: int) -> None:
    """Run concurrent clients that pipeline requests to different unit ids with equal transaction ids."""
    failures: list[BaseException] = []
    passed: list[int] = []

    def run(unit: int) -> None:
        try:
            with gateway.client() as client:
                passed.append(pipeline(client, unit, requests // CLIENTS))
        except BaseException as failure:
            failures.append(failure)

    threads = [threading.Thread(target=run, args=(unit,)) for unit in range(1, CLIENTS + 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if failures:
        raise failures[0]
    # requests passed on to the line are answered later than others, so answers were out of order
    assert sum(passed) > 10


@pytest.mark.long
def test_each_of_thousands_of_answers_has_the_transaction_id_of_its_request(gateway: Gateway) -> None:
    all_clients(gateway, 8_000)


@pytest.mark.nightly
def test_each_of_a_million_answers_has_the_transaction_id_of_its_request(gateway: Gateway) -> None:
    all_clients(gateway, 1_000_000)


@pytest.mark.long
def test_a_client_gets_all_answers_although_it_reads_them_late(gateway: Gateway) -> None:
    """The client sends all requests before it reads any answer. Until then, the server keeps the answers."""
    requests = 20_000
    with gateway.client() as client:
        frames = b"".join(request(number, 1, 3, 0, 120) for number in range(requests))
        sender = threading.Thread(target=client.send, args=(frames,))
        sender.start()
        with gateway.client() as other:  # another client is served although the first reads no answers
            for _ in range(50):
                assert other.ask(2, 3, 1, 1).words == expected(2, 1, 1)
        for number in range(requests):
            reply = client.receive()
            assert reply is not None
            assert (reply.transaction, reply.words) == (number, expected(1, 0, 120))
        sender.join()


# ---- the share of a line's time that Modbus clients may use: measured, limited, and divided fairly ----


class PacedLine:
    """A line on which each request takes `seconds`; it records start times and overlaps of requests."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self.under_way = self.most = 0
        self.begun: list[float] = []
        self.left: list[float] = []

    async def ask(self, left: float) -> list[int]:
        self.begun.append(asyncio.get_running_loop().time())
        self.left.append(left)
        self.under_way += 1
        self.most = max(self.most, self.under_way)
        await asyncio.sleep(self.seconds)
        self.under_way -= 1
        return [len(self.begun)]


async def flood(share: LineShare, line: PacedLine, seconds: float, clients: int = 3) -> int:
    """Send requests without pauses for `seconds`; return the number of answers."""
    loop = asyncio.get_running_loop()
    until = loop.time() + seconds
    answered = 0

    async def client(name: object) -> None:
        nonlocal answered
        while loop.time() < until:
            try:
                await share.ask(name, line.ask)
                answered += 1
            except PassingBusy:
                await asyncio.sleep(0.01)

    await asyncio.gather(*(client(f"client {number % clients}") for number in range(clients * 4)))
    return answered


@pytest.mark.long
@pytest.mark.parametrize("seconds", usually(0.03, 0.005, 0.7))
async def test_a_flooding_client_gets_exactly_a_fifth_of_the_bus_time(seconds: float) -> None:
    loop = asyncio.get_running_loop()
    begun = loop.time()
    share, line = LineShare(), PacedLine(seconds)
    await flood(share, line, 60.0)
    passed = loop.time() - begun
    used = seconds * len(line.begun)
    assert used <= SHARE * passed + BURST_S + seconds
    assert used >= SHARE * 60.0 - BURST_S - 2 * seconds
    assert line.most == 1


@pytest.mark.long
async def test_clients_get_a_limited_share_of_bus_time_in_each_second() -> None:
    share, line = LineShare(), PacedLine(0.01)
    await flood(share, line, 30.0)
    first = line.begun[0]
    for second in range(28):
        window = [at for at in line.begun if second <= at - first < second + 1]
        assert len(window) * 0.01 <= SHARE + BURST_S + 0.01 + 1e-6


async def test_a_request_is_refused_if_eight_others_wait_for_the_line() -> None:
    share, line = LineShare(), PacedLine(0.5)
    # one request in progress, and MOST_WAITING waiting requests
    asked = [share.ask("one", line.ask) for _ in range(1 + MOST_WAITING)]
    await asyncio.sleep(0)
    with pytest.raises(PassingBusy, match="8 requests are waiting"):
        share.ask("one", line.ask)
    results = await asyncio.gather(*asked, return_exceptions=True)
    assert results[0] == [1]
    # the share of bus time that clients may use is used up
    assert all(isinstance(result, PassingBusy) for result in results[1:])


async def test_a_request_is_dropped_after_waiting_a_second_for_the_line() -> None:
    loop = asyncio.get_running_loop()
    share, line = LineShare(), PacedLine(1.5)
    first, second = share.ask("one", line.ask), share.ask("two", line.ask)
    begun = loop.time()
    with pytest.raises(PassingBusy, match="within 1 s"):
        await second
    assert loop.time() - begun == pytest.approx(EXPIRY_S)
    assert await first == [1]
    await asyncio.sleep(60)
    assert len(line.begun) == 1


async def test_each_request_to_a_line_has_the_remaining_time_before_expiry() -> None:
    share, line = LineShare(), PacedLine(0.15)
    first, second = share.ask("one", line.ask), share.ask("one", line.ask)
    await asyncio.gather(first, second)
    assert line.left == [pytest.approx(1.0), pytest.approx(0.85)]


async def test_the_last_request_of_a_greedy_client_is_dropped_for_another_client() -> None:
    share, line = LineShare(), PacedLine(0.01)
    greedy = [share.ask("greedy", line.ask) for _ in range(1 + MOST_WAITING)]
    await asyncio.sleep(0)
    modest = share.ask("modest", line.ask)
    results = await asyncio.gather(*greedy, return_exceptions=True)
    assert [isinstance(result, PassingBusy) for result in results] == [False] * MOST_WAITING + [True]
    assert await modest


async def test_waiting_requests_of_a_disconnected_client_are_dropped() -> None:
    share, line = LineShare(), PacedLine(0.1)
    gone = [share.ask("gone", line.ask) for _ in range(3)]
    stays = share.ask("stays", line.ask)
    await asyncio.sleep(0.05)
    for asked in gone:
        asked.cancel()
    assert await stays == [2]
    assert line.most == 1
    assert line.begun[1] - line.begun[0] >= 0.1


async def test_the_next_request_is_sent_after_a_failed_request() -> None:
    async def fails(left: float) -> list[int]:
        raise TimeoutError("no reply")

    share, line = LineShare(), PacedLine(0.01)
    first, second = share.ask("one", fails), share.ask("one", line.ask)
    with pytest.raises(TimeoutError):
        await first
    assert await second == [1]


async def test_closing_the_line_refuses_the_current_and_all_waiting_requests() -> None:
    share, line = LineShare(), PacedLine(0.1)
    current, waits = share.ask("one", line.ask), share.ask("one", line.ask)
    await asyncio.sleep(0.01)
    share.close()
    with pytest.raises(PassingBusy, match="the gateway is shutting down"):
        await waits
    with pytest.raises(PassingBusy, match="the gateway is shutting down"):
        await asyncio.wait_for(current, 1.0)
