"""Shipped families command responders that are typed from the sources, independent of the simulation."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import pytest
from profile_families import shipped
from simulated_bus import SimulatedBus
from tables import table

from multidrop.core import Message
from multidrop.drive import Condition, Drive

ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, FAULT = 1, 2, 4
Word = tuple[int, int]  # address and value


@dataclass(frozen=True)
class Sheet:
    """Facts from a family's sources: registers at rest and while running, and the words of each verb."""

    rest: Mapping[int, int]  # all readable registers, with their values at rest
    turning: Mapping[int, int]
    tripped: Mapping[int, int]
    setpoint: Word  # write of a setpoint of 20 Hz
    starts: tuple[Word, ...]  # words of a start; the last one runs the motor
    stops: tuple[Word, ...]
    resets: tuple[Word, ...]
    shown: Mapping[str, float]  # values on the keypad while the motor turns, by register
    write: int = 6
    shows_setpoint: int = 0  # address of a register that repeats the setpoint
    passes: Mapping[Word, Mapping[int, int]] = field(default_factory=dict)  # effects of other words


SHEETS = {
    # Goodrive200A manual p. 138 to 141; the DC link is 556.4 V and the output 20 Hz.
    "invt-goodrive": Sheet(
        {0x2000: 0, 0x2001: 0, 0x2100: 3, 0x2102: 0, 0x2103: 0x0105, 0x3000: 0, 0x3002: 5564, 0x3004: 0},
        {0x2100: 1, 0x3000: 2000, 0x3004: 70},
        {0x2100: 4, 0x2102: FAULT},
        (0x2001, 2000),
        ((0x2000, 1),),
        ((0x2000, 5),),
        ((0x2000, 7),),
        {"output_frequency": 20, "dc_bus_voltage": 556.4, "output_current": 7},
    ),
    # CHE100 manual p. 117 to 119, and the row 3137, 5564, 293, 70, 1882, 262, 198 of the public log.
    "invt-chf100a": Sheet(
        {0x1000: 0, 0x1001: 3, 0x2000: 0, 0x3000: 0, 0x3002: 5564, 0x3006: 0, 0x3016: 0x0201, 0x5000: 0},
        {0x1001: 1, 0x3000: 3137, 0x3006: 262},
        {0x1001: 4, 0x5000: FAULT},
        (0x2000, 4000),
        ((0x1000, 1),),
        ((0x1000, 5),),
        ((0x1000, 7),),
        {"output_frequency": 31.37, "dc_bus_voltage": 556.4, "output_power": 2.62},
    ),
    # Fuling manual, sheets 50 and 51: 3000H is the setpoint, 3001H the output.
    "fuling-dzb": Sheet(
        {0x1000: 0, 0x1001: 3, 0x2000: 0, 0x3000: 200, 0x3001: 0, 0x5000: 0},
        {0x1001: 1, 0x3001: 199},
        {0x1001: 4, 0x5000: FAULT},
        (0x2000, 4000),
        ((0x1000, 1),),
        ((0x1000, 5),),
        ((0x1000, 7),),
        {"reference_frequency": 20, "output_frequency": 19.9},
    ),
    # DelixiProtocol.h: 6 ramps down and 5 coasts; vfd_controller.c: 2 is the status of reverse.
    "delixi-e": Sheet(
        {0xA000: 0, 0xA001: 0, 0xB000: 3, 0xB001: 0, 0x9000: 0, 0x9002: 0, 0x9004: 5401, 0x4102: 1},
        {0xB000: 1, 0x9000: 2000, 0x9002: 123},
        {0xB001: FAULT},
        (0xA001, 4000),
        ((0xA000, 1),),
        ((0xA000, 6),),
        ((0xA000, 7),),
        {"output_frequency": 20, "output_current": 1.23, "dc_bus_voltage": 540.1},
    ),
    # Powtran PI130 manual p. 115 and 116.
    "powtran-pi130": Sheet(
        {0x2000: 0, 0x1000: 0, 0x3000: 3, 0x8000: 0, 0x1001: 0},
        {0x3000: 1, 0x1001: 2000},
        {0x8000: FAULT},
        (0x1000, 4000),
        ((0x2000, 1),),
        ((0x2000, 6),),
        ((0x2000, 7),),
        {"output_frequency": 20},
    ),
    # A1000 manual 27G p. 559 to 561, 27C p. 494: bit 1 zero speed, 0 runs, 5 ready, 7 fault, 15 by the line.
    "yaskawa-a1000": Sheet(
        {1: 0, 2: 0, 0x23: 2000, 0x24: 0, 0x26: 0, 0x34: 0x4130, 0x4B: 0x8022, 0x80: 0},
        {0x4B: 0x8031, 0x24: 2000, 0x26: 84},
        {0x4B: 0x8082, 0x80: FAULT},
        (2, 2000),
        ((1, 1),),
        ((1, 0),),
        ((1, 8), (1, 0)),
        {"reference_in_force": 20, "output_frequency": 20, "output_current": 8.4},
        write=16,
    ),
    # C2000 Plus manual p.: bits 1 and 0 of 2101H are 00 at rest and 11 while it runs.
    "delta-cp2000": Sheet(
        {
            0x2000: 0,
            0x2001: 0,
            0x2002: 0,
            0x2100: 0,
            0x2101: 0x0500,
            0x2102: 0,
            0x2103: 0,
            0x2200: 0,
            0x0900: 1,
        },
        {0x2101: 0x0503, 0x2103: 2000, 0x2200: 840},
        {0x2100: FAULT},
        (0x2001, 2000),
        ((0x2000, 0x12),),
        ((0x2000, 0x01),),
        ((0x2002, 0x02), (0x2002, 0x00)),
        {"output_frequency": 20, "output_current": 8.4},
        shows_setpoint=0x2102,
    ),
    # ATV312.yaml, CMD 8501 and ETA 3201: 6 shut down, 7 switch on, 15 enable; 7 disables operation.
    "schneider-atv320": Sheet(
        {8501: 0, 8502: 0, 3201: 0x0250, 3202: 0, 3204: 0, 7121: 0},
        {3201: 0x0637, 3202: 200, 3204: 84},
        {3201: 0x0218},
        (8502, 200),
        ((8501, 6), (8501, 7), (8501, 15)),
        ((8501, 7),),
        ((8501, 0x87), (8501, 0x07)),
        {"output_frequency": 20, "output_current": 8.4},
        passes={(8501, 6): {3201: 0x0231}, (8501, 7): {3201: 0x0233}},
    ),
    # V20 manual (10/2019) p. 187, S120 p. 171: 047E is OFF1, bit 0 runs, bit 7 resets; 40100 is address 99.
    "siemens-v20": Sheet(
        {99: 0, 100: 0, 109: 0x0231, 110: 0, 15: 5000, 23: 0, 25: 0, 29: 540},
        {109: 0x0237, 23: 2000, 25: 840},
        {109: 0x0238},
        (100, 6554),
        ((99, 0x0476), (99, 0x0477), (99, 0x047F)),
        ((99, 0x047E),),
        ((99, 0x04FE), (99, 0x047E)),
        {"output_frequency": 20, "output_current": 8.4, "dc_bus_voltage": 540},
        passes={(99, 0x0477): {109: 0x0233}},
    ),
}
SHEETS["yaskawa-v1000"] = SHEETS["yaskawa-a1000"]


