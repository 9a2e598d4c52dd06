"""Record the writes of a line: in an audit log with their author, and in the EEPROM ledger.

A write is counted before it is sent. A stop is recorded on separate threads, because a disk may hang and a
ledger may be locked; the stop does not wait for these threads.
"""

from __future__ import annotations

import json
import logging
import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from contextvars import ContextVar
from functools import partial
from pathlib import Path
from typing import IO, Any, NamedTuple, TypeVar

from multidrop.control.eeprom_ledger import LEAST_INTERVAL, YEARLY, Ledger, LedgerCell
from multidrop.control.outcome import Effect, Stopped
from multidrop.control.rules import refused
from multidrop.core import Message, build_request
from multidrop.drive.family import Drive
from multidrop.drive.register import Kept, Register
from multidrop.errors import Advice
from multidrop.printable import format_time, printable
from multidrop.transport import clock
from multidrop.transport.aside_log import AsideThread, log_aside
from multidrop.transport.line import Line

T = TypeVar("T")

# ---- the audit log ----


OPENING_S = 5.0  # s; timeout for opening the audit log

_sync = getattr(os, "fdatasync", os.fsync)  # fsync on macOS, which has no fdatasync


class AuditLog:
    """An append-only file of JSON lines that records every write that was sent, and its author.

    A write is recorded when its outcome is known. If the process is killed while a write is in flight, the
    write is recorded only if it was made in a `noted_first` block. A stop is recorded when it is called, and
    again for each drive when it ends. A line that a crash or a full disk truncated does not damage the next
    record. Raises OSError if the file cannot be opened within OPENING_S s.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self._file = _opened(self.path)

    def add(self, utc_ns: int, record: dict[str, Any]) -> None:
        """Append a record. Raises OSError if it was not written completely."""
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
    outcome "called" means that the write is about to be sent, "not sent" that it then was not sent, and
    "refused" that a gateway did not send it.
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


class _Author(NamedTuple):
    """The fields of an audit record that `written_by` sets, and the error in its arguments, if any."""

    fields: dict[str, str]
    mistake: Exception | None


_author: ContextVar[_Author] = ContextVar("multidrop author")
_NOBODY = _Author({}, None)
_noted_first: ContextVar[bool] = ContextVar("multidrop noted first", default=False)
_commissioning: ContextVar[bool] = ContextVar("multidrop commissioning", default=False)


def check_author() -> None:
    """Raise TypeError or ValueError if the present author's name is invalid. Not called for stops."""
    mistake = _author.get(_NOBODY).mistake
    if mistake is not None:
        raise mistake


@contextmanager
def _within(variable: ContextVar[T], value: T) -> Iterator[None]:
    token = variable.set(value)
    try:
        yield
    finally:
        variable.reset(token)


def written_by(who: str, way: str = "", command: str = "") -> AbstractContextManager[None]:
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
    fields = {"by": _spelt(who), "way": _spelt(way), "id": _spelt(command)}
    known = {key: text for key, text in fields.items() if text}
    return _within(_author, _Author(known, next(filter(None, mistakes), None)))


def noted_first() -> AbstractContextManager[None]:
    """Within the block, write a record with the outcome "called" to the audit log before each write.

    A second record has the real outcome. If the first record cannot be written, the write raises OSError and
    is not sent; a stop is always sent. The block applies to this thread or task, like that of `written_by`.
    """
    return _within(_noted_first, True)


def commissioning() -> AbstractContextManager[None]:
    """Within the block, do not apply LEAST_INTERVAL, because a person is setting up a drive.

    Each write is still counted in the ledger, the yearly budget still applies, and the audit record has
    `commissioning`. The block applies to this thread or task.
    """
    return _within(_commissioning, True)


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
    except Exception:  # the object's own `__repr__` may raise anything
        text = type(given).__name__
    return printable(text).strip()[:MOST_CHARACTERS]


# ---- the records of a line's writes ----


CALLED = "called"  # outcome in the record of a write or a stop that is about to be sent
UNSENT = "not sent"  # outcome of a write that was recorded as CALLED and then not sent
REFUSED = "refused"  # outcome of a write that a gateway refused
CALLED_S = 0.05  # s; longest time that a stop waits until its audit record is written
CLOSING_NS = 1_000_000_000  # longest time that closing the audit log waits for records of other threads

_log = logging.getLogger("multidrop.control")
_audit_thread = AsideThread("multidrop audit")
_ledger_thread = AsideThread("multidrop ledger")


