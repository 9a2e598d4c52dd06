"""Measure the CPU time of each kind of work of `multidrop serve`, alone and with warm caches.

A gateway's hub without polling has 31 drives with 10 values each. The script calls its protocols as asyncio
would. Before each measurement the hub gets new rows with other values. The table has the shortest time of
many measurements, because other processes disturb that one least. The times leave out the kernel's time and
the effect of cold caches: see `gateway_load` for these.
"""

from __future__ import annotations

import argparse
import asyncio
import struct
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from gateway_users import COMMON, COMMON_WORDS, WORDS
from simulated_pumps import FIRST_READING, POLLED, write_plant

from bench.support import tables
from multidrop import Plant
from multidrop.core import Columns, Counters, Names, Status
from multidrop.exposition import expose_metrics
from multidrop.gateway.gateway import Gateway
from multidrop.gateway.http.connections import Connections, WatchedApp
from multidrop.gateway.http.routes import make_app
from multidrop.gateway.live.frames import WHOLE
from multidrop.gateway.metrics import families_of
from multidrop.gateway.modbus_server.clients import ModbusClient, ModbusPort
from multidrop.gateway.modbus_server.server import ModbusServer
from multidrop.gateway.modbus_server.settings import ModbusSettings
from multidrop.gateway.settings import ServeSettings
from multidrop.polling.batch import Batch
from multidrop.transport.statistics import line_statistics

LINES = (8, 8, 8, 7)  # numbers of drives on each line


def as_numbers(data: Any, kind: str) -> memoryview:
    """Return a view of bytes as numbers in the format `kind` of the module struct."""
    found: memoryview = data.cast(kind)
    return found


class GivenColumns(Columns):
    """Columns with given arrays, in place of the C core's."""

    def __init__(self, columns: dict[str, memoryview]) -> None:
        self._columns = columns

    def __len__(self) -> int:
        return len(self._columns["time"])

    def array(self, name: str) -> memoryview:
        return self._columns[name]


class FakeTransport(asyncio.Transport):
    """A connection that counts the written bytes and discards them."""

    written = 0

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        return {"peername": ("127.0.0.1", 1), "sockname": ("127.0.0.1", 2)}.get(name, default)

    def write(self, data: Any) -> None:
        self.written += len(data)

    def is_closing(self) -> bool:
        return False

    def pause_reading(self) -> None: ...
    def resume_reading(self) -> None: ...
    def close(self) -> None: ...


