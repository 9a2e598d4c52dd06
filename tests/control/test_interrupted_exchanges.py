"""Ctrl-C at any step of an exchange: what may have been sent is told, and nothing is left behind."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import count
from linecache import getline
from types import FrameType

import pytest
from interruptions import interrupted_at
from lines import PATIENCE
from motors import ReceivedRequests

from multidrop import Bus
from multidrop.families import InvtCHE
from multidrop.sim import MotorDrive, Simulator, Wire, simulated
from multidrop.transport import clock
from multidrop.transport import line as of_a_port

BAUDRATE = 38400  # its silences are short
CODE = of_a_port.Line.carry_out.__code__


def counts(frame: FrameType) -> bool:
    """Say whether a signal comes before this line: not before the last one, after which nothing is left."""
    return frame.f_code is CODE and "discard" not in getline(CODE.co_filename, frame.f_lineno)


def interrupted(call: Callable[[], object], nth: int) -> KeyboardInterrupt | None:
    """Call it, and raise before the nth line of the exchanges that it makes; None where there are fewer."""
    try:
        with interrupted_at(nth, counts):
            call()
    except KeyboardInterrupt as interruption:
        return interruption
    return None


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("verb", ["start", "coast", "stop"])
def test_what_may_have_been_sent_is_told_wherever_it_is_interrupted(verb: str) -> None:
    sim = simulated(InvtCHE(1, baudrate=BAUDRATE, maximum_frequency=50))
    assert isinstance(sim, MotorDrive)
    received = ReceivedRequests(sim)
    with Simulator([Wire([sim], unpaced=True)]) as simulator:
        for nth in count(1):
            with Bus(simulator.wires[0].path, expiry=PATIENCE) as bus:
                drive = bus.attach(InvtCHE, address=1, baudrate=BAUDRATE, maximum_frequency=50)
                drive.set_frequency(25.0)
                before = len(received.writes)
                interruption = interrupted(getattr(drive, verb), nth)
                sent = received.writes[before:]
            if interruption is None:
                break
            (told,) = interruption.__notes__
            assert "sent" in told
            if sent:
                assert "nothing of the" not in told
                assert "no stop was sent" not in told
    assert nth > 8


def test_an_interrupted_exchange_does_not_hold_the_port_up(monkeypatch: pytest.MonkeyPatch) -> None:
    waits: list[float] = []
    with Simulator([Wire([simulated(InvtCHE(1, baudrate=BAUDRATE))], unpaced=True)]) as simulator:
        for nth in count(1):
            bus = Bus(simulator.wires[0].path)
            drive = bus.attach(InvtCHE, address=1, baudrate=BAUDRATE)
            interruption = interrupted(partial(drive.read, drive.status), nth)
            with monkeypatch.context() as patched:
                patched.setattr(clock, "sleep", waits.append)
                bus.close()
            assert waits == []
            if interruption is None:
                break
    assert nth > 8
