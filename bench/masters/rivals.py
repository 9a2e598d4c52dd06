"""The masters to compare, each run in a separate process (`python -m bench.masters.rivals MASTER JOB`).

Each other library is used as its own documentation shows, with its own waits, and no retries.
"""

from __future__ import annotations

import asyncio
import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from bench.masters.jobs import REGISTERS, TIMEOUT_S, Job, expected
from bench.support.programs import compiled, module

Read = Callable[[int], Sequence[float]]
Poll = Callable[[], tuple[int, int]]  # returns the numbers of good and of failed exchanges


@contextmanager
def multidrop(job: Job) -> Iterator[Poll]:
    from bench.masters import adapter

    with adapter.multidrop(job) as poll:
        yield poll


@contextmanager
def realtime(job: Job) -> Iterator[Poll]:
    from bench.masters import adapter

    with adapter.multidrop(job, realtime=True) as poll:
        yield poll


@contextmanager
def leased(job: Job) -> Iterator[Poll]:
    from bench.masters import adapter

    with adapter.leased(job) as poll:
        yield poll


# ---- masters that are called for each exchange: open and read functions ----


@contextmanager
def reading_by_hand(job: Job) -> Iterator[Read]:
    """Call `drive.read_many` in a loop, instead of multidrop's poller."""
    from bench.masters import adapter

    with adapter.reading(job) as read:
        yield lambda address: list(read(address).values())


@contextmanager
def pymodbus(job: Job) -> Iterator[Read]:
    from pymodbus import FramerType
    from pymodbus.client import ModbusSerialClient, ModbusTcpClient

    if job.port.startswith("socket://"):
        host, _, tcp_port = job.port.removeprefix("socket://").partition(":")
        client: Any = ModbusTcpClient(
            host, port=int(tcp_port), framer=FramerType.RTU, timeout=TIMEOUT_S, retries=0
        )
    else:
        client = ModbusSerialClient(job.port, baudrate=job.port_baudrate, timeout=TIMEOUT_S, retries=0)
    client.connect()
    yield lambda address: client.read_holding_registers(0, count=REGISTERS, device_id=address).registers
    client.close()


@contextmanager
def pyserial(job: Job) -> Iterator[Any]:
    """Open a pyserial port, for libraries that use one. A URL opens a TCP connection."""
    import serial

    with serial.serial_for_url(job.port, job.port_baudrate, timeout=TIMEOUT_S) as port:
        yield port


@contextmanager
def minimalmodbus(job: Job) -> Iterator[Read]:
    from minimalmodbus import Instrument

    with pyserial(job) as port:
        drives = {address: Instrument(port, address) for address in range(1, job.drives + 1)}
        yield lambda address: drives[address].read_registers(0, REGISTERS)


@contextmanager
def modbus_tk(job: Job) -> Iterator[Read]:
    from modbus_tk.defines import READ_HOLDING_REGISTERS
    from modbus_tk.modbus_rtu import RtuMaster

    with pyserial(job) as port:
        master = RtuMaster(port)
        master.set_timeout(TIMEOUT_S)
        yield lambda address: master.execute(address, READ_HOLDING_REGISTERS, 0, REGISTERS)


@contextmanager
def umodbus(job: Job) -> Iterator[Read]:
    from umodbus.client.serial import rtu

    with pyserial(job) as port:
        yield lambda address: rtu.send_message(rtu.read_holding_registers(address, 0, REGISTERS), port)


def in_turn(
    reader: Callable[[Job], AbstractContextManager[Read]],
) -> Callable[[Job], AbstractContextManager[Poll]]:
    """Return a master that reads the drives in turn; an exchange counts as good if its values are right."""

    @contextmanager
    def rival(job: Job) -> Iterator[Poll]:
        def poll() -> tuple[int, int]:
            good, asked, end = 0, 0, time.monotonic() + job.seconds
            while time.monotonic() < end:
                address = 1 + asked % job.drives
                asked += 1
                with suppress(Exception):  # each library has its own error classes
                    good += list(read(address)) == expected(address)
            return good, asked - good

        with reader(job) as read:
            yield poll

    return rival


# ---- masters that poll by themselves ----


