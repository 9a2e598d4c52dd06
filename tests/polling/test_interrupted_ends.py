"""A bus, poller or simulator whose opening or closing was interrupted is closed completely by a second close.

KeyboardInterrupt is raised before each bytecode of the main thread in turn, in the package's own files. This
is harsher than a signal handler, which runs only between some bytecodes.
"""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from time import sleep
from typing import Any

import pytest
from interruptions import Interruption, every, interrupted, interrupted_before
from lines import ANY_PORT, PATIENCE, line, patient, plant, polled, until
from motors import ReceivedRequests
from tables import usually
from toy import Toy

from multidrop import Bus, InvtCHE, Poller
from multidrop.sim import EncodedDrive, MotorDrive, Simulator, Wire, simulated

# An interrupted garbage collection gives this warning.
pytestmark = [patient, pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")]

CURRENT = Toy.registers["output_current"]
STRIDE = 31  # number of bytecodes between interruptions, except in the complete run


@dataclass
class Received:
    """A simulated line, with the path of its port and a drive that counts requests."""

    path: str
    drive: Counting


class Counting(EncodedDrive):
    requests = 0

    def receive(self, frame: Any) -> Any:
        self.requests += 1
        return super().receive(frame)


@pytest.fixture
def hall() -> Iterator[Received]:
    drive = Counting(Toy(1))
    with Simulator([Wire([drive], unpaced=True)]) as simulator:
        yield Received(simulator.wires[0].path, drive)


def falls_silent(requests: Callable[[], int]) -> None:
    """Check that no further request is sent after the drive has received the last one."""

    def has_ended() -> bool:
        before = requests()
        sleep(0.02)
        return requests() == before

    until(has_ended, 10.0)


def made(hall: Received) -> Poller:
    return Poller(plant(line(hall.path, polled(Toy(1, name="pump"), [CURRENT]))))


def ended(poller: Poller, hall: Received) -> None:
    """Close the poller again; check that buses are closed, requests have ended, and the port is free."""
    poller.close()
    assert not any(bus.is_open for bus in poller.buses.values())
    falls_silent(lambda: hall.drive.requests)
    with Bus(hall.path) as bus:  # raises if the port is still open
        bus.attach(Toy, 1).read(CURRENT)


NIGHTLY = pytest.mark.nightly
STEPS = [*usually(STRIDE, 7), pytest.param(1, marks=NIGHTLY)]


@pytest.mark.long
@pytest.mark.parametrize(
    ("end", "step"),
    [
        ("close", STRIDE),
        *usually(("__exit__", STRIDE), ("__exit__", 7)),  # calls `close`
        pytest.param("__exit__", 1, marks=NIGHTLY),
    ],
)
def test_a_second_close_completes_an_interrupted_close_of_a_poller(
    hall: Received, step: int, end: str
) -> None:
    places: set[str] = set()

    def act(nth: int) -> bool:
        poller = made(hall)
        poller.__enter__()
        until(poller.take)
        details = () if end == "close" else (None, None, None)
        was = interrupted(lambda: getattr(poller, end)(*details), nth, places)
        ended(poller, hall)
        return was

    assert every(step, act) > 1
    assert any("Poller" in place for place in places)


@pytest.mark.parametrize(
    ("end", "step", "failure"),
    [
        ("close", STRIDE, Interruption),
        *usually(("__exit__", STRIDE, Interruption), ("__exit__", 7, Interruption)),
        *usually(("__exit__", 2 * STRIDE, ZeroDivisionError), ("__exit__", 7, ZeroDivisionError)),
        pytest.param("__exit__", 1, Interruption, marks=NIGHTLY),
        pytest.param("__exit__", 1, ZeroDivisionError, marks=NIGHTLY),
    ],
)
def test_an_interrupted_close_still_stops_motors(end: str, step: int, failure: type[BaseException]) -> None:
    details = () if end == "close" else (None, None, None)
    handler = signal.getsignal(signal.SIGINT)

    def act(nth: int) -> bool:
        sim = simulated(InvtCHE(1, baudrate=38400, maximum_frequency=50))
        assert isinstance(sim, MotorDrive)
        sim.motor.acceleration_time = sim.motor.deceleration_time = 0.01
        received = ReceivedRequests(sim)
        with Simulator([Wire([sim], unpaced=True)]) as simulator:
            pump = InvtCHE(1, name="pump", baudrate=38400, maximum_frequency=50)
            declared = plant(line(simulator.wires[0].path, polled(pump, [InvtCHE.output_frequency])))
            poller = Poller(declared, stop_on_exit=True).__enter__()
            pump.set_frequency(20)
            pump.start()
            with suppress(failure), interrupted_before(nth, failure) as place:
                getattr(poller, end)(*details)
            poller.close()
            assert not any(bus.is_open for bus in poller.buses.values()), place
            assert poller.bus("line").stopped["pump"].ok, place
            assert not sim.motor.energised, place
            assert signal.getsignal(signal.SIGINT) is handler, place
            falls_silent(lambda: len(received.requests))
        return bool(place)

    assert every(step, act) > 1


@pytest.mark.parametrize("step", STEPS)
def test_a_poller_interrupted_at_its_start_can_be_closed(hall: Received, step: int) -> None:
    places: set[str] = set()

    def act(nth: int) -> bool:
        poller = made(hall)
        was = interrupted(poller.__enter__, nth, places)
        ended(poller, hall)
        return was

    assert every(step, act) > 1
    assert any("Poller" in place for place in places)


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("deed", ["take", "adopt", "set_rate"])
def test_a_poller_can_be_closed_after_any_interrupted_call(hall: Received, step: int, deed: str) -> None:
    def adopt(nth: int) -> None:
        poller.adopt(plant(line(hall.path, polled(Toy(1, name=f"pump-{nth}"), [CURRENT]))))

    def set_rate(nth: int) -> None:
        poller.set_rate(poller.plant.lines[0].drives[0].drive, CURRENT, 0.001 * nth)

    deeds = {"take": lambda nth: poller.take(), "adopt": adopt, "set_rate": set_rate}
    poller = made(hall)
    poller.__enter__()
    assert every(step, lambda nth: interrupted(partial(deeds[deed], nth), nth, set())) > 1
    ended(poller, hall)


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("deed", ["open", "close"])
def test_a_bus_can_be_closed_after_an_interrupted_open_or_close(hall: Received, step: int, deed: str) -> None:
    def act(nth: int) -> bool:
        if deed == "open":
            was = interrupted(lambda: Bus(hall.path), nth, set())
            gc.collect()  # closes a bus whose constructor was interrupted
        else:
            bus = Bus(hall.path)
            bus.attach(Toy, 1).read(CURRENT)
            was = interrupted(bus.close, nth, set())
            bus.close()
            assert not bus.is_open
        with Bus(hall.path) as again:
            again.attach(Toy, 1).read(CURRENT)
        return was

    assert every(step, act) > 1


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("deed", ["__enter__", "__exit__"])
def test_a_simulator_can_be_ended_after_an_interrupted_start_or_end(step: int, deed: str) -> None:
    def act(nth: int) -> bool:
        simulator = Simulator([Wire([EncodedDrive(Toy(1))], unpaced=True)])
        if deed == "__exit__":
            simulator.__enter__()
        was = interrupted(getattr(simulator, deed), nth, set())
        simulator.__exit__()
        assert not simulator._thread.is_alive()
        assert simulator.wires[0].port is None
        return was

    assert every(step, act) > 1


LEFT_OPEN = """
import gc, sys, time
sys.path[:0] = {path!r}
from lines import line, plant, polled
from toy import Toy
from multidrop import Poller
poller = Poller(plant(line({port!r}, polled(Toy(1, name="pump"), [Toy.output_current]))))
poller.__enter__()
while not poller.take():
    pass
if {is_ended}:  # as by a closing that was interrupted
    poller._closing = True
    poller._call_thread()
    poller._thread.join()
{end}
class Late:
    def __del__(self, sleep=time.sleep):
        sleep(0.05)
sys.late = Late()  # collected after most of the others
"""
ENDS = {
    "at the end": "",
    "by SystemExit": "sys.exit(0)",
    "collected": "del poller; gc.collect()",
    "in a cycle": "poller.itself = poller; del poller; gc.collect(); x = [bytearray(5000)] * 2000",
    "used at exit": "import atexit; atexit.register(lambda: [poller.take() for _ in range(100)])",
    "without an owner of its port": "line = poller.bus('line').line; line.queue = None; gc.collect()",
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("end", "is_ended"),
    [*((end, False) for end in ENDS), ("at the end", True), ("without an owner of its port", True)],
)
def test_a_poller_left_open_at_exit_does_not_corrupt_memory(hall: Received, end: str, is_ended: bool) -> None:
    """At exit the interpreter frees objects in any order, while the core's thread still runs."""
    path = [each for each in sys.path if each]
    code = LEFT_OPEN.format(path=path, port=hall.path, is_ended=is_ended, end=ENDS[end])
    env = {**os.environ, "PYTHONMALLOC": "malloc", "MALLOC_PERTURB_": "165"}  # freed memory is overwritten
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, env=env)
    assert (ran.returncode, ran.stderr) == (0, "")
    falls_silent(lambda: hall.drive.requests)


