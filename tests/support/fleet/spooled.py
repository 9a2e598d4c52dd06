"""Batches of numbered exchanges, and their rows read back from a spool or a stream."""

from __future__ import annotations

import sys
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import lru_cache
from itertools import count
from pathlib import Path
from typing import Any

from batches import add_miss, add_rows, new_completion
from nats_clusters import Cluster

from multidrop.core import Columns, Field, Names, NumberFormat, RowLayout, Status
from multidrop.fleet.samples import samples_stream
from multidrop.fleet.samples.samples_stream import create_stream, samples_path, stream_info
from multidrop.fleet.servers.connections import ServerPath
from multidrop.polling.batch import Batch
from multidrop.samples.message import unpack
from multidrop.samples.spool import Spool

NOON = 1_795_262_400_000_000_000  # 2026-11-21 12:00 UTC
STEP = 10_000_000  # ns between requests
DRIVES = Names([f"pump-{number}" for number in range(1, 5)])
REGISTERS = Names([f"value_{number}" for number in range(1, 11)])
MISSED = 9  # exchanges with this remainder modulo 10 are misses


def numbered(first: int, count: int, drives: Names = DRIVES) -> Batch:
    """Return a batch of `count` exchanges with ten registers each, in the core's memory as after a poll.

    Exchange `n` was sent at `n * STEP` of the monotonic clock, to drive `n % 4`; register `r` has the value
    `n % 60000 + r`. Every tenth exchange is a miss.
    """
    columns = Columns(10 * count)
    layouts = [
        RowLayout(drive, [Field(at, NumberFormat.U16, at, 1.0, 1.0) for at in range(10)])
        for drive in range(4)
    ]
    for number in range(first, first + count):
        layout = layouts[number % 4]
        if number % 10 == MISSED:
            assert add_miss(columns, layout, Status.NO_REPLY, number * STEP, NOON)
            continue
        found = new_completion(result=25, sent_ns=number * STEP, first_ns=number * STEP + 5_000_001)
        found.reply.data_len = 20
        words = [number % 60000 + at for at in range(10)]
        found.reply.data[0:20] = list(b"".join(word.to_bytes(2, "big") for word in words))
        assert add_rows(columns, layout, found, NOON)
    return Batch(columns, drives, REGISTERS)


def rows_of(table: Any) -> list[tuple[Any, ...]]:
    """Return a table's rows as tuples of numbers and texts, sorted by time, drive and register."""
    columns = [table.column(name) for name in table.schema.names]
    columns[0] = columns[0].cast("int64")
    return sorted(
        zip(*(column.to_pylist() for column in columns), strict=True), key=lambda row: (row[0], row[3:5])
    )


@lru_cache(maxsize=16)  # tests that damage one file read the undamaged files repeatedly
def _rows_of_file(data: bytes) -> list[tuple[Any, ...]]:
    return rows_of(unpack(data))


def rows_in(folder: Path) -> list[tuple[Any, ...]]:
    """Return all rows of a spool's files."""
    files = sorted(folder.glob("*.arrows"))
    return sorted(
        (row for file in files for row in _rows_of_file(file.read_bytes())),
        key=lambda row: (row[0], row[3:5]),
    )


def exchanges_in(rows: list[tuple[Any, ...]]) -> list[int]:
    """Return the numbers of the exchanges in these rows; fail unless each exchange has all its rows."""
    found = [row[1] // STEP for row in rows]
    assert found == [number for number in found[::10] for _ in range(10)]
    return found[::10]


# ---- a connection to NATS servers with an empty stream of samples ----


@asynccontextmanager
async def empty_stream(servers: Cluster) -> AsyncIterator[ServerPath]:
    """Yield an open ServerPath to the servers, on which the stream of samples is empty."""
    async with samples_path(servers.urls) as path:
        # On a busy machine, a new stream may get the messages of the stream that was just deleted.
        is_empty = False
        while not is_empty:
            await samples_stream._ask(path, "STREAM.DELETE.samples", {}, samples_stream.NO_STREAM)
            await create_stream(path, replicas=1)
            is_empty = (await stream_info(path)).last == 0
        yield path


# ---- a process that fills a spool: `python spooled.py FOLDER FIRST` ----

EXCHANGES = 20  # exchanges per batch


def main(folder: Path, first: int) -> None:
    """Fill a spool with exchanges from number `first` on until killed; print how many are stored."""
    spool = Spool(folder, "gateway-1")
    print(0, flush=True)
    for number in count(1):
        spool.append(numbered(first + (number - 1) * EXCHANGES, EXCHANGES))
        if number % 3 == 0 and spool.sync(60.0):
            print(number * EXCHANGES, flush=True)
            time.sleep(0.001)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
