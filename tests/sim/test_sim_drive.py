"""A simulated drive of a user's class: its memory, access to registers, limits, refusals and counters."""

import math

import pytest
from tables import table
from toy import Fault, Toy

from multidrop.core import Message, NumberFormat
from multidrop.drive import Drive
from multidrop.drive.register import (
    COIL,
    DISCRETE,
    HOLDING,
    HOLDING_MULTIPLE,
    INPUT,
    Kept,
    Register,
    Table,
    command,
    reading,
    setting,
)
from multidrop.sim import EncodedDrive, SimulatedDrive, encoded, simulated
from multidrop.sim.motor import Motor, Phase, Rating

ON, OFF = b"\xff\x00", b"\x00\x00"


def test_simulating_a_family_instead_of_a_drive_is_refused() -> None:
    with pytest.raises(TypeError, match=r"Toy is a family, not a drive: write Toy\(1\) for address 1"):
        simulated(Toy)  # type: ignore[arg-type]


class Own(Drive):
    """A drive that a user declares."""

    most_registers = {HOLDING: 10, INPUT: 4, COIL: 16, DISCRETE: 16}
    readable_gaps = {HOLDING: range(0x10, 0x20)}
    broadcasts = True

    output_frequency = reading(0x01, "Hz", step=0.1, table=INPUT)
    temperature = reading(0x02, "°C", number_format=NumberFormat.I16, table=INPUT)
    energy = reading(0x03, "kWh", step=0.01, number_format=NumberFormat.U32, table=INPUT)
    energy_swapped = reading(
        0x05, "kWh", step=0.01, number_format=NumberFormat.U32, order="CDAB", table=INPUT
    )
    power = reading(0x07, "kW", number_format=NumberFormat.F32, table=INPUT)
    acceleration_time = setting(
        0x10, "s", step=0.1, span=(0.1, 600), default=5, kept=Kept.EEPROM, ram_address=0x8010
    )
    total = setting(0x12, number_format=NumberFormat.U32)
    frequency = command(0x30, "Hz", step=0.01, span=(0, 50), kept=Kept.RAM)
    offset = setting(0x40, "%", number_format=NumberFormat.I16, span=(-100, 100))
    relay = setting(0x05, table=COIL)
    lamp = setting(0x06, table=COIL)
    door = reading(0x05, table=DISCRETE)


@pytest.fixture
def sim() -> SimulatedDrive:
    return SimulatedDrive(Own(7))


def ask(sim: SimulatedDrive, function: int, start: int, count: int = 0, data: bytes = b"") -> Message | None:
    return sim.answer(Message(7, function, start, count, data), 0.0)


def data_of(reply: Message | None) -> str:
    assert reply is not None
    assert not reply.exception
    return reply.data.hex(" ")


def exception_of(reply: Message | None) -> int:
    assert reply is not None
    return reply.exception


@pytest.mark.parametrize(
    ("name", "value", "function", "start", "count", "words"),
    [
        ("output_frequency", 50.0, 4, 1, 1, "01 f4"),
        ("temperature", -10, 4, 2, 1, "ff f6"),
        ("energy", 12345.67, 4, 3, 2, "00 12 d6 87"),  # 1234567 is 12D687H
        ("energy_swapped", 12345.67, 4, 5, 2, "d6 87 00 12"),
        ("power", 1.5, 4, 7, 2, "3f c0 00 00"),
        ("door", 1, 2, 5, 1, "01"),
        ("relay", 1, 1, 4, 3, "02"),
    ],
)
def test_value_set_on_a_simulated_drive_is_read_over_the_line(
    sim: SimulatedDrive, name: str, value: float, function: int, start: int, count: int, words: str
) -> None:
    if name == "relay":
        sim.memory.make_readable(COIL, [4])
    sim[name] = value
    assert data_of(ask(sim, function, start, count)) == words
    assert sim[name] == value


def test_simulated_drive_returns_0_for_undeclared_readable_registers(sim: SimulatedDrive) -> None:
    assert data_of(ask(sim, 3, 0x10, 4)) == "00 32 00 00 00 00 00 00"


def test_one_read_returns_registers_with_different_write_functions() -> None:
    class Controller(Drive):
        """A drive with a register that only function 16 writes."""

        most_registers = {HOLDING: 10, HOLDING_MULTIPLE: 10}
        level = reading(0, "m")
        target = setting(1, "m", table=HOLDING_MULTIPLE)

    sim = SimulatedDrive(Controller(1))
    sim["level"], sim["target"] = 3, 4
    assert sim.read(3, 0, 2) == [3, 4]


