"""A capture of a polled line gives the same rows as the recording of that poll."""

from __future__ import annotations

import json
import random
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from captures import decimal, spans, tshark
from commands import Run
from line_driver import MS, LineDriver
from lines import PATIENCE, Faulty, LateWire, line, plant, polled, rows_of, served
from motors import LATEST, fast_drives, real_drives, real_wires
from recordings import recorded

from multidrop.capture import Capture, CaptureWriter, Decoding, FlightRecorder, Side, Tapped
from multidrop.capture import tap as flight
from multidrop.capture.pcapng import WRAPPINGS
from multidrop.capture.tap import AnomalyWatch
from multidrop.cli.poll import tap_text
from multidrop.core import Exchange, Framing, Message, NumberFormat, Peer, Status, Tap
from multidrop.families import InnovertIBD
from multidrop.plant.model import PolledDrive
from multidrop.poller import Poller
from multidrop.polling.batch import Row
from multidrop.recording import RecordingError
from multidrop.sim import EncodedDrive, Simulator, Wire

HOUR_NS = 3600 * 10**9
FATES = Counter({"ok": 300, "no reply": 10, "bad checksum": 5, "bad character": 5, "reply cut short": 5})
NEVER_ON_THE_LINE = {str(each) for each in (Status.NOT_ASKED, Status.LATE_ANSWER_DUE, Status.EXPIRED)}


class RoughWire(LateWire):
    """At random, adds noise around replies, and damages, truncates, loses, doubles or delays replies."""

    def __init__(self, seed: int) -> None:
        super().__init__([EncodedDrive(drive) for drive in fast_drives()], unpaced=True)
        self.chance = random.Random(seed)

    def distort(self, reply: bytes) -> bytes:
        noise = self.chance.randbytes(self.chance.randint(1, 40))
        at = self.chance.randrange(len(reply))
        damaged = reply[:at] + bytes([reply[at] ^ 0x20]) + reply[at + 1 :]
        fates = [reply, noise + reply, reply + noise, damaged, reply[:at], b"", reply + reply, noise]
        fate = self.chance.choices(fates, [70, 8, 5, 5, 3, 3, 3, 3])[0]
        if self.chance.random() < 0.05:
            return self.hold_up(fate, self.chance.uniform(0, LATEST))
        return fate


class EchoingWire(RoughWire):
    """A RoughWire behind an adapter that echoes each request."""

    _echo = b""

    def receive(self, chunk: bytes, now: float, baudrate: int | None = None) -> None:
        self._echo += chunk
        super().receive(chunk, now, baudrate)

    def advance(self, now: float) -> bytes:
        echo, self._echo = self._echo, b""
        return echo + super().advance(now)

    @property
    def wake(self) -> float | None:
        return self._now if self._echo else super().wake


def rough_wires() -> list[Wire]:
    return [RoughWire(1)]


def echoing_wires() -> list[Wire]:
    return [EchoingWire(2)]


def captured(
    capture: Path, make: Callable[[], list[Wire]], drives: list[PolledDrive], enough: Counter[str]
) -> tuple[list[Row], list[Row]]:
    """Poll until `enough` rows of each status; return the polled and the decoded rows."""
    with served(make) as (path,):
        known = plant(line(path, *drives, name="hall-1"))
        poller = Poller(known)
        rows = []
        with CaptureWriter(capture, list(poller.buses)) as writer:
            with Tapped(poller.buses, writer) as tapped, poller:
                for batch in poller.batches(2 * PATIENCE, every=0.05):
                    rows += list(batch)
                    tapped.collect()
                    if Counter(row.status for row in rows) >= enough:
                        break
            rows += rows_of(poller)
            assert tapped.lost == 0
    with Capture(capture) as found:
        decoded = [row for batch in Decoding(found, known) for row in batch]
        assert found.truncated == 0
    return rows, decoded


def by_exchange(rows: list[Row]) -> dict[int, list[tuple[object, ...]]]:
    """Return the sent requests' rows by the time of their request, without monotonic times."""
    found: dict[int, list[tuple[object, ...]]] = {}
    for row in rows:
        if row.status not in NEVER_ON_THE_LINE:
            what = (row.drive, row.register, row.value, row.status, row.uncertainty_ns)
            found.setdefault(row.time_ns, []).append(what)
    return {time: sorted(found[time], key=str) for time in found}


