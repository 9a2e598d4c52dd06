"""A poller whose lines other processes may take over: its requests and rows during these changes."""

from __future__ import annotations

import os
import select
import socket
import sys
import threading
import time
import tty
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import pytest
from lines import HOST_LATE, PATIENCE, line, plant, polled, rows_of, until
from serial.urlhandler import protocol_socket
from tables import table, usually
from toy import QuickToy, Toy

from multidrop import Bus, NotMaster
from multidrop.core import Mastership, RowQueue
from multidrop.errors import NoSuchPort
from multidrop.plant.model import PlantLine, PolledDrive
from multidrop.poller import Poller
from multidrop.polling import line_set
from multidrop.polling.batch import Row
from multidrop.polling.polled_line import PolledLine
from multidrop.sim import SimulatedDrive, Simulator, Wire, simulated
from multidrop.transport import clock

if sys.platform != "linux":
    pytest.skip("masterships are Linux's", allow_module_level=True)

S = 1_000_000_000
CURRENT, STATUS = Toy.registers["output_current"], Toy.registers["status"]
LONGEST = 256 * 10 / 9600  # s, duration of the longest RTU frame at 9600 baud
NOT_MASTER, OTHER_MASTER = "not sent: not master", "not sent: another master"
paces = pytest.mark.parametrize("every", usually(0.02, None), ids=["on a grid", "as fast as it goes"])


class Slow(Toy):
    """A drive with a timeout longer than any delay of the other master, even on a busy computer."""

    response_timeout = 1.5


def now_ns() -> int:
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


def quick(name: str, address: int, every: float | None) -> PolledDrive:
    return polled(QuickToy(address, name=name), [CURRENT, STATUS], every)


@pytest.fixture
def mastership() -> Iterator[Mastership]:
    made = Mastership()
    yield made
    made.end()


def hold(mastership: Mastership) -> None:
    mastership.extend(now_ns() + 1000 * S)


@contextmanager
def lines(every: float | None, port: str = "pty") -> Iterator[tuple[list[SimulatedDrive], list[PlantLine]]]:
    """Yield two simulated drives, each on its own line, and the declarations of the lines."""
    drives = [simulated(QuickToy(1)) for _ in range(2)]
    with Simulator([Wire([drive], unpaced=True, port=port) for drive in drives]) as simulator:
        paths = [wire.path for wire in simulator.wires]
        names = ("hall", "pump"), ("yard", "fan")
        declared = [
            line(path, quick(drive, 1, every), name=name)
            for path, (name, drive) in zip(paths, names, strict=True)
        ]
        yield drives, declared


class Rows:
    """Takes a poller's rows, and waits for rows with given statuses."""

    def __init__(self, poller: Poller) -> None:
        self._poller = poller

    def statuses(self, drive: str) -> set[str]:
        return {row.status for row in rows_of(self._poller) if row.drive == drive}

    def until(self, drive: str, status: str) -> None:
        until(lambda: status in self.statuses(drive))

    def settle_unpolled(self, drive: str) -> None:
        """Wait until several values of this drive are missing. Then its earlier requests have ended."""
        for _ in range(3):
            rows_of(self._poller)
            self.until(drive, NOT_MASTER)

    def settle(self, *drives: str) -> None:
        """Take the rows of earlier requests, and wait until each drive has a new value."""
        for drive in drives:
            self.until(drive, "ok")


@pytest.mark.slow
@paces
def test_a_line_is_polled_only_by_the_master_process(mastership: Mastership, every: float | None) -> None:
    with lines(every) as (sims, made), Poller(plant(*made), mastership=mastership) as poller:
        rows = Rows(poller)
        rows.until("pump", NOT_MASTER)
        assert [sim.counters.requests for sim in sims] == [0, 0]
        hold(mastership)
        rows.settle("pump", "fan")
        mastership.end()
        rows.settle_unpolled("pump")  # returns once the drives have received all earlier requests
        asked = [sim.counters.requests for sim in sims]
        rows_of(poller)
        rows.until("fan", NOT_MASTER)
        assert "ok" not in rows.statuses("pump")
        with pytest.raises(NotMaster):
            poller.bus("hall").drives[0].read(CURRENT)
        assert [sim.counters.requests for sim in sims] == asked
        hold(mastership)
        rows.settle("pump", "fan")
        summary = poller.summary()["lines"]["hall"]
        assert summary["misses"][NOT_MASTER] > 0
        assert summary["foreign_bytes"] == 0


