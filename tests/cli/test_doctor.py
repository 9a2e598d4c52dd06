"""`multidrop doctor`: what it measures on simulated lines, and the findings that it prints."""

from __future__ import annotations

import json
import os
import re
import socketserver
import threading
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from commands import Run
from ptys import SerialServer, pyserials_own, vanishing_pty
from tables import table, usually

from multidrop.cli import doctor
from multidrop.cli.doctor_findings import ROUNDS
from multidrop.core import RS485, Framing, Message, build_reply
from multidrop.families.innovert_ibd import InnovertIBD
from multidrop.families.invt_che import InvtCHE
from multidrop.families.registry import find_model
from multidrop.sim import Simulator, Wire, simulated


@pytest.fixture
def port(request: pytest.FixtureRequest) -> Iterator[str]:
    kind = getattr(request, "param", "pty")
    drives = [simulated(InvtCHE(1))]
    if not kind.startswith("tcp"):
        drives.append(simulated(InnovertIBD(2, framing="ascii")))
    with Simulator([Wire(drives, unpaced=True, port=kind)]) as sim:
        yield sim.wires[0].path


CHE_1 = ("--model", "invt-che", "--address", "1")
CHE_9 = ("--model", "invt-che", "--address", "9")


def examined(run: Run, *words: object) -> tuple[int, str]:
    """Return the exit status of `doctor`, and its output as one line."""
    status, out, _ = run("doctor", *words)
    return status, " ".join(out.split())


def test_the_doctor_command_measures_how_late_the_computer_wakes(run: Run, port: str) -> None:
    told = examined(run, port)[1]
    assert re.search(r"wake-ups the core wakes \d+\.\d\d ms late \(p50\), .* for 9600 8N1: p99 must be", told)


def test_the_doctor_command_reports_no_adapter_on_a_pty(run: Run, port: str) -> None:
    status, out, err = run("doctor", port)
    assert (status, err) == (0, "")
    told = " ".join(out.split())
    assert f"{port} is a pseudo-terminal" in told
    assert "none, and therefore no driver" in told
    assert "multidrop locks it against programs that respect such locks, makes it raw" in told
    assert "echo none at 9600 8N1" in told
    assert "not measured: it needs a drive -> name one with --model and --address" in told
    assert max(map(len, out.splitlines())) <= 80


@pytest.mark.slow
@pytest.mark.parametrize("port", ["socket://127.0.0.1:0"], indirect=True)
def test_the_doctor_command_reports_a_remote_adapter_for_a_network_port(run: Run, port: str) -> None:
    status, told = examined(run, port)
    assert status == 0
    assert "is a TCP connection" in told
    assert "at the far end" in told


def test_the_rs485_option_is_accepted_only_for_a_serial_device(run: Run, port: str) -> None:
    status, out, err = run("doctor", port, "--rs485", "rts-up")
    assert (status, err) == (0, "")  # a pseudo-terminal has no RS-485 mode, and needs none
    for words, sentence in (
        ((port, "--rs485", "on"), 'rs485 \'on\' is none of "off", "kernel", "rts-up" and "rts-down"'),
        (("tcp://10.0.0.7", "--rs485", "kernel"), "rs485 applies to serial devices only"),
    ):
        status, out, err = run("doctor", *words)
        assert (status, out) == (2, "")
        assert sentence in err


@pytest.mark.slow
@pyserials_own
@pytest.mark.parametrize("port", ["socket://127.0.0.1:0"], indirect=True)
def test_the_doctor_command_reports_a_remote_adapter_for_a_pyserial_url(run: Run, port: str) -> None:
    server = SerialServer(port)
    status, out, _ = run("doctor", server.url)
    server.close()
    told = " ".join(out.split())
    assert status == 0
    assert f"{server.url} is a pyserial rfc2217 port; two threads copy its bytes" in told
    assert "at the far end" in told


def test_the_doctor_command_reports_a_port_lost_during_the_echo_test(run: Run) -> None:
    port, hang_up = vanishing_pty()
    thread = threading.Thread(target=hang_up)
    thread.start()
    out = run("doctor", port)[1]
    thread.join()
    assert "not tested: the port was lost (" in " ".join(out.split())


@pytest.mark.slow
@pytest.mark.usefixtures("_patient")
def test_the_doctor_command_measures_the_round_trip_with_a_drive(run: Run, port: str) -> None:
    words = ("--model", "innovert-ibd", "--address", "2", "--framing", "ascii", "--json")
    status, out, _ = run("doctor", port, *words)
    assert status == 0
    findings = {load["topic"]: load for load in json.loads(out)["findings"]}
    assert findings["round trip"]["what"].startswith("innovert-ibd@2 answers in ")


