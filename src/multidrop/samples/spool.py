"""Spool: a poller's rows on a gateway's disk until a receiver has them, one file per message.

| in the folder         | content                                                              |
|-----------------------|----------------------------------------------------------------------|
| `spool.json`          | the gateway's name, and the id of this folder's log                  |
| `NUMBER-ROWS.arrows`  | a message: its sequence number in the log, and its number of rows    |
| `NUMBER-ROWS.damaged` | the newest message of an earlier run, if the disk stored only a part |
| `.spool.lock`         | locked by the process that writes here                               |

A log is the sequence of all messages that were written into one folder. Its id is created with the folder, so
a new disk starts a new log. A file is synced to the disk under a temporary name and then renamed. The newest
message is never removed, because the next message's number is one above the number of the newest.
"""

from __future__ import annotations

import json
import logging
import os
import re
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any, NamedTuple

from multidrop.polling.batch import Batch
from multidrop.recording import FileLock
from multidrop.samples.message import MessageError, Packed, PolledUnits, RowBuffer, unpack
from multidrop.whole_file import sync_to_disk, whole_file

FORMAT = "multidrop spool 1"
HEAD = "spool.json"
_NAME = re.compile(r"(\d{12,})-(\d+)\.(arrows|damaged)")
_TEMPORARY = re.compile(r"\..+\.tmp")
ENOUGH_ROWS = 1 << 14  # a message is written when this many rows wait in memory
ENOUGH_S = 1.0  # a message is written when its oldest row has waited this long
MOST_WAITING = 1_000_000  # limit of rows that wait in memory while the disk is slow or full: 38 MB
# Limit of the ranges in `_undecided`. If there are more, ranges are joined in pairs, so the limit is even.
MOST_UNDECIDED = 10_000
AGAIN_S = 1.0  # pause after a disk error
LOG_S = 60.0  # time between log lines about lost rows
ENDING_S = 10.0  # time limit of `close` for writing to the disk
_log = logging.getLogger("multidrop.samples.spool")


class SpoolError(ValueError):
    """A folder that is not a spool, belongs to another gateway, or cannot be written."""


class StoredMessage(NamedTuple):
    """A message in the spool's folder: its sequence number, rows, size in bytes, and file."""

    sequence: int
    rows: int
    size: int
    path: Path


class SpoolFolder:
    """The folder of a spool, with one file per message. Only one process at a time may use it.

    Raises SpoolError if the folder holds other files, belongs to another gateway, is in use by another
    process, or cannot be written.
    """

    def __init__(self, path: Path, gateway: str) -> None:
        self.path = path
        # a sentence about the newest message if only a part of the message is on the disk
        self.damage: str | None = None
        with ExitStack() as stack:
            try:
                path.mkdir(parents=True, exist_ok=True)
                lock = stack.enter_context(closing(FileLock(path / ".spool.lock")))
                self.log = self._head({"format": FORMAT, "gateway": gateway})
                self.messages = self._listed()
                self._check_newest()
            except BlockingIOError:
                raise SpoolError(f"the spool {path} is in use by another process") from None
            except OSError as failure:
                raise SpoolError(f"the spool {path} cannot be written: {failure.strerror}") from failure
            stack.pop_all()
        self.close = lock.close

    def _head(self, wanted: dict[str, str]) -> str:
        """Return the id of the folder's log from `spool.json`; create this file in an empty folder."""
        path = self.path / HEAD
        if not path.exists():
            others = sorted(one.name for one in self.path.iterdir() if not one.name.startswith("."))
            if others:
                raise SpoolError(
                    f"{self.path} is not a spool: it holds {others[0]!r} and no {HEAD}; name an empty folder"
                )
            log = secrets.token_hex(8)
            with whole_file(path) as part:
                part.write_text(json.dumps({**wanted, "log": log}), "utf-8")
            return log
        found = _parsed(path)
        if found.get("format") != FORMAT or not re.fullmatch(r"[0-9a-f]{16}", str(found.get("log"))):
            raise SpoolError(
                f"{path} is damaged, or from another version of multidrop; expected format {FORMAT!r}"
            )
        if found.get("gateway") != wanted["gateway"]:
            raise SpoolError(
                f"{self.path} is the spool of gateway {found.get('gateway')!r}, not of {wanted['gateway']!r}"
            )
        return str(found["log"])

    def _listed(self) -> dict[int, StoredMessage]:
        """Return the folder's messages by sequence number. Remove unfinished files of a killed process."""
        found = {}
        self.newest = 0
        for path in self.path.iterdir():
            if _TEMPORARY.fullmatch(path.name):
                path.unlink()
            elif match := _NAME.fullmatch(path.name):
                number = int(match[1])
                # damaged messages count too, so that their numbers are not reused
                self.newest = max(self.newest, number)
                if match[3] == "arrows":
                    found[number] = StoredMessage(number, int(match[2]), path.stat().st_size, path)
        return dict(sorted(found.items()))

    def _check_newest(self) -> None:
        """Rename the newest message to `.damaged` if it is incomplete."""
        newest = self.messages.get(self.newest)
        if newest and (mistake := _mistake(newest)):
            del self.messages[self.newest]
            newest.path.rename(newest.path.with_suffix(".damaged"))
            sync_to_disk(self.path)
            self.damage = f"{newest.path} is damaged, and was put aside with {newest.rows} rows: {mistake}"

    def write(self, data: bytes, rows: int) -> StoredMessage:
        """Write the next message and sync it to the disk. After an OSError the call may be repeated."""
        number = self.newest + 1
        path = self.path / f"{number:012d}-{rows}.arrows"
        with whole_file(path) as part:
            part.write_bytes(data)
        return StoredMessage(number, rows, len(data), path)

    def add(self, stored: StoredMessage) -> None:
        self.messages[stored.sequence] = stored
        self.newest = stored.sequence


