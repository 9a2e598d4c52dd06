"""SimulatedDrive: answers requests from its memory. The drive's class determines the memory's layout.

The input is a request with its time, the output is a reply or None. It has no port and no clock. The
protocols are Modbus (application protocol V1.1b3) and Delixi's own (third part of Delixi's "RS-485
communication protocol").
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, ClassVar, NamedTuple

from multidrop.core import Framing, Message
from multidrop.drive.family import Drive
from multidrop.drive.register import Access, Carrier, Kept, Register, Table
from multidrop.drive.request import STANDARD_LIMITS, read_limit
from multidrop.sim.memory import Memory, MemoryCell, decode, pack
from multidrop.sim.receiver import Frame

COIL_ON, COIL_OFF = b"\xff\x00", b"\x00\x00"

# Function codes of Delixi's own protocol.
COMMAND, STATE, SETPOINT, SET, STORE, QUERY = 0x02, 0x03, 0x04, 0x05, 0x06, 0x07
NO_DATA = bytes(4)  # unused D3..D0


class Reason(Enum):
    """A reason to refuse a request. Each family has an exception code for the reason, or sends no reply."""

    FUNCTION = "no such function"
    READ_ADDRESS = "nothing to be read there"
    WRITE_ADDRESS = "nothing to be written there"
    COUNT = "too many or none at all"
    VALUE = "outside its span"
    LOCKED = "not while the motor runs"
    CANNOT = "not in this state"
    BUSY = "storing"
    DAMAGED = "wrong checksum"


class Refusal(Exception):
    """Raised when the drive refuses a request, with the reason."""

    def __init__(self, reason: Reason) -> None:
        super().__init__(reason.value)
        self.reason = reason


@dataclass(frozen=True)
class DriveProtocol:
    """The functions of a protocol, and its exception codes by reason.

    Without a code for a reason, the drive does not reply.
    """

    answers: Mapping[int, Callable[[SimulatedDrive, Message], Message]]
    codes: Mapping[Reason, int]
    octets: int  # bytes in a request for one register, without the checksum
    no_data: bytes = b""  # data bytes of an exception reply


def _with_data(request: Message, data: bytes) -> Message:
    return Message(request.address, request.function, request.start, request.count, data)


def _read_words(sim: SimulatedDrive, request: Message) -> Message:
    raws = sim.read(request.function, request.start, request.count)
    return _with_data(request, b"".join(raw.to_bytes(2) for raw in raws))


def _read_bits(sim: SimulatedDrive, request: Message) -> Message:
    raws = sim.read(request.function, request.start, request.count)
    bits = sum(raw << at for at, raw in enumerate(raws))
    return _with_data(request, bits.to_bytes((request.count + 7) // 8, "little"))


def _write_one(sim: SimulatedDrive, request: Message) -> Message:
    sim.write(request.function, request.start, [int.from_bytes(request.data)])
    return request


def _write_coil(sim: SimulatedDrive, request: Message) -> Message:
    if request.data not in (COIL_ON, COIL_OFF):
        raise Refusal(Reason.VALUE)
    sim.write(request.function, request.start, [int(request.data == COIL_ON)])
    return request


def _write_words(sim: SimulatedDrive, request: Message) -> Message:
    raws = [int.from_bytes(request.data[at : at + 2]) for at in range(0, len(request.data), 2)]
    return _write_several(sim, request, raws)


def _write_coils(sim: SimulatedDrive, request: Message) -> Message:
    bits = int.from_bytes(request.data, "little")
    return _write_several(sim, request, [bits >> at & 1 for at in range(request.count)])


def _write_several(sim: SimulatedDrive, request: Message, raws: list[int]) -> Message:
    # the limit for the length of a read also applies to writes
    sim.check_count({0x0F: 0x01, 0x10: 0x03}[request.function], request.count)
    sim.write(request.function, request.start, raws)
    return Message(request.address, request.function, request.start, request.count)


def _return_query_data(sim: SimulatedDrive, request: Message) -> Message:
    if request.start != 0:  # of function 08, only subfunction 0 is simulated
        raise Refusal(Reason.FUNCTION)
    return request


def _command(sim: SimulatedDrive, request: Message) -> Message:
    sim.write(COMMAND, 0, [request.start])
    return request


def _state(sim: SimulatedDrive, request: Message) -> Message:
    (raw,) = sim.read(STATE, 0, 1)
    return Message(request.address, STATE, start=raw, data=NO_DATA)


def _query(sim: SimulatedDrive, request: Message) -> Message:
    (raw,) = sim.read(QUERY, request.start, 1)
    return Message(request.address, QUERY, request.start, data=raw.to_bytes(4))


MODBUS = DriveProtocol(
    {
        0x01: _read_bits,
        0x02: _read_bits,
        0x03: _read_words,
        0x04: _read_words,
        0x05: _write_coil,
        0x06: _write_one,
        0x08: _return_query_data,
        0x0F: _write_coils,
        0x10: _write_words,
    },
    {
        Reason.FUNCTION: 1,
        Reason.READ_ADDRESS: 2,
        Reason.WRITE_ADDRESS: 2,
        Reason.COUNT: 3,
        Reason.VALUE: 3,
        Reason.LOCKED: 4,
        Reason.CANNOT: 4,
        Reason.BUSY: 6,
    },
    octets=6,
)
DELIXI = DriveProtocol(
    {
        COMMAND: _command,
        STATE: _state,
        SETPOINT: _write_one,
        SET: _write_one,
        STORE: _write_one,
        QUERY: _query,
    },
    {
        Reason.FUNCTION: 0xF0,
        Reason.CANNOT: 0xF0,
        Reason.READ_ADDRESS: 0xFC,
        Reason.WRITE_ADDRESS: 0xFC,
        Reason.VALUE: 0xFD,
        Reason.LOCKED: 0xFE,
        Reason.DAMAGED: 0xFF,
    },
    octets=8,
    no_data=NO_DATA,
)
PROTOCOLS = {Framing.RTU: MODBUS, Framing.ASCII: MODBUS, Framing.TCP: MODBUS, Framing.DELIXI: DELIXI}


MOST_REMEMBERED = 10_000  # limit of a drive's recorded writes, to save memory
# writes whose length is limited like the length of a read, and the function code of that read
_COUNTED_AS = {0x06: 0x03, 0x10: 0x03}
# Longest silence within a frame, in s. Sources: the Modbus serial-line guide, 2.5.2.1; the third part of
# Delixi's document; for TCP an assumed long time.
GAPS = {Framing.ASCII: 1.0, Framing.DELIXI: 10e-3, Framing.TCP: 10.0}


class Written(NamedTuple):
    """A write that was carried out."""

    time: float
    name: str  # name of the written register
    address: int
    raw: int


@dataclass
class DriveCounters:
    """Counts of one drive's requests, replies and writes since it was created."""

    requests: int = 0  # number of requests, without broadcasts
    replies: int = 0  # refusals included
    refusals: int = 0
    broadcasts: int = 0
    damaged: int = 0  # number of damaged frames with the drive's address
    early: int = 0  # number of frames that came too soon after a reply
    functions: Counter[int] = field(default_factory=Counter)
    eeprom_writes: Counter[str] = field(default_factory=Counter)
    writes: deque[Written] = field(default_factory=lambda: deque(maxlen=MOST_REMEMBERED))


