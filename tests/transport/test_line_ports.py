"""Ports of every kind: opening, reopening and closing them, and their errors."""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from commands import descriptors, threads
from lines import PATIENCE, line, plant, polled, rows_of, until
from ptys import SerialServer, pyserials_own, vanishing_pty
from serial import Serial
from tables import table
from toy import PatientToy, Toy

from multidrop.bus import Bus
from multidrop.capture import Capture, CaptureWriter, Decoding, Tapped
from multidrop.core import Echo, Port, set_settings
from multidrop.drive import Drive
from multidrop.errors import LineError, NoReply, Unconfirmed
from multidrop.families import MODELS
from multidrop.poller import Poller
from multidrop.sim import Simulator, Wire, simulated
from multidrop.transport import clock, open_port
from multidrop.transport.line import Line
from multidrop.transport.network_port import MOST_STALL_MS

MakePort = Callable[[], tuple[str, Callable[[], None]]]


def wire(port: str = "pty") -> Wire:
    drive = simulated(Toy(1))
    drive["output_current"] = 3.25
    return Wire([drive], unpaced=True, port=port)


def read_and_write(bus: Bus) -> None:
    toy = bus.attach(PatientToy, 1)
    assert toy.read(toy.output_current) == 3.25
    assert toy.write(toy.frequency, 25.0) == 25.0


def test_a_drive_is_read_and_written_through_a_socket_port() -> None:
    with Simulator([wire("socket://127.0.0.1:0")]) as sim, Bus(sim.wires[0].path) as bus:
        read_and_write(bus)
    assert sim.wires[0].drives[0]["frequency"] == 25.0


def read_at_every_baud_rate(family: type[Drive]) -> None:
    drives = [simulated(family(at, baudrate=baudrate)) for at, baudrate in enumerate(family.baudrates, 1)]
    with Simulator([Wire(drives, unpaced=True)]) as sim, Bus(sim.wires[0].path) as bus:
        for drive, baudrate in zip(drives, family.baudrates, strict=True):
            attached = bus.attach(family, drive.drive.address, baudrate=baudrate)
            first = next(iter(attached.readings()))
            assert attached.read(first) == drive[first.name]


@pytest.mark.long
def test_drives_can_be_read_at_every_documented_baud_rate() -> None:
    """The library knows the baud rate of a drive in advance, and may use it to recognise a late reply."""
    with ThreadPoolExecutor(len(MODELS)) as pool:
        list(pool.map(read_at_every_baud_rate, MODELS.values()))


