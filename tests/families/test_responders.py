"""Each of the 25 families commands two simulated drives: one typed from the manuals, and the library's.

The responder shares no code and no table with the library: it splits, checks and builds frames itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import checksums
import pytest
from profile_families import READ_ONLY, shipped
from responder import DriveRequest, split
from simulated_bus import SimulatedBus, one
from tables import table

from multidrop.drive import Condition, Drive
from multidrop.errors import Unsupported
from multidrop.families import MODELS
from multidrop.families.registry import SHIPPED, find_model

ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, FAULT = 1, 2, 4
# the addresses of input registers and coils have these numbers added
INPUT, COIL, ON = 0x10000, 0x20000, 0xFF00
Word = tuple[int, int]  # address and value of a register that is written


@dataclass(frozen=True)
class Sheet:
    """A family's manual as tables: register values at rest and while running, and the words of each verb."""

    rest: Mapping[int, int]  # values at rest of all readable registers, by address
    shown: Mapping[str, float]  # values on the keypad while the motor turns, by register name
    turning: Mapping[int, int] = field(default_factory=dict)
    tripped: Mapping[int, int] = field(default_factory=dict)
    setpoint: Word = (0, 0)  # the write that sets a setpoint of 20 Hz
    starts: tuple[Word, ...] = ()  # the writes of a start; the last one runs the motor
    stops: tuple[Word, ...] = ()
    reset: Word | None = None  # the write that resets a fault; None if the document has none
    before_reset: tuple[Word, ...] | None = None  # writes before the reset; None: the writes of a stop
    after_reset: tuple[Word, ...] = ()  # writes after the reset
    write: int = 6
    shows_setpoint: int = 0  # address of a register that shows the setpoint; 0: there is none
    # register values that each write causes
    passes: Mapping[Word, Mapping[int, int]] = field(default_factory=dict)
    standing: Condition = Condition.STOPPED  # condition that the drive reports at rest
    failed: Condition = Condition.FAULT  # condition that the drive reports in a fault


# ER-G-220-01(02) protocol 1.4, section 10. Reads of reserved registers are answered with 0 (section 6).
ERMAN = Sheet(
    dict.fromkeys(range(0x59), 0)
    | dict.fromkeys(range(INPUT, INPUT + 0x1000), 0)
    | {3: 500, 4: 0, 0x0D: 10, INPUT + 26: 250},
    {"output_frequency": 20, "output_current": 1.5},
    {INPUT + 0x401: 1, INPUT + 1: 200, INPUT + 3: 15},
    {INPUT + 0x403: 0x40},
    (2, 200),
    ((COIL + 1, 0), (COIL + 2, 0), (COIL + 0, ON)),
    ((COIL + 1, ON), (COIL + 0, 0)),
    (COIL + 9, ON),
    before_reset=((COIL + 0, 0),),
    after_reset=((COIL + 9, 0),),
    # 0402H is the last fault, which may have been reset, so the state shows only that the motor is at rest
    failed=Condition.STOPPED,
)
# CP2000 manual p. 12.1-09-8, MS300 p. 788 to 790, VFD-EL-W p. 4-83: bits 1 and 0 of 2101H are 00 at rest.
DELTA = Sheet(
    dict.fromkeys((0x2000, 0x2001, 0x2002, 0x2100, 0x2102, 0x2103), 0) | {0x2101: 0x0500, 0x0900: 1},
    {"output_frequency": 20},
    {0x2101: 0x0503, 0x2103: 2000},
    {0x2100: FAULT},
    (0x2001, 2000),
    ((0x2000, 0x12),),
    ((0x2000, 0x01),),
    (0x2002, 0x02),
    after_reset=((0x2002, 0x00),),
    shows_setpoint=0x2102,
)


def with_registers(
    sheet: Sheet, rest: Mapping[int, int], turning: Mapping[int, int], **shown: float
) -> Sheet:
    """Return a copy of the sheet with more registers, and with more values on the keypad."""
    return replace(
        sheet, rest={**sheet.rest, **rest}, turning={**sheet.turning, **turning}, shown=sheet.shown | shown
    )


