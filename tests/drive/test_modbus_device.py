"""ModbusDevice: read and write a device by address, without declaring its registers."""

from __future__ import annotations

import struct
from typing import Any

import pytest
from checksums import rtu
from simulated_bus import SimulatedBus, one

from multidrop.drive import Drive
from multidrop.drive.register import COIL, DISCRETE, INPUT, reading, setting
from multidrop.drive.text import text
from multidrop.errors import DriveException, NotAttached, NotVerified, NoValue, Unconfirmed, WriteForbidden
from multidrop.families import InnovertIBD
from multidrop.modbus_device import ModbusDevice
from multidrop.sim import SimulatedDrive

BusAndDevice = tuple[SimulatedBus, ModbusDevice]


class Device(Drive):
    """A family that declares the simulated device's registers."""

    first = setting(5, span=(0, 65535), moves=False)
    second = setting(6, span=(0, 65535), moves=False)
    high = reading(0, table=INPUT)
    low = reading(1, table=INPUT)
    lamp = setting(3, table=COIL, moves=False)
    door = reading(4, table=DISCRETE)


@pytest.fixture
def meter() -> BusAndDevice:
    line = SimulatedBus(SimulatedDrive(Device(7)))
    return line, line.attach(ModbusDevice(7, name="meter"))


def test_modbus_device_reads_numbers_of_any_format(meter: BusAndDevice) -> None:
    line, device = meter
    sim = line.sims[0]
    sim["first"], sim["second"] = 12, 65535
    assert device.read_holding(5, 2) == [12, 65535]
    assert device.read_holding(6, format="I16") == [-1]
    low, high = struct.unpack(">HH", struct.pack(">f", 2.5))
    sim["high"], sim["low"] = high, low
    assert device.read_input(0, 1, format="F32", order="CDAB") == [2.5]
    sim["high"], sim["low"] = 0x7FC0, 0
    with pytest.raises(NoValue, match="input register 0 holds no valid value"):
        device.read_input(0, format="F32")


def test_modbus_device_returns_coils_and_discrete_inputs_as_bool(meter: BusAndDevice) -> None:
    line, device = meter
    line.sims[0]["door"] = 1
    assert device.read_discrete(4)[0] is True
    assert device.read_coils(3)[0] is False
    assert device.write_coils(3, [True], confirm=True) == [True]
    assert line.sims[0]["lamp"] == 1


def test_modbus_device_refuses_writes_without_the_argument_confirm(meter: BusAndDevice) -> None:
    line, device = meter
    for write in (
        lambda: device.write_holding(5, [1, 2]),
        lambda: device.write_coils(3, [True]),
        lambda: device.write_holding(5, [1], confirm=1),  # type: ignore[arg-type]
    ):
        with pytest.raises(WriteForbidden, match="If this write cannot start a motor, pass confirm=True"):
            write()
    assert line.frames == []


def test_modbus_device_reads_back_the_registers_that_it_wrote(meter: BusAndDevice) -> None:
    line, device = meter
    assert device.write_holding(5, [7], confirm=True) == [7]
    assert device.write_holding(5, [1, 2], confirm=True) == [1, 2]
    assert (line.sims[0]["first"], line.sims[0]["second"]) == (1, 2)
    assert [request.function for request, _ in line.frames] == [6, 3, 16, 3]


def test_single_value_can_be_written_without_a_list(meter: BusAndDevice) -> None:
    _, device = meter
    assert device.write_holding(5, 7, confirm=True) == [7]
    assert device.write_coils(3, True, confirm=True) == [True]
    assert device.read_coils(3) == [True]


def test_a_start_address_that_is_no_number_is_refused_in_one_sentence(meter: BusAndDevice) -> None:
    _, device = meter
    wrong: Any = "5"
    with pytest.raises(TypeError, match="start = '5' is not a whole number"):
        device.read_holding(wrong)


def test_one_number_is_written_with_function_10h_if_multiple_is_true(meter: BusAndDevice) -> None:
    line, device = meter
    assert device.write_holding(5, [7], confirm=True, multiple=True) == [7]
    assert device.write_coils(3, [True], confirm=True, multiple=True) == [True]
    assert [request.function for request, _ in line.frames] == [16, 3, 15, 1]


