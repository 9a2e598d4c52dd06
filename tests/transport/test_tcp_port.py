"""Modbus TCP ports: names, accepted drives, and peers that speak another protocol."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import pytest
from lines import PATIENCE, rows_of, until
from tables import table

from multidrop.bus import Bus
from multidrop.core import Framing, Message, build_reply, build_request, parse_request
from multidrop.drive import Drive
from multidrop.drive.register import HOLDING, reading, setting
from multidrop.drive.text import Text
from multidrop.errors import BadReply, NoReply, NoSuchPort, PortLost, Unconfirmed, WriteForbidden
from multidrop.families import YD1000, DelixiNative, InnovertIBD
from multidrop.plant.loader import PlantError, load_plant
from multidrop.poller import Poller
from multidrop.sim import Simulator, Wire, simulated
from multidrop.transport.network_port import mixed_up
from multidrop.transport.open_port import unopened
from multidrop.transport.port_identity import of_name


class Meter(Drive):
    """A device with its own connection. Its unit id may be any number."""

    title = "Meter"
    framings = (Framing.TCP,)
    addresses = range(256)
    voltage = reading(1, "V", table=HOLDING)


@contextmanager
def serving(serve: Callable[[socket.socket], object]) -> Iterator[str]:
    """Yield the address of a server that passes its connections to `serve`, one after another."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def run() -> None:
            while True:
                try:
                    connection, _ = listener.accept()
                except OSError:
                    return
                with connection, suppress(OSError):
                    serve(connection)

        thread = threading.Thread(target=run, daemon=True)
        thread.start()
        yield f"127.0.0.1:{listener.getsockname()[1]}"
        listener.shutdown(socket.SHUT_RDWR)
    thread.join()


@contextmanager
def responder(answer: bytes) -> Iterator[tuple[str, list[bytes]]]:
    """Yield the address of a server and a list of its inputs. It answers the first input with `answer`."""
    came: list[bytes] = []

    def serve(connection: socket.socket) -> None:
        came.append(connection.recv(1024))
        connection.sendall(answer)
        while connection.recv(1024):
            pass

    with serving(serve) as place:
        yield place, came


@pytest.mark.parametrize(
    ("name", "opened", "identity"),
    [
        ("tcp://10.0.0.7", "socket://10.0.0.7:502", "10.0.0.7:502"),
        ("tcp://10.0.0.7:1502", "socket://10.0.0.7:1502", "10.0.0.7:1502"),
        ("tcp://[fe80::1]", "socket://[fe80::1]:502", "[fe80::1]:502"),
    ],
)
def test_the_default_tcp_port_is_502(name: str, opened: str, identity: str) -> None:
    assert unopened(name).port == opened
    assert of_name(name) == identity


@table("name", ["tcp://", "tcp://:502", "tcp://10.0.0.7:0", "tcp://10.0.0.7:99999"])
def test_an_invalid_tcp_url_raises_a_one_sentence_error(name: str) -> None:
    with pytest.raises(NoSuchPort, match=r"needs a host, such as tcp://10\.0\.0\.7|Port out of range"):
        Bus(name)


@pytest.fixture
def port() -> Iterator[str]:
    with Simulator([Wire([simulated(InnovertIBD(1))], port="tcp://127.0.0.1:0", unpaced=True)]) as line:
        yield line.wires[0].path


@pytest.mark.usefixtures("_patient")
def test_an_attached_drive_uses_the_framing_of_its_port(port: str) -> None:
    drive = InnovertIBD(1)
    with Bus(port) as bus:
        bus.attach(drive)
        assert drive.framing is Framing.TCP
        assert drive.read(drive.output_current) == 0
    with Simulator([Wire([simulated(InnovertIBD(1))])]) as line, Bus(line.wires[0].path) as bus:
        bus.attach(drive)
        assert drive.framing is Framing.RTU
        assert drive.read(drive.output_current) == 0


