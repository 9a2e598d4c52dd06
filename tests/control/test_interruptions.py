"""Ctrl-C at any step of an exchange: the caller learns what may have been sent, and no resource leaks."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import count
from linecache import getline
from types import FrameType
from typing import Any

import pytest
from interruptions import interrupted_at
from lines import PATIENCE
from motors import MAKE, STARTS, ReceivedRequests
from simulated_bus import STOPS, Own, SimulatedBus, first, is_write, one, writes

from multidrop import Bus
from multidrop.control.outcome import Seen
from multidrop.core import Message
from multidrop.drive import Script, insist, read, wait, write
from multidrop.drive.verbs import verb
from multidrop.families import InvtCHE
from multidrop.sim import MotorDrive, Simulator, Wire, simulated
from multidrop.transport import clock
from multidrop.transport import line as of_a_port

BAUDRATE = 38400  # a high baud rate, with short silences between frames
CODE = of_a_port.Line.carry_out.__code__


def counts(frame: FrameType) -> bool:
    """Return True if an interruption may be raised before this line of an exchange: any line but the last."""
    return frame.f_code is CODE and "discard" not in getline(CODE.co_filename, frame.f_lineno)


def interrupted(call: Callable[[], object], nth: int) -> KeyboardInterrupt | None:
    """Interrupt a call before the nth line of its exchanges; return None if they have fewer lines."""
    try:
        with interrupted_at(nth, counts):
            call()
    except KeyboardInterrupt as interruption:
        return interruption
    return None


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("verb", ["start", "coast", "stop"])
def test_a_keyboard_interrupt_reports_what_may_have_been_sent(verb: str) -> None:
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


def test_an_interrupted_exchange_does_not_delay_the_next_exchange(monkeypatch: pytest.MonkeyPatch) -> None:
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


# families whose stop has two writes: the second withdraws START, or ends a jog
OF_TWO_WRITES = ("erman-er-g-220", "invt-che")


class Restless(Own):
    """A drive whose stop reads without waiting, and never sees the motor at rest."""

    model = "restless"
    title = "OWN 4"

    @verb
    def stop(self) -> Script[None]:
        yield from insist(self.run, 0)
        while (yield from read(self.ratio)) >= 0:
            pass


class Careful(Own):
    """A drive whose stop reads first, and waits before the last write."""

    model = "careful"
    title = "OWN 3"

    @verb
    def stop(self) -> Script[None]:
        ratio = yield from read(self.ratio)
        yield from write(self.run, 7 if ratio else 0)
        yield from wait(2)
        yield from write(self.run, 9)


@pytest.mark.parametrize("model", MAKE)
@pytest.mark.parametrize("all_of_them", [False, True])
def test_a_stop_is_sent_once_more_after_an_interruption(model: str, all_of_them: bool) -> None:
    line, drive, _ = one(MAKE[model](1))
    drive.set_frequency(20)
    drive.start()
    begun = len(line.frames)
    pressed: list[Message] = []

    def press(request: Message) -> bytes | None:
        if len(line.frames) > begun and not pressed:
            pressed.append(request)
            raise KeyboardInterrupt
        return None

    line.answers = press
    with pytest.raises(KeyboardInterrupt) as interruption:
        line.bus.stop_all() if all_of_them else drive.stop()
    stops = [write for write in writes(line, begun) if STOPS[model](write)]
    assert len(stops) == 2
    assert interruption.value.__notes__ == [
        f"{drive.name}: the stop was sent {'2 to 3' if model in OF_TWO_WRITES else '1 to 2'} times; "
        "the motor is not seen to stand"
    ]


def test_an_interrupted_stop_also_ends_a_jog() -> None:
    """The motor's state is not read after an interruption, so the motor may be jogging."""
    line, drive, _ = one(InvtCHE(1, maximum_frequency=50))
    drive.jog()
    begun = len(writes(line))

    line.fails = lambda request: KeyboardInterrupt() if len(writes(line)) == begun + 1 else None
    with pytest.raises(KeyboardInterrupt):
        drive.stop()
    sent = writes(line)[begun:]
    assert [write.data for write in sent] == [b"\0\5", b"\0\5", b"\0\x08"]
    assert [request for request, _ in line.frames[-3:]] == sent


def test_a_stop_that_keeps_reading_does_not_delay_other_stops() -> None:
    sims: list[Any] = [simulated(Restless(1)), simulated(InvtCHE(2, maximum_frequency=50))]
    line = SimulatedBus(*sims)
    restless, other = (line.attach(sim.drive) for sim in sims)
    other.set_frequency(20)
    other.start()
    line.bus.check_identity(restless)
    begun, heard = len(line.frames), line.seconds + 1.0
    line.deafens = lambda request: request.address == 2 and line.seconds < heard
    found = line.bus.stop_all(seconds=12)
    assert {name: stopped.seen for name, stopped in found.items()} == {
        restless.name: Seen.SENT,
        other.name: Seen.STOPPED,
    }
    assert [request.address for request in writes(line, begun)][:4] == [1, 2, 2, 2]


def test_an_interrupted_stop_is_sent_again_up_to_the_first_wait() -> None:
    line = SimulatedBus(simulated(Careful(1)))
    drive = line.attach(Careful(1))
    drive.write(drive.ratio, 3.0)
    line.bus.check_identity(drive)
    begun, pressed = len(line.frames), [KeyboardInterrupt()]

    line.fails = lambda request: pressed.pop() if pressed else None
    with pytest.raises(KeyboardInterrupt) as interruption:
        drive.stop()
    assert [write.data for write in writes(line, begun)] == [b"\0\7"]
    assert interruption.value.__notes__ == [
        f"{drive.name}: the stop was sent 1 times; the motor is not seen to stand"
    ]


def test_a_second_ctrl_c_ends_the_retries_of_a_stop() -> None:
    line, drive, _ = one(InvtCHE(1, maximum_frequency=50))
    line.bus.check_identity(drive)

    line.fails = lambda request: KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt) as interruption:
        drive.stop()
    assert len(writes(line)) == 2
    assert interruption.value.__notes__ == [
        f"{drive.name}: the stop was sent 0 to 2 times; the motor is not seen to stand"
    ]


@pytest.mark.parametrize(
    ("moment", "note"),
    [
        ("look", "the start was not sent"),
        ("start", "control = FORWARD may have been sent; its effect is unknown"),
        ("after", "control = FORWARD was sent and confirmed, but its effect was not seen"),
    ],
)
def test_an_interrupted_start_says_what_was_sent(moment: str, note: str) -> None:
    line, drive, _ = one(InvtCHE(1, maximum_frequency=50))
    drive.set_frequency(20)

    def press(request: Message) -> bytes | None:
        is_start = is_write(request) and STARTS["invt-che"](request)
        was_sent = first(line, 0, STARTS["invt-che"]) is not None
        if {"look": True, "start": is_start, "after": was_sent and not is_start}[moment]:
            raise KeyboardInterrupt
        return None

    line.answers = press
    with pytest.raises(KeyboardInterrupt) as interruption:
        drive.start()
    assert interruption.value.__notes__ == [f"{drive.name}: {note}"]