def test_mask_write_fails_if_the_written_bits_read_back_differently(meter: BusAndDevice) -> None:
    line, device = meter
    held = ["12 34"]
    answers = {0x16: "07 16 00 05 FF F0 00 04", 3: "07 03 02 "}
    line.answers = lambda request: rtu(
        answers[request.function] + (held.pop(0) if request.function == 3 else "")
    )
    assert device.mask_holding(5, 0xFFF0, 0x0004, confirm=True) == 0x1234
    held[:] = ["12 35"]
    with pytest.raises(NotVerified, match="the device holds 4661"):
        device.mask_holding(5, 0xFFF0, 0x0004, confirm=True)
    with pytest.raises(WriteForbidden, match="pass confirm=True"):
        device.mask_holding(5, 0xFFF0, 0x0004)
    with pytest.raises(ValueError, match="65536 does not fit into U16"):
        device.mask_holding(5, 65536, 0, confirm=True)


def test_a_mask_write_is_unconfirmed_if_the_register_cannot_be_read(meter: BusAndDevice) -> None:
    line, device = meter
    answers = {0x16: "07 16 00 05 FF F0 00 04", 3: "07 83 02"}
    line.answers = lambda request: rtu(answers[request.function])
    with pytest.raises(
        Unconfirmed, match=r"register 5 took effect: .* refuses the read that would confirm the write"
    ):
        device.mask_holding(5, 0xFFF0, 0x0004, confirm=True)


def test_device_identification_in_two_replies_is_returned_whole(meter: BusAndDevice) -> None:
    line, device = meter
    parts = {0: "07 2B 0E 01 01 FF 01 01 00 04 41 63 6D 65", 1: "07 2B 0E 01 01 00 00 01 01 04 50 43 2D 31"}
    line.answers = lambda request: rtu(parts[request.data[2]])
    assert device.read_identification() == {0: b"Acme", 1: b"PC-1"}
    assert [request.data.hex() for request, _ in line.frames] == ["0e0100", "0e0101"]


def test_a_write_that_cannot_be_read_back_is_unconfirmed(meter: BusAndDevice) -> None:
    """The reply to a write is a copy of the request, so it may be an RS-485 adapter's echo."""
    line, device = meter
    line.loses = lambda request: request.function == 3
    with pytest.raises(Unconfirmed, match="could not be read back"):
        device.write_holding(5, [7], confirm=True)


