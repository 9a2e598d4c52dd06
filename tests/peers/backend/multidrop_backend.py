"""pytest plugin for the tests of the library modbus-connection: it replaces their pymodbus backend by
multidrop. The tests then compare multidrop with the tmodbus backend and the tmodbus server.
"""

from __future__ import annotations

import sys
from typing import Any

import modbus_connection
import pytest

from multidrop import modbus_connection as backend

UNFIT = {  # part of a test's name: why the test does not apply to multidrop
    "udp": "multidrop does not support UDP",
    "tls": "multidrop does not support TLS",
    "accepts_the_full_matrix": "multidrop does not support UDP",
    "test_connect_errors": "replaces pymodbus's client",
    "sends_timed_out_request_once": "replaces pymodbus's transport",
}


async def connect_tcp(host: str, *, port: int = 502, **options: Any) -> backend.ModbusConnection:
    """Connect with the arguments of the function of this name in modbus-connection's own backends."""
    connection = backend.ModbusConnection(modbus_connection.ModbusTcpParams(host=host, port=port), **options)
    await connection.connect()
    return connection


names: Any = backend
names.connect_tcp = connect_tcp
names.PymodbusConnection = backend.ModbusConnection
backend.ModbusConnection._on_trace_connect = lambda self, connecting: self._on_connection_lost(None)
sys.modules["modbus_connection.pymodbus"] = modbus_connection.pymodbus = backend


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Select the tests of the pymodbus backend, and those that compare it with the tmodbus backend."""
    ours = [item for item in items if "pymodbus" in item.name or "parity" in item.name]
    unfit = [item for item in ours if any(part in item.nodeid for part in UNFIT)]
    config.hook.pytest_deselected(items=[item for item in items if item not in ours or item in unfit])
    items[:] = [item for item in ours if item not in unfit]