SHEETS = {
    "erman-er-g-220": ERMAN,
    # Template of the wb-community project: input register 26 is the water pressure, holding register 98 its
    # setpoint.
    "erman-er-g-220-02": with_registers(ERMAN, {98: 300}, {}, water_pressure=2.5, pressure_setpoint=3),
    # ERMANGIZER protocol of 2026, p. 2: register 5 counts 0.01 bar; register 14 is a letter.
    "erman-er-g-220-03": Sheet(
        {1: 350, 3: 230, 5: 305, 14: 72, 17: 250, 0x1000: 300},
        {"output_frequency": 35, "input_voltage": 230, "pressure": 3.05, "pressure_setpoint": 3},
    ),
    # Source: the public program erman.py. Input registers start at 2000; parameter Pnnn is at 1000 + nnn.
    "erman-er-g-220-05": Sheet(
        {INPUT + 2000: 350, INPUT + 2004: 4, INPUT + 2006: 305, 1100: 0, 1001: 300, 1006: 1000},
        {"output_frequency": 35, "pressure": 3.05, "pressure_setpoint": 3},
    ),
    # CHE100 manual p. 117 to 119; scales of the Goodrive300L manual, p. 130.
    "invt-che": Sheet(
        dict.fromkeys(range(0x3000, 0x3017), 0)
        | {0x1000: 0, 0x1001: 3, 0x2000: 0, 0x3016: 0x0101, 0x5000: 0},
        {"output_frequency": 20, "output_current": 7},
        {0x1001: 1, 0x3000: 2000, 0x3004: 70},
        {0x1001: 4, 0x5000: FAULT},
        (0x2000, 4000),
        ((0x1000, 1),),
        ((0x1000, 5),),
        (0x1000, 7),
        before_reset=(),
    ),
    # INNOVERT IBD manual p. 128 to 134: outputs programmed as in the example; PrA.22 has bits 11 and 12 set.
    "innovert-ibd": Sheet(
        {22: 0x1800, 101: 5, 102: 2, 108: 100, 323: 1, 324: 7, 325: 8, 328: 3, 700: 1, 702: 1, 3: 0, 4: 0},
        {"output_current": 2.5},
        {22: 0x1900, 3: 25, 4: 1450},
        {22: 0x3800},
        (0x2001, 2000),
        ((0x2000, 0x02),),
        ((0x2000, 0x01),),
        (0x2000, 0x10),
        after_reset=((0x2000, 0x01),),
    ),
    # Source: the public program stand_drive.py. PA02 is the frequency, PA27 the fault and PA28 the state;
    # Pb01 = 5 and Pb02 = 2.
    "innovert-idd-mini-plus": Sheet(
        {2: 0, 3: 0, 22: 0, 0x1B: 0, 0x1C: 0, 101: 5, 102: 2, 108: 100},
        {"output_frequency": 20, "output_current": 2.5},
        {2: 200, 3: 25, 0x1C: 1},
        {0x1B: FAULT},
        (0x2001, 2000),
        ((0x2000, 0x02),),
        ((0x2000, 0x01),),
        (0x2000, 0x10),
        after_reset=((0x2000, 0x01),),
    ),
    # Delixi protocol, part 2: no reset is documented, and at 0 Hz the motor may run at a setpoint of 0.
    "delixi-modbus": Sheet(
        {0: 2, 1: 1, 2: 0, 428: 3, 430: 1, 500: 0, 531: 0},
        {"output_frequency": 20},
        {500: 2000},
        {531: FAULT},
        (2, 2000),
        ((0x2000, 0x12),),
        ((0x2000, 0x01),),
        standing=Condition.UNKNOWN,
    ),
    # Delixi protocol, part 3. Function codes: 02 run command, 03 state, 04 setpoint, 07 read of parameters.
    "delixi-native": Sheet(
        {0: 2, 1: 1, 428: 3, 430: 1, 500: 0, 531: 0, 0x30000: 1},
        {"output_frequency": 20},
        {0x30000: 2, 500: 2000},
        {0x30000: 4, 531: FAULT},
        (0x40001, 2000),
        ((0x20002, 0),),
        ((0x20001, 0),),
        (0x20004, 0),
        before_reset=(),
    ),
    # YD1000 communication notes, sections 6 to 8. A reset restarts the drive, so a stop is sent after it.
    "yd1000": Sheet(
        dict.fromkeys((0x1001, 0x1100, 0x1200, 0x1201, 0x1203, 0x1206, 0x1210, 0x0110, 0x0803), 0)
        | {0x0010: 100, 0x0011: 8000, 0x0802: 1},
        {"output_frequency": 20, "output_current": 50},
        {0x1100: 2000, 0x1201: 0x0400, 0x1203: 5000},
        {0x1210: FAULT},
        (0x1001, 2000),
        ((0x1000, 0xC400),),
        ((0x1000, 0xC000),),
        (0x1000, 0xE000),
        before_reset=(),
        after_reset=((0x1000, 0xC000),),
    ),
    # Goodrive200A manual p. 138 to 141; the DC link is 556.4 V and the output 20 Hz.
    "invt-goodrive": Sheet(
        {0x2000: 0, 0x2001: 0, 0x2100: 3, 0x2102: 0, 0x2103: 0x0105, 0x3000: 0, 0x3002: 5564, 0x3004: 0},
        {"output_frequency": 20, "dc_bus_voltage": 556.4, "output_current": 7},
        {0x2100: 1, 0x3000: 2000, 0x3004: 70},
        {0x2100: 4, 0x2102: FAULT},
        (0x2001, 2000),
        ((0x2000, 1),),
        ((0x2000, 5),),
        (0x2000, 7),
    ),
    # The registers are from the CHE100 manual, p. 117 to 119. The values 3137, 5564, 293, 70, 1882, 262 and
    # 198 are from a log that an owner of this drive has published.
    "invt-chf100a": Sheet(
        {0x1000: 0, 0x1001: 3, 0x2000: 0, 0x3000: 0, 0x3002: 5564, 0x3006: 0, 0x3016: 0x0201, 0x5000: 0},
        {"output_frequency": 31.37, "dc_bus_voltage": 556.4, "output_power": 2.62},
        {0x1001: 1, 0x3000: 3137, 0x3006: 262},
        {0x1001: 4, 0x5000: FAULT},
        (0x2000, 4000),
        ((0x1000, 1),),
        ((0x1000, 5),),
        (0x1000, 7),
    ),
    # Fuling manual, sheets 50 and 51: 3000H is the setpoint, 3001H the output.
    "fuling-dzb": Sheet(
        {0x1000: 0, 0x1001: 3, 0x2000: 0, 0x3000: 200, 0x3001: 0, 0x5000: 0},
        {"reference_frequency": 20, "output_frequency": 19.9},
        {0x1001: 1, 0x3001: 199},
        {0x1001: 4, 0x5000: FAULT},
        (0x2000, 4000),
        ((0x1000, 1),),
        ((0x1000, 5),),
        (0x1000, 7),
    ),
    # DelixiProtocol.h: 6 ramps down and 5 coasts; vfd_controller.c: 2 is the status of reverse.
    "delixi-e": Sheet(
        {0xA000: 0, 0xA001: 0, 0xB000: 3, 0xB001: 0, 0x9000: 0, 0x9002: 0, 0x9004: 5401, 0x4102: 1},
        {"output_frequency": 20, "output_current": 1.23, "dc_bus_voltage": 540.1},
        {0xB000: 1, 0x9000: 2000, 0x9002: 123},
        {0xB001: FAULT},
        (0xA001, 4000),
        ((0xA000, 1),),
        ((0xA000, 6),),
        (0xA000, 7),
    ),
    # Powtran PI130 manual p. 115 and 116.
    "powtran-pi130": Sheet(
        {0x2000: 0, 0x1000: 0, 0x3000: 3, 0x8000: 0, 0x1001: 0},
        {"output_frequency": 20},
        {0x3000: 1, 0x1001: 2000},
        {0x8000: FAULT},
        (0x1000, 4000),
        ((0x2000, 1),),
        ((0x2000, 6),),
        (0x2000, 7),
    ),
    # A1000 manual 27G p. 559 to 561, 27C p. 494. Status bits: 0 motor runs, 1 speed is zero, 5 ready,
    # 7 fault, 15 run commands come from the bus.
    "yaskawa-a1000": Sheet(
        {1: 0, 2: 0, 0x23: 2000, 0x24: 0, 0x26: 0, 0x34: 0x4130, 0x4B: 0x8022, 0x80: 0},
        {"reference_in_force": 20, "output_frequency": 20, "output_current": 8.4},
        {0x4B: 0x8031, 0x24: 2000, 0x26: 84},
        {0x4B: 0x8082, 0x80: FAULT},
        (2, 2000),
        ((1, 1),),
        ((1, 0),),
        (1, 8),
        after_reset=((1, 0),),
        write=16,
    ),
    # C2000 Plus manual p. A-12: 2200H counts 0.01 A. VFD-EL-W p. 4-84: 2104H counts 0.1 A.
    # MS300 p. 790: 2105H counts 0.1 V.
    "delta-cp2000": with_registers(DELTA, {0x2200: 0}, {0x2200: 840}, output_current=8.4),
    "delta-vfd-el": with_registers(DELTA, {0x2104: 0}, {0x2104: 84}, output_current=8.4),
    "delta-ms300": with_registers(DELTA, {0x2105: 5401}, {}, dc_bus_voltage=540.1),
    # Source: the public register list ATV312.yaml. Register 8501 (CMD) takes commands, 3201 (ETA) shows the
    # status. The commands 6, 7 and 15, one after another, start the motor; 7 stops it.
    "schneider-atv320": Sheet(
        {8501: 0, 8502: 0, 3201: 0x0250, 3202: 0, 3204: 0, 7121: 0},
        {"output_frequency": 20, "output_current": 8.4},
        {3201: 0x0637, 3202: 200, 3204: 84},
        {3201: 0x0218},
        (8502, 200),
        ((8501, 6), (8501, 7), (8501, 15)),
        ((8501, 7),),
        (8501, 0x87),
        after_reset=((8501, 0x07),),
        passes={(8501, 6): {3201: 0x0231}, (8501, 7): {3201: 0x0233}},
    ),
    # V20 manual (10/2019) p. 187, S120 p. 171: the control word 047EH stops (OFF1), bit 0 runs the motor,
    # bit 7 resets a fault. Register 40100 has the address 99.
    "siemens-v20": Sheet(
        {99: 0, 100: 0, 109: 0x0231, 110: 0, 15: 5000, 23: 0, 25: 0, 29: 540},
        {"output_frequency": 20, "output_current": 8.4, "dc_bus_voltage": 540},
        {109: 0x0237, 23: 2000, 25: 840},
        {109: 0x0238},
        (100, 6554),
        ((99, 0x0476), (99, 0x0477), (99, 0x047F)),
        ((99, 0x047E),),
        (99, 0x04FE),
        after_reset=((99, 0x047E),),
        passes={(99, 0x0477): {109: 0x0233}},
    ),
    # ACS355 manual p. 308 to 319: 20000 is REF1 MAX; parameter 0103 is register 40103, so address 102.
    "abb-acs355": Sheet(
        {0: 0, 1: 0, 3: 0x0231, 102: 0, 103: 0, 106: 540, 400: 0, 5301: 1, 5304: 2},
        {"output_frequency": 20, "output_current": 8.4, "dc_bus_voltage": 540},
        {3: 0x0337, 102: 200, 103: 84},
        {3: 0x0238, 400: FAULT},
        (1, 8000),
        ((0, 0x0476), (0, 0x0477), (0, 0x047F)),
        ((0, 0x047E),),
        (0, 0x04FE),
        after_reset=((0, 0x047E),),
        passes={(0, 0x0477): {3: 0x0233}},
    ),
    # FC 51 MG02A4 p. 29 and 33: register 50000 has the address 49999; 4000H is 100 %.
    # Status bits: 3 tripped, 11 running.
    "danfoss-fc51": Sheet(
        {50199: 0x0207, 50209: 0, 16129: 0, 16299: 540, 8299: 2, 8309: 1},
        {"output_frequency": 20, "main_actual_value": 40, "dc_bus_voltage": 540},
        {50199: 0x0F07, 50209: 6554, 16129: 200},
        {50199: 0x0209},
        (50009, 6554),
        ((49999, 0x047C),),
        ((49999, 0x043C),),
        (49999, 0x04BC),
        after_reset=((49999, 0x043C),),
    ),
    # ODE-3 user guide p. 33: register 1 has the address 0. E3 manual p. 35, status bits: 0 running,
    # 1 tripped, 6 ready.
    "optidrive-e3": Sheet(
        {0: 0, 1: 0, 5: 0x0040, 6: 0, 7: 0, 22: 540, 139: 3},
        {"output_frequency": 20, "output_current": 8.4, "dc_bus_voltage": 540},
        {5: 0x0041, 6: 200, 7: 84},
        {5: FAULT << 8 | 0x0002},
        (1, 200),
        ((0, 0x0001),),
        ((0, 0x0000),),
        (0, 0x0004),
        after_reset=((0, 0x0000),),
    ),
}
SHEETS["yaskawa-v1000"] = SHEETS["yaskawa-a1000"]
COMMANDED = [name for name in SHEETS if name not in READ_ONLY]


