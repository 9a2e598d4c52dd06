"""The simulated motor's physics, at times that the test chooses."""

import math

import pytest

from multidrop.sim.motor import Motor, Phase, Rating

RATING = Rating(frequency=50, voltage=400, current=10, power=4, torque=26, pole_pairs=2)


@pytest.fixture
def motor() -> Motor:
    motor = Motor(RATING)
    motor.acceleration_time = 10  # s from 0 to 50 Hz: 5 Hz/s
    motor.deceleration_time = 5  # 10 Hz/s
    motor.target = 40
    return motor


def test_the_motor_is_off_until_a_run(motor: Motor) -> None:
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
def test_it_accelerates_along_its_ramp(motor: Motor, now: float, frequency: float, phase: Phase) -> None:
    motor.run()
    motor.run_to(now)
    assert motor.frequency == pytest.approx(frequency)
    assert motor.phase is phase


def test_the_ramp_does_not_depend_on_how_often_it_is_looked_at(motor: Motor) -> None:
    motor.run()
    for step in range(1, 401):
        motor.run_to(step / 100)
    assert motor.frequency == pytest.approx(20)


def test_a_stop_goes_down_the_ramp_and_then_takes_the_voltage_off(motor: Motor) -> None:
    motor.run()
    motor.run_to(100)
    motor.stop()
    motor.run_to(102)
    assert motor.frequency == pytest.approx(20)
    assert motor.phase is Phase.DECELERATING
    motor.run_to(104)
    assert (motor.frequency, motor.phase, motor.energised) == (0, Phase.STOPPED, False)


def test_a_lower_target_is_reached_along_the_deceleration_ramp(motor: Motor) -> None:
    motor.run()
    motor.run_to(100)
    motor.target = 30
    motor.run_to(100.5)
    assert motor.frequency == pytest.approx(35)
    motor.run_to(110)
    assert motor.frequency == 30


def test_a_reversal_brakes_to_zero_first(motor: Motor) -> None:
    motor.run()
    motor.run_to(100)
    motor.run(-1)
    motor.run_to(104)  # 40 Hz at 10 Hz/s
    assert motor.frequency == pytest.approx(0)
    motor.run_to(106)  # then at 5 Hz/s
    assert motor.frequency == pytest.approx(-10)
    motor.run_to(104 + 8)
    assert motor.frequency == pytest.approx(-40)


def test_coasting_takes_the_voltage_off_while_the_shaft_runs_out(motor: Motor) -> None:
    motor.run()
    motor.run_to(100)
    turning = motor.speed
    motor.coast()
    assert (motor.frequency, motor.current, motor.voltage) == (0, 0, 0)
    motor.run_to(101)
    assert 0 < motor.speed < turning * 1.1
    motor.run_to(200)
    assert motor.speed == 0


def test_the_target_is_limited_by_the_maximum_frequency(motor: Motor) -> None:
    motor.target = 400
    motor.run()
    motor.run_to(1000)
    assert motor.frequency == 50


def test_volts_follow_hertz_and_amperes_follow_the_load(motor: Motor) -> None:
    motor.run()
    motor.run_to(100)
    assert motor.voltage == pytest.approx(400 * 40 / 50)
    light = motor.current
    motor.load = 1.0
    assert light < motor.current
    assert motor.current == pytest.approx(10 * math.hypot(0.3, 1.0))
    assert motor.power == pytest.approx(4 * 40 / 50)


def test_the_bus_sags_under_load_and_rises_while_braking(motor: Motor) -> None:
    idle = motor.dc_bus_voltage
    assert idle == pytest.approx(400 * math.sqrt(2))
    motor.run()
    motor.run_to(100)
    assert motor.dc_bus_voltage < idle
    motor.stop()
    motor.run_to(101)
    assert motor.dc_bus_voltage > idle


def test_the_heatsink_warms_slowly_and_cools_again(motor: Motor) -> None:
    motor.load = 0.95
    motor.run()
    motor.run_to(10)
    assert 25 < motor.heatsink < 30
    motor.run_to(3600)
    assert motor.heatsink == pytest.approx(25 + 35 * (motor.current / 10) ** 2)
    motor.coast()
    motor.run_to(7200)
    assert motor.heatsink == pytest.approx(25, abs=0.01)


def test_a_fault_keeps_the_motor_off_and_a_reset_does_not_start_it(motor: Motor) -> None:
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


def test_it_remembers_four_faults_the_latest_first(motor: Motor) -> None:
    for code in range(1, 6):
        motor.trip(code)
    assert [motor.fault_record(number) for number in range(1, 6)] == [5, 4, 3, 2, 0]


def test_it_counts_the_hours_that_it_ran(motor: Motor) -> None:
    motor.run_to(10_000)
    motor.run()
    motor.run_to(17_200)
    assert motor.run_seconds == 7200


def test_time_does_not_run_backwards(motor: Motor) -> None:
    motor.run()
    motor.run_to(4)
    motor.run_to(3)
    assert motor.frequency == pytest.approx(20)
