"""Exit by a signal: the drives of all buses are stopped in parallel; a second signal does not abort this."""

from __future__ import annotations

import errno
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import pytest
from commands import BoundProcess
from lines import PATIENCE, line, plant, polled, until
from motors import ReceivedRequests
from tables import usually

from multidrop.bus import Bus
from multidrop.control.exit_hook import CUT_SHORT, ExitHook, ExitTask
from multidrop.families import InvtCHE
from multidrop.poller import Poller
from multidrop.sim import MotorDrive, Simulator, Wire, simulated

BOTH = pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])


class Act:
    """The two callbacks of an exit task. `work` returns when the test sets `go_on`."""

    def __init__(self) -> None:
        self.is_begun = False
        self.works = threading.Event()
        self.go_on = threading.Event()

    def begin(self) -> None:
        self.is_begun = True

    def work(self) -> None:
        self.works.set()
        assert self.go_on.wait(PATIENCE)


@pytest.fixture
def caught() -> Iterator[list[int]]:
    """Return a list of the signals that reached the handlers installed before those of the hook."""
    found: list[int] = []
    before = [
        (each, signal.signal(each, lambda number, frame: found.append(number)))
        for each in (signal.SIGINT, signal.SIGTERM)
    ]
    yield found
    for number, handler in before:
        signal.signal(number, handler)


@BOTH
def test_a_second_signal_is_delayed_until_all_stops_have_ended(caught: list[int], number: int) -> None:
    hook, acts = ExitHook(), [Act(), Act()]
    for act in acts:
        hook.add(act.begin, act.work)
    signal.raise_signal(number)
    assert all(act.is_begun for act in acts)  # immediately
    for act in acts:
        assert act.works.wait(PATIENCE)  # both actions run in parallel
    signal.raise_signal(number)
    acts[0].go_on.set()
    assert caught == []
    acts[1].go_on.set()
    until(lambda: caught)
    assert caught == [number]
    assert signal.getsignal(number) != hook._on_signal


@BOTH
def test_a_signal_while_a_bus_closes_starts_the_stops_of_other_buses(caught: list[int], number: int) -> None:
    hook, acts = ExitHook(), [Act(), Act()]
    made = [hook.add(act.begin, act.work) for act in acts]
    timer = threading.Thread(target=lambda: (acts[0].works.wait(PATIENCE), signal.raise_signal(number)))
    timer.start()
    release = threading.Thread(target=lambda: (acts[1].works.wait(PATIENCE), acts[0].go_on.set()))
    release.start()
    hook.finish(made[0])  # the signal arrives during this call
    assert caught == []
    acts[1].go_on.set()
    until(lambda: caught)
    assert caught == [number]
    timer.join()
    release.join()


def test_a_bus_opened_after_the_signal_is_stopped_immediately(caught: list[int]) -> None:
    """Otherwise the new bus's motors would turn while the process waits for the other stops."""
    hook, acts = ExitHook(), [Act(), Act()]
    hook.add(acts[0].begin, acts[0].work)
    signal.raise_signal(signal.SIGTERM)
    hook.add(acts[1].begin, acts[1].work)
    assert acts[1].works.wait(PATIENCE)
    for act in acts:
        act.go_on.set()
    until(lambda: caught)


