"""Serial settings on a descriptor; the C core's thread, which drives all ports, and its realtime scheduling.

A pty accepts any baud rate, but always has 8 bits without parity. Only the C core's thread has realtime
scheduling, and only if the user wants it and the system permits it.
"""

from __future__ import annotations

import errno
import os
import socket
import subprocess
import sys
import termios
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from lines import until

from multidrop import Plant, Poller
from multidrop.core import REFUSALS, Port, Realtime, get_settings, set_settings, wake_lateness
from multidrop.core import port as port_module
from multidrop.core.port import NICE
from multidrop.polling.row_source import ASYNC_LOOK_S, BATCHES_S, PROMPT_S

SHOWS_SCHEDULING = pytest.mark.skipif(
    sys.platform != "linux", reason="other systems show no thread's scheduling"
)


@pytest.fixture
def pty() -> Iterator[int]:
    master, slave = os.openpty()
    yield slave
    os.close(slave)
    os.close(master)


def refused(fd: int, baudrate: int, format: str) -> set[str]:
    mask = set_settings(fd, baudrate, format)
    return {name for bit, name in REFUSALS.items() if mask & bit}


@pytest.mark.parametrize("baudrate", [50, 1200, 9600, 38400, 115200, 12345, 250_000, 3_000_000])
def test_a_port_can_be_set_to_any_baud_rate(pty: int, baudrate: int) -> None:
    assert refused(pty, baudrate, "8N1") == set()
    assert get_settings(pty) == (baudrate, "8N1")


@pytest.mark.parametrize(
    ("format", "not_taken", "taken"),
    [
        ("8N1", set(), "8N1"),
        ("8N2", set(), "8N2"),
        ("8E1", {"parity"}, "8N1"),
        ("8O2", {"parity"}, "8N2"),
        ("7N2", {"data bits"}, "8N2"),
        ("7E1", {"data bits", "parity"}, "8N1"),
    ],
)
def test_unsupported_settings_of_a_pseudo_terminal_are_reported(
    pty: int, format: str, not_taken: set[str], taken: str
) -> None:
    assert refused(pty, 9600, format) == not_taken
    assert get_settings(pty) == (9600, taken)


@pytest.mark.parametrize("format", ["8E1", "7E1"])
def test_the_same_settings_can_be_set_repeatedly(pty: int, format: str) -> None:
    """tcsetattr() would fail from the second time on, because no requested change takes effect."""
    name = os.ttyname(pty)
    first = refused(pty, 9600, format)
    for _ in range(20):
        again = os.open(name, os.O_RDWR | os.O_NOCTTY)
        try:
            assert refused(again, 9600, format) == first
        finally:
            os.close(again)


def test_a_port_is_set_to_raw_mode(pty: int) -> None:
    """Raw mode has no echo, no line editing, no flow control and no signals."""
    set_settings(pty, 9600, "8N1")
    iflag, oflag, cflag, lflag, *_ = termios.tcgetattr(pty)
    assert (iflag, oflag, lflag) == (0, 0, 0)
    assert cflag & (termios.CREAD | termios.CLOCAL) == termios.CREAD | termios.CLOCAL
    assert not cflag & termios.CRTSCTS


def test_every_byte_value_passes_unchanged() -> None:
    master, slave = os.openpty()
    try:
        set_settings(slave, 9600, "8N1")
        every = bytes(range(256))
        os.write(slave, every)
        assert os.read(master, 1024) == every
        os.write(master, every)
        assert os.read(slave, 1024) == every
    finally:
        os.close(slave)
        os.close(master)


def test_bytes_with_parity_errors_are_dropped(pty: int) -> None:
    set_settings(pty, 9600, "8E1")
    assert termios.tcgetattr(pty)[0] == termios.INPCK | termios.IGNPAR


def test_a_descriptor_without_settings_raises() -> None:
    reader, writer = os.pipe()
    try:
        with pytest.raises(OSError, match="no serial settings") as failed:
            set_settings(writer, 9600, "8N1")
        assert failed.value.errno == errno.ENOTTY
        with pytest.raises(OSError, match="no serial settings"):
            get_settings(reader)
    finally:
        os.close(reader)
        os.close(writer)
    with pytest.raises(OSError, match="no serial settings") as failed:
        set_settings(writer, 9600, "8N1")
    assert failed.value.errno == errno.EBADF