class Responder:
    """A drive with registers and a motor; it fails on any word that its sheet does not have."""

    def __init__(self, drive: Drive, sheet: Sheet) -> None:
        self.drive = drive
        self.sheet = sheet
        self.memory = dict(sheet.rest)
        self.words: list[Word] = []

    def answer(self, request: Message, now: float) -> Message:
        start, function = request.start, request.function
        if function == 3:
            span = range(start, start + request.count)
            if not all(address in self.memory for address in span):
                return Message(request.address, function, start, exception=ILLEGAL_ADDRESS)
            words = [self.memory[address] for address in span]
            return Message(request.address, function, start, data=struct.pack(f">{len(words)}H", *words))
        if function != self.sheet.write:
            return Message(request.address, function, start, exception=ILLEGAL_FUNCTION)
        (word,) = struct.unpack(">H", request.data[-2:])
        self.command((start, word))
        data = b"" if function == 16 else request.data
        return Message(request.address, function, start, request.count, data)

    def command(self, word: Word) -> None:
        sheet = self.sheet
        self.words.append(word)
        self.memory[word[0]] = word[1]
        if word[0] == sheet.setpoint[0] and sheet.shows_setpoint:
            self.memory[sheet.shows_setpoint] = word[1]
        if word == sheet.starts[-1]:
            self.memory |= sheet.turning
        elif word == sheet.resets[0]:
            self.memory |= {at: sheet.rest[at] for at in sheet.tripped}
        elif word in sheet.stops and not self.is_tripped:
            self.memory |= {at: sheet.rest[at] for at in sheet.turning}
        if not self.is_tripped:
            self.memory |= sheet.passes.get(word, {})

    @property
    def is_tripped(self) -> bool:
        return all(self.memory[at] == value for at, value in self.sheet.tripped.items())


@table("name", SHEETS)
def test_start_stop_and_reset_send_the_documented_words_and_readings_match(name: str) -> None:
    sheet, drive = SHEETS[name], shipped(name, 1)
    there: Any = Responder(drive, sheet)
    with pytest.MonkeyPatch.context() as monkeypatch:
        driven = SimulatedBus(monkeypatch, there).attach(drive)
        assert driven.state().condition is Condition.STOPPED
        driven.set_frequency(20)
        driven.start()
        assert driven.state().condition is Condition.RUNNING
        assert driven.read_many([driven.register(each) for each in sheet.shown]) == sheet.shown
        driven.stop()
        assert driven.state().condition is Condition.STOPPED
        assert there.words == [sheet.setpoint, *sheet.starts, *sheet.stops]
        there.memory |= sheet.tripped
        assert driven.state().condition is Condition.FAULT
        there.words.clear()
        driven.reset_fault()
        assert there.words == [*sheet.stops, *sheet.resets]  # no further word may run the motor
        assert driven.state().condition is Condition.STOPPED
