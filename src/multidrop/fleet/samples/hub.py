"""Hub: reads the stream of samples into a sink: Parquet files, or a database (postgres_sink.py).

The sink stores rows and their position in the stream in one commit. The hub uses no NATS consumer and
acknowledges no messages. After a failure it asks the sink for the stored position, and reads the stream from
there.

ParquetSink writes a folder that `History(folder)` and DuckDB can read:

| in the folder                           | content                                                   |
|-----------------------------------------|-----------------------------------------------------------|
| `rows/FIRST-LAST.BEGIN-END.parquet`     | all rows of the messages FIRST to LAST, by drive, time    |
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
import time
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from multidrop.fleet.errors import FleetError
from multidrop.fleet.samples.samples_stream import StreamInfo, StreamMessage, read_after, stream_info
from multidrop.fleet.servers.connections import ServerPath
from multidrop.printable import install_command
from multidrop.recording import FileLock
from multidrop.samples import ROWS, MessageError, SinkError, unpack
from multidrop.whole_file import UNFINISHED, whole_file

MOST_READ = 64  # limit of messages in one read from the stream
MOST_READ_BYTES = 8 << 20
MOST_ROWS = 1_000_000  # limit of rows in one commit; a million rows need 50 MB
MOST_BYTES = 256 << 20  # limit in bytes of messages and rows in one commit; a single read may exceed it
LOOKING_S = 0.2  # pause after a read without a new message
AGAIN_S = 1.0  # pause after a failure
BEHIND_S = 5.0  # how long to wait for a server that does not have the stream's newest messages yet
KEY = "multidrop"  # key in a Parquet file's metadata for multidrop's own entry, as in all recordings
SECOND_NS = 1_000_000_000
FORM = "%Y%m%dT%H%M%SZ"  # format of a time in a file's name
# If the file has no Arrow schema, `History` and DuckDB read dictionary-encoded columns as plain texts.
WRITTEN = {"compression": "zstd", "compression_level": 1, "store_schema": False}
OWN = {"rows", "tens", "damaged"}  # names of the folders in a hub's folder
_NAME = re.compile(r"(\d{8,})-(\d{8,})\.(\d{8}T\d{6}Z)-(\d{8}T\d{6}Z)\.parquet")
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
EVERY_S = 300.0  # pause between two merges of Parquet files
T = TypeVar("T")

_log = logging.getLogger("multidrop.fleet.samples.hub")


class SourceCheck:
    """Checks that no message of a gateway is missing or repeated.

    Each missing or repeated message is counted and logged as an error. It is counted once, even if the hub
    reads messages again after a failure. A gateway numbers its messages. With a new spool (the folder for
    messages on its disk) it starts again at 1. So the numbers are kept by gateway and id of the spool.
    """

    def __init__(self, last: Mapping[str, int]) -> None:
        self.last = dict(last)  # sequence number of the last message, by gateway and id of the spool
        self.alarms = 0
        self.missing = 0  # number of missing messages
        self.doubled = 0  # number of repeated messages, which are ignored
        # number of lost rows that the gateway has reported, by gateway and id of the spool
        self._lost: dict[str, int] = {}
        # sequence number of the last message counted as missing, by gateway and id of the spool
        self._missed: dict[str, int] = {}
        self._newest = 0  # stream position of the newest message
        self._known = 0  # stream position up to which errors were counted before the last `restart`

    def restart(self, last: Mapping[str, int]) -> None:
        """Check again the messages after these sequence numbers."""
        self.last, self._known = dict(last), self._newest

    def take(self, message: StreamMessage) -> bool:
        """Return True if the message is new and must be stored."""
        name = f"{message.gateway}.{message.log}"
        self._newest = max(self._newest, message.place)
        if message.sequence == 0:
            self.reject(
                message, f"message {message.place} of the stream, by {name}, has no number and is ignored"
            )
            return False
        before = self.last.get(name, 0)
        if message.sequence <= before:
            sentence = f"{name}: message {message.sequence} came again after {before} and is ignored"
            self.doubled += self.reject(message, sentence)
            return False
        first = max(before, self._missed.get(name, 0)) + 1
        if message.sequence > first:
            self.missing += message.sequence - first
            self._missed[name] = message.sequence - 1
            self.alarm(f"{name}: messages {first} to {message.sequence - 1} are missing")
        if message.place > self._known and message.lost > self._lost.get(name, 0):
            self.alarm(f"{name}: its spool has lost {message.lost} rows since its start")
        self._lost[name] = message.lost
        self.last[name] = message.sequence
        return True

    def reject(self, message: StreamMessage, sentence: str) -> bool:
        """Log and count that a message is ignored; return False if it was counted before."""
        if message.place <= self._known:
            return False
        self.alarm(sentence)
        return True

    def alarm(self, sentence: str) -> None:
        """Log and count an error that must never happen, such as a missing message."""
        self.alarms += 1
        _log.error("%s", sentence)


class NotThisHubs(SinkError):
    """The sink belongs to another stream or another hub. The hub does not retry."""


class StoredPosition(NamedTuple):
    """The position up to which a sink has stored the stream."""

    place: int  # stream position of the last stored message
    sources: Mapping[str, int]  # sequence number of the last stored message, by gateway and id of the spool


class Commit(NamedTuple):
    """Rows for a sink, and the stream position of their last message. The sink must store both together."""

    stream: str  # identity of the stream, which is the time of its creation
    first: int  # stream position of the commit's first message
    last: int
    sources: Mapping[str, int]
    tables: Sequence[Any]  # one pyarrow.Table per message, with the columns of message.ROWS; may be empty
    rows: int


class SampleSink(Protocol):
    """A store of rows, such as a database. The hub calls its methods in a thread; they raise SinkError."""

    def begin(self, stream: str) -> StoredPosition:
        """Return the stored position in this stream. Called at the start and after each failure."""

    def write(self, commit: Commit) -> None:
        """Store the whole commit; if that fails, leave the sink unchanged."""

    def close(self) -> None: ...


async def _on_thread(act: Callable[..., T], *arguments: Any) -> T:
    """Return act(*arguments), called in a thread. If cancelled, wait for the thread before raising."""
    done = asyncio.ensure_future(asyncio.to_thread(act, *arguments))
    try:
        return await asyncio.shield(done)
    except asyncio.CancelledError:
        await asyncio.wait([done])
        raise


class HubState(NamedTuple):
    """The hub's positions in the stream, its counts since the start, and its present problem (or None)."""

    place: int  # stream position of the last stored message
    behind: int  # messages in the stream that are not stored yet
    rows: int
    alarms: int
    missing: int
    doubled: int  # number of repeated messages, which are ignored
    trouble: str | None


