"""AuditLog: an append-only file of JSON lines that records every write that was sent, and its author.

A write is recorded when its outcome is known. If the process is killed while a write is in flight, the write
is recorded only if it was made in a `noted_first` block. A stop is recorded when it is called, and again for
each drive when it ends. A line that a crash or a full disk truncated does not damage the next record.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import IO, Any, NamedTuple

from multidrop.iso_time import format_time
from multidrop.printable import printable

OPENING_S = 5.0  # timeout for opening the file

_sync = getattr(os, "fdatasync", os.fsync)  # macOS has no fdatasync


class AuditLog:
    """The audit log in the file `path`. Raises OSError if the file cannot be opened within OPENING_S s."""

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self._file = _opened(self.path)

    def add(self, utc_ns: int, record: dict[str, Any]) -> None:
        """Append a record. Raises OSError, even if a part of the record was written."""
        line = json.dumps({"time": format_time(utc_ns), **record}, ensure_ascii=False)
        whole = (b"\n" if self._is_truncated() else b"") + line.encode(errors="backslashreplace") + b"\n"
        if self._file.write(whole) < len(whole):
            raise OSError(f"{self.path}: only part of a record could be written")

    def sync(self) -> None:
        """Flush all records to the disk. Raises OSError."""
        _sync(self._file.fileno())

    def close(self) -> None:
        self._file.close()

    def _is_truncated(self) -> bool:
        """Return True if the file's last line is incomplete, whichever process wrote that line."""
        if self._file.seek(0, os.SEEK_END) == 0:
            return False
        self._file.seek(-1, os.SEEK_END)
        return self._file.read(1) != b"\n"


def _opened(path: Path) -> IO[bytes]:
    """Open the log with a timeout, because a disk may hang."""
    from multidrop.supervisor import in_time  # imported here, because the import takes 4 MB

    def open_file() -> IO[bytes]:
        # unbuffered: each record is one system call, so processes do not mix their lines
        return path.open("a+b", buffering=0)

    try:
        return in_time("audit log", OPENING_S, open_file)
    except RuntimeError:  # the system has no thread left
        return open_file()


def read_audit(path: Path | str) -> Iterator[dict[str, Any]]:
    """Yield the records of a log in order, without truncated ones. Raises OSError.

    Each record has `time` (UTC), `port`, `drive`, `write` and `outcome`. If known, it also has `model`,
    `address`, `sent` (the newest frame), `frames` (the number of frames of a stop), `held` (the value that
    the drive holds), `why` (the reason for the outcome), and `by`, `way` and `id` (see `written_by`). The
    outcome "called" means that the write is about to be sent, and "refused" that a gateway did not send it.
    """
    with Path(path).open("rb") as lines:
        for line in lines:
            try:
                record = json.loads(line)
            except (ValueError, RecursionError):
                continue
            if isinstance(record, dict):
                yield record


# ---- the author of a write ----


MOST_CHARACTERS = 200


class Author(NamedTuple):
    """Fields of an audit record: `by` names the author, `way` the interface, `id` is the command's id."""

    by: str = ""
    way: str = ""
    id: str = ""


class _Named(NamedTuple):
    """An author as printable text, and the error in the arguments of `written_by`, if any."""

    author: Author
    mistake: Exception | None


_named: ContextVar[_Named] = ContextVar("multidrop author")
_NOBODY = _Named(Author(), None)
_noted_first: ContextVar[bool] = ContextVar("multidrop noted first", default=False)


def present_author() -> Author:
    """Return the author of writes in this context; all fields are empty if no author was named."""
    return _named.get(_NOBODY).author


def check_author() -> None:
    """Raise TypeError or ValueError if the present author's name is invalid. Not called for stops."""
    mistake = _named.get(_NOBODY).mistake
    if mistake is not None:
        raise mistake


@contextmanager
def written_by(who: str, way: str = "", command: str = "") -> Iterator[None]:
    """Record `who` as the author of all writes within the block, and `way` as the interface used.

    The audit record of a write or a stop then has `by`, such as "anna", and `way`, such as "web, 10.0.0.7",
    unless `way` is empty. `command` is an id, recorded as `id`: it connects the records of a command with its
    answer. The block applies to this thread, or to this task and its calls of `asyncio.to_thread`. Other
    threads, such as those of `run_in_executor`, need a block of their own. Of nested blocks, the innermost
    applies. Naming an author grants no rights.

    Within the block a write raises TypeError if an argument is not text. It raises ValueError if an argument
    is longer than 200 characters or not printable, or if `who` is empty. A stop is sent nevertheless, and
    recorded with the printable part of the arguments.
    """
    others = {"way": way, "command": command}
    given = {"who": who} | {name: text for name, text in others.items() if text != ""}
    mistakes = (_mistake(name, text) for name, text in given.items())
    author = Author(_spelt(who), _spelt(way), _spelt(command))
    token = _named.set(_Named(author, next(filter(None, mistakes), None)))
    try:
        yield
    finally:
        _named.reset(token)


@contextmanager
def noted_first() -> Iterator[None]:
    """Within the block, write a record with the outcome "called" to the audit log before each write.

    A second record has the real outcome. If the first record cannot be written, the write raises OSError and
    is not sent; a stop is always sent. The block applies to this thread or task, like that of `written_by`.
    """
    token = _noted_first.set(True)
    try:
        yield
    finally:
        _noted_first.reset(token)


def is_noted_first() -> bool:
    """Return True if the caller is inside a `noted_first` block."""
    return _noted_first.get()


def _mistake(name: str, text: object) -> Exception | None:
    if not isinstance(text, str):
        return TypeError(f"{name} = {_spelt(text)} is not text")
    if not text.strip() or len(text) > MOST_CHARACTERS or not text.isprintable():
        return ValueError(f"{name} = {text!r} is not 1 to {MOST_CHARACTERS} printable characters")
    return None


def _spelt(given: object) -> str:
    """Return the name of an author as printable text; the name may be any object."""
    try:
        text = given if isinstance(given, str) else repr(given)
    except Exception:  # raised by the caller's own `__repr__`
        text = type(given).__name__
    return printable(text).strip()[:MOST_CHARACTERS]