@pytest.mark.slow
@pytest.mark.usefixtures("_patient")
def test_the_doctor_command_measures_all_drives_of_a_plant(run: Run, port: str, tmp_path: Path) -> None:
    plant = tmp_path / "plant.toml"
    drive = '[[line.drive]]\nname = "{}"\nmodel = "{}"\naddress = {}\n'
    plant.write_text(
        f'[[line]]\nname = "hall"\nport = "{port}"\n'
        + drive.format("che", "invt-che", 1).replace("address", "maximum_frequency = 50\naddress")
        + drive.format("ibd", "innovert-ibd", 2) + 'framing = "ascii"\n'
        + '[[line]]\nname = "roof"\nport = "/dev/none"\n' + drive.format("fan", "yd1000", 1)
    )  # fmt: skip
    status, out, _ = run("doctor", plant, "--json")
    assert status == 1
    hall, roof = json.loads(out)["lines"]
    trips = [one["what"] for one in hall["findings"] if one["topic"] == "round trip"]
    assert [trip.split(" in ")[0] for trip in trips] == ["che answers", "ibd answers"]
    assert [one["what"] for one in roof["findings"]] == ["/dev/none: there is no such port"]
    status, out, _ = run("doctor", plant, "hall")
    assert (status, out.count("round trip")) == (0, 2)
    assert run("doctor", plant)[1].startswith(f"hall: {port}\n")
    assert "has no drive 'holl'; there are che, ibd, fan" in run("doctor", plant, "holl")[2]


@pytest.mark.slow
def test_the_doctor_command_sends_only_five_requests_to_a_silent_drive(run: Run, port: str) -> None:
    status, told = examined(run, port, *CHE_9)
    assert status == 1
    assert "did not answer 5 requests" in told


@pytest.mark.usefixtures("_patient")
@pytest.mark.parametrize("port", ["pty", "socket://127.0.0.1:0"], indirect=True)
def test_measured_delays_on_ptys_and_network_ports_are_never_negative(run: Run, port: str) -> None:
    """The simulated far end answers immediately, sooner than a wire could have delivered the request."""
    status, told = examined(run, port, *CHE_1)
    assert status == 0
    found = re.search(r"invt-che@1 answers in (\S+) ms \(median; (\S+) to (\S+) ms\)", told)
    assert found
    median, least, most = map(float, found.groups())
    assert 0 <= least <= median <= most
    assert "after its request was handed over (a wire at 9600 8N1 takes 9.4 ms of it)" in told


def test_the_echo_test_uses_the_given_settings(run: Run, port: str) -> None:
    status, out, _ = run("doctor", port, "--baudrate", "19200", "--format", "8E1")
    assert status == 0
    assert "none at 19200 8E1" in out


class Responder:
    """A line that records every request, and replies with the bytes that `answer` returns."""

    def __init__(self, answer: Callable[[bytes], bytes]) -> None:
        self.requests: list[bytes] = []
        self._answer = answer
        self._fd, slave = os.openpty()
        tty.setraw(slave)
        self.path = os.ttyname(slave)
        self._slave = slave
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        received = b""
        while (piece := os.read(self._fd, 4096)) != b"end":
            received += piece
            while len(received) >= 8:
                request, received = received[:8], received[8:]
                self.requests.append(request)
                os.write(self._fd, self._answer(request))

    def close(self) -> None:
        os.write(self._slave, b"end")
        self._thread.join()
        os.close(self._fd)
        os.close(self._slave)


@contextmanager
def frame_server(answer: Callable[[bytes], bytes]) -> Iterator[str]:
    """Yield HOST:PORT of a server that replies to each received piece, for one client after another."""

    class Handler(socketserver.BaseRequestHandler):
        def handle(self) -> None:
            while piece := self.request.recv(4096):
                self.request.sendall(answer(piece))

    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Handler) as server:
        server.daemon_threads = True
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield "{}:{}".format(*server.server_address)
        server.shutdown()


@pytest.fixture
def responder() -> Iterator[Callable[[Callable[[bytes], bytes]], Responder]]:
    made: list[Responder] = []

    def make(answer: Callable[[bytes], bytes]) -> Responder:
        made.append(Responder(answer))
        return made[-1]

    yield make
    for one in made:
        one.close()