def _most_cells(drive: Drive) -> dict[int, int]:
    """Return the largest number of cells in one request, by the function code of reads.

    A register that is longer than the family's limit is still read whole.
    """
    most: dict[int, int] = {}
    held = [(register.table, len(register.reach)) for register in drive.registers.values()]
    for table, words in [*held, *((text.table, 1) for text in drive.texts.values())]:
        limit = min(max(read_limit(drive, table), words), STANDARD_LIMITS[table.carrier])
        for code in {table.read, _COUNTED_AS.get(table.write or 0)} - {None}:
            most[code or 0] = max(most.get(code or 0, 1), limit)
    return most


class SimulatedDrive:
    """A simulated drive of any class. Its registers keep the values written to them.

    `drive[name]` gets or sets a register's value in its unit, or a text. None means "no value".
    """

    # supported function codes; None: all functions of the protocol
    functions: ClassVar[Collection[int] | None] = None
    # exception codes by reason; None: the default codes of the protocol
    codes: ClassVar[Mapping[Reason, int] | None] = None
    needs_silence: ClassVar[bool] = False  # True if the drive ignores a frame without silence before it

    def __init__(self, drive: Drive, *, response_delay: float | None = None) -> None:
        self.drive = drive
        self.protocol = PROTOCOLS[drive.framing]
        self.response_delay = drive.response_delay if response_delay is None else response_delay
        self.memory = Memory(type(drive), drive.framing)
        self.counters = DriveCounters()
        self.now = 0.0  # time of the last request
        self.deaf_until = 0.0  # time in s until which all frames are ignored; inf: for ever
        self.most = _most_cells(drive)
        for proof in drive.identity_proofs:
            self.memory.set(drive.register(proof.register), proof.example)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.drive.name}>"

    def __getitem__(self, name: str) -> Any:
        if name in self.drive.texts:
            return self.memory.get_text(self.drive.texts[name])
        register = self.drive.register(name)
        for cell in self.memory.of(register):
            self.refresh(cell)
        return self.memory.get(register)

    def __setitem__(self, name: str, value: Any) -> None:
        if name in self.drive.texts:
            self.memory.set_text(self.drive.texts[name], value)
            return
        register = self.drive.register(name)
        if isinstance(value, str):  # the name of a named value; an unknown name raises ValueError
            value = register.parse(value)
        self.memory.set(register, value)
        for cell in self.memory.of(register):
            self.changed(cell)

    def pass_time(self, now: float) -> None:
        """Advance the drive's state to the time `now`."""

    def refresh(self, cell: MemoryCell) -> None:
        """Set the cell to the value that a read returns now (`self.now`)."""

    def accept(self, cell: MemoryCell, raw: int) -> int:
        """Return the raw count to store when `raw` is written. Raises Refusal if the drive rejects it."""
        register = cell.register
        if register is None or register.words > 1:
            return raw
        value = decode(register, raw)
        if value is None or not register.takes(value):
            raise Refusal(Reason.VALUE)
        return raw

    def _accept_long(self, raws: Mapping[MemoryCell, int]) -> None:
        """Raise Refusal if a write sets a value of several words outside the limits of its register."""
        for register in {cell.register for cell in raws if cell.register and cell.register.words > 1}:
            cells = self.memory.of(register)
            if all(cell in raws for cell in cells):
                data = b"".join(pack(cell.table, raws[cell]) for cell in cells)
                value = register.value_in(data, 0)
                if value is None or not register.takes(value):
                    raise Refusal(Reason.VALUE)

    def changed(self, cell: MemoryCell) -> None:
        """React to a change of a cell, by a write over the line or by the user of the simulator."""

    def eeprom_written(self) -> None:
        """React to a write to the EEPROM."""

    def accepts_broadcast(self, request: Message) -> bool:
        return self.drive.broadcasts

    @property
    def delay(self) -> float:
        """Time in s from the end of a request to the start of the reply."""
        return max(self.response_delay, self.silence)

    @property
    def silence(self) -> float:
        """The silence in s that the drive needs before and after an RTU frame. Text frames need none."""
        return self.drive.needed_silence() if self.drive.framing is Framing.RTU else 0.0

    @property
    def most_gap(self) -> float:
        """The silence in s within a frame after which the drive discards the bytes received before."""
        return GAPS.get(self.drive.framing, self.drive.settings.t3_5)

    def receive(self, frame: Frame) -> Message | None:
        """Return the reply to a frame for this drive or a broadcast; None if there is no reply."""
        if not frame.intact:
            self.counters.damaged += 1
            return self._answer_damaged(frame)
        if frame.message is not None:
            return self.answer(frame.message, frame.end)
        if not self._is_for_all(frame.address) and not self._knows(frame.function):
            return self.answer(Message(frame.address, frame.function), frame.end)
        return None  # the length does not fit the function code

    def _is_for_all(self, address: int) -> bool:
        return address == 0 and self.drive.framing is not Framing.TCP

    def _knows(self, function: int) -> bool:
        return function in (self.protocol.answers if self.functions is None else self.functions)

    def _answer_damaged(self, frame: Frame) -> Message | None:
        """Return the exception reply to a damaged request; None if the family has no code for that."""
        code = self._code(Reason.DAMAGED)
        whole = len(frame.body) == self.protocol.octets and self._knows(frame.function)
        if code is None or not whole or self._is_for_all(frame.address):
            return None
        return self.refused(Message(frame.address, frame.function), code)

    def _code(self, reason: Reason) -> int | None:
        return (self.protocol.codes if self.codes is None else self.codes).get(reason)

    def answer(self, request: Message, now: float) -> Message | None:
        """Carry out a request; return its reply, or None if the drive stays silent."""
        if now < self.deaf_until:
            return None
        self.now = now
        is_broadcast = self._is_for_all(request.address)
        if is_broadcast and self.accepts_broadcast(request):
            self.counters.broadcasts += 1
        elif request.address == self.drive.address:
            self.counters.requests += 1
            self.counters.functions[request.function] += 1
        else:
            return None
        self.pass_time(now)
        try:
            reply = self._carry_out(request)
        except Refusal as refusal:
            self.counters.refusals += 1
            code = self._code(refusal.reason)
            if code is None or is_broadcast:
                return None
            reply = self.refused(request, code)
        if is_broadcast:
            return None
        self.counters.replies += 1
        return reply

    def refused(self, request: Message, code: int) -> Message:
        return Message(request.address, request.function, data=self.protocol.no_data, exception=code)

    def _carry_out(self, request: Message) -> Message:
        if not self._knows(request.function):
            raise Refusal(Reason.FUNCTION)
        return self.protocol.answers[request.function](self, request)

    def check_count(self, function: int, count: int) -> None:
        if not 1 <= count <= self.most.get(function, 1):
            raise Refusal(Reason.COUNT)

    def read(self, function: int, start: int, count: int) -> list[int]:
        """Return the raw counts of `count` adjacent cells. Raises Refusal if a cell is unreadable."""
        self.check_count(function, count)
        raws = []
        for address in range(start, start + count):
            cell = self.memory.readable(function, address)
            if cell is None:
                raise Refusal(Reason.READ_ADDRESS)
            self.refresh(cell)
            raws.append(cell.raw)
        return raws

    def write(self, function: int, start: int, raws: list[int]) -> None:
        """Write raw numbers to adjacent addresses. Raises Refusal, and writes none, if one is rejected."""
        found = [self.memory.writable(function, start + at) for at in range(len(raws))]
        cells = [cell for cell in found if cell is not None]
        if len(cells) < len(raws):
            raise Refusal(Reason.WRITE_ADDRESS)
        self._accept_long(dict(zip(cells, raws, strict=True)))
        stored = [self.accept(cell, raw) for cell, raw in zip(cells, raws, strict=True)]
        for at, (cell, raw) in enumerate(zip(cells, stored, strict=True)):
            cell.raw = raw
            self.counters.writes.append(Written(self.now, cell.name, start + at, raw))
            if self.wears_eeprom(cell, function, start + at):
                self.counters.eeprom_writes[cell.name] += 1
                self.eeprom_written()
        for cell in cells:
            self.changed(cell)

    def wears_eeprom(self, cell: MemoryCell, function: int, address: int) -> bool:
        """Return True if a write to this cell may wear the EEPROM.

        A setting whose memory the document does not state counts as EEPROM, but a coil does not.
        """
        register = cell.register
        if register is None or (function, address) in self.memory.aliases:
            return False
        if register.kept is Kept.UNKNOWN:
            return register.access is Access.SETTING and register.table.carrier is not Carrier.BIT
        return register.kept is Kept.EEPROM