IN_DOUBT_NS = 100_000_000  # longer than any timeout: a reply as late as this may belong to an earlier request


def by_time(rows: list[Row]) -> dict[int, list[tuple[object, ...]]]:
    """Return `by_exchange` without rows whose reply may belong to an earlier request."""
    return by_exchange([row for row in rows if (row.uncertainty_ns or 0) < IN_DOUBT_NS])


def check(rows: list[Row], decoded: list[Row]) -> None:
    """Check that the capture has all exchanges of the poll, except perhaps the last one."""
    recorded = list(by_time(rows).items())
    read = by_exchange(decoded)
    assert [time for time, _ in recorded[:-1] if time not in read] == []
    assert recorded[:-1] == [(time, read[time]) for time, _ in recorded[:-1]]


@dataclass(frozen=True)
class Mixed:
    """A captured poll of drives of all families and variants, at the pace of a real line."""

    drives: list[PolledDrive]
    capture: Path
    rows: list[Row]
    decoded: list[Row]


@pytest.fixture(scope="module")
def mixed(tmp_path_factory: pytest.TempPathFactory) -> Mixed:
    capture = tmp_path_factory.mktemp("mixed") / "a.pcapng"
    drives = [polled(drive, drive.readings()[:4]) for drive in real_drives()]
    return Mixed(drives, capture, *captured(capture, real_wires, drives, Counter(ok=100)))


@pytest.mark.long
@pytest.mark.slow
def test_a_capture_of_all_family_variants_decodes_to_the_polled_rows(mixed: Mixed) -> None:
    check(mixed.rows, mixed.decoded)
    samples = {row.drive for row in mixed.decoded if row.value is not None}
    assert samples == {polled.drive.name for polled in mixed.drives}


@pytest.mark.long
def test_wireshark_decodes_a_capture_of_all_family_variants(mixed: Mixed) -> None:
    """Check address, registers and times of each request to an RTU drive, and the registers of each reply."""
    packets = tshark(mixed.capture)
    by_time = {each["frame.time_epoch"]: (number, each) for number, each in enumerate(packets, 1)}
    replies = {each["modbus.request_frame"]: each for each in packets if each["modbus.request_frame"]}
    drives = {each.drive.name: each.drive for each in mixed.drives}
    checked = set()
    for row in mixed.rows:
        drive = drives[row.drive]
        register = drive.registers[row.register]
        if (row.uncertainty_ns or 0) >= IN_DOUBT_NS:
            continue
        if (
            row.value is None
            or drive.framing is not Framing.RTU
            or register.number_format is not NumberFormat.U16
        ):
            continue
        number, asked = by_time[epoch(row.time_ns)]
        answered = replies[str(number)]
        for packet in (asked, answered):
            assert packet["frame.interface_name"] == "hall-1"
            assert decimal(packet["mbrtu.unit_id"]) == [drive.address]
            assert decimal(packet["modbus.func_code"]) == [register.table.read]
            assert packet["mbrtu.crc16.status"] == "1"
        assert int(asked["frame.packet_flags_direction"], 0) == 2
        assert int(answered["frame.packet_flags_direction"], 0) == 1
        assert answered["frame.time_epoch"] == epoch(row.time_ns + (row.uncertainty_ns or 0))
        (first,), (count,) = decimal(asked["modbus.reference_num"]), decimal(asked["modbus.word_cnt"])
        words = decimal(answered["modbus.regval_uint16"])
        assert len(words) == count
        assert words[register.address - first] * float(register.scale) == pytest.approx(row.value)
        checked.add(row.drive)
    assert len(checked) >= 4


def epoch(time_ns: int) -> str:
    return f"{time_ns // 10**9}.{time_ns % 10**9:09}"


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize(
    "make", [pytest.param(rough_wires, id="rough"), pytest.param(echoing_wires, id="echoing")]
)
def test_capture_of_a_line_with_faults_decodes_to_the_polled_rows(
    tmp_path: Path, make: Callable[[], list[Wire]]
) -> None:
    drives = [polled(drive, drive.readings()) for drive in fast_drives()]
    rows, decoded = captured(tmp_path / "a.pcapng", make, drives, FATES)
    check(rows, decoded)


