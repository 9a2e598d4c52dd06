"""Samples of a fleet: bytes and CPU time per value, in messages and in the hub's stores.

The rows resemble those of a real plant, which are less regular than a simulator's. On each line, the drives
are read in turn, ten registers per request, every 12 ms or slightly more. Speeds, currents and voltages
change by one or two steps in three of five polls, and temperatures in one of three polls. Five of 1000
requests get no reply.
"""

from __future__ import annotations

import argparse
import heapq
import os
import random
import resource
import time
from array import array
from collections.abc import Callable, Iterator
from datetime import UTC as UTC_ZONE
from datetime import datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any, cast

from postgres_clusters import Postgres, postgres

from bench.support import tables
from multidrop import PlantLine
from multidrop.fleet.samples.hub import Commit, ParquetSink, SampleSink
from multidrop.fleet.samples.postgres_sink import PostgresSink
from multidrop.polling import BatchColumns
from multidrop.samples.message import Packed, PolledUnits, RowBuffer, unpack
from multidrop.samples.spool import SpoolFolder

UTC = 1_795_253_399_123_456_789
DRIVES = 16  # per line
REGISTERS = {  # name: first raw value, step, and probability that a poll finds a change
    "output_frequency": (4500, 0.01, 0.6),
    "output_current": (53, 0.1, 0.7),
    "output_voltage": (3800, 0.1, 0.3),
    "dc_bus_voltage": (5400, 0.1, 0.4),
    "temperature": (45, 0.1, 0.3),
    "motor_speed": (1460, 1.0, 0.6),
    "output_power": (620, 0.1, 0.7),
    "load": (31, 1.0, 0.02),
    "status_word": (1, 1.0, 0.0),
    "fault": (0, 1.0, 0.0),
}
UNITS = ("Hz", "A", "V", "V", "degC", "rpm", "kW", "%", "", "")
STATUSES = ("ok", "no reply")


