"""mbpoll, libmodbus, pymodbus and minimalmodbus on a gateway's tool port, which imitates a polled line."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

import pytest
from examples import usually
from gateways import Served, served
from lines import until
from modbus_tools import NO_REPLY, Libmodbus, Mbpoll
from peers import require_module

from multidrop.control import read_audit

SETPOINT, CONTROL, OUTPUT_VOLTAGE, OUTPUT_CURRENT = 0x2000, 0x1000, 0x3003, 0x3004  # CHE100 manual, p. 117
START, STOP = 1, 5
VOLTAGE = 231


class Pymodbus:
    """A client of pymodbus on a serial port, or with RTU framing over TCP."""

    def __init__(self, path: str, tcp: int = 0) -> None:
        client = require_module("pymodbus.client")
        framer = require_module("pymodbus").FramerType.RTU
        if tcp:
            self._client = client.ModbusTcpClient("127.0.0.1", port=tcp, framer=framer, timeout=10)
        else:
            self._client = client.ModbusSerialClient(path, framer=framer, baudrate=115200, timeout=10)
        assert self._client.connect()

    def read(self, unit: int, function: int, start: int, count: int) -> list[int] | int:
        found = self._client.read_holding_registers(start, count=count, device_id=unit)
        return NO_REPLY if found.isError() else list(found.registers)

    def write(self, unit: int, function: int, address: int, value: int) -> int:
        return NO_REPLY if self._client.write_register(address, value, device_id=unit).isError() else 0

    def close(self) -> None:
        self._client.close()


class Minimalmodbus:
    """The library minimalmodbus on a serial port."""

    def __init__(self, path: str) -> None:
        self._module = require_module("minimalmodbus")
        self._instrument = self._module.Instrument(path, 1)
        self._instrument.serial.baudrate = 4800
        self._instrument.serial.timeout = 10

    def read(self, unit: int, function: int, start: int, count: int) -> list[int] | int:
        try:
            return list(self._instrument.read_registers(start, count))
        except self._module.ModbusException:
            return NO_REPLY

    def write(self, unit: int, function: int, address: int, value: int) -> int:
        try:
            self._instrument.write_register(address, value, functioncode=function)
        except self._module.ModbusException:
            return NO_REPLY
        return 0

    def close(self) -> None:
        self._instrument.serial.close()


TOOLS = ["mbpoll", "libmodbus", "pymodbus", "pymodbus tcp", "minimalmodbus"]


@contextmanager
def tool_of(name: str, path: str, tcp: int, built: Path) -> Iterator[Any]:
    """Yield the tool of this name, connected to the tool port."""
    tools: dict[str, Callable[[], Any]] = {
        "mbpoll": lambda: Mbpoll(path, "-m", "rtu", "-b", "19200"),
        "libmodbus": lambda: Libmodbus(path, built),
        "pymodbus": lambda: Pymodbus(path),
        "pymodbus tcp": lambda: Pymodbus(path, tcp),
        "minimalmodbus": lambda: Minimalmodbus(path),
    }
    with closing(tools[name]()) as tool:
        yield tool


SERVE = """
[serve]
audit = "audit.jsonl"
[serve.may]
write = ["pump-1.setpoint", "pump-1.control"]
verbs = ["pump-1.start"]
[serve.tool]
pty = { hall = "hall" }
rtu = { hall = "127.0.0.1:0" }
timeout = 9
"""


@contextmanager
def connected(name: str, folder: Path, serve: str) -> Iterator[tuple[Served, Any]]:
    """Yield a gateway with polled drives, and a tool that is connected to its tool port."""
    with ExitStack() as stack:
        gateway = stack.enter_context(served(folder, serve))
        gateway.sims["pump-1"]["output_voltage"] = VOLTAGE
        gateway.await_state("pump-1", "stands")
        ports = gateway.gateway.feeds["tool"]
        tcp = ports.ports["hall"]  # type: ignore[attr-defined]
        yield gateway, stack.enter_context(tool_of(name, str(folder / "hall"), tcp, folder))


def read(tool: Any, start: int, count: int) -> list[int]:
    """Return words of pump-1. Repeats the request if a busy machine loses the reply."""
    found: list[list[int] | int] = []
    until(lambda: (found.append(tool.read(1, 3, start, count)), isinstance(found[-1], list))[1])
    assert isinstance(found[-1], list)
    return found[-1]


def writes(tool: Any, address: int, value: int) -> bool:
    """Write a word of pump-1; return True if the write was confirmed."""
    return bool(tool.write(1, 6, address, value) == 0)


@pytest.mark.slow
@pytest.mark.parametrize("name", usually(*TOOLS))
def test_a_modbus_tool_reads_the_drives_and_cannot_write_by_default(name: str, tmp_path: Path) -> None:
    with connected(name, tmp_path, SERVE) as (gateway, tool):
        sim, polled = gateway.sims["pump-1"], gateway.gateway.poller.statistics()  # type: ignore[union-attr]
        assert read(tool, OUTPUT_VOLTAGE, 2) == [VOLTAGE, 0]
        for value in range(500, 520):
            sim["output_voltage"] = value
            assert read(tool, OUTPUT_VOLTAGE, 1) == [value]
        before = len(sim.counters.writes)
        assert not writes(tool, CONTROL, START)
        assert not writes(tool, SETPOINT, 1000)
        assert len(sim.counters.writes) == before
        until(lambda: gateway.gateway.poller.statistics() != polled)  # type: ignore[union-attr]
        until(lambda: [each for each in read_audit(tmp_path / "audit.jsonl") if each["outcome"] == "refused"])
    refused = [each for each in read_audit(tmp_path / "audit.jsonl") if each["outcome"] == "refused"]
    assert "01 06 10 00 00 01" in refused[0]["write"]
    assert refused[0]["way"].startswith("tool from")


@pytest.mark.slow
@pytest.mark.parametrize("name", usually(*TOOLS))
def test_a_tool_that_may_write_can_stop_but_not_start_a_drive(name: str, tmp_path: Path) -> None:
    with connected(name, tmp_path, SERVE.replace("[serve.tool]", '[serve.tool]\nmay = "write"')) as (
        gateway,
        tool,
    ):
        sim = gateway.sims["pump-1"]
        until(lambda: writes(tool, SETPOINT, 5000))
        assert read(tool, SETPOINT, 1) == [5000]
        assert not writes(tool, CONTROL, START)
        writes(tool, CONTROL, STOP)
        until(lambda: ("control", STOP) in [(each.name, each.raw) for each in sim.counters.writes])
        assert {each.raw for each in sim.counters.writes if each.name == "control"} == {STOP}