@pytest.mark.long
def test_wireshark_shows_a_damaged_reply_as_modbus_with_a_bad_checksum(tmp_path: Path) -> None:
    frame = bytes.fromhex("01 03 02 13 88 B5 13")
    with CaptureWriter(tmp_path / "a.pcapng", ["hall-1"]) as capture:
        for side in (Side.FAILED, Side.NOISE):
            capture.write(frame, side, 1, "hall-1")
    failed, noise = tshark(tmp_path / "a.pcapng")
    assert (failed["mbrtu.unit_id"], failed["mbrtu.crc16.status"]) == ("1", "0")
    assert noise["data.data"] == frame.hex()


ASK = Message(1, 3, 2, 1)
GOOD = bytes.fromhex("01 03 02 13 88 B5 12")  # Delixi, part 2


def new_peer() -> Peer:
    return Peer(least_timeout=0.02, most_timeout=0.2)


def asking(peer: Peer | None = None) -> Exchange:
    """Return an exchange that sends the request ASK on a line at 9600 baud."""
    return Exchange(
        Framing.RTU, ASK, peer or new_peer(), baudrate=9600, format="8N1", character=1e-3, silence=4e-3
    )


def test_bytes_lost_due_to_a_full_capture_buffer_are_counted() -> None:
    """Noise fills the tap's buffer until 4000 bytes are lost."""
    driver, tap, told = LineDriver(), Tap(), 0
    driver.begin(asking())
    driver._line.tap = tap.c
    while not tap.lost:
        driver.receive(b"\xff" * 4000)
        told += 4000
    assert tap.lost == 4000
    packets = b"".join(tap.take(WRAPPINGS, 0, 0))
    assert packets.count(b"\xff" * 4000) == told // 4000 - 1
    assert list(tap.take(WRAPPINGS, 0, 0)) == []
    assert list(tap_text({"untapped_bytes": tap.lost})) == [
        "4000 bytes not captured: this machine was too slow"
    ]


def test_capture_contains_noise_before_and_after_a_reply() -> None:
    """The noise before the reply is longer than the line's buffer."""
    driver, tap = LineDriver(), Tap()
    driver.begin(asking())
    driver._line.tap = tap.c
    driver.wait_until_write()
    driver.receive(b"\xff" * 950)
    driver.receive(GOOD + b"\xfe" * 400)
    assert driver.completion.raw == GOOD
    packets = b"".join(tap.take(WRAPPINGS, 0, 0))
    assert (packets.count(b"\xff"), packets.count(b"\xfe")) == (950, 400)


def times_of(packets: bytes) -> list[int]:
    """Return the time stamps of enhanced packet blocks."""
    found = []
    while packets:
        _, size, _, high, low = struct.unpack_from("<5I", packets)
        found.append(high << 32 | low)
        packets = packets[size:]
    return found


def test_captured_frames_have_correct_times_after_clock_changes() -> None:
    driver, tap, peer = LineDriver(), Tap(), new_peer()
    asked = []
    driver._line.tap = tap.c
    for ahead_ns in (HOUR_NS, 3 * HOUR_NS):
        driver.begin(asking(peer))
        driver.found.utc_ahead_ns = ahead_ns
        driver.wait_until_write()
        asked.append(driver.found.sent_ns + ahead_ns)
        driver.now += 5 * MS
        driver.receive(GOOD)
        assert driver.completion.raw == GOOD
        asked.append(driver.found.first_ns + ahead_ns)
    driver.now += 5 * MS
    driver.receive(b"\xff")  # a byte outside of any exchange
    found = times_of(b"".join(tap.take(WRAPPINGS, 0, 5 * HOUR_NS)))
    assert found == [*asked, driver.now + 5 * HOUR_NS]


class Flight:
    """A flight recorder on a clock that the test sets."""

    def __init__(self, directory: Path, monkeypatch: pytest.MonkeyPatch, **details: Any) -> None:
        self.seconds = 1000.0
        monkeypatch.setattr(flight, "now_ns", lambda: round(self.seconds * 1e9))
        monkeypatch.setattr(flight, "utc_minus_monotonic_ns", lambda: 1_700_000_000 * 10**9)
        self.recorder = FlightRecorder(directory, ["hall-1"], **details)

    def pass_(self, seconds: float, *troubles: str) -> None:
        """Let `seconds` s pass with one byte per second on the line, then report the anomalies `troubles`."""
        for _ in range(round(seconds)):
            self.seconds += 1
            time_ns = round(self.seconds * 1e9)
            self.recorder.append(WRAPPINGS.packet(0, Side.NOISE, time_ns, bytes([round(self.seconds) % 256])))
            self.recorder.report([])
        self.recorder.report(list(troubles))