@pytest.mark.parametrize("interrupted", [0, 1, 2])
def test_interrupted_openings_leave_no_port_open(monkeypatch: pytest.MonkeyPatch, interrupted: int) -> None:
    """All ports are closed, even those that other threads open after the interruption."""
    wires = [Wire([simulated(Toy(1))], unpaced=True, port=ANY_PORT) for _ in range(3)]
    buses: list[Bus] = []
    open_bus, others_are_open = Bus.__init__, threading.Semaphore(0)

    def opened(bus: Bus, port: str, **details: object) -> None:
        if port == simulator.wires[interrupted].path:
            for _ in range(2):
                assert others_are_open.acquire(timeout=PATIENCE)
            raise KeyboardInterrupt
        open_bus(bus, port, **details)  # type: ignore[arg-type]
        buses.append(bus)
        others_are_open.release()

    with Simulator(wires) as simulator:
        declared = [
            line(wire.path, polled(Toy(1, name=f"fan-{n}"), [Toy.output_current], None), name=f"line-{n}")
            for n, wire in enumerate(simulator.wires)
        ]
        monkeypatch.setattr(Bus, "__init__", opened)
        with pytest.raises(KeyboardInterrupt):
            Poller(plant(*declared))
        assert len(buses) == 2
        assert not any(bus.is_open for bus in buses)