@pytest.mark.slow
@paces
def test_a_process_without_mastership_gets_few_rows(mastership: Mastership, every: float | None) -> None:
    """The poller must not run a busy loop while it is not the master."""
    with lines(every) as (_, made), Poller(plant(*made), mastership=mastership) as poller:
        Rows(poller).until("pump", NOT_MASTER)
        begun = time.monotonic()
        found = 0
        while time.monotonic() < begun + 1.5:
            found += sum(row.drive == "pump" for row in rows_of(poller))
            time.sleep(0.05)
        most = (time.monotonic() - begun + 1) * 2 * (2 if every is None else 1 / every)
        assert 0 < found <= most


def test_the_summary_has_no_foreign_bytes_without_a_mastership() -> None:
    with lines(None) as (_, made), Poller(plant(*made)) as poller:
        Rows(poller).settle("pump")
        assert "foreign_bytes" not in poller.summary()["lines"]["hall"]


@contextmanager
def seen_line(mastership: Mastership, every: float | None) -> Iterator[tuple[int, Poller]]:
    """Yield the far end of a polled line on which no drive answers, and the line's poller."""
    far, near = os.openpty()
    tty.setraw(near)
    os.set_blocking(far, False)
    try:
        declared = line(os.ttyname(near), polled(Slow(1, name="pump"), [CURRENT, STATUS], every))
        with Poller(plant(declared), mastership=mastership) as poller:
            yield far, poller
    finally:
        os.close(far)
        os.close(near)


def wait_for_bytes(far: int) -> bytes:
    assert select.select([far], [], [], PATIENCE)[0]
    return os.read(far, 4096)


@pytest.mark.slow
@paces
def test_a_new_master_listens_before_its_first_poll(mastership: Mastership, every: float | None) -> None:
    hold(mastership)
    begun = time.monotonic()
    with seen_line(mastership, every) as (far, _):
        wait_for_bytes(far)
        assert time.monotonic() - begun >= LONGEST + Slow.response_timeout


@pytest.mark.slow
@pytest.mark.parametrize("port", ["pty", "tcp://127.0.0.1:0"])
def test_nothing_is_sent_during_the_guard_time_of_the_previous_master(port: str) -> None:
    """Here the guard time is longer than the time for which a new master listens."""
    mastership = Mastership(guard_s=1.0)
    try:
        hold(mastership)
        with lines(None, port) as (_, (hall, _)):
            begun = time.monotonic_ns()
            with Poller(plant(hall), mastership=mastership) as poller:
                rows: list[Row] = []
                until(lambda: rows.extend(rows_of(poller)) or any(row.status == "ok" for row in rows))
                assert min(row.monotonic_ns for row in rows if row.status == "ok") - begun >= S
                assert poller.summary()["lines"]["hall"]["foreign_bytes"] == 0
    finally:
        mastership.end()


@pytest.mark.long
@paces
def test_polling_starts_when_another_master_falls_silent(mastership: Mastership, every: float | None) -> None:
    hold(mastership)
    is_over = threading.Event()
    with seen_line(mastership, every) as (far, poller):

        def ask() -> None:
            while not is_over.wait(0.02):
                os.write(far, b"\x07\x03\x00\x01\x00\x01\xd5\xac")

        other = threading.Thread(target=ask)
        other.start()
        try:
            Rows(poller).until("pump", OTHER_MASTER)
            with suppress(BlockingIOError):
                assert os.read(far, 4096) == b""
            until(lambda: poller.summary()["lines"]["line"]["foreign_bytes"] > 0)
            assert poller.summary()["lines"]["line"]["misses"][OTHER_MASTER] > 0
        finally:
            is_over.set()
            other.join()
        silent = time.monotonic()
        wait_for_bytes(far)
        assert time.monotonic() - silent >= LONGEST


