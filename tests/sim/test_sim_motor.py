"""The simulated motor's physics on simulated time."""

import math

import pytest

from multidrop.sim.motor import Motor, Phase, Rating

RATING = Rating(frequency=50, voltage=400, current=10, power=4, torque=26, pole_pairs=2)


@pytest.fixture
def motor() -> Motor:
    motor = Motor(RATING)
    motor.acceleration_time = 10  # s from 0 to 50 Hz: 5 Hz/s
    motor.deceleration_time = 5  # s from 50 Hz to 0: 10 Hz/s
    motor.target = 40
    return motor


def test_motor_has_no_voltage_until_run_is_called(motor: Motor) -> None:
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
def test_motor_accelerates_along_its_ramp(motor: Motor, now: float, frequency: float, phase: Phase) -> None:
    motor.run()
    motor.run_to(now)
    assert motor.frequency == pytest.approx(frequency)
    assert motor.phase is phase


def test_ramp_is_the_same_in_one_step_or_many(motor: Motor) -> None:
    motor.run()
    for step in range(1, 401):
        motor.run_to(step / 100)
    assert motor.frequency == pytest.approx(20)


def test_stop_ramps_down_and_then_removes_the_voltage(motor: Motor) -> None:
    motor.run()
    motor.run_to(100)
    motor.stop()
    motor.run_to(102)
    assert motor.frequency == pytest.approx(20)
    assert motor.phase is Phase.DECELERATING
    motor.run_to(104)
    assert (motor.frequency, motor.phase, motor.energised) == (0, Phase.STOPPED, False)


def test_lower_target_is_reached_along_the_deceleration_ramp(motor: Motor) -> None:
    motor.run()
    motor.run_to(100)
    motor.target = 30
    motor.run_to(100.5)
    assert motor.frequency == pytest.approx(35)
    motor.run_to(110)
    assert motor.frequency == 30


def test_reversal_decelerates_to_zero_first(motor: Motor) -> None:
    motor.run()
    motor.run_to(100)
    motor.run(-1)
    motor.run_to(104)  # 4 s from 40 Hz to 0, at 10 Hz/s
    assert motor.frequency == pytest.approx(0)
    motor.run_to(106)  # 2 s in reverse, at 5 Hz/s
    assert motor.frequency == pytest.approx(-10)
    motor.run_to(104 + 8)
    assert motor.frequency == pytest.approx(-40)


def test_coast_removes_the_voltage_while_the_shaft_runs_down(motor: Motor) -> None:
    motor.run()
    motor.run_to(100)
    turning = motor.speed
    motor.coast()
    assert (motor.frequency, motor.current, motor.voltage) == (0, 0, 0)
    motor.run_to(101)
    assert 0 < motor.speed < turning * 1.1
    motor.run_to(200)
    assert motor.speed == 0


def test_target_is_limited_to_the_maximum_frequency(motor: Motor) -> None:
    motor.target = 400
    motor.run()
    motor.run_to(1000)
    assert motor.frequency == 50


def test_voltage_follows_frequency_and_current_follows_load(motor: Motor) -> None:
    motor.run()
    motor.run_to(100)
    assert motor.voltage == pytest.approx(400 * 40 / 50)
    light = motor.current
    motor.load = 1.0
    assert light < motor.current
    assert motor.current == pytest.approx(10 * math.hypot(0.3, 1.0))
    assert motor.power == pytest.approx(4 * 40 / 50)


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


def test_fault_prevents_a_run_until_reset_which_starts_nothing(motor: Motor) -> None:
    motor.run()
    motor.run_to(100)
    motor.trip(7)
    motor.run()
    motor.jog()
    motor.run_to(110)
    assert (motor.frequency, motor.fault, motor.energised) == (0, 7, False)
    motor.reset()
    motor.run_to(120)
    assert (motor.frequency, motor.fault, motor.energised) == (0, 0, False)
    motor.run()
    motor.run_to(200)
    assert motor.frequency == 40


def test_fault_record_keeps_the_four_latest_faults(motor: Motor) -> None:
    for code in range(1, 6):
        motor.trip(code)
    assert [motor.fault_record(number) for number in range(1, 6)] == [5, 4, 3, 2, 0]


def test_run_time_counts_only_while_the_motor_runs(motor: Motor) -> None:
    motor.run_to(10_000)
    motor.run()
    motor.run_to(17_200)
    assert motor.run_seconds == 7200


def test_run_to_an_earlier_time_changes_nothing(motor: Motor) -> None:
    motor.run()
    motor.run_to(4)
    motor.run_to(3)
    assert motor.frequency == pytest.approx(20)