def encoded(address: int, table: Table, register_address: int) -> int:
    """Return the number that an EncodedDrive has at this address; for a coil, take the lowest bit."""
    return (address * 257 + register_address * 31 + (table.read or table.write or 0)) & 0x7FFF


def proof(drive: Drive, register: Register[Any]) -> float:
    """Return the value that a read of this EncodedDrive's register must return; NaN for "no value"."""
    if register in drive.known_counts():
        return register.coding.value_of(_known(drive, register))
    size = 2 if register.table.carrier is Carrier.WORD else 4
    data = b"".join(encoded(drive.address, register.table, at).to_bytes(size) for at in register.reach)
    number = register.number_in(data, register.address - register.reach.start)
    return math.nan if number is None else number


def _known(drive: Drive, register: Register[Any]) -> int:
    """Return a raw count within the known range of this register."""
    least, most = drive.known_counts()[register]
    raw = encoded(drive.address, register.table, register.address)
    return least + raw % (most - least + 1)


class EncodedDrive(SimulatedDrive):
    """A drive for tests: each register has its own fixed number, from which a test can tell the register.

    `encoded` computes the number. Writes are confirmed but change nothing.
    """

    def refresh(self, cell: MemoryCell) -> None:
        if cell.register and cell.register in self.drive.known_counts():
            cell.raw = _known(self.drive, cell.register)
            return
        bits = 1 if cell.table.carrier is Carrier.BIT else 0x7FFF
        cell.raw = encoded(self.drive.address, cell.table, cell.address) & bits

    def accept(self, cell: MemoryCell, raw: int) -> int:
        return cell.raw