def test_register_written_to_a_simulated_drive_is_read_back_and_recorded(sim: SimulatedDrive) -> None:
    request = Message(7, 6, 0x10, data=b"\x00\xc8")
    assert sim.answer(request, 3.5) == request
    assert sim["acceleration_time"] == 20
    assert data_of(ask(sim, 3, 0x10, 1)) == "00 c8"
    (written,) = sim.counters.writes
    assert written == (3.5, "acceleration_time", 0x10, 200)


def test_write_of_several_registers_sets_a_32_bit_value(sim: SimulatedDrive) -> None:
    assert ask(sim, 0x10, 0x12, 2, b"\x00\x12\xd6\x87") == Message(7, 0x10, 0x12, 2)
    assert sim["total"] == 1234567


def test_coil_writes_to_a_simulated_drive_are_stored_or_refused(sim: SimulatedDrive) -> None:
    assert ask(sim, 5, 5, data=ON) == Message(7, 5, 5, data=ON)
    assert ask(sim, 0x0F, 5, 2, b"\x02") == Message(7, 0x0F, 5, 2)
    assert (sim["relay"], sim["lamp"]) == (0, 1)
    assert exception_of(ask(sim, 5, 5, data=b"\x12\x34")) == 3


def test_refused_write_of_several_registers_changes_no_register(sim: SimulatedDrive) -> None:
    assert exception_of(ask(sim, 0x10, 0x12, 3, bytes(range(1, 7)))) == 2
    assert sim["total"] == 0
    assert not sim.counters.writes


@pytest.mark.parametrize(
    ("function", "start", "count", "data", "code"),
    [
        (3, 0x10, 11, b"", 3),
        (3, 0x10, 0, b"", 3),
        (4, 0x00, 1, b"", 2),
        (4, 0x08, 2, b"", 2),  # the class declares only the first of the two input registers
        (3, 0xFFFF, 2, b"", 2),
        (3, 0x30, 1, b"", 2),  # write-only
        (3, 0x8010, 1, b"", 2),  # the address in RAM can only be written
        (6, 0x01, 0, b"\x00\x01", 2),  # an input register can only be read
        (6, 0x11, 0, b"\x00\x01", 2),  # a reserved address
        (6, 0x30, 0, b"\x13\x89", 3),  # 50.01 Hz is above the limit
        (8, 0x01, 0, b"\x00\x00", 1),
        (0x2B, 0, 0, b"", 1),
    ],
)
def test_simulated_drive_refuses_an_invalid_request_with_an_exception(
    sim: SimulatedDrive, function: int, start: int, count: int, data: bytes, code: int
) -> None:
    assert exception_of(ask(sim, function, start, count, data)) == code
    assert sim.counters.refusals == 1


def test_simulated_drive_refuses_a_negative_value_below_its_limit(sim: SimulatedDrive) -> None:
    assert exception_of(ask(sim, 6, 0x40, data=b"\xff\x9c")) == 0  # -100
    assert sim["offset"] == -100
    assert exception_of(ask(sim, 6, 0x40, data=b"\xff\x9b")) == 3


def test_switched_off_simulated_drive_does_not_reply(sim: SimulatedDrive) -> None:
    sim.deaf_until = math.inf
    assert ask(sim, 4, 1, 1) is None
    assert sim.counters.requests == 0


def test_simulated_drive_echoes_a_diagnostics_request(sim: SimulatedDrive) -> None:
    assert ask(sim, 8, 0, data=b"\xa5\x37") == Message(7, 8, 0, data=b"\xa5\x37")


def test_simulated_drive_ignores_a_request_to_another_address(sim: SimulatedDrive) -> None:
    assert sim.answer(Message(8, 4, 1, 1), 0.0) is None
    assert sim.counters.requests == 0


def test_simulated_drive_carries_out_a_broadcast_write_without_a_reply(sim: SimulatedDrive) -> None:
    assert sim.answer(Message(0, 6, 0x30, data=b"\x13\x88"), 0.0) is None
    assert sim.memory.get(Own.frequency) == 50
    assert sim.answer(Message(0, 6, 0x99, data=b"\x13\x88"), 0.0) is None
    assert sim.answer(Message(0, 4, 1, 1), 0.0) is None
    assert (sim.counters.broadcasts, sim.counters.requests) == (3, 0)


def test_simulated_drive_without_broadcasts_in_its_class_ignores_them() -> None:
    class Deaf(Own):
        broadcasts = False

    sim = SimulatedDrive(Deaf(7))
    assert sim.answer(Message(0, 6, 0x30, data=b"\x13\x88"), 0.0) is None
    assert sim["frequency"] == 0


