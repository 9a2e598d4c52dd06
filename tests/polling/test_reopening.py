"""Lost ports of polled lines are reopened by the poller and by stops; neither prevents a stop."""

from __future__ import annotations

import socket
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from itertools import count
from pathlib import Path

import pytest
from clocked_lines import ClockedLines, ClockedWire
from lines import PATIENCE, line, plant, polled, rows_of, until
from tables import table, usually
from toy import Status, Toy

from multidrop import poller as poller_module
from multidrop.bus import Bus
from multidrop.core import Framing, Message, build_reply, build_request, parse_request
from multidrop.drive import Drive, Script, insist, read
from multidrop.drive.register import HOLDING, command, reading
from multidrop.drive.verbs import CommandOutcome, verb
from multidrop.errors import LineError, PollingFailed, Unconfirmed
from multidrop.families import InvtCHE
from multidrop.poller import Poller
from multidrop.polling import polled_line
from multidrop.polling.batch import Row
from multidrop.polling.polled_line import MOST_AT_ONCE, PolledLine
from multidrop.sim import Faults, MotorDrive, Simulator, Wire, simulated

START = threading.Thread.start


class Plant:
    """A polled line whose port vanishes and comes back while its motor turns."""

    def __init__(self, path: Path, stack: ExitStack) -> None:
        self.path = path
        self.drive = InvtCHE(1, name="pump", maximum_frequency=50)
        sim = simulated(self.drive)
        assert isinstance(sim, MotorDrive)
        self.sim = sim
        self.stack = stack
        with self.there():
            asked = polled(self.drive, [self.drive.status])
            self.poller = stack.enter_context(Poller(plant(line(str(path), asked, name="hall"))))
            self.drive.set_frequency(20.0)
            self.drive.start()
        self.port = self.poller.bus("hall").line

    def there(self) -> Simulator:
        """Return a simulator of the line; the port exists while the simulator runs."""
        return Simulator([Wire([self.sim], port=str(self.path), unpaced=True)])

    def stop(self) -> None:
        self.drive.stop(seconds=20)
        assert not self.sim.motor.energised


@pytest.fixture
def hall(tmp_path: Path, _turns_awaited: None) -> Iterator[Plant]:
    with ExitStack() as stack:
        yield Plant(tmp_path / "hall", stack)


@pytest.mark.slow
@pytest.mark.parametrize("failure", usually(RuntimeError("can't start new thread"), MemoryError()))
def test_a_stop_reopens_a_lost_port_if_no_thread_can_be_started(
    hall: Plant, monkeypatch: pytest.MonkeyPatch, failure: Exception
) -> None:
    tried = 0

    def start(thread: threading.Thread) -> None:
        nonlocal tried
        if thread.name == "multidrop reopening":
            tried += 1
            raise failure
        START(thread)

    with monkeypatch.context() as without:
        without.setattr(threading.Thread, "start", start)
        until(lambda: tried > 1)
        hall.stack.enter_context(hall.there())
        hall.stop()
    rows_of(hall.poller)
    until(lambda: any(row.status == "ok" for row in rows_of(hall.poller)))


@pytest.mark.slow
@pytest.mark.parametrize("threads", [0, 1])
def test_all_new_lines_are_opened_even_if_few_threads_can_be_started(
    hall: Plant, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, threads: int
) -> None:
    """If `adopt` failed here, running motors would get no stop."""
    left = threads

    def start(thread: threading.Thread) -> None:
        nonlocal left
        if thread.name.startswith("multidrop opening"):
            left -= 1
            if left < 0:
                raise RuntimeError("can't start new thread")
        START(thread)

    names = [f"pump-{number}" for number in range(3)]
    ports = [str(tmp_path / name) for name in names]
    drives = [InvtCHE(1, name=name, maximum_frequency=50) for name in names]
    hall.stack.enter_context(
        Simulator([Wire([simulated(drive)], port=port) for drive, port in zip(drives, ports, strict=True)])
    )
    lines = [
        line(port, polled(drive, [drive.status]), name=drive.name)
        for drive, port in zip(drives, ports, strict=True)
    ]
    monkeypatch.setattr(threading.Thread, "start", start)
    assert hall.poller.adopt(plant(*lines)) == {}
    assert left < 0
    for drive in drives:
        drive.stop()


@pytest.mark.slow
def test_a_stop_of_a_failed_poller_reopens_its_port(hall: Plant, monkeypatch: pytest.MonkeyPatch) -> None:
    until(lambda: hall.port.is_lost)

    def fail(*_: object) -> None:
        raise MemoryError

    monkeypatch.setattr(PolledLine, "tend", fail)
    hall.poller._thread.join()
    with pytest.raises(LineError):
        hall.drive.read(hall.drive.status)
    hall.stack.enter_context(hall.there())
    hall.stop()
    with pytest.raises(PollingFailed):
        hall.poller.close()