class WriteRecords:
    """Records of one line's writes. Records of stops are queued until `catch_up`."""

    def __init__(self, line: Line, ledger: Ledger, audit: AuditLog | None) -> None:
        self.audit = audit
        self.audit_trouble = ""  # why the newest audit record could not be written; "" if it was written
        self._line = line
        self._ledger = ledger
        self._uncounted: deque[LedgerCell] = deque()
        # queued audit records, each with its time: UTC in ns
        self._unlogged: deque[tuple[int, dict[str, Any]]] = deque()
        # one item for each thread that writes records; a list, because its operations need no lock
        self._writers: list[None] = []

    def count(self, drive: Drive, register: Register[Any], kept: Kept) -> None:
        """Count a write in the ledger before it is sent. Raises WriteForbidden if the budget is used up.

        For a register in EEPROM, also raises WriteForbidden if the last write was less than LEAST_INTERVAL
        seconds ago, unless within `commissioning`.
        """
        least = LEAST_INTERVAL if kept is Kept.EEPROM and not _commissioning.get() else 0.0
        ledger = self._ledger.at(self._line.identity)
        why = ledger.enter(self._cell(drive, register), clock.utc_ns() / 1e9, least)
        if why:
            way, advice = _way_out(drive, register, kept, is_yearly=YEARLY in why)
            refusal = refused(drive, register, f"{why}; {way}", advice)
            refusal.is_budget = True
            raise refusal

    def count_later(self, drive: Drive, register: Register[Any]) -> None:
        self._uncounted.append(self._cell(drive, register))

    def log(
        self, drive: Drive, request: Message, what: str, effect: Effect, why: str = "", held: Any = None
    ) -> None:
        """Record a write in the audit log; a failure is logged as a warning."""
        self._put(self._record(drive, request, what, effect.value, why, held), _log.log)
        self.catch_up()

    def log_later(
        self, drive: Drive, request: Message, what: str, effect: Effect, why: str = "", held: Any = None
    ) -> None:
        """Queue the audit record, and log the write on the log thread."""
        self._put(self._record(drive, request, what, effect.value, why, held), partial(log_aside, _log))

    def note_called(self, drive: Drive, request: Message, what: str) -> None:
        """In a `noted_first` block, record that this write is about to be sent. Otherwise do nothing.

        Raises OSError if the record cannot be written.
        """
        if self.audit is None or not _noted_first.get():
            return
        record = self._record(drive, request, what, CALLED, "", None)
        del record["sent"]
        self._append(clock.utc_ns(), self._complete(record))
        if self.audit_trouble:
            raise OSError(f"{what} was not sent: the audit log cannot be written: {self.audit_trouble}")

    def note_unsent(self, drive: Drive, request: Message, what: str, failure: BaseException) -> None:
        """In a `noted_first` block, record that a write was not sent after all. Otherwise do nothing."""
        if self.audit is None or not _noted_first.get():
            return
        record = self._record(drive, request, what, UNSENT, str(failure) or type(failure).__name__, None)
        del record["sent"]
        self._put(record, _log.log)
        self.catch_up()

    def note_stops_called(self, verb: str, drives: Sequence[Drive]) -> None:
        """Record that these drives are about to be stopped, and wait up to CALLED_S for the record.

        Once such a wait has timed out because the disk hangs, later calls do not wait while it still hangs.
        """
        of_one = {"model": drives[0].model, "address": drives[0].address} if len(drives) == 1 else {}
        names = ", ".join(drive.name for drive in drives)
        self._put({"drive": names, **of_one, "write": verb, "outcome": CALLED}, partial(log_aside, _log))
        self.catch_up_aside()
        if self.audit is not None and not _audit_thread.hangs(CALLED_S):
            _audit_thread.flush(CALLED_S)

    def note_stop_ended(
        self, verb: str, drive: Drive, stopped: Stopped, frames: int, newest: Message | None
    ) -> None:
        """Record the result of one drive's stop, and how many frames it took."""
        record = self._record(drive, newest, verb, stopped.seen.value, stopped.why, None)
        self._put({**record, "frames": frames}, partial(log_aside, _log), str(stopped))
        self.catch_up_aside()

    def note_refused(self, drive: str, what: str, why: str) -> None:
        """Record a write that was refused before a request was made. Does not wait for the disk."""
        record = {"drive": drive, "write": what, "outcome": REFUSED, "why": why}
        self._put(record, partial(log_aside, _log))
        self.catch_up_aside()

    def _record(
        self, drive: Drive, request: Message | None, what: str, outcome: str, why: str, held: Any
    ) -> dict[str, Any]:
        record = {
            "drive": drive.name if request is None or request.address else "all",
            "model": drive.model,
            "address": drive.address if request is None else request.address,
            "write": what,
        }
        if request is not None:
            frame = build_request(drive.framing, request)
            record["sent"] = frame.decode().strip() if frame.startswith(b":") else frame.hex(" ").upper()
        more = {"held": None if held is None else float(held), "why": why}
        known = {key: value for key, value in more.items() if value not in (None, "")}
        return record | {"outcome": outcome} | known

    def _put(self, record: dict[str, Any], log: Callable[..., None], text: str = "") -> None:
        """Queue a record for the audit log, and pass `text`, or a sentence made from the record, to `log`."""
        record = self._complete(record)
        if self.audit is not None:
            self._unlogged.append((clock.utc_ns(), record))
        why = f": {record['why']}" if "why" in record else ""
        author = [record[key] for key in ("by", "way", "id") if key in record]
        by = f" (by {', '.join(author)})" if "by" in record else ""
        text = text or f"{record['drive']}: {record['write']}: {record['outcome']}{why}"
        log(logging.INFO, "%s%s", text, by)

    def _complete(self, record: dict[str, Any]) -> dict[str, Any]:
        """Return the record with the port and the author added."""
        set_up = {"commissioning": True} if _commissioning.get() else {}
        return {"port": self._line.port, **record, **_author.get(_NOBODY).fields, **set_up}

    def catch_up(self) -> None:
        """Write the queued records and count the queued writes; log a failure as a warning."""
        self._write_queued()
        self._count_queued()

    def catch_up_aside(self) -> None:
        """Start the work of `catch_up` on separate threads, without waiting."""
        if self._uncounted:
            _ledger_thread.put(self._count_queued)
        if self._unlogged:
            _audit_thread.put(self._write_queued)

    def flush(self, seconds: float) -> None:
        """Do the work of `catch_up` on separate threads, and wait up to `seconds` for each thread."""
        self.catch_up_aside()
        for thread in (_audit_thread, _ledger_thread):
            if not thread.hangs(seconds) and not thread.flush(seconds) and not thread.hangs(seconds):
                # The separate thread could not be started, so this thread does the work.
                self.catch_up()

    def _write_queued(self) -> None:
        # `close` waits for each thread in this list, so the entry precedes the first record.
        self._writers.append(None)
        try:
            with suppress(IndexError):  # the queue is empty; other threads may empty it too
                while True:
                    self._append(*self._unlogged.popleft())
        finally:
            self._writers.pop()

    def _count_queued(self) -> None:
        cells: list[LedgerCell] = []
        with suppress(IndexError):
            while True:
                cells.append(self._uncounted.popleft())
        if not cells:
            return
        try:
            self._ledger.at(cells[0].port).note(cells, clock.utc_ns() / 1e9)
        except (OSError, ValueError) as failure:  # ValueError is raised if a port's name is not valid text
            log_aside(_log, logging.WARNING, "stops were not counted: %s", failure)

    def _append(self, at_ns: int, record: dict[str, Any]) -> None:
        audit = self.audit
        if audit is None:
            return
        try:
            audit.add(at_ns, record)
            self.audit_trouble = ""
        except (OSError, ValueError) as failure:  # ValueError is raised if the file was closed
            self.audit_trouble = getattr(failure, "strerror", None) or str(failure)
            log_aside(_log, logging.WARNING, "the audit log cannot be written: %s", self.audit_trouble)

    def _cell(self, drive: Drive, register: Register[Any]) -> LedgerCell:
        return LedgerCell(
            self._line.identity, drive.address, drive.ledger_name, register.name, self._line.port
        )

    def close(self) -> None:
        """Write the queued records and close the log; wait only briefly for a disk that hangs."""
        self.flush(CLOSING_NS / 1e9)
        given_up_ns = clock.now_ns() + CLOSING_NS
        while self._writers and clock.now_ns() < given_up_ns:
            clock.sleep(0.001)
        if self.audit is not None:
            self.audit.close()
            self.audit = None


def _way_out(
    drive: Drive, register: Register[Any], kept: Kept, *, is_yearly: bool
) -> tuple[str, Advice | None]:
    """Return a sentence on how to set a register although the ledger refuses its writes; and an Advice."""
    if kept is Kept.UNKNOWN:
        declared = f'ram = ["{register.name}"]'
        written = f"write {declared} below its [[line.drive]]"
        advice = Advice(f"declare {declared}", f"add --ram {register.name}", written)
        return f"if you know that this drive keeps it in RAM, {advice.program}", advice
    if register.name == drive.setpoint_name:
        return "change it less often: this family has no setpoint in RAM", None
    if is_yearly or drive.parameter_space is None:
        return "set it on the drive's panel", None
    advice = Advice("params.apply(..., commissioning=True)", "`multidrop params apply --commissioning`")
    return f"wait, set it on the drive's panel, or use {advice.program}", advice