def test_a_write_raises_an_error_if_another_number_is_read_back(
    meter: BusAndDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    line, device = meter
    monkeypatch.setattr(line.sims[0], "write", lambda function, start, raws: None)
    with pytest.raises(NotVerified, match=r"the device holds \[0\]"):
        device.write_holding(5, [7], confirm=True)


@pytest.mark.parametrize(
    ("values", "format", "sentence"),
    [
        ([-1], "U16", "-1 does not fit into U16; write 0 to 65535"),
        ([1.5], "I16", "I16 needs a whole number, not 1.5"),
        ([float("nan")], "F32", "nan is not a finite number"),
        ([0] * 124, "U16", "one write takes 1 to 123 registers or coils, not 124"),
        ([], "U16", "not 0"),
        ([1], "U17", "format = 'U17' is not one of U16"),
    ],
)
def test_written_number_that_does_not_fit_its_format_is_refused(
    meter: BusAndDevice, values: list[float], format: str, sentence: str
) -> None:
    line, device = meter
    with pytest.raises(ValueError, match=sentence):
        device.write_holding(5, values, format, confirm=True)  # type: ignore[arg-type]
    assert line.frames == []


def test_a_modbus_device_raises_an_error_for_a_refused_address(meter: BusAndDevice) -> None:
    with pytest.raises(DriveException, match="illegal address"):
        meter[1].read_holding(5000)


def test_modbus_device_reads_many_registers_in_several_requests(meter: BusAndDevice) -> None:
    line, device = meter
    line.answers = lambda request: rtu(f"07 03 {2 * request.count:02X}" + " 00" * (2 * request.count))
    assert device.read_holding(0, 300) == [0] * 300
    assert [request.count for request, _ in line.frames] == [125, 125, 50]
    line.frames.clear()
    assert device.read_holding(0, 70, format="F64") == [0.0] * 70
    assert [(request.start, request.count) for request, _ in line.frames] == [(0, 124), (124, 124), (248, 32)]


class Tank(Drive):
    """A drive with two readings at neighbouring addresses, a setting, and a text register."""

    level = reading(0, "m", step=0.1)
    flow = reading(1, "l/s")
    limit = setting(5, "m", step=0.1, span=(0, 100), moves=False)
    serial = text(20, 4)
    door = reading(3, table=DISCRETE)
    lamp = setting(4, table=COIL, moves=False)


BusAndTank = tuple[SimulatedBus, Tank]


@pytest.fixture
def metered() -> BusAndTank:
    sim = SimulatedDrive(Tank(1, name="tank"))
    sim["level"], sim["flow"], sim["limit"], sim["serial"] = 2.5, 7, 4.0, "AB12"
    line = SimulatedBus(sim)
    return line, line.attach(Tank(1, name="tank"))


def test_a_read_of_several_registers_returns_their_values_by_name(metered: BusAndTank) -> None:
    line, tank = metered
    assert tank.read(tank.level) == tank.read("level") == 2.5
    sent = len(line.frames)
    assert tank.read("level", tank.flow) == {"level": 2.5, "flow": 7}
    assert len(line.frames) == sent + 1
    assert tank.read("flow", "level") == {"flow": 7, "level": 2.5}
    assert list(tank.read("flow", "level")) == ["flow", "level"]
    assert tank.read_many(["level"]) == {"level": 2.5}
    assert tank.read_all() == {"level": 2.5, "flow": 7, "door": False}


def test_equal_requests_are_planned_only_once(metered: BusAndTank, monkeypatch: pytest.MonkeyPatch) -> None:
    _, tank = metered
    tank.read("level", "flow")
    monkeypatch.delattr(Drive, "register")
    assert tank.read("level", "flow") == {"level": 2.5, "flow": 7}


def test_text_registers_are_read_by_name_like_other_registers(metered: BusAndTank) -> None:
    _, tank = metered
    assert tank.read(tank.serial) == tank.read("serial") == "AB12"
    assert tank.read("serial", tank.level) == {"serial": "AB12", "level": 2.5}


def test_declared_coils_and_discrete_inputs_are_returned_as_bool(metered: BusAndTank) -> None:
    line, tank = metered
    line.sims[0]["door"] = 1
    assert tank.read("door") is True
    assert tank.read("door", "lamp", "flow") == {"door": True, "lamp": False, "flow": 7}
    assert tank.read("lamp", "door")["lamp"] is False
    assert tank.write("lamp", True) is True
    assert line.sims[0]["lamp"] == 1


def test_a_setting_is_written_by_its_name(metered: BusAndTank) -> None:
    line, tank = metered
    assert tank.write("limit", 6.5) == tank.read(tank.limit) == line.sims[0]["limit"] == 6.5
    with pytest.raises(ValueError, match="has no register 'limits'; did you mean limit"):
        tank.write("limits", 6.5)


def test_a_drive_without_a_bus_raises_an_error() -> None:
    pump = InnovertIBD(1, name="pump-1")
    sentence = r"^pump-1 is not attached to a bus: use bus\.attach\(\.\.\.\)$"
    for call in (
        lambda: pump.read("output_current"),
        lambda: pump.read("output_current", "output_frequency"),
        pump.read_all,
        lambda: pump.write("acceleration_time", 5.0),
        lambda: pump.read_raw(3, 0, 1),
        lambda: pump.send_raw(6, 0, b"\0\1"),
        pump.start,
    ):
        with pytest.raises(NotAttached, match=sentence):
            call()
    line, attached, _ = one(InnovertIBD(1, name="pump-1"))
    line.bus.detach(attached)
    with pytest.raises(NotAttached, match="pump-1 is not attached to this bus"):
        attached.read("output_current")