def test_a_third_signal_within_a_second_ends_the_wait_for_stops(
    caught: list[int], capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 1000.0
    monkeypatch.setattr("multidrop.control.exit_hook.time.monotonic", lambda: now)
    hook, act, others = ExitHook(), Act(), exit_threads()
    made = hook.add(act.begin, act.work)
    for _ in range(5):  # signals that are 0.7 s apart never end the wait
        signal.raise_signal(signal.SIGINT)
        now += 0.7
    assert caught == []
    now += 5
    for count in (0, 0, 1):
        signal.raise_signal(signal.SIGINT)
        now += 0.1
        assert len(caught) == count
    assert capfd.readouterr().err == f"multidrop: {CUT_SHORT}\n"
    hook.finish(made)  # returns although the action has not ended
    act.go_on.set()
    until(lambda: exit_threads() <= others)
    assert len(caught) == 1


def test_a_third_signal_ends_the_wait_although_standard_error_fails(
    caught: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Standard error may be closed, or its terminal may be gone."""

    def write(fd: int, data: bytes) -> int:
        raise OSError(errno.EIO, "Input/output error")

    hook, act, others = ExitHook(), Act(), exit_threads()
    made = hook.add(act.begin, act.work)
    monkeypatch.setattr("multidrop.control.exit_hook.os.write", write)
    for _ in range(3):
        signal.raise_signal(signal.SIGINT)
    assert caught == [signal.SIGINT]
    hook.finish(made)
    act.go_on.set()
    until(lambda: exit_threads() <= others)


def test_a_repeated_sighup_does_not_end_the_wait_for_stops(caught: list[int]) -> None:
    """The kernel and the shell may each send SIGHUP when a terminal closes."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    try:
        hook, act = ExitHook(), Act()
        made = hook.add(act.begin, act.work)
        # the program's own handler
        hook._before[signal.SIGHUP] = lambda number, frame: caught.append(number)
        for _ in range(4):
            signal.raise_signal(signal.SIGHUP)
        assert act.is_begun
        assert caught == []
        act.go_on.set()
        hook.finish(made)
        until(lambda: caught == [signal.SIGHUP])
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("has", [signal.SIG_IGN, lambda number, frame: None], ids=["nohup", "its own"])
def test_the_sighup_setting_of_the_program_is_not_replaced(caught: list[int], has: Any) -> None:
    before = signal.signal(signal.SIGHUP, has)
    try:
        hook = ExitHook()
        hook.take_signals()
        assert signal.getsignal(signal.SIGHUP) == has
        hook.finish(hook.add(lambda: None, lambda: None))
        assert signal.getsignal(signal.SIGHUP) == has
    finally:
        signal.signal(signal.SIGHUP, before)


def exit_threads() -> set[threading.Thread]:
    """Return the threads of all hooks that are running their actions."""
    return {thread for thread in threading.enumerate() if thread.name == "multidrop exit"}


def test_a_failing_exit_task_is_logged(caught: list[int], caplog: pytest.LogCaptureFixture) -> None:
    def fail() -> None:
        raise ZeroDivisionError

    hook = ExitHook()
    act = hook.add(lambda: None, fail)
    hook.finish(act)
    assert "the drives could not be stopped" in caplog.text


def test_an_exit_task_can_be_finished_on_another_thread(caught: list[int]) -> None:
    hook, act = ExitHook(), Act()
    made = hook.add(act.begin, act.work)
    act.go_on.set()
    thread = threading.Thread(target=hook.finish, args=[made])
    thread.start()
    thread.join(PATIENCE)
    assert made.is_over
    signal.raise_signal(signal.SIGTERM)
    assert caught == [signal.SIGTERM]


def test_sigterm_stops_a_bus_that_was_opened_while_another_bus_closed(
    caught: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise SIGTERM would end the process and leave the new bus's motors running."""
    hook, acts = ExitHook(), [Act(), Act()]
    first, let_go = hook.add(acts[0].begin, acts[0].work), hook._let_go

    def come_meanwhile() -> None:
        monkeypatch.setattr(hook, "_let_go", let_go)
        thread = threading.Thread(target=hook.add, args=[acts[1].begin, acts[1].work])
        thread.start()
        thread.join(PATIENCE)
        let_go()

    monkeypatch.setattr(hook, "_let_go", come_meanwhile)
    acts[0].go_on.set()
    hook.finish(first)
    signal.raise_signal(signal.SIGTERM)
    assert acts[1].is_begun
    acts[1].go_on.set()
    until(lambda: caught == [signal.SIGTERM])


def test_an_exit_task_is_refused_if_no_signal_handler_can_be_installed(
    caught: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    hook, acts = ExitHook(), [Act(), Act()]
    first = hook.add(acts[0].begin, acts[0].work)
    has_taken, goes_on, told = threading.Event(), threading.Event(), list[ValueError]()

    def make(*details: Any) -> ExitTask:
        has_taken.set()
        assert goes_on.wait(PATIENCE)
        return ExitTask(*details)

    def add() -> None:
        try:
            hook.add(acts[1].begin, acts[1].work)
        except ValueError as mistake:
            told.append(mistake)

    monkeypatch.setattr("multidrop.control.exit_hook.ExitTask", make)
    thread = threading.Thread(target=add)
    thread.start()
    assert has_taken.wait(PATIENCE)
    acts[0].go_on.set()
    hook.finish(first)
    goes_on.set()
    thread.join(PATIENCE)
    (mistake,) = told
    assert str(mistake).startswith("stop_on_exit must be set on the main thread")
    hook._at_exit()
    assert not acts[1].is_begun


def test_the_library_signal_handler_calls_the_previous_handler_after_close(caught: list[int]) -> None:
    """Another program part replaces our handler, and installs it again after the bus was closed."""
    hook = ExitHook()
    for comes_again in (False, True):
        made = hook.add(lambda: None, lambda: None)
        ours = signal.signal(signal.SIGTERM, signal.SIG_IGN)
        hook.finish(made)
        assert signal.getsignal(signal.SIGTERM) == signal.SIG_IGN
        signal.signal(signal.SIGTERM, ours)
        if comes_again:
            hook.finish(hook.add(lambda: None, lambda: None))
        signal.raise_signal(signal.SIGTERM)
        assert caught == [signal.SIGTERM]
        caught.clear()


@pytest.mark.parametrize("is_over", [True, False], ids=["the first bus is closed", "the first bus is open"])
def test_a_new_bus_stops_motors_before_the_programs_handler_runs(caught: list[int], is_over: bool) -> None:
    """The first bus is still open, or was closed on a thread, which cannot restore signal handlers."""
    hook, acts, handled = ExitHook(), [Act(), Act()], list[int]()
    first = hook.add(acts[0].begin, acts[0].work)
    acts[0].go_on.set()
    if is_over:
        thread = threading.Thread(target=hook.finish, args=[first])
        thread.start()
        thread.join(PATIENCE)
    signal.signal(signal.SIGTERM, lambda number, frame: handled.append(number))
    hook.add(acts[1].begin, acts[1].work)
    signal.raise_signal(signal.SIGTERM)
    assert acts[1].is_begun
    assert handled == []
    acts[1].go_on.set()
    until(lambda: handled)
    assert (handled, caught) == ([signal.SIGTERM], [])


@pytest.mark.parametrize("effect", ["called", "default", "ignored"])
def test_a_signal_handler_of_the_program_may_call_the_library_handler(caught: list[int], effect: str) -> None:
    """The program has replaced our handler. After the stops, the handler before ours is called once."""
    hook, act, handled = ExitHook(), Act(), list[int]()
    if effect != "called":
        signal.signal(signal.SIGTERM, signal.SIG_DFL if effect == "default" else signal.SIG_IGN)
    hook.add(act.begin, act.work)
    ours: Any = signal.getsignal(signal.SIGTERM)

    def handle(number: int, frame: Any) -> None:
        handled.append(number)
        ours(number, frame)

    signal.signal(signal.SIGTERM, handle)
    signal.raise_signal(signal.SIGTERM)
    assert act.is_begun
    act.go_on.set()
    until(lambda: len(handled) == 2)  # `handle` runs when the signal arrives, and after the stops
    assert caught == ([signal.SIGTERM] if effect == "called" else [])


def test_a_replaced_signal_handler_may_still_call_the_library_handler(caught: list[int]) -> None:
    hook, handled = ExitHook(), list[int]()
    hook.add(lambda: None, lambda: None)
    ours: Any = signal.getsignal(signal.SIGTERM)

    def handle(number: int, frame: Any) -> None:
        handled.append(number)
        ours(number, frame)

    signal.signal(signal.SIGTERM, handle)
    last = hook.add(lambda: None, lambda: None)  # installs the library's handler again
    signal.raise_signal(signal.SIGTERM)
    until(lambda: handled)
    assert last.is_over
    assert handled == [signal.SIGTERM]


def test_a_bus_made_on_a_thread_warns_if_the_program_replaced_a_signal_handler(
    caught: list[int], caplog: pytest.LogCaptureFixture
) -> None:
    hook, handled = ExitHook(), list[int]()
    hook.add(lambda: None, lambda: None)
    signal.signal(signal.SIGTERM, lambda number, frame: handled.append(number))
    acts = list[ExitTask]()
    thread = threading.Thread(target=lambda: acts.append(hook.add(lambda: None, lambda: None)))
    thread.start()
    thread.join(PATIENCE)
    assert (
        caplog.text.count(
            "SIGTERM will not stop the drives, because the program has set its own signal handler"
        )
        == 1
    )
    assert "SIGINT" not in caplog.text
    signal.raise_signal(signal.SIGTERM)
    assert handled == [signal.SIGTERM]
    assert not acts[0].is_over
    hook._at_exit()
    assert acts[0].is_over


def test_a_forked_child_has_its_own_exit_tasks(caught: list[int]) -> None:
    hook, acts = ExitHook(), [Act(), Act()]
    hook.add(acts[0].begin, acts[0].work)
    signal.raise_signal(signal.SIGTERM)
    hook.forked()
    made = hook.add(acts[1].begin, acts[1].work)
    assert not acts[1].is_begun
    for act in acts:
        act.go_on.set()
    hook.finish(made)


def test_a_delayed_signal_is_forwarded_only_once(caught: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    """Two actions may end before the main thread handles the forwarded signal."""
    sent: list[int] = []
    hook, act = ExitHook(), Act()
    monkeypatch.setattr("multidrop.control.exit_hook._send", lambda number, ident: sent.append(number))
    hook.add(act.begin, act.work)
    for count in (1, 2):  # the second signal is delayed and forwarded too
        signal.raise_signal(signal.SIGTERM)
        act.go_on.set()
        until(lambda count=count: len(sent) == count)
        hook._one_is_over()
        assert len(sent) == count
        signal.raise_signal(sent[-1])
        assert len(caught) == count
        act = Act()
        hook.add(act.begin, act.work)
    signal.raise_signal(signal.SIGTERM)
    act.go_on.set()
    until(lambda: len(sent) == 3)
    signal.raise_signal(sent[-1])


def test_a_signal_prints_the_names_of_the_drives_being_stopped(
    caught: list[int], capfd: pytest.CaptureFixture[str]
) -> None:
    hook, acts = ExitHook(), [Act(), Act()]
    names = [["pump"], [f"fan-{number}" for number in range(25)]]
    for act, drives in zip(acts, names, strict=True):
        hook.add(act.begin, act.work, lambda drives=drives: drives)
    signal.raise_signal(signal.SIGINT)
    signal.raise_signal(signal.SIGINT)
    (told,) = capfd.readouterr().err.splitlines()
    assert told.startswith("multidrop: SIGINT received: stopping pump, fan-0, fan-1, ")
    assert told.endswith("fan-18 and 6 more; press Ctrl-C three times within a second to give up")
    for act in acts:
        act.go_on.set()
    until(lambda: caught)


CLIENT = """
import sys, time
from contextlib import ExitStack
from multidrop import Bus, InvtCHE
with ExitStack() as stack:
    buses = [stack.enter_context(Bus(port)) for port in sys.argv[2:]]
    for bus in buses:
        for address in (1, 2, 3, 4):
            pump = bus.attach(InvtCHE(address, maximum_frequency=50))
            pump.set_frequency(20)
            pump.start()
        bus.stop_on_exit()
    print("running", flush=True)
    while sys.argv[1] == "wait":
        time.sleep(600)
    while sys.argv[1] == "steer":
        for hz in (15, 20):
            pump.set_frequency(hz)
    while sys.argv[1] == "read":
        pump.read(pump.output_current)
"""


@contextmanager
def lines(count: int) -> Iterator[tuple[list[list[ReceivedRequests]], list[str]]]:
    """Yield the received requests of four drives for each line, and the lines' ports."""
    received: list[list[ReceivedRequests]] = []
    for _ in range(count):
        sims = [simulated(InvtCHE(address, maximum_frequency=50)) for address in (1, 2, 3, 4)]
        for sim in sims:
            assert isinstance(sim, MotorDrive)
            sim.motor.acceleration_time, sim.motor.deceleration_time = 0.2, 3.0
        received.append([ReceivedRequests(sim) for sim in sims if isinstance(sim, MotorDrive)])
    with Simulator([Wire([each.sim for each in one], unpaced=True) for one in received]) as simulator:
        yield received, [wire.path for wire in simulator.wires]


@contextmanager
def client(how: str, ports: list[str]) -> Iterator[subprocess.Popen[str]]:
    words = [sys.executable, "-c", CLIENT, how, *ports]
    with BoundProcess(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, stdin=subprocess.DEVNULL, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "running\n"
        yield process


def stops(received: list[ReceivedRequests]) -> int:
    broadcast = max(sum(request.address == 0 for request in one.requests) for one in received)
    return broadcast + sum(
        write.data[-1] == 5 for one in received for write in one.writes if write.start == 0x1000
    )


@pytest.mark.long
def test_a_third_signal_ends_the_process_though_a_drive_is_silent() -> None:
    with lines(1) as (received, ports), client("wait", ports) as process:
        for each in received[0]:
            each.loses = lambda request: True
        process.send_signal(signal.SIGINT)
        until(lambda: stops(received[0]))
        # The system may merge signals that arrive together, so more than three are sent.
        for _ in range(20):
            process.send_signal(signal.SIGINT)
            try:
                process.wait(0.1)
                break
            except subprocess.TimeoutExpired:
                pass
        _, told = process.communicate(timeout=PATIENCE)
        assert process.returncode == -signal.SIGINT
        assert CUT_SHORT in told


@pytest.mark.slow
@pytest.mark.parametrize("how", ["wait", "steer", "read"])
def test_ctrl_c_is_raised_in_the_users_code_after_the_motors_have_stopped(how: str) -> None:
    """The traceback has no lines of this package, whatever the program was doing."""
    with lines(1) as (received, ports), client(how, ports) as process:
        process.send_signal(signal.SIGINT)
        _, told = process.communicate(timeout=PATIENCE)
        assert process.returncode == -signal.SIGINT
        assert not any(each.sim.motor.energised for each in received[0])
    first, *_, last = told.splitlines()
    assert first.startswith("multidrop: SIGINT received: stopping invt-che@1, invt-che@2, ")
    assert last == "KeyboardInterrupt"
    files = [text for text in told.splitlines() if text.startswith("  File ")]
    assert files
    assert {text.partition(",")[0] for text in files} == {'  File "<string>"'}


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("number", usually(signal.SIGTERM, signal.SIGINT))
def test_a_second_signal_leaves_no_motor_running(number: int) -> None:
    """The second signal may arrive when only the first drive has been sent a stop."""
    with lines(1) as (received, ports), client("wait", ports) as process:
        process.send_signal(number)
        until(lambda: stops(received[0]))
        process.send_signal(number)
        process.communicate()
        assert process.returncode == -number
        assert not any(each.sim.motor.energised for each in received[0])


@pytest.mark.long
@pytest.mark.slow
def test_all_motors_stop_if_sigterm_arrives_as_the_with_block_ends() -> None:
    with lines(1) as (received, ports), client("leave", ports) as process:
        until(lambda: stops(received[0]))
        process.send_signal(signal.SIGTERM)
        process.communicate()
        assert process.returncode == -signal.SIGTERM
        assert not any(each.sim.motor.energised for each in received[0])


@pytest.mark.long
def test_motors_of_two_buses_are_stopped_in_parallel() -> None:
    with lines(2) as (received, ports), client("wait", ports) as process:
        turning_at_last_stop: list[bool] = []
        for one, others in (received, received[::-1]):
            for each in one:
                each.loses = seen(each, others, turning_at_last_stop)
        process.send_signal(signal.SIGTERM)
        process.communicate()
        assert process.returncode == -signal.SIGTERM
        assert all(stops(one) for one in received)
        assert turning_at_last_stop
        assert all(turning_at_last_stop)
        assert not any(each.sim.motor.energised for one in received for each in one)


def seen(drive: ReceivedRequests, others: list[ReceivedRequests], found: list[bool]) -> Callable[[Any], bool]:
    """When this drive is stopped, append to `found` whether all other motors are still ramping down."""

    def loses(request: Any) -> bool:
        if request.start == 0x1000 and request.data[-1:] == b"\5" and drive.sim.motor.frequency > 0:
            found.append(all(other.sim.motor.frequency > 0 for other in others))
        return False

    return loses


@pytest.mark.slow
def test_a_poller_stops_the_drives_of_all_its_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    with lines(2) as (received, ports):
        drives = [InvtCHE(1, maximum_frequency=50, name=f"pump-{number}") for number in (1, 2)]
        declared = [
            line(port, polled(drive, [drive.output_frequency]), name=f"line-{number}")
            for number, (port, drive) in enumerate(zip(ports, drives, strict=True))
        ]
        with ExitStack() as stack:
            poller = stack.enter_context(Poller(plant(*declared)))
            for drive in drives:
                drive.set_frequency(20)
                drive.start()
            poller.stop_on_exit()
        assert not any(each.sim.motor.energised for one in received for each in one)


@pytest.mark.parametrize("leaves", ["poller", "line"])
def test_signal_handlers_are_restored_when_a_poller_or_line_closes(caught: list[int], leaves: str) -> None:
    drive = InvtCHE(1, maximum_frequency=50, name="pump")
    before = signal.getsignal(signal.SIGTERM)
    with lines(1) as (received, (port,)):
        with Poller(plant(line(port, polled(drive, [drive.output_frequency])))) as poller:
            poller.bus("line").stop_on_exit()
            assert signal.getsignal(signal.SIGTERM) != before
            if leaves == "line":
                poller.remove_line("line")
        assert stops(received[0])
    assert signal.getsignal(signal.SIGTERM) == before


@pytest.mark.long
def test_a_programs_own_sigterm_handler_runs_after_the_stops(caught: list[int]) -> None:
    """The program's own SIGTERM handler, installed between two pollers, runs once the motor has stopped."""
    drive = InvtCHE(1, maximum_frequency=50, name="pump")
    energised: list[bool] = []
    with lines(2) as (received, ports):
        motor = received[1][0].sim.motor
        with Poller(plant(line(ports[0], polled(drive, [drive.output_frequency])))) as poller:
            poller.bus("line").stop_on_exit()
        signal.signal(signal.SIGTERM, lambda number, frame: energised.append(motor.energised))
        with Bus(ports[1]) as bus:
            pump = bus.attach(InvtCHE(1, maximum_frequency=50))
            bus.stop_on_exit()
            pump.set_frequency(20)
            pump.start()
            signal.raise_signal(signal.SIGTERM)
            until(lambda: energised)
        assert energised == [False]
        assert stops(received[1])
