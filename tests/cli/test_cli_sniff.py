"""`sniff` and `decode`: on a live line, behind a network, from captures; and their errors."""

from __future__ import annotations

import fcntl
import json
import os
import pty
import socket
import threading
from collections.abc import Iterable, Iterator
from contextlib import closing, suppress
from pathlib import Path
from time import tzset
from typing import Any

import pytest
from commands import Run, multidrop
from frames import PRINTED
from lines import PATIENCE, until
from ptys import SerialServer, pyserials_own
from recordings import recorded
from sniffing import sniffing, tapped

from multidrop.capture import CaptureWriter, Side
from multidrop.capture.decoding import Pairing
from multidrop.cli import sniff
from multidrop.cli.sniff import Listener, TrafficPrinter
from multidrop.core import Framing, Message, Splitter, Stream, build_reply, build_request
from multidrop.drive.line_settings import Settings
from multidrop.families.delixi import DelixiNative
from multidrop.families.innovert_ibd import InnovertIBD
from multidrop.families.invt_che import InvtCHE
from multidrop.sim import EncodedDrive, Simulator, Wire

DRIVES = (InnovertIBD(1), InvtCHE(2), InnovertIBD(3, framing="ascii"), DelixiNative(4))
PLANT = """
[[line]]
name = "hall-1"
port = "{port}"
baudrate = 9600
format = "8N1"
[[line.drive]]
name = "fan-1"
model = "innovert-ibd"
address = 1
[[line.drive]]
name = "fan-2"
model = "invt-che"
address = 2
[[line.drive]]
name = "pump-3"
model = "innovert-ibd"
framing = "ascii"
address = 3
[[line.drive]]
name = "pump-4"
model = "delixi-native"
address = 4
poll = ["output_frequency", "status"]
"""


@pytest.fixture
def line() -> Iterator[tuple[str, str]]:
    """Yield the ports of a master and of a listener, on a line with drives of three framings."""
    drives = [EncodedDrive(drive) for drive in DRIVES]
    simulator = Simulator([Wire(drives, unpaced=True)])
    with simulator, tapped(simulator.wires[0].path, 9600) as ports:
        yield ports


def plant(directory: Path, port: str) -> Path:
    path = directory / "plant.toml"
    path.write_text(PLANT.format(port=port))
    return path


@pytest.mark.long
def test_polled_values_can_be_sniffed_and_decoded(line: tuple[str, str], tmp_path: Path, run: Run) -> None:
    port, tap = line
    file = plant(tmp_path, port)
    with sniffing(tap, "--plant", file, "--out", tmp_path / "a.pcapng") as sniffer:
        done = multidrop("poll", file, "--seconds", 2, "--out", tmp_path / "polled.arrows")
        assert done.returncode == 0, done.stderr
    assert run("decode", tmp_path / "a.pcapng", "--plant", file, "--out", tmp_path / "decoded.arrows")[0] == 0

    def values(path: Path) -> dict[tuple[str, str], list[float]]:
        found: dict[tuple[str, str], list[float]] = {}
        for row in recorded(path):
            if row.value is not None:
                found.setdefault((row.drive, row.register), []).append(row.value)
        return found

    polled, decoded = values(tmp_path / "polled.arrows"), values(tmp_path / "decoded.arrows")
    assert {drive for drive, _ in polled} == {"fan-1", "fan-2", "pump-3", "pump-4"}
    assert set(polled) <= set(decoded)
    for name, column in polled.items():
        assert decoded[name][: len(column)] == column  # the poll may have missed the last reply
        assert len(decoded[name]) <= len(column) + 3  # at most three replies have no polled row
    assert {exchange["line"] for exchange in sniffer.exchanges} == {"hall-1"}


def test_the_listener_of_the_sniff_command_cannot_send(line: tuple[str, str]) -> None:
    with (
        closing(Listener(line[1], Settings(9600, "8N1"))) as listener,
        pytest.raises(OSError, match="Bad file"),
    ):
        os.write(listener.fileno(), b"\x01")


