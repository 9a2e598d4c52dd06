"""Modbus clients by other authors: mbpoll, libmodbus in a C program of the tests, and Python libraries."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

from lines import PATIENCE
from peers import build_with_libmodbus, require_module, require_program

SOURCE = Path(__file__).parents[1] / "programs" / "libmodbus_client.c"
TYPES = {1: "0", 2: "1", 3: "4", 4: "3", 5: "0", 6: "4"}  # value of mbpoll's option -t, by function code
READS = {1: "read_coils", 2: "read_discrete_inputs", 3: "read_holding_registers", 4: "read_input_registers"}
NO_REPLY = -1
CODES = {  # exception code by the text that libmodbus has for it
    "Illegal function": 1,
    "Illegal data address": 2,
    "Illegal data value": 3,
    "Slave device or server failure": 4,
    "Acknowledge": 5,
    "Slave device or server is busy": 6,
    "Gateway path unavailable": 10,
    "Target device failed to respond": 11,
}


class Mbpoll:
    """A Modbus client that runs mbpoll for each request; `where` is a host or a serial port."""

    def __init__(self, where: str, *options: str) -> None:
        self._command = [require_program("mbpoll"), "-q", "-o", "10", "-0", *options]
        self._where = where

    def _run(self, unit: int, function: int, start: int, *words: object) -> str:
        asked = map(str, ("-a", unit, "-t", TYPES[function], "-r", start, *words))
        command = [*self._command, *asked]
        done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)
        return done.stdout + done.stderr

    def read(self, unit: int, function: int, start: int, count: int) -> list[int] | int:
        """Return the words or bits read, or an exception code, or NO_REPLY."""
        shown = self._run(unit, function, start, "-c", count, "-1", self._where)
        found = {int(at): int(word) for at, word in re.findall(r"^\[(\d+)\]:\s+(\d+)", shown, re.M)}
        return [*found.values()] if [*found] == [*range(start, start + count)] else _code(shown)

    def write(self, unit: int, function: int, start: int, value: int) -> int:
        """Write a value; return 0, or an exception code, or NO_REPLY."""
        shown = self._run(unit, function, start, self._where, value)
        return 0 if "Written 1 references" in shown else _code(shown)

    def close(self) -> None:
        """Do nothing: each request is a process of its own."""


def _code(shown: str) -> int:
    return next((code for words, code in CODES.items() if words in shown), NO_REPLY)


class Libmodbus:
    """A Modbus client in C with libmodbus; `where` is a port of 127.0.0.1 or the path of a serial port."""

    def __init__(self, where: int | str, built: Path) -> None:
        self._process = subprocess.Popen(
            [build_with_libmodbus(SOURCE, built), str(where)],
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


class Pymodbus:
    """A client of pymodbus; `where` is the path of a serial port, or a TCP port of 127.0.0.1."""

    def __init__(self, where: str | int, frames: str = "RTU") -> None:
        client, framer = require_module("pymodbus.client"), require_module("pymodbus").FramerType[frames]
        if isinstance(where, int):
            self._client = client.ModbusTcpClient("127.0.0.1", port=where, framer=framer, timeout=10)
        else:
            self._client = client.ModbusSerialClient(where, framer=framer, baudrate=115200, timeout=10)
        assert self._client.connect()

    def read(self, unit: int, function: int, start: int, count: int) -> list[int] | int:
        found = getattr(self._client, READS[function])(start, count=count, device_id=unit)
        if found.isError():
            return int(getattr(found, "exception_code", NO_REPLY))
        return [int(one) for one in (found.bits[:count] if function < 3 else found.registers)]

    def write(self, unit: int, function: int, start: int, *values: int) -> int:
        name = {5: "write_coil", 6: "write_register", 16: "write_registers"}[function]
        given = list(values) if function == 16 else values[0]
        done = getattr(self._client, name)(start, given, device_id=unit)
        return int(getattr(done, "exception_code", NO_REPLY)) if done.isError() else 0

    def close(self) -> None:
        self._client.close()


class PyModbusTcp:
    """A client of pyModbusTCP, connected to a port of 127.0.0.1."""

    def __init__(self, port: int) -> None:
        client = require_module("pyModbusTCP.client")
        self._client = client.ModbusClient("127.0.0.1", port, timeout=30.0, auto_open=True)

    def read(self, unit: int, function: int, start: int, count: int) -> list[int] | int:
        self._client.unit_id = unit
        found = getattr(self._client, READS[function])(start, count)
        return int(self._client.last_except) if found is None else [int(word) for word in found]

    def write(self, unit: int, function: int, start: int, value: int) -> int:
        self._client.unit_id = unit
        write = {5: self._client.write_single_coil, 6: self._client.write_single_register}[function]
        return 0 if write(start, value) else int(self._client.last_except)

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

    def write(self, unit: int, function: int, start: int, value: int) -> int:
        try:
            self._instrument.write_register(start, value, functioncode=function)
        except self._module.ModbusException:
            return NO_REPLY
        return 0

    def close(self) -> None:
        self._instrument.serial.close()