def _mistake(message: StoredMessage) -> str | None:
    try:
        found = len(unpack(message.path.read_bytes()))
    except MessageError as error:
        return str(error)
    return None if found == message.rows else f"it has {found} rows"


def _parsed(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text("utf-8"))
    except ValueError:
        found = None
    return found if isinstance(found, dict) else {}


class RemovedMessages(NamedTuple):
    """Successive messages that the spool has removed, and the number of their rows."""

    first: int
    last: int
    rows: int

    def joined(self, later: RemovedMessages) -> RemovedMessages:
        return RemovedMessages(self.first, later.last, self.rows + later.rows)


class SpoolState(NamedTuple):
    """The state of a spool. Counts of rows start when the spool is opened."""

    log: str  # id of the log, from `spool.json`
    written: int  # number of rows that reached the disk
    lost: int  # number of rows dropped because the disk is slow, or removed from it before they were sent
    waiting: int  # rows that wait in memory
    oldest: int  # sequence number of the oldest message; 0 if there is none
    newest: int
    acknowledged: int | None  # the receiver has all messages up to this sequence number; None: not known yet
    stored: int  # size of all stored messages in bytes
    trouble: str | None  # the disk's present error; None if writing works


class Spool:
    """Keeps rows in a folder: `poller.on_batch(spool.append)`.

    The waiting rows are written as one message, in its own file, when 16384 rows wait or the oldest is a
    second old. If all files together exceed `most` bytes, the oldest are removed; rows that were not sent are
    counted as lost and logged. If `keep_sent` is False, each new message also removes the oldest messages
    that were sent. A full or slow disk does not delay the poller: up to a million rows wait in memory,
    further rows are lost and counted, and writing is retried each second.

    Raises SpoolError as `SpoolFolder` does.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        gateway: str,
        *,
        most: int = 10_000_000_000,
        units: PolledUnits | None = None,
        keep_sent: bool = True,
    ) -> None:
        self.gateway = gateway
        self._folder = SpoolFolder(Path(folder), gateway)
        self.log = self._folder.log
        # called in the spool's thread for each written message
        self.on_message: Callable[[], object] = lambda: None
        self._most = most
        self._units = units or PolledUnits()
        self._keep_sent = keep_sent
        self._stored = sum(message.size for message in self._folder.messages.values())
        self._changing = threading.Condition()
        self._waiting: deque[RowBuffer] = deque()
        self._packed: deque[Packed] = deque()  # messages to write; used only by the spool's thread
        self._first_s: float | None = None  # arrival time of the oldest waiting row
        self._taken = self._written = self._lost = 0
        self._acknowledged: int | None = None
        self._missing: Sequence[tuple[int, int]] = ()
        # Messages that were removed before the receiver had confirmed them. `acknowledge` later finds out
        # whether they were received or lost.
        self._undecided: list[RemovedMessages] = []
        self._trouble: str | None = None
        self._logged_s: float | None = None
        self._wanted = 0  # `sync` waits until this many of the appended rows are on the disk
        self._over = False
        if self._folder.damage:
            _log.error("%s", self._folder.damage)
        self._thread = threading.Thread(target=self._run, name="multidrop spool", daemon=True)
        self._thread.start()

    # ---- for the poller: any thread ----

    def append(self, batch: Batch) -> None:
        """Copy the rows; the spool's thread writes them later. This never waits for the disk."""
        columns = batch.columns()
        with self._changing:
            rows = len(columns.time)
            if self._over or self._in_memory() + rows > MOST_WAITING:
                self._lose(rows, "the spool is closed" if self._over else "the disk is too slow")
                return
            if not self._waiting or not self._waiting[-1].add(columns):
                self._waiting.append(RowBuffer())
                self._waiting[-1].add(columns)
            self._taken += rows
            if self._first_s is None or self._waiting_rows() >= ENOUGH_ROWS:
                self._first_s = self._first_s or time.monotonic()
                self._changing.notify_all()

    def sync(self, timeout: float | None = None) -> bool:
        """Wait until all rows appended so far are on the disk; return False after `timeout` seconds."""
        with self._changing:
            wanted = self._wanted = self._taken
            self._changing.notify_all()
            return self._changing.wait_for(lambda: self._written >= wanted, timeout)

    def is_alive(self) -> bool:
        return self._thread.is_alive()

    def state(self) -> SpoolState:
        with self._changing:
            oldest = next(iter(self._folder.messages), 0)
            counts = self._written, self._lost, self._in_memory(), oldest, self._folder.newest
            return SpoolState(self.log, *counts, self._acknowledged, self._stored, self._trouble)

    def close(self) -> None:
        """Write the waiting rows and stop the thread; wait at most 10 s for the disk."""
        with self._changing:
            self._over = True
            self._changing.notify_all()
        self._thread.join(ENDING_S)
        if not self._thread.is_alive():
            self._folder.close()

    # ---- for the forwarder: any thread ----

    def following(self, sequence: int) -> StoredMessage | None:
        """Return the stored message that follows this sequence number; None if there is none."""
        with self._changing:
            messages = self._folder.messages
            first = max(sequence + 1, next(iter(messages), sequence + 1))
            return next(
                (messages[at] for at in range(first, self._folder.newest + 1) if at in messages), None
            )

    def stored(self, sequence: int) -> StoredMessage | None:
        """Return the message with this sequence number; None if it was removed."""
        with self._changing:
            return self._folder.messages.get(sequence)

    def acknowledge(self, sequence: int, missing: Sequence[tuple[int, int]] = ()) -> None:
        """Note that the receiver has all messages up to this sequence number, except those in `missing`.

        `missing` has ranges of sequence numbers, each as its first and its last number.
        """
        with self._changing:
            self._acknowledged, self._missing = sequence, missing
            for removed in self._undecided:
                if not self._are_sent(removed.first, removed.last):
                    self._lose(removed.rows, f"the spool is full at {self._most} bytes")
            self._undecided.clear()

    def _is_sent(self, sequence: int) -> bool:
        return self._are_sent(sequence, sequence)

    def _are_sent(self, first: int, last: int) -> bool:
        with self._changing:
            if self._acknowledged is None or last > self._acknowledged:
                return False
            return not any(begin <= last and first <= end for begin, end in self._missing)

    # ---- for the spool's own thread ----

    def _run(self) -> None:
        is_over = False
        while not is_over:
            try:
                is_over = self._write_due_rows()
            except Exception as failure:  # such as MemoryError; the rows that wait are written later
                _log.error("writing the spool %s failed; retrying", self._folder.path, exc_info=failure)
                time.sleep(AGAIN_S)

    def _write_due_rows(self) -> bool:
        """Wait until rows are due, and write them; return True if the thread must end."""
        with self._changing:
            if not self._is_due():
                self._changing.wait(self._patience())
            if self._over and not (self._waiting or self._packed):
                return True
            if not self._is_due():
                return False
            waiting, self._waiting, self._first_s = self._waiting, deque(), None
        for buffer in waiting:
            self._pack(buffer)
        while self._packed:
            if not self._write(self._packed[0]):
                break
            self._packed.popleft()
        return bool(self._packed) and self._pause()

    def _pack(self, buffer: RowBuffer) -> None:
        try:
            self._packed += list(buffer.messages(units=self._units))  # all messages or none
        except Exception:  # a bug here must not end the thread
            _log.exception("%d rows could not be packed", buffer.rows)
            with self._changing:
                self._taken -= buffer.rows
                self._lose(buffer.rows, "they could not be packed into a message")

    def _is_due(self) -> bool:
        if self._over or self._packed or (self._waiting and self._wanted > self._written):
            return True
        return self._waiting_rows() >= ENOUGH_ROWS or self._patience() == 0

    def _patience(self) -> float | None:
        if self._first_s is None:
            return None
        return max(0.0, self._first_s + ENOUGH_S - time.monotonic())

    def _pause(self) -> bool:
        """Wait before a retry. If the spool is closing, count the waiting rows as lost, and return True."""
        with self._changing:
            if not self._over:
                self._changing.wait_for(lambda: self._over, AGAIN_S)
                return False
            self._lose(self._in_memory(), self._trouble or "the spool ends")
            return True

    def _write(self, packed: Packed) -> bool:
        try:
            stored = self._folder.write(packed.data, packed.rows)
        except Exception as failure:  # polling must continue whatever fails here
            self._note(str(failure))
            return False
        with self._changing:
            self._folder.add(stored)
            self._written += packed.rows
            self._stored += stored.size
            self._changing.notify_all()
        self._note(None)
        self._make_room()
        self.on_message()
        return True

    def _note(self, trouble: str | None) -> None:
        if trouble and not self._trouble:
            _log.error("the spool %s cannot be written: %s", self._folder.path, trouble)
        if self._trouble and not trouble:
            _log.warning(
                "the spool %s is written again; %d rows were lost so far", self._folder.path, self._lost
            )
        self._trouble = trouble
        if trouble:
            self._remove_acknowledged()

    def _remove_acknowledged(self) -> None:
        """Remove the oldest message if the receiver has it, because the disk may be full."""
        oldest = self.following(0)
        if oldest and self._is_sent(oldest.sequence) and oldest.sequence < self._folder.newest:
            self._remove(oldest)

    def _make_room(self) -> None:
        while len(self._folder.messages) > 1:
            oldest = self.following(0)
            is_excess = self._stored > self._most
            if oldest is None or not (is_excess or self._is_done(oldest)) or not self._remove(oldest):
                return

    def _is_done(self, message: StoredMessage) -> bool:
        return not self._keep_sent and self._is_sent(message.sequence)

    def _remove(self, message: StoredMessage) -> bool:
        try:
            # called without the lock, so that a disk that hangs does not delay `append`
            message.path.unlink(missing_ok=True)
        except OSError as failure:
            _log.error("the spool cannot remove %s: %s", message.path, failure.strerror)
            return False
        with self._changing:
            del self._folder.messages[message.sequence]
            self._stored -= message.size
            if self._acknowledged is None:
                self._undecided.append(RemovedMessages(message.sequence, message.sequence, message.rows))
                if len(self._undecided) == MOST_UNDECIDED:
                    pairs = zip(self._undecided[::2], self._undecided[1::2], strict=True)
                    self._undecided = [one.joined(later) for one, later in pairs]
            elif not self._is_sent(message.sequence):
                self._lose(message.rows, f"the spool is full at {self._most} bytes")
        return True

    def _lose(self, rows: int, reason: str) -> None:
        self._lost += rows
        now = time.monotonic()
        if rows and (self._logged_s is None or now - self._logged_s >= LOG_S):
            _log.error("%s: %d rows of the spool %s were lost so far", reason, self._lost, self._folder.path)
            self._logged_s = now

    def _waiting_rows(self) -> int:
        return sum(buffer.rows for buffer in self._waiting)

    def _in_memory(self) -> int:
        return self._taken - self._written