class Listener:
    """A far end that never answers, and keeps the received bytes of each connection."""

    def __init__(self) -> None:
        self._server = socket.create_server(("127.0.0.1", 0))
        self.url = f"socket://127.0.0.1:{self._server.getsockname()[1]}"
        self.received: list[bytes] = []
        self.ends: list[str] = []
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        with suppress(OSError):
            while True:
                connection, _ = self._server.accept()
                self.received.append(b"")
                self._take(connection)

    def _take(self, connection: socket.socket) -> None:
        with connection:
            try:
                while chunk := connection.recv(4096):
                    self.received[-1] += chunk
                self.ends.append("closed")
            except ConnectionResetError:
                self.ends.append("reset")

    def close(self) -> None:
        self._server.shutdown(socket.SHUT_RDWR)
        self._server.close()


@pytest.fixture
def far() -> Iterator[Listener]:
    made = Listener()
    yield made
    made.close()


@pytest.mark.long
def test_a_removed_lines_port_is_closed_and_receives_no_bytes(mastership: Mastership, far: Listener) -> None:
    hold(mastership)
    yard = line(far.url, quick("fan", 1, None), name="yard")
    with lines(0.02) as (_, (hall, _)), Poller(plant(hall), mastership=mastership) as poller:
        Rows(poller).settle("pump")
        for n in (1, 2):
            poller.add_line(yard)
            until(lambda n=n: len(far.received) == n and far.received[-1])
            poller.remove_line("yard")
            until(lambda n=n: len(far.ends) == n)
            asked = list(far.received)
            Rows(poller).settle("pump")
            assert far.received == asked
        assert list(poller.buses) == ["hall"]


@pytest.mark.slow
def test_no_port_is_opened_before_the_process_is_master(mastership: Mastership, far: Listener) -> None:
    """The port is neither opened nor reopened, because this could end the present master's connection."""
    yard = line(far.url, quick("fan", 1, None), name="yard")
    with lines(0.02) as (_, (hall, _)), Poller(plant(hall, yard), mastership=mastership) as poller:
        Rows(poller).until("fan", NOT_MASTER)
        assert far.received == []
        hold(mastership)
        until(lambda: far.received and far.received[-1])
        mastership.end()
        Rows(poller).until("fan", NOT_MASTER)
        poller.bus("yard").line.drop()
        Rows(poller).settle_unpolled("fan")
        assert len(far.received) == 1
        hold(mastership)
        until(lambda: any(far.received[1:]))  # on a busy computer, the port may be opened more than once


def taken_of(poller: Poller, rows: list[Row]) -> list[Row]:
    """Append the pump's new rows of the register `status` to `rows`; return `rows`."""
    rows += [row for row in rows_of(poller) if (row.drive, row.register) == ("pump", "status")]
    return rows


@pytest.mark.long
def test_an_added_or_removed_line_does_not_interrupt_others(mastership: Mastership, far: Listener) -> None:
    hold(mastership)
    yard = line(far.url, quick("fan", 1, None), name="yard")
    with lines(0.02) as (_, (hall, _)), Poller(plant(hall), mastership=mastership) as poller:
        Rows(poller).settle("pump")
        rows_of(poller)
        rows: list[Row] = []
        for n in range(1, 6):
            poller.add_line(yard)
            poller.remove_line("yard")
            until(lambda n=n: len(taken_of(poller, rows)) >= 10 * n)
        assert {row.status for row in rows} <= {"ok", *HOST_LATE}
        due = [row.monotonic_ns for row in rows]
        assert max(later - at for at, later in pairwise(due)) < S  # far more than the period, 0.02 s


@pytest.mark.slow
def test_a_pyserial_port_is_refused_with_a_mastership(mastership: Mastership) -> None:
    hold(mastership)
    bridged = line("rfc2217://127.0.0.1:1", quick("fan", 1, None), name="yard")
    with pytest.raises(NoSuchPort, match="a port of this kind cannot be used with a mastership"):
        Poller(plant(bridged), mastership=mastership)
    with lines(None) as (_, (hall, _)), Poller(plant(hall), mastership=mastership) as poller:
        with pytest.raises(NoSuchPort):
            poller.add_line(bridged)
        with pytest.raises(NoSuchPort):
            poller.adopt(plant(bridged))
        assert list(poller.buses) == ["hall"]
        Rows(poller).settle("pump")


