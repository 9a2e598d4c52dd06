"""multidrop as a backend of modbus-connection, compared with its other backends.

Most tests need Python 3.12 or newer, modbus-connection with its backends, and device libraries that use it:
`tests/peers/backend/run` creates such a Debian system. As a program, this file prints how many values each
backend gets wrong if replies are late.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import pytest

needs_package = pytest.mark.skipif(
    find_spec("modbus_connection") is None, reason="needs modbus-connection: tests/peers/backend/run"
)
BACKENDS = ("multidrop.modbus_connection", "modbus_connection.pymodbus", "modbus_connection.tmodbus")
LATE_S, TIMEOUT_S = 0.6, 0.5
READS, LATE_EVERY = 40, 4  # every fourth reply is late

# a device's function from a request to its reply; both are unit id, function code and data, without a CRC
Answer = Callable[[bytes], bytes]


def crc(data: bytes) -> bytes:
    """Return the CRC-16/MODBUS of the serial-line guide, 6.2.2, low byte first."""
    register = 0xFFFF
    for byte in data:
        register ^= byte
        for _ in range(8):
            register = register >> 1 ^ (0xA001 if register & 1 else 0)
    return register.to_bytes(2, "little")


async def rtu_request(reader: asyncio.StreamReader) -> tuple[bytes, Callable[[bytes], bytes]]:
    body = await reader.readexactly(6)
    if body[1] in (0x0F, 0x10):
        body += await reader.readexactly(1)
        body += await reader.readexactly(body[6])
    assert await reader.readexactly(2) == crc(body)
    return body, lambda reply: reply + crc(reply)


async def tcp_request(reader: asyncio.StreamReader) -> tuple[bytes, Callable[[bytes], bytes]]:
    head = await reader.readexactly(6)
    body = await reader.readexactly(int.from_bytes(head[4:6]))
    return body, lambda reply: head[:4] + len(reply).to_bytes(2) + reply


@asynccontextmanager
async def device(answer: Answer, framer: str, late: Iterator[bool]) -> AsyncIterator[int]:
    """Serve a device on a TCP port, and yield the port. Requests are answered one after the other."""
    take = tcp_request if framer == "socket" else rtu_request

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while True:
                body, framed = await take(reader)
                if next(late, False):
                    await asyncio.sleep(LATE_S)
                writer.write(framed(answer(body)))
        except (asyncio.IncompleteReadError, ConnectionError):
            writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    try:
        yield server.sockets[0].getsockname()[1]
    finally:
        server.close()


class Registers:
    """A simulated device. `requests` has the bodies of all requests so far."""

    def __init__(self, held: Callable[[int], int]) -> None:
        self.held = held
        self.written: dict[int, int] = {}
        self.requests: list[bytes] = []

    def answer(self, body: bytes) -> bytes:
        self.requests.append(body)
        start, count = int.from_bytes(body[2:4]), int.from_bytes(body[4:6])
        if body[1] in (3, 4):
            words = [self.written.get(at, self.held(at)) for at in range(start, start + count)]
            data = b"".join(word.to_bytes(2) for word in words)
            return body[:2] + bytes([len(data)]) + data
        if body[1] in (1, 2):  # coils and discrete inputs, which are off
            return body[:2] + bytes([(count + 7) // 8, *bytes((count + 7) // 8)])
        values = (
            [count] if body[1] == 6 else [int.from_bytes(body[at : at + 2]) for at in range(7, len(body), 2)]
        )
        self.written |= {start + at: value for at, value in enumerate(values)}
        return body[:6]


def own_value(address: int) -> int:
    """Return a register's value, which is different for each address."""
    return address * 257 & 0xFFFF


async def late_values(backend: str, framer: str) -> tuple[int, int, int]:
    """Return the numbers of reads that returned the right value, a wrong value, or an error."""
    neutral = import_module("modbus_connection")
    late = (number % LATE_EVERY == LATE_EVERY - 1 for number in range(10**6))
    async with device(Registers(own_value).answer, framer, late) as port:
        params = neutral.ModbusTcpParams(host="127.0.0.1", port=port)
        if framer == "rtu":
            params = neutral.ModbusSerialParams(device=f"socket://127.0.0.1:{port}")
        connection = import_module(backend).ModbusConnection(params, timeout=TIMEOUT_S)
        unit, right, wrong = connection.for_unit(1), 0, 0
        for address in range(1, READS + 1):
            try:
                found = await unit.read_holding_registers(address, 1)
            except neutral.ModbusError:
                continue
            right += found == [own_value(address)]
            wrong += found != [own_value(address)]
        await connection.close()
    return right, wrong, READS - right - wrong


@pytest.mark.skipif(find_spec("modbus_connection") is not None, reason="modbus-connection is installed")
def test_the_error_without_modbus_connection_says_what_to_install() -> None:
    with pytest.raises(ImportError, match=r"needs Python 3\.12 or newer .* modbus-connection: pip install"):
        import_module("multidrop.modbus_connection")


@needs_package
@pytest.mark.parametrize("framer", ["rtu", "socket"])
def test_no_late_reply_is_returned_for_another_register(framer: str) -> None:
    right, wrong, _ = asyncio.run(late_values("multidrop.modbus_connection", framer))
    assert wrong == 0
    assert right >= READS // 2


