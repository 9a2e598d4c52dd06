"""multidrop as a master. In bench/ only this file, players/replay.py and many_adapter.py use its API."""

from __future__ import annotations

import select
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy
import pyarrow
import pyarrow.compute
from multidrop._core import ffi, lib

from bench.masters.jobs import REGISTERS, Job, expected
from bench.players.replay import Played, Unpaced
from multidrop.bus import Bus
from multidrop.core import Columns, Field, Mastership, Names, RowLayout
from multidrop.plant.loader import load_plant
from multidrop.poller import Poller
from multidrop.polling.batch import Batch, Row
from multidrop.recording import open_writer

BATCH_ROWS = 1 << 14
LEASE_NS = 3600 * 1_000_000_000


def silence(baudrate: int) -> float:
    """Return the silence that multidrop keeps between exchanges, plus one bit for a second stop bit, in s."""
    drive = Played(1, baudrate=baudrate)
    return drive.needed_silence() + drive.settings.bit


def _plant_text(job: Job) -> str:
    family = "Played" if job.baudrate else "Unpaced"
    model = f"{Path(__file__).parents[1] / 'players' / 'replay.py'}:{family}"
    drives = (
        f'[[line.drive]]\nname = "drive-{address}"\nmodel = "{model}"\naddress = {address}\n'
        + (f"baudrate = {job.baudrate}\n" if job.baudrate else "")
        for address in range(1, job.drives + 1)
    )
    return f'[[line]]\nname = "line"\nport = "{job.port}"\n' + "".join(drives)


@contextmanager
def polling(job: Job, mastership: Mastership | None = None, *, realtime: bool = False) -> Iterator[Poller]:
    """Yield a poller of all registers of all drives, which polls as fast as the line allows."""
    with TemporaryDirectory() as directory:
        path = Path(directory) / "plant.toml"
        path.write_text(_plant_text(job))
        plant = load_plant(path)
    with Poller(plant, mastership=mastership, realtime=realtime) as poller:
        if realtime and not poller._realtime.is_held:
            sys.exit("realtime is refused: run this as root, or see `multidrop doctor`")
        yield poller


def counts(poller: Poller) -> tuple[int, int]:
    """Return the numbers of good and of failed exchanges so far."""
    summary = poller.summary()
    return summary["samples"] // REGISTERS, summary["misses"] // REGISTERS


def missed(batch: Batch) -> int:
    """Return the number of rows without a value."""
    return int(numpy.count_nonzero(batch._columns.array("status")))


def dropped(poller: Poller) -> int:
    """Return the number of dropped rows; for thousands of drives this is faster than `summary`."""
    return poller._row_queue.dropped


@contextmanager
def multidrop(
    job: Job, mastership: Mastership | None = None, *, realtime: bool = False
) -> Iterator[Callable[[], tuple[int, int]]]:
    """Yield a function that polls with a Poller, and returns the numbers of good and of failed exchanges.

    It takes batches ten times a second, and checks the values of the last batch."""

    def poll() -> tuple[int, int]:
        for row in last(poller.batches(job.seconds)):
            address, register = int(row.drive.partition("-")[2]), int(row.register[1:])
            if row.value is not None and row.value != expected(address)[register]:
                raise AssertionError(f"{row} is not what the drive holds")
        return counts(poller)

    def last(batches: Iterable[Batch]) -> Iterable[Row]:
        return deque(batches, 1).pop()

    with polling(job, mastership, realtime=realtime) as poller:
        yield poll


@contextmanager
def leased(job: Job) -> Iterator[Callable[[], tuple[int, int]]]:
    """Poll like `multidrop`, but with a mastership: the C core then checks the clock before each request."""
    mastership = Mastership()
    mastership.extend(time.clock_gettime_ns(time.CLOCK_BOOTTIME) + LEASE_NS)
    try:
        with multidrop(job, mastership) as poll:
            yield poll
    finally:
        mastership.end()


@contextmanager
def reading(job: Job) -> Iterator[Callable[[int], dict[str, float]]]:
    """Yield a function that reads all registers of the drive at an address."""
    family = Played if job.baudrate else Unpaced
    registers = family.readings()
    with Bus(job.port, baudrate=job.port_baudrate) as bus:
        drives = {address: bus.attach(family, address) for address in range(1, job.drives + 1)}
        yield lambda address: drives[address].read_many(registers)


def lateness_ms(job: Job, *, realtime: bool = False) -> tuple[int, numpy.ndarray]:
    """Return the number of good exchanges, and the ms from each reply's first byte until a value is taken.

    The consumer sleeps on the poller's descriptor, and takes the rows as soon as it wakes.
    """
    _replied_ns(decoder(1)())  # imports modules now, because later imports would delay values
    late = [numpy.empty(0)]
    with polling(job, realtime=realtime) as poller:
        end = time.monotonic() + job.seconds
        while (left := end - time.monotonic()) > 0:
            select.select([poller], [], [], left)
            while batch := poller.take():
                now = time.monotonic_ns()
                late.append(now - _replied_ns(batch))
        good, _ = counts(poller)
    return good, numpy.concatenate(late) / 1e6


def _replied_ns(batch: Batch) -> numpy.ndarray:
    columns = pyarrow.record_batch(batch)
    replied = pyarrow.compute.add(columns["monotonic_ns"], columns["uncertainty_ns"]).drop_null()
    return numpy.asarray(replied)


def decoder(drives: int) -> Callable[[], Batch]:
    """Return a function that decodes one reply of each drive in turn until a batch is full."""
    registers = list(Played.registers.values())
    replies = []
    for address in range(1, drives + 1):
        fields = [
            Field(register.address, register.number_format, register.address, 1, 10) for register in registers
        ]
        data = b"".join(value.to_bytes(2, "big") for value in expected(address))
        found = ffi.new("struct md_completion *")
        found.result, found.sent_ns, found.first_ns = 5 + len(data), address, address + 1
        found.reply.data_len, found.reply.data[0 : len(data)] = len(data), list(data)
        replies.append((RowLayout(address - 1, fields), found))
    turns = replies * (BATCH_ROWS // REGISTERS // drives + 1)
    names = (
        Names(f"drive-{address}" for address in range(1, drives + 1)),
        Names(register.name for register in registers),
    )

    def decode() -> Batch:
        columns = Columns(BATCH_ROWS)
        add, into = lib.md_columns_add, columns.c  # called directly from C, as the C core's own thread does
        for block, found in turns[: BATCH_ROWS // REGISTERS]:
            add(into, block.c, found, 0)
        return Batch(columns, *names)

    return decode


def record(path: Path, decode: Callable[[], Batch], values: int) -> int:
    """Decode and write batches until the recording has at least `values` values; return their number."""
    with open_writer(path, {}) as writer:
        while writer.rows < values:
            writer.write(decode())
        return writer.rows