def test_simulated_drive_counts_writes_to_eeprom_but_not_to_ram(sim: SimulatedDrive) -> None:
    ask(sim, 6, 0x10, data=b"\x00\xc8")
    ask(sim, 6, 0x10, data=b"\x00\xc8")
    ask(sim, 6, 0x8010, data=b"\x01\x90")
    ask(sim, 6, 0x30, data=b"\x00\x01")
    assert sim.counters.eeprom_writes == {"acceleration_time": 2}
    assert sim["acceleration_time"] == 40


def test_simulated_drive_counts_requests_by_function(sim: SimulatedDrive) -> None:
    ask(sim, 4, 1, 1)
    ask(sim, 4, 1, 1)
    ask(sim, 6, 0x10, data=b"\x00\xc8")
    assert sim.counters.functions == {4: 2, 6: 1}
    assert (sim.counters.requests, sim.counters.replies) == (3, 3)


@pytest.mark.long
def test_simulated_drive_records_only_the_latest_10000_writes(sim: SimulatedDrive) -> None:
    for _ in range(11_000):
        ask(sim, 6, 0x10, data=b"\x00\xc8")
    assert len(sim.counters.writes) == 10_000
    assert sim.counters.eeprom_writes["acceleration_time"] == 11_000


def test_value_of_a_write_only_register_can_be_read_by_the_test(sim: SimulatedDrive) -> None:
    ask(sim, 6, 0x30, data=b"\x13\x88")
    assert sim["frequency"] == 50


def test_simulated_drive_of_a_user_defined_class_has_no_motor() -> None:
    assert type(simulated(Own(3))) is SimulatedDrive


def every_register() -> list[tuple[Register[float], int]]:
    return [
        (register, at)
        for register in Own.registers.values()
        if register.readable
        for at in range(register.words)
    ]


@table(("register", "at"), every_register())
def test_encoded_drive_computes_each_value_from_the_register_address(
    register: Register[float], at: int
) -> None:
    sim = EncodedDrive(Own(7))
    table, where = register.table, register.address + at
    numbers = {COIL: 1, DISCRETE: 2, HOLDING: 3, INPUT: 4}
    expected = (7 * 257 + where * 31 + numbers[table]) & 0x7FFF
    assert encoded(7, table, where) == expected
    reply = ask(sim, table.read or 0, where, 1)
    assert reply is not None
    width = {COIL: 0x1, DISCRETE: 0x1}.get(table, 0xFFFF)
    assert int.from_bytes(reply.data) == expected & width


def test_encoded_drive_confirms_writes_without_storing_values() -> None:
    sim = EncodedDrive(Own(7))
    before = ask(sim, 3, 0x10, 1)
    request = Message(7, 6, 0x10, data=b"\x00\xc8")
    assert sim.answer(request, 0.0) == request
    assert ask(sim, 3, 0x10, 1) == before


def test_registers_of_encoded_drives_have_different_values() -> None:
    tables = (HOLDING, INPUT, Table("another", 7, None))
    codes = {encoded(address, table, at) for address in range(1, 9) for table in tables for at in range(8)}
    assert len(codes) == 8 * 3 * 8


def test_value_of_a_simulated_drive_can_be_set_by_name_or_as_text() -> None:
    sim = simulated(Toy(1))
    sim["fault"] = "overcurrent"
    sim["output_current"] = "2.5"
    assert (sim["fault"], sim["output_current"]) == (Fault.OVERCURRENT, 2.5)
    with pytest.raises(ValueError, match="fault has no 'three'; it takes none, overcurrent"):
        sim["fault"] = "three"


RATING = Rating(frequency=50, voltage=400, current=10, power=4, torque=26, pole_pairs=2)


@pytest.fixture
def motor() -> Motor:
    motor = Motor(RATING)
    motor.acceleration_time = 10  # seconds from 0 to 50 Hz, so 5 Hz/s
    motor.deceleration_time = 5  # seconds from 50 Hz to 0, so 10 Hz/s
    motor.target = 40
    return motor


@pytest.fixture
def turning(motor: Motor) -> Motor:
    """Return the motor while it runs at 40 Hz, 100 s after its start."""
    motor.run()
    motor.run_to(100)
    return motor


def test_simulated_motor_has_no_voltage_until_it_is_run(motor: Motor) -> None:
    motor.run_to(1000)
    assert (motor.frequency, motor.current, motor.voltage, motor.phase) == (0, 0, 0, Phase.STOPPED)


@pytest.mark.parametrize(
    ("now", "frequency", "phase"),
    [
        (0.5, 2.5, Phase.ACCELERATING),
        (4, 20, Phase.ACCELERATING),
        (8, 40, Phase.CONSTANT),
        (100, 40, Phase.CONSTANT),
    ],
)
def test_simulated_motor_follows_its_ramp(motor: Motor, now: float, frequency: float, phase: Phase) -> None:
    motor.run()
    motor.run_to(now)
    assert motor.frequency == pytest.approx(frequency)
    assert motor.phase is phase


