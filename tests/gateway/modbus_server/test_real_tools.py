"""mbpoll, libmodbus, pymodbus and minimalmodbus on a gateway's tool port, which imitates a polled line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

import pytest
from examples import usually
from gateways import Served, served
from lines import until
from modbus_tools import Libmodbus, Mbpoll, Minimalmodbus, Pymodbus

from multidrop.control import read_audit

SETPOINT, CONTROL, OUTPUT_VOLTAGE, OUTPUT_CURRENT = 0x2000, 0x1000, 0x3003, 0x3004  # CHE100 manual, p. 117
START, STOP = 1, 5
VOLTAGE = 231
TOOLS = {  # the tools, made from the path of the serial port, the TCP port and a folder for programs
    "mbpoll": lambda path, tcp, built: Mbpoll(path, "-m", "rtu", "-b", "19200"),
    "libmodbus": lambda path, tcp, built: Libmodbus(path, built),
    "pymodbus": lambda path, tcp, built: Pymodbus(path),
    "pymodbus tcp": lambda path, tcp, built: Pymodbus(tcp),
    "minimalmodbus": lambda path, tcp, built: Minimalmodbus(path),
}


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
        yield gateway, stack.enter_context(closing(TOOLS[name](str(folder / "hall"), tcp, folder)))


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
