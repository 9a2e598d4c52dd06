"""MBAP: requests are taken out of bytes however they come, and each client has its own answers alone."""

from __future__ import annotations

import asyncio
import socket
import struct
from collections.abc import Awaitable, Callable
from typing import cast

import pytest
from controlled_loop import ControlledLoop, run_controlled
from hypothesis import given
from hypothesis import strategies as st
from modbus_gateway import RawClient, plant_of, request, serving
from tables import table

from multidrop.drives import InvtCHE
from multidrop.gateway import mbap
from multidrop.gateway.mbap import Garbage, MbapRequest, ModbusClient, ModbusPort, take_request
from multidrop.gateway.modbus_settings import ModbusSettings

# MODBUS Messaging on TCP/IP Implementation Guide V1.0b, 4.4.2.1 and the example of section 3.1.3:
# transaction 1501H, protocol 0, length 6, unit FFH, function 03, start 0004H, count 0001H
PRINTED = bytes.fromhex("15 01 00 00 00 06 FF 03 00 04 00 01")


def test_the_guide_s_example_is_taken_and_answered() -> None:
    buffer = bytearray(PRINTED)
    found = take_request(buffer)
    assert found == MbapRequest(0x1501, 0xFF, 3, bytes.fromhex("00 04 00 01"))
    assert not buffer
    assert found.reply(bytes.fromhex("02 00 05")) == bytes.fromhex("15 01 00 00 00 05 FF 03 02 00 05")
    assert found.exception(2) == bytes.fromhex("15 01 00 00 00 03 FF 83 02")


def test_each_byte_may_come_alone() -> None:
    buffer = bytearray()
    for byte in PRINTED[:-1]:
        buffer.append(byte)
        assert take_request(buffer) is None
    buffer.append(PRINTED[-1])
    assert take_request(buffer) is not None


@table(
    "header",
    [
        "00 01 00 01",  # of another protocol
        "00 01 FF FF 00 06 01 03",
        "47 45 54 20",  # GET
        "16 03 01 02",  # TLS
        "00 01 00 00 00 00",
        "00 01 00 00 00 01",
        "00 01 00 00 00 FF",  # one more than a frame has
        "00 01 00 00 FF FF",
    ],
)
def test_no_header_is_garbage_as_soon_as_it_is_seen(header: str) -> None:
    with pytest.raises(Garbage):
        take_request(bytearray.fromhex(header))


frames = st.builds(
    lambda transaction, unit, function, data: (
        struct.pack(">HHHBB", transaction, 0, 2 + len(data), unit, function) + data
    ),
    st.integers(0, 0xFFFF),
    st.integers(0, 255),
    st.integers(0, 255),
    st.binary(max_size=252),
)


@given(st.lists(frames, max_size=6), st.lists(st.integers(1, 40), min_size=1, max_size=40))
def test_requests_are_the_same_however_they_are_cut(sent: list[bytes], cuts: list[int]) -> None:
    whole = b"".join(sent)
    buffer, found, at = bytearray(), [], 0
    while at < len(whole):
        size = cuts[len(found) % len(cuts)]
        buffer += whole[at : at + size]
        at += size
        while taken := take_request(buffer):
            found.append(taken)
    assert not buffer
    assert [
        struct.pack(">HHHBB", one.transaction, 0, 2 + len(one.data), one.unit, one.function) + one.data
        for one in found
    ] == sent


# ---- connections ----


class FakeTransport(asyncio.Transport):
    """A connection that keeps what is written to it."""

    def __init__(self, address: str = "127.0.0.1") -> None:
        super().__init__({"peername": (address, 40000)})
        self.written = b""
        self.is_reading = True  # type: ignore[assignment, method-assign]
        self.ended = ""

    def write(self, data: bytes) -> None:  # type: ignore[override]
        self.written += data

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


def test_answers_come_under_their_own_ids_in_the_order_in_which_they_are_done() -> None:
    async def main() -> None:
        async def slow(found: MbapRequest) -> bytes:
            await asyncio.sleep(found.transaction)
            return found.reply(bytes([found.transaction]))

        client, transport = connected(port_of(lambda found, _: slow(found)))
        client.data_received(b"".join(request(number, 1, 3, 0, 1) for number in (3, 1, 2)))
        await asyncio.sleep(5)
        assert transactions(transport.written) == [1, 2, 3]
        assert [transport.written[at + 8] for at in (0, 9, 18)] == [1, 2, 3]

    run_controlled(main())


def test_a_failure_of_ours_is_answered_all_the_same(caplog: pytest.LogCaptureFixture) -> None:
    async def main() -> None:
        async def fails(found: MbapRequest) -> bytes:
            raise RuntimeError("a mistake of ours")

        client, transport = connected(port_of(lambda found, _: fails(found)))
        client.data_received(request(9, 1, 3, 0, 1))
        await asyncio.sleep(1)
        assert transport.written == bytes.fromhex("00 09 00 00 00 03 01 83 04")

    run_controlled(main())
    assert "a mistake of ours" in caplog.text