@pytest.mark.skipif(not hasattr(socket, "TCP_USER_TIMEOUT"), reason="this system knows no such time-out")
def test_socket_port_sets_tcp_user_timeout_against_stalled_connections(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A loopback connection cannot stall, so this test reads the socket options."""
    told: list[int] = []

    class Watched(Port):
        def __init__(self, fd: int, must_take: int, **details: Any) -> None:
            with socket.socket(fileno=os.dup(fd)) as connection:
                told.append(connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT))
            super().__init__(fd, must_take, **details)

    monkeypatch.setattr(open_port, "Port", Watched)
    with Simulator([wire("socket://127.0.0.1:0")]) as sim, Bus(sim.wires[0].path):
        assert told == [MOST_STALL_MS]


@pytest.mark.parametrize("echo", ["auto", "on", "off"])
def test_the_echo_option_is_kept_when_a_port_is_reopened(echo: str, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[Echo] = []
    monkeypatch.setattr(Port, "set_echo", lambda port, each: told.append(each))
    with Simulator([wire()]) as sim, Bus(sim.wires[0].path, echo=echo) as bus:
        bus.line.reopen()
        assert told == [Echo(echo)] * 2


def test_port_waits_for_the_settle_time_after_each_opening(monkeypatch: pytest.MonkeyPatch) -> None:
    """Some gateways restart when their port is opened: they print text, and ignore requests for a while."""
    slept: list[float] = []
    with socket.create_server(("127.0.0.1", 0)) as listener:
        host, number = listener.getsockname()
        accepted: list[socket.socket] = []

        def boot(seconds: float) -> None:
            slept.append(seconds)
            accepted.append(listener.accept()[0])
            accepted[-1].sendall(b"ets Jun  8 2016\r\n")

        monkeypatch.setattr(clock, "sleep", boot)
        with Bus(f"tcp://{host}:{number}", settle=1.5) as bus:
            bus.line.reopen()
            assert not bus.line.is_lost
        assert slept == [1.5, 1.5]
        for connection in accepted:
            connection.close()


@table("settle", [-1, 10.1, float("nan"), "1.5 s", True])
def test_a_settle_option_that_is_not_a_number_of_seconds_raises(settle: object) -> None:
    with pytest.raises(ValueError, match="is not a number of seconds from 0 to 10"):
        Bus("/dev/nowhere", settle=settle)  # type: ignore[arg-type]


def test_an_unknown_echo_option_raises() -> None:
    with pytest.raises(ValueError, match='echo \'loud\' is none of "auto", "on" and "off"'):
        Bus("/dev/null", echo="loud")


def test_a_pty_can_be_opened_repeatedly_although_it_ignores_the_parity() -> None:
    """A pty stays at 8 bits without parity whatever is set, and passes all bytes."""
    drive = simulated(Toy(1, format="8E1"))
    drive["output_current"] = 3.25
    with Simulator([Wire([drive], unpaced=True)]) as sim:
        for _ in range(2):
            with Bus(sim.wires[0].path, format="8E1") as bus:
                read_and_write(bus)


def test_a_port_is_set_to_low_latency_mode(monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise USB adapters delay received bytes by up to 16 ms."""
    told: list[bool] = []
    monkeypatch.setattr(Serial, "set_low_latency_mode", lambda port, wanted: told.append(wanted))
    with Simulator([wire()]) as sim, Bus(sim.wires[0].path) as bus:
        read_and_write(bus)
        bus.line.reopen()
    assert told == [True, True]


@table("refusal", [ValueError, OSError, NotImplementedError, AttributeError])
def test_port_works_if_low_latency_mode_is_refused(
    monkeypatch: pytest.MonkeyPatch, refusal: type[Exception]
) -> None:
    def refuse(port: Serial, wanted: bool) -> None:
        raise refusal

    monkeypatch.setattr(Serial, "set_low_latency_mode", refuse)
    with Simulator([wire()]) as sim, Bus(sim.wires[0].path) as bus:
        read_and_write(bus)


@pytest.fixture
def server() -> Iterator[SerialServer]:
    with Simulator([wire("socket://127.0.0.1:0")]) as sim:
        server = SerialServer(sim.wires[0].path)
        yield server
        server.close()


@pytest.mark.slow
@pyserials_own
def test_a_drive_is_read_and_written_through_an_rfc2217_port(server: SerialServer) -> None:
    with Bus(server.url, baudrate=19200, format="8E1") as bus:
        read_and_write(bus)
        far = server.port
        assert (far.baudrate, far.bytesize, far.parity, far.stopbits) == (19200, 8, "E", 1)


@pytest.mark.slow
@pyserials_own
def test_an_rfc2217_port_is_polled(server: SerialServer) -> None:
    toy = polled(Toy(1, baudrate=19200), [Toy.output_current])
    with Poller(plant(line(server.url, toy))) as poller:
        rows = []
        until(lambda: rows.extend(rows_of(poller)) or any(row.value == 3.25 for row in rows))
        assert server.port.baudrate == 19200


@pytest.mark.slow
@pyserials_own
def test_drives_with_different_settings_are_refused_on_an_rfc2217_port(server: SerialServer) -> None:
    slow, fast = Toy(1, baudrate=9600), Toy(2, baudrate=19200)
    with pytest.raises(LineError, match=r"cannot change its baud rate or format between drives$"):
        Poller(plant(line(server.url, polled(slow, [Toy.status]), polled(fast, [Toy.status]))))


def os_words_of_an_unknown_zone() -> str:
    with pytest.raises(socket.gaierror) as failure:
        socket.getaddrinfo("fe80::1%nowhere", 4001)
    return str(failure.value.strerror)


@table(
    ("port", "reason"),
    [
        ("{tmp}/absent", "there is no such port"),
        ("{tmp}/file/port", "Not a directory"),
        ("{tmp}/file", "it is not a serial port"),
        ("{tmp}", "it is a directory, not a serial port"),
        ("/dev/null", "it is not a serial port"),
        ("socket://127.0.0.1:{closed}", "nothing listens there"),
        ("rfc2217://127.0.0.1:{closed}", "nothing listens there"),
        ("tcp://127.0.0.1:{closed}", "nothing listens there"),
        (
            "127.0.0.1:502",
            "a scheme is missing: write tcp://127.0.0.1:502 for Modbus TCP, or socket://127.0.0.1:502 for "
            "RTU over TCP",
        ),
        ("socket://127.0.0.1", "the URL needs a host and a port number, such as socket://10.0.0.7:4001"),
        ("rfc2217://:4001", "the URL needs a host and a port number, such as rfc2217://10.0.0.7:4001"),
        ("socket://127.0.0.1:99999", "Port out of range 0-65535"),
        (
            "sokcet://127.0.0.1:4001",
            "the scheme sokcet:// is not supported; write a URL such as tcp://10.0.0.7, "
            "socket://10.0.0.7:4001 or rfc2217://10.0.0.7:4001",
        ),
        ("socket://[fe80::1%nowhere]:4001", "{unknown}"),
        ("spy://{tmp}/absent", "there is no such port"),
    ],
)
def test_opening_an_invalid_port_raises_a_one_sentence_error(tmp_path: Path, port: str, reason: str) -> None:
    (tmp_path / "file").write_text("no port")
    with socket.create_server(("127.0.0.1", 0)) as listener:
        closed = listener.getsockname()[1]
    port = port.format(tmp=tmp_path, closed=closed)
    reason = reason.format(unknown=os_words_of_an_unknown_zone())
    with pytest.raises(LineError) as caught:
        Line(port).open()
    assert str(caught.value) == f"{port}: {reason}"
    assert (caught.value.port, caught.value.reason) == (port, reason)
    assert isinstance(caught.value, OSError)
    is_mistaken = any(
        word in reason for word in ("needs a host", "out of range", "the scheme sokcet", "write tcp:")
    )
    assert isinstance(caught.value, ValueError) == is_mistaken


def test_a_port_that_is_open_cannot_be_opened_by_another_bus() -> None:
    with Simulator([wire()]) as sim:
        port = sim.wires[0].path
        with Bus(port) as first:
            with pytest.raises(LineError) as caught:
                Line(port).open()
            assert str(caught.value) == f"{port}: it is in use by this or another program"
            read_and_write(first)
        Line(port).open().close()


def test_closed_or_failed_ports_leave_no_descriptor_or_thread(tmp_path: Path) -> None:
    with Simulator([wire(), wire("socket://127.0.0.1:0")]) as sim:
        Line(sim.wires[0].path).open().close()  # opens descriptors that stay open in each process
        before = descriptors(), threads()
        for each in sim.wires:
            for _ in range(3):
                Line(each.path).open().close()
        for _ in range(3):
            Line("loop://").open().close()
            with pytest.raises(LineError):
                Line("/dev/null").open()
        assert (descriptors(), threads()) == before


def vanishing_socket() -> tuple[str, Callable[[], None]]:
    """Return the URL of a peer, and a function that closes the connection after one request."""
    listener = socket.create_server(("127.0.0.1", 0))
    path = f"socket://127.0.0.1:{listener.getsockname()[1]}"

    def hang_up() -> None:
        with listener, listener.accept()[0] as client:
            client.recv(1024)

    return path, hang_up


@pytest.mark.slow
def test_a_read_on_a_flooded_port_raises_no_reply() -> None:
    master, slave = os.openpty()
    with Bus(os.ttyname(slave)) as bus:
        toy = bus.attach(Toy(1))
        for _ in range(2):
            for _ in range(4):
                os.write(master, b"\xff" * 1000)
            with pytest.raises(NoReply):
                toy.read(toy.output_current)
    os.close(slave)
    os.close(master)


@pytest.mark.parametrize("make", [vanishing_pty, vanishing_socket])
def test_a_port_lost_during_a_read_raises_line_error(make: MakePort) -> None:
    path, hang_up = make()
    thread = threading.Thread(target=hang_up)
    thread.start()
    with Bus(path) as bus:
        toy = bus.attach(PatientToy, 1)
        for _ in range(2):  # the port is still lost at the second read
            with pytest.raises(LineError) as caught:
                toy.read(toy.output_current)
            assert str(caught.value).startswith(f"{path}: the port was lost (")
            assert "\n" not in str(caught.value)
        thread.join()
        with pytest.raises(LineError):
            bus.line.reopen()
        with pytest.raises(LineError, match=r"there is no such port|nothing listens there"):
            toy.read(toy.output_current)


@pytest.mark.parametrize("make", [vanishing_pty, vanishing_socket])
def test_a_port_lost_during_a_write_raises_unconfirmed(make: MakePort) -> None:
    path, hang_up = make()
    thread = threading.Thread(target=hang_up)
    thread.start()
    with Bus(path) as bus:
        toy = bus.attach(PatientToy, 1)
        with pytest.raises(Unconfirmed, match=r"it is not known whether .* took effect: the port was lost"):
            toy.send_raw(6, 0x15, bytes(2))
        thread.join()
        with pytest.raises(LineError):  # this write was not sent
            toy.send_raw(6, 0x15, bytes(2))


def test_a_port_is_reopened_through_its_device_link(tmp_path: Path) -> None:
    link = tmp_path / "by-id"
    with Simulator([wire(str(link))]), Bus(str(link)) as bus:
        read_and_write(bus)
        first = link.readlink()
        held = os.open(link, os.O_RDONLY | os.O_NOCTTY)  # so that no other pty gets its number
    with Simulator([wire(str(link))]):
        assert link.readlink() != first
        bus.line.reopen()
        assert bus.drives[0].read(Toy.output_current) == 3.25
        bus.close()
    os.close(held)


def test_a_capture_continues_after_the_port_is_reopened(tmp_path: Path) -> None:
    with (
        Simulator([wire()]) as sim,
        Bus(sim.wires[0].path) as bus,
        CaptureWriter(tmp_path / "a.pcapng", ["hall-1"]) as writer,
        Tapped({"hall-1": bus}, writer) as tapped,
    ):
        toy = bus.attach(PatientToy, 1)
        tapped.collect()
        bus.line.reopen()
        assert toy.read(toy.output_current) == 3.25
    with Capture(tmp_path / "a.pcapng") as capture:
        assert [(row.register, row.value) for rows in Decoding(capture) for row in rows] == [
            ("holding_register_2", 325)
        ]


def test_a_port_handled_by_pyserial_keeps_its_settings_when_it_is_reopened() -> None:
    """The test uses a spy:// port of pyserial. With another baud rate, the drive would not answer."""
    with Simulator([Wire([simulated(Toy(1, baudrate=19200))], unpaced=True)]) as sim:
        path = sim.wires[0].path
        with Bus(f"spy://{path}", baudrate=19200) as bus:
            toy = bus.attach(Toy, 1)
            assert toy.read(toy.output_current) == 0
            with Path(path).open("rb", buffering=0) as port:
                set_settings(port.fileno(), 9600, "8N1")
            bus.line.reopen()
            assert toy.read(toy.output_current) == 0


def test_a_pyserial_port_that_cannot_be_set_up_raises_a_one_sentence_error() -> None:
    master, slave = os.openpty()
    port = f"spy://{os.ttyname(slave)}"
    with Bus(port) as bus:
        toy = bus.attach(Toy, 1)
        os.close(slave)
        os.close(master)
        with pytest.raises(LineError) as caught:
            toy.read(toy.output_current)
    assert caught.value.port == port
    assert "its adapter failed" in caught.value.reason
    assert "\n" not in str(caught.value)


def test_closing_a_port_waits_for_the_exchanges_of_another_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    closing: list[threading.Thread] = []
    end = Port.end

    def end_slowly(port: Port) -> bool:
        closing.append(threading.Thread(target=ours.close))
        closing[0].start()
        closing[0].join(0.2)  # time in which `close` would end if it did not wait
        assert port.c is not None
        return end(port)

    monkeypatch.setattr(Port, "end", end_slowly)
    with Simulator([wire()]) as simulator:
        ours = Line(simulator.wires[0].path).open()
        assert not ours.end()
        closing[0].join(PATIENCE)
        assert not closing[0].is_alive()
        assert not ours.end()


def test_a_read_through_a_closed_bus_raises_an_error() -> None:
    with Simulator([wire()]) as sim:
        with Bus(sim.wires[0].path) as bus:
            toy = bus.attach(Toy, 1)
        bus.close()  # a second call is allowed
        with pytest.raises(LineError) as caught:
            toy.read(toy.output_current)
        assert str(caught.value) == f"{sim.wires[0].path}: it is closed"


def test_closing_a_bus_ends_exchanges_that_wait_for_a_reply() -> None:
    """One thread waits for a silent drive, another closes the bus."""
    failures: list[LineError] = []
    master, slave = os.openpty()
    bus = Bus(os.ttyname(slave))
    slow = bus.attach(PatientToy, 1)

    def wait() -> None:
        with pytest.raises(LineError) as caught:
            slow.read(slow.output_current)
        failures.append(caught.value)

    waiting = threading.Thread(target=wait)
    waiting.start()
    os.read(master, 1024)  # wait for the request
    bus.close()
    waiting.join()
    os.close(slave)
    os.close(master)
    assert [failure.port for failure in failures] == [bus.line.port]


def test_a_file_named_in_a_ports_url_is_not_changed(tmp_path: Path) -> None:
    """pyserial's spy:// empties the file that it names."""
    precious = tmp_path / "precious"
    precious.write_text("precious")
    with pytest.raises(LineError, match="the scheme spy:// is not supported"):
        Line(f"spy:///dev/null?file={precious}").open()
    assert precious.read_text() == "precious"