@pytest.mark.parametrize(
    ("drive", "sentence"),
    [
        (InnovertIBD(1, framing="rtu"), "framing rtu is for serial lines, but tcp://.* speaks Modbus TCP"),
        (InnovertIBD(1, framing="ascii"), "framing ascii is for serial lines"),
        (DelixiNative(1), "does not speak Modbus, but the port tcp://.* carries only Modbus TCP"),
    ],
)
def test_another_framing_on_a_tcp_port_is_refused_in_one_sentence(
    port: str, drive: Drive, sentence: str
) -> None:
    with Bus(port) as bus, pytest.raises(ValueError, match=sentence):
        bus.attach(drive)


@pytest.mark.parametrize(
    ("drive", "sentence"),
    [
        (InnovertIBD(1, framing="tcp"), "framing tcp is for tcp:// ports, such as tcp://10.0.0.7:502"),
        (Meter(0), "framing tcp is for tcp:// ports"),
    ],
)
def test_tcp_framing_on_a_serial_port_raises_a_one_sentence_error(drive: Drive, sentence: str) -> None:
    wire = Wire([simulated(InnovertIBD(9))])
    with Simulator([wire]), Bus(wire.path) as bus, pytest.raises(ValueError, match=sentence):
        bus.attach(drive)


def test_unit_ids_of_modbus_tcp_are_refused_on_serial_ports() -> None:
    class Both(Drive):
        title = "Both"
        addresses = range(256)
        voltage = reading(1, "V", table=HOLDING)

    with Simulator([Wire([simulated(InnovertIBD(9))])]) as line, Bus(line.wires[0].path) as bus:
        for address in (0, 248, 255):
            with pytest.raises(ValueError, match=f"address {address} is valid only on Modbus TCP"):
                bus.attach(Both, address)


@pytest.mark.parametrize("unit", [0, 1, 255])
def test_devices_with_every_unit_id_can_be_read(unit: int) -> None:
    sim = simulated(Meter(unit))
    sim["voltage"] = 230
    wire = Wire([sim], port="tcp://127.0.0.1:0", unpaced=True)
    with Simulator([wire]), Bus(wire.path) as bus:
        assert bus.attach(Meter, unit).read(Meter.voltage) == 230


def test_no_broadcast_is_sent_on_modbus_tcp() -> None:
    drives = [YD1000(1), YD1000(2)]
    sims = [simulated(drive) for drive in drives]
    wire = Wire(sims, port="tcp://127.0.0.1:0", unpaced=True)
    with Simulator([wire]), Bus(wire.path) as bus:
        for drive in (YD1000(1), YD1000(2)):
            bus.attach(drive)
            bus.check_identity(drive)
        register = bus.drives[0].register("control")
        with pytest.raises(WriteForbidden, match="cannot be broadcast: Modbus TCP has no broadcast"):
            bus.broadcast(register, 0xC000)
        bus.stop_all(seconds=5)
    assert [sim.counters.broadcasts for sim in sims] == [0, 0]


def test_every_modbus_tcp_mistake_in_a_plant_file_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "plant.toml"
    path.write_text(
        '[[line]]\nname = "a"\nport = "tcp://10.0.0.7"\ntransaction = "skip"\n'
        '[[line.drive]]\nname = "p"\nmodel = "innovert-ibd"\naddress = 1\nframing = "rtu"\n'
        '[[line]]\nname = "b"\nport = "/dev/ttyUSB0"\ntransaction = "ignore"\n'
        '[[line.drive]]\nname = "q"\nmodel = "innovert-ibd"\naddress = 1\nframing = "tcp"\n'
    )
    with pytest.raises(PlantError) as mistakes:
        load_plant(path)
    said = "\n".join(mistakes.value.mistakes)
    assert """transaction 'skip' is none of "match" and "ignore\"""" in said
    assert "framing rtu is for serial lines, but tcp://10.0.0.7 speaks Modbus TCP" in said
    assert "transaction is only for tcp:// ports, and /dev/ttyUSB0 is not one" in said
    assert "framing tcp is for tcp:// ports" in said


