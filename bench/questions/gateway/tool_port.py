"""Which values does polling lose while a vendor's tool reads through the gateway without pause?

Simulated drives with the timing of a real wire are polled by `multidrop serve` at several periods, without
and with a tool on the line's tool port. The tool sends its next read as soon as it has a reply. Then motors
are stopped over HTTP: how many of the tool's requests reach the line between the call and the first stop?
"""

from __future__ import annotations

import argparse
import http.client
import json
import re
import select
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import serial

from bench.support import tables
from multidrop import InvtCHE, Plant
from multidrop.core import crc16
from multidrop.sim import SimulatedDrive, Simulator, Wire, simulated

POLL = ("status", "output_frequency", "output_current", "fault")
TOOLS_FUNCTION = 4  # polling does not use this function, so each such request is the tool's
OUTPUT_VOLTAGE, CONTROL, STOP = 0x3003, 0x1000, 5  # CHE100 manual v1.4, p. 117
SETTLE_S = 8.0  # time after the start in which the poller learns response delays, in s
PATIENCE_S = 30.0

PLANT = """
[serve]
listen = "127.0.0.1:0"
[serve.may]
stop = "anyone"
[serve.tool]
pty = {{ hall = "hall" }}
timeout = 5
[[line]]
name = "hall"
port = "{port}"
baudrate = {baudrate}
"""
DRIVE = """
[[line.drive]]
name = "fan-{n}"
model = "invt-che"
address = {n}
every = "{every:g} ms"
poll = {poll}
"""


class Gateway:
    """A running command `multidrop serve`."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        self._port = int(re.findall(r":(\d+)", process.stdout.readline())[-1])

    def ask(self, method: str, path: str, body: str | None = None) -> str:
        connection = http.client.HTTPConnection("127.0.0.1", self._port, timeout=PATIENCE_S)
        connection.request(method, path, body, {"content-type": "application/json"})
        said = connection.getresponse().read().decode()
        connection.close()
        return said

    def rows(self) -> Counter[str]:
        """Return how many values have been polled, under the key "", and how many are missing, by reason."""
        text = self.ask("GET", "/metrics")
        found: Counter[str] = Counter()
        for count in re.findall(r"^multidrop_line_samples_total.* (\S+)$", text, re.M):
            found[""] += int(float(count))
        for reason, count in re.findall(r'^multidrop_misses_total.*reason="([^"]*)".* (\S+)$', text, re.M):
            found[reason] += int(float(count))
        return found


class Tool:
    """A thread that reads one register through the tool port without pause."""

    def __init__(self, path: Path, function: int) -> None:
        self.replies: Counter[str] = Counter()
        body = bytes([1, function]) + OUTPUT_VOLTAGE.to_bytes(2) + (1).to_bytes(2)
        self._request = body + crc16(body, len(body)).to_bytes(2, "little")
        self._port = serial.Serial(str(path), timeout=PATIENCE_S)
        self._is_ending = False
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def _read(self) -> None:
        while not self._is_ending:
            self._port.write(self._request)
            head = self._port.read(5)
            if len(head) == 5 and not head[1] & 0x80:
                self._port.read(head[2])
            is_busy = len(head) == 5 and head[1] & 0x80 and head[2] == 6
            self.replies["busy" if is_busy else "answered" if head else "silent"] += 1

    def close(self) -> None:
        self._is_ending = True
        self._thread.join()
        self._port.close()


def write_plant(folder: Path, port: str, drives: int, baudrate: int, every_ms: float) -> Path:
    text = PLANT.format(port=port, baudrate=baudrate)
    for n in range(1, drives + 1):
        text += DRIVE.format(n=n, every=every_ms, poll=json.dumps(POLL))
    plant = folder / "plant.toml"
    plant.write_text(text)
    return plant


@contextmanager
def gateway(
    drives: int, baudrate: int, every_ms: float
) -> Iterator[tuple[Gateway, list[SimulatedDrive], Path]]:
    """Simulate a line and serve it; yield the gateway, the drives, and the tool port's path."""
    sims = [simulated(InvtCHE(n, baudrate=baudrate)) for n in range(1, drives + 1)]
    with TemporaryDirectory() as name, Simulator([Wire(sims)]) as line:
        plant = write_plant(Path(name), line.wires[0].path, drives, baudrate, every_ms)
        command = [sys.executable, "-m", "multidrop", "serve", str(plant)]
        with subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        ) as process:
            try:
                made = Gateway(process)
                time.sleep(SETTLE_S)
                yield made, sims, Path(name) / "hall"
            finally:
                process.terminate()


