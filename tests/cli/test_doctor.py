"""`multidrop doctor`: the facts that it reads from the system, and the findings that it prints."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import re
import socketserver
import struct
import threading
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from commands import Run
from completions import completed
from examples import usually
from serial_server import SerialServer, pyserials_own, vanishing_pty
from tables import table

from multidrop.cli.doctor_findings import (
    ROUNDS,
    RS485_ENABLED,
    RS485_RX_DURING_TX,
    Adapter,
    RS485Mode,
    WakeLateness,
    adapter_finding,
    decoded_rs485,
    echo_finding,
    find_adapter,
    latency_finding,
    low_latency,
    low_latency_finding,
    round_trip_finding,
    rs485_finding,
    rs485_mode,
    wake_finding,
)
from multidrop.core import RS485, Completion, Failure, Framing, Message, build_reply
from multidrop.drive.line_settings import Settings
from multidrop.families.innovert_ibd import InnovertIBD
from multidrop.families.invt_che import InvtCHE
from multidrop.families.registry import find_model
from multidrop.sim import Simulator, Wire, simulated

USUAL = Settings(9600, "8N1")
SENT = bytes.fromhex("F7 03 00 00 00 01 90 9C")
REFUSAL = bytes.fromhex("F7 83 04 61 1E")


def ended(raw: bytes, result: int = Failure.NO_REPLY, skipped: int = 0, exception: int = 0) -> Completion:
    """Return the outcome of the request to an unused address."""
    reply = Message(0xF7, 3, exception=exception)
    return completed(result, reply, raw, at_ns=1, skipped=skipped)


@pytest.fixture
def sysfs(tmp_path: Path) -> Path:
    """Return a folder like Linux's /sys with an FTDI adapter: class links into the tree of devices."""
    usb = tmp_path / "devices/pci0000:00/usb1/1-2"
    port = usb / "1-2:1.0/ttyUSB0"
    (port / "tty/ttyUSB0").mkdir(parents=True)
    for name, text in {
        "idVendor": "0403",
        "idProduct": "6001",
        "manufacturer": "FTDI",
        "product": "FT232R USB UART",
    }.items():
        (usb / name).write_text(text + "\n")
    (port / "latency_timer").write_text("16\n")
    driver = tmp_path / "bus/usb-serial/drivers/ftdi_sio"
    driver.mkdir(parents=True)
    (port / "driver").symlink_to(driver)
    devices = tmp_path / "bus/usb-serial/devices"
    devices.mkdir()
    (devices / "ttyUSB0").symlink_to(port)
    tty = tmp_path / "class/tty/ttyUSB0"
    tty.mkdir(parents=True)
    (tty / "device").symlink_to(port)
    return tmp_path


@pytest.fixture
def port(request: pytest.FixtureRequest) -> Iterator[str]:
    kind = getattr(request, "param", "pty")
    drives = [simulated(InvtCHE(1))]
    if not kind.startswith("tcp"):
        drives.append(simulated(InnovertIBD(2, framing="ascii")))
    with Simulator([Wire(drives, unpaced=True, port=kind)]) as sim:
        yield sim.wires[0].path


# ---- facts of the system ----


def test_an_adapter_is_found_through_sysfs(sysfs: Path) -> None:
    adapter = find_adapter("/dev/ttyUSB0", sysfs)
    assert (adapter.name, adapter.driver, adapter.product) == ("ttyUSB0", "ftdi_sio", "FTDI FT232R USB UART")
    assert (adapter.usb_id, adapter.latency_timer) == ("0403:6001", 16)


def test_a_link_to_a_device_finds_the_devices_adapter(sysfs: Path) -> None:
    link = sysfs / "by-id"
    link.symlink_to("/dev/ttyUSB0")
    assert find_adapter(str(link), sysfs).driver == "ftdi_sio"


def test_an_adapter_without_known_facts_has_only_a_name(sysfs: Path) -> None:
    assert find_adapter("/dev/ttyS7", sysfs) == Adapter("ttyS7")


def test_rs485_modes_are_decoded_from_linuxs_struct() -> None:
    # struct serial_rs485 in linux/serial.h: flags, two delays in ms, five words of padding
    assert decoded_rs485(struct.pack("=8I", 0x01, 0, 0, 0, 0, 0, 0, 0)) == RS485Mode(True, False)
    assert decoded_rs485(struct.pack("=8I", 0x13, 5, 5, 0, 0, 0, 0, 0)) == RS485Mode(True, True)
    assert decoded_rs485(bytes(32)) == RS485Mode(False, False)
    assert (RS485_ENABLED, RS485_RX_DURING_TX) == (1, 16)