class SampleHub:
    """Copies the rows of a fleet's sample stream into a sink, such as a database.

    It stores them in batches (commits): every `every` seconds, or as soon as a million rows are pending.
    """

    def __init__(self, path: ServerPath, sink: SampleSink, *, every: float = 10.0) -> None:
        self._path, self._sink, self._every = path, sink, every
        self._sources = SourceCheck({})
        self._place = self._end = self._rows = 0
        self._removed = 0  # the last message of the stream that was removed before it was stored
        self._trouble: str | None = None

    def state(self) -> HubState:
        found = self._sources
        counts = self._rows, found.alarms, found.missing, found.doubled
        return HubState(self._place, max(0, self._end - self._place), *counts, self._trouble)

    async def run(self, *, once: bool = False) -> None:
        """Read until cancelled, or with `once` until all messages that are in the stream now are stored.

        A failure of the stream or the sink is logged and retried each second. Raises NotThisHubs if the sink
        belongs to another stream or hub.
        """
        while True:
            try:
                await self._begin()
                self._note(None)
                while not (await self._commit(once) and once):
                    pass
            except NotThisHubs:
                raise
            except (FleetError, SinkError) as failure:
                if once:
                    raise
                self._note(str(failure))
                await asyncio.sleep(AGAIN_S)
            else:
                return

    async def _begin(self) -> None:
        found = await stream_info(self._path)
        kept = await _on_thread(self._sink.begin, found.created)
        self._stream, self._place = found.created, kept.place
        # if `first` is above `last`, the stream is empty now
        self._end = found.last if found.first <= found.last else kept.place
        self._sources.restart(kept.sources)
        self._check_end(found)
        first = max(kept.place, self._removed) + 1
        if found.first > first and found.last > kept.place:
            self._removed = found.first - 1
            gone = f"messages {first} to {self._removed}"
            self._sources.alarm(f"{gone} of the stream were removed before they were read")

    def _check_end(self, found: StreamInfo) -> None:
        if found.last < self._place:
            raise NotThisHubs(
                f"the stream ends at message {found.last}, but the hub has stored message {self._place}. "
                "The stream has lost messages: use a new folder or database"
            )

    async def _commit(self, once: bool) -> bool:
        """Collect messages, and store them in one commit.

        If `once` is set, return True when all messages up to the stream position `_end` are stored.
        """
        messages: list[StreamMessage] = []
        tables: list[Any] = []
        rows, size, ends = 0, 0, None
        is_end = False
        patient_until = time.monotonic() + BEHIND_S
        while rows < MOST_ROWS and size < MOST_BYTES and (ends is None or time.monotonic() < ends):
            place = messages[-1].place if messages else self._place
            found = await read_after(self._path, place, MOST_READ, MOST_READ_BYTES)
            if not found:
                if once and place >= self._end:
                    is_end = True
                    break
                if once and not messages and time.monotonic() > patient_until:
                    raise FleetError(f"messages {place + 1} to {self._end} of the stream cannot be read now")
                await asyncio.sleep(LOOKING_S)
                if not messages:
                    self._check_end(await stream_info(self._path))
                continue
            ends = ends or time.monotonic() + self._every
            messages += found
            self._end = max(self._end, found[-1].place)
            made = await _on_thread(self._tables, found)
            tables += made
            rows += sum(map(len, made))
            size += sum(len(one.data) for one in found) + sum(one.get_total_buffer_size() for one in made)
        if messages:
            commit = Commit(
                self._stream, self._place + 1, messages[-1].place, dict(self._sources.last), tables, rows
            )
            await _on_thread(self._sink.write, commit)
            self._place = commit.last
            self._rows += rows
        return is_end

    def _tables(self, messages: Sequence[StreamMessage]) -> list[Any]:
        """Return a table of rows for each message that is new and valid."""
        found = []
        for message in messages:
            if self._sources.take(message):
                try:
                    found.append(unpack(message.data))
                except MessageError as error:
                    name = f"{message.gateway}.{message.log}"
                    self._sources.reject(message, f"{name}: message {message.sequence} is ignored: {error}")
        return found

    def _note(self, trouble: str | None) -> None:
        if trouble and trouble != self._trouble:
            _log.error("samples are not stored: %s", trouble)
        if self._trouble and not trouble:
            _log.warning("samples are stored again, after message %d", self._place)
        self._trouble = trouble


# ---- Parquet files ----


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
