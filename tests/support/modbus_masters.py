"""Modbus TCP masters by other authors, with one interface."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

from peers import build_with_libmodbus, require_module, require_program

SOURCE = Path(__file__).parent / "programs" / "libmodbus_tcp_client.c"
TYPES = {1: "0", 2: "1", 3: "4", 4: "3"}  # mbpoll's
WRITTEN = {5: "0", 6: "4"}
MBPOLL_CODES = {  # libmodbus's texts for exceptions
    "Illegal function": 1,
    "Illegal data address": 2,
    "Illegal data value": 3,
    "Slave device or server failure": 4,
    "Acknowledge": 5,
    "Slave device or server is busy": 6,
    "Gateway path unavailable": 10,
    "Target device failed to respond": 11,
}


class Master(Protocol):
    """A connected master."""

    def read(self, unit: int, function: int, start: int, count: int) -> list[int] | int:
        """Return words or bits, or an exception code."""

    def write(self, unit: int, function: int, start: int, value: int) -> int:
        """Return an exception code, or 0."""


class Mbpoll:
    """The program mbpoll, started for each request."""

    def __init__(self, port: int) -> None:
        self._command = [require_program("mbpoll"), "-q", "-m", "tcp", "-p", str(port), "-o", "10", "-0"]

    def _run(self, *words: object) -> str:
        done = subprocess.run(
            [*self._command, *map(str, words)], capture_output=True, text=True, timeout=60, check=False
        )
        return done.stdout + done.stderr

    def read(self, unit: int, function: int, start: int, count: int) -> list[int] | int:
        shown = self._run("-a", unit, "-t", TYPES[function], "-r", start, "-c", count, "-1", "127.0.0.1")
        found = re.findall(r"^\[(\d+)\]:\s+(\d+)", shown, re.M)
        if code := _code(shown):
            return code
        assert [int(at) for at, _ in found] == list(range(start, start + count)), shown
        return [int(word) for _, word in found]

    def write(self, unit: int, function: int, start: int, value: int) -> int:
        shown = self._run("-a", unit, "-t", WRITTEN[function], "-r", start, "127.0.0.1", value)
        assert "Written 1 references" in shown or _code(shown), shown
        return _code(shown)


def _code(shown: str) -> int:
    return next((code for words, code in MBPOLL_CODES.items() if words in shown), 0)


class Libmodbus:
    """The library libmodbus, in a C program of the tests."""

    def __init__(self, port: int, built: Path) -> None:
        self._process = subprocess.Popen(
            [build_with_libmodbus(SOURCE, built), str(port)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def _ask(self, *numbers: int) -> list[str]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(*numbers, file=self._process.stdin, flush=True)
        return self._process.stdout.readline().split()

    def read(self, unit: int, function: int, start: int, count: int) -> list[int] | int:
        said, *words = self._ask(unit, function, start, count)
        return int(words[0]) if said == "error" else [int(word) for word in words]

    def write(self, unit: int, function: int, start: int, value: int) -> int:
        said, *words = self._ask(unit, function, start, value)
        return int(words[0]) if said == "error" else 0

    def close(self) -> None:
        with self._process:
            self._process.kill()


class PyModbusTcp:
    """The client of pyModbusTCP."""

    def __init__(self, port: int) -> None:
        client = require_module("pyModbusTCP.client")
        self._client = client.ModbusClient("127.0.0.1", port, timeout=30.0, auto_open=True)

    def read(self, unit: int, function: int, start: int, count: int) -> list[int] | int:
        self._client.unit_id = unit
        ask = {
            1: self._client.read_coils,
            2: self._client.read_discrete_inputs,
            3: self._client.read_holding_registers,
            4: self._client.read_input_registers,
        }[function]
        found = ask(start, count)
        return int(self._client.last_except) if found is None else [int(word) for word in found]

    def write(self, unit: int, function: int, start: int, value: int) -> int:
        self._client.unit_id = unit
        done = {
            5: lambda: self._client.write_single_coil(start, bool(value)),
            6: lambda: self._client.write_single_register(start, value),
            16: lambda: self._client.write_multiple_registers(start, [value]),
        }[function]()
        return 0 if done else int(self._client.last_except)

    def close(self) -> None:
        self._client.close()


@contextmanager
def master_of(name: str, port: int, built: Path) -> Iterator[Master]:
    """Give "mbpoll", "libmodbus" or "pyModbusTCP", connected to this port; skip if it is not installed."""
    if name == "mbpoll":
        yield Mbpoll(port)
        return
    master = Libmodbus(port, built) if name == "libmodbus" else PyModbusTcp(port)
    try:
        yield master
    finally:
        master.close()