def test_a_pty_has_no_low_latency_flag_and_no_rs485_mode() -> None:
    master, slave = os.openpty()
    try:
        assert low_latency(slave) is None
        assert rs485_mode(slave) is None
    finally:
        os.close(master)
        os.close(slave)


@pytest.mark.parametrize(("settable", "mode"), [(True, RS485Mode(False, False)), (False, None)])
def test_a_driver_that_refuses_its_own_rs485_mode_has_none(
    monkeypatch: pytest.MonkeyPatch, settable: bool, mode: RS485Mode | None
) -> None:
    """The driver serial8250 behaves so: TIOCGRS485 returns zeros, TIOCSRS485 fails with ENOTTY."""
    written: list[bytes] = []

    def ioctl(fd: int, request: int, data: bytearray) -> int:
        if request == 0x542F:
            if not settable:
                raise OSError(errno.ENOTTY, "Inappropriate ioctl for device")
            written.append(bytes(data))
        return 0

    monkeypatch.setattr(fcntl, "ioctl", ioctl)
    assert rs485_mode(0) == mode
    assert written == [bytes(32)] * settable


# ---- sentences ----


@pytest.mark.parametrize("driver", ["cp210x", "ch341-uart", "pl2303", "cdc_acm"])
def test_low_latency_is_not_advised_for_drivers_that_ignore_it(driver: str) -> None:
    finding = low_latency_finding(False, driver)
    assert finding.what == f"the driver {driver} does not delay received bytes: nothing to set"
    assert not finding.advice
    assert low_latency_finding(False, "ftdi_sio").advice


def test_a_long_latency_timer_gets_advice(sysfs: Path) -> None:
    finding = latency_finding(find_adapter("/dev/ttyUSB0", sysfs))
    assert finding.what == "16 ms: every reply may wait that long in the adapter"
    assert f"echo 1 | sudo tee {sysfs}/bus/usb-serial/devices/ttyUSB0/latency_timer" in finding.advice
    assert 'ATTR{latency_timer}="1"' in finding.advice


@table(
    ("finding", "what", "advised"),
    [
        (latency_finding(Adapter("ttyUSB0", latency_timer=1)), "1 ms: the shortest possible", False),
        (latency_finding(Adapter("ttyS0")), "the driver shows none", False),
        (
            adapter_finding(Adapter("ttyS0"), "/dev/ttyS0", "/dev/ttyS0"),
            "not on USB; driver unknown",
            False,
        ),
        (
            adapter_finding(
                Adapter("ttyUSB0", "ch341", "QinHeng", "1a86:7523"), "/dev/ttyUSB0", "/dev/ttyUSB0"
            ),
            "QinHeng (1a86:7523); driver ch341",
            False,
        ),
        (
            adapter_finding(Adapter("ttyUSB0"), "/dev/ttyUSB0", "/dev/serial/by-id/usb-FTDI_A1-port0"),
            "not on USB; driver unknown",
            True,
        ),
        (low_latency_finding(None), "the driver has no such flag", False),
        (
            low_latency_finding(True),
            "the flag is set; multidrop sets it whenever it opens the port",
            False,
        ),
        (
            low_latency_finding(False),
            "the flag is not set: the driver did not accept it from multidrop",
            True,
        ),
        (
            rs485_finding(None),
            "the driver has none: the adapter itself must switch between sending and receiving",
            False,
        ),
        (
            rs485_finding(None, RS485.RTS_UP),
            "rts-up: multidrop turns RTS on while a request leaves",
            False,
        ),
        (
            rs485_finding(None, RS485.RTS_UP, is_usb=True),
            "rts-up: multidrop turns RTS on while a request leaves, and on USB for at least 2 ms longer: a "
            "drive that answers sooner is not heard",
            True,
        ),
        (
            rs485_finding(RS485Mode(True, False), RS485.RTS_DOWN),
            "rts-down: multidrop turns RTS off while a request leaves; the driver's own mode is on too",
            True,
        ),
        (rs485_finding(RS485Mode(True, False), RS485.KERNEL), "on: the driver switches the direction", False),
        (rs485_finding(RS485Mode(False, False)), "off; the driver supports it", True),
        (rs485_finding(RS485Mode(True, False)), "on: the driver switches the direction", False),
        (
            rs485_finding(RS485Mode(True, True)),
            "on: the driver switches the direction, and the port receives its own requests: "
            "multidrop removes the echo",
            False,
        ),
        (
            echo_finding(ended(b""), SENT, USUAL),
            "none at 9600 8N1",
            False,
        ),
        (
            echo_finding(ended(SENT), SENT, USUAL),
            "the adapter receives its own requests at 9600 8N1; multidrop removes them",
            False,
        ),
        (echo_finding(ended(b"\x00\xff"), SENT, USUAL), "2 unexpected bytes at 9600 8N1: 00 FF", True),
        (
            echo_finding(ended(REFUSAL, len(REFUSAL), exception=4), SENT, USUAL),
            "none at 9600 8N1; address 247, which should be unused, answers with exception 04",
            True,
        ),
        (
            echo_finding(ended(REFUSAL, len(REFUSAL), len(SENT)), SENT, USUAL),
            "the adapter receives its own requests at 9600 8N1; address 247, which should be unused, answers "
            "with a value",
            True,
        ),
    ],
)
def test_each_finding_is_a_sentence_with_advice_only_if_needed(
    finding: object, what: str, advised: bool
) -> None:
    assert finding.what == what
    assert bool(finding.advice) == advised


