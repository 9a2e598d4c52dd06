"""How much CPU time does the OPC UA server take for 1,000 values at 10 Hz, and do clients delay stops?

A gateway's hub without polling has 100 drives with 10 values each. It gets new rows ten times a second; each
time, eight of ten values have changed. The table has the CPU time of the process in percent of a core:
without the server, with it, and with clients that subscribe to all values. The least of many seconds counts,
because other processes disturbed it least. The clients' own processes are not counted. `values/s` is the
number that the first client received.

Then `multidrop serve` polls 100 simulated drives, and one drive at a time is stopped over HTTP: without the
server, with it, and with it beside clients that read 1,000 nodes without pause. The times are from the
request to the stop's first frame, as the simulator received it, and to the HTTP answer.
"""

from __future__ import annotations

import argparse
import asyncio
import http.client
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory

from commands import BoundProcess
from free_ports import free_ports
from simulated_pumps import simulated_pumps, write_plant

from bench.questions.gateway.costs import Worker
from bench.support import tables
from multidrop.gateway.opcua.part import OpcUaSettings, build
from multidrop.supervisor import supervisor

LINES = (25, 25, 25, 25)  # numbers of drives on each line
PERIOD_S = 0.1
SLICE_S = 1.0
SETTLE_S = 5.0  # time after the gateway's start in which it learns response delays and makes its OPC UA nodes
RUN_S = 0.5  # time for which motors run before a stop
GREEDY = 5
READER = Path(__file__).parents[2] / "players" / "opcua_reader.py"
SUBSCRIBER = Path(__file__).parents[3] / "tests" / "support" / "programs" / "opcua_subscriber.py"


async def poll(worker: Worker) -> None:
    """Give the hub new rows forever."""
    due = time.monotonic()
    while True:
        worker.take_rows()
        due += PERIOD_S
        await asyncio.sleep(max(0.0, due - time.monotonic()))


async def used(slices: int) -> float:
    """Return the least CPU time of this process in `slices` time slices, in percent of a core."""
    found = []
    for _ in range(slices):
        begun, cpu = time.monotonic(), time.process_time()
        await asyncio.sleep(SLICE_S)
        found.append(100 * (time.process_time() - cpu) / (time.monotonic() - begun))
    return min(found)


def last(log: Path) -> tuple[float, int]:
    """Return the time in s and the number of values of a subscriber's last line."""
    time_s, count = log.read_text().splitlines()[-1].split()
    return float(time_s), int(count)


async def measured(slices: int, clients: int | None) -> tuple[float, float]:
    """Return the CPU time in percent, and the first client's values per second.

    With `clients` None, measure without the OPC UA server.
    """
    with TemporaryDirectory() as folder, ExitStack() as stack:
        worker, rate = Worker(Path(folder), LINES), 0.0
        stack.callback(worker.gateway.listener.close)
        supervisor().keep("polling", poll(worker))
        if clients is None:
            found = await used(slices)
        else:
            part = build(OpcUaSettings("127.0.0.1:0"), worker.gateway.part_context(worker.plant))
            supervisor().keep("opcua", part.run())
            while not part.is_ready:
                await asyncio.sleep(PERIOD_S)
            logs = [Path(folder) / f"{number}" for number in range(clients)]
            subscribers: list[BoundProcess[bytes]] = []
            for log in logs:
                words = [sys.executable, str(SUBSCRIBER), f"opc.tcp://127.0.0.1:{part.port}/", "100"]
                output = stack.enter_context(log.open("w"))
                subscribers.append(stack.enter_context(BoundProcess(words, stdout=output)))
                stack.callback(subscribers[-1].kill)
            while not all(log.read_text().count("\n") for log in logs):
                if any(subscriber.poll() is not None for subscriber in subscribers):
                    raise SystemExit("a subscriber ended before it received values")
                await asyncio.sleep(PERIOD_S)
            begun = [last(log) for log in logs]
            found = await used(slices)
            if logs:
                (begin_s, before), (end_s, after) = begun[0], last(logs[0])
                rate = (after - before) / (end_s - begin_s)
            await supervisor().release("opcua")
            await part.close()
        await supervisor().release("polling")
    return found, rate


def started(stack: ExitStack, words: list[str]) -> None:
    """Start a program that ends with the stack; return when it has printed its first line."""
    process = stack.enter_context(BoundProcess(words, stdout=subprocess.PIPE, text=True))
    stack.callback(process.kill)
    assert process.stdout is not None
    assert process.stdout.readline()


def stops(rounds: int, clients: int | None) -> Iterator[tuple[float, float]]:
    """Yield the times in ms from each stop to its first frame and to its answer.

    With `clients` None, the gateway runs without its OPC UA server.
    """
    with TemporaryDirectory() as folder, ExitStack() as stack:
        web, opcua = free_ports(2)
        serve = f'[serve]\nlisten = "127.0.0.1:{web}"\n[serve.may]\nstop = "anyone"\n'
        serve += "" if clients is None else f'[serve.opcua]\nlisten = "127.0.0.1:{opcua}"\n'
        plant = write_plant(Path(folder), LINES, serve)
        pumps = stack.enter_context(simulated_pumps(plant))
        started(stack, [sys.executable, "-m", "multidrop", "serve", str(plant)])
        time.sleep(SETTLE_S)
        for _ in range(clients or 0):
            started(stack, [sys.executable, str(READER), f"opc.tcp://127.0.0.1:{opcua}/"])
        for number in range(rounds):
            drive = f"pump-{number % sum(LINES) + 1}"
            pumps.run()
            time.sleep(RUN_S)
            begun = time.monotonic()
            connection = http.client.HTTPConnection("127.0.0.1", web)
            body = json.dumps({"drives": [drive]})
            connection.request("POST", "/api/stop", body, {"content-type": "application/json"})
            told = connection.getresponse().read()
            answered = time.monotonic()
            connection.close()
            sent, _ = pumps.stops()[drive]
            assert sent is not None, told
            yield 1e3 * (sent - begun), 1e3 * (answered - begun)


def show_stops(rounds: int) -> None:
    rows = []
    for what, clients in (("no server", None), ("no client", 0), (f"{GREEDY} greedy clients", GREEDY)):
        first, answers = zip(*stops(rounds, clients), strict=True)
        cells = [statistics.median(first), max(first), statistics.median(answers), max(answers)]
        rows.append((what, rounds, *(f"{ms:.0f}" for ms in cells)))
    print()
    tables.show(("stops with", "stops", "first frame p50 ms", "longest", "answer p50 ms", "longest"), rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--slices", type=int, default=20)
    parser.add_argument("--clients", type=int, nargs="*", default=[0, 1, 2])
    parser.add_argument("--stops", type=int, default=30, help="number of stops in each case")
    arguments = parser.parse_args()
    tables.heading("1,000 values at 10 Hz by OPC UA: CPU of the gateway's process.")
    rows = []
    for clients in (None, *arguments.clients):
        cpu, rate = asyncio.run(measured(arguments.slices, clients))
        rows.append(("no server" if clients is None else f"{clients} clients", f"{cpu:.1f} %", f"{rate:.0f}"))
    tables.show(("what", "CPU", "values/s"), rows)
    if arguments.stops:
        show_stops(arguments.stops)


if __name__ == "__main__":
    main()