@pytest.mark.long
@pytest.mark.slow
def test_the_sniff_command_prints_an_unanswered_request_while_the_line_is_silent() -> None:
    master, slave = pty.openpty()
    with sniffing(os.ttyname(slave)) as sniffer:
        os.write(master, READ.request_frame)
        until(lambda: sniffer.told)
        (told,) = sniffer.told
        assert (told["result"], told["frames"]) == ("no reply", [READ.request_frame.hex(" ").upper()])
    assert sniffer.summary["unanswered"] == 1
    os.close(master)
    os.close(slave)


def test_bytes_received_late_do_not_count_as_silence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A busy computer reads the request late, and soon after it the reply. The line was never silent."""
    now = 0.0

    class Listening:
        port, stream = "line", Stream()

        def receive(self) -> int:
            """Return a request after 2 s, no bytes for 0.05 s, and then the reply."""
            nonlocal now
            said, seconds = next(coming, (b"", 1.0))
            now += seconds
            self.stream.put(said, round(now * 1e9))
            return len(said)

    coming = iter([(READ.request_frame, 2.0), (b"", 0.05), (READ.frame, 0.05)])
    monkeypatch.setattr(sniff.time, "monotonic", lambda: now)
    printer = TrafficPrinter("line", None, as_json=True, out=None)
    sniff._listen(Listening(), printer, 3.0)  # type: ignore[arg-type]
    assert printer.pairing.counts()["exchanges"] == 1
    assert printer.pairing.counts()["unanswered"] == 0


class ResponderLine:
    """A far end that sends the same bytes repeatedly, and stores the bytes that it receives."""

    def __init__(self, said: bytes) -> None:
        self._said = said
        self.told = b""
        self._server = socket.create_server(("127.0.0.1", 0))
        self.url = f"socket://127.0.0.1:{self._server.getsockname()[1]}"
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        connection, _ = self._server.accept()
        with connection, suppress(OSError):
            connection.settimeout(0.005)
            while True:
                connection.sendall(self._said)
                with suppress(TimeoutError):
                    more = connection.recv(1024)
                    if not more:
                        return
                    self.told += more

    def close(self) -> bytes:
        """Close the connection, and return all bytes received on it."""
        self._thread.join(timeout=PATIENCE)
        self._server.close()
        return self.told


@pytest.mark.long
@pytest.mark.parametrize("kind", ["socket", "rfc2217"])
@pyserials_own
def test_the_sniff_command_sends_no_bytes_to_a_network_port(run: Run, kind: str) -> None:
    far = ResponderLine(READ.request_frame + READ.frame + WRITE.request_frame + WRITE.frame)
    server = SerialServer(far.url) if kind == "rfc2217" else None
    url = server.url if server else far.url
    status, out, err = run("sniff", url, "--baudrate", 19200, "--format", "8E1", "--seconds", 2, "--json")
    assert (status, err) == (0, f"listening on {url}, Ctrl-C ends\n")
    told = [json.loads(line) for line in out.splitlines()]
    assert {record["line"] for record in told[:-1]} == {url}
    assert told[-1]["summary"]["exchanges"] > 10
    # the records at the start and at the end may be incomplete
    sniffed = [record.get("frames", [])[1:] for record in told[2:-2]]
    pair = [[each.frame.hex(" ").upper()] for each in (READ, WRITE)]
    assert sniffed in ((len(sniffed) * pair)[: len(sniffed)], (len(sniffed) * pair)[1 : len(sniffed) + 1])
    if server:
        assert (server.port.baudrate, server.port.parity) == (19200, "E")
        server.close()
    assert far.close() == b""


def test_a_listener_on_a_network_port_cannot_send() -> None:
    far = ResponderLine(b"")
    with closing(Listener(far.url, Settings(9600, "8N1"))) as listener:
        port = listener._source
        with pytest.raises(OSError, match="only listens: 01 was not sent"):
            port.write(b"\x01")
    assert far.close() == b""


def test_a_lost_network_connection_ends_sniffing_with_a_sentence(run: Run) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        url = f"socket://127.0.0.1:{server.getsockname()[1]}"
        threading.Thread(target=lambda: server.accept()[0].close(), daemon=True).start()
        status, _, err = run("sniff", url)
    assert (status, err.splitlines()[-1]) == (1, f"multidrop: {url}: the port was lost (hung up)")


PAIRS = {each.frame: each for each in PRINTED if each.request is not None}
READ = PAIRS[bytes.fromhex("01 03 02 13 88 B5 12")]
WRITE = PAIRS[bytes.fromhex("01 06 00 02 13 88 25 5C")]


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    path = tmp_path / "a.pcapng"
    with CaptureWriter(path) as writer:
        time = 1_700_000_000_000_000_000
        for exchange in (READ, WRITE):
            writer.write(exchange.request_frame, Side.ASKING, time, "hall-1")
            writer.write(exchange.frame, Side.ANSWERING, time + 5_300_000, "hall-1")
        writer.write(b"\xff\x00", Side.EITHER, time + 6_000_000, "hall-1")
        writer.write(READ.request_frame, Side.ASKING, time + 7_000_000, "hall-1")
    return path


def delixi_plant(directory: Path) -> Path:
    path = directory / "plant.toml"
    drive = 'name = "pump"\nmodel = "delixi-modbus"\naddress = 1\n'
    path.write_text(f'[[line]]\nname = "hall-1"\nport = "/dev/none"\n[[line.drive]]\n{drive}')
    return path


@pytest.mark.parametrize("command", [["decode"], ["sniff", "--replay"]])
def test_the_decode_command_prints_values_of_a_capture_with_units(
    run: Run, capture: Path, command: list[str]
) -> None:
    status, out, err = run(*command, capture, "--plant", delixi_plant(capture.parent))
    assert (status, err) == (0, "")
    assert [line.partition("  ")[2] for line in out.splitlines()[:4]] == [
        "pump  reads output_frequency = 50.00 Hz  (5.3 ms)",
        "pump  writes frequency = 50.00 Hz  (5.3 ms)",
        "unknown: FF 00",
        "pump  reads output_frequency: no reply",
    ]
    assert out.splitlines()[4:] == ["2 exchanges, 1 request without a reply, 2 unknown bytes"]


def test_the_decode_command_without_a_plant_file_prints_raw_registers(run: Run, capture: Path) -> None:
    out = run("decode", capture)[1]
    assert "  address 1  reads holding_register_500 = 5000  " in out
    objects = [json.loads(line) for line in run("decode", capture, "--json")[1].splitlines()]
    assert objects[0] == {
        "line": "hall-1",
        "time": "2023-11-14T22:13:20.000000000Z",
        "framing": "rtu",
        "address": 1,
        "function": 3,
        "frames": ["01 03 01 F4 00 01 C4 04", "01 03 02 13 88 B5 12"],
        "drive": "address 1",
        "access": "read",
        "result": "ok",
        "reply_after_ns": 5_300_000,
        "values": {"holding_register_500": 5000},
    }
    assert objects[-1]["summary"]["exchanges"] == 2


def frame(asked: bool, *message: Any, framing: Framing = Framing.RTU) -> tuple[bytes, Side]:
    build = build_request if asked else build_reply
    return build(framing, Message(*message)), Side.ASKING if asked else Side.ANSWERING


def told(run: Run, path: Path, frames: Iterable[tuple[bytes, Side]], *words: object) -> list[str]:
    """Return what `decode` prints for a capture of the frames, 1 ms apart, without times of day."""
    with CaptureWriter(path) as writer:
        for number, (raw, side) in enumerate(frames):
            writer.write(raw, side, number * 1_000_000, "hall-1")
    status, out, err = run("decode", path, *words)
    assert status == 0
    assert not err or err.endswith("/meter.py is run as Python: a user's model is a program\n")
    return [line.partition("  ")[2] or line for line in out.splitlines()]


def test_the_decode_command_prints_requests_other_than_reads(run: Run, tmp_path: Path) -> None:
    delixi = (4, 0x02, 1, 0, bytes(4))
    frames = [
        frame(False, 1, 0x03, 0, 0, b"\x13\x88"),
        *(frame(True, 1, 0x03, 500, 1), frame(False, 1, 0x03, 0, 0, b"", 0x02)),
        frame(True, 0, 0x06, 8193, 0, b"\x13\x88"),
        *(frame(True, 1, 0x08, 0, 0, b"\xa5\x37"), frame(False, 1, 0x08, 0, 0, b"\xa5\x37")),
        *(frame(True, *delixi, framing=Framing.DELIXI), frame(False, *delixi, framing=Framing.DELIXI)),
        frame(True, 1, 0x06, 2, 0, b"\0\x01"),
    ]
    assert told(run, tmp_path / "a.pcapng", frames) == [
        "address 1  function 03: reply without its request: 01 03 02 13 88 B5 12",
        "address 1  reads holding_register_500: refused, code 02H  (1.0 ms)",
        "all drives  writes holding_register_8193 = 5000 (broadcast)",
        "address 1  reads loopback_0 = 42295  (1.0 ms)",
        "address 4  writes k2_0001 = 1  (1.0 ms)",
        "address 1  writes holding_register_2 = 1: no reply",
        "3 exchanges, 1 broadcast, 1 request without a reply, 1 reply without a request, 0 unknown bytes",
    ]


def test_endless_noise_is_printed_as_it_arrives() -> None:
    stream, splitter, pairing, told = Stream(), Splitter(), Pairing(), []
    for time in range(4):
        stream.put(b"\xff" * 1500, time)
        told.append([(each.time_ns, len(each.raw)) for each in pairing.pair(splitter.spans(stream))])
    assert told == [[], [], [(0, 4500)], []]
    assert [(each.time_ns, len(each.raw)) for each in pairing.flush()] == [(3, 1500)]


METER = """\
from multidrop.core import NumberFormat
from multidrop.drive.family import Drive
from multidrop.drive.register import reading
from multidrop.drive.register import HOLDING

