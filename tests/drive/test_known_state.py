"""A drive's state from known values, computed again only if it may have changed."""

from __future__ import annotations

import math

import pytest

from multidrop import Condition
from multidrop.drive import Drive, StateReader
from multidrop.drive.register import reading
from multidrop.drive.script import Script, read
from multidrop.drive.state import State
from multidrop.drive.verbs import verb
from multidrop.families import MODELS

RUNS, STANDS = State(Condition.RUNNING), State(Condition.STOPPED)


class Counting(Drive):
    """A drive that records each computation of its state, in all copies."""

    looks: list[float] = []
    speed = reading(0x10)
    temperature = reading(0x11)

    @verb
    def state(self) -> Script[State]:
        """Return running if the speed is not 0."""
        speed = yield from read(self.speed)
        self.looks.append(speed)
        return RUNS if speed else STANDS


class Noting(Drive):
    """A drive that stores an attribute while its state is computed, so each call must compute it."""

    speed = reading(0x10)

    def __init__(self, address: int) -> None:
        super().__init__(address)
        self.zeros = 0

    @verb
    def state(self) -> Script[State]:
        """Return the state `stopped` after two successive readings of output frequency 0."""
        speed = yield from read(self.speed)
        self.zeros = 0 if speed else self.zeros + 1
        return STANDS if self.zeros > 1 else RUNS


def test_the_state_of_equal_values_is_computed_once() -> None:
    Counting.looks.clear()
    reader = StateReader(Counting(1))
    for temperature in range(5):
        assert reader.state({"speed": 25.0, "temperature": float(temperature)}) == RUNS
    assert Counting.looks == [25.0]
    assert reader.state({"speed": 0.0}) == STANDS
    assert reader.state({}) is None
    assert reader.state({"speed": 0.0}) == STANDS
    assert reader.state({"speed": 25.0}) == RUNS
    assert Counting.looks[-1] == 25.0


def test_the_state_of_nan_is_computed_again() -> None:
    Counting.looks.clear()
    reader = StateReader(Counting(1))
    assert [reader.state({"speed": math.nan}) for _ in range(2)] == [RUNS, RUNS]
    assert len(Counting.looks) == 2


def test_the_state_of_a_family_with_attributes_is_computed_each_time() -> None:
    reader = StateReader(Noting(1))
    shown = [reader.state({"speed": speed}) for speed in (25.0, 0.0, 0.0, 0.0, 25.0, 0.0, 0.0)]
    assert shown == [RUNS, RUNS, STANDS, STANDS, RUNS, RUNS, STANDS]


# Status words from the manuals. A Delixi with Modbus has none: only its fault code shows a fault.
@pytest.mark.parametrize(
    ("model", "values", "condition"),
    [
        ("invt-che", {"status": 4.0}, Condition.FAULT),
        ("invt-che", {"status": 3.0}, Condition.STOPPED),
        ("delixi-native", {"status": 4.0}, Condition.FAULT),
        ("delixi-modbus", {"output_frequency": 25.0}, None),
    ],
)
def test_a_fault_is_detected_from_the_status_alone(
    model: str, values: dict[str, float], condition: Condition | None
) -> None:
    found = StateReader(MODELS[model](1)).state(values)
    assert (found and found.condition) == condition
    assert found is None or found.fault is None


def test_a_fault_gets_its_name_when_its_code_arrives() -> None:
    reader = StateReader(MODELS["invt-che"](1))
    assert reader.state({"status": 4.0}) == State(Condition.FAULT)
    assert reader.state({"status": 4.0}) == State(Condition.FAULT)
    named = reader.state({"status": 4.0, "fault": 4.0})
    assert named == State(Condition.FAULT, fault="overcurrent while accelerating (OC1)")
    assert reader.state({"status": 4.0}) == State(Condition.FAULT)
