"""Record histories for tests in segments, and compute their expected buckets in plain Python."""

from __future__ import annotations

import random
import sys
import time
from collections.abc import Iterable, Sequence
from itertools import count
from math import isclose
from pathlib import Path

from batches import add_miss, add_rows, new_completion

from multidrop.core import Columns, Field, NumberFormat, RowLayout, Status
from multidrop.core.columns import Names
from multidrop.history import writer as writer_module
from multidrop.history.buckets import Buckets
from multidrop.history.history import History
from multidrop.history.writer import HistoryWriter
from multidrop.polling.batch import Batch, Row
from multidrop.recording.rows import from_rows
from multidrop.recording.segments import SegmentWriter

SECOND = 1_000_000_000
DAY = 86400 * SECOND
NOON = 1_795_262_400 * SECOND  # 2026-11-21 12:00 UTC
METADATA = {"plant": "завод.toml", "drives": {"pump-1": {"registers": {"speed": {"unit": "rpm"}}}}}


def batch(names: Names, drive: int, numbers: Iterable[int], begin: int, step: int) -> Batch:
    """Return a batch with a row per number, in the core's memory as after a poll. Every tenth has no value.

    A row's request was sent at `number * step` ns of the monotonic clock, which is UTC minus `begin`.
    """
    numbers = list(numbers)
    columns = Columns(len(numbers))
    layout = RowLayout(drive, [Field(0, NumberFormat.U16, 0, 1.0, 1.0)])
    for number in numbers:
        if number % 10 == 9:
            assert add_miss(columns, layout, Status.NO_REPLY, number * step, begin)
        else:
            found = new_completion(result=7, sent_ns=number * step, first_ns=number * step + 5)
            found.reply.data_len = 2
            found.reply.data[0:2] = list((number & 0xFFFF).to_bytes(2, "big"))
            assert add_rows(columns, layout, found, begin)
    return Batch(columns, names, _SPEED)


_SPEED = Names(["speed"])


def random_rows(seed: int, begin: int, count: int, step: int = SECOND // 5) -> list[Row]:
    """Return rows of six series at irregular times; about one value in seven is missing."""
    dice = random.Random(seed)
    rows, time = [], begin
    for _ in range(count):
        time += dice.randrange(2 * step)
        is_miss = dice.random() < 0.15
        rows.append(
            Row(
                time,
                time - NOON + 10 * DAY,
                # a power of two, which a float represents exactly
                None if is_miss else 1 << dice.randrange(10, 24),
                f"pump-{dice.randrange(3)}",
                ("speed", "current")[dice.randrange(2)],
                None if is_miss else dice.uniform(-50, 50),
                "no reply" if is_miss else "ok",
            )
        )
    return rows


def record(folder: Path, segments: Sequence[Sequence[Row]], piece: int = 40, after: int = 0) -> None:
    """Write each list of rows as a segment of a history; each write has at most `piece` rows."""
    folder.mkdir(exist_ok=True)
    with SegmentWriter(folder / "rows.arrows", METADATA, every=1e9, after=after) as writer:
        for rows in segments:
            for at in range(0, len(rows), piece):
                writer.write(from_rows(rows[at : at + piece]))
            writer.rotate()


def rows_in(history: History, *of: object) -> list[Row]:
    return [row for rows in history.read(*of) for row in rows]  # type: ignore[arg-type]


def check_buckets(found: Buckets, rows: Iterable[Row], series: str) -> None:
    """Check the buckets against a computation from the rows in plain Python."""
    drive, _, register = series.rpartition(".")
    mine: dict[int, list[float | None]] = {}
    for row in rows:
        if (row.drive, row.register) == (drive, register):
            mine.setdefault((row.time_ns - found.begin) // found.step, []).append(row.value)
    for number, begin in enumerate(found.times):
        assert begin == found.begin + number * found.step
        here = mine.get(number, [])
        values = [value for value in here if value is not None]
        assert (found.n[number], found.missed[number]) == (len(values), len(here) - len(values))
        if values:
            assert (found.least[number], found.most[number]) == (min(values), max(values))
            assert isclose(found.mean[number] or 0.0, sum(values) / len(values), rel_tol=1e-9, abs_tol=1e-9)
        else:
            assert (found.least[number], found.mean[number], found.most[number]) == (None, None, None)


# ---- a process that records: `python histories.py FOLDER RUN` ----

STEP = SECOND // 100
RUN = 9 * 3600 * SECOND
ROWS = 30  # rows per batch


def main(folder: Path, run: int) -> None:
    """Record into a history until killed; print how many rows are written.

    Row `n` of run `r` has the drive `run-r` and was sent at `n * 10 ms` of the monotonic clock; each run
    starts 9 hours after the previous one.
    """
    writer_module.WRITING_S = 0.01
    names = Names([f"run-{run}"])
    writer = HistoryWriter(folder, METADATA, rotate=0.25)
    for number in count():
        writer.take(batch(names, 0, range(number * ROWS, (number + 1) * ROWS), NOON + run * RUN, STEP))
        print(writer.state().rows, flush=True)
        time.sleep(0.005)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