@pytest.mark.slow
def test_the_echo_test_ignores_exception_replies(
    run: Run, responder: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A server may answer for every address, even an unused one."""
    # on a busy machine, the reply may come late
    monkeypatch.setattr("multidrop.cli.doctor.LEAST_TIMEOUT", 2.0)
    end = responder(lambda request: build_reply(Framing.RTU, Message(request[0], request[1], exception=4)))
    told = examined(run, end.path)[1]
    assert "answers with exception 04" in told
    assert "came unasked" not in told


@pytest.mark.slow
@pytest.mark.parametrize("code", [0x0A, 0x0B])
def test_an_exception_from_a_gateway_does_not_count_as_a_drives_reply(
    run: Run, responder: Any, code: int
) -> None:
    """These codes mean that the device was not reached (application protocol V1.1b3, section 7)."""
    end = responder(lambda request: build_reply(Framing.RTU, Message(request[0], request[1], exception=code)))
    status, told = examined(run, end.path, *CHE_9)
    assert (status, "answers in" in told) == (1, False)
    assert f"20 requests: exception {code:02X}, as from a gateway that does not reach it" in told


@pytest.mark.slow
def test_the_framing_of_a_gateway_is_detected_by_an_exception_reply(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bytes without a frame do not prove that the far end speaks the other framing."""
    monkeypatch.setattr(doctor, "MOST_S", 1.0)
    monkeypatch.setattr(doctor.ask_once, "__defaults__", (RS485.OFF, 0.5))

    def answered(request: bytes) -> bytes:
        if request[2:4] != b"\0\0":
            return b"what is that"
        return request[:4] + b"\0\3" + request[6:7] + bytes([request[7] | 0x80, 0x0B])

    with frame_server(answered) as address:
        status, told = examined(run, f"tcp://{address}", *CHE_9)
        assert (status, "other way" in told) == (1, False)
        assert "20 requests: exception 0B, as from a gateway that does not reach it" in told
        assert (
            "the far end speaks Modbus TCP, not RTU over TCP"
            in examined(run, f"socket://{address}", *CHE_9)[1]
        )
    with frame_server(lambda request: b"" if request[2:4] == b"\0\0" else b"what is that") as address:
        assert "RTU over TCP got no answer either" in examined(run, f"tcp://{address}", *CHE_9)[1]


@pytest.mark.slow
def test_the_doctor_command_prints_the_exception_code_of_a_drive_that_refuses(
    run: Run, responder: Any
) -> None:
    end = responder(lambda request: build_reply(Framing.RTU, Message(request[0], request[1], exception=6)))
    status, told = examined(run, end.path, *CHE_9)
    assert (status, "invt-che@9 answers in" in told) == (0, True)
    assert "20 exceptions: 06" in told


@pytest.mark.slow
def test_the_doctor_command_counts_only_sent_requests(
    run: Run, responder: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A silent drive gets no request while its late reply may come. Held-back requests are not counted."""
    end = responder(lambda request: b"")
    monkeypatch.setattr("multidrop.cli.doctor.MOST_S", 1.0)
    status, told = examined(run, end.path, *CHE_9)
    assert status == 1
    sent = sum(request[0] == 9 for request in end.requests)
    assert 1 <= sent < ROUNDS
    assert f"invt-che@9 did not answer {sent} request{'s' * (sent != 1)} -> check its address" in told


@table(
    ("words", "status", "sentence"),
    [
        (("/dev/nowhere",), 1, "/dev/nowhere: there is no such port"),
        (("/dev/null",), 1, "/dev/null: it is not a serial port"),
        (("/dev/nowhere", "--model", "invt-che"), 2, "--model and --address belong together"),
        (("/dev/nowhere", "--model", "invt", "--address", "1"), 2, "did you mean invt-che"),
        (("/dev/nowhere", "--baudrate", "0"), 2, "baud rate 0 is outside 50 to 4000000"),
        (("/dev/nowhere", "--format", "9N1"), 2, "format '9N1' is not data bits, parity and stop bits"),
        (("/dev/nowhere", "--framing", "rtu"), 2, "--framing needs a drive: add --model and --address"),
    ],
)
def test_invalid_doctor_arguments_are_named_in_the_error(
    run: Run, words: tuple[str, ...], status: int, sentence: str
) -> None:
    found, out, err = run("doctor", *words)
    assert (found, out) == (status, "")
    assert sentence in err
    assert len(err.splitlines()) == 1


@pytest.mark.long
@pytest.mark.parametrize("port", ["tcp://127.0.0.1:0"], indirect=True)
def test_the_doctor_command_measures_a_drive_on_modbus_tcp(port: str, run: Run) -> None:
    status, told = examined(run, port, *CHE_1)
    assert status == 0
    assert "is a Modbus TCP connection" in told
    assert "answers in" in told
    assert "other way" not in told


@pytest.mark.long
@pytest.mark.parametrize(
    ("port", "asked", "spoken", "other"),
    usually(
        ("tcp://127.0.0.1:0", "socket", "Modbus TCP", "tcp"),
        ("socket://127.0.0.1:0", "tcp", "RTU over TCP", "socket"),
    ),
    indirect=["port"],
)
def test_the_doctor_command_suggests_the_framing_that_the_far_end_uses(
    port: str, asked: str, spoken: str, other: str, run: Run
) -> None:
    place = port.partition("://")[2]
    status, told = examined(run, f"{asked}://{place}", *CHE_1)
    assert status == 1
    assert f"the far end speaks {spoken}, not" in told
    assert f"use the port {other}://{place} instead of {asked}://{place}" in told


@pytest.mark.parametrize("table_of", ["setting", "command"], ids=["readable", "unreadable"])
def test_the_doctor_command_reads_another_register_without_readings(
    run: Run, tmp_path: Path, table_of: str
) -> None:
    family = tmp_path / "relay.toml"
    family.write_text(
        '[family]\ntitle = "Relay board"\nmanual = "x"\ncounts_from = 0\n[default]\ntable = "coil"\n'
        f'[{table_of}]\nrelay = {{ at = 0, unit = "", kept = "ram" }}\n'
    )
    with Simulator([Wire([simulated(find_model(str(family))(1))], unpaced=True)]) as simulator:
        _, out, _ = run("doctor", simulator.wires[0].path, "--model", str(family), "--address", "1")
    assert "round trip" in out
    assert ("has no readable register" in " ".join(out.split())) == (table_of == "command")