def plant_of_two(path: Path, port: str, second: int) -> Path:
    path.write_text(
        "".join(
            f'[[line]]\nname = "net-{number}"\nport = "{port}"\n'
            f'[[line.drive]]\nname = "pump-{number}"\nmodel = "innovert-ibd"\naddress = {address}\n'
            'poll = ["output_current"]\n'
            for number, address in enumerate((1, second), 1)
        )
    )
    return path


def answer_when_both_asked(listening: socket.socket) -> None:
    """Wait for the first request on each of two connections, then reply to both."""
    both_asked, answered = threading.Barrier(2), set[int]()

    def serve(connection: socket.socket) -> None:
        with connection, suppress(OSError, threading.BrokenBarrierError):
            while request := connection.recv(260):
                asked = parse_request(Framing.TCP, request)[1]
                assert asked is not None
                if asked.address not in answered:
                    both_asked.wait(PATIENCE)
                    answered.add(asked.address)
                held = Message(
                    asked.address, 3, data=bytes([0, asked.address]), transaction=asked.transaction
                )
                connection.sendall(build_reply(Framing.TCP, held))

    for _ in range(2):
        threading.Thread(target=serve, args=[listening.accept()[0]], daemon=True).start()


def test_two_lines_to_one_gateway_send_requests_concurrently(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        threading.Thread(target=answer_when_both_asked, args=[listening], daemon=True).start()
        port = f"tcp://127.0.0.1:{listening.getsockname()[1]}"
        found: set[tuple[str, object]] = set()
        with Poller(load_plant(plant_of_two(tmp_path / "plant.toml", port, 2))) as poller:
            until(lambda: found.update((row.drive, row.value) for row in rows_of(poller)) or len(found) > 1)
    assert found - {("pump-1", None), ("pump-2", None)} <= {("pump-1", 0.1), ("pump-2", 0.2)}


def test_same_unit_id_on_two_lines_to_one_gateway_is_refused(tmp_path: Path) -> None:
    sentence = r'line "net-2", drive "pump-2": address 1 is already used by line "net-1", drive "pump-1"'
    with pytest.raises(PlantError, match=sentence):
        load_plant(plant_of_two(tmp_path / "plant.toml", "tcp://10.0.0.7", 1))


READ = Message(1, 3, 3, 1)


def test_rtu_frames_from_a_tcp_port_are_reported_and_end_the_connection() -> None:
    answer = build_reply(Framing.RTU, Message(1, 3, data=b"\0\7"))
    with responder(answer) as (place, came), Bus(f"tcp://{place}") as bus:
        drive = bus.attach(InnovertIBD, 1)
        with pytest.raises(PortLost, match=f"looks like RTU over TCP: name the port socket://{place}"):
            drive.read(drive.output_current)
        assert parse_request(Framing.TCP, came[0])[0] == len(came[0])
        bus.line.regain()
        with pytest.raises(PortLost):
            drive.read(drive.output_current)
        until(lambda: len(came) == 2)  # the second request came on a new connection


def test_modbus_tcp_frames_from_a_socket_port_are_reported() -> None:
    answer = build_reply(Framing.TCP, Message(1, 3, data=b"\0\7", transaction=3))
    with responder(answer) as (place, _), Bus(f"socket://{place}") as bus:
        drive = bus.attach(InnovertIBD, 1)
        with pytest.raises((BadReply, NoReply)) as failure:
            bus._exchanges.values(drive, [drive.output_current], 1)
        assert f"name the port tcp://{place}" in str(failure.value)


@pytest.mark.slow
def test_the_error_for_a_silent_port_names_the_other_protocol() -> None:
    with responder(b"") as (place, _):
        for kind, other in (("tcp", "socket"), ("socket", "tcp")):
            with Bus(f"{kind}://{place}") as bus:
                drive = bus.attach(InnovertIBD, 1)
                with pytest.raises(NoReply, match=f"{other}://{place}"):
                    drive.read(drive.output_current)


def test_an_exception_0b_of_a_gateway_counts_as_a_missing_reply() -> None:
    """The gateway answers each request with exception 0BH and the request's transaction id."""

    def serve(connection: socket.socket) -> None:
        while request := connection.recv(260):
            connection.sendall(request[:4] + b"\0\3" + request[6:7] + bytes([request[7] | 0x80, 0x0B]))

    with serving(serve) as place, Bus(f"tcp://{place}") as bus:
        drive = bus.attach(InnovertIBD, 1)
        with pytest.raises(NoReply, match=r"behind the gateway, which says so \(exception 0BH\)"):
            drive.read(drive.output_current)
        assert bus.peer(drive).failures == 3


@pytest.mark.parametrize("kind", ["socket", "tcp"])
def test_only_frames_of_the_other_protocol_are_recognised_as_mixed_up(kind: str) -> None:
    port = f"{kind}://10.0.0.7:502"
    rtu, tcp = build_request(Framing.RTU, READ), build_request(Framing.TCP, READ)
    own, other = (rtu, tcp) if kind == "socket" else (tcp, rtu)
    assert mixed_up(port, other)
    assert not any(mixed_up(port, came) for came in (own, b"", b"\0" * 4, b"HTTP/1.1 400 Bad Request"))
    assert not any(mixed_up("/dev/ttyUSB0", came) for came in (rtu, tcp))


class TwoBlocks(Drive):
    """A device whose registers need two requests."""

    title = "Two blocks"
    framings = (Framing.TCP,)
    first = reading(1, table=HOLDING)
    second = reading(0x1000, table=HOLDING)
    third = reading(0x2000, table=HOLDING)
    target = setting(0x3000, table=HOLDING)
    serial = Text(0x4142, 2, table=HOLDING)


@contextmanager
def closing_peer(replies: int) -> Iterator[tuple[str, list[Message]]]:
    """Yield a Modbus TCP peer that closes each connection after `replies` replies, or after a request."""
    asked: list[Message] = []

    def serve(connection: socket.socket) -> None:
        for _ in range(max(replies, 1)):
            if frame := connection.recv(1024):
                asked.append(parse_request(Framing.TCP, frame)[1])
                connection.sendall(answered(frame, asked[-1]) if replies else b"")

    with serving(serve) as place:
        yield f"tcp://{place}", asked


def answered(frame: bytes, request: Message) -> bytes:
    """Return a reply in which the registers hold their addresses."""
    words = b"".join((request.start + at).to_bytes(2) for at in range(request.count))
    reply = build_reply(Framing.TCP, replace(request, data=words))
    return frame[:2] + reply[2:]


def test_a_read_continues_if_the_peer_closes_after_each_reply() -> None:
    with closing_peer(1) as (port, asked), Bus(port) as bus:
        drive = bus.attach(TwoBlocks(1))
        for _ in range(2):
            found = drive.read(drive.second, drive.first, drive.third)
            assert found == {"second": 0x1000, "first": 1, "third": 0x2000}
        assert drive.read(drive.serial) == "ABAC"
        assert len(asked) <= 12


def test_a_read_raises_if_the_peer_closes_before_any_reply() -> None:
    with closing_peer(0) as (port, asked), Bus(port) as bus:
        drive = bus.attach(TwoBlocks(1))
        with pytest.raises(PortLost):
            drive.read(drive.first)
        assert len(asked) == 1


@pytest.mark.usefixtures("_patient")
def test_a_write_is_not_repeated_on_a_reopened_port() -> None:
    with closing_peer(1) as (port, asked), Bus(port) as bus:
        drive = bus.attach(TwoBlocks(1))
        assert drive.read(drive.first) == 1
        with pytest.raises((PortLost, Unconfirmed)):
            drive.write(drive.target, 5)
        assert all(request.function == 3 for request in asked)
