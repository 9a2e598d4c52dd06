"""The 16-bit words that Modbus clients read: words that a drive has sent, and the drive's common block.

Polled values are numbers in units, but Modbus clients expect the drive's raw words. Batches of polled values
do not keep the raw words, which would cost 8 bytes per value. So a word is computed from the value, and used
only if it is certain: encoding the value as a raw count and decoding it must give the value again, and the
neighbouring counts must give other values.

The words of some registers are always uncertain: a register that is only a part of a word, one that has a
scale register, and one with the format `I8` or `U32_EITHER`, which do not determine all bits. A float's zero
is uncertain too, because its sign is unknown.

The common block has a drive's state, values and stop at the same addresses and in the same units for every
drive. Numbers of two words have the high word first. A value that is not fresh reads as a reserved number,
never as 0. The computed channels of a drive are in a second block.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable
from enum import Enum
from functools import lru_cache
from typing import Any, NamedTuple

from multidrop import PolledDrive, Register
from multidrop.core import NumberFormat
from multidrop.drive import Carrier, Table
from multidrop.gateway.live.hub import Hub, KeptRow

_FLOATS = {NumberFormat.F16: (">e", ">H"), NumberFormat.F32: (">f", ">I"), NumberFormat.F64: (">d", ">Q")}
_OPEN = frozenset({NumberFormat.I8, NumberFormat.U32_EITHER})
MOST_KNOWN = 8192  # limit of the cached values; all drives of a family share the cache
_MOST_EXACT = 1 << 53  # a float64 represents every whole number up to this one
_FUNCTIONS = {Carrier.BIT: (1, 2), Carrier.WORD: (3, 4)}
COMMON_LENGTH = 16  # number of words in the common block, which is the same for every drive
# places in the common block: number of words before the value
STATE, FAULT, FREQUENCY, CURRENT, SETPOINT, AGE, STOP = 0, 1, 2, 4, 6, 8, 10
STATES = {"unknown": 0, "stands": 1, "runs": 2, "fault": 3, "silent": 4}
NO_FAULT, FAULT_WITHOUT_NUMBER, FAULT_UNKNOWN = 0, 0xFFFE, 0xFFFF
NO_NUMBER = -(1 << 31)  # 8000 0000H: the value is unknown, or out of range
# ages in ms: reserved number for "no value was read yet", and the largest age
NEVER, LONGEST_AGE = 0xFFFF_FFFF, 0xFFFF_FFFE
_PER_UNIT = 100


def reading_function(table: Table) -> int:
    """Return the Modbus function code, 1 to 4, that reads a table; 0 if there is none."""
    code = table.read or 0
    return code if code in _FUNCTIONS.get(table.carrier, ()) else 0


class Unavailable(Enum):
    """The reason why polled values cannot answer a read."""

    UNPOLLED = "not polled, or the words are uncertain"
    STALE = "polled, but the newest read has failed or is old"


def is_certain(register: Register[Any]) -> bool:
    """Return True if the words that the drive sent can be computed from the register's value.

    They cannot if the register is a part of a word, if another register holds its scale, or if its number
    format is one of _OPEN.
    """
    coding = register.coding
    return register.part is None and not register.scale_register and coding.number_format not in _OPEN


@lru_cache(maxsize=MOST_KNOWN)
def exact_data(register: Register[Any], value: float) -> bytes | None:
    """Return the bytes that the drive sends for this value (a coil: one byte, 0 or 1).

    Return None if they are uncertain.
    """
    coding = register.coding
    if not is_certain(register):
        return None
    try:
        if coding.number_format is NumberFormat.BIT:
            found = [bit for bit in (0, 1) if coding.value_of(bit) == value]
            return bytes(found) if len(found) == 1 else None
        raw = _nearest_count(register, value)
        if raw is None:
            return None
        data = coding.pack(raw)
        again = register.number_in(data, 0)
        if again is None or float(again) != value:
            return None
        near = _neighbours(raw, coding.number_format)
        if any(float(coding.value_of(other)) == value for other in near):
            return None
    except (ArithmeticError, ValueError, struct.error):  # no raw count has this value
        return None
    return data


def _nearest_count(register: Register[Any], value: float) -> float | None:
    """Return the raw count whose value is nearest to this value; None if other counts may have it too."""
    multiplier, addend, divisor = register.coding.factors
    count = value if multiplier == divisor and not addend else (value * divisor - addend) / multiplier
    if register.coding.number_format not in _FLOATS:
        raw = round(count)
        return raw if abs(raw * multiplier) + abs(addend) <= _MOST_EXACT else None
    code, _ = _FLOATS[register.coding.number_format]
    held: float = struct.unpack(code, struct.pack(code, count))[0]
    return held if held else None  # a zero may be the float 0.0 or -0.0, which are different words


def _neighbours(raw: float, number_format: NumberFormat) -> Iterable[float]:
    """Return the raw counts just below and above a raw count."""
    if number_format not in _FLOATS:
        return (raw - 1, raw + 1)
    as_float, as_bits = _FLOATS[number_format]
    bits = struct.unpack(as_bits, struct.pack(as_float, raw))[0]
    near = [struct.unpack(as_float, struct.pack(as_bits, other))[0] for other in (bits - 1, bits + 1)]
    return [other for other in near if math.isfinite(other)]


class _PolledRegister:
    """A polled register, and the raw words computed from its latest value."""

    __slots__ = ("_data", "_register", "_value", "name")

    def __init__(self, register: Register[Any]) -> None:
        self.name = register.name
        self._register = register
        self._value: float | None = None
        self._data: bytes | None = None

    def word(self, row: KeptRow | None, at: int) -> int | Unavailable:
        """Return the word at the offset `at` in the value of a fresh row, or why it is unknown."""
        if row is None:
            return Unavailable.STALE
        value = row[2]
        if value != self._value:
            self._value, self._data = value, exact_data(self._register, value)
        data = self._data
        if data is None:
            return Unavailable.UNPOLLED
        return data[0] if len(data) == 1 else data[2 * at] << 8 | data[2 * at + 1]


class DriveWords:
    """The raw words of one drive's polled registers, by function code and address."""

    def __init__(self, polled: PolledDrive) -> None:
        self._at: dict[tuple[int, int], list[tuple[_PolledRegister, int]]] = {}
        self.registers: set[str] = set()  # names of the registers for which `is_certain` is True
        for poll in polled.polls:
            register = poll.register
            function = reading_function(register.table)
            if not function:
                continue
            found = _PolledRegister(register)
            if is_certain(register):
                self.registers.add(register.name)
            for at in range(register.words):
                key = function, register.address + at
                self._at.setdefault(key, []).append((found, at))

    def read(
        self, function: int, addresses: range, fresh: Callable[[str], KeptRow | None]
    ) -> list[int] | Unavailable:
        """Return the words or bits at these addresses from fresh polled values, or why that is impossible.

        `fresh` returns the newest row of a register by name, if it has a fresh value.
        """
        words: list[int] = []
        reasons: list[Unavailable] = []
        for address in addresses:
            found = self._at.get((function, address))
            if found is None:
                return Unavailable.UNPOLLED
            if len(found) == 1:
                polled, at = found[0]
                word = polled.word(fresh(polled.name), at)
            else:
                word = _newest_word([(fresh(polled.name), polled, at) for polled, at in found])
            if isinstance(word, Unavailable):
                reasons.append(word)
            else:
                words.append(word)
        if reasons:
            return Unavailable.UNPOLLED if Unavailable.UNPOLLED in reasons else Unavailable.STALE
        return words