class Worker:
    """The separate tasks of a gateway; each call carries out one task once for all drives.

    The gateway itself is not started.
    """

    def __init__(self, folder: Path, lines: tuple[int, ...] = LINES) -> None:
        self.plant = Plant.load(write_plant(folder, lines))
        self.gateway = Gateway(self.plant, ServeSettings(port=0))
        self.drives = [polled.drive.name for line in self.plant.lines for polled in line.drives]
        self._names = Names(self.drives), Names(POLLED)
        self._turns = count(1)
        self.transport = FakeTransport()

    def take_rows(self) -> None:
        """Give the hub one row for each register."""
        turn, drives, registers = next(self._turns), len(self.drives), len(POLLED)
        codes = [(drive, register) for drive in range(drives) for register in range(registers)]
        now_ns, size = time.monotonic_ns(), len(codes)

        def column(kind: str, numbers: list[Any]) -> memoryview:
            return as_numbers(memoryview(struct.pack(f"{size}{kind}", *numbers)), kind)

        rows = {
            "time": column("q", [1_790_000_000_000_000_000 + turn * 10**8] * size),
            "sent": column("q", [now_ns] * size),
            "uncertainty": column("q", [1000] * size),
            "drive": column("H", [drive for drive, _ in codes]),
            "reg": column("H", [register for _, register in codes]),
            "status": column("H", [0] * size),
            "value": column("d", [float((at + turn) % 30 if at % 10 > 1 else 0) for at in range(size)]),
            "valid": memoryview(b"\xff" * (size // 8 + 1)),
        }
        self.batch = Batch(GivenColumns(rows), *self._names)
        self.gateway.hub.take(self.batch)

    # ---- kinds of work ----

    def take_given(self) -> None:
        self.gateway.hub.take(self.batch)

    def frame(self) -> None:
        """Make a frame of live values, and encode its changes for viewers that have the previous frame."""
        frames = self.gateway.frames
        frames._build()
        frames._since(frames._kept[-2]["n"] if len(frames._kept) > 1 else WHOLE)

    def next_viewer(self) -> Callable[[], Any]:
        """Return a function that sends a frame's changes to a second viewer, after the first one got them."""
        frames = self.gateway.frames
        for _ in range(2):
            self.take_rows()
            frames._build()
        return partial(frames._since, frames._kept[0]["n"])

    def whole_frame(self) -> None:
        self.gateway.frames._build()
        self.gateway.frames._since(WHOLE)

    def events(self) -> None:
        self.gateway._look_for_events()

    def statistics(self) -> None:
        """Do what the gateway does once a second: read the statistics of all exchanges."""
        turn = next(self._turns)
        delays = Counter(dict.fromkeys(range(60, 75), turn))
        of_drive = Counters(turn, turn, 10 * turn, turn, ideal_ns=turn, missed=Counter({Status.NO_REPLY: 1}))
        reading = {
            line.name: line_statistics(
                float(turn), {p.drive.name: of_drive._replace(delays=delays) for p in line.drives}, None
            )
            for line in self.plant.lines
        }
        self.gateway.recent.tick(float(turn), turn * 1000, reading)

    def metrics(self) -> None:
        gateway = self.gateway
        expose_metrics(families_of(gateway), "")

    def masters(self, start: int, words: int) -> Callable[[], None]:
        """Return a function that reads `words` registers of each drive over Modbus TCP."""
        units = {name: number for number, name in enumerate(self.drives, 1)}
        gateway, settings = self.gateway, ModbusSettings(units=units)
        server = ModbusServer(self.plant, gateway.hub, gateway.commands, settings, gateway.ask)
        client = ModbusClient(ModbusPort(partial(server.serve, ""), lambda address: True, time.monotonic))
        client.connection_made(self.transport)

        def read() -> None:
            before = self.transport.written
            for unit in units.values():
                client.data_received(struct.pack(">HHHBBHH", unit, 0, 6, unit, 3, start, words))
                client._drain()  # answer immediately, whereas the gateway would serve other clients first
            assert self.transport.written - before == len(units) * (9 + 2 * words)

        return read

    def viewer(self) -> Callable[[], Any]:
        """Return a function that requests the web page's newest data over HTTP."""
        from uvicorn import Config
        from uvicorn.protocols.http.h11_impl import H11Protocol
        from uvicorn.server import ServerState

        app = WatchedApp(make_app(self.gateway), Connections(time.monotonic))
        config = Config(app, http="h11", ws="none", lifespan="off", log_config=None, access_log=False)
        config.load()
        protocol = H11Protocol(config, ServerState(), {})
        protocol.connection_made(self.transport)

        async def ask() -> None:
            before = self.transport.written
            protocol.data_received(
                b"GET /api/frame?after=-1 HTTP/1.1\r\nhost: localhost\r\naccept-encoding: gzip\r\n\r\n"
            )
            while protocol.tasks:
                await asyncio.sleep(0)
            assert self.transport.written - before > 500

        self.gateway.frames._build()
        return ask


WORKS: dict[str, Callable[[Worker], Callable[[], Any]]] = {
    "310 rows": lambda worker: worker.take_given,
    "events": lambda worker: worker.events,
    "a frame, as what changed": lambda worker: worker.frame,
    "the same, to a next viewer": Worker.next_viewer,
    "a frame, whole": lambda worker: worker.whole_frame,
    "a frame over HTTP": Worker.viewer,
    "31 x ten words by Modbus": lambda worker: worker.masters(FIRST_READING, WORDS),
    "31 x common block by Modbus": lambda worker: worker.masters(COMMON, COMMON_WORDS),
    "statistics": lambda worker: worker.statistics,
    "metrics": lambda worker: worker.metrics,
}


async def least_us(name: str, turns: int) -> float:
    """Return the least CPU time in us of `turns` measurements of this kind of work."""
    with TemporaryDirectory() as folder:
        worker = Worker(Path(folder))
        act, least = WORKS[name](worker), float("inf")
        for _ in range(turns):
            worker.take_rows()
            worker.gateway.frames._has_news = False
            begun = time.thread_time()
            done = act()
            if asyncio.iscoroutine(done):
                await done
            least = min(least, time.thread_time() - begun)
        worker.gateway.listener.close()
    return least * 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--turns", type=int, default=400)
    arguments = parser.parse_args()
    tables.heading(f"{sum(LINES)} drives x {len(POLLED)} values: CPU of each work, once; us.")
    found = [(name, f"{asyncio.run(least_us(name, arguments.turns)):.0f}") for name in WORKS]
    tables.show(("work", "us"), found)


if __name__ == "__main__":
    main()