def test_ramp_of_a_simulated_motor_does_not_depend_on_the_time_steps(motor: Motor) -> None:
    motor.run()
    for step in range(1, 401):
        motor.run_to(step / 100)
    assert motor.frequency == pytest.approx(20)


def test_a_stopped_simulated_motor_ramps_down_and_loses_its_voltage(turning: Motor) -> None:
    turning.stop()
    turning.run_to(102)
    assert turning.frequency == pytest.approx(20)
    assert turning.phase is Phase.DECELERATING
    turning.run_to(104)
    assert (turning.frequency, turning.phase, turning.energised) == (0, Phase.STOPPED, False)


def test_simulated_motor_reaches_a_lower_target_along_its_ramp(turning: Motor) -> None:
    turning.target = 30
    turning.run_to(100.5)
    assert turning.frequency == pytest.approx(35)
    turning.run_to(110)
    assert turning.frequency == 30


def test_simulated_motor_decelerates_to_zero_before_it_reverses(turning: Motor) -> None:
    turning.run(-1)
    turning.run_to(104)  # 4 s from 40 Hz to 0 at 10 Hz/s
    assert turning.frequency == pytest.approx(0)
    turning.run_to(106)  # 2 s in reverse at 5 Hz/s
    assert turning.frequency == pytest.approx(-10)
    turning.run_to(104 + 8)
    assert turning.frequency == pytest.approx(-40)


def test_a_coasting_motor_has_no_voltage_while_its_shaft_slows_down(turning: Motor) -> None:
    speed = turning.speed
    turning.coast()
    assert (turning.frequency, turning.current, turning.voltage) == (0, 0, 0)
    turning.run_to(101)
    assert 0 < turning.speed < speed * 1.1
    turning.run_to(200)
    assert turning.speed == 0


def test_frequency_of_a_simulated_motor_is_limited_to_its_maximum(motor: Motor) -> None:
    motor.target = 400
    motor.run()
    motor.run_to(1000)
    assert motor.frequency == 50


def test_motor_voltage_follows_frequency_and_motor_current_follows_load(turning: Motor) -> None:
    assert turning.voltage == pytest.approx(400 * 40 / 50)
    light = turning.current
    turning.load = 1.0
    assert light < turning.current
    assert turning.current == pytest.approx(10 * math.hypot(0.3, 1.0))
    assert turning.power == pytest.approx(4 * 40 / 50)


def test_dc_bus_voltage_falls_under_load_and_rises_while_braking(motor: Motor) -> None:
    idle = motor.dc_bus_voltage
    assert idle == pytest.approx(400 * math.sqrt(2))
    motor.run()
    motor.run_to(100)
    assert motor.dc_bus_voltage < idle
    motor.stop()
    motor.run_to(101)
    assert motor.dc_bus_voltage > idle


def test_heatsink_warms_under_load_and_cools_at_rest(motor: Motor) -> None:
    motor.load = 0.95
    motor.run()
    motor.run_to(10)
    assert 25 < motor.heatsink < 30
    motor.run_to(3600)
    assert motor.heatsink == pytest.approx(25 + 35 * (motor.current / 10) ** 2)
    motor.coast()
    motor.run_to(7200)
    assert motor.heatsink == pytest.approx(25, abs=0.01)


def test_a_simulated_motor_with_a_fault_starts_only_after_a_reset(turning: Motor) -> None:
    turning.trip(7)
    turning.run()
    turning.jog()
    turning.run_to(110)
    assert (turning.frequency, turning.fault, turning.energised) == (0, 7, False)
    turning.reset()
    turning.run_to(120)
    assert (turning.frequency, turning.fault, turning.energised) == (0, 0, False)
    turning.run()
    turning.run_to(200)
    assert turning.frequency == 40


def test_fault_record_of_a_simulated_motor_keeps_four_faults(motor: Motor) -> None:
    for code in range(1, 6):
        motor.trip(code)
    assert [motor.fault_record(number) for number in range(1, 6)] == [5, 4, 3, 2, 0]


def test_run_time_of_a_simulated_motor_counts_only_while_it_runs(motor: Motor) -> None:
    motor.run_to(10_000)
    motor.run()
    motor.run_to(17_200)
    assert motor.run_seconds == 7200


def test_simulated_motor_does_not_go_back_in_time(motor: Motor) -> None:
    motor.run()
    motor.run_to(4)
    motor.run_to(3)
    assert motor.frequency == pytest.approx(20)
