"""Run verbs without a bus: a table answers their reads, and their writes are recorded as frames."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from enum import Enum
from fractions import Fraction
from typing import Any

from multidrop.control.rules import conditions, raw_count
from multidrop.core import Message, build_request
from multidrop.drive import Drive, Read, Script, Wait, carry_out
from multidrop.drive.register import COIL, Carrier, Register


def frame(drive: Drive, register: Register[Any], value: Any) -> str:
    """Return the frame that writes this value, as the documents print it; computed without the library."""
    raw = (
        value.value if isinstance(value, Enum) else round(Fraction(str(value)) / Fraction(str(register.step)))
    )
    address, function = register.address, register.table.write
    assert function is not None
    if register.table is COIL:
        message = Message(drive.address, function, address, data=b"\xff\x00" if raw else b"\x00\x00")
    elif register.table.carrier is Carrier.NUMBER:
        message = Message(drive.address, function, raw, data=bytes(4))
    elif register.table.carrier is Carrier.LONG:
        message = Message(drive.address, function, address, data=struct.pack(">I", raw))
    else:
        count = 1 if function == 16 else 0
        message = Message(drive.address, function, address, count, data=struct.pack(">H", raw))
    sent = build_request(drive.framing, message)
    return sent.decode().strip() if sent.startswith(b":") else sent.hex(" ").upper()


class Wire:
    """A drive whose replies are set by the test.

    `says` has a value by register name, or a list of values for successive reads; further reads get the last
    value. An exception among the values is raised. `loses` has, by frame, the exceptions that the first
    writes of this frame raise. `turns` has, by frame, the changes of `says` after a write of this frame. A
    written value is read back unless `says` has a value. Rules between registers apply as on a bus; their
    reads are not recorded in `reads`.
    """

    def __init__(
        self,
        drive: Drive,
        says: Mapping[str, Any] | None = None,
        loses: Mapping[str, Sequence[Exception]] | None = None,
        turns: Mapping[str, Mapping[str, Any]] | None = None,
    ) -> None:
        self.drive = drive
        self.says: dict[str, list[Any]] = {}
        self.say(says or {})
        self.turns = turns or {}
        self.loses = {text: list(each) for text, each in (loses or {}).items()}
        self.held: dict[str, Any] = {}
        self.sent: list[str] = []
        self.reads: list[str] = []
        self.seconds = 0.0
        drive.perform = self.run

    def say(self, says: Mapping[str, Any]) -> None:
        """Update the values of later reads."""
        self.says |= {name: list(each) if isinstance(each, list) else [each] for name, each in says.items()}

    def run(self, script: Script[Any]) -> Any:
        return carry_out(script, self._step)

    def _step(self, step: Any) -> Any:
        if isinstance(step, Wait):
            self.seconds += step.seconds
            return None
        if isinstance(step, Read):
            self.reads.append(step.register.name)
            assert step.register.readable
            return self._said(step.register)
        raw_count(self.drive, step.register, step.value)
        carry_out(conditions(self.drive, step.register, step.value), self._peek)
        text = frame(self.drive, step.register, step.value)
        self.sent.append(text)
        is_setpoint = step.register.name == self.drive.setpoint_name
        if is_setpoint:
            self.drive.commanded = None
        if self.loses.get(text):
            raise self.loses[text].pop(0)
        self.say(self.turns.get(text, {}))
        if step.register.name not in self.says:
            self.held[step.register.name] = step.value
        held = self._said(step.register)
        if is_setpoint and held == step.value:
            self.drive.commanded = held
        return held

    def _peek(self, step: Any) -> Any:
        """Return the value that the next read of this register gets."""
        return self.says[step.register.name][0]

    def _said(self, register: Register[Any]) -> Any:
        if register.name in self.held:
            return self.held[register.name]
        values = self.says[register.name]
        value = values.pop(0) if len(values) > 1 else values[0]
        if isinstance(value, Exception):
            raise value
        return value


def rows(drive: type[Drive]) -> set[tuple[str, str, str, str, float | None]]:
    """Return every register as (table, address, name, unit or enumeration, step)."""
    return {
        (
            f"{each.table.read or 0:02X}/{each.table.write or 0:02X}",
            f"{each.address:04X}",
            name,
            each.values.__name__ if each.values is not None else each.unit,
            each.step if each.values is None else None,
        )
        for name, each in drive.registers.items()
    }


def typed(table: str) -> set[tuple[str, str, str, str, float | None]]:
    """Parse a table typed from a manual into tuples like those of `rows`.

    A step "-" means that there is none, "?" that the manual does not state it; both become None.
    """
    found = set()
    for line in table.strip().splitlines():
        functions, address, name, step, *unit = line.split()
        found.add((functions, address, name, " ".join(unit), None if step in "?-" else float(step)))
    return found


# Readings of both Delixi protocols, in the format that the function `typed` parses.
DELIXI_MONITORS = """
01F4 output_frequency     0.01 Hz
01F5 reference_frequency  ? Hz
01F6 output_current       ? A
01F7 output_voltage       ? V
01F8 dc_bus_voltage       ? V
01F9 io_signals           1
01FA closed_loop_setpoint ?
01FB closed_loop_feedback ?
01FC heatsink_temperature ? °C
01FD synchronous_speed    ? rpm
01FE motor_speed          ? rpm
01FF counter              1
0200 length               ?
0201 set_length           ?
0202 overload             ?
0203 stage                1
0204 stage_time           ?
0205 stage_time_left      ?
0206 work_time            ?
0207 energy_high          ?
0208 energy_low           ?
0209 vf1_input            ?
020A vf2_input            ?
020B vf1_transformed      ?
020C vf2_transformed      ?
020D fault_record_1       1
020E fault_record_2       1
020F fault_record_3       1
0210 fault_record_4       1
0211 overcurrent_record   ?
0212 overvoltage_record   ?
0213 fault                - DelixiFault
0000 run_source           - DelixiRunSource
0001 frequency_source     1
01AC baudrate_setting     - DelixiBaudrate
01AD format_setting       - DelixiModbusFormat
01AE address_setting      1
"""