def utilisation(drives: int, baudrate: int, every_ms: float) -> float:
    """Return the planned share of the line's time that polling takes."""
    with TemporaryDirectory() as name:
        plant = write_plant(Path(name), "/dev/ttyUSB0", drives, baudrate, every_ms)
        return float(Plant.load(plant).metadata()["planned"]["hall"]["utilisation"])


def rows_within(made: Gateway, seconds: float) -> Counter[str]:
    """Return the numbers of values, and of missing values by reason, within this time."""
    before = made.rows()
    time.sleep(seconds)
    return made.rows() - before


def kept(rows: Counter[str]) -> str:
    """Return the share of due values that polling received, and why the others are missing."""
    if not rows.total():
        return "no value was due"
    reasons = "; ".join(f"{count} {reason}" for reason, count in rows.items() if reason)
    return f"{rows[''] / rows.total():.2%}" + (f" ({reasons})" if reasons else "")


def tools_requests(sims: list[SimulatedDrive]) -> int:
    return sum(sim.counters.functions[TOOLS_FUNCTION] for sim in sims)


def requests_before_stop(made: Gateway, sims: list[SimulatedDrive], path: Path) -> int:
    """Stop all motors while a tool reads; return the number of its requests before the first stop."""
    tool = Tool(path, TOOLS_FUNCTION)
    try:
        time.sleep(1.0)
        for sim in sims:
            sim.counters.writes.clear()
        before = tools_requests(sims)
        stop = threading.Thread(target=made.ask, args=("POST", "/api/stop", "{}"))
        stop.start()
        while not any(written.raw == STOP for sim in sims for written in list(sim.counters.writes)):
            select.select([], [], [], 0.0005)
        came = tools_requests(sims) - before
        stop.join()
        return came
    finally:
        tool.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--baudrate", type=int, default=9600)
    parser.add_argument("--drives", type=int, default=8)
    parser.add_argument("--every", type=float, nargs="+", default=[800, 2000], help="periods in ms")
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--stops", type=int, default=10)
    arguments = parser.parse_args()
    # Python switches often between the threads, so that the simulator's thread is not delayed by the tool's.
    sys.setswitchinterval(1e-4)
    size = arguments.drives, arguments.baudrate
    tables.heading("{} drives at {} bit/s, polled beside a tool that reads without pause.".format(*size))
    rows, before_stops = [], []
    for every in arguments.every:
        with gateway(*size, every) as (made, sims, path):
            alone = rows_within(made, arguments.seconds)
            tool = Tool(path, 3)
            time.sleep(1.0)
            before, begun = tool.replies.copy(), time.monotonic()
            beside = rows_within(made, arguments.seconds)
            came, spent = tool.replies - before, time.monotonic() - begun
            tool.close()
            before_stops += [requests_before_stop(made, sims, path) for _ in range(arguments.stops)]
        used = utilisation(*size, every)
        rows.append(
            [
                f"{every:g} ms",
                f"{used:.1%}",
                kept(alone),
                kept(beside),
                f"{came['answered'] / spent:.1f}",
                f"{came['busy'] / spent:.1f}",
                f"{came['silent']}",
            ]
        )
    columns = ("period", "planned use", "kept alone", "kept beside", "tool's reads/s", "busy/s", "silent")
    tables.show(columns, rows)
    print("\nkept: the share of due values that polling receives")
    print(f"requests of the tool between a call of stop and the first stop: {sorted(before_stops)}")


if __name__ == "__main__":
    main()
