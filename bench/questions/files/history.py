"""The cost to record, compact, store and plot a history: a day of 310 series at 10 Hz.

`python -m bench.questions.files.history DIRECTORY` writes such a day into DIRECTORY, in segments of ten
minutes. The first segment is recorded as .arrows, in batches of 0.2 s, and compacted by the process that a
gateway starts for this. DuckDB makes the other segments from generated rows with the same queries. After the
first hour their rows are at 1 Hz, which gives the same number of ten-second summaries. The last half segment,
at 10 Hz, is not compacted, as if it were still recorded.

Then the script measures the queries that the gateway's page makes. If DIRECTORY already has such a day, the
script only measures the queries.
"""

from __future__ import annotations

import argparse
import os
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from struct import calcsize
from tempfile import TemporaryDirectory
from typing import Any

from bench.support import tables
from multidrop import History
from multidrop.core.columns import COLUMNS, Names
from multidrop.history import HistoryWriter
from multidrop.history.compact import ROWS, TENS, compact
from multidrop.history.database import TABLE, connect, copy_out, rows_of
from multidrop.history.folder import STEM, file_name, parquet_files
from multidrop.polling.batch import Batch, GatheredRows
from multidrop.recording.rows import from_rows
from multidrop.recording.segments import SegmentWriter

SECOND = 1_000_000_000
SEGMENT_S = 600
MIDNIGHT = 1_795_219_200 * SECOND  # 2026-11-21
FULL_S = 3600  # seconds after midnight with 10 rows per second and register; later there is one row
DRIVES, REGISTERS = 31, 10
UNIT = "Hz"
DESCRIBED = {f"value_{number}": {"unit": UNIT} for number in range(REGISTERS)}
METADATA = {"drives": {f"drive-{number}": {"registers": DESCRIBED} for number in range(DRIVES)}}
COMPACTED = """
import resource, subprocess, sys
subprocess.run([sys.executable, "-m", "multidrop.history.compact", sys.argv[1], "--below", "2"], check=True)
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(f"{used.ru_utime + used.ru_stime:.1f} s of CPU, {used.ru_maxrss / 1000:.0f} MB at most")
"""
MADE = f"""
insert into recorded select make_timestamp_ns(sent)::timestamptz_ns, sent - {MIDNIGHT} + 1000000000,
    21000000 + sent % 977, 'drive-' || drive, 'value_' || register,
    case when random() < 0.999 then round(40 + 5 * sin(sent / 6e11 + drive) + random(), 2) end, 'ok'
from (select {MIDNIGHT} + tick * $every::bigint * 100000000 + drive * 3000000 as sent, drive, register
    from range($first::bigint, $end::bigint) ticks(tick), range({DRIVES}) drives(drive),
    range({REGISTERS}) registers(register));
update recorded set status = 'no reply', uncertainty_ns = null where value is null
"""


