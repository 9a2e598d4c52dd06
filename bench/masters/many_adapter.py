"""multidrop on lines without a plant file: on open descriptors, with all families, or with late replies."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy
import pyarrow

from bench.players.replay import Played, Unpaced, Unreliable
from multidrop.core import Port
from multidrop.drive import Drive
from multidrop.families import MODELS
from multidrop.planning.blocks import planned
from multidrop.planning.prediction import predict
from multidrop.plant.model import Plant, PlantLine, PolledDrive
from multidrop.poller import Poller
from multidrop.polling.batch import Batch
from multidrop.transport.line import Line


class Inherited(Line):
    """A line on an open descriptor, which has no URL."""

    def _open(self) -> None:
        os.set_blocking(int(self.port), False)
        self.queue = Port(int(self.port), must_take=-1)

    def close(self) -> None:
        if self.queue:
            self.queue.close()
            self.queue = None


def _opened(port: str, *facts: Any) -> Line:
    return (Inherited if port.isdigit() else Line)(port, *facts)


@contextmanager
def _polling_drives(lines: Mapping[str, Sequence[Drive]], every: float | None) -> Iterator[Poller]:
    """Yield a poller of all registers of the drives; a port is a path, or the number of a descriptor."""
    declared = tuple(
        PlantLine(
            port,
            port,
            drives=[PolledDrive(drive, every=every) for drive in drives],
        )
        for port, drives in lines.items()
    )
    with patch("multidrop.bus.Line", _opened), Poller(Plant(declared, Path())) as poller:
        yield poller


@contextmanager
def polling_lines(
    ports: Sequence[str], baudrate: int, drives: int = 16, every: float | None = None
) -> Iterator[Poller]:
    """Yield a poller of `drives` drives with addresses from 1 on each port; baud rate 0 means no waits."""

    def drive(port: str, address: int) -> Drive:
        name = _name(port, address)
        return Played(address, name=name, baudrate=baudrate) if baudrate else Unpaced(address, name=name)

    lines = {port: [drive(port, address) for address in range(1, drives + 1)] for port in ports}
    with _polling_drives(lines, every) as poller:
        yield poller


def _name(port: str, address: int) -> str:
    return f"{port}/{address}"


def start_lateness_us(ports: Sequence[str], baudrate: int, every: float, seconds: float) -> list[float]:
    """Return how late each request was sent, in us. Each line has one drive."""
    with polling_lines(ports, baudrate, 1, every) as poller:
        batches = list(poller.batches(seconds))
        grids = {_name(line.name, 1): line.started_ns for line in poller._lines}
    period_ns = round(every * 1e9)
    sent_ns = {(row.drive, row.monotonic_ns - grids[row.drive]) for batch in batches for row in batch}
    # skip each drive's first request, which is due when polling starts
    return [sent % period_ns / 1e3 for _, sent in sorted(sent_ns) if sent > period_ns / 2]


# ---- all families on one line ----


@dataclass(frozen=True)
class Mixed:
    """A line with drives of all families: the arguments for mixed_line.c, and the predicted bus cycle."""

    drives: Sequence[Drive]
    words: Sequence[str]
    requests: int  # number of requests in a bus cycle
    cycle: float  # predicted bus cycle in s


def mixed() -> Mixed:
    """Return a line with one drive of each family and framing, each with its documented factory settings."""
    kinds = [(family, framing) for family in MODELS.values() for framing in family.framings]
    drives = [
        family(at, name=f"{family.model} {framing}", framing=framing)
        for at, (family, framing) in enumerate(kinds, 1)
    ]
    exchanges = [
        each
        for drive in drives
        for each in planned(drive, ((register, None) for register in drive.readings()))
    ]
    words = [
        ":".join(
            str(each)
            for each in (
                drive.address,
                int(drive.framing),
                drive.settings.baudrate,
                *(round(1e9 * each) for each in (drive.settings.character, drive.response_delay, demanded)),
            )
        )
        for drive in drives
        # the silences before and after ASCII frames are longer
        for demanded in [drive.needed_silence() + drive.settings.bit]
    ]
    return Mixed(drives, words, len(exchanges), predict(exchanges, lateness=0).cycle)


def poll_mixed(port: str, seconds: float) -> dict[str, Any]:
    """Poll the drives of `mixed()` at `port` for `seconds`; return the poller's summary of their line."""
    with _polling_drives({port: mixed().drives}, None) as poller:
        for _ in poller.batches(seconds):
            pass
        line: dict[str, Any] = poller.summary()["lines"][port]
    return line


# ---- replies that are late, lost or doubled ----


@dataclass
class Judged:
    """Counts of values and replies on lines whose replies are late, lost or doubled."""

    exchanges: int = 0  # requests that were sent
    samples: int = 0
    wrong: int = 0  # values that belonged to another register
    beyond: int = 0  # wrong values from requests sent more than three time-outs earlier
    late: int = 0  # late replies that were recognised as such
    misses: Counter[str] = field(default_factory=Counter)
    asked_ns: dict[tuple[str, int], int] = field(default_factory=dict)  # unanswered requests


def judge(ports: Sequence[str], exchanges: int, drives: int) -> Judged:
    """Poll for `exchanges` exchanges, and compare each value with the true value of its register."""
    return _judged(ports, drives, lambda judged: judged.exchanges >= exchanges)


def judge_for(ports: Sequence[str], seconds: float, drives: int) -> Judged:
    """Poll for `seconds`, and compare each value with the true value of its register."""
    end = time.monotonic() + seconds
    return _judged(ports, drives, lambda judged: time.monotonic() >= end)


def _judged(ports: Sequence[str], drives: int, is_over: Callable[[Judged], bool]) -> Judged:
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
        while not is_over(judged):
            for batch in poller.batches(1.0):
                _judge(batch, held, judged)
            judged.exchanges = sum(line.exchanges for line in poller.statistics().values())
    while rest := poller.take():
        _judge(rest, held, judged)
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
    bad = columns.filter(columns["value"].is_null())
    judged.misses.update(bad["status"].to_pylist())
    for drive, register, sent in zip(
        *(bad[each].to_pylist() for each in ("drive", "register", "monotonic_ns")), strict=True
    ):
        judged.asked_ns[drive, held[drive, register]] = sent
    good = columns.filter(columns["value"].is_valid())
    judged.samples += len(good)
    drives, registers = (good[name].dictionary_encode() for name in ("drive", "register"))
    names = drives.dictionary.to_pylist(), registers.dictionary.to_pylist()
    truth = numpy.array([[held[drive, register] for register in names[1]] for drive in names[0]])
    if len(good):
        right = truth[drives.indices.to_numpy(), registers.indices.to_numpy()]
        wrong = good.filter(pyarrow.array(good["value"].to_numpy() != right))
        judged.wrong += len(wrong)
        judged.beyond += sum(_is_beyond(row, judged.asked_ns) for row in wrong.to_pylist())


def _is_beyond(row: Mapping[str, Any], asked_ns: Mapping[tuple[str, int], int]) -> bool:
    """Return True if a wrong value is the reply to a request sent more than three time-outs earlier."""
    question_ns = asked_ns.get((row["drive"], int(row["value"])))
    last_ns = 3e9 * Unreliable.response_timeout
    return question_ns is not None and row["monotonic_ns"] + row["uncertainty_ns"] - question_ns > last_ns