class Meter(Drive):
    model = "meter"
    most_registers = {HOLDING: 4}
    power = reading(7, "kW", number_format=NumberFormat.F32, table=HOLDING)
"""


def test_a_nan_reply_is_printed_as_no_valid_value(run: Run, tmp_path: Path) -> None:
    """A meter without a sensor replies with the NaN of the floating-point format."""
    (tmp_path / "meter.py").write_text(METER)
    drive = 'name = "meter"\nmodel = "meter.py:Meter"\naddress = 1\n'
    plant = tmp_path / "plant.toml"
    plant.write_text(f'[[line]]\nname = "hall-1"\nport = "/dev/none"\n[[line.drive]]\n{drive}')
    frames = [frame(True, 1, 0x03, 7, 2), frame(False, 1, 0x03, 0, 0, bytes.fromhex("7F C0 00 00"))]
    assert (
        told(run, tmp_path / "a.pcapng", frames, "--plant", plant)[0]
        == "meter  reads power: no valid value  (1.0 ms)"
    )
    (line, _) = run("decode", tmp_path / "a.pcapng", "--plant", plant, "--json")[1].splitlines()
    assert json.loads(line)["values"] == {"power": None}
    out = tmp_path / "a.csv"
    assert run("decode", tmp_path / "a.pcapng", "--plant", plant, "--out", out)[0] == 0
    assert [(row.register, row.value, row.status) for row in recorded(out)] == [
        ("power", None, "no valid value")
    ]


def test_a_capture_can_be_replayed_into_an_equal_capture(run: Run, capture: Path) -> None:
    again = capture.parent / "again.pcapng"
    first = run("sniff", "--replay", capture, "--out", again)
    assert first[0] == 0
    assert run("decode", again) == first


def test_the_decode_command_prints_the_numbers_of_rows_and_exchanges(run: Run, capture: Path) -> None:
    out = capture.parent / "a.csv"
    assert run("decode", capture, "--out", out) == (0, f"2 rows in {out}: 2 exchanges, 2 unknown bytes\n", "")
    assert [row.value for row in recorded(out)] == [5000, 5000]


def test_the_sniff_command_reports_a_port_that_cannot_be_opened(run: Run, tmp_path: Path) -> None:
    ordinary = tmp_path / "file"
    ordinary.write_text("hello")
    for port, sentence in (
        (tmp_path / "none", "there is no such port"),
        (ordinary, "it is not a serial port"),
        (tmp_path, "it is not a serial port"),
        ("socket://127.0.0.1:9", "nothing listens there"),
    ):
        assert run("sniff", port) == (1, "", f"multidrop: {port}: {sentence}\n")
    port, sentence = (
        "socket://127.0.0.1",
        "the URL needs a host and a port number, such as socket://10.0.0.7:4001",
    )
    assert run("sniff", port) == (2, "", f"multidrop: {port}: {sentence}\n")


def test_the_sniff_command_reports_a_port_in_use(run: Run) -> None:
    master, slave = pty.openpty()
    fcntl.flock(slave, fcntl.LOCK_EX)
    port = os.ttyname(slave)
    assert run("sniff", port) == (1, "", f"multidrop: {port}: it is in use by this or another program\n")
    os.close(master)
    os.close(slave)


def test_the_sniff_command_reports_a_missing_permission(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Root has every permission, so the system's refusal is simulated."""

    def refuse(path: str, flags: int) -> int:
        raise PermissionError(13, "Permission denied", path)

    monkeypatch.setattr("multidrop.cli.sniff.os.open", refuse)
    assert run("sniff", "/dev/ttyS0") == (
        1,
        "",
        "multidrop: /dev/ttyS0: no permission to open it (is the user in the group that owns it?)\n",
    )


