"""LimitWatch: compare the rows of a run with its limits. All times are arguments; no clock is read."""

from __future__ import annotations

from collections.abc import Iterable

from multidrop.drive.known_state import FAULT, FAULT_RECORDS, StateReader
from multidrop.drive.verbs import Condition
from multidrop.polling.batch import Row
from multidrop.runs.model import ReadingCondition, RunPlan, polled_drive


class LimitWatch:
    """Compares the newest values of a run's drives with the limits.

    `silence_ns` is the longest allowed time without a value. `begin_ns` is the start of the run (monotonic,
    in ns).
    """

    def __init__(self, plan: RunPlan, silence_ns: int, begin_ns: int) -> None:
        self._silence_ns = silence_ns
        self._limits = plan.limits.conditions
        self._drives = {name: polled_drive(plan.plant, name) for name in plan.drives}
        self._readers = {name: StateReader(polled.drive) for name, polled in self._drives.items()}
        self._newest: dict[str, dict[str, Row]] = {name: {} for name in self._drives}
        # newest value of each register that stores a past fault, such as `last_fault`, by drive and register
        self._records: dict[tuple[str, str], float] = {}
        # monotonic times in ns of the newest values, by drive name and by "drive.register"
        self._heard = dict.fromkeys(self._drives, begin_ns)
        limited = [(limit.drive, limit.register) for limit in self._limits]
        self._heard |= {f"{name}.{register}": begin_ns for name, register in (*limited, *plan.faults)}

    def add(self, rows: Iterable[Row]) -> str:
        """Take new rows. Return why the run must be aborted; "" if no limit is reached."""
        changed: set[str] = set()
        for row in rows:
            newest = self._newest.get(row.drive)
            if newest is None:
                continue
            if row.value is None:
                newest.pop(row.register, None)
                continue
            newest[row.register] = row
            changed.add(row.drive)
            is_answer = row.register in self._drives[row.drive].drive.registers  # False for a channel
            for key in (row.drive if is_answer else "", f"{row.drive}.{row.register}"):
                if key in self._heard:
                    self._heard[key] = max(self._heard[key], row.monotonic_ns)
            if self._is_new_fault(row.drive, row.register, row.value):
                return f"{row.drive} had a fault, {self._shown(row)}"
            for limit in self._limits:
                if (limit.drive, limit.register) == (row.drive, row.register) and limit.holds(row.value):
                    return f"{limit.text}: it is {self._shown(row)}"
        return next(filter(None, map(self._fault, changed)), "")

    def _shown(self, row: Row) -> str:
        register = self._drives[row.drive].find_register(row.register)
        assert row.value is not None
        return register.format(register.decode(row.value) if register.values is not None else row.value)

    def _is_new_fault(self, drive: str, register: str, value: float) -> bool:
        """Return True if the value is a new fault in a register of past faults, such as `last_fault`."""
        # the first value does not count, because the fault may be old
        if register not in FAULT_RECORDS:
            return False
        before = self._records.get((drive, register), value)
        self._records[drive, register] = value
        return value not in (0.0, before)

    def _fault(self, name: str) -> str:
        newest = self._newest[name]
        if FAULT in newest and newest[FAULT].value:
            return f"{name} has a fault, {self._shown(newest[FAULT])}"
        values = {register: row.value for register, row in newest.items() if row.value is not None}
        state = self._readers[name].state(values)
        return f"{name} has a fault" if state is not None and state.condition is Condition.FAULT else ""

    def silent(self, now_ns: int) -> str:
        """Return a sentence if a value has been missing for too long, else ""."""
        for key, heard_ns in self._heard.items():
            if now_ns - heard_ns > self._silence_ns:
                return f"no value of {key} came for {(now_ns - heard_ns) / 1e9:.1f} s"
        return ""

    def holds(self, condition: ReadingCondition, since_ns: int) -> bool:
        """Return True if the condition holds for the newest value, requested at `since_ns` or later."""
        row = self._newest[condition.drive].get(condition.register)
        return row is not None and row.monotonic_ns >= since_ns and condition.holds(row.value or 0.0)
