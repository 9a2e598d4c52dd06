"""Common block: state, values and stop of every drive at the same addresses and in the same units.

Numbers of two 16-bit words have the high word first. A value that is not fresh reads as a reserved
number, never as 0. The computed channels of a drive are in a second block.
"""

from __future__ import annotations

import math
import struct
from typing import Any, NamedTuple

from multidrop import PolledDrive, Register
from multidrop.gateway.live.hub import Hub
from multidrop.gateway.modbus_server.words import is_fresh

COMMON_LENGTH = 16  # length of the block in 16-bit words
STATE, FAULT, FREQUENCY, CURRENT, SETPOINT, AGE, STOP = 0, 1, 2, 4, 6, 8, 10  # offsets in words

STATES = {"unknown": 0, "stands": 1, "runs": 2, "fault": 3, "silent": 4}
NO_FAULT, FAULT_WITHOUT_NUMBER, FAULT_UNKNOWN = 0, 0xFFFE, 0xFFFF
NO_NUMBER = -(1 << 31)  # 8000 0000H: the value is unknown, or out of range
NEVER, LONGEST_AGE = 0xFFFF_FFFF, 0xFFFF_FFFE  # ages in ms: no value was read yet; limit of ages

_PER_UNIT = 100


class CommonNumber(NamedTuple):
    """A number of the common block, as the address map describes it."""

    name: str
    at: int  # offset in words
    words: int
    format: str
    step: float
    unit: str | None  # None: the unit of the drive's setpoint
    unknown: int  # the reserved number for a value that is not current
    note: str = ""


NUMBERS = (
    CommonNumber(
        *("state", STATE, 1, "u16", 1, "", STATES["unknown"]),
        ", ".join(f"{number} {state}" for state, number in STATES.items()),
    ),
    CommonNumber(
        *("fault", FAULT, 1, "u16", 1, "", FAULT_UNKNOWN),
        f"{NO_FAULT} none, {FAULT_WITHOUT_NUMBER} a fault without a number",
    ),
    CommonNumber("frequency", FREQUENCY, 2, "i32", 1 / _PER_UNIT, "Hz", NO_NUMBER),
    CommonNumber("current", CURRENT, 2, "i32", 1 / _PER_UNIT, "A", NO_NUMBER),
    CommonNumber("setpoint", SETPOINT, 2, "i32", 1 / _PER_UNIT, None, NO_NUMBER),
    CommonNumber("age", AGE, 2, "u32", 1, "ms", NEVER, "time since the request of the newest value"),
)


class CommonBlock:
    """The common block of one drive; its words are computed on request."""

    length = COMMON_LENGTH

    def __init__(self, polled: PolledDrive) -> None:
        self._name = polled.drive.name
        self._polled = {(poll.register.name, unit) for poll in polled.polls for unit in _units(poll.register)}
        self._numbers = (
            (FREQUENCY, "output_frequency", "Hz"),
            (CURRENT, "output_current", "A"),
            (SETPOINT, polled.drive.setpoint_name, None),
        )

    def words(self, hub: Hub, now_ns: int) -> list[int]:
        """Return the words of the block at the monotonic time `now_ns`."""
        state, woke_ns = hub.state(self._name), hub.woke_ns()
        words = [0] * COMMON_LENGTH
        words[STATE] = STATES.get(state, 0)
        words[FAULT] = self._fault(hub, now_ns, woke_ns, state)
        for at, name, unit in self._numbers:
            value = self._fresh_value(hub, now_ns, woke_ns, name, unit)
            words[at : at + 2] = _two_words(NO_NUMBER if value is None else _hundredths(value))
        words[AGE : AGE + 2] = _two_words(self._age(hub, now_ns, woke_ns))
        return words

    def _fresh_value(self, hub: Hub, now_ns: int, woke_ns: int, name: str, unit: str | None) -> float | None:
        """Return a polled register's fresh value, if its unit is `unit` (None: any unit); None otherwise."""
        row = hub.newest(self._name, name) if (name, unit) in self._polled else None
        return row.value if row and is_fresh(row, now_ns, woke_ns) else None

    def _fault(self, hub: Hub, now_ns: int, woke_ns: int, state: str) -> int:
        """Return the present fault's number in its drive family, or one of the reserved fault numbers."""
        if state != "fault":
            return NO_FAULT if state in ("stands", "runs") else FAULT_UNKNOWN
        value = self._fresh_value(hub, now_ns, woke_ns, "fault", "")
        if value is None or value != int(value) or not 0 < value < FAULT_WITHOUT_NUMBER:
            return FAULT_WITHOUT_NUMBER
        return int(value)

    def _age(self, hub: Hub, now_ns: int, woke_ns: int) -> int:
        """Return the time since the drive's newest value was requested, in ms."""
        answer = hub.last_answer(self._name)
        if answer is None:
            return NEVER
        if answer[1] < woke_ns:  # requested before a sleep of unknown length
            return LONGEST_AGE
        return min(max(now_ns - answer[1], 0) // 1_000_000, LONGEST_AGE)


class ChannelBlock:
    """The computed channels of one drive in the plant file's order, each as a float of two words."""

    def __init__(self, polled: PolledDrive) -> None:
        self._drive = polled.drive.name
        self.channels = polled.channels
        self.length = 2 * len(self.channels)

    def words(self, hub: Hub, now_ns: int) -> list[int]:
        """Return the words at the monotonic time `now_ns`; a value that is not fresh is NaN."""
        since_ns = hub.woke_ns()
        words: list[int] = []
        for channel in self.channels:
            row = hub.newest(self._drive, channel.name)
            value = row.value if row and is_fresh(row, now_ns, since_ns) else None
            words += struct.unpack(">2H", _float(math.nan if value is None else value))
        return words


def _float(value: float) -> bytes:
    try:
        return struct.pack(">f", value)
    except OverflowError:
        return struct.pack(">f", math.copysign(math.inf, value))


def _units(register: Register[Any]) -> tuple[str | None, ...]:
    """Return the units in which a register may be requested; None (any unit) is left out for raw counts."""
    is_raw = register.values is None and register.step is None
    return (register.value_unit,) if is_raw else (register.value_unit, None)


def _hundredths(value: float) -> int:
    count = value * _PER_UNIT
    return round(count) if abs(count) < 1 << 31 else NO_NUMBER


def _two_words(number: int) -> tuple[int, int]:
    return number >> 16 & 0xFFFF, number & 0xFFFF
