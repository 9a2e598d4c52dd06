"""Compact closed segments in a separate process: `python -m multidrop.history.compact FOLDER --below NUMBER`.

The process may be killed at any moment and started again. A new file gets its final name when it is complete
and on the disk; the files that it replaces are removed after that.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import closing, suppress
from itertools import groupby
from pathlib import Path
from typing import Any

from multidrop.history.database import (
    FINITE,
    Database,
    copy_out,
    insert,
    insert_units,
    kept_metadata,
    with_units,
)
from multidrop.history.folder import STEM, HistoryFile, file_name, parquet_files, widest
from multidrop.history.units import unit_texts_of
from multidrop.polling.batch import Rows
from multidrop.recording.arrows import ArrowsReader
from multidrop.recording.segments import FileLock, segments_of
from multidrop.whole_file import UNFINISHED, whole_file

MEMORY = "100MB"  # DuckDB's limit; the process takes about 80 MB besides
WITH_UNITS = """
create temp view with_units as select recorded.*, unit from recorded left join units using (drive, register)
"""
ROWS = "select * from with_units order by drive, time"
TENS = f"""
select to_timestamp(epoch_ns(time) // 10000000000 * 10) as time, drive, register, unit,
    count({FINITE}) as n, count(*) - count({FINITE}) as missed,
    min({FINITE}) as least, avg({FINITE}) as mean, max({FINITE}) as most,
    arg_max({FINITE}, monotonic_ns) as last
from {{}} group by all order by drive, register, time
"""
MERGED = "select * exclude filename from {} order by drive, register, time"
MERGED_ROWS = "select * exclude filename from {} order by drive, time"
MOST_MERGED = 200_000_000  # limit in bytes for the files of `rows/` that are merged into one
# limits of reported sentences and of their length, because a full pipe would block the process for ever
MOST_REPORTED, LONGEST_REPORTED = 100, 500


def main(words: list[str] | None = None) -> int:
    """Compact a folder, unless another process is compacting it; return 0 in both cases."""
    parser = argparse.ArgumentParser(prog="multidrop.history.compact", description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--below", type=int, required=True, help="segments with a lower number are closed")
    parser.add_argument("--merge-rows", action="store_true", help="for a folder of `multidrop hub`")
    arguments = parser.parse_args(words)
    folder: Path = arguments.folder
    try:
        lock = FileLock(folder / ".compact.lock")
    except BlockingIOError:
        return 0
    try:
        compact(folder, arguments.below, merge_rows=arguments.merge_rows)
    finally:
        lock.close()
    return 0


def compact(folder: Path, below: int, *, merge_rows: bool = False) -> None:
    """Convert the segment files with numbers less than `below` to Parquet, and merge files of summaries.

    A summary has the least, mean and greatest value of a register in ten seconds. The summaries of each past
    hour are merged into one file, and then those of each past day. With `merge_rows`, also merge the rows of
    each past hour, and compute missing summaries of files in `rows/`.
    """
    for name in ("rows", "tens", "damaged"):
        (folder / name).mkdir(exist_ok=True)
    clean(folder)
    with closing(Database(MEMORY, folder / ".spill")) as database:
        damage: list[str] = []
        for number, path in segments_of(folder / STEM):
            if number < below:
                found = _compact_segment(database, folder, number, path)
                for sentence in found[: max(0, MOST_REPORTED - len(damage))]:
                    print(sentence[:LONGEST_REPORTED], file=sys.stderr)
                damage += found
                _put_away(folder, path, bool(found))
        if len(damage) > MOST_REPORTED:
            print(f"{len(damage) - MOST_REPORTED} more damaged segments are not listed", file=sys.stderr)
        if merge_rows:
            rows = widest(parquet_files(folder / "rows"))
            # Compute missing summaries before rows are merged: a merged file does not show which of the files
            # in it had no summaries.
            _make_tens(database, folder, rows[:-1])
            for part in (part for run in finished(rows, 3600, set()) for part in _parts(run)):
                _merge(database, part, MERGED_ROWS, keeps_metadata=True)
        for seconds in (3600, 86400):
            tens = widest(parquet_files(folder / "tens"))
            for run in finished(tens, seconds, _without_tens(folder, tens)):
                _merge(database, run, MERGED, keeps_metadata=False)


def clean(folder: Path) -> None:
    """Remove what a killed compaction left behind: incomplete files, and files that newer files replace."""
    for directory in (folder / "rows", folder / "tens"):
        for path in directory.glob(UNFINISHED):
            path.unlink()
    shutil.rmtree(folder / ".spill", ignore_errors=True)
    have = {file.first for file in parquet_files(folder / "rows")}
    for number, path in segments_of(folder / STEM):
        if number in have:
            _put_away(folder, path, not _is_whole(path))
    for name in ("rows", "tens"):
        files = parquet_files(folder / name)
        for file in set(files) - set(widest(files)):
            file.path.unlink(missing_ok=True)


def _is_whole(path: Path) -> bool:
    with suppress(OSError, ValueError):
        reader = ArrowsReader(path)
        return not reader.truncated and sum(map(len, reader)) >= 0
    return False


def _put_away(folder: Path, path: Path, is_damaged: bool) -> None:
    """Remove a compacted segment, or move it to `damaged/` if it is damaged."""
    with suppress(FileNotFoundError):  # the recorder may have removed the old segment already
        if is_damaged and path.stat().st_size:
            path.replace(folder / "damaged" / path.name)
        else:
            path.unlink()


def _compact_segment(database: Database, folder: Path, number: int, path: Path) -> list[str]:
    """Convert a segment to Parquet, and return a sentence for each damage in it."""
    damage: list[str] = []
    with database.cursor() as cursor:
        metadata = {}
        try:
            reader = ArrowsReader(path)
            metadata = dict(reader.metadata)
            if reader.truncated:
                damage.append(f"{path} ends within a batch: its last {reader.truncated} bytes were skipped")
        except FileNotFoundError:  # the recorder has removed the old segment
            return []
        except ValueError as error:
            damage.append(str(error))
        else:
            insert(cursor, _readable(reader, damage))
            insert_units(cursor, unit_texts_of(metadata))
            cursor.execute(WITH_UNITS)
            bounds = "select min(epoch_ns(time)), max(epoch_ns(time)), count(*) from recorded"
            least, most, rows = cursor.execute(bounds).fetchone()
            if rows:
                name = file_name(number, number, least, most)
                _write(cursor, TENS.format("with_units"), folder / "tens" / name)
                _write(cursor, ROWS, folder / "rows" / name, metadata)
    return damage


def _readable(reader: ArrowsReader, damage: list[str]) -> Iterator[Rows]:
    """Yield the rows up to the first damaged batch, and append a description of the damage to `damage`."""
    try:
        yield from reader
    except ValueError as error:
        damage.append(str(error))


def _write(database: Any, query: str, path: Path, metadata: dict[str, Any] | None = None) -> None:
    """Write a query's rows into a Parquet file, which gets its final name when it is on the disk."""
    with whole_file(path) as part:
        copy_out(database, query, part, metadata)


def _without_tens(folder: Path, tens: list[HistoryFile]) -> set[int]:
    """Return the numbers of the segments whose ten-second summaries are in none of the files `tens`."""
    found = {number for number, _ in segments_of(folder / STEM)}
    found |= {file.first for file in parquet_files(folder / "rows")}
    return found - {number for file in tens for number in range(file.first, file.last + 1)}


def finished(files: list[HistoryFile], seconds: int, missing: set[int]) -> list[list[HistoryFile]]:
    """Return groups of files to merge: one group for each past period of `seconds`, an hour or a day.

    `missing` has the numbers of the segments without ten-second summaries. Groups with such a segment are
    omitted, because a merged file does not show which summaries are missing.
    """
    runs = [list(run) for _, run in groupby(files, key=lambda file: file.begin // seconds)]
    return [
        run
        for run in runs[:-1]
        if len(run) > 1 and not any(run[0].first <= number <= run[-1].last for number in missing)
    ]


def _merge(database: Database, run: list[HistoryFile], query: str, *, keeps_metadata: bool) -> None:
    """Merge these files into one in their folder. With `keeps_metadata`, it gets the last file's metadata."""
    begin, end = min(file.begin for file in run), max(file.end for file in run)
    path = run[0].path.with_name(file_name(run[0].first, run[-1].last, begin * 10**9, end * 10**9))
    with database.cursor() as cursor:
        metadata = kept_metadata(cursor, run[-1].path) if keeps_metadata else None
        _write(cursor, query.format(with_units(file.path for file in run)), path, metadata)
    for file in run:
        file.path.unlink(missing_ok=True)


def _parts(run: list[HistoryFile]) -> Iterator[list[HistoryFile]]:
    """Yield groups of two or more successive files with at most MOST_MERGED bytes in all."""
    part: list[HistoryFile] = []
    size = 0
    for file in run:
        own = file.path.stat().st_size
        if part and (file.first != part[-1].last + 1 or size + own > MOST_MERGED):
            if len(part) > 1:
                yield part
            part, size = [], 0
        part.append(file)
        size += own
    if len(part) > 1:
        yield part


def _make_tens(database: Database, folder: Path, rows: list[HistoryFile]) -> None:
    """Write the ten-second summaries into `tens/` for each of the files that lacks them."""
    missing = _without_tens(folder, widest(parquet_files(folder / "tens")))
    for file in rows:
        if file.first in missing:
            with database.cursor() as cursor:
                _write(cursor, TENS.format(with_units([file.path])), folder / "tens" / file.path.name)


def be_low() -> None:
    """Lower this process's priority, if the system allows it.

    A recorder may have real-time scheduling (SCHED_RR). This process would inherit it, and delay the polling.
    """
    with suppress(OSError, AttributeError):  # Windows and macOS lack sched_setscheduler
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    with suppress(OSError):
        os.nice(19)


if __name__ == "__main__":
    be_low()
    raise SystemExit(main())
