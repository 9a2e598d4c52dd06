"""Samples as Parquet files in a folder that `History(folder)` and DuckDB can read.

| in the folder                           | content                                                   |
|-----------------------------------------|-----------------------------------------------------------|
| `rows/FIRST-LAST.BEGIN-END.parquet`     | all rows of these messages of the stream, by drive, time  |
| `tens/FIRST-LAST.BEGIN-END.parquet`     | the same messages, one row per ten seconds of a register  |
| `.hub.lock`                             | locked by the process that writes here                    |

FIRST and LAST are stream positions. BEGIN and END are UTC and enclose all times. A file is renamed to its
final name once it is synced to the disk. This commits its rows, and LAST as the stored position. The newest
file has the number of each gateway's last message, and must be kept.
"""

from __future__ import annotations

import asyncio
import importlib.util
import json
import logging
import os
import re
import sys
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from multidrop.fleet.samples.hub import Commit, NotThisHubs, StoredPosition
from multidrop.printable import install_command
from multidrop.recording import FileLock
from multidrop.samples import ROWS, SinkError
from multidrop.whole_file import UNFINISHED, whole_file

KEY = "multidrop"  # key in a Parquet file's metadata for multidrop's own entry, as in all recordings
SECOND_NS = 1_000_000_000
FORM = "%Y%m%dT%H%M%SZ"  # format of a time in a file's name
# If the file has no Arrow schema, `History` and DuckDB read dictionary-encoded columns as plain texts.
WRITTEN = {"compression": "zstd", "compression_level": 1, "store_schema": False}
OWN = {"rows", "tens", "damaged"}  # names of the folders in a hub's folder
_NAME = re.compile(r"(\d{8,})-(\d{8,})\.(\d{8}T\d{6}Z)-(\d{8}T\d{6}Z)\.parquet")
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
EVERY_S = 300.0  # pause between two merges of Parquet files

_log = logging.getLogger("multidrop.fleet.samples.hub")


class ParquetSink:
    """Writes each of the hub's commits as one Parquet file.

    Raises SinkError if the folder cannot be written, or belongs to another hub.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)
        self._rows = self.folder / "rows"
        try:
            self._rows.mkdir(parents=True, exist_ok=True)
            self._lock = FileLock(self.folder / ".hub.lock")
        except BlockingIOError:
            raise NotThisHubs(f"another hub writes into {self.folder}") from None
        except OSError as failure:
            raise SinkError(f"the folder {self.folder} cannot be written: {failure.strerror}") from failure
        others = sorted(
            one.name for one in self.folder.iterdir() if one.name not in OWN and one.name[0] != "."
        )
        if others:
            self.close()
            raise NotThisHubs(
                f"{self.folder} holds {others[0]!r}, not written by `multidrop hub`: name an empty folder"
            )

    def close(self) -> None:
        self._lock.close()

    def begin(self, stream: str) -> StoredPosition:
        """Return the position that the newest file contains, and remove unfinished files."""
        try:
            for part in self._rows.glob(UNFINISHED):
                part.unlink()
            newest = max(self._files(), default=None)
        except OSError as failure:
            raise SinkError(f"the folder {self.folder} cannot be written: {failure.strerror}") from failure
        if newest is None:
            return StoredPosition(0, {})
        last, path = newest
        found = _metadata(path).get("hub")
        if not isinstance(found, dict) or not isinstance(found.get("sources"), dict):
            raise NotThisHubs(f"{path} was not written by `multidrop hub`: name an empty folder")
        if found.get("stream") != stream:
            raise NotThisHubs(
                f"{self.folder} holds samples of a stream created at {found.get('stream')}, but the present "
                f"stream was created at {stream}: name another folder"
            )
        return StoredPosition(last, {str(name): int(number) for name, number in found["sources"].items()})

    def _files(self) -> list[tuple[int, Path]]:
        found = [(_NAME.fullmatch(path.name), path) for path in self._rows.iterdir()]
        return [(int(match[2]), path) for match, path in found if match]

    def write(self, commit: Commit) -> None:
        """Write the rows into a temporary file, sync it to the disk, and rename it."""
        table = _joined(commit)
        path = self._rows / _name(commit, table)
        try:
            with whole_file(path) as part, pq.ParquetWriter(part, table.schema, **WRITTEN) as writer:
                writer.add_key_value_metadata({KEY: json.dumps(_about(commit))})
                writer.write_table(table)
        except OSError as failure:
            raise SinkError(f"{path} cannot be written: {failure.strerror or failure}") from failure


def _joined(commit: Commit) -> Any:
    """Return all rows of the commit, sorted by drive and time."""
    if not commit.rows:
        return ROWS.empty_table()
    table = pa.concat_tables(commit.tables).unify_dictionaries().combine_chunks()
    drives = table.column("drive").chunk(0)
    ranks = pc.rank(drives.dictionary).cast(pa.int32()).take(drives.indices)
    by_time = pc.array_sort_indices(table.column("time").chunk(0).cast(pa.int64()))
    # sorted by drive and time, because the second sort is stable
    return table.take(by_time.take(pc.array_sort_indices(ranks.take(by_time))))


def _about(commit: Commit) -> dict[str, Any]:
    return {"drives": {}, "hub": {"stream": commit.stream, "sources": commit.sources}}


def _name(commit: Commit, table: Any) -> str:
    times = pc.min_max(table.column("time").cast(pa.int64())).as_py()
    begin, end = (times["min"] or 0) // SECOND_NS, -(-(times["max"] or 0) // SECOND_NS)
    return f"{commit.first:08d}-{commit.last:08d}.{_text(begin)}-{_text(end)}.parquet"


def _text(second: int) -> str:
    return f"{_EPOCH + timedelta(seconds=second):{FORM}}"


def _metadata(path: Path) -> dict[str, Any]:
    try:
        found = json.loads((pq.read_metadata(path).metadata or {}).get(KEY.encode(), b"{}"))
    except (pa.ArrowException, ValueError, OSError) as error:
        raise SinkError(f"{path} cannot be read: {error}") from error
    return found if isinstance(found, dict) else {}


async def compact_for_ever(folder: Path, every: float = EVERY_S) -> None:
    """Merge the files of past hours and create the files in `tens` for plots, until cancelled; needs duckdb.

    A child process of low priority does the work. It may be killed at any time.
    """
    if importlib.util.find_spec("duckdb") is None:
        _log.warning("files are not merged, because duckdb is not installed: %s", install_command("history"))
        await asyncio.Event().wait()
    words = ["-m", "multidrop.history.compact", str(folder), "--below", "0", "--merge-rows"]
    while True:
        await asyncio.sleep(every)
        try:
            await _compact(words)
        except Exception as failure:  # such as an error when the process starts; the loop tries again
            _log.error("merging files failed; retrying", exc_info=failure)


async def _compact(words: Sequence[str]) -> None:
    child = await asyncio.create_subprocess_exec(
        sys.executable,
        *words,
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.PIPE,
    )
    try:
        _, said = await child.communicate()
    except asyncio.CancelledError:
        child.kill()
        await child.wait()
        raise
    if child.returncode:
        last = said.decode("utf-8", "replace").strip().splitlines()[-1:]
        _log.error("compaction ended with status %d: %s", child.returncode, *(last or ["no message"]))