@contextmanager
def pymodbus_async(job: Job) -> Iterator[Poll]:
    from pymodbus import FramerType
    from pymodbus.client import AsyncModbusSerialClient, AsyncModbusTcpClient
    from pymodbus.exceptions import ModbusException

    async def poll() -> tuple[int, int]:
        if job.port.startswith("socket://"):
            host, _, tcp_port = job.port.removeprefix("socket://").partition(":")
            client: Any = AsyncModbusTcpClient(
                host, port=int(tcp_port), framer=FramerType.RTU, timeout=TIMEOUT_S, retries=0
            )
        else:
            client = AsyncModbusSerialClient(
                job.port, baudrate=job.port_baudrate, timeout=TIMEOUT_S, retries=0
            )
        await client.connect()
        good, asked, end = 0, 0, time.monotonic() + job.seconds
        while time.monotonic() < end:
            address = 1 + asked % job.drives
            asked += 1
            with suppress(ModbusException):
                reply = await client.read_holding_registers(0, count=REGISTERS, device_id=address)
                good += reply.registers == expected(address)
        client.close()
        return good, asked - good

    yield lambda: asyncio.run(poll())


READERS = {
    "pymodbus": pymodbus,
    "minimalmodbus": minimalmodbus,
    "modbus-tk": modbus_tk,
    "umodbus": umodbus,
}
IN_PYTHON = {
    "multidrop": multidrop,
    "multidrop, realtime": realtime,
    **{name: in_turn(reader) for name, reader in READERS.items()},
    "pymodbus-async": pymodbus_async,
    "read_many": in_turn(reading_by_hand),
    "multidrop, leased": leased,
}
MASTERS = (*IN_PYTHON, "libmodbus")

INSTALL = {
    "read_many": "multidrop",
    "multidrop, leased": "multidrop",
    "multidrop, realtime": "multidrop",
    "pymodbus": "pymodbus==3.16.1",
    "pymodbus-async": "pymodbus==3.16.1",
    "minimalmodbus": "minimalmodbus==2.1.1",
    "modbus-tk": "modbus-tk==1.1.5",
    "umodbus": "umodbus==1.0.4",
}


def _missing(wanted: Sequence[str]) -> set[str]:
    missing = set()
    for name in wanted:
        package = INSTALL.get(name, name)
        try:
            version(package.partition("==")[0])
        except PackageNotFoundError:
            missing.add(package)
    return missing


def insist_on(masters: Sequence[str]) -> None:
    """Exit with one sentence that names the packages to install, if a master's package is missing."""
    missing = _missing([name for name in masters if name in IN_PYTHON])
    if missing:
        sys.exit(f"rivals are missing: {sys.executable} -m pip install {' '.join(sorted(missing))}")
    if "libmodbus" in masters and subprocess.run(["pkg-config", "--exists", "libmodbus"]).returncode:
        sys.exit("libmodbus is missing: apt-get install libmodbus-dev pkg-config")


def measure(master: str, job: Job) -> dict[str, Any]:
    """Run a master; return its exchanges, failures, CPU seconds, elapsed seconds and version."""
    if master == "libmodbus":
        flags = subprocess.check_output(["pkg-config", "--cflags", "--libs", "libmodbus"], text=True).split()
        program = compiled("masters/libmodbus_master.c", *flags)
        command = [program, job.port, job.port_baudrate, job.drives, REGISTERS, job.seconds]
    else:
        command = [*module("bench.masters.rivals", master, json.dumps(asdict(job)))]
    result: dict[str, Any] = json.loads(subprocess.check_output([str(word) for word in command]))
    return result


def measure_bare(job: Job, silence: float, asleep: float = 0.0, *, realtime: bool = False) -> dict[str, Any]:
    """Run bare_master.c, with realtime scheduling if wanted; return the same values as `measure`.

    The program waits `silence` s before each request, and sleeps `asleep` s after each request.
    """
    command = [compiled("masters/bare_master.c"), "--seconds", job.seconds, "--drives", job.drives]
    command += ["--registers", REGISTERS, "--silence-us", silence * 1e6]
    command += ["--asleep-us", asleep * 1e6, *["--realtime"] * realtime, job.port]
    result: dict[str, Any] = json.loads(subprocess.check_output([str(word) for word in command]))
    return result | {"version": ""}


def _cpu_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def main(master: str, job: Job) -> None:
    with IN_PYTHON[master](job) as poll:
        cpu, begun = _cpu_seconds(), time.monotonic()
        good, bad = poll()
        cpu, seconds = _cpu_seconds() - cpu, time.monotonic() - begun
    package = INSTALL.get(master, master).partition("==")[0]
    result = {"exchanges": good, "failures": bad, "cpu_seconds": cpu, "seconds": seconds}
    print(json.dumps(result | {"version": version(package)}))


if __name__ == "__main__":
    main(sys.argv[1], Job(**json.loads(sys.argv[2])))