def seconds_in(path: Path) -> list[int]:
    (found,) = spans(path).values()
    return [span.time_ns // 10**9 for span in found]


def test_flight_recorder_saves_traffic_around_an_anomaly(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one_flight = Flight(tmp_path / "flights", monkeypatch, seconds=20)
    one_flight.pass_(50)
    assert one_flight.recorder.written == []
    one_flight.pass_(
        0, "hall-1: pump-1: bad checksum", "hall-1: pump-1: bad checksum", "hall-1: pump-2: fell silent"
    )
    one_flight.pass_(10)
    (path,) = one_flight.recorder.written
    assert path == tmp_path / "flights" / "flight-20231114T223052Z.pcapng"
    assert seconds_in(path) == list(range(1032, 1053))
    assert b"hall-1: pump-1: bad checksum; hall-1: pump-2: fell silent\0" in path.read_bytes()[:200]


def test_flight_recorders_write_different_files_in_the_same_second(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for _ in range(2):
        one_flight = Flight(tmp_path, monkeypatch)  # the clocks of both recorders start at the same time
        one_flight.pass_(10, "hall-1: pump-1: bad checksum")
        one_flight.pass_(5)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "flight-20231114T223012Z.pcapng",
        "flight-20231114T223013Z.pcapng",
    ]


def test_flight_recorder_keeps_at_most_the_allowed_number_of_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one_flight = Flight(tmp_path, monkeypatch, seconds=20, most_files=3)
    (tmp_path / "flight-plan.pcapng").touch()  # a user's own file
    for _ in range(600):
        one_flight.pass_(1, "hall-1: pump-1: bad checksum")
    assert len(one_flight.recorder.written) == 10
    assert sorted(tmp_path.iterdir()) == sorted(
        [tmp_path / "flight-plan.pcapng", *one_flight.recorder.written[-3:]]
    )


@pytest.mark.parametrize("most_files", [0, -1])
def test_flight_recorder_refuses_a_file_limit_below_one(tmp_path: Path, most_files: int) -> None:
    with pytest.raises(ValueError, match=f"most_files = {most_files} is not 1 or more"):
        FlightRecorder(tmp_path, ["hall-1"], most_files=most_files)


def test_flight_recorder_limits_its_buffered_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one_flight = Flight(tmp_path, monkeypatch, most_bytes=1000)
    one_flight.pass_(200, "hall-1: the port was lost")
    one_flight.recorder.close()
    (path,) = one_flight.recorder.written
    assert 800 < path.stat().st_size < 1300
    seconds = seconds_in(path)
    assert seconds == list(range(seconds[0], 1201))


def test_closing_a_flight_recorder_writes_the_pending_anomaly(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one_flight = Flight(tmp_path, monkeypatch)
    one_flight.pass_(3)
    one_flight.recorder.close()
    assert one_flight.recorder.written == []
    one_flight.pass_(3, "hall-1: the port was lost")
    one_flight.recorder.close()
    assert [seconds_in(path) for path in one_flight.recorder.written] == [list(range(1001, 1007))]


def test_flight_recorder_in_an_unwritable_directory_raises_recording_error(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(RecordingError, match="cannot be written"):
        FlightRecorder(tmp_path / "file" / "flights", [])


class Watched:
    """A drive, its line with a clock that the test sets, and the line's AnomalyWatch."""

    def __init__(self) -> None:
        self.line = LineDriver()
        peer = new_peer()
        self._exchange = asking(peer)
        self.port: Any = SimpleNamespace(lost=False)
        pump: Any = SimpleNamespace(name="pump-1")
        bus: Any = SimpleNamespace(line=self, drives=[pump], peer=lambda drive: peer)
        self.watch = AnomalyWatch("hall-1", bus)

    @property
    def queue(self) -> Any:
        return self.port

    def told(self, reply: bytes) -> list[str]:
        """Carry out an exchange with this reply, when no late reply can come; return its anomalies."""
        self.line.now += 1000 * MS
        self.line.begin(self._exchange)
        self.line.wait_until_write()
        self.line.now += 20 * MS
        self.line.receive(reply)
        self.line.wait_until_done()
        return list(self.watch.check())


def test_damaged_and_late_replies_are_reported_as_anomalies() -> None:
    pump = Watched()
    assert pump.told(GOOD) == []
    assert pump.told(GOOD[:-1]) == ["hall-1: pump-1: reply cut short"]
    assert pump.told(GOOD[:-1] + b"\0") == ["hall-1: pump-1: bad checksum"]
    assert pump.told(GOOD[:-1] + b"\0") == ["hall-1: pump-1: bad checksum"]
    assert pump.told(bytes.fromhex("01 83 03 01 31")) == []  # an exception reply is not an anomaly
    assert list(pump.watch.check()) == []
    assert pump.told(b"") == []
    pump.line.receive(GOOD)
    assert pump.told(GOOD) == ["hall-1: pump-1: late reply"]


def test_drive_causes_one_anomaly_when_replies_stop() -> None:
    pump = Watched()
    assert [pump.told(b"") for _ in range(5)] == [[]] * 5  # no anomaly: the drive has never answered
    assert pump.told(GOOD) == []
    assert [pump.told(b"") for _ in range(5)] == [[], [], ["hall-1: pump-1: fell silent"], [], []]
    assert pump.told(GOOD) == []


def test_a_lost_port_causes_one_anomaly() -> None:
    pump = Watched()
    open_port = pump.port
    for lost in (SimpleNamespace(lost=True), None):
        pump.port = lost
        assert list(pump.watch.check()) == ["hall-1: the port was lost"]
        assert list(pump.watch.check()) == []
        pump.port = open_port
        assert list(pump.watch.check()) == []


@pytest.mark.slow
def test_the_command_poll_writes_a_capture(tmp_path: Path, run: Run, mixed_plant: Path) -> None:
    capture = tmp_path / "a.pcapng"
    words = ["poll", mixed_plant, "--seconds", 1, "--capture", capture]
    status, out, err = run(*words, "--out", tmp_path / "polled.csv")
    assert (status, err) == (0, "")
    assert out.splitlines()[-1] == f"captured in {capture}"
    assert run("decode", capture, "--plant", mixed_plant, "--out", tmp_path / "decoded.csv")[0] == 0
    check(recorded(tmp_path / "polled.csv"), recorded(tmp_path / "decoded.csv"))
    assert run(*words) == (
        2,
        "",
        f"multidrop: {capture} exists already: name another file, or remove it first\n",
    )
    assert run("poll", mixed_plant, "--flight-recorder", capture)[::2] == (
        2,
        f"multidrop: --flight-recorder {capture} is a file: name a directory\n",
    )
    assert run("poll", mixed_plant, "--capture", "a.csv")[::2] == (
        2,
        "multidrop: a.csv: a capture's name must end in .pcapng\n",
    )


@pytest.mark.slow
def test_the_flight_recorder_saves_a_capture_when_a_drive_s_replies_are_damaged(
    tmp_path: Path, run: Run, mixed_plant: Path, wire: Faulty
) -> None:
    wire.fate = lambda reply: reply[:-1] + bytes([reply[-1] ^ 1])
    flights = tmp_path / "flights"
    status, out, _ = run("poll", mixed_plant, "--seconds", 1, "--flight-recorder", flights, "--json")
    assert status == 1
    (path,) = json.loads(out)["flight_recordings"]
    assert [Path(path)] == list(flights.iterdir())
    assert b"hall-1: pump-1: bad checksum" in Path(path).read_bytes()[:300]
    assert "unknown: 01 03" in run("decode", path)[1]


@pytest.fixture
def wire() -> Iterator[Faulty]:
    faulty = Faulty([EncodedDrive(InnovertIBD(1))], lambda reply: reply, unpaced=True)
    with Simulator([faulty]):
        yield faulty


@pytest.fixture
def mixed_plant(tmp_path: Path, wire: Faulty) -> Path:
    path = tmp_path / "plant.toml"
    drive = 'name = "pump-1"\nmodel = "innovert-ibd"\naddress = 1\n'
    path.write_text(f'[[line]]\nname = "hall-1"\nport = "{wire.path}"\n[[line.drive]]\n{drive}')
    return path
