"""A Modbus device without a family: reads and writes by address, on simulated devices."""

from __future__ import annotations

import struct

import pytest
from checksums import rtu
from simulated_bus import SimulatedBus

from multidrop.drive import Drive
from multidrop.drive.register import COIL, DISCRETE, INPUT, reading, setting
from multidrop.errors import DriveException, NotVerified, NoValue, Unconfirmed, WriteForbidden
from multidrop.modbus_device import ModbusDevice
from multidrop.sim import SimulatedDrive


class Device(Drive):
    """A family that declares the simulated device's registers."""

    first = setting(5, span=(0, 65535), moves=False)
    second = setting(6, span=(0, 65535), moves=False)
    high = reading(0, table=INPUT)
    low = reading(1, table=INPUT)
    lamp = setting(3, table=COIL, moves=False)
    door = reading(4, table=DISCRETE)


@pytest.fixture
def meter(monkeypatch: pytest.MonkeyPatch) -> tuple[SimulatedBus, ModbusDevice]:
    line = SimulatedBus(monkeypatch, SimulatedDrive(Device(7)))
    return line, line.attach(ModbusDevice(7, name="meter"))


def test_numbers_of_any_format_are_read(meter: tuple[SimulatedBus, ModbusDevice]) -> None:
    line, device = meter
    sim = line.sims[0]
    sim["first"], sim["second"] = 12, 65535
    assert device.read_holding(5, 2) == [12, 65535]
    assert device.read_holding(6, format="I16") == [-1]
    low, high = struct.unpack(">HH", struct.pack(">f", 2.5))
    sim["high"], sim["low"] = high, low
    assert device.read_input(0, 1, "F32", order="CDAB") == [2.5]
    sim["high"], sim["low"] = 0x7FC0, 0
    with pytest.raises(NoValue, match="input register 0 holds no valid value"):
        device.read_input(0, format="F32")


def test_coils_and_discrete_inputs_are_returned_as_bool(meter: tuple[SimulatedBus, ModbusDevice]) -> None:
    line, device = meter
    line.sims[0]["door"] = 1
    assert device.read_discrete(4)[0] is True
    assert device.read_coils(3)[0] is False
    assert device.write_coils(3, [True], confirm=True) == [True]
    assert line.sims[0]["lamp"] == 1


def test_writes_without_confirm_are_refused_and_not_sent(meter: tuple[SimulatedBus, ModbusDevice]) -> None:
    line, device = meter
    for write in (
        lambda: device.write_holding(5, [1, 2]),
        lambda: device.write_coils(3, [True]),
        lambda: device.write_holding(5, [1], confirm=1),  # type: ignore[arg-type]
    ):
        with pytest.raises(WriteForbidden, match="If it cannot, pass confirm=True"):
            write()
    assert line.frames == []


def test_written_registers_are_read_back(meter: tuple[SimulatedBus, ModbusDevice]) -> None:
    line, device = meter
    assert device.write_holding(5, [7], confirm=True) == [7]
    assert device.write_holding(5, [1, 2], confirm=True) == [1, 2]
    assert (line.sims[0]["first"], line.sims[0]["second"]) == (1, 2)
    assert [request.function for request, _ in line.frames] == [6, 3, 16, 3]


def test_a_write_that_cannot_be_read_back_is_unconfirmed(meter: tuple[SimulatedBus, ModbusDevice]) -> None:
    """The reply to a write is a copy of the request, so it may be an adapter's echo."""
    line, device = meter
    line.loses = lambda request: request.function == 3
    with pytest.raises(Unconfirmed, match="could not be read back"):
        device.write_holding(5, [7], confirm=True)


def test_a_write_that_reads_back_another_number_raises_not_verified(
    meter: tuple[SimulatedBus, ModbusDevice], monkeypatch: pytest.MonkeyPatch
) -> None:
    line, device = meter
    monkeypatch.setattr(line.sims[0], "write", lambda function, start, raws: None)
    with pytest.raises(NotVerified, match=r"the device holds \[0\]"):
        device.write_holding(5, [7], confirm=True)


@pytest.mark.parametrize(
    ("values", "format", "sentence"),
    [
        ([-1], "U16", "-1 does not fit into U16: 0 to 65535"),
        ([1.5], "I16", "1.5 is not a whole number"),
        ([float("nan")], "F32", "nan is not a finite number"),
        ([0] * 124, "U16", "one write takes 1 to 123 registers or coils, not 124"),
        ([], "U16", "not 0"),
        ([1], "U17", "format = 'U17' is not one of U16"),
    ],
)
def test_numbers_that_do_not_fit_the_format_are_refused(
    meter: tuple[SimulatedBus, ModbusDevice], values: list[float], format: str, sentence: str
) -> None:
    line, device = meter
    with pytest.raises(ValueError, match=sentence):
        device.write_holding(5, values, format, confirm=True)  # type: ignore[arg-type]
    assert line.frames == []


def test_a_refused_address_raises_drive_exception(meter: tuple[SimulatedBus, ModbusDevice]) -> None:
    with pytest.raises(DriveException, match="illegal address"):
        meter[1].read_holding(5000)


def test_many_registers_take_several_requests(meter: tuple[SimulatedBus, ModbusDevice]) -> None:
    line, device = meter
    line.answers = lambda request: rtu(f"07 03 {2 * request.count:02X}" + " 00" * (2 * request.count))
    assert device.read_holding(0, 300) == [0] * 300
    assert [request.count for request, _ in line.frames] == [125, 125, 50]
    line.frames.clear()
    assert device.read_holding(0, 70, "F64") == [0.0] * 70
    assert [(request.start, request.count) for request, _ in line.frames] == [(0, 124), (124, 124), (248, 32)]
