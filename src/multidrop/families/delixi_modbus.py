"""Delixi 9200 with RTU firmware (RTU, ASCII) and 9100-SC (ASCII): standard Modbus."""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from typing import Any

from multidrop.drive import Framing, WriteForbidden
from multidrop.drive.register import HOLDING, Kept, Register, command, setting
from multidrop.drive.script import Script, insist, read, write
from multidrop.drive.state import Condition, Direction, State
from multidrop.drive.verbs import verb
from multidrop.families.delixi_parameters import KEYPAD, DelixiBaudrate, DelixiParameters, parameter


class DelixiModbusControl(IntEnum):
    """The control words that this library sends: run and jog include a direction; the toggle is not used."""

    NOTHING = 0x00
    STOP = 0x01
    FORWARD = 0x12
    REVERSE = 0x22
    JOG_FORWARD = 0x13
    JOG_REVERSE = 0x23


class DelixiModbusFormat(IntEnum):
    """Values of P04.29, the character format, in firmware for standard Modbus."""

    ASCII_7N2 = 0
    ASCII_7E1 = 1
    ASCII_7O1 = 2
    RTU_8N2 = 3
    RTU_8E1 = 4
    RTU_8O1 = 5


class DelixiModbus(DelixiParameters, table=HOLDING):
    """Delixi 9200 (RTU firmware) and 9100-SC; RS-485 communication protocol, part 2, standard Modbus.

    P04.29 selects RTU or ASCII on a 9200; a 9100-SC has ASCII only. For other models use `delixi-native`.
    Where the document errs or is silent, the safest interpretation applies:

    - The address of the setpoint in RAM is printed "xxH". The only known setpoint is 0002H (P00.02), which
      wears the EEPROM. It is written on change only, so do not ramp with it.
    - Whether a run command without a direction keeps the previous direction is not stated, so every run
      command has a direction. `start` without a direction goes forward from rest. It is refused while the
      motor turns, because the direction cannot be read. The word that toggles the direction is never sent.
    - It is not stated whether a start ends a jog, or whether a jog ends a run. So after a jog a stop is
      required before a start, and a turning motor must be stopped before a jog.
    - No fault reset is documented, and reserved bits are not tried.
    - No state word is documented: an output frequency of 0 may mean a stop, or a run at a setpoint of 0.
    - "3800" bit/s is a misprint of 4800. The fault "0C-xx" is OC-2, and 04 is OU.
    - How many registers one request may read is not stated, so each request reads one. Exception codes are
      not stated either, so any exception counts as a refusal.
    - Timing is taken from part 3 of the document.

    With P00.00 = 2 the drive takes commands from the line; with P00.01 = 1 it takes the setpoint from P00.02.
    Only functions 03 and 06 are used. Only run commands may be broadcast.
    """

    model = "delixi-modbus"
    title = "Delixi 9200/9100-SC (Modbus)"
    manual = "Delixi inverters, RS-485 communication protocol, part 2, standard Modbus"

    framings = (Framing.RTU, Framing.ASCII)
    formats = {  # P04.29
        Framing.RTU: ("8N2", "8E1", "8O1"),
        Framing.ASCII: ("7N2", "7E1", "7O1"),
    }
    most_registers = {HOLDING: 1}  # no example reads more
    exceptions = {}
    broadcasts = True
    identify_recognises = True
    remote = "P00.00 must be 2 (RS-485), and P00.01 1 (digital setting)"

    control = command(
        0x2000,
        DelixiModbusControl,
        broadcast=(DelixiModbusControl.STOP,),
        harmless=(DelixiModbusControl.NOTHING, DelixiModbusControl.STOP),
        place="part 2, section 3: 2000H",
    )
    frequency = setting(
        parameter(0, 2),
        "Hz",
        step=0.01,
        kept=Kept.EEPROM,
        place="P00.02",
        note="Every write wears the EEPROM. Used if P00.01 = 1.",
    )
    format_setting = setting(parameter(4, 29), DelixiModbusFormat, never=KEYPAD, place="P04.29")

    _jogged = False  # True if this object has sent a jog since it last saw the motor at rest

    def known_counts(self) -> Mapping[Register[Any], tuple[int, int]]:
        """Return the known counts of P04.30 (address) and P04.28 (baud rate), and those of the bus voltage.

        Only a bus voltage of 32 or more counts as known: addresses end at 31, so the ranges do not overlap.
        """
        known = {self.address_setting: (self.address, self.address), self.dc_bus_voltage: (32, 0xFFFF)}
        code = DelixiBaudrate.__members__.get(f"B{self.settings.baudrate}", self.address)
        return known if code == self.address else known | {self.baudrate_setting: (code, code)}

    @verb
    def identify(self) -> Script[None]:
        """Check that P04.30 is the drive's address, P04.28 its baud rate, and P05.31 a fault code."""
        yield from self._shows_its_line()
        fault = yield from read(self.fault)
        if not isinstance(fault, type(self.fault.decode(0))):
            raise WriteForbidden(
                f"{self.name} has {int(fault):04X}H as its present fault (P05.31), a code that the manual "
                f"does not list: it may be another make; look at its name plate"
            )

    @verb
    def start(self, direction: Direction | None = None) -> Script[None]:
        """Start at the setpoint in force. Without a direction: forward, and only from rest."""
        if self._jogged and not (yield from self._stands()):
            raise self._stop_first("may still jog, and a start may not end the jog:")
        forward = yield from self._forward(direction)
        if (yield from read(self.frequency_source)) != 1:
            raise WriteForbidden(f"{self.name} takes no setpoint from P00.02: set P00.01 to 1 on the keypad")
        yield from self._setpoint_in_force()
        self._jogged = False
        yield from write(
            self.control, DelixiModbusControl.FORWARD if forward else DelixiModbusControl.REVERSE
        )
        yield from self._started(direction)

    @verb
    def jog(self, direction: Direction | None = None) -> Script[None]:
        """Turn slowly from rest until stopped; without a direction, forward."""
        forward = yield from self._forward(direction)
        if not (yield from self._stands()):
            raise self._stop_first("turns, and may continue to turn during a jog:")
        self._jogged = True
        yield from write(
            self.control, DelixiModbusControl.JOG_FORWARD if forward else DelixiModbusControl.JOG_REVERSE
        )
        yield from self._started(direction)

    def _forward(self, direction: Direction | None) -> Script[bool]:
        yield from self._may_start()
        if direction is None and not (yield from self._stands()):
            raise WriteForbidden(f"{self.name} turns, and cannot report which way: give the direction")
        return direction is not Direction.REVERSE

    @verb
    def stop(self) -> Script[None]:
        """Stop. The motor counts as stopped when the output frequency is 0."""
        yield from insist(self.control, DelixiModbusControl.STOP)
        yield from self._stopped(self._stands, self._limit())

    @verb
    def set_frequency(self, hz: float) -> Script[None]:
        """Write the setpoint, which is stored in EEPROM, if it changes."""
        yield from self._hold(self.frequency, hz)

    @verb
    def state(self) -> Script[State]:
        """Return a fault by its name, or `running` above 0 Hz; at 0 Hz the state is unknown."""
        fault = yield from read(self.fault)
        if fault:
            return State(Condition.FAULT, fault=self.fault.in_words(fault))
        if (yield from self._stands()):
            return State(Condition.UNKNOWN, note="output frequency 0: stopped, or running at a setpoint of 0")
        return State(Condition.RUNNING)