def test_invalid_sniff_arguments_are_reported_in_one_sentence(
    run: Run, tmp_path: Path, capture: Path, request: pytest.FixtureRequest
) -> None:
    none, text = tmp_path / "none.pcapng", tmp_path / "text"
    ends = os.pipe()
    request.addfinalizer(lambda: [os.close(end) for end in ends])
    pipe = f"/dev/fd/{ends[0]}"
    text.write_text("hello, world")
    cut = tmp_path / "cut.pcapng"
    cut.write_bytes(capture.read_bytes()[:-5])
    for words, status, sentence in (
        (["sniff"], 2, "name either a PORT to listen to, or a capture with --replay FILE"),
        (["sniff", "--replay", capture, "--out", "a.csv"], 2, "a.csv: a capture's name must end in .pcapng"),
        (["decode", none], 2, f"{none}: No such file or directory"),
        (["decode", text], 2, f"{text} is not a capture: it does not start like a pcap or pcapng file"),
        (["decode", pipe], 2, f"{pipe} is not a capture: it is not a regular file"),
        (["sniff", "--replay", pipe], 2, f"{pipe} is not a capture: it is not a regular file"),
        (
            ["decode", capture, "--out", capture],
            2,
            f"{capture} exists already: name another file, or remove it first",
        ),
        (["decode", cut], 0, f"{cut} ends within a packet: its last 103 bytes were skipped"),
    ):
        found, _, err = run(*words)
        assert (found, err) == (status, f"multidrop: {sentence}\n")