def test_a_client_s_flood_lets_others_have_their_turn() -> None:
    async def main() -> None:
        port = port_of()
        flood, flooded = connected(port)
        other, answered = connected(port)
        flood.data_received(b"".join(request(number, 1, 3, 0, 1) for number in range(1000)))
        assert len(transactions(flooded.written)) == mbap.SLICE
        assert not flooded.is_reading
        other.data_received(request(1, 1, 3, 0, 1))
        assert transactions(answered.written) == [1]
        await asyncio.sleep(1)
        assert transactions(flooded.written) == list(range(1000))
        assert flooded.is_reading

    run_controlled(main())


def test_requests_that_take_long_to_answer_let_others_have_their_turn_sooner() -> None:
    async def main() -> None:
        loop = cast(ControlledLoop, asyncio.get_running_loop())

        def long(found: MbapRequest, _: ModbusClient) -> bytes:
            loop.passing.now += 0.0005
            return found.reply(b"")

        client, transport = connected(port_of(long))
        client.data_received(b"".join(request(number, 1, 3, 0, 125) for number in range(100)))
        assert len(transactions(transport.written)) < 10
        await asyncio.sleep(1)
        assert transactions(transport.written) == list(range(100))

    run_controlled(main())


def test_garbage_closes_its_client_after_the_answers_before_it() -> None:
    async def main() -> None:
        port = port_of()
        client, transport = connected(port)
        _, other = connected(port)
        client.data_received(request(1, 1, 3, 0, 1) + b"GET / HTTP/1.1\r\n" + request(2, 1, 3, 0, 1))
        assert transactions(transport.written) == [1]
        assert (transport.ended, other.ended) == ("closed", "")

    run_controlled(main())


def test_a_client_that_takes_no_answers_is_read_no_more_and_then_cut() -> None:
    async def main() -> None:
        port = port_of()
        client, transport = connected(port)
        client.pause_writing()
        assert not transport.is_reading
        await asyncio.sleep(mbap.STALLED_S - 0.1)
        port.sweep()
        assert not transport.ended
        await asyncio.sleep(0.2)
        port.sweep()
        assert transport.ended == "aborted"

        client, transport = connected(port)
        client.pause_writing()
        client.resume_writing()
        assert transport.is_reading
        await asyncio.sleep(mbap.STALLED_S + 1)
        port.sweep()
        assert not transport.ended

    run_controlled(main())


def test_an_idle_client_is_let_go_and_one_that_waits_for_an_answer_is_not() -> None:
    async def main() -> None:
        never = asyncio.get_running_loop().create_future()
        port = port_of(lambda found, _: never if found.transaction == 9 else found.reply(b""))
        connections = [connected(port) for _ in range(3)]
        connections[1][0].data_received(request(9, 1, 3, 0, 1))
        await asyncio.sleep(mbap.IDLE_S - 1)
        connections[2][0].data_received(request(1, 1, 3, 0, 1))
        await asyncio.sleep(2)
        port.sweep()
        assert [transport.ended for _, transport in connections] == ["closed", "", ""]
        never.cancel()

    run_controlled(main())


def test_a_client_too_many_takes_the_place_of_the_one_that_is_idle_longest() -> None:
    async def main() -> None:
        port = port_of()
        found = []
        for _ in range(mbap.MOST_CLIENTS):
            found.append(connected(port)[1])
            await asyncio.sleep(0.1)
        refused = connected(port)[1]
        assert refused.ended == "aborted"  # nobody is idle for 10 s
        await asyncio.sleep(mbap.FORGETTABLE_S - 6.35)
        assert not connected(port)[1].ended
        assert [transport.ended for transport in found[:2]] == ["aborted", ""]
        assert len(port.clients) == mbap.MOST_CLIENTS
        assert port.refused == 1

    run_controlled(main())


def test_who_is_not_named_is_refused() -> None:
    async def main() -> None:
        port = port_of()
        assert connected(port, "10.0.0.1")[1].ended == "aborted"
        assert not port.clients

    run_controlled(main())


def test_what_is_under_way_for_a_client_that_is_gone_is_cancelled_once_it_began() -> None:
    async def main() -> None:
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

    run_controlled(main())


def test_a_client_that_sends_no_more_still_gets_its_answers() -> None:
    async def main() -> None:
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

    run_controlled(main())


# ---- over real sockets ----


def test_garbage_of_one_client_is_nothing_to_another() -> None:
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


def test_a_reset_connection_is_only_gone() -> None:
    plant = plant_of(("hall", InvtCHE(1, name="mill")))
    with serving(plant, ModbusSettings(listen="127.0.0.1:0")) as gateway, gateway.client() as good:
        gateway.hub.values["mill", "output_voltage"] = 231.0
        for _ in range(20):
            with RawClient(gateway.server.ports[""]) as bad:
                bad.send(request(1, 1, 3, 0x3003, 1) * 50)
                bad.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        assert good.ask(1, 3, 0x3003, 1).words == [231]


def test_a_port_that_is_taken_is_told_in_one_sentence() -> None:
    plant = plant_of(("hall", InvtCHE(1, name="mill")))
    with socket.create_server(("127.0.0.1", 0)) as taken:
        number = cast(int, taken.getsockname()[1])
        with (
            pytest.raises(OSError, match=rf"127.0.0.1:{number} cannot be had: another program listens there"),
            serving(plant, ModbusSettings(listen=f"127.0.0.1:{number}")),
        ):
            pass
