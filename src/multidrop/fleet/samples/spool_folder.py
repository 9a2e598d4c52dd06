"""The folder of a spool: a file a message, each on the disk before it has its name.

| in the folder        | what it holds                                                         |
|----------------------|-----------------------------------------------------------------------|
| `spool.json`         | fleet, gateway, and the id of the log whose messages are numbered here |
| `NUMBER-ROWS.arrows` | a message: its sequence in the log, and its rows                       |
| `NUMBER-ROWS.damaged`| a newest message of which a disk kept only a part                      |
| `.spool.lock`        | held by the process that writes here                                   |

The newest message is never removed: it says which number comes next. A log's id is made with its folder, so
a new disk is a new log.
"""

from __future__ import annotations

import json
import os
import re
import secrets
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from multidrop.fleet.file_lock import lock
from multidrop.fleet.samples.message import MessageError, unpack

FORMAT = "multidrop spool 1"
HEAD = "spool.json"
_NAME = re.compile(r"(\d{12,})-(\d+)\.(arrows|damaged)")
_TEMPORARY = re.compile(r"\..+\.tmp")


class SpoolError(ValueError):
    """A folder that is no spool, or another's, or not to be written."""


class StoredMessage(NamedTuple):
    """A message in a file."""

    sequence: int
    rows: int
    size: int  # bytes
    path: Path


class SpoolFolder:
    """The files of one log, of which one process at a time is the owner.

    Raises SpoolError for a folder that holds something else, is another gateway's or fleet's, is being
    written by another process, or cannot be written.
    """

    def __init__(self, path: Path, gateway: str, fleet: str) -> None:
        self.path = path
        self.damage: str | None = None  # a sentence about a newest message that was no whole one
        try:
            path.mkdir(parents=True, exist_ok=True)
            self._lock = os.open(path / ".spool.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        except OSError as failure:
            raise SpoolError(f"the spool {path} cannot be written: {failure.strerror}") from failure
        try:
            self._own(gateway, fleet)
        except BaseException:
            os.close(self._lock)
            raise

    def _own(self, gateway: str, fleet: str) -> None:
        try:
            lock(self._lock)
        except BlockingIOError:
            raise SpoolError(f"the spool {self.path} is being written by another process") from None
        try:
            self.log = self._head({"format": FORMAT, "fleet": fleet, "gateway": gateway})
            self.messages = self._listed()
            self._check_newest()
        except OSError as failure:
            raise SpoolError(f"the spool {self.path} cannot be written: {failure.strerror}") from failure

    def close(self) -> None:
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1

    def _head(self, wanted: dict[str, str]) -> str:
        """Return the log's id: of the folder, or a new one for an empty folder."""
        path = self.path / HEAD
        if not path.exists():
            others = sorted(one.name for one in self.path.iterdir() if not one.name.startswith("."))
            if others:
                raise SpoolError(
                    f"{self.path} is no spool: it holds {others[0]!r} and no {HEAD}; name an empty folder"
                )
            log = secrets.token_hex(8)
            self._store(path, json.dumps({**wanted, "log": log}).encode())
            return log
        found = _parsed(path)
        if found.get("format") != FORMAT or not re.fullmatch(r"[0-9a-f]{16}", str(found.get("log"))):
            raise SpoolError(f"{path} is not the head of a spool of this version ({FORMAT!r})")
        for key in ("fleet", "gateway"):
            if found.get(key) != wanted[key]:
                raise SpoolError(
                    f"{self.path} is the spool of gateway {found.get('gateway')!r} in fleet "
                    f"{found.get('fleet')!r}, not of {wanted['gateway']!r} in {wanted['fleet']!r}"
                )
        return str(found["log"])

    def _listed(self) -> dict[int, StoredMessage]:
        """Return the messages in order, and remove what a killed process had begun."""
        found = {}
        self.newest = 0
        for path in self.path.iterdir():
            if _TEMPORARY.fullmatch(path.name):
                path.unlink()
            elif match := _NAME.fullmatch(path.name):
                number = int(match[1])
                self.newest = max(self.newest, number)  # also a damaged one: it is not given again
                if match[3] == "arrows":
                    found[number] = StoredMessage(number, int(match[2]), path.stat().st_size, path)
        return dict(sorted(found.items()))

    def _check_newest(self) -> None:
        """Put a newest message away that is not whole."""
        newest = self.messages.get(self.newest)
        if newest and (mistake := _mistake(newest)):
            del self.messages[self.newest]
            newest.path.rename(newest.path.with_suffix(".damaged"))
            self._sync_folder()
            self.damage = f"{newest.path} is damaged, and was put away with {newest.rows} rows: {mistake}"

    def write(self, data: bytes, rows: int) -> StoredMessage:
        """Store the next message; it is on the disk when this returns. Raises OSError: try again."""
        number = self.newest + 1
        path = self.path / f"{number:012d}-{rows}.arrows"
        self._store(path, data)
        return StoredMessage(number, rows, len(data), path)

    def add(self, stored: StoredMessage) -> None:
        """Note a message that was written."""
        self.messages[stored.sequence] = stored
        self.newest = stored.sequence

    def remove(self, message: StoredMessage) -> None:
        """Remove a message that is not the newest. Raises OSError."""
        message.path.unlink(missing_ok=True)
        del self.messages[message.sequence]

    def _store(self, path: Path, data: bytes) -> None:
        """Write a file that has its name once it is on the disk, and leave nothing where that fails."""
        part = path.with_name(f".{path.name}.tmp")
        try:
            file = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o666)
            try:
                left = memoryview(data)
                while left:
                    left = left[os.write(file, left) :]
                os.fsync(file)
            finally:
                os.close(file)
            part.rename(path)
        except BaseException:
            with suppress(OSError):
                part.unlink()
            raise
        self._sync_folder()

    def _sync_folder(self) -> None:
        folder = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


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
