"""Kill clients (processes that poll, record and write) at random times: reported data must be stored exactly
once. A client reports rows after `RecordingWriter.write` has returned, and numbers after `Drive.write` has
returned. By default 20 clients are killed; more with `pytest tests/recording/test_crash.py --kills 200`.
"""

from __future__ import annotations

import os
import random
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from time import sleep

import pytest
from killable_client import METADATA, NAME, Counted, audit, ledger
from lines import until

from multidrop.control.records import read_audit
from multidrop.polling.batch import Row
from multidrop.recording import open_recording
from multidrop.sim import SimulatedDrive, Simulator, Wire
from multidrop.sim.memory import MemoryCell

SEED = 6
MOST_TOLD = 9  # largest number of reports for which the test waits before it kills a client
LONGEST_WAIT = 0.03  # largest delay in s between the last report and the kill


class Counting(SimulatedDrive):
    """A drive whose register `count` is the number of its reads. It lists every written number."""

    def __init__(self) -> None:
        super().__init__(Counted(1, name=NAME))
        self.reads = 0
        self.numbers: list[int] = []

    def refresh(self, cell: MemoryCell) -> None:
        if cell.register is Counted.count and cell.address == Counted.count.address:
            self.reads += 1
            self.memory.set_raw(Counted.count, self.reads)

    def accept(self, cell: MemoryCell, raw: int) -> int:
        self.numbers.append(raw)
        return raw


class Nursery:
    """A process that starts clients as its children; the test kills the clients."""

    def __init__(self, port: str, directory: Path) -> None:
        self._port = port
        self._directory = directory
        self._process = subprocess.Popen(
            [sys.executable, str(Path(__file__).parents[1] / "support" / "processes" / "killable_client.py")],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            bufsize=1,
        )

    def live(self, life: str, number: int, lines: int, seconds: float) -> int:
        """Start a client, kill it `seconds` s after it reported `lines` lines; return its exit status."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(f"poll {self._port} {self._directory} {life} {number}\n")
        child = int(self._process.stdout.readline())
        try:
            until(lambda: len(told(self._directory, life)) >= lines)
            sleep(seconds)
        finally:
            os.kill(child, signal.SIGKILL)
        return int(self._process.stdout.readline())

    def close(self) -> None:
        self._process.communicate()


@pytest.fixture
def counting() -> Counting:
    return Counting()


@pytest.fixture
def nursery(counting: Counting, tmp_path: Path) -> Iterator[Nursery]:
    with Simulator([Wire([counting], unpaced=True)]) as simulator:
        nursery = Nursery(simulator.wires[0].path, tmp_path)
        yield nursery
        nursery.close()


def told(directory: Path, life: str) -> list[str]:
    """Return the complete lines that a client has reported."""
    path = directory / f"{life}.told"
    return path.read_text().rpartition("\n")[0].splitlines() if path.exists() else []


def check_rows(rows: Sequence[Row]) -> None:
    """Check that each value is the previous value plus one, or plus up to one more for each row without a
    value in between. On a busy machine the drive may count as silent: then rows have the status "not asked".
    """
    samples = [row for row in rows if row.value is not None]
    assert all(before.monotonic_ns < after.monotonic_ns for before, after in pairwise(samples))
    last, missed = None, 0
    for row in rows:
        if row.value is None:
            missed += 1
            continue
        assert last is None or last < row.value <= last + missed + 1
        last, missed = row.value, 0


def check_recordings(directory: Path, life: str, acknowledged: int | None) -> int:
    """Check that both recordings have the reported rows; return the number of reported rows."""
    for suffix in (".arrows", ".csv"):
        path = directory / f"{life}{suffix}"
        if acknowledged is None and (not path.exists() or not path.stat().st_size):
            continue  # the client was killed before the recording existed
        reader = open_recording(path)
        assert reader.metadata == METADATA
        rows = [row for batch in reader for row in batch]
        assert len(rows) >= (acknowledged or 0)
        check_rows(rows)
    return acknowledged or 0


def check_ledger(directory: Path, sent: int, lives: int) -> None:
    """Check that the EEPROM ledger counts every sent write, and at most one more per killed client."""
    book = ledger(directory)
    if not book.path.exists():
        assert sent == 0
        return
    with closing(sqlite3.connect(book.path)) as opened:
        assert opened.execute("pragma integrity_check").fetchall() == [("ok",)]
    counted = sum(wear.writes for wear in book.wear(0.0))
    assert sent <= counted <= sent + lives


def check_audit(directory: Path, numbers: Sequence[int], acknowledged: Sequence[int], lives: int) -> None:
    """Check that the audit log has each reported write once, as "done"."""
    path = audit(directory)
    records = list(read_audit(path)) if path.exists() else []
    noted = [int(str(record["write"]).removeprefix("number = ")) for record in records]
    assert all(record["outcome"] == "done" for record in records)
    assert all(before < after for before, after in pairwise(noted))
    assert set(acknowledged) <= set(noted) <= set(numbers)
    assert len(numbers) - lives <= len(noted)


@pytest.mark.long
@pytest.mark.slow
def test_rows_that_a_killed_client_reported_are_recorded_exactly_once(
    request: pytest.FixtureRequest, nursery: Nursery, counting: Counting, tmp_path: Path
) -> None:
    chance = random.Random(SEED)
    kills = request.config.getoption("--kills")
    rows = 0
    acknowledged: list[int] = []
    for life in range(kills):
        # The last write of a killed client may still reach the drive, so the next client must not write the
        # same number. It would find that number in the drive already, and would neither write nor log it.
        next_number = counting.numbers[-1] + 2 if counting.numbers else 1
        lines, seconds = chance.randint(0, MOST_TOLD), chance.uniform(0.0, LONGEST_WAIT)
        died_of = nursery.live(str(life), next_number, lines, seconds)
        assert died_of == signal.SIGKILL, f"life {life} ended by itself"
        said = {word: int(number) for word, number in map(str.split, told(tmp_path, str(life)))}
        rows += check_recordings(tmp_path, str(life), said.get("rows"))
        acknowledged += range(next_number, said.get("wrote", 0) + 1)
        numbers = list(counting.numbers)
        assert all(before < after for before, after in pairwise(numbers)), "a write was sent twice"
        check_ledger(tmp_path, len(numbers), life + 1)
        check_audit(tmp_path, numbers, acknowledged, life + 1)
    assert rows > kills
    assert len(acknowledged) > kills
    print(f"{kills} clients killed; they told of {rows} rows and {len(acknowledged)} writes")