def test_a_lost_port_ends_sniffing_with_a_sentence(run: Run) -> None:
    master, slave = pty.openpty()
    threading.Timer(0.3, os.close, [master]).start()
    port = os.ttyname(slave)
    status, _, err = run("sniff", port)
    os.close(slave)
    assert status == 1
    assert err.splitlines()[-1].startswith(f"multidrop: {port}: the port was lost (")


def test_the_decode_command_prints_times_of_day_in_utc(
    run: Run, capture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    try:
        monkeypatch.setenv("TZ", "America/New_York")
        tzset()
        assert run("decode", capture)[1].startswith("22:13:20.000000Z  address 1  reads ")
    finally:
        monkeypatch.undo()
        tzset()


def test_an_infinite_value_is_null_in_json(run: Run, tmp_path: Path) -> None:
    (tmp_path / "meter.py").write_text(METER)
    drive = 'name = "meter"\nmodel = "meter.py:Meter"\naddress = 1\n'
    plant = tmp_path / "plant.toml"
    plant.write_text(f'[[line]]\nname = "hall-1"\nport = "/dev/none"\n[[line.drive]]\n{drive}')
    frames = [frame(True, 1, 0x03, 7, 2), frame(False, 1, 0x03, 0, 0, bytes.fromhex("FF 80 00 00"))]
    told(run, tmp_path / "a.pcapng", frames, "--plant", plant)
    (line, _) = run("decode", tmp_path / "a.pcapng", "--plant", plant, "--json")[1].splitlines()
    assert '"values": {"power": null}' in line
