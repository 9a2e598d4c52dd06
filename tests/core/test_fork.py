"""A forked process opens its own lines and does not touch its parent's. Sub-interpreters are rejected."""

from __future__ import annotations

import gc
import multiprocessing
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, cast

import pytest
import toy
from commands import BoundProcess
from lines import PATIENCE, plant, polled, rows_of, until
from lines import line as declared
from ptys import SerialServer
from toy import Toy

from multidrop.bus import Bus
from multidrop.core import Field, NumberFormat, RowLayout, RowQueue, Status
from multidrop.core.process import only_here
from multidrop.errors import CancelledByStop, LineError, NoReply
from multidrop.families import InvtCHE
from multidrop.poller import Poller
from multidrop.sim import MotorDrive, Simulator, Wire, simulated

pytestmark = pytest.mark.filterwarnings(
    "ignore:.*fork:DeprecationWarning",  # Python's warning about a fork while other threads run
    "ignore:set(Daemon|Name)\\(\\) is deprecated:DeprecationWarning",
)


@contextmanager
def child(act: Callable[[], object]) -> Iterator[Any]:
    """Call `act` in a forked child and yield its result. The child lives until the end of the block."""
    ours, theirs = multiprocessing.Pipe()

    def run() -> None:
        try:
            theirs.send(act())
        except Exception as failure:
            theirs.send(failure)
        theirs.recv()

    process = multiprocessing.get_context("fork").Process(target=run)
    process.start()
    try:
        assert ours.poll(PATIENCE), "the child hangs"
        yield ours.recv()
        ours.send("leave")
        process.join(PATIENCE)
        assert process.exitcode == 0
    finally:
        process.kill()
        process.join()
        ours.close()
        theirs.close()


def in_child(act: Callable[[], object]) -> Any:
    with child(act) as told:
        if isinstance(told, Exception):
            raise told
        return told


@contextmanager
def held(*locks: Any) -> Iterator[None]:
    """Let another thread hold these locks during the block."""
    are_held, done = threading.Event(), threading.Event()

    def hold() -> None:
        with ExitStack() as stack:
            for lock in locks:
                stack.enter_context(lock)
            are_held.set()
            done.wait(PATIENCE)

    holding = threading.Thread(target=hold)
    holding.start()
    assert are_held.wait(PATIENCE)
    try:
        yield
    finally:
        done.set()
        holding.join()


def wire(port: str = "pty") -> Wire:
    drive = simulated(Toy(1))
    drive["output_current"] = 3.25
    return Wire([drive], unpaced=True, port=port)


def current(bus: Bus) -> float:
    drive = bus.drives[0] if bus.drives else bus.attach(Toy, 1)
    return drive.read(Toy.output_current)


def is_polled(poller: Poller) -> bool:
    """Return True once the poller has a value of the drive on `wire`."""
    return any(row.value == 3.25 for row in rows_of(poller))


@pytest.fixture
def port() -> Iterator[str]:
    with Simulator([wire()]) as simulator:
        yield simulator.wires[0].path


@pytest.fixture(params=["pty", "socket", "rfc2217"])
def any_port(request: pytest.FixtureRequest) -> Iterator[str]:
    """Yield a port of each kind, with a simulated drive behind it."""
    with Simulator([wire("pty" if request.param == "pty" else "socket://127.0.0.1:0")]) as simulator:
        if request.param != "rfc2217":
            yield simulator.wires[0].path
            return
        server = SerialServer(simulator.wires[0].path)
        yield server.url
        server.close()


@pytest.mark.slow
def test_forked_child_can_open_other_lines(port: str) -> None:
    def open_another() -> float:
        with Bus(other.wires[0].path) as bus:
            return current(bus)

    with Simulator([wire()]) as other, Bus(port) as bus:
        assert current(bus) == 3.25
        for _ in range(2):
            assert in_child(open_another) == 3.25
        assert current(bus) == 3.25


@pytest.mark.slow
def test_forked_grandchild_can_open_other_lines(port: str) -> None:
    def open_it() -> float:
        with Bus(port) as bus:
            return current(bus)

    def open_another() -> Any:
        with Bus(other.wires[0].path):
            return in_child(open_it)

    with Simulator([wire()]) as other, Bus(port) as bus:
        assert current(bus) == 3.25
        bus.line.close()
        assert in_child(open_another) == 3.25