class Responder:
    """A simulated drive with registers and a motor. It only knows its sheet, and no code of this library."""

    def __init__(self, sheet: Sheet) -> None:
        self.sheet = sheet
        self.memory = dict(sheet.rest)
        self.words: list[Word] = []

    def answer(self, frame: bytes) -> bytes:
        """Carry out a request; return the reply."""
        _, asked, rest = split(frame)
        assert asked is not None, "the checksum is right"
        assert not rest
        if frame[:1] == b":":
            return self._reply_in_delixis_protocol(asked, frame)
        head = f"{asked.address:02X}{asked.function:02X}"
        if asked.function in (3, 4):
            first = asked.start + (INPUT if asked.function == 4 else 0)
            span = range(first, first + asked.value)
            if not self.memory.keys() >= {*span}:
                return self._refuse(asked, ILLEGAL_ADDRESS)
            return checksums.rtu(
                f"{head}{2 * len(span):02X}" + "".join(f"{self.memory[at]:04X}" for at in span)
            )
        if asked.function not in (self.sheet.write, 5):
            return self._refuse(asked, ILLEGAL_FUNCTION)
        self.command((asked.start + (COIL if asked.function == 5 else 0), asked.value))
        return checksums.rtu(f"{head}{asked.start:04X}0001") if asked.function == 16 else frame

    def _refuse(self, asked: DriveRequest, code: int) -> bytes:
        return checksums.rtu(f"{asked.address:02X}{asked.function | 0x80:02X}{code:02X}")

    def _reply_in_delixis_protocol(self, asked: DriveRequest, frame: bytes) -> bytes:
        head = f"{asked.address:02X}{asked.function:02X}"
        if asked.function == 3:
            return checksums.delixi(f"{head}{self.memory[0x30000]:04X}00000000")
        if asked.function == 7:
            return checksums.delixi(f"{head}{asked.start:04X}{self.memory[asked.start]:08X}")
        self.command((asked.function << 16 | asked.start, asked.value))
        return frame

    def command(self, word: Word) -> None:
        sheet = self.sheet
        self.words.append(word)
        self.memory[word[0]] = word[1]
        if word[0] == sheet.setpoint[0] and sheet.shows_setpoint:
            self.memory[sheet.shows_setpoint] = word[1]
        if word == sheet.starts[-1]:
            self.memory |= sheet.turning
        elif word == sheet.reset:
            self.memory |= {at: sheet.rest[at] for at in sheet.tripped}
        elif word in sheet.stops and not self.is_tripped:
            self.memory |= {at: sheet.rest[at] for at in sheet.turning}
        if not self.is_tripped:
            self.memory |= sheet.passes.get(word, {})

    @property
    def is_tripped(self) -> bool:
        return all(self.memory[at] == value for at, value in self.sheet.tripped.items())


