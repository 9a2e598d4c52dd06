"""Ledger: a file that counts the writes of registers in EEPROM, and limits them to a yearly budget."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

from multidrop.transport.port_identity import is_simulated, ledger_of, of_name

YEAR = 365 * 86400.0  # s
CYCLES = 10_000  # writes that an EEPROM survives (Toshiba's figure for a relative of the YD1000)
YEARS = 10
BUDGET = CYCLES // YEARS  # limit of writes of one register in a year
NO_HOME = Path("/nonexistent")  # replaces the home folder of a user who has none
LATEST = 6e10  # s; the file is damaged if a time in it is further than this from 1970
YEARLY = "times in a year"  # only the error for a used-up yearly budget contains these words
LEAST_INTERVAL = 60.0  # seconds between two writes of a register that is kept in EEPROM


@dataclass(frozen=True)
class LedgerCell:
    """A counter in a ledger: one register of one drive.

    `port` is the port's identity (see port_identity). `spelt` is the port's name, which older entries have
    instead of the identity.
    """

    port: str
    address: int
    model: str
    register: str
    spelt: str = field(default="", compare=False)


@dataclass(frozen=True)
class Wear:
    """How often one register of one drive was written."""

    cell: LedgerCell
    writes: int  # all writes so far
    this_year: int  # writes within the last year
    last: float  # UTC in s of the latest entry


def default_ledger_path() -> Path:
    """Return the ledger's path in the user's directory for state (XDG base directory specification).

    For a user without a home, as in a container, the path cannot be written; stops work nevertheless.
    """
    try:
        state = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state")
    except RuntimeError:
        state = NO_HOME
    return state / "multidrop" / "wear.sqlite"


class Ledger:
    """A file that counts the writes of each register that a drive may keep in EEPROM.

    Several processes share the file. The ledger identifies a drive by its port's identity and its address. An
    EEPROM survives about 10,000 writes; a yearly budget makes these writes last for ten years. The file
    `path` is created at the first entry. Times are UTC in s.
    """

    def __init__(self, path: Path | str | None = None, *, budget: int = BUDGET) -> None:
        self.path = Path(path) if path else default_ledger_path()
        self.budget = budget
        self._is_default_path = not path

    def at(self, port: str) -> Ledger:
        """Return the ledger for this port; simulated ports have a ledger of their own."""
        if self._is_default_path and is_simulated(port):
            return Ledger(ledger_of(port, self.path.parent), budget=self.budget)
        return self

    def enter(self, cell: LedgerCell, now: float, least_interval: float) -> str:
        """Count a write that is about to be sent, and return "".

        If the write must not be sent, return the reason, and do not count the write. `now` is UTC in s;
        `least_interval` is the shortest time in s between two writes. The file is locked until the write is
        counted, so two processes cannot both take the last write of the budget. Raises OSError if the file
        cannot be written.
        """
        with self._opened() as ledger:
            ledger.execute("begin immediate")
            wear = _wear(ledger, cell, _names(ledger, cell), now)
            since = now - wear.last  # negative if the clock was set back; then the true interval is unknown
            if wear.writes and 0 <= since < least_interval:
                return (
                    f"it is kept in EEPROM and was written {since:.0f} s ago, but only one write in "
                    f"{least_interval:.0f} s is allowed"
                )
            if wear.this_year >= self.budget:
                return (
                    f"it was written {wear.this_year} {YEARLY}, and its EEPROM survives {CYCLES} "
                    f"writes: {self.budget} a year for {YEARS} years"
                )
            ledger.execute("insert into writes values (?, ?, ?, ?, ?)", (*_key(cell), now))
            ledger.commit()
        return ""

    def note(self, cells: Sequence[LedgerCell], now: float) -> None:
        """Count writes that stops have sent, in one transaction, even if the yearly budget is used up.

        Waits up to 5 s if another process has locked the file. Raises OSError if it cannot be written.
        """
        with self._opened() as ledger:
            ledger.execute("begin immediate")
            ledger.executemany("insert into writes values (?, ?, ?, ?, ?)", [(*_key(c), now) for c in cells])
            ledger.commit()

    def wear(self, now: float) -> list[Wear]:
        """Return the number of writes of each register, the most written within the last year first."""
        if not self.path.exists():
            return []
        with self._opened() as ledger:
            rows = ledger.execute("select distinct port, address, model, register from writes").fetchall()
            names: dict[LedgerCell, list[str]] = {}
            for port, *place in rows:
                names.setdefault(LedgerCell(of_name(port), *place), []).append(port)
            found = [_wear(ledger, cell, ports, now) for cell, ports in names.items()]
        return sorted(found, key=_by_wear)

    def wear_of(self, port: str, address: int, model: str, now: float) -> list[Wear]:
        """Return the wear of each counted register of one drive.

        `port` is the port's name or identity, `model` the drive's `ledger_name`, `now` UTC in s.
        """
        place = (of_name(port), address, model)
        return [one for one in self.wear(now) if (one.cell.port, one.cell.address, one.cell.model) == place]

    @contextmanager
    def _opened(self) -> Iterator[sqlite3.Connection]:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as failure:
            raise self._unkept(failure) from failure
        try:
            with closing(sqlite3.connect(self.path, timeout=5.0, isolation_level=None)) as ledger:
                ledger.execute(
                    "create table if not exists writes"
                    " (port text, address integer, model text, register text, time real)"
                )
                ledger.execute("create index if not exists cells on writes (port, address, register)")
                yield ledger
        except sqlite3.Error as failure:
            raise self._unkept(failure) from failure

    def _unkept(self, failure: Exception) -> OSError:
        return OSError(f"the ledger of EEPROM writes {self.path} cannot be kept: {failure}")


def _by_wear(wear: Wear) -> tuple[int, str, int, str]:
    return -wear.this_year, wear.cell.port, wear.cell.address, wear.cell.register


def _key(cell: LedgerCell) -> tuple[str, int, str, str]:
    return cell.port, cell.address, cell.model, cell.register


def _names(ledger: sqlite3.Connection, cell: LedgerCell) -> list[str]:
    """Return all names under which the cell's port was entered."""
    ports = [port for (port,) in ledger.execute("select distinct port from writes")]
    return [port for port in ports if port in (cell.port, cell.spelt) or of_name(port) == cell.port]


def _wear(ledger: sqlite3.Connection, cell: LedgerCell, ports: list[str], now: float) -> Wear:
    same_port = f"port in ({', '.join('?' * len(ports))})"
    where = f"{same_port} and address = ? and model = ? and register = ?"
    key = (*ports, *_key(cell)[1:])
    writes, latest = ledger.execute(f"select count(*), max(rowid) from writes where {where}", key).fetchone()
    (this_year,) = ledger.execute(
        f"select count(*) from writes where {where} and time > ?", (*key, now - YEAR)
    ).fetchone()
    (last,) = ledger.execute("select time from writes where rowid = ?", (latest,)).fetchone() or (0.0,)
    if not isinstance(last, float) or not abs(last) < LATEST:
        raise sqlite3.DataError(f"a write of {cell.register} has an invalid time: {last!r}")
    return Wear(replace(cell, spelt=""), writes, this_year, last)
