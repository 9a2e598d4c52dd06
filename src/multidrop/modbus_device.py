"""ModbusDevice: any Modbus device, read and written by address, without declared registers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from fractions import Fraction
from typing import Literal, overload

from multidrop.core import Framing, NumberFormat
from multidrop.drive import Drive
from multidrop.drive.number_format import FLOATS, ORDERS, WORDS, Coding
from multidrop.drive.request import DEVICE_ID, function_limit
from multidrop.errors import (
    Advice,
    BadReply,
    DriveException,
    LineError,
    NoReply,
    NotVerified,
    NoValue,
    Unconfirmed,
    WriteForbidden,
)
from multidrop.printable import is_number, is_whole

IntegerFormat = Literal["U16", "I16", "I8", "U32", "I32", "U64", "I64", "BCD16", "BCD32"]
FloatFormat = Literal["F16", "F32", "F64"]
Format = IntegerFormat | FloatFormat
Order = Literal["AB", "BA", "ABCD", "CDAB", "BADC", "DCBA"]

_FORMATS = {each.name: each for each in WORDS if each is not NumberFormat.U32_EITHER}
_MOST_WORDS, _MOST_COILS = 123, 1968  # limits of one write (application protocol V1.1b3, 6.11 and 6.12)
_BASIC_OBJECTS = 0x0100  # code of the basic objects in a device's identification (6.21)
_CONFIRM = "pass confirm=True"


class ModbusDevice(Drive):
    """A Modbus device without a declared family, whose tables are read and written by address.

    Addresses are those on the wire, from 0. Numbers have the formats of family files ("U16" to "F64") and the
    byte orders "ABCD", "CDAB", "BADC" and "DCBA". As for other drives, the library waits for the silence
    between frames, retries reads, detects late replies, and records writes in the audit log. A write needs
    `confirm=True`, because it may start a motor. If a device often does not answer, it may need a longer
    silence between frames than Modbus asks for: `ModbusDevice(7, silence=0.01)`, in s.
    """

    title = "Modbus device"
    framings = (Framing.RTU, Framing.ASCII)
    addresses = range(256)
    has_motor = False  # assumed: the user confirms for each write that it starts no motor
    response_timeout = 1.0

    @overload
    def read_holding(
        self, start: int, count: int = 1, *, format: IntegerFormat = "U16", order: Order = "ABCD"
    ) -> list[int]: ...
    @overload
    def read_holding(
        self, start: int, count: int = 1, *, format: FloatFormat, order: Order = "ABCD"
    ) -> list[float]: ...
    def read_holding(
        self, start: int, count: int = 1, *, format: Format = "U16", order: Order = "ABCD"
    ) -> list[int] | list[float]:
        """Return `count` numbers from the holding registers that start at address `start`.

        Raises NoReply, BadReply, DriveException or LineError if the read fails, and NoValue if a number is
        NaN or invalid BCD.
        """
        return self._numbers(3, "holding register", start, count, format, order)

    @overload
    def read_input(
        self, start: int, count: int = 1, *, format: IntegerFormat = "U16", order: Order = "ABCD"
    ) -> list[int]: ...
    @overload
    def read_input(
        self, start: int, count: int = 1, *, format: FloatFormat, order: Order = "ABCD"
    ) -> list[float]: ...
    def read_input(
        self, start: int, count: int = 1, *, format: Format = "U16", order: Order = "ABCD"
    ) -> list[int] | list[float]:
        """Return `count` numbers from the input registers that start at address `start`.

        Raises the errors of `read_holding`.
        """
        return self._numbers(4, "input register", start, count, format, order)

    def read_coils(self, start: int, count: int = 1) -> list[bool]:
        """Return `count` coils from address `start`. Raises the errors of `read_holding`."""
        return self._bits(1, start, count)

    def read_discrete(self, start: int, count: int = 1) -> list[bool]:
        """Return `count` discrete inputs from address `start`. Raises the errors of `read_holding`."""
        return self._bits(2, start, count)

    def read_identification(self) -> dict[int, bytes]:
        """Return the device's basic identification by function 43: its objects by number.

        Object 0 is the vendor's name, 1 the product code, and 2 the revision. Raises the errors of
        `read_holding`.
        """
        found: dict[int, bytes] = {}
        first = 0
        while True:
            data = self.link.read_raw(self, DEVICE_ID, _BASIC_OBJECTS | first, 0, attempts=3)
            has_more, following = data[3] == 0xFF, data[4]
            found |= _objects_of(data[6:])
            if not has_more or following <= first:
                return found
            first = following

    def write_holding(
        self,
        start: int,
        values: float | Sequence[float],
        format: Format = "U16",
        *,
        order: Order = "ABCD",
        confirm: bool = False,
        multiple: bool = False,
    ) -> list[float]:
        """Write a number or several to the holding registers from `start`; return what the device then holds.

        One register is written by function 6, several by function 16. With `multiple`, function 16 also
        writes one register. The registers are then read back; if the device refuses that read, the written
        numbers are returned. Raises WriteForbidden without `confirm=True`, and ValueError for a number that
        does not fit. Raises NotVerified if the device holds other numbers, and Unconfirmed if the write may
        have happened.
        """
        coding = _coding(format, order)
        numbers = values if isinstance(values, Sequence) else [values]
        data = b"".join(coding.pack(_raw(number, format, coding)) for number in numbers)
        words = len(data) // 2
        what = _named("holding register", start, words)
        self._check_write(what, words, _MOST_WORDS, confirm)
        if words == 1 and not multiple:
            self.send_raw(6, start, data)
        else:
            self.send_raw(16, start, data, count=words)
        held = self._read_back(what, 3, start, words) or data
        found = list(_decoded(held, coding, len(numbers)))
        if held != data:
            raise NotVerified(self.name, what, f"the device holds {found}")
        return [float("nan") if number is None else number for number in found]

    def mask_holding(self, start: int, and_mask: int, or_mask: int, *, confirm: bool = False) -> int:
        """Set bits of the holding register `start`; return the number that the device then holds.

        By function 22 the device keeps the bits of `and_mask`, and sets the others as in `or_mask`. Raises
        the errors of `write_holding`, and Unconfirmed if the device refuses to be read back: its number is
        then unknown.
        """
        what = f"holding register {start}"
        self._check_write(what, 1, _MOST_WORDS, confirm)
        coding = _coding("U16", "ABCD")
        masks = b"".join(coding.pack(_raw(mask, "U16", coding)) for mask in (and_mask, or_mask))
        self.send_raw(0x16, start, masks)
        found = self._read_back(what, 3, start, 1)
        if not found:
            raise Unconfirmed(self.name, what, "the device refuses the read that would confirm the write")
        held = int.from_bytes(found)
        if (held ^ or_mask) & ~and_mask & 0xFFFF:
            raise NotVerified(self.name, what, f"the device holds {held}")
        return held

    def write_coils(
        self, start: int, values: bool | Sequence[bool], *, confirm: bool = False, multiple: bool = False
    ) -> list[bool]:
        """Write a coil or several from `start`, and return the coils that the device then holds.

        If the device refuses to be read back, the written coils are returned. Raises the errors of
        `write_holding`.

        One coil is written by function 5, several by function 15. With `multiple`, function 15 also writes
        one coil.
        """
        coils = values if isinstance(values, Sequence) else [values]
        for coil in coils:
            if coil not in (True, False):
                raise TypeError(f"a coil is True or False, not {coil!r}")
        count = len(coils)
        what = _named("coil", start, count)
        self._check_write(what, count, _MOST_COILS, confirm)
        bits = sum(bool(coil) << at for at, coil in enumerate(coils)).to_bytes((count + 7) // 8, "little")
        if count == 1 and not multiple:
            self.send_raw(5, start, b"\xff\x00" if coils[0] else b"\x00\x00")
        else:
            self.send_raw(15, start, bits, count=count)
        held = [*_bits_of(self._read_back(what, 1, start, count) or bits, count)]
        if held != [bool(coil) for coil in coils]:
            raise NotVerified(self.name, what, f"the device holds {held}")
        return held

    # ---- requests ----

    def _numbers(
        self, function: int, what: str, start: int, count: int, format: Format, order: Order
    ) -> list[float]:
        coding = _coding(format, order)
        words = WORDS[coding.number_format]
        most = max(1, function_limit(self, function) // words)
        found: list[float | None] = []
        for at, part in _parts(start, count, most, words):
            found += _decoded(self.link.read_raw(self, function, at, part * words, attempts=3), coding, part)
        for number, value in enumerate(found):
            if value is None:
                held = {f"{what} {start + i * words}": one for i, one in enumerate(found) if one is not None}
                raise NoValue(self.name, f"{what} {start + number * words}", held)
        return [value for value in found if value is not None]

    def _bits(self, function: int, start: int, count: int) -> list[bool]:
        found: list[bool] = []
        for at, part in _parts(start, count, function_limit(self, function), 1):
            found += _bits_of(self.link.read_raw(self, function, at, part, attempts=3), part)
        return found

    def _check_write(self, what: str, count: int, most: int, confirm: bool) -> None:
        if not 1 <= count <= most:
            raise ValueError(f"one write takes 1 to {most} registers or coils, not {count}")
        if confirm is not True:
            raise WriteForbidden(
                f"nothing is written to {what} of the unknown device {self.name}, because a write may start "
                f"a motor. If this write cannot start a motor, {_CONFIRM}",
                rule="an unknown device is not written to",
                advice=Advice(_CONFIRM, "declare its family"),
            )

    def _read_back(self, what: str, function: int, start: int, count: int) -> bytes:
        """Return the data that the device holds after a write; b"" if the device refuses the read.

        This read is needed because the reply to the write may have been only an adapter's echo.
        """
        try:
            return self.link.read_raw(self, function, start, count, attempts=3)
        except DriveException:  # the device answers, but these registers cannot be read
            return b""
        except (NoReply, BadReply, LineError) as failure:
            raise Unconfirmed(self.name, what, f"it could not be read back: {failure}") from failure


def _named(kind: str, start: int, count: int) -> str:
    return f"{kind}s {start} to {start + count - 1}" if count > 1 else f"{kind} {start}"


def _parts(start: int, count: int, most: int, words: int) -> Iterator[tuple[int, int]]:
    """Yield the start address and the number of values of each request that reads `count` values."""
    if not is_whole(count) or count < 1:
        raise ValueError(f"count = {count!r} is not 1 or more")
    if not is_whole(start):
        raise TypeError(f"start = {start!r} is not a whole number")
    for done in range(0, count, most):
        yield start + done * words, min(most, count - done)


def _coding(format: str, order: str) -> Coding:
    if format not in _FORMATS:
        raise ValueError(f"format = {format!r} is not one of {', '.join(_FORMATS)}")
    if order not in ORDERS:
        raise ValueError(f"order = {order!r} is not one of {', '.join(ORDERS)}")
    return Coding(_FORMATS[format], order)


def _raw(value: float, format: str, coding: Coding) -> float:
    """Return the number to encode for `value`. Raises TypeError or ValueError if it does not fit `format`."""
    if not is_number(value):
        raise TypeError(f"{value!r} is not a number")
    if not abs(value) < float("inf"):
        raise ValueError(f"{value!r} is not a finite number")
    least, most = coding.raw_span
    if not least <= Fraction(value) <= most:
        raise ValueError(f"{value:g} does not fit into {format}; write {float(least):g} to {float(most):g}")
    if coding.number_format not in FLOATS and value != int(value):
        raise ValueError(f"the format {format} needs a whole number, not {value:g}")
    return coding.count_of(value)


def _decoded(data: bytes, coding: Coding, count: int) -> Iterator[float | None]:
    words = WORDS[coding.number_format]
    for at in range(0, count * words, words):
        raw = coding.raw_in(data, at)
        yield raw if raw is None or coding.number_format in FLOATS else int(raw)


def _objects_of(data: bytes) -> dict[int, bytes]:
    """Return the content of each object by its number. `data` has number, length and content of each."""
    found: dict[int, bytes] = {}
    at = 0
    while at < len(data):
        number, length = data[at : at + 2]
        found[number] = data[at + 2 : at + 2 + length]
        at += 2 + length
    return found


def _bits_of(data: bytes, count: int) -> Iterator[bool]:
    return (bool(data[bit // 8] >> bit % 8 & 1) for bit in range(count))