def exchanges(lines: int, dice: random.Random) -> Iterator[tuple[int, int, int, list[float] | None]]:
    """Yield each exchange: its time and uncertainty, the drive's number, and the values (None: missing)."""
    due = [(dice.randrange(12_000_000), line) for line in range(lines)]
    heapq.heapify(due)
    turn = [0] * lines
    steps: dict[int, list[int]] = {}
    while True:
        now, line = heapq.heappop(due)
        drive = line * DRIVES + turn[line]
        turn[line] = (turn[line] + 1) % DRIVES
        heapq.heappush(due, (now + 12_000_000 + dice.randrange(400_000), line))
        values = steps.setdefault(
            drive,
            [of + (dice.randint(-of // 5, of // 5) if of > 20 else 0) for of, _, _ in REGISTERS.values()],
        )
        for at, (_, _, moves) in enumerate(REGISTERS.values()):
            if dice.random() < moves:
                values[at] += dice.choice((-2, -1, 1, 2))
        told = [many * step for many, (_, step, _) in zip(values, REGISTERS.values(), strict=True)]
        yield now, dice.randrange(2_500_000, 4_500_000), drive, None if dice.random() < 0.005 else told


def columns_of(rows: int, lines: int, dice: random.Random) -> BatchColumns:
    """Return `rows` random rows in the format of `Batch.columns()`."""
    kinds = {"time": "q", "monotonic_ns": "q", "uncertainty_ns": "q"}
    kinds |= {"drive": "H", "register": "H", "value": "d", "status": "H"}
    made: dict[str, array[Any]] = {name: array(kind) for name, kind in kinds.items()}
    for now, uncertainty, drive, values in exchanges(lines, dice):
        if len(made["time"]) >= rows:
            break
        for register, value in enumerate(values or [0.0] * len(REGISTERS)):
            one: tuple[Any, ...] = (UTC + now, now, uncertainty, drive, register, value, int(values is None))
            for name, number in zip(made, one, strict=True):
                made[name].append(number)
    return BatchColumns(
        **{name: memoryview(column) for name, column in made.items()},
        valid=memoryview(b""),
        drives=tuple(f"line-{at // DRIVES + 1}-pump-{at % DRIVES + 1}" for at in range(lines * DRIVES)),
        registers=tuple(REGISTERS),
        statuses=STATUSES,
    )


def units_of(columns: BatchColumns) -> PolledUnits:
    polls = [
        SimpleNamespace(register=SimpleNamespace(name=name, unit=unit, values=None, step=1))
        for name, unit in zip(REGISTERS, UNITS, strict=True)
    ]
    drives = [SimpleNamespace(drive=SimpleNamespace(name=name), polls=polls) for name in columns.drives]
    units = PolledUnits()
    units.note(cast(PlantLine, SimpleNamespace(drives=drives)), 0)
    return units


def packed(columns: BatchColumns, units: PolledUnits) -> list[Packed]:
    buffer = RowBuffer()
    assert buffer.add(columns)
    return list(buffer.messages(units=units))


def cpu() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def cost(act: Any, times: int) -> float:
    """Return the CPU time of one call of `act` in ns, the mean of `times` calls."""
    act()
    begun = cpu()
    for _ in range(times):
        act()
    return (cpu() - begun) / times * 1e9


def messages() -> Iterator[tuple[object, ...]]:
    for rows, lines in ((3100, 2), (4096, 40), (16384, 40), (16384, 500), (65536, 40), (65536, 500)):
        columns = columns_of(rows, lines, random.Random(rows))
        made, units = len(columns.time), units_of(columns)
        found = packed(columns, units)
        size = sum(len(one.data) for one in found)
        times = max(3, 400_000 // made)
        packing = cost(lambda columns=columns, units=units: packed(columns, units), times) / made
        reading = cost(lambda found=found: [unpack(one.data) for one in found], times) / made
        yield made, lines, len(found), f"{size / made:.2f}", f"{packing:.0f}", f"{reading:.0f}"


def stores(folder: Path) -> Iterator[tuple[object, ...]]:
    """Write the same half million rows of 500 lines to each store, in two commits."""
    found = [columns_of(65536, 500, random.Random(seed)) for seed in range(8)]
    units = units_of(found[0])  # the same in all messages, because all have the same drives
    sent = [one.data for columns in found for one in packed(columns, units)]
    rows = sum(len(columns.time) for columns in found)
    spool = SpoolFolder(folder / "spool", "gateway-1")

    def spooled() -> int:
        for columns in found:
            for one in packed(columns, units):
                spool.add(spool.write(one.data, one.rows))
        return size_of(folder / "spool")

    yield ("spool, packed and fsynced", rows, *timed(rows, spooled))
    yield ("hub, Parquet", rows, *timed(rows, lambda: in_files(folder / "hub", sent)))
    with postgres() as database:
        yield ("hub, PostgreSQL", rows, *timed(rows, lambda: in_database(database, sent)))
        yield (
            "PostgreSQL, a row a value, COPY by psycopg",
            rows,
            *timed(rows, lambda: narrow(database, sent)),
        )


def in_files(folder: Path, sent: list[bytes]) -> int:
    sink = ParquetSink(folder)
    commit(sink, sent)
    sink.close()
    return size_of(folder)


def in_database(database: Postgres, sent: list[bytes]) -> int:
    sink = PostgresSink(database.where)
    sink.begin("bench")
    commit(sink, sent)
    sink.close()
    ((size,),) = database.ask("select pg_total_relation_size('multidrop.exchanges')")
    return int(str(size))


def commit(sink: SampleSink, sent: list[bytes]) -> None:
    """Write the messages in two commits."""
    for first in range(0, len(sent), len(sent) // 2):
        tables = [unpack(data) for data in sent[first : first + len(sent) // 2]]
        last = first + len(tables)
        sink.write(Commit("bench", first + 1, last, {"gateway-1.log": last}, tables, sum(map(len, tables))))


def narrow(database: Postgres, sent: list[bytes]) -> int:
    """Write a simple table for comparison: a row per value, an index by drive, register and time."""
    import psycopg

    database.ask(
        "create table narrow (time timestamptz, drive int, register int, value float8, status int);"
        "create index on narrow (drive, register, time)"
    )
    query = "copy narrow from stdin (format binary)"
    with psycopg.connect(database.where) as connection, connection.cursor() as cursor:
        with cursor.copy(query) as copy:
            copy.set_types(["timestamptz", "int4", "int4", "float8", "int4"])
            for data in sent:
                table = unpack(data).combine_chunks()
                codes = [table.column(name).chunk(0).indices for name in ("drive", "register", "status")]
                drives, registers, statuses = (one.to_pylist() for one in codes)
                times = [datetime.fromtimestamp(ns / 1e9, UTC_ZONE) for ns in times_of(table)]
                values = table.column("value").to_pylist()
                for row in zip(times, drives, registers, values, statuses, strict=True):
                    copy.write_row(row)
        connection.commit()
    (size,) = database.ask("select pg_total_relation_size('narrow')")[0]
    return int(str(size))


def times_of(table: Any) -> list[int]:
    times: list[int] = table.column("time").cast("int64").to_pylist()
    return times


def size_of(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def timed(rows: int, act: Callable[[], int]) -> tuple[str, str, str]:
    """Run `act`, which writes `rows` rows and returns the bytes on disk.

    Return three figures: millions of rows per second, ns of CPU time per row in this process, and bytes on
    disk per row.
    """
    begun, used = time.monotonic(), cpu()
    size = act()
    seconds, used = time.monotonic() - begun, cpu() - used
    return f"{rows / seconds / 1e6:.2f}", f"{used / rows * 1e9:.0f}", f"{size / rows:.1f}"


def main() -> None:
    argparse.ArgumentParser(description=__doc__).parse_args()
    tables.heading("Messages of samples, and their stores.")
    tables.show(
        ("rows", "lines", "messages", "B/value", "pack ns/value", "unpack ns/value"), list(messages())
    )
    print(f"\nload now {os.getloadavg()[0]:.1f}\n")
    with TemporaryDirectory(prefix="multidrop-samples-") as folder:
        columns = ("store", "values", "million/s", "CPU ns/value", "B/value")
        tables.show(columns, list(stores(Path(folder))))
    print(f"\nload now {os.getloadavg()[0]:.1f}")


if __name__ == "__main__":
    main()