def test_a_slow_round_trip_gets_advice() -> None:
    drive = InvtCHE(1)
    usual = round_trip_finding(drive, [0.005] * ROUNDS, ROUNDS)
    assert usual.what.endswith("answers in 5.0 ms (median; 5.0 to 5.0 ms)")
    assert usual.advice == ""
    slow = round_trip_finding(drive, [0.005] * 3 + [0.0201] * 10, 13)
    assert "20.1 ms (median" in slow.what
    assert "usually takes 5.0 ms" in slow.advice
    assert not slow.is_failure
    assert "did not answer 4 requests" in round_trip_finding(drive, [], 4).what


def test_lost_requests_are_a_failure_with_advice() -> None:
    lost = round_trip_finding(InvtCHE(1), [0.005] * 10, 17)
    assert lost.what.endswith("7 of 17 requests got no valid reply")
    assert lost.advice.startswith("check termination, bias, cable and signal ground")
    assert lost.is_failure


def test_invalid_replies_are_part_of_the_round_trip_finding() -> None:
    came = "reply from another address (received 63 03 02 00 00)"
    nothing_good = round_trip_finding(InvtCHE(1), [], 4, came=came).what
    assert nothing_good == f"invt-che@1 gave no valid reply to 4 requests; received: {came}"
    assert round_trip_finding(InvtCHE(1), [0.005], 2, came=came).what.endswith(f"received instead: {came}")


def test_a_round_trip_over_a_network_includes_the_wires_time() -> None:
    told = round_trip_finding(InvtCHE(1), [0.0004, 0.0005, 0.0006], 3, 0.0094)
    assert told.what.endswith(
        "answers in 0.5 ms (median; 0.4 to 0.6 ms) after its request was handed over "
        "(a wire at 9600 8N1 takes 9.4 ms of it)"
    )
    assert told.advice == ""
    assert round_trip_finding(InvtCHE(1), [0.0140], 1, 0.0094).advice == ""
    assert "the adapter or the network" in round_trip_finding(InvtCHE(1), [0.0240], 1, 0.0094).advice


# ---- wake-ups ----

EARLY, LATE = WakeLateness(0.0001, 0.0005, 0.003), WakeLateness(0.0001, 0.004, 0.05)
REFUSED = "the system refuses it; permit it so"


@pytest.mark.parametrize(
    ("realtime", "options", "verdict", "advice"),
    [
        (EARLY, {}, "too late for 9600 8N1: p99 must be below 3.65 ms", "set realtime = true at the top"),
        (EARLY, {"is_realtime": True}, "good enough for 9600 8N1", ""),
        (EARLY, {"is_realtime": True, "switch": RS485.RTS_UP}, "good enough for 9600 8N1: max must be", ""),
        (LATE, {"is_realtime": True}, "too late for 9600 8N1", "stop other programs on this computer"),
        (LATE, {}, "too late for 9600 8N1", "stop other programs on this computer"),
        (REFUSED, {}, "realtime: refused; too late", REFUSED),
    ],
)
def test_wake_ups_are_judged_by_the_lines_silence(
    realtime: WakeLateness | str, options: dict[str, Any], verdict: str, advice: str
) -> None:
    found = wake_finding(LATE, realtime, USUAL, **options)
    assert found.what.startswith("the core wakes 0.10 ms late (p50), 4.00 (p99), 50.00 (max); ")
    assert verdict in found.what
    assert found.advice.startswith(advice) if advice else not found.advice