@pytest.mark.slow
def test_using_an_inherited_bus_in_a_forked_child_raises_an_error(any_port: str) -> None:
    def use() -> list[str]:
        with bus:
            stopped = [each.why for each in bus.stop_all().values()]
            with pytest.raises(LineError) as failure:
                current(bus)
            with pytest.raises(CancelledByStop, match="the start was not sent: the bus was closed"):
                bus.drives[0].start()
        return [*stopped, str(failure.value)]

    with Bus(any_port) as bus:
        assert current(bus) == 3.25
        sentence = f"{any_port}: it was opened before this process was forked; open it again here"
        assert in_child(use) == [sentence] * 2
        assert current(bus) == 3.25


@pytest.mark.slow
def test_parents_bus_works_after_a_child_discards_a_copy(any_port: str) -> None:
    buses = [Bus(any_port)]

    def let_go() -> None:
        buses.clear()
        gc.collect()

    try:
        assert current(buses[0]) == 3.25
        assert in_child(let_go) is None
        assert current(buses[0]) == 3.25
    finally:
        buses[0].close()


@pytest.mark.slow
def test_parents_port_stays_open_if_a_child_closes_the_inherited_bus() -> None:
    with Bus("loop://") as bus:
        assert in_child(bus.close) is None
        with pytest.raises(NoReply):
            current(bus)


def test_a_child_does_not_wait_for_a_lock_of_the_loop_port() -> None:
    with Bus("loop://") as bus:
        with held(cast(Any, bus.line._opened._serial).queue.mutex):  # the bridge's thread often holds it
            assert in_child(bus.close) is None
        with pytest.raises(NoReply):
            current(bus)


def test_parent_can_reopen_a_closed_port_while_the_child_lives(port: str) -> None:
    bus = Bus(port)
    with child(lambda: None):
        bus.close()
        with Bus(port) as again:
            assert current(again) == 3.25


def test_a_child_does_not_wait_for_a_bus_lock_held_in_the_parent(port: str) -> None:
    def use() -> None:
        bus.detach(bus.drives[0])
        bus.line.require((9600, "8N1"))
        bus.close()

    with Bus(port) as bus:
        assert current(bus) == 3.25
        # This stop stays in progress in the parent until `over` is called.
        stop = threading.Thread(target=bus._latches.begin, args=["stop", bus.drives])
        stop.start()
        stop.join()
        with held(bus.line._lock, bus._attached.lock):
            assert in_child(use) is None
        bus._latches.over("stop")
        assert current(bus) == 3.25


@pytest.mark.slow
def test_inherited_poller_is_closed_in_a_forked_child(port: str) -> None:
    def look() -> list[Any]:
        found = [poller.take(), poller.summary()["lines"].keys(), poller.fileno() > 0]
        poller.close()
        return [str(each) for each in found]

    def open_another() -> int:
        with Poller(plant(declared(other.wires[0].path, toy))) as another:
            until(lambda: is_polled(another))
        return 1

    toy = polled(Toy(1), [Toy.output_current])
    with Simulator([wire()]) as other, Poller(plant(declared(port, toy))) as poller:
        until(lambda: is_polled(poller))
        assert in_child(look) == ["None", "dict_keys(['line'])", "True"]
        assert in_child(open_another) == 1
        until(lambda: is_polled(poller))


def test_a_child_does_not_wait_for_a_poller_lock_held_in_the_parent(port: str) -> None:
    toy = polled(Toy(1), [Toy.output_current])

    def use() -> None:
        poller.summary()
        poller.remove("line", toy.drive.name)
        poller.close()

    with Poller(plant(declared(port, toy))) as poller:
        with held(poller._changing, next(iter(poller._lines))._lock):
            assert in_child(use) is None
        until(lambda: is_polled(poller))


def test_only_here_wrapper_does_nothing_in_a_forked_child() -> None:
    given: list[str] = []
    give_back = only_here(given.append)

    def act() -> list[str]:
        give_back("there")
        return given

    give_back("here")
    assert in_child(act) == ["here"]


