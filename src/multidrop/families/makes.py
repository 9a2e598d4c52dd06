"""Makes (brands) of drives that can be recognised by their registers, and the words that run their motors.

Two families may use one address for control words with different meanings. Then one family's stop word may
run the motor of another make. A stop is withheld only if registers of the drive show that it is of such a
make. MAKES lists these registers. A drive of the declared family refuses to read them, or has other values.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from multidrop.drive.family import Drive
from multidrop.drive.number_format import NumberFormat
from multidrop.drive.register import HOLDING, Register, reading
from multidrop.drive.verbs import Script, read
from multidrop.families.innovert_ibd import IBDBaudrate


class Evidence(Drive):
    """The registers by which makes are recognised, at the addresses in the makes' manuals."""

    goodrive_state = reading(0x2100, place="Goodrive200A manual p. 140")
    goodrive_device = reading(0x2103, place="Goodrive200A manual p. 140 to 142")
    powtran_setpoint = reading(0x1000, number_format=NumberFormat.I16, place="Powtran PI130 manual p. 116")
    powtran_state = reading(0x3000, place="Powtran PI130 manual p. 116")
    powtran_fault = reading(0x8000, place="Powtran PI500 manual p. 157")
    invt_state = reading(0x1001, place="CHE100 manual p. 117")
    invt_device = reading(0x3016, place="CHE100 manual p. 119")
    delta_address = reading(0x0900, place="CP2000 manual, 09-00")
    delta_status = reading(0x2101, place="MS300 manual p. 790")
    ibd_baudrate = reading(0x02BC, place="IBD manual, PrH.00, inferred")
    ibd_address = reading(0x02BE, place="IBD manual, PrH.02, inferred")
    delixi_baudrate = reading(0x01AC, place="Delixi document, P04.28")
    delixi_address = reading(0x01AE, place="Delixi document, P04.30")


Test = Callable[[int, Drive], bool]


@dataclass(frozen=True)
class Make:
    """A make of drives: its model name, its control words that run a motor, and how to recognise it."""

    model: str
    title: str
    control: int  # address of the control word, a holding register
    runs: Callable[[float], bool]  # function that returns True for a control word that runs the motor
    evidence: tuple[tuple[Register[Any], Test], ...]
    may_be_silent: bool = False  # True if such a drive may not reply to reads of missing registers
    copies: tuple[str, ...] = ()  # models whose drives have the same values in these registers

    def shows(self, drive: Drive) -> Script[bool]:
        """Return True if the drive's registers have the values that prove this make. It only reads."""
        for register, test in self.evidence:
            if not test(int((yield from read(register))), drive):
                return False
        return True


def _within(least: int, most: int) -> Test:
    return lambda value, drive: least <= value <= most


def _own_address(value: int, drive: Drive) -> bool:
    return bool(value == drive.address)


def _ibd_baudrate(value: int, drive: Drive) -> bool:
    return bool(IBDBaudrate.__members__.get(f"B{drive.settings.baudrate}") == value)


def _one_to_four(word: float) -> bool:
    return word in (1, 2, 3, 4)


def _bit_1(word: float) -> bool:
    """Return True if the control word runs or jogs the motor: its bits 1 and 0 are 10 (run) or 11 (jog)."""
    return bool(int(word) & 0x02)


def _delixi_baudrate(value: int, drive: Drive) -> bool:
    return value < 6 and (1200, 2400, 4800, 9600, 19200, 38400)[value] == drive.settings.baudrate


MAKES = (
    Make(
        "invt-goodrive",
        "INVT Goodrive",
        0x2000,
        _one_to_four,
        ((Evidence.goodrive_device, _within(0x0100, 0x01FF)), (Evidence.goodrive_state, _within(1, 5))),
    ),
    Make(
        "powtran-pi130",
        "Powtran PI130, Inovance MD or copy",
        0x2000,
        _one_to_four,
        (
            (Evidence.powtran_state, _within(1, 3)),
            (Evidence.powtran_fault, _within(0, 99)),
            (Evidence.powtran_setpoint, _within(-10_000, 10_000)),
        ),
    ),
    Make(
        "delta-vfd-el",
        "Delta",
        0x2000,
        _bit_1,
        ((Evidence.delta_address, _own_address), (Evidence.delta_status, _within(0x0000, 0x9FFF))),
    ),
    Make(
        "innovert-ibd",
        "INNOVERT IBD",
        0x2000,
        _bit_1,
        ((Evidence.ibd_address, _own_address), (Evidence.ibd_baudrate, _ibd_baudrate)),
        may_be_silent=True,
    ),
    Make(
        "delixi-modbus",
        "Delixi 9200 or 9100-SC",
        0x2000,
        _bit_1,
        ((Evidence.delixi_address, _own_address), (Evidence.delixi_baudrate, _delixi_baudrate)),
        may_be_silent=True,  # its document names no exceptions
    ),
    Make(
        "invt-che",
        "INVT CHE",
        0x1000,
        _one_to_four,
        ((Evidence.invt_device, _within(0x0101, 0x0102)), (Evidence.invt_state, _within(1, 4))),
        copies=("fuling-dzb",),
    ),
    Make(
        "invt-chf100a",
        "INVT CHF100A",
        0x1000,
        _one_to_four,
        ((Evidence.invt_device, _within(0x0200, 0x02FF)), (Evidence.invt_state, _within(1, 4))),
        copies=("fuling-dzb",),
    ),
)


def run_by(register: Register[Any], count: float) -> list[Make]:
    """Return the makes whose motors would run if this raw count were written to this register."""
    if register.table.read_space != HOLDING.read_space:
        return []
    return [make for make in MAKES if make.control == register.address and make.runs(count)]


def easily_mistaken_for(drive: Drive) -> list[Make]:
    """Return the makes that must be excluded before a write to a drive that cannot identify itself.

    A control word that is harmless on this drive, such as its stop, would run the motors of these makes.
    Makes that cannot be distinguished from the drive's model are included too.
    """
    control = drive.registers.get("control")
    harmless = control.harmless or () if control is not None else ()
    return [
        make
        for make in MAKES
        if drive.model in make.copies or any(control and make in run_by(control, each) for each in harmless)
    ]