def test_a_computer_that_is_in_time_needs_no_permission_unless_the_plant_asks() -> None:
    assert wake_finding(EARLY, REFUSED, USUAL).advice == ""
    assert wake_finding(EARLY, REFUSED, USUAL, is_realtime=True).advice == REFUSED
    switched = wake_finding(WakeLateness(0.0001, 0.0005, 0.004), EARLY, USUAL, RS485.RTS_DOWN)
    assert "too late" in switched.what


def test_doctor_measures_wake_ups(run: Run, port: str) -> None:
    told = " ".join(run("doctor", port)[1].split())
    assert re.search(r"wake-ups the core wakes \d+\.\d\d ms late \(p50\), .* for 9600 8N1: p99 must be", told)


# ---- the command ----


def test_on_a_pty_doctor_reports_no_adapter(run: Run, port: str) -> None:
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
def test_on_a_socket_the_adapter_is_at_the_far_end(run: Run, port: str) -> None:
    status, out, _ = run("doctor", port)
    told = " ".join(out.split())
    assert status == 0
    assert "is a TCP connection" in told
    assert "at the far end" in told


def test_rs485_modes_are_accepted_only_for_devices(run: Run, port: str) -> None:
    status, out, err = run("doctor", port, "--rs485", "rts-up")
    assert (status, err) == (0, "")  # a pseudo-terminal has no RS-485 mode, and works without
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
def test_on_a_pyserial_port_the_adapter_is_at_the_far_end(run: Run, port: str) -> None:
    server = SerialServer(port)
    status, out, _ = run("doctor", server.url)
    server.close()
    told = " ".join(out.split())
    assert status == 0
    assert f"{server.url} is a pyserial rfc2217 port; two threads copy its bytes" in told
    assert "at the far end" in told


def test_a_port_lost_during_the_echo_test_is_part_of_the_finding(run: Run) -> None:
    port, hang_up = vanishing_pty()
    thread = threading.Thread(target=hang_up)
    thread.start()
    out = run("doctor", port)[1]
    thread.join()
    assert "not tested: the port was lost (" in " ".join(out.split())


def test_driver_features_of_a_lost_port_raise_instead_of_none() -> None:
    master, slave = os.openpty()
    os.close(master)
    os.close(slave)
    for ask in (low_latency, rs485_mode):
        with pytest.raises(OSError, match="Bad file descriptor"):
            ask(slave)


@pytest.mark.slow
def test_the_round_trip_is_measured_with_a_drive(run: Run, port: str) -> None:
    words = ("--model", "innovert-ibd", "--address", "2", "--framing", "ascii", "--json")
    status, out, _ = run("doctor", port, *words)
    assert status == 0
    findings = {load["topic"]: load for load in json.loads(out)["findings"]}
    assert findings["round trip"]["what"].startswith("innovert-ibd@2 answers in ")


@pytest.mark.slow
@pytest.mark.usefixtures("_patient")
def test_doctor_measures_all_drives_of_a_plant(run: Run, port: str, tmp_path: Path) -> None:
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
def test_doctor_sends_only_five_requests_to_a_silent_drive(run: Run, port: str) -> None:
    status, out, _ = run("doctor", port, "--model", "invt-che", "--address", "9")
    assert status == 1
    assert "did not answer 5 requests" in " ".join(out.split())


