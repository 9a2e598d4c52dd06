"""WriteRecords: the audit log and the EEPROM ledger of one line's writes.

A write is counted before it is sent. A stop is sent first, and recorded afterwards: a disk may hang.
"""

from __future__ import annotations

import logging
from collections import deque
from contextlib import suppress
from typing import Any

from multidrop.control.audit_log import AuditLog
from multidrop.control.author import present_author
from multidrop.control.eeprom_ledger import LEAST_INTERVAL, Ledger, LedgerCell
from multidrop.control.outcome import Effect
from multidrop.control.rules import refused
from multidrop.core import Message, build_request
from multidrop.drive.family import Drive
from multidrop.drive.register import Register
from multidrop.drive.table import Kept
from multidrop.errors import Advice
from multidrop.transport import clock
from multidrop.transport.line import Line

CLOSING_NS = 1_000_000_000  # that closing waits for other threads' records
_log = logging.getLogger("multidrop.control")


class WriteRecords:
    """Records of one line's writes; stops are queued until `catch_up`."""

    def __init__(self, line: Line, ledger: Ledger, audit: AuditLog | None) -> None:
        self.audit = audit
        self.audit_trouble = ""  # why the newest record is not in the log
        self._line = line
        self._ledger = ledger
        self._uncounted: deque[LedgerCell] = deque()
        self._unlogged: deque[tuple[int, dict[str, Any]]] = deque()  # each with its time, UTC in ns
        self._writers: list[None] = []  # in `catch_up`; a list grows and shrinks without a lock

    def count(self, drive: Drive, register: Register[Any], kept: Kept) -> None:
        """Count a write in the ledger before it is sent; Refused when it must not be."""
        least = LEAST_INTERVAL if kept is Kept.EEPROM else 0.0
        ledger = self._ledger.at(self._line.identity)
        why = ledger.enter(self._cell(drive, register), clock.utc_ns() / 1e9, least)
        if why:
            way, advice = "write it less often, or take a setpoint that is kept in RAM", None
            if kept is Kept.UNKNOWN:
                declared = f'ram = ["{register.name}"]'
                written = f"write {declared} below its [[line.drive]]"
                advice = Advice(f"declare {declared}", f"add --ram {register.name}", written)
                way = f"if you know that this drive keeps it in RAM, {advice.program}"
            refusal = refused(drive, register, f"{why}; {way}", advice)
            refusal.is_budget = True
            raise refusal

    def count_later(self, drive: Drive, register: Register[Any]) -> None:
        self._uncounted.append(self._cell(drive, register))

    def log(
        self, drive: Drive, request: Message, what: str, effect: Effect, why: str = "", held: Any = None
    ) -> None:
        """Note a write in the audit log; a failure is logged as a warning."""
        self.log_later(drive, request, what, effect, why, held)
        self.catch_up()

    def log_later(
        self, drive: Drive, request: Message, what: str, effect: Effect, why: str = "", held: Any = None
    ) -> None:
        """Queue the note, also for the logger, whose handler may write to the same disk."""
        frame = build_request(drive.framing, request)
        record = {
            "port": self._line.port,
            "drive": drive.name if request.address else "all",
            "model": drive.model,
            "address": request.address,
            "write": what,
            "sent": frame.decode().strip() if frame.startswith(b":") else frame.hex(" ").upper(),
            "outcome": effect.value,
        }
        more = {"held": None if held is None else float(held), "why": why, **present_author()._asdict()}
        record |= {key: text for key, text in more.items() if text not in (None, "")}
        self._unlogged.append((clock.utc_ns(), record))

    def catch_up(self) -> None:
        """Log and count what was queued; a failure is logged as a warning."""
        self._writers.append(None)  # before a record is taken: `close` then waits for this thread
        try:
            with suppress(IndexError):  # another thread may be at it
                while True:
                    self._append(*self._unlogged.popleft())
            uncounted: list[LedgerCell] = []
            with suppress(IndexError):
                while True:
                    uncounted.append(self._uncounted.popleft())
            if uncounted:
                self._note(uncounted)
        finally:
            self._writers.pop()

    def _append(self, at_ns: int, record: dict[str, Any]) -> None:
        why = f": {record['why']}" if "why" in record else ""
        by = (
            f" (by {', '.join(record[key] for key in ('by', 'way') if key in record)})"
            if "by" in record
            else ""
        )
        _log.info("%s: %s: %s%s%s", record["drive"], record["write"], record["outcome"], why, by)
        audit = self.audit
        if audit is None:
            return
        try:
            audit.add(at_ns, record)
            self.audit_trouble = ""
        except (OSError, ValueError) as failure:  # it may be closed meanwhile
            self.audit_trouble = getattr(failure, "strerror", None) or str(failure)
            _log.warning("the audit log cannot be written: %s", self.audit_trouble)

    def _note(self, cells: list[LedgerCell]) -> None:
        try:
            self._ledger.at(cells[0].port).note(cells, clock.utc_ns() / 1e9)
        except (OSError, ValueError) as failure:  # a port's name may be no text
            _log.warning("stops were not counted: %s", failure)

    def _cell(self, drive: Drive, register: Register[Any]) -> LedgerCell:
        return LedgerCell(
            self._line.identity, drive.address, drive.ledger_name, register.name, self._line.port
        )

    def close(self) -> None:
        """Close the log when what was queued is in it; a disk that hangs holds nobody up for long."""
        self.catch_up()
        given_up_ns = clock.now_ns() + CLOSING_NS
        while self._writers and clock.now_ns() < given_up_ns:
            clock.sleep(0.001)
        if self.audit is not None:
            self.audit.close()
            self.audit = None