def made(database: Any, begin_s: int, end_s: int, every: int = 1) -> None:
    """Fill the table `recorded` with rows from `begin_s` to `end_s`, at 10 Hz divided by `every`."""
    database.execute("drop table if exists recorded")
    database.execute(TABLE)
    insert, update = MADE.split(";")
    database.execute(insert, {"first": begin_s * 10 // every, "end": end_s * 10 // every, "every": every})
    database.execute(update)
    database.execute(f"create or replace temp view told as select *, '{UNIT}' as unit from recorded")


def recorded(database: Any, folder: Path, after: int) -> None:
    """Write the rows of the table `recorded` as a segment, in batches of 0.2 s."""
    with SegmentWriter(folder / STEM, METADATA, every=1e9, after=after) as writer:
        for batch in rows_of(database, "from recorded order by time", {}):
            pieces: list[Any] = list(batch)
            for at in range(0, len(pieces), 620):
                writer.write(from_rows(pieces[at : at + 620]))


def make_day(folder: Path, hours: int) -> None:
    for name in ("rows", "tens"):
        (folder / name).mkdir(parents=True)
    with connect("300MB", folder / ".making") as database:
        made(database, 0, SEGMENT_S)
        recorded(database, folder, 0)
        size = (folder / "rows.00000001.arrows").stat().st_size
        print(
            f"a segment of {SEGMENT_S} s: {size / 1e6:.1f} MB as .arrows; compacted by a process with",
            end=" ",
        )
        # The compaction runs as the only child of a small process, which measures its greatest memory.
        words = [sys.executable, "-c", COMPACTED, str(folder)]
        print(subprocess.run(words, check=True, capture_output=True, text=True).stdout.strip())
        segments = hours * 3600 // SEGMENT_S
        for number in range(2, segments + 1):
            begin = (number - 1) * SEGMENT_S
            made(database, begin, begin + SEGMENT_S, 1 if begin < FULL_S else 10)
            span = MIDNIGHT + begin * SECOND, MIDNIGHT + (begin + SEGMENT_S) * SECOND
            for kind, query in (("tens", TENS.format("told")), ("rows", ROWS)):
                copy_out(database, query, folder / kind / file_name(number, number, *span), METADATA)
        # the last segment, which is not closed yet
        made(database, hours * 3600 - SEGMENT_S // 2, hours * 3600)
        recorded(database, folder, segments)
    compact(folder, 0)  # merges the summaries of each complete hour


def asked(ask: Callable[[], object]) -> tuple[float, float, float, float]:
    """Return a query's times in ms: first call, median and maximum of 20 more calls, CPU time per call."""
    found = []
    for _ in range(21):
        begun, used = time.perf_counter(), time.process_time()
        ask()
        found.append(((time.perf_counter() - begun) * 1000, (time.process_time() - used) * 1000))
    walls, cpus = zip(*found[1:], strict=True)
    return found[0][0], statistics.median(walls), max(walls), statistics.median(cpus)


def rows_read(history: History, *of: Any) -> int:
    return sum(map(len, history.read(*of)))


def questions(folder: Path, hours: int) -> Iterator[tuple[str, ...]]:
    begin, end = MIDNIGHT, MIDNIGHT + hours * 3600 * SECOND
    middle = begin + 1200 * SECOND
    one, four = "drive-7.value_3", [f"drive-7.value_{number}" for number in range(4)]
    all_drives = [f"drive-{number}.value_0" for number in range(DRIVES)]
    minute, hour = 60 * SECOND, 3600 * SECOND
    with History(folder) as history:
        asks: dict[str, Callable[[], object]] = {
            "1 series, all hours, 800 points": lambda: history.buckets(one, begin, end),
            "4 series, all hours, 800 points": lambda: history.buckets(four, begin, end),
            "31 drives, all hours, 300 points": lambda: history.buckets(all_drives, begin, end, 300),
            "1 series, 1 h, 1000 points, of rows": lambda: history.buckets(one, begin, begin + hour, 1000),
            "1 series, 1 min, 800 points, of rows": lambda: history.buckets(one, middle, middle + minute),
            "1 series, the last minute, 800 points": lambda: history.buckets(one, end - minute, end),
            "1 series, 1 min, all rows": lambda: rows_read(history, one, middle, middle + minute),
        }
        for what, ask in asks.items():
            yield (what, *(f"{ms:.1f}" for ms in asked(ask)))


def taking() -> None:
    """Print the cost of `HistoryWriter.take` for a batch of all series."""
    names = Names([f"drive-{number}" for number in range(DRIVES)]), Names(["value"] * REGISTERS)
    rows = GatheredRows(*names)
    for name, kind in COLUMNS.items():
        rows._gathered[name] += bytes(calcsize(kind) * DRIVES * REGISTERS)
    batch = Batch(rows, *names)
    found = []
    with TemporaryDirectory() as folder:
        writer = HistoryWriter(folder, METADATA)
        for _ in range(300):
            begun = time.perf_counter_ns()
            writer.take(batch)
            found.append((time.perf_counter_ns() - begun) / 1000)
            time.sleep(0.01)
        writer.close()
        assert writer.state().rows == 300 * len(batch)
    found.sort()
    print(
        f"take() of {len(batch)} rows: median {found[150]:.0f} us, p99 {found[297]:.0f}, most {found[-1]:.0f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("directory", type=Path)
    parser.add_argument("--hours", type=int, default=24)
    arguments = parser.parse_args()
    folder: Path = arguments.directory
    tables.heading(f"{arguments.hours} h of {DRIVES * REGISTERS} series at 10 Hz.")
    taking()
    if not (folder / "rows").exists():
        make_day(folder, arguments.hours)
    for kind in ("rows", "tens"):
        files = parquet_files(folder / kind)
        size = sum(file.path.stat().st_size for file in files)
        print(f"{kind}: {len(files)} files, {size / 1e6:.0f} MB")
    print(f"load now {os.getloadavg()[0]:.1f}; ms: the first time, median, longest and CPU of 20 more\n")
    columns = ("question", "first", "median", "longest", "CPU")
    tables.show(columns, list(questions(folder, arguments.hours)))
    print(f"\nthis process: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000:.0f} MB at most")
    _merge(folder, arguments.hours)
    print("\nwith the day's tens in one file\n")
    tables.show(columns, list(questions(folder, arguments.hours))[:3])


def _merge(folder: Path, hours: int) -> None:
    """Store one second of the next day's rows, then merge the day's ten-second summaries into one file."""
    with connect("100MB", folder / ".making") as database:
        made(database, 30 * 3600, 30 * 3600 + 1)
        number = hours * 3600 // SEGMENT_S + 5
        span = MIDNIGHT + 30 * 3600 * SECOND, MIDNIGHT + (30 * 3600 + 1) * SECOND
        for kind, query in (("tens", TENS.format("told")), ("rows", ROWS)):
            copy_out(database, query, folder / kind / file_name(number, number, *span), METADATA)
    compact(folder, 0)


if __name__ == "__main__":
    main()
