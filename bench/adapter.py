"""The one place in bench/, besides played.py, that knows multidrop's API."""

from __future__ import annotations

import os
import select
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import numpy
import pyarrow
import pyarrow.compute
from jobs import REGISTERS, Job, expected
from played import Played, Unpaced, Unreliable

from multidrop.batch import Batch, Row
from multidrop.bus import Bus
from multidrop.core import Block, Columns, Field, Port, new_completion
from multidrop.drive import Drive
from multidrop.line import Line
from multidrop.plant import Line as Declared
from multidrop.plant import Plant, Polled, PolledDrive, load_plant
from multidrop.poller import Poller
from multidrop.recording import open_writer

BATCH_ROWS = 1 << 14


def silence(baudrate: int) -> float:
    """Seconds that multidrop keeps between two exchanges: one bit more, for a second stop bit."""
    drive = Played(1, baudrate=baudrate)
    return drive.needed_silence() + drive.settings.bit


def _plant_text(job: Job) -> str:
    family = "Played" if job.baudrate else "Unpaced"
    model = f"{Path(__file__).with_name('played.py')}:{family}"
    drives = (
        f'[[line.drive]]\nname = "drive-{address}"\nmodel = "{model}"\naddress = {address}\n'
        + (f"baudrate = {job.baudrate}\n" if job.baudrate else "")
        for address in range(1, job.drives + 1)
    )
    return f'[[line]]\nname = "line"\nport = "{job.port}"\n' + "".join(drives)


@contextmanager
def polling(job: Job) -> Iterator[Poller]:
    """All registers of all drives, as fast as the line allows."""
    with TemporaryDirectory() as directory:
        path = Path(directory) / "plant.toml"
        path.write_text(_plant_text(job))
        plant = load_plant(path)
    with Poller(plant) as poller:
        yield poller


class Inherited(Line):
    """A line on a descriptor that is open already, which no URL can name."""

    def _open(self) -> None:
        os.set_blocking(int(self.port), False)
        self._core = Port(int(self.port), must_take=-1)

    def close(self) -> None:
        if self._core:
            self._core.close()
            self._core = None


def _opened(port: str) -> Line:
    return Inherited(port) if port.isdigit() else Line(port)


@contextmanager
def _polling_drives(lines: Mapping[str, Sequence[Drive]], every: float | None) -> Iterator[Poller]:
    """All registers of the drives on each port: a path, or the number of an open descriptor."""
    declared = tuple(
        Declared(
            port,
            port,
            None,
            None,
            tuple(
                PolledDrive(it, tuple(Polled(register, every) for register in it.readings())) for it in drives
            ),
        )
        for port, drives in lines.items()
    )
    with patch("multidrop.bus.Line", _opened), Poller(Plant(declared, Path())) as poller:
        yield poller


@contextmanager
def polling_lines(
    ports: Sequence[str], baudrate: int, drives: int = 16, every: float | None = None
) -> Iterator[Poller]:
    """Drives with the addresses from 1 on each port; baud rate 0: without waits."""

    def drive(port: str, address: int) -> Drive:
        name = _name(port, address)
        return Played(address, name=name, baudrate=baudrate) if baudrate else Unpaced(address, name=name)

    lines = {port: [drive(port, address) for address in range(1, drives + 1)] for port in ports}
    with _polling_drives(lines, every) as poller:
        yield poller


def _name(port: str, address: int) -> str:
    return f"{port}/{address}"


def counts(poller: Poller) -> tuple[int, int]:
    """Good exchanges and failures so far."""
    summary = poller.summary()
    return summary["samples"] // REGISTERS, summary["misses"] // REGISTERS


@contextmanager
def multidrop(job: Job) -> Iterator[Callable[[], tuple[int, int]]]:
    """As a rival: batches of columns are taken ten times a second, and the last one is looked at."""

    def poll() -> tuple[int, int]:
        for row in last(poller.batches(job.seconds)):
            address, register = int(row.drive.partition("-")[2]), int(row.register[1:])
            if row.value is not None and row.value != expected(address)[register]:
                raise AssertionError(f"{row} is not what the drive holds")
        return counts(poller)

    def last(batches: Iterable[Batch]) -> Iterable[Row]:
        return deque(batches, 1).pop()

    with polling(job) as poller:
        yield poll


@contextmanager
def reading(job: Job) -> Iterator[Callable[[int], object]]:
    """What reads all registers of the drive with an address, and raises what the library raises."""
    with Bus(job.port, baudrate=job.port_baudrate) as bus:
        drives = {address: bus.attach(Played, address) for address in range(1, job.drives + 1)}
        yield lambda address: bus.read_many(drives[address], Played.readings())


