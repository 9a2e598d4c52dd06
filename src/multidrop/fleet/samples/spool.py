"""Spool: rows of a poller on a gateway's disk, until they are where they are kept."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from multidrop import Batch
from multidrop.fleet.samples.message import Packed, RowBuffer
from multidrop.fleet.samples.polled_units import PolledUnits
from multidrop.fleet.samples.spool_folder import SpoolFolder, StoredMessage
from multidrop.fleet.servers.names import checked_name

ENOUGH_ROWS = 1 << 14  # for a message at once
ENOUGH_S = 1.0  # since the first row, for a message of fewer
MOST_WAITING = 1_000_000  # rows in memory, for a disk that is slow or full: 38 MB
AGAIN_S = 1.0  # between attempts at a disk that failed
TELLING_S = 60.0  # between sentences about rows that are lost
ENDING_S = 10.0  # for which `close` waits for the disk

_log = logging.getLogger("multidrop.fleet.samples.spool")


class SpoolState(NamedTuple):
    """The state of a spool; rows and bytes count since it was opened, but for those stored."""

    log: str  # id
    written: int  # rows that reached the disk
    lost: int  # rows that did not, or were removed before they were forwarded
    waiting: int  # rows in memory
    oldest: int  # sequence of the oldest message, 0 without one
    newest: int
    acknowledged: int | None  # sequence up to which the stream has all; None: it was not asked yet
    stored: int  # bytes
    trouble: str | None  # with the disk, now


class Spool:
    """Keeps rows in a folder: `poller.on_batch(spool.append)`.

    Rows become a message, a file of its own, when 16384 are there or the first is a second old. All files
    together take `most` bytes: then the oldest are removed, forwarded or not; those that were not are
    counted as lost, and told once. A disk that is full or slow holds nobody up: a million rows wait in
    memory, further ones are lost and counted, and it is tried again each second.

    Raises SpoolError, and ValueError for a name that no subject may have.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        gateway: str,
        *,
        fleet: str = "fleet",
        most: int = 10_000_000_000,
        units: PolledUnits | None = None,
    ) -> None:
        self.gateway = checked_name("gateway", gateway)
        self._folder = SpoolFolder(Path(folder), gateway, checked_name("fleet", fleet))
        self.log = self._folder.log
        self.on_message: Callable[[], object] = lambda: None  # called on the spool's thread after each
        self._most = most
        self._units = units or PolledUnits()
        self._stored = sum(message.size for message in self._folder.messages.values())
        self._changing = threading.Condition()
        self._waiting: deque[RowBuffer] = deque()
        self._packed: deque[Packed] = deque()  # begun: with the thread alone
        self._first_s: float | None = None  # when the oldest waiting row came
        self._taken = self._written = self._lost = 0
        self._acknowledged: int | None = None
        self._undecided: dict[int, int] = {}  # removed before the stream was asked: rows by sequence
        self._trouble: str | None = None
        self._told_s: float | None = None
        self._wanted = 0  # rows that `sync` waits for
        self._over = False
        if self._folder.damage:
            _log.error("%s", self._folder.damage)
        self._thread = threading.Thread(target=self._run, name="multidrop spool", daemon=True)
        self._thread.start()

    # ---- for the poller: any thread ----

    def append(self, batch: Batch) -> None:
        """Copy the rows for the thread to write. It takes microseconds, and raises nothing for the disk.

        If they cannot be copied, as for want of memory, they are lost and counted; later ones are taken.
        """
        try:
            self._append(batch)
        except Exception as failure:
            with self._changing:
                self._lose(len(batch), f"{type(failure).__name__}: {failure}")

    def _append(self, batch: Batch) -> None:
        columns = batch.columns()
        with self._changing:
            rows = len(columns.time)
            if self._over or self._in_memory() + rows > MOST_WAITING:
                self._lose(rows, "the disk does not keep up")
                return
            if not self._waiting or not self._waiting[-1].add(columns):
                self._waiting.append(RowBuffer())
                self._waiting[-1].add(columns)
            self._taken += rows
            if self._first_s is None or self._waiting_rows() >= ENOUGH_ROWS:
                self._first_s = self._first_s or time.monotonic()
                self._changing.notify_all()

    def sync(self, timeout: float | None = None) -> bool:
        """Wait until all rows that were taken before are on the disk; False when the time is over."""
        with self._changing:
            wanted = self._wanted = self._taken
            self._changing.notify_all()
            return self._changing.wait_for(lambda: self._written >= wanted, timeout)

    def is_alive(self) -> bool:
        """True until the thread that writes has ended."""
        return self._thread.is_alive()

    def state(self) -> SpoolState:
        """Return how much is where, and what is wrong."""
        with self._changing:
            oldest = next(iter(self._folder.messages), 0)
            counts = self._written, self._lost, self._in_memory(), oldest, self._folder.newest
            return SpoolState(self.log, *counts, self._acknowledged, self._stored, self._trouble)

    def close(self) -> None:
        """Write what waits, and end; a disk that does not answer is waited for 10 s at most."""
        with self._changing:
            self._over = True
            self._changing.notify_all()
        self._thread.join(ENDING_S)
        if not self._thread.is_alive():
            self._folder.close()

    # ---- for the forwarder: any thread ----

    def following(self, sequence: int) -> StoredMessage | None:
        """Return the first message behind this sequence."""
        with self._changing:
            messages = self._folder.messages
            first = max(sequence + 1, next(iter(messages), sequence + 1))
            return next(
                (messages[at] for at in range(first, self._folder.newest + 1) if at in messages), None
            )

    def stored(self, sequence: int) -> StoredMessage | None:
        """Return this message, where it is still kept."""
        with self._changing:
            return self._folder.messages.get(sequence)

    def acknowledge(self, sequence: int) -> None:
        """Note that the stream has all messages up to this one: they are the first to be removed."""
        with self._changing:
            self._acknowledged = sequence
            for removed, rows in self._undecided.items():
                if removed > sequence:
                    self._lose(rows, f"the spool is full at {self._most} bytes")
            self._undecided.clear()

    # ---- the thread ----

    def _run(self) -> None:
        is_over = False
        while not is_over:
            try:
                is_over = self._write_what_is_due()
            except Exception as failure:  # such as a want of memory: it goes on with what waits
                _log.error("the spool %s is interrupted", self._folder.path, exc_info=failure)
                time.sleep(AGAIN_S)

    def _write_what_is_due(self) -> bool:
        """Wait until rows are to be written, and write them; True when the spool has ended."""
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
            self._packed += buffer.messages(units=self._units)
        except Exception:  # a mistake of ours must not end the thread
            _log.exception("%d rows could not be packed", buffer.rows)
            with self._changing:
                self._taken -= buffer.rows
                self._lose(buffer.rows, "they could not be packed")

    def _is_due(self) -> bool:
        if self._over or self._packed or (self._waiting and self._wanted > self._written):
            return True
        return self._waiting_rows() >= ENOUGH_ROWS or self._patience() == 0

    def _patience(self) -> float | None:
        if self._first_s is None:
            return None
        return max(0.0, self._first_s + ENOUGH_S - time.monotonic())

    def _pause(self) -> bool:
        """Wait before the disk is tried again; True when the spool ends, and what is left is lost."""
        with self._changing:
            if not self._over:
                self._changing.wait_for(lambda: self._over, AGAIN_S)
                return False
            self._lose(self._in_memory(), self._trouble or "the spool ends")
            return True

    def _write(self, packed: Packed) -> bool:
        try:
            stored = self._folder.write(packed.data, packed.rows)
        except Exception as failure:  # whatever it is, polling must go on
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
            _log.error("the spool %s takes nothing: %s", self._folder.path, trouble)
        if self._trouble and not trouble:
            _log.warning("the spool %s takes rows again; %d were lost so far", self._folder.path, self._lost)
        self._trouble = trouble
        if trouble:
            self._remove_acknowledged()

    def _remove_acknowledged(self) -> None:
        """Remove what the stream has: it is kept for convenience alone, and the disk has no room."""
        oldest = self.following(0)
        if oldest and oldest.sequence <= (self._acknowledged or 0) and oldest.sequence < self._folder.newest:
            self._remove(oldest)

    def _make_room(self) -> None:
        while self._stored > self._most and len(self._folder.messages) > 1:
            oldest = self.following(0)
            if oldest is None or not self._remove(oldest):
                return

    def _remove(self, message: StoredMessage) -> bool:
        with self._changing:
            try:
                self._folder.remove(message)
            except OSError as failure:
                _log.error("the spool cannot remove %s: %s", message.path, failure.strerror)
                return False
            self._stored -= message.size
            if self._acknowledged is None:
                self._undecided[message.sequence] = message.rows
            elif message.sequence > self._acknowledged:
                self._lose(message.rows, f"the spool is full at {self._most} bytes")
            return True

    def _lose(self, rows: int, reason: str) -> None:
        self._lost += rows
        now = time.monotonic()
        if rows and (self._told_s is None or now - self._told_s >= TELLING_S):
            _log.error("%s: %d rows of the spool %s were lost so far", reason, self._lost, self._folder.path)
            self._told_s = now

    def _waiting_rows(self) -> int:
        return sum(buffer.rows for buffer in self._waiting)

    def _in_memory(self) -> int:
        return self._taken - self._written