@pytest.mark.slow
def test_ports_opened_concurrently_share_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """While one port starts the thread, the other ports wait; otherwise there would be several threads."""
    started: list[str] = []
    is_second = threading.Event()

    def start() -> str:
        started.append(f"engine {len(started)}")
        if len(started) > 1:
            is_second.set()
        is_second.wait(0.5)  # time in which a second port would start a thread if it did not wait
        return started[0]

    monkeypatch.setattr(port_module, "lib", SimpleNamespace(md_engine_start=start))
    engine, found = port_module._Engine(), list[str]()
    threads = [threading.Thread(target=lambda: found.append(engine.c)) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert started == ["engine 0"]
    assert found == ["engine 0"] * 4


# ---- realtime scheduling ----


def threads() -> list[int]:
    return [int(task.name) for task in Path("/proc/self/task").iterdir()]


def policies() -> dict[int, int]:
    """Return the scheduling policy of each of this process's threads."""
    return {thread: os.sched_getscheduler(thread) for thread in threads()}


@pytest.fixture
def realtime() -> Iterator[Realtime]:
    """Yield a client for which the C core's thread has realtime scheduling."""
    client = Realtime()
    try:
        client.want(True)
    except PermissionError:
        pytest.skip("this process may not use realtime scheduling")
    yield client
    client.want(False)


@SHOWS_SCHEDULING
def test_only_the_cores_thread_is_scheduled_in_real_time(realtime: Realtime) -> None:
    found = policies()
    (core,) = (thread for thread, policy in found.items() if policy != os.SCHED_OTHER)
    assert found[core] == os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
    assert os.sched_getparam(core).sched_priority == 1
    assert core != os.getpid()
    show = [sys.executable, "-ISc", "import os; print(os.sched_getscheduler(0))"]
    assert int(subprocess.check_output(show)) == os.SCHED_OTHER

    second = Realtime()
    second.want(True)
    realtime.want(False)
    assert policies()[core] & os.SCHED_FIFO
    second.want(False)
    assert not policies()[core] & os.SCHED_FIFO
    assert not second.has_ended()  # the client switched realtime scheduling off, not the C core


@pytest.fixture
def _usual_nice() -> Iterator[None]:
    """Give the nice value 0 to the test's thread, and so to the threads that it starts."""
    before = os.getpriority(os.PRIO_PROCESS, 0)
    try:
        os.setpriority(os.PRIO_PROCESS, 0, 0)
    except PermissionError:
        pytest.skip("this process may not change its nice value")
    yield
    os.setpriority(os.PRIO_PROCESS, 0, before)


def nice_values() -> dict[int, int]:
    return {thread: os.getpriority(os.PRIO_PROCESS, thread) for thread in threads()}


SHOW_NICE = [sys.executable, "-ISc", "import os; print(os.getpriority(os.PRIO_PROCESS, 0))"]


@SHOWS_SCHEDULING
@pytest.mark.usefixtures("_usual_nice")
def test_only_threads_that_deliver_values_get_higher_priority(realtime: Realtime) -> None:
    """They are the poller's thread, and each thread that has taken values."""
    taker = threading.get_native_id()
    with Poller(Plant(()), realtime=True) as poller:
        poller.take()
        expected = {taker, poller._thread.native_id}
        until(lambda: {thread for thread, nice in nice_values().items() if nice == NICE} == expected)
        assert int(subprocess.check_output(SHOW_NICE)) == 0
    assert nice_values()[taker] == NICE  # another client still wants realtime scheduling
    realtime.want(False)
    assert nice_values()[taker] == 0


@SHOWS_SCHEDULING
@pytest.mark.usefixtures("_usual_nice")
def test_one_warning_explains_how_to_permit_nice_values(
    realtime: Realtime, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(which: int, who: int, nice: int) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(os, "setpriority", refuse)
    with Poller(Plant(()), realtime=True) as poller:
        poller.take()
        until(lambda: "LimitNICE=-10" in caplog.text)
        poller.take()
        poller._call_thread()
    assert caplog.text.count("LimitNICE") == 1


@SHOWS_SCHEDULING
@pytest.mark.usefixtures("_usual_nice")
def test_thread_keeps_a_scheduling_policy_set_by_the_user(realtime: Realtime) -> None:
    own = os.sched_getscheduler(0)
    os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    try:
        realtime.lower_nice()
        assert os.sched_getscheduler(0) == os.SCHED_BATCH
        assert nice_values()[threading.get_native_id()] == 0
    finally:
        os.sched_setscheduler(0, own, os.sched_param(0))


@SHOWS_SCHEDULING
def test_values_are_taken_more_often_with_realtime_scheduling() -> None:
    poller = Poller(Plant(()))
    assert poller._interval_s(BATCHES_S) == BATCHES_S
    poller._realtime.is_held = True
    assert poller._interval_s(BATCHES_S) == poller._interval_s(ASYNC_LOOK_S) == PROMPT_S
    poller.close()


def locked_kb() -> int:
    (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if "VmLck" in line)
    return int(line.split()[1])


@SHOWS_SCHEDULING
def test_the_cores_code_is_locked_in_memory(realtime: Realtime) -> None:
    assert 64 < locked_kb() < 4096  # kB: the C core's library, but not the whole process
    realtime.want(False)
    assert locked_kb() == 0


@SHOWS_SCHEDULING
def test_one_warning_explains_how_to_permit_realtime_scheduling() -> None:
    program = """
import logging, os, resource
from contextlib import suppress
from multidrop import Plant, Poller
from multidrop.core import Realtime, wake_lateness
from multidrop.transport import aside_log
logging.basicConfig(format="%(message)s")
resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
if os.geteuid() == 0:
    os.setresuid(65534, 65534, 65534)
for attempt in (lambda: Realtime().want(True), lambda: wake_lateness(0.01, realtime=True)):
    try:
        attempt()
    except PermissionError:
        print("refused")
with Poller(Plant(()), realtime=True) as poller:
    poller.adopt(poller.plant)
    policies = set()
    for thread in os.listdir("/proc/self/task"):
        with suppress(ProcessLookupError):  # this thread has just ended
            policies.add(os.sched_getscheduler(int(thread)))
    print(policies)
aside_log.flush_log(10)
"""
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert run.stdout.splitlines() == ["refused", "refused", str({os.SCHED_OTHER})], run.stderr
    assert run.stderr == (
        "polling without realtime: the system refuses it (Operation not permitted); permit it with "
        "LimitRTPRIO=1 and RestrictRealtime=no in the systemd unit, or with "
        '"USER - rtprio 1" in /etc/security/limits.conf and a new login\n'
    )


@SHOWS_SCHEDULING
@pytest.mark.long
def test_realtime_scheduling_ends_during_a_flood_of_bytes(
    realtime: Realtime, caplog: pytest.LogCaptureFixture
) -> None:
    """The C core's thread discards bytes that a program sends as fast as the computer can."""
    near, far = socket.socketpair()
    near.setblocking(False)
    flood = [sys.executable, "-c", f"import os\nwhile True: os.write({far.fileno()}, bytes(1000))"]
    with Poller(Plant(()), realtime=True), near, far:
        port = Port(near.fileno(), -1)
        program = subprocess.Popen(flood, pass_fds=[far.fileno()])
        try:
            os.sched_setscheduler(program.pid, os.SCHED_RR, os.sched_param(1))
            until(lambda: "realtime has ended" in caplog.text)
        finally:
            program.kill()
            program.wait()
        assert realtime.has_ended()
        assert not realtime.has_ended()
        assert set(policies().values()) <= {os.SCHED_OTHER, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK}
        del port


@SHOWS_SCHEDULING
@pytest.mark.parametrize("how", ["plant file", "argument"])
def test_realtime_scheduling_is_requested_by_a_plant_file_or_an_argument(
    how: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[bool] = []
    monkeypatch.setattr("multidrop.core.port._Engine.set_realtime", lambda *words: asked.append(words[-1]))
    wanted = Plant((), realtime=how == "plant file")
    with Poller(wanted, realtime=how == "argument") as poller:
        assert asked == [True]
        poller.adopt(poller.plant)
        poller.adopt(Plant(()))
        assert asked == ([True] if how == "argument" else [True, False])
        poller.adopt(wanted)
    assert asked[-2:] == [True, False]


@SHOWS_SCHEDULING
def test_wake_lateness_measures_how_late_the_core_wakes() -> None:
    late = wake_lateness(0.02, realtime=False)
    assert len(late) == 10
    assert all(each >= 0 for each in late)


@SHOWS_SCHEDULING
def test_only_the_first_and_last_client_switch_realtime_scheduling(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thread that has ended realtime by itself must not start it again for a second client."""
    switched: list[bool] = []

    def switch(engine: object, wanted: bool) -> int:
        switched.append(wanted)
        return 0

    monkeypatch.setattr(port_module, "lib", SimpleNamespace(md_engine_realtime=switch))
    engine, clients = port_module._Engine(), [Realtime(), Realtime()]
    engine._c = object()
    for wanted in (True, False):
        for client in clients:
            engine.set_realtime(client, wanted)
    assert switched == [True, False]