@pytest.mark.parametrize("port", ["pty", "socket://127.0.0.1:0"], indirect=True)
def test_no_delay_is_negative_on_ports_without_bits(run: Run, port: str) -> None:
    """The simulated far end answers immediately, sooner than a wire could have delivered the request."""
    status, out, _ = run("doctor", port, "--model", "invt-che", "--address", "1")
    told = " ".join(out.split())
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
def test_an_exception_in_the_echo_test_is_not_called_foreign_traffic(
    run: Run, responder: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A server may answer for every address, even an unused one."""
    monkeypatch.setattr("multidrop.cli.doctor.LEAST_TIMEOUT", 2.0)  # a busy machine may be slow
    end = responder(lambda request: build_reply(Framing.RTU, Message(request[0], request[1], exception=4)))
    told = " ".join(run("doctor", end.path)[1].split())
    assert "answers with exception 04" in told
    assert "came unasked" not in told


@pytest.mark.slow
@pytest.mark.parametrize("code", [0x0A, 0x0B])
def test_a_gateways_exception_does_not_count_as_the_drives_answer(
    run: Run, responder: Any, code: int
) -> None:
    """These codes mean that the device was not reached (application protocol V1.1b3, section 7)."""
    end = responder(lambda request: build_reply(Framing.RTU, Message(request[0], request[1], exception=code)))
    status, out, _ = run("doctor", end.path, "--model", "invt-che", "--address", "9")
    told = " ".join(out.split())
    assert (status, "answers in" in told) == (1, False)
    assert f"20 requests: exception {code:02X}, as from a gateway that does not reach it" in told


@pytest.mark.slow
def test_a_gateways_exception_proves_its_framing_and_noise_does_not(run: Run) -> None:
    """Bytes without a frame do not prove that the far end speaks the other framing."""

    def answered(request: bytes) -> bytes:
        if request[2:4] != b"\0\0":
            return b"what is that"
        return request[:4] + b"\0\3" + request[6:7] + bytes([request[7] | 0x80, 0x0B])

    with frame_server(answered) as address:
        status, out, _ = run("doctor", f"tcp://{address}", "--model", "invt-che", "--address", "9")
        told = " ".join(out.split())
        assert (status, "other way" in told) == (1, False)
        assert "20 requests: exception 0B, as from a gateway that does not reach it" in told
        status, out, _ = run("doctor", f"socket://{address}", "--model", "invt-che", "--address", "9")
        assert "the far end speaks Modbus TCP, not RTU over TCP" in " ".join(out.split())
    with frame_server(lambda request: b"" if request[2:4] == b"\0\0" else b"what is that") as address:
        _, out, _ = run("doctor", f"tcp://{address}", "--model", "invt-che", "--address", "9")
        assert "RTU over TCP got no answer either" in " ".join(out.split())


@pytest.mark.slow
def test_a_drive_that_refuses_counts_as_present_and_its_code_is_printed(run: Run, responder: Any) -> None:
    end = responder(lambda request: build_reply(Framing.RTU, Message(request[0], request[1], exception=6)))
    status, out, _ = run("doctor", end.path, "--model", "invt-che", "--address", "9")
    told = " ".join(out.split())
    assert (status, "invt-che@9 answers in" in told) == (0, True)
    assert "20 exceptions: 06" in told


@pytest.mark.slow
def test_the_round_trip_counts_only_sent_requests(
    run: Run, responder: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While a late reply may come, a silent drive gets no request. Held-back requests do not count."""
    end = responder(lambda request: b"")
    monkeypatch.setattr("multidrop.cli.doctor.MOST_S", 1.0)
    status, out, _ = run("doctor", end.path, "--model", "invt-che", "--address", "9")
    told = " ".join(out.split())
    assert status == 1
    sent = sum(request[0] == 9 for request in end.requests)
    assert 1 <= sent < ROUNDS
    assert f"invt-che@9 did not answer {sent} request{'s' * (sent != 1)} -> check its address" in told


@pytest.mark.parametrize(
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
def test_mistaken_doctor_arguments_are_one_sentence(
    run: Run, words: tuple[str, ...], status: int, sentence: str
) -> None:
    found, out, err = run("doctor", *words)
    assert (found, out) == (status, "")
    assert sentence in err
    assert len(err.splitlines()) == 1


# ---- Modbus TCP and RTU over TCP ----


@pytest.mark.long
@pytest.mark.parametrize("port", ["tcp://127.0.0.1:0"], indirect=True)
def test_a_drive_on_modbus_tcp_is_measured(port: str, run: Run) -> None:
    status, said, _ = run("doctor", port, "--model", "invt-che", "--address", "1")
    assert status == 0
    told = " ".join(said.split())
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
def test_doctor_reports_a_far_end_with_the_other_framing(
    port: str, asked: str, spoken: str, other: str, run: Run
) -> None:
    place = port.partition("://")[2]
    status, said, _ = run("doctor", f"{asked}://{place}", "--model", "invt-che", "--address", "1")
    assert status == 1
    told = " ".join(said.split())
    assert f"the far end speaks {spoken}, not" in told
    assert f"use the port {other}://{place} instead of {asked}://{place}" in told


@pytest.mark.parametrize("table_of", ["setting", "command"], ids=["readable", "unreadable"])
def test_a_family_without_readings_is_measured_by_any_readable_register(
    run: Run, tmp_path: Path, table_of: str
) -> None:
    family = tmp_path / "relay.toml"
    family.write_text(
        '[family]\ntitle = "Relay board"\nmanual = "x"\ncounts_from = 0\n[default]\ntable = "coil"\n'
        f'[{table_of}]\nrelay = {{ at = 0, unit = "", kept = "ram" }}\n'
    )
    with Simulator([Wire([simulated(find_model(str(family))(1))])]) as simulator:
        _, out, _ = run("doctor", simulator.wires[0].path, "--model", str(family), "--address", "1")
    assert "round trip" in out
    assert ("has no readable register" in " ".join(out.split())) == (table_of == "command")