def test_pending_rows_can_be_read_only_in_the_parent_process() -> None:
    row_queue, block = RowQueue(), RowLayout(0, [Field(0, NumberFormat.U16, 0, 1, 1)])
    row_queue.add_miss(block, Status.NO_REPLY, 0)
    assert in_child(row_queue.take) is None
    found = row_queue.take()
    assert found is not None
    assert len(found) == 1


LEFT = """
import os, sys
sys.path[:0] = [{support!r}]
from toy import Toy
from multidrop import Bus
from multidrop.sim import Simulator, Wire, simulated
with Simulator([Wire([simulated(Toy(1))], unpaced=True)]) as simulator:
    child = os.fork()
    if child == 0:
        sys.exit(0)  # leaves the simulator's block
    os.waitpid(child, 0)
    assert simulator._thread.is_alive()
    with Bus(simulator.wires[0].path) as bus:
        print(bus.attach(Toy, 1).read(Toy.status))
"""


@pytest.mark.long
def test_the_exit_of_a_child_does_not_end_the_parents_simulator() -> None:
    # a socket that the child leaves open is reported on stderr
    shown = ["-W", "ignore", "-W", "always::ResourceWarning"]
    words = [sys.executable, *shown, "-c", LEFT.format(support=str(Path(toy.__file__).parent))]
    done = subprocess.run(words, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert (done.stdout, done.stderr, done.returncode) == ("0\n", "", 0)


PARENT = """
import os, signal, sys, time
from multidrop import Bus, InvtCHE
with Bus(sys.argv[1]) as bus:
    pump = bus.attach(InvtCHE(1, maximum_frequency=50))
    pump.set_frequency(20)
    pump.start()
    bus.stop_on_exit()
    child = os.fork()
    if child == 0:
        signal.alarm(30)  # ends the child if it hangs
        {end}
        sys.exit(0)
    print(os.waitpid(child, 0)[1], flush=True)
    sys.stdin.read()
"""
ENDS = {
    "leaving": ("pass", 0),
    "closing": ("bus.close()", 0),
    "SIGTERM": ("signal.raise_signal(signal.SIGTERM)", signal.SIGTERM),
}


@pytest.mark.long
@pytest.mark.parametrize("end", ENDS)
def test_the_exit_of_a_child_does_not_stop_the_parents_motor(end: str) -> None:
    """Only the parent stops the motor, when it leaves the bus."""
    sim = simulated(InvtCHE(1, maximum_frequency=50))
    assert isinstance(sim, MotorDrive)
    sim.motor.deceleration_time = 0.2
    act, status = ENDS[end]
    with Simulator([Wire([sim], unpaced=True)]) as simulator:
        words = [sys.executable, "-W", "ignore", "-c", PARENT.format(end=act), simulator.wires[0].path]
        with BoundProcess(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as parent:
            assert parent.stdout is not None
            assert parent.stdout.readline() == f"{int(status)}\n"
            assert [write.raw for write in sim.counters.writes if write.name == "control"] == [1]
            parent.communicate()
        assert parent.returncode == 0
        start, *stops = (write.raw for write in sim.counters.writes if write.name == "control")
        # On a busy computer the stop may be repeated, or followed by the stop of a jog.
        assert (start, stops[0], set(stops) - {5, 8}) == (1, 5, set())


CODE = """
try:
    import _interpreters as interpreters
except ImportError:
    import _xxsubinterpreters as interpreters

INSIDE = '''
import sys
try:
    import multidrop
except ImportError as refusal:
    print(refusal)
print([name for name in sys.modules if name.startswith("multidrop")])
'''
for _ in range(3):
    one = interpreters.create()
    interpreters.run_string(one, INSIDE)
    interpreters.destroy(one)
from multidrop import Bus
print("and here it works:", Bus.__name__)
"""


@pytest.mark.slow
def test_importing_multidrop_fails_in_a_sub_interpreter() -> None:
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True)
    refused = (
        "multidrop cannot be imported in a sub-interpreter. Import it in the process's main "
        "interpreter, or in another process"
    )
    lines = done.stdout.splitlines()
    assert lines[0::2][:3] == [refused] * 3
    assert lines[1::2] == ["[]"] * 3
    assert lines[6] == "and here it works: Bus"