@pytest.mark.long
def test_the_first_request_after_a_new_mastership_waits_the_guard_time(mastership: Mastership) -> None:
    hold(mastership)
    wire = Wire([simulated(QuickToy(1))], unpaced=True)
    with Simulator([wire]), Bus(wire.path, mastership=mastership) as bus:
        pump = bus.attach(QuickToy(1))
        pump.read(CURRENT)
        mastership.end()
        hold(mastership)
        begun = time.monotonic()
        pump.read(CURRENT)
        assert time.monotonic() - begun >= mastership.guard_s


@pytest.mark.slow
def test_network_ports_open_and_close_without_sleeping(
    mastership: Mastership, monkeypatch: pytest.MonkeyPatch
) -> None:
    """pyserial's own sockets sleep for 0.3 s when they are closed, which would take 19 s for 64 sockets."""
    pauses_s: list[float] = []
    monkeypatch.setattr(protocol_socket, "time", SimpleNamespace(sleep=pauses_s.append))
    hold(mastership)
    sims = [simulated(QuickToy(1)) for _ in range(64)]
    wires = [Wire([sim], unpaced=True, port="socket://127.0.0.1:0") for sim in sims]
    with Simulator(wires) as simulator:
        declared = [
            line(wire.path, quick(f"pump-{n}", 1, 1.0), name=f"line-{n}")
            for n, wire in enumerate(simulator.wires)
        ]
        with Poller(plant(*declared), mastership=mastership) as poller:
            assert len(poller.buses) == 64
            until(lambda: all(sim.counters.requests for sim in sims))
    assert pauses_s == []


def test_the_removal_of_a_line_does_not_wait_for_another_lines_request(
    mastership: Mastership, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A gateway that loses its lease has only half a second to close all of its lines."""
    end, asked, is_answered = PolledLine.end, threading.Event(), threading.Event()

    def waited_for(ending: PolledLine) -> bool:
        if ending.name == "yard":
            asked.set()
        return end(ending) or (ending.name == "yard" and not is_answered.is_set())

    monkeypatch.setattr(PolledLine, "end", waited_for)
    monkeypatch.setattr(line_set, "ENDING_NS", 1000 * S)
    hold(mastership)
    with lines(0.02) as (_, both), Poller(plant(*both), mastership=mastership) as poller:
        removing = [threading.Thread(target=poller.remove_line, args=[name]) for name in ("yard", "hall")]
        removing[0].start()
        assert asked.wait(PATIENCE)
        try:
            removing[1].start()
            removing[1].join(PATIENCE)
            assert list(poller.buses) == ["yard"]
        finally:
            is_answered.set()
        removing[0].join(PATIENCE)
        assert list(poller.buses) == []


class Busy:
    """A line with a request in flight that is never answered."""

    bus = SimpleNamespace(leave=lambda: None, part=lambda: None)

    def leave(self) -> None:
        pass

    def end(self) -> bool:
        return True


@table(("left_ns", "waited_ns"), [(0, S), (S // 5, S // 5), (-S, 0), (5 * S, S)])
def test_closing_waits_for_a_request_until_the_mastership_ends(
    monkeypatch: pytest.MonkeyPatch, left_ns: int, waited_ns: int
) -> None:
    """The mastership ends after `left_ns`; with 0 the process holds no mastership."""
    now = [1000 * S]
    until_ns = now[0] + left_ns if left_ns else 0
    monkeypatch.setattr(clock, "now_ns", lambda: now[0])
    monkeypatch.setattr(clock, "boottime_ns", lambda: now[0])
    monkeypatch.setattr(clock, "sleep", lambda seconds: now.__setitem__(0, now[0] + round(seconds * S)))
    held: Any = SimpleNamespace(until_ns=until_ns)
    line_set.LineSet(RowQueue(), None, None, held).wind_down([Busy()])  # type: ignore[list-item]
    assert now[0] - 1000 * S == waited_ns