def run(use: Callable[[Any, Registers], Awaitable[None]], held: Callable[[int], int] = own_value) -> None:
    """Call `use` with two arguments: a connection through multidrop, and the registers of its device."""

    async def story() -> None:
        neutral, ours = import_module("modbus_connection"), import_module("multidrop.modbus_connection")
        registers = Registers(held)
        async with device(registers.answer, "socket", iter(())) as port:
            connection = ours.ModbusConnection(neutral.ModbusTcpParams(host="127.0.0.1", port=port))
            try:
                await use(connection, registers)
            finally:
                await connection.close()

    asyncio.run(story())


@needs_package
def test_one_register_is_written_with_the_function_code_of_the_caller() -> None:
    """Some devices know function 16 only, even for one register."""

    async def use(connection: Any, registers: Registers) -> None:
        await connection.for_unit(1).write_register(5, 7)
        await connection.for_unit(1).write_registers(5, [8])
        assert [body[1] for body in registers.requests] == [6, 3, 16, 3]
        assert registers.written == {5: 8}

    run(use)


@needs_package
def test_a_write_raises_no_error_if_the_register_returns_to_0(caplog: pytest.LogCaptureFixture) -> None:
    """If this write raised an error, a caller might write again and so repeat the command."""

    async def use(connection: Any, registers: Registers) -> None:
        registers.written = type("Forgetful", (dict,), {"__ior__": lambda self, other: self})()
        await connection.for_unit(1).write_register(5, 7)

    run(use, lambda address: 0)
    assert "the device holds [0]" in caplog.text


@needs_package
def test_unsupported_functions_and_parameters_are_refused_in_one_sentence() -> None:
    neutral, ours = import_module("modbus_connection"), import_module("multidrop.modbus_connection")
    for params in (neutral.ModbusUdpParams(host="h"), neutral.ModbusTlsParams(host="h")):
        with pytest.raises(ValueError, match=r"multidrop does not support Modbus\w+Params: use"):
            ours.ModbusConnection(params)
    with pytest.raises(ValueError, match="the scheme esphome:// is not supported"):
        ours.ModbusConnection(neutral.ModbusSerialParams(device="esphome://proxy"))

    async def use(connection: Any, registers: Registers) -> None:
        unit = connection.for_unit(1)
        assert isinstance(unit, neutral.ModbusUnit)
        with pytest.raises(NotImplementedError, match="multidrop does not send Modbus function 14H: use"):
            await unit.read_file_record(1, 0, 2)
        with pytest.raises(NotImplementedError, match="does not send diagnostics sub-function 04H"):
            await unit.diagnostics(4)
        assert registers.requests == []

    run(use)


@needs_package
def test_a_library_for_heat_pumps_reads_and_writes_through_multidrop() -> None:
    weider = pytest.importorskip("weider_modbus")
    held = {13: 485, 15: 0xFFCE, 44: 1250, 1: 450, 723: 210}  # 48.5 °C, -5.0 °C, 1.25 m³/h, 45 °C, 21 °C

    async def use(connection: Any, registers: Registers) -> None:
        pump = weider.WeiderWT16(connection.for_unit(1))
        await pump.async_update()
        assert pump.measurements.hot_water_temperature == pytest.approx(48.5)
        assert pump.measurements.outdoor_temperature == pytest.approx(-5.0)
        assert pump.measurements.volume_flow == pytest.approx(1.25)
        assert pump.settings.room_target_temperature == pytest.approx(21.0)
        await pump.async_set_hot_water_target(50.0)
        assert registers.written == {1: 500}

    run(use, lambda address: held.get(address, 0))


@needs_package
def test_a_library_for_inverters_reads_through_multidrop() -> None:
    sunsynk = pytest.importorskip("sunsynk_modbus")
    held = {3: 0x3230, 4: 0x3331, 16: 36000, 59: 2, 79: 5001, 90: 1455, 109: 3120}

    async def use(connection: Any, registers: Registers) -> None:
        inverter = sunsynk.SunsynkInverter(connection.for_unit(1))
        await inverter.async_update()
        assert inverter.identity.serial_number == "2031"
        assert inverter.identity.rated_power == pytest.approx(3600)
        assert inverter.readings.state is sunsynk.InverterState.NORMAL
        assert inverter.readings.grid_frequency == pytest.approx(50.01)
        assert inverter.readings.dc_transformer_temperature == pytest.approx(45.5)
        assert inverter.readings.pv1_voltage == pytest.approx(312.0)

    run(use, lambda address: held.get(address, 0))


if __name__ == "__main__":
    logging.disable()
    print(
        f"{READS} reads of different registers, time-out {TIMEOUT_S} s; every fourth reply after {LATE_S} s\n"
    )
    print(f"{'backend':30} {'framing':8} {'own value':>9} {'another':>8} {'error':>6}")
    for name in BACKENDS:
        for framing in ("rtu", "socket"):
            counts = asyncio.run(late_values(name, framing))
            print(f"{name:30} {framing:8} {counts[0]:9} {counts[1]:8} {counts[2]:6}", flush=True)