def _newest_word(found: list[tuple[KeptRow | None, _PolledRegister, int]]) -> int | Unavailable:
    """Return the word at an address that belongs to several registers. The newest read decides."""
    reason = Unavailable.STALE
    for row, polled, at in sorted(found, key=lambda one: -one[0][1] if one[0] else 0):
        word = polled.word(row, at)
        if not isinstance(word, Unavailable):
            return word
        if word is Unavailable.UNPOLLED:
            reason = word
    return reason


# ---- the common block, and the computed channels ----


class CommonNumber(NamedTuple):
    """A number in the common block: the addresses with the same meaning for every drive.

    The address map, a table for the users of Modbus clients, has these fields too.
    """

    name: str
    at: int  # number of words before this number in the block
    words: int
    format: str
    step: float
    unit: str | None  # None: the unit of the drive's setpoint
    unknown: int  # the reserved number that means "no current value"
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
    """A drive's state and main values, at the same addresses for every drive. Computed on request."""

    length = COMMON_LENGTH

    def __init__(self, polled: PolledDrive) -> None:
        self._name = polled.drive.name
        self._polled = {(poll.register.name, unit) for poll in polled.polls for unit in _units(poll.register)}
        self._numbers = (
            (FREQUENCY, "output_frequency", "Hz"),
            (CURRENT, "output_current", "A"),
            (SETPOINT, polled.drive.setpoint_name, None),
        )

    def words(self, hub: Hub) -> list[int]:
        """Return all words of the drive's common block."""
        state = hub.state(self._name)
        words = [0] * COMMON_LENGTH
        words[STATE] = STATES.get(state, 0)
        words[FAULT] = self._fault(hub, state)
        for at, name, unit in self._numbers:
            value = self._fresh_value(hub, name, unit)
            words[at : at + 2] = _two_words(NO_NUMBER if value is None else _hundredths(value))
        words[AGE : AGE + 2] = _two_words(self._age(hub))
        return words

    def _fresh_value(self, hub: Hub, name: str, unit: str | None) -> float | None:
        """Return a polled register's fresh value; None if there is none, or if its unit is not `unit`.

        With `unit` None, any unit fits.
        """
        row = hub.fresh(self._name, name) if (name, unit) in self._polled else None
        return row[2] if row else None

    def _fault(self, hub: Hub, state: str) -> int:
        """Return the drive's own number of the present fault, or one of the reserved fault numbers."""
        if state != "fault":
            return NO_FAULT if state in ("stands", "runs") else FAULT_UNKNOWN
        value = self._fresh_value(hub, "fault", "")
        if value is None or not value.is_integer() or not 0 < value < FAULT_WITHOUT_NUMBER:
            return FAULT_WITHOUT_NUMBER
        return int(value)

    def _age(self, hub: Hub) -> int:
        """Return the time since the drive's newest value was requested, in ms."""
        answer = hub.last_answer(self._name)
        if answer is None:
            return NEVER
        if answer[1] < hub.woke_ns():  # the computer slept after the request, for an unknown time
            return LONGEST_AGE
        return min(max(hub.now_ns() - answer[1], 0) // 1_000_000, LONGEST_AGE)


class ChannelBlock:
    """The computed channels of one drive in the plant file's order, each as a float of two words."""

    def __init__(self, polled: PolledDrive) -> None:
        self._drive = polled.drive.name
        self.channels = polled.channels
        self.length = 2 * len(self.channels)

    def words(self, hub: Hub) -> list[int]:
        """Return the block's words. A value that is not fresh is NaN."""
        rows = [hub.fresh(self._drive, channel.name) for channel in self.channels]
        return [word for row in rows for word in struct.unpack(">2H", _float(row[2] if row else math.nan))]


def _float(value: float) -> bytes:
    try:
        return struct.pack(">f", value)
    except OverflowError:
        return struct.pack(">f", math.copysign(math.inf, value))


def _units(register: Register[Any]) -> tuple[str | None, ...]:
    """Return the units in which callers may ask for this register. None stands for "any unit".

    A register of unknown scale is returned only to callers that ask for raw counts.
    """
    is_raw = register.values is None and register.step is None
    return (register.value_unit,) if is_raw else (register.value_unit, None)


def _hundredths(value: float) -> int:
    count = value * _PER_UNIT
    return round(count) if abs(count) < 1 << 31 else NO_NUMBER


def _two_words(number: int) -> tuple[int, int]:
    return number >> 16 & 0xFFFF, number & 0xFFFF