def made(name: str) -> Drive:
    """Return a drive of this family, with the options that the family requires."""
    if name in COMMANDED and name in SHIPPED:
        return shipped(name, 1)
    return find_model(name)(1, **({"maximum_frequency": 50} if name == "invt-che" else {}))


def connected(name: str) -> tuple[Any, Responder]:
    """Return a drive on a bus, and the responder that receives its frames."""
    there = Responder(SHEETS[name])
    line = SimulatedBus()

    def answer(request: object) -> bytes:
        sent = line.frames[-1][1]
        return there.answer(f"{sent}\r\n".encode() if sent.startswith(":") else bytes.fromhex(sent))

    line.answers = answer
    return line.attach(made(name)), there


def values(drive: Any, names: Mapping[str, float]) -> dict[str, float]:
    return {name: drive.read(name) for name in names}


def test_each_of_the_25_families_has_an_independent_simulated_drive() -> None:
    assert {*SHEETS} == {*MODELS, *SHIPPED}
    assert len(SHEETS) == 25


@table("name", COMMANDED)
def test_the_commands_of_each_family_are_those_of_its_manual(name: str) -> None:
    sheet = SHEETS[name]
    driven, there = connected(name)
    assert driven.state().condition is sheet.standing
    driven.set_frequency(20)
    driven.start()
    assert driven.state().condition is Condition.RUNNING
    assert values(driven, sheet.shown) == pytest.approx(sheet.shown, abs=0.005)
    driven.stop()
    assert driven.state().condition is sheet.standing
    assert there.words == [sheet.setpoint, *sheet.starts, *sheet.stops]
    there.memory |= sheet.tripped
    assert driven.state().condition is sheet.failed
    there.words.clear()
    if sheet.reset is None:
        with pytest.raises(Unsupported):
            driven.reset_fault()
        return
    driven.reset_fault()
    before = sheet.stops if sheet.before_reset is None else sheet.before_reset
    assert there.words == [*before, sheet.reset, *sheet.after_reset]  # any other word could run the motor
    assert driven.state().condition is sheet.standing


@table("name", READ_ONLY)
def test_the_read_only_families_return_the_values_of_their_manuals(name: str) -> None:
    drive, there = connected(name)
    drive.bus.check_identity(drive)
    assert values(drive, SHEETS[name].shown) == SHEETS[name].shown
    assert there.words == []


@pytest.mark.long
@table("name", COMMANDED)
def test_simulation_of_each_family_obeys_every_command(name: str) -> None:
    sheet = SHEETS[name]
    line, drive, sim = one(made(name))
    assert drive.state().condition is sheet.standing
    drive.set_frequency(20)
    drive.start()
    line.sleep(30)
    assert drive.state().condition is Condition.RUNNING
    assert {*drive.read_many(drive.readings())} == {register.name for register in drive.readings()}
    assert sim.motor.frequency == pytest.approx(20, abs=0.005)
    drive.stop()
    assert not sim.motor.energised
    sim.trip(FAULT)
    assert drive.state().condition is sheet.failed
    if sheet.reset is not None:
        drive.reset_fault()
        assert not sim.motor.fault
        assert drive.state().condition is sheet.standing
