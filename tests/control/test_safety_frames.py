"""No order of calls sends a forbidden frame, or starts a motor without a call of `start` or `jog`.

The allowed frames were typed from the documents, not taken from the library's declarations.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from motors import MAKE, STARTS
from simulated_bus import SimulatedBus, is_write
from tables import examples

from multidrop.control.ramp import ramp, start_staggered
from multidrop.core import Message
from multidrop.drive import Direction
from multidrop.drive.register import Register
from multidrop.errors import BusError
from multidrop.sim import simulated


def word(request: Message) -> int:
    return int.from_bytes(request.data)


def erman(message: Message) -> bool:
    """Return True for an allowed write: to no reserved coil (3 to 8, 10 to 12) and no reserved register.

    Register 0001H is not reserved, but the meaning of its bits is not documented: it is not allowed either.
    """
    if message.function == 5:
        return message.start in (0, 1, 2, 9)
    return message.function == 6 and message.start in (2, 3, 4, 0x0B, 0x0C, 0x0D, 0x15)


def che(message: Message) -> bool:
    return message.function == 6 and (
        (message.start == 0x1000 and 1 <= word(message) <= 8)
        or (message.start == 0x2000 and word(message) <= 10_000)
    )


def ibd(message: Message) -> bool:
    """Return True for an allowed write: a listed control word, register 107 or 108, or a setpoint."""
    if message.start == 0x2000:
        return message.function == 6 and word(message) in (0, 1, 2, 3, 0x10)
    return message.function == 6 and (
        message.start in (107, 108) or (message.start == 0x2001 and word(message) <= 40_000)
    )


def delixi(message: Message) -> bool:
    """Return True for an allowed write.

    In a control word, reserved bits must be 0, bits 4 and 5 must not toggle the direction, and a run must
    state its direction.
    """
    if message.start == 0x2000:
        return message.function == 6 and word(message) in (0, 1, 0x12, 0x22, 0x13, 0x23)
    return message.function == 6 and message.start == 2


def native(message: Message) -> bool:
    if message.function == 2:
        return message.start in (1, 2, 3, 4) and word(message) == 0
    return (message.function == 4 and message.start in (1, 7)) or (
        message.function == 6 and message.start == 2
    )


def yd(message: Message) -> bool:
    """Return True for an allowed write: bits 4 and 5 are 0, bit 15 is 1, no reset bit with run or jog."""
    if message.start == 0x1000:
        control = word(message)
        resets = control & 0x2000 and control & 0x0500
        return message.function == 6 and not control & 0x0030 and bool(control & 0x8000) and not resets
    never = (1, 2, 3, 4, 6, 7, 8, 0x15, 0x16, 0x103, 0x104, *range(0x110, 0x116), 0x0800, 0x0801, 0x0802)
    readings = message.start == 0x1100 or 0x1200 <= message.start <= 0x1214
    return (
        message.function == 6
        and message.start not in never
        and not readings
        and not set("ABCDEF") & set(f"{message.start:X}")
    )


ALLOWED: dict[str, Callable[[Message], bool]] = {
    "erman-er-g-220": erman,
    "invt-che": che,
    "innovert-ibd": ibd,
    "delixi-modbus": delixi,
    "delixi-native": native,
    "yd1000": yd,
}
BROADCASTS = {  # (function, register address, value) of each allowed broadcast
    (6, 0x1000, 5),
    (6, 0x1000, 0xC000),
    (6, 0x1000, 0x8000),
    (6, 0x1001, 0),
    (6, 0x2000, 0),  # INVT CHE
    (6, 0x2000, 1),  # INNOVERT IBD, Delixi
    (6, 0x2001, 0),
    (2, 1, 0),
}
TURNING_VERBS = ("start", "jog", "start_staggered")
VERBS = ("start", "stop", "coast", "emergency_stop", "jog", "reset_fault", "state", "identify")

directions = st.sampled_from([None, *Direction])
numbers = st.one_of(
    st.floats(-1e5, 1e5), st.just(float("nan")), st.integers(-1, 0x1_0000), st.sampled_from([0, 1, 0.0, 30.0])
)


@st.composite
def calls(draw: st.DrawFn, model: str) -> tuple[str, Callable[[SimulatedBus, Any], object]]:
    """Draw a public call with random arguments; return its name and a function that makes it."""
    family = type(MAKE[model](1))
    name = draw(
        st.sampled_from(
            [
                *VERBS,
                *VERBS,
                *["write"] * 10,
                "set_frequency",
                "write",
                "broadcast",
                "stop_all",
                "ramp",
                "start_staggered",
            ]
        )
    )
    if name == "set_frequency":
        hz = draw(numbers)
        return name, lambda line, drive: drive.set_frequency(hz)
    if name in ("write", "broadcast"):
        registers = list(family.registers.values())
        moving = [each for each in registers if each.harmless is not None]
        register = draw(st.one_of(st.sampled_from(moving), st.sampled_from(registers)))
        value = draw(values(register))
        if name == "write":
            return name, lambda line, drive: drive.write(register, value)
        return name, lambda line, drive: line.bus.broadcast(register, value)
    if name == "stop_all":
        return name, lambda line, drive: line.bus.stop_all()
    if name == "ramp":
        hz = draw(st.floats(0, 60))
        return name, lambda line, drive: ramp(drive, hz, rate=5.0, every=1.0)
    if name == "start_staggered":
        return name, lambda line, drive: start_staggered([drive], 1.0)
    if name in ("start", "jog"):
        direction = draw(directions)
        return name, lambda line, drive: getattr(drive, name)(direction)
    return name, lambda line, drive: getattr(drive, name)()


def values(register: Register[Any]) -> st.SearchStrategy[Any]:
    if register.values is None:
        return numbers
    kind: Any = register.values
    known = st.sampled_from(list(kind))
    if hasattr(kind, "__or__") and kind.__mro__[1].__name__ == "IntFlag":
        return st.one_of(known, st.integers(0, 0xFFFF).map(kind), st.integers(0, 0xFFFF))
    return st.one_of(known, st.integers(0, 0xFFFF))


@pytest.mark.slow
@pytest.mark.parametrize("model", MAKE)
@settings(
    max_examples=examples(100),
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(data=st.data())
def test_no_sequence_of_calls_sends_a_forbidden_frame(model: str, data: st.DataObject) -> None:
    sim: Any = simulated(MAKE[model](1))
    with TemporaryDirectory() as directory:
        line = SimulatedBus(sim, ledger=Path(directory) / "wear")
        play(line, sim, model, data)


def play(line: SimulatedBus, sim: Any, model: str, data: st.DataObject) -> None:
    """Write a setpoint, then make random calls, with random replies lost."""
    drive = line.attach(sim.drive)
    drive.set_frequency(20)
    line.frames.clear()
    loses = data.draw(st.sampled_from(["nothing", "writes", "some"]))
    some = data.draw(st.sets(st.integers(0, 60), max_size=12))
    line.loses = {
        "nothing": lambda request: False,
        "writes": is_write,
        "some": lambda request: len(line.frames) in some,
    }[loses]
    for name, call in data.draw(st.lists(calls(model), min_size=1, max_size=6)):
        begun = len(line.frames)
        ran = sim.motor.energised
        with suppress(BusError, ValueError, TypeError):
            call(line, drive)
        sent = [request for request, _ in line.frames[begun:] if is_write(request)]
        for request in sent:
            if request.address == 0:
                assert (request.function, request.start, word(request)) in BROADCASTS
            else:
                assert ALLOWED[model](request), f"{name} sent {request}"
        turning = [request for request in sent if STARTS[model](request)]
        assert len(turning) <= (name in TURNING_VERBS), f"{name} sent {turning}"
        assert len([request for request in sent if resets(model, request)]) <= (name == "reset_fault")
        sim.pass_time(line.seconds)
        if name not in TURNING_VERBS and not ran:
            assert not sim.motor.energised, f"{name} started the motor"


def resets(model: str, message: Message) -> bool:
    """Return True for a write that resets a fault, which a call may send only once."""
    if message.address == 0:
        return False
    return {
        "erman-er-g-220": message.function == 5 and message.start == 9 and word(message) != 0,
        "invt-che": message.start == 0x1000 and word(message) == 7,
        "innovert-ibd": message.start == 0x2000 and bool(word(message) & 0x10),
        "delixi-modbus": False,
        "delixi-native": message.function == 2 and message.start == 4,
        "yd1000": message.start == 0x1000 and bool(word(message) & 0x2000),
    }[model]
