"""Requests in flight while a line is handed over: each of them gets its row."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from lines import until
from numbered_answers import PORT, Answers, KeptRow, NumberedDrive, drive_name, judge_drive, plant_file
from tables import table

from multidrop.core import UNASKED, Mastership
from multidrop.families import InnovertIBD
from multidrop.plant.loader import load_plant
from multidrop.plant.model import Plant, PlantLine
from multidrop.poller import Poller
from multidrop.polling.batch import Row
from multidrop.sim import Simulator, Wire

if sys.platform != "linux":
    pytest.skip("masterships are Linux's", allow_module_level=True)

SECOND = 1_000_000_000
HOUR_NS = 3600 * SECOND


@contextmanager
def simulated_line(folder: Path, delay: float) -> Iterator[tuple[list[NumberedDrive], PlantLine]]:
    """Yield two drives that answer after `delay` seconds, and their line."""
    drives = [
        NumberedDrive(InnovertIBD(address=at, name=drive_name("line", at)), response_delay=delay)
        for at in (1, 2)
    ]
    with Simulator([Wire(drives, name="line", port=PORT)]) as simulator:
        path = folder / "plant.toml"
        path.write_text(plant_file({"line": simulator.wires[0].path}))
        yield drives, load_plant(path).lines[0]


class Gateway:
    """A poller with a valid mastership, and its rows for requests that were sent."""

    def __init__(self, folder: Path) -> None:
        self.mastership = Mastership(guard_s=0.01)
        self.mastership.extend(time.clock_gettime_ns(time.CLOCK_BOOTTIME) + HOUR_NS)
        self.rows: list[Row] = []
        self.poller = Poller(Plant((), folder), mastership=self.mastership)
        self.poller.on_batch(lambda batch: self.rows.extend(row for row in batch if is_asked(row)))

    def close(self) -> None:
        self.poller.close()
        self.mastership.end()


def is_asked(row: Row) -> bool:
    return not row.status.startswith(UNASKED)


@pytest.fixture
def gateways(tmp_path: Path) -> Iterator[list[Gateway]]:
    made = [Gateway(tmp_path) for _ in range(2)]
    for gateway in made:
        gateway.poller.__enter__()
    yield made
    for gateway in made:
        gateway.close()


def hand_over(gateway: Gateway, drives: list[NumberedDrive], line: PlantLine) -> None:
    """Poll until a drive has received a request, and close the line before the drive answers."""
    gateway.poller.add_line(line)
    begun = sum(drive.answers for drive in drives)
    until(lambda: sum(drive.answers for drive in drives) > begun)
    gateway.poller.remove_line("line")


def judge(drives: list[NumberedDrive], gateways: list[Gateway]) -> list[Answers]:
    for gateway in gateways:
        gateway.close()
    rows = [row for gateway in gateways for row in gateway.rows]
    return [
        judge_drive(
            [
                KeptRow(row.time_ns, None if row.value is None else round(row.value))
                for row in rows
                if row.drive == drive.drive.name
            ],
            drive.answers,
        )
        for drive in drives
    ]


@pytest.mark.slow
def test_no_row_is_lost_when_a_line_moves_between_gateways(tmp_path: Path, gateways: list[Gateway]) -> None:
    with simulated_line(tmp_path, delay=0.1) as (drives, line):
        for turn in range(8):
            hand_over(gateways[turn % 2], drives, line)
        judged = judge(drives, gateways)
    assert sum(one.answered for one in judged) >= 8
    assert [(one.lost, one.doubled) for one in judged] == [(0, 0), (0, 0)]


def test_an_abandoned_request_has_a_row_with_its_status(
    tmp_path: Path, gateways: list[Gateway], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("multidrop.polling.line_set.ENDING_NS", 0)
    with simulated_line(tmp_path, delay=1.0) as (drives, line):
        hand_over(gateways[0], drives, line)
        hand_over(gateways[1], drives, line)
        judged = judge(drives, gateways)
    assert [(one.lost, one.doubled) for one in judged] == [(0, 0), (0, 0)]
    assert {row.status for gateway in gateways for row in gateway.rows} == {"poll ended"}


def rows(*numbers: int | None) -> list[KeptRow]:
    """Return one row per 100 ns with these values; 0 leaves a row out, None is a miss."""
    return [KeptRow(100 * at, number) for at, number in enumerate(numbers) if number != 0]


@table(
    ("found", "answered", "expected"),
    [
        (rows(1, 2, 3), 3, Answers(3, 3)),
        (rows(), 0, Answers()),
        (rows(1, None, 3), 3, Answers(3, 2, late=1)),
        (rows(1, None, 2), 2, Answers(2, 2)),
        (rows(1, 3), 3, Answers(3, 2, lost=1)),
        (rows(1, None, 4), 4, Answers(4, 2, late=1, lost=1)),
        (rows(1, 2), 3, Answers(3, 2, lost=1)),
        (rows(1, 2, 2, 3), 3, Answers(3, 3, doubled=1)),
    ],
)
def test_the_judge_finds_lost_and_doubled_answers(
    found: list[KeptRow], answered: int, expected: Answers
) -> None:
    assert judge_drive(found, answered) == expected


@pytest.mark.long
def test_late_answers_have_a_row_marked_as_late(tmp_path: Path, gateways: list[Gateway]) -> None:
    with simulated_line(tmp_path, delay=0.02) as (drives, line):
        gateways[0].poller.add_line(line)
        for delay in (0.02, 0.45, 0.02, 0.9, 0.02):
            drives[0].response_delay = delay
            begun = drives[0].answers
            until(lambda begun=begun: drives[0].answers >= begun + 3)  # type: ignore[misc]
        judged = judge(drives, gateways)
    assert [(one.lost, one.doubled) for one in judged] == [(0, 0), (0, 0)]
    assert judged[0].late > 0