@pytest.mark.long
def test_a_stop_reopens_a_port_between_two_attempts_of_the_poller(
    hall: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(polled_line, "REOPEN_NS", 3_600_000_000_000)
    lost = hall.poller._lines.find("hall")
    until(lambda: lost._tried_ns and not lost._reopening.is_under_way)
    hall.stack.enter_context(hall.there())
    hall.stop()


@pytest.mark.long
def test_the_poller_keeps_a_port_that_a_stop_reopened(hall: Plant, monkeypatch: pytest.MonkeyPatch) -> None:
    """The poller may notice the loss of the earlier port just after a stop has reopened the port."""
    until(lambda: hall.port.is_lost)
    hall.stack.enter_context(hall.there())
    until(lambda: not hall.port.is_lost)
    reopened = hall.port.queue
    hall.port.drop_lost()
    assert hall.port.queue is reopened is not None


def good_reply(framing: Framing, request: Message) -> bytes:
    """Return a register's address as its value, or the confirmation of a write."""
    read = Message(1, 3, data=request.start.to_bytes(2), transaction=request.transaction)
    return build_reply(framing, read if request.function == 3 else request)


@contextmanager
def server(
    is_last: Callable[[int, int], bool],
    idle_s: float | None = None,
    closes: list[bytes] | None = None,
    framing: Framing = Framing.TCP,
    reply: Callable[[Framing, Message], bytes] = good_reply,
) -> Iterator[str]:
    """Serve one client at a time.

    The server closes a connection after its nth request if `is_last(nth, address)` is True, or if no request
    comes for `idle_s` s. It closes the connection without a reply if the address is `DEADLY`. When it closes
    an idle connection, it adds to `closes` the request that came just before, or b"" if none came.
    """
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve(connection: socket.socket) -> None:
            for nth in count(1):
                _, request = parse_request(framing, connection.recv(64))
                if request is None or request.start == DEADLY:
                    return
                connection.sendall(reply(framing, request))
                if is_last(nth, request.start):
                    return

        def accept() -> None:
            with suppress(OSError):
                while True:
                    connection, _ = listener.accept()
                    connection.settimeout(idle_s)
                    with connection, suppress(OSError):
                        try:
                            serve(connection)
                        except TimeoutError:
                            connection.shutdown(socket.SHUT_RDWR)
                            if closes is not None:
                                closes.append(connection.recv(64))

        thread = threading.Thread(target=accept, daemon=True)
        thread.start()
        scheme = "tcp" if framing is Framing.TCP else "socket"
        yield f"{scheme}://127.0.0.1:{listener.getsockname()[1]}"
        listener.shutdown(socket.SHUT_RDWR)
    thread.join()


DEADLY = 40


class Scattered(Drive):
    title = "Scattered"
    framings = (Framing.TCP,)
    most_registers = {HOLDING: 1}
    near = reading(1, table=HOLDING)
    far = reading(20, table=HOLDING)
    deadly = reading(DEADLY, table=HOLDING)


@pytest.mark.long
@table("every", [None, 0.1])
@table("most", [1, 2, 3])
def test_every_register_is_read_if_the_server_closes_connections_early(
    every: float | None, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An interrupted request is usually repeated first on the next connection."""
    monkeypatch.setattr(poller_module, "LOOK_NS", 5_000_000)  # so that each lost port is noticed soon
    seen = Counter[tuple[str, float | None]]()
    with server(lambda nth, address: nth == most) as port:
        drive = polled(Scattered(1, name="pump"), list(Scattered.registers.values()), every)
        with Poller(plant(line(port, drive))) as poller:

            def look() -> bool:
                seen.update((row.register, row.value) for row in rows_of(poller) if row.status == "ok")
                return all(seen[name, value] >= 3 for name, value in (("near", 1), ("far", 20)))

            until(look)
    assert {name for name, _ in seen} == {"near", "far"}


@pytest.mark.usefixtures("_patient")
def test_no_value_is_lost_if_the_server_closes_idle_connections() -> None:
    """Reported as home-assistant/core#101982 and zivillian/esp32-modbus-gateway#2.

    On a busy machine the server may close late, after the next request. Only that request may fail.
    """
    closes: list[bytes] = []
    with server(lambda nth, address: False, idle_s=0.02, closes=closes) as port:
        drive = polled(Scattered(1, name="pump"), [Scattered.registers["near"]], 0.1)
        with Poller(plant(line(port, drive))) as poller:
            rows: list[Row] = []

            def look() -> bool:
                rows.extend(rows_of(poller))
                return closes.count(b"") >= 3 and [row.status for row in rows].count("ok") >= 4

            until(look)
    late_closes = len(closes) - closes.count(b"")
    assert sum(row.status != "ok" for row in rows) <= late_closes


@pytest.mark.long
def test_all_values_are_missing_if_a_server_closes_each_connection_immediately() -> None:
    """Many devices close a new connection at once if they already serve as many clients as they can."""
    with server(lambda nth, address: False, idle_s=0.0) as port:
        drive = polled(Scattered(1, name="pump"), [Scattered.registers["near"]], 0.1)
        with Poller(plant(line(port, drive))) as poller:
            rows: list[Row] = []

            def look() -> bool:
                rows.extend(row for row in rows_of(poller) if row.status != "ok")
                return len(rows) >= 10

            until(look)
    assert {row.status for row in rows} <= {"port lost", "reply cut short"}


class Fragile(Toy):
    framings = (Framing.TCP,)
    formats = {Framing.TCP: ("8N1",)}
    deadly = reading(DEADLY)


class Checked(Fragile):
    """A drive whose identity is checked with two reads before the first stop."""

    control = command(0x14, Status, harmless=(0,))

    @verb
    def identify(self) -> Script[None]:
        """Read two registers."""
        yield from read(self.fault)
        yield from read(self.mystery)

    @verb
    def stop(self) -> Script[None]:
        """Stop the motor, and read whether it stands."""
        yield from insist(self.control, Status(0))
        yield from read(self.output_frequency)


class CheckedRTU(Checked):
    framings = (Framing.RTU,)
    formats = {Framing.RTU: ("8N1",)}


@pytest.mark.parametrize("is_polled", [False, True])
def test_a_stop_is_sent_if_the_server_closes_the_connection_after_each_reply(is_polled: bool) -> None:
    """The check of the drive's family must not use up each new connection, and neither must polling."""
    drive = Checked(1, name="pump")
    with server(lambda nth, address: True) as port, ExitStack() as stack:
        if is_polled:
            polls = polled(drive, [Checked.output_current, Checked.status])
            stack.enter_context(Poller(plant(line(port, polls))))
        else:
            stack.enter_context(Bus(port)).attach(drive)
        assert drive.stop(seconds=PATIENCE).outcome is CommandOutcome.DONE


@pytest.mark.parametrize("most", [1, 2])
def test_a_stop_over_rtu_is_confirmed_if_the_server_closes_connections_early(most: int) -> None:
    """On each new connection the confirmation may be an adapter's echo, until a read shows that it is not."""
    drive = CheckedRTU(1)
    with server(lambda nth, address: nth == most, framing=Framing.RTU) as port, Bus(port) as bus:
        bus.attach(drive)
        assert drive.stop(seconds=PATIENCE).outcome is CommandOutcome.DONE


@pytest.mark.parametrize("is_alive", [False, True])
def test_an_echo_before_the_connection_ends_does_not_confirm_a_stop(is_alive: bool) -> None:
    """The adapter echoes each request. No write reaches the drive, which may still answer reads."""

    def echo_and_reply(framing: Framing, request: Message) -> bytes:
        is_answered = is_alive and request.function == 3
        return build_request(framing, request) + (good_reply(framing, request) if is_answered else b"")

    closing = server(lambda nth, address: True, framing=Framing.RTU, reply=echo_and_reply)
    with closing as port, Bus(port) as bus, pytest.raises(Unconfirmed):
        bus.attach(CheckedRTU(1)).stop(seconds=1)


def test_a_stop_does_not_wait_for_the_poller_to_reopen_a_port(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(polled_line, "REOPEN_NS", 3_600_000_000_000)
    with server(lambda nth, address: False) as port:
        drive = Fragile(1, name="pump")
        with Poller(plant(line(port, polled(drive, [Fragile.deadly])))) as poller:
            losing = poller._lines.find("line")
            until(lambda: losing._losses > MOST_AT_ONCE)
            assert drive.stop(seconds=20).outcome is CommandOutcome.DONE


def test_a_port_is_reopened_twice_a_second_if_every_request_loses_it(tmp_path: Path) -> None:
    """Some devices close each connection at its first request, while another client is connected."""
    drives = [Toy(address, name=f"pump-{address}") for address in range(1, 6)]
    port = str(tmp_path / "port")
    wire = ClockedWire([simulated(drive) for drive in drives], Faults(hang_up=1, away=0.001), port=port)
    with ClockedLines(wire, [polled(drive, [Toy.fault], 0.2) for drive in drives]) as clocked:
        rows = clocked.run(10)
        assert 2 * 10 <= len(clocked.opened) <= 1 + MOST_AT_ONCE + 2 * 10
        wire.faults = Faults()
        rows += clocked.run(1)
        healthy = clocked.run(1)
    assert {row.status for row in rows} == {"ok", "port lost", "not asked: drive is silent"}
    assert {row.status for row in healthy} == {"ok"}
    for drive in drives:
        assert sum(row.drive == drive.name for row in rows + healthy) >= 12 / 0.2 - 1