def lateness_ms(job: Job) -> tuple[int, numpy.ndarray]:
    """Good exchanges, and for each value how long after its reply's first byte the consumer had it.

    The consumer sleeps on the poller's descriptor and takes what there is as soon as it wakes.
    """
    _replied_ns(decoder(1)())  # what is imported at the first use would make it late
    late = [numpy.empty(0)]
    with polling(job) as poller:
        end = time.monotonic() + job.seconds
        while (left := end - time.monotonic()) > 0:
            select.select([poller], [], [], left)
            while batch := poller.take():
                now = time.monotonic_ns()
                late.append(now - _replied_ns(batch))
        good, _ = counts(poller)
    return good, numpy.concatenate(late) / 1e6


def start_lateness_us(ports: Sequence[str], baudrate: int, every: float, seconds: float) -> list[float]:
    """How long after it was due each request of one drive per line began to leave."""
    with polling_lines(ports, baudrate, 1, every) as poller:
        batches = list(poller.batches(seconds))
        grids = {_name(line.name, 1): line.started_ns for line in poller._lines}
    period_ns = round(every * 1e9)
    sent_ns = {(row.drive, row.monotonic_ns - grids[row.drive]) for batch in batches for row in batch}
    # The first ones are due at the moment at which polling starts.
    return [sent % period_ns / 1e3 for _, sent in sorted(sent_ns) if sent > period_ns / 2]


@dataclass
class Judged:
    """What came of drives on which replies are late, lost or doubled."""

    exchanges: int = 0
    samples: int = 0
    wrong: int = 0  # values that are another register's
    late: int = 0  # replies that were recognised after their time-out
    misses: Counter[str] = field(default_factory=Counter)


def judge(ports: Sequence[str], exchanges: int, drives: int) -> Judged:
    """Poll until so many exchanges are done, and hold each value against what its register holds."""
    judged = Judged()
    names = [_name(port, address) for port in ports for address in range(1, drives + 1)]
    held = {
        (name, register): Unreliable.held(int(name.partition("/")[2]), register)
        for name in names
        for register in Unreliable.registers
    }
    lines = {
        port: [Unreliable(address, name=_name(port, address)) for address in range(1, drives + 1)]
        for port in ports
    }
    with _polling_drives(lines, None) as poller:
        while judged.exchanges < exchanges:
            for batch in poller.batches(1.0):
                _judge(batch, held, judged)
            judged.exchanges = sum(line["exchanges"] for line in poller.summary()["lines"].values())
    while batch := poller.take():
        _judge(batch, held, judged)
    summary = poller.summary()
    judged.late = sum(line["late_replies"] for line in summary["lines"].values())
    if summary["dropped"] or (judged.samples, judged.misses.total()) != (
        summary["samples"],
        summary["misses"],
    ):
        raise AssertionError(f"rows are missing: {judged}, {summary}")
    return judged


def _judge(batch: Batch, held: Mapping[tuple[str, str], int], judged: Judged) -> None:
    columns = pyarrow.record_batch(batch)
    good = columns.filter(columns["value"].is_valid())
    drives, registers = (good[name].dictionary_encode() for name in ("drive", "register"))
    names = drives.dictionary.to_pylist(), registers.dictionary.to_pylist()
    truth = numpy.array([[held[drive, register] for register in names[1]] for drive in names[0]])
    if len(good):
        right = truth[drives.indices.to_numpy(), registers.indices.to_numpy()]
        judged.wrong += int((good["value"].to_numpy() != right).sum())
    judged.samples += len(good)
    judged.misses.update(columns.filter(columns["value"].is_null())["status"].to_pylist())


def _replied_ns(batch: Batch) -> numpy.ndarray:
    columns = pyarrow.record_batch(batch)
    replied = pyarrow.compute.add(columns["monotonic_ns"], columns["uncertainty_ns"]).drop_null()
    return replied.to_numpy(zero_copy_only=False)


def decoder(drives: int) -> Callable[[], Batch]:
    """What decodes one reply of each drive in turn, again and again, until a new batch is full."""
    registers = list(Played.registers.values())
    replies = []
    for address in range(1, drives + 1):
        fields = [Field(it.address, it.wire, address - 1, it.address, 1, 10) for it in registers]
        data = b"".join(value.to_bytes(2, "big") for value in expected(address))
        found = new_completion()
        found.result, found.sent_ns, found.first_ns = 5 + len(data), address, address + 1
        found.reply.data_len, found.reply.data[0 : len(data)] = len(data), list(data)
        replies.append((Block(fields), found))
    names = [f"drive-{address}" for address in range(1, drives + 1)], [it.name for it in registers]

    def decode() -> Batch:
        columns = Columns(BATCH_ROWS)
        for turn in range(BATCH_ROWS // REGISTERS):
            columns.add(*replies[turn % drives], 0)
        return Batch(columns, *names)

    return decode


def record(path: Path, decode: Callable[[], Batch], values: int) -> int:
    """Decode and write until so many values are in the recording; how many there are."""
    with open_writer(path, {}) as writer:
        while writer.rows < values:
            writer.write(decode())
        return writer.rows
