"""SimulatedDrive: answers requests out of its memory, as the drive's class declares it.

It knows neither ports nor clocks: a request and the time at which it was understood come in, the
reply or nothing comes out. What one family does differently is in that family's file.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, ClassVar, NamedTuple

from multidrop.core import Framing, Message
from multidrop.drive import Drive
from multidrop.register import Access, Carrier, Kept
from multidrop.sim.memory import Cell, Memory
from multidrop.sim.receiver import Frame

MOST_REMEMBERED = 10_000  # writes, so that memory stays flat
MOST_CELLS = {Carrier.BIT: 2000, Carrier.WORD: 125, Carrier.LONG: 1, Carrier.NUMBER: 1}  # in any reply
ASCII_GAP = 1.0  # s (serial-line guide 2.5.2.1)
COIL_ON = b"\xff\x00"


class Reason(Enum):
    """Why a drive refuses; each family has its own code for it, or says nothing."""

    FUNCTION = "no such function"
    READ_ADDRESS = "nothing to be read there"
    WRITE_ADDRESS = "nothing to be written there"
    COUNT = "too many or none at all"
    VALUE = "outside its span"
    LOCKED = "not while the motor runs"
    CANNOT = "not in this state"
    BUSY = "storing"


class Refusal(Exception):
    """The drive does not do what it was asked."""

    def __init__(self, reason: Reason) -> None:
        super().__init__(reason.value)
        self.reason = reason


class Written(NamedTuple):
    """One write that was carried out."""

    time: float
    name: str  # of the register
    address: int
    raw: int


@dataclass
class Counters:
    """What a drive has seen since it was made."""

    requests: int = 0  # addressed to it alone
    replies: int = 0  # of which refusals
    refusals: int = 0
    broadcasts: int = 0
    damaged: int = 0  # frames that seemed to be for it
    early: int = 0  # came before the silence was over, and were not understood
    functions: Counter[int] = field(default_factory=Counter)
    eeprom_writes: Counter[str] = field(default_factory=Counter)
    writes: deque[Written] = field(default_factory=lambda: deque(maxlen=MOST_REMEMBERED))


class SimulatedDrive:
    """A drive of any class: its registers hold what is written to them.

    `drive[name]` is a register's value in its own unit, to be read and set from outside.
    """

    functions: ClassVar[Collection[int]] = (0x01, 0x02, 0x03, 0x04, 0x05, 0x06, 0x08, 0x0F, 0x10)
    codes: ClassVar[Mapping[Reason, int]] = {  # a reason without a code is answered with silence
        Reason.FUNCTION: 1,
        Reason.READ_ADDRESS: 2,
        Reason.WRITE_ADDRESS: 2,
        Reason.COUNT: 3,
        Reason.VALUE: 3,
        Reason.LOCKED: 4,
        Reason.CANNOT: 4,
        Reason.BUSY: 6,
    }

    def __init__(self, drive: Drive, *, response_delay: float | None = None) -> None:
        self.drive = drive
        self.response_delay = drive.response_delay if response_delay is None else response_delay
        self.memory = Memory(type(drive), drive.framing)
        self.counters = Counters()
        self.now = 0.0  # of the last request
        self.deaf_until = 0.0  # it hears nothing before
        self.most = {  # cells in one request, by the function code that reads them
            table.read: min(most, MOST_CELLS[table.carrier]) for table, most in drive.most_registers.items()
        }

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.drive.name}>"

    def __getitem__(self, name: str) -> Any:
        register = self.drive.register(name)
        for cell in self.memory.of(register):
            self.refresh(cell)
        return self.memory.get(register)

    def __setitem__(self, name: str, value: float) -> None:
        register = self.drive.register(name)
        self.memory.set(register, value)
        for cell in self.memory.of(register):
            self.changed(cell)

    # ---- what a family may replace ----

    def pass_time(self, now: float) -> None:
        """Bring the drive to the time `now`."""

    def refresh(self, cell: Cell) -> None:
        """Make the cell hold what is to be read from it now."""

    def accept(self, cell: Cell, raw: int) -> int:
        """What is stored when this is written; raises Refusal."""
        register = cell.register
        if register is None or register.words > 1:
            return raw
        if register.values is not None:
            known = isinstance(register.decode(raw), register.values)
        elif register.span is not None:
            known = register.span[0] <= register.decode(raw) <= register.span[1]
        else:
            known = True
        if not known:
            raise Refusal(Reason.VALUE)
        return raw

    def changed(self, cell: Cell) -> None:
        """The cell was written, by the line or from outside: act on it."""

    def wore(self) -> None:
        """The EEPROM was written."""

    def takes_broadcast(self, request: Message) -> bool:
        return self.drive.broadcasts

    def answer_damaged(self, frame: Frame) -> Message | None:
        """The reply to a frame with a wrong checksum whose address seems to be this drive's."""
        return None

    # ---- the line's side ----

    @property
    def delay(self) -> float:
        """From the request's end to the reply's begin: never within the silence after an RTU frame."""
        silence = self.drive.needed_silence() if self.drive.framing is Framing.RTU else 0.0
        return max(self.response_delay, silence)

    @property
    def most_gap(self) -> float:
        """Silence in s within a frame that makes the drive throw away what came before it."""
        return ASCII_GAP if self.drive.framing is Framing.ASCII else self.drive.settings.t3_5

    def hear(self, frame: Frame) -> Message | None:
        """The reply to a frame of the line, whoever it is for."""
        if frame.address not in (self.drive.address, 0):
            return None
        if not frame.intact:
            self.counters.damaged += 1
            return self.answer_damaged(frame) if frame.address else None
        if frame.message is not None:
            return self.answer(frame.message, frame.end)
        if frame.address and frame.function not in self.functions:
            return self.answer(Message(frame.address, frame.function), frame.end)
        return None  # of a length that its function does not have

    def answer(self, request: Message, now: float) -> Message | None:
        """Carry out a request; its reply, or None where the drive keeps silent."""
        if now < self.deaf_until:
            return None
        self.now = now
        if request.address == 0:
            self._obey_broadcast(request, now)
            return None
        if request.address != self.drive.address:
            return None
        self.counters.requests += 1
        self.counters.functions[request.function] += 1
        self.pass_time(now)
        try:
            reply = self.carry_out(request)
        except Refusal as refusal:
            self.counters.refusals += 1
            code = self.codes.get(refusal.reason)
            if code is None:
                return None
            reply = self.refused(request, code)
        self.counters.replies += 1
        return reply

    def _obey_broadcast(self, request: Message, now: float) -> None:
        if not self.takes_broadcast(request):
            return
        self.counters.broadcasts += 1
        self.pass_time(now)
        try:
            self.carry_out(request)
        except Refusal:
            self.counters.refusals += 1

    def refused(self, request: Message, code: int) -> Message:
        return Message(request.address, request.function, exception=code)

    # ---- Modbus ----

    def carry_out(self, request: Message) -> Message:
        if request.function not in self.functions:
            raise Refusal(Reason.FUNCTION)
        return _ANSWERS[request.function](self, request)

    def _read(self, request: Message) -> list[int]:
        if not 1 <= request.count <= self.most.get(request.function, 1):
            raise Refusal(Reason.COUNT)
        cells = [self.memory.readable(request.function, request.start + at) for at in range(request.count)]
        return [self.read_cell(cell) for cell in cells]

    def read_cell(self, cell: Cell | None) -> int:
        if cell is None:
            raise Refusal(Reason.READ_ADDRESS)
        self.refresh(cell)
        return cell.raw

    def _read_words(self, request: Message) -> Message:
        data = b"".join(raw.to_bytes(2) for raw in self._read(request))
        return Message(request.address, request.function, request.start, request.count, data)

    def _read_bits(self, request: Message) -> Message:
        bits = sum(raw << at for at, raw in enumerate(self._read(request)))
        data = bits.to_bytes((request.count + 7) // 8, "little")
        return Message(request.address, request.function, request.start, request.count, data)

    def _write_one(self, request: Message) -> Message:
        self.write(request.function, request.start, [int.from_bytes(request.data)])
        return request

    def _write_coil(self, request: Message) -> Message:
        if request.data not in (COIL_ON, b"\0\0"):
            raise Refusal(Reason.VALUE)
        self.write(request.function, request.start, [int(request.data == COIL_ON)])
        return request

    def _write_words(self, request: Message) -> Message:
        data = request.data
        return self._write_several(
            request, [int.from_bytes(data[at : at + 2]) for at in range(0, len(data), 2)]
        )

    def _write_coils(self, request: Message) -> Message:
        bits = int.from_bytes(request.data, "little")
        return self._write_several(request, [bits >> at & 1 for at in range(request.count)])

    def _write_several(self, request: Message, raws: list[int]) -> Message:
        reads = {0x0F: 0x01, 0x10: 0x03}[request.function]  # the limits are the same
        if not 1 <= request.count <= self.most.get(reads, 1):
            raise Refusal(Reason.COUNT)
        self.write(request.function, request.start, raws)
        return Message(request.address, request.function, request.start, request.count)

    def write(self, function: int, start: int, raws: list[int]) -> None:
        """Write neighbouring cells: all of them, or none when one is refused."""
        cells: list[Cell] = []
        for at in range(len(raws)):
            cell = self.memory.writable(function, start + at)
            if cell is None:
                raise Refusal(Reason.WRITE_ADDRESS)
            cells.append(cell)
        stored = [self.accept(cell, raw) for cell, raw in zip(cells, raws, strict=True)]
        for at, (cell, raw) in enumerate(zip(cells, stored, strict=True)):
            cell.raw = raw
            self.counters.writes.append(Written(self.now, cell.name, start + at, raw))
            if self.wears(cell, function, start + at):
                self.counters.eeprom_writes[cell.name] += 1
                self.wore()
        for cell in cells:
            self.changed(cell)

    def wears(self, cell: Cell, function: int, address: int) -> bool:
        """Whether such a write wears the EEPROM; one to a setting of which nothing is known does."""
        register = cell.register
        if register is None or (function, address) in self.memory.aliases:
            return False
        if register.kept is Kept.UNKNOWN:
            return register.access is Access.SETTING
        return register.kept is Kept.EEPROM

    def _echo(self, request: Message) -> Message:
        if request.start != 0:  # subfunction 0: return query data
            raise Refusal(Reason.FUNCTION)
        return request


_ANSWERS: Mapping[int, Callable[[SimulatedDrive, Message], Message]] = {
    0x01: SimulatedDrive._read_bits,
    0x02: SimulatedDrive._read_bits,
    0x03: SimulatedDrive._read_words,
    0x04: SimulatedDrive._read_words,
    0x05: SimulatedDrive._write_coil,
    0x06: SimulatedDrive._write_one,
    0x08: SimulatedDrive._echo,
    0x0F: SimulatedDrive._write_coils,
    0x10: SimulatedDrive._write_words,
}
