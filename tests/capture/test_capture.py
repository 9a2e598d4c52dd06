"""Captures: ours as Wireshark takes them, others' as we take them."""

from __future__ import annotations

import struct
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import checksums
import pytest
from disks import full_at
from frames import PRINTED, Printed
from peers import require_program

from multidrop.capture import Capture, CaptureError, CaptureWriter, Decoding, Side
from multidrop.core import (
    STREAM_ROOM,
    FrameSpan,
    Framing,
    Kind,
    Message,
    Splitter,
    Unpacker,
    build_reply,
    build_request,
)
from multidrop.plant.loader import load_plant
from multidrop.plant.model import Plant
from multidrop.polling.batch import Row
from multidrop.recording import RecordingError

RTU = [
    it
    for it in PRINTED
    if it.request is not None and isinstance(it.says, Message) and it.framing is Framing.RTU
]
READ = bytes.fromhex("01 03 00 16 00 01 65 CE")
TEXT = [it for it in PRINTED if it.request is not None and it.framing is not Framing.RTU]
BEGIN = 1_700_000_000_123_456_789
STEP = 5_000_001  # ns between two frames


def write(path: Path, exchanges: Iterable[Printed], line: str = "hall-1") -> Path:
    with CaptureWriter(path) as capture:
        time = BEGIN
        for it in exchanges:
            capture.write(it.request_frame, Side.ASKING, time, line)
            capture.write(it.frame, Side.ANSWERING, time + STEP, line)
            time += 2 * STEP
    return path


def spans(path: Path) -> dict[str, list[FrameSpan]]:
    """What a capture holds, by line."""
    found: dict[str, list[FrameSpan]] = {}
    splitters: dict[str, Splitter] = {}
    with Capture(path) as capture:
        for _ in capture:
            for name, heard in zip(capture.lines, capture.streams, strict=True):
                splitter = splitters.setdefault(name, Splitter())
                found.setdefault(name, []).extend(splitter.spans(heard))
    return found


def rows(path: Path, plant: Plant | None = None) -> list[Row]:
    with Capture(path) as capture:
        return [row for batch in Decoding(capture, plant) for row in batch]


# ---- Wireshark reads ours ----

FIELDS = (
    *("frame.interface_name", "frame.time_epoch", "frame.packet_flags_direction"),
    *("mbrtu.unit_id", "modbus.func_code", "modbus.exception_code", "modbus.reference_num"),
    *("modbus.word_cnt", "modbus.bit_cnt", "modbus.regval_uint16", "modbus.data", "mbrtu.crc16.status"),
    *("modbus.request_frame", "data.data"),
)


def tshark(path: Path) -> list[dict[str, str]]:
    options = ["-o", "mbrtu.tcp.port:502", "-o", "mbrtu.crc_verification:TRUE"]
    fields = [word for field in FIELDS for word in ("-e", field)]
    done = subprocess.run(
        [require_program("tshark"), "-n", "-r", path, *options, "-T", "fields", "-E", "separator=|", *fields],
        capture_output=True,
        text=True,
        check=True,
    )
    return [dict(zip(FIELDS, line.split("|"), strict=True)) for line in done.stdout.splitlines()]


def decimal(text: str) -> list[int]:
    return [int(number) for number in text.split(",")]


def registers(data: bytes) -> list[int]:
    return list(struct.unpack(f">{len(data) // 2}H", data))


def test_wireshark_decodes_every_printed_exchange(tmp_path: Path) -> None:
    packets = tshark(write(tmp_path / "a.pcapng", RTU))
    assert len(packets) == 2 * len(RTU) > 20
    for number, packet in enumerate(packets):
        exchange, is_reply = RTU[number // 2], number % 2
        message = exchange.says if is_reply else exchange.request
        assert isinstance(message, Message)
        time = BEGIN + number * STEP
        assert packet["frame.time_epoch"] == f"{time // 10**9}.{time % 10**9:09}"
        assert packet["frame.interface_name"] == "hall-1"
        assert int(packet["frame.packet_flags_direction"], 0) == (1 if is_reply else 2)
        assert decimal(packet["mbrtu.unit_id"]) == [message.address]
        raw_function = (exchange.frame if is_reply else exchange.request_frame)[1]
        assert decimal(packet["modbus.func_code"]) == [raw_function & 0x7F]
        assert packet["mbrtu.crc16.status"] == "1"
        if message.exception:
            assert decimal(packet["modbus.exception_code"]) == [message.exception]
            continue
        if message.function in (5, 6) or not is_reply:
            is_loopback = message.function == 8
            assert is_loopback or decimal(packet["modbus.reference_num"]) == [message.start]
        if message.function in (5, 6):
            assert packet["modbus.data"] == message.data.hex()
        elif message.function in (3, 4, 16) and (is_reply or message.function == 16) and message.data:
            assert decimal(packet["modbus.regval_uint16"]) == registers(message.data)
        elif message.function in (3, 4, 16):
            assert decimal(packet["modbus.word_cnt"]) == [message.count]
        if is_reply and message.function != 8 and raw_function < 0x80:
            assert packet["modbus.request_frame"] == str(number)


def test_wireshark_sees_a_bad_checksum(tmp_path: Path) -> None:
    bad = next(it for it in PRINTED if it.verdict == "bad checksum")
    with CaptureWriter(tmp_path / "a.pcapng") as capture:
        capture.write(bad.frame, Side.ASKING, BEGIN, "hall-1")
    assert tshark(tmp_path / "a.pcapng")[0]["mbrtu.crc16.status"] == "0"


def test_wireshark_shows_ascii_and_delixi_frames_as_they_are(tmp_path: Path) -> None:
    packets = tshark(write(tmp_path / "a.pcapng", TEXT))
    frames = [frame.hex() for it in TEXT for frame in (it.request_frame, it.frame)]
    assert [packet["data.data"] for packet in packets] == frames
    assert {packet["modbus.func_code"] for packet in packets} == {""}


def test_a_line_is_an_interface_with_its_name(tmp_path: Path) -> None:
    with CaptureWriter(tmp_path / "a.pcapng") as capture:
        for number, line in enumerate(("hall-1", "Halle zwei", "hall-1")):
            capture.write(RTU[0].frame, Side.ANSWERING, BEGIN + number, line)
    names = [packet["frame.interface_name"] for packet in tshark(tmp_path / "a.pcapng")]
    assert names == ["hall-1", "Halle zwei", "hall-1"]
    assert {line: len(it) for line, it in spans(tmp_path / "a.pcapng").items()} == {
        "hall-1": 2,
        "Halle zwei": 1,
    }


# ---- we read ours, and others' ----


def test_what_was_written_is_read(tmp_path: Path) -> None:
    exchanges = [*RTU, *TEXT]
    (found,) = spans(write(tmp_path / "a.pcapng", exchanges)).values()
    assert [(span.kind, span.time_ns, span.raw) for span in found] == [
        (kind, BEGIN + (2 * number + after) * STEP, frame)
        for number, it in enumerate(exchanges)
        for kind, after, frame in ((Kind.REQUEST, 0, it.request_frame), (Kind.REPLY, 1, it.frame))
    ]


def test_junk_is_read_as_junk(tmp_path: Path) -> None:
    with CaptureWriter(tmp_path / "a.pcapng") as capture:
        capture.write(b"\xff\x00\xff", Side.EITHER, BEGIN, "hall-1")
        capture.write(RTU[0].frame[:-1], Side.ANSWERING, BEGIN, "hall-1")
    (found,) = spans(tmp_path / "a.pcapng").values()
    assert {span.kind for span in found} == {Kind.JUNK}
    assert b"".join(span.raw for span in found) == b"\xff\x00\xff" + RTU[0].frame[:-1]


def hexdump(packets: Iterable[bytes]) -> str:
    """What text2pcap reads: one packet a line, each a millisecond after the other."""
    return "".join(
        f"2026-11-21T09:30:00.{number:03}Z 0000 {packet.hex(' ')}\n" for number, packet in enumerate(packets)
    )


@pytest.mark.parametrize("format", ["pcap", "pcapng", "nsecpcap"])
@pytest.mark.parametrize("link", [147, 162, 250])
def test_captures_that_wireshark_s_tools_wrote_are_read(tmp_path: Path, format: str, link: int) -> None:
    frames = [frame for it in (*RTU, *TEXT) for frame in (it.request_frame, it.frame)]
    rtac = struct.pack(">IIBBH", 0, 0, 2, 0, 0) if link == 250 else b""
    path = tmp_path / f"other.{format}"
    subprocess.run(
        [require_program("text2pcap"), "-q", "-F", format, "-l", str(link), "-t", "ISO", "-", path],
        input=hexdump(rtac + frame for frame in frames),
        text=True,
        check=True,
        capture_output=True,
    )
    (found,) = spans(path).values()
    assert [span.raw for span in found] == frames
    assert [span.kind for span in found] == [Kind.REQUEST, Kind.REPLY] * (len(frames) // 2)
    first = 1_795_253_400 * 10**9
    assert [span.time_ns for span in found] == [first + n * 10**6 for n in range(len(frames))]


def test_a_frame_may_lie_in_several_packets_and_several_in_one(tmp_path: Path) -> None:
    frames = b"".join(it.request_frame + it.frame for it in RTU)
    packets = [frames[at : at + 7] for at in range(0, len(frames), 7)]
    header = struct.pack(">IHHiIII", 0xA1B23C4D, 2, 4, 0, 0, 65535, 147)  # big-endian, ns
    path = tmp_path / "a.pcap"
    path.write_bytes(header + b"".join(struct.pack(">IIII", 1, 5, len(it), len(it)) + it for it in packets))
    (found,) = spans(path).values()
    assert b"".join(span.raw for span in found) == frames
    assert {span.kind for span in found[1:]} <= {Kind.REQUEST, Kind.REPLY, Kind.EITHER}
    assert {span.time_ns for span in found} == {10**9 + 5}


@pytest.mark.parametrize(
    ("resolution", "time_ns"),
    [(b"\x09", 5_000_007), (b"\x06", 5_000_007_000), (b"\x03", 5_000_007_000_000), (b"\x94", 4_768_378_257)],
    ids=["ns", "us", "ms", "2^-20 s"],
)
def test_a_clock_of_any_resolution_is_read(tmp_path: Path, resolution: bytes, time_ns: int) -> None:
    path = tmp_path / "a.pcapng"
    with CaptureWriter(path) as capture:
        capture.write(RTU[0].frame, Side.ANSWERING, 5_000_007, "hall-1")
    option = b"\x09\0\x01\0"
    path.write_bytes(path.read_bytes().replace(option + b"\x09", option + resolution))
    (found,) = spans(path).values()
    assert [span.time_ns for span in found] == [time_ns]


# ---- what is no capture ----


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"", "is not a capture: it is empty"),
        (b"hello, world", "is not a capture: it does not begin like pcap or pcapng"),
        (b"\xd4\xc3\xb2\xa1\x02\0", "is not a capture: it ends within its header"),
        (b"\x0a\x0d\x0d\x0a\x1c\0", "is not a capture: it ends within its header"),
        (
            struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1),
            "a is Ethernet (link type 1), not a serial line",
        ),
        (
            struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 147) + b"\xff" * 40,
            "is damaged: what begins at byte 24 is no packet",
        ),
    ],
)
def test_what_is_no_capture_of_a_line_is_told_in_a_sentence(
    tmp_path: Path, content: bytes, sentence: str
) -> None:
    path = tmp_path / "a.pcap"
    path.write_bytes(content)
    with pytest.raises(CaptureError) as mistake:
        spans(path)
    assert str(mistake.value).startswith(str(path))
    assert str(mistake.value).endswith(sentence)
    assert "\n" not in str(mistake.value)


def described(*options: tuple[int, bytes]) -> bytes:
    """A pcapng file with one interface, described so, and no packet."""
    told = b"".join(
        struct.pack("<HH", code, len(value)) + value + bytes(-len(value) % 4) for code, value in options
    )
    interface = struct.pack("<HHI", 147, 0, 0) + told
    size = len(interface) + 12
    section = struct.pack("<IIIHHqI", 0x0A0D0D0A, 28, 0x1A2B3C4D, 1, 0, -1, 28)
    return section + struct.pack("<II", 1, size) + interface + struct.pack("<I", size)


def test_a_resolution_that_says_nothing_is_the_usual_one(tmp_path: Path) -> None:
    (tmp_path / "a.pcapng").write_bytes(described((9, b"")))
    assert spans(tmp_path / "a.pcapng") == {"a-0": []}


def test_a_clock_that_is_off_by_ages_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.pcapng").write_bytes(described((14, struct.pack("<q", 1 << 40))))
    with pytest.raises(CaptureError, match=r"byte 28: its clock is 1099511627776 s off"):
        spans(tmp_path / "a.pcapng")


def block(kind: int, body: bytes) -> bytes:
    return struct.pack("<II", kind, len(body) + 12) + body + struct.pack("<I", len(body) + 12)


def packet(interface: int, content: bytes, told: int | None = None) -> bytes:
    """An enhanced packet block; `told` is its length as it says itself."""
    length = len(content) if told is None else told
    return block(6, struct.pack("<5I", interface, 0, 0, length, length) + content + bytes(-len(content) % 4))


NO_PACKET = " is damaged: what begins at byte 48 is no packet"
SECTION, INTERFACE = described()[:28], described()[28:]
BIG_ENDIAN_SECTION = struct.pack(">IIIHHqI", 0x0A0D0D0A, 28, 0x1A2B3C4D, 1, 0, -1, 28)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (SECTION[:8] + b"\xde\xad\xbe\xef" + SECTION[12:], " is damaged: what begins at byte 0 is no packet"),
        (SECTION + struct.pack("<III", 1, 7, 7), " is damaged: what begins at byte 28 is no packet"),
        (SECTION + block(1, bytes(4)), " is damaged: what begins at byte 28 is no packet"),
        (described((9, b"\x0a")), ": byte 28: its clock is finer than a nanosecond"),
        (described() + packet(1, READ), NO_PACKET),  # of an interface that is not there
        (described() + packet(0, READ, told=9), NO_PACKET),  # longer than its block
        (described() + packet(0, READ)[:-4] + bytes(4), NO_PACKET),  # its two lengths differ
        (described() + SECTION, ": byte 48: only the first section can be read"),
        (described() + BIG_ENDIAN_SECTION, ": byte 48: sections of both byte orders cannot be read"),
        (
            SECTION + block(3, bytes(8)),
            ": byte 28: packets without time or of the old kind cannot be read; "
            "`editcap` turns them into enhanced ones",
        ),
        (
            SECTION + INTERFACE * (Unpacker.MOST_CHANNELS + 1),
            f": more than {Unpacker.MOST_CHANNELS} interfaces",
        ),
    ],
)
def test_a_pcapng_file_that_cannot_be_read_is_told_in_a_sentence(
    tmp_path: Path, content: bytes, sentence: str
) -> None:
    path = tmp_path / "a.pcapng"
    path.write_bytes(content)
    with pytest.raises(CaptureError) as mistake:
        spans(path)
    assert str(mistake.value) == f"{path}{sentence}"


def test_a_capture_that_is_cut_within_a_description_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    path = tmp_path / "a.pcapng"
    path.write_bytes(described()[:-6])
    with Capture(path) as capture:
        assert list(capture) == [None]
        assert (capture.lines, capture.torn) == ([], 14)


@pytest.mark.parametrize(
    "tags", [b"\0\x0c\0\x05mb", b"\0\x0c\0\x05mbrtu", b"\0\x0c\xff\xff", b"\0\0\0\0", b"\0"]
)
def test_a_packet_that_ends_within_its_tags_holds_nothing(tmp_path: Path, tags: bytes) -> None:
    """A frame that somebody exported begins behind tags that say what it is; here none does."""
    path = tmp_path / "a.pcapng"
    interface = block(1, struct.pack("<HHI", 252, 0, 0))
    path.write_bytes(SECTION + interface + packet(0, tags) + packet(0, b"\0\0\0\0" + READ))
    (found,) = spans(path).values()
    assert [span.raw for span in found] == [READ]


@pytest.mark.parametrize(("content", "count"), [(READ, 33_000), (b"\xff" * 700, STREAM_ROOM // 700 + 1)])
@pytest.mark.parametrize("format", ["pcapng", "pcap"])
def test_a_capture_may_hold_more_than_is_heard_at_once(
    tmp_path: Path, format: str, content: bytes, count: int
) -> None:
    """More packets than there is room for, or more bytes."""
    path = tmp_path / f"a.{format}"
    if format == "pcapng":
        path.write_bytes(described() + packet(0, content) * count)
    else:
        header = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 147)
        path.write_bytes(header + (struct.pack("<IIII", 1, 0, len(content), len(content)) + content) * count)
    (found,) = spans(path).values()
    assert b"".join(span.raw for span in found) == content * count
    assert {span.kind for span in found} == {Kind.REQUEST if content == READ else Kind.JUNK}


@pytest.mark.parametrize("format", ["pcapng", "pcap"])
def test_a_cut_capture_is_read_as_far_as_it_goes(tmp_path: Path, format: str) -> None:
    path = write(tmp_path / "a.pcapng", RTU)
    if format == "pcap":
        whole = tmp_path / "a.pcap"
        subprocess.run([require_program("editcap"), "-F", "nsecpcap", path, whole], check=True)
        path = whole
    content, read = path.read_bytes(), []
    for cut in range(1, len(content) - 60, 97):
        path.write_bytes(content[: len(content) - cut])
        with Capture(path) as capture:
            read.append(sum(map(len, Decoding(capture))))
            assert capture.torn < 300
    assert read == sorted(read, reverse=True)
    assert read[0] > read[-1] == 0


# ---- what cannot be written ----


def test_a_capture_that_finds_no_room_is_told_in_a_sentence(tmp_path: Path) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("needs /dev/full")
    path = tmp_path / "a.pcapng"
    path.symlink_to("/dev/full")
    files = sorted(Path("/proc/self/fd").iterdir())
    with pytest.raises(RecordingError) as failure:
        CaptureWriter(path, ["hall-1"])
    assert str(failure.value) == f"{path}: cannot be written: No space left on device"
    assert sorted(Path("/proc/self/fd").iterdir()) == files


def test_a_capture_in_a_directory_that_is_not_there_is_told_in_a_sentence(tmp_path: Path) -> None:
    path = tmp_path / "none" / "a.pcapng"
    with pytest.raises(RecordingError) as failure:
        CaptureWriter(path)
    assert str(failure.value) == f"{path}: cannot be written: No such file or directory"


def test_a_disk_that_becomes_full_leaves_whole_packets(tmp_path: Path) -> None:
    path = tmp_path / "a.pcapng"
    with CaptureWriter(path) as capture:
        capture.write(READ, Side.ASKING, BEGIN, "hall-1")
        with full_at(path.stat().st_size + 50), pytest.raises(RecordingError, match="File too large"):
            capture.write(READ, Side.ASKING, BEGIN + STEP, "hall-1")
        capture.write(READ, Side.ASKING, BEGIN + 2 * STEP, "hall-1")
    (found,) = spans(path).values()
    assert [span.time_ns for span in found] == [BEGIN, BEGIN + 2 * STEP]


# ---- columns ----

PLANT = """
[[line]]
name = "hall-1"
port = "/dev/ttyUSB0"
[[line.drive]]
name = "pump"
model = "{}"
address = 1
framing = "{}"
"""


def plant(directory: Path, model: str, framing: str) -> Plant:
    path = directory / "plant.toml"
    path.write_text(PLANT.format(model, framing))
    return load_plant(path)


EXCHANGES = [  # model, framing, the printed request and its reply, what that says
    ("innovert-ibd", "rtu", "01 06 20 01 13 88 DE 9C", "frequency", 50),
    ("innovert-ibd", "rtu", "01 06 00 6B 00 C8 F9 80", "acceleration_time", 20),
    ("innovert-ibd", "ascii", "0106200113883D", "frequency", 50),
    ("delixi-modbus", "rtu", "01 03 01 F4 00 01 C4 04", "output_frequency", 50),
    ("delixi-modbus", "ascii", "010301F4000106", "output_frequency", 50),
    ("delixi-native", "delixi", "010701F400000000FD", "output_frequency", 50),
    ("delixi-native", "delixi", "010200020000000005", "control", 2),
    ("delixi-native", "delixi", "0104000100001388A1", "frequency", 50),
    ("delixi-native", "delixi", "0106000200001388A4", "stored_frequency", 50),
]


@pytest.mark.parametrize(("model", "framing", "request_", "register", "value"), EXCHANGES)
def test_an_exchange_is_a_row_in_engineering_units(
    tmp_path: Path, model: str, framing: str, request_: str, register: str, value: float
) -> None:
    texts = (request_, f":{request_}\\r\\n")
    exchange = next(it for it in (*RTU, *TEXT) if _text(it.request_frame) in texts)
    path = write(tmp_path / "a.pcapng", [exchange])
    (row,) = rows(path, plant(tmp_path, model, framing))
    assert row == Row(BEGIN, BEGIN, STEP, "pump", register, value, "ok")


def _text(frame: bytes) -> str:
    return frame.decode().replace("\r\n", "\\r\\n") if frame[:1] == b":" else frame.hex(" ").upper()


def test_several_registers_are_a_row_each(tmp_path: Path) -> None:
    exchange = next(it for it in RTU if _text(it.request_frame) == "01 10 00 0C 00 02 04 00 C8 01 90 73 F8")
    found = rows(write(tmp_path / "a.pcapng", [exchange]), plant(tmp_path, "erman-er-g-220", "rtu"))
    assert [(row.register, row.value) for row in found] == [
        ("acceleration_time", 20),
        ("deceleration_time", 40),
    ]


def test_without_a_plant_rows_are_raw_registers(tmp_path: Path) -> None:
    exchange = next(it for it in RTU if _text(it.frame) == "01 03 08 01 00 01 F4 01 F4 00 32 25 C4")
    found = rows(write(tmp_path / "a.pcapng", [exchange]))
    assert [(row.drive, row.register, row.value) for row in found] == [
        ("address 1", f"holding_register_{1 + at}", value) for at, value in enumerate((256, 500, 500, 50))
    ]


def test_a_refusal_is_a_miss_with_its_code(tmp_path: Path) -> None:
    exchange = next(it for it in RTU if _text(it.frame) == "01 83 03 01 31")
    found = rows(write(tmp_path / "a.pcapng", [exchange]))
    assert {(row.value, row.status) for row in found} == {(None, "exception 03")}


def test_a_request_without_a_reply_is_a_miss_with_its_reason(tmp_path: Path) -> None:
    exchange = next(it for it in RTU if _text(it.frame) == "01 03 02 13 88 B5 12")
    with CaptureWriter(tmp_path / "a.pcapng") as capture:
        capture.write(exchange.request_frame, Side.ASKING, 1, "hall-1")
        capture.write(exchange.request_frame, Side.ASKING, 2, "hall-1")
        capture.write(exchange.frame[:-1] + b"\0", Side.ANSWERING, 3, "hall-1")
        capture.write(exchange.request_frame, Side.ASKING, 4, "hall-1")
        capture.write(exchange.frame, Side.ANSWERING, 6, "hall-1")
    assert [(row.time, row.uncertainty_ns, row.value, row.status) for row in rows(tmp_path / "a.pcapng")] == [
        (1, None, None, "no reply"),
        (2, None, None, "bad checksum"),
        (4, 2, 5000, "ok"),
    ]


def test_more_names_than_a_batch_can_hold_are_more_batches(tmp_path: Path) -> None:
    """Every register of one table, and then of another."""
    with CaptureWriter(tmp_path / "a.pcapng") as capture:
        for function in (3, 4):
            for start in range(0, 65500, 100):
                asked = Message(1, function, start, 100)
                reply = Message(1, function, start, 100, struct.pack(">100H", *range(start, start + 100)))
                capture.write(build_request(Framing.RTU, asked), Side.ASKING, start, "hall-1")
                capture.write(build_reply(Framing.RTU, reply), Side.ANSWERING, start + 1, "hall-1")
    found = rows(tmp_path / "a.pcapng")
    assert [(row.register, row.value) for row in found] == [
        (f"{table}_register_{at}", at) for table in ("holding", "input") for at in range(65500)
    ]


def frames_of(path: Path, exchanges: Iterable[tuple[Message, Message | None]]) -> Path:
    """A capture of them, one in every 2 ns."""
    with CaptureWriter(path) as capture:
        for number, (asked, reply) in enumerate(exchanges):
            capture.write(build_request(Framing.RTU, asked), Side.ASKING, 2 * number, "hall-1")
            if reply:
                capture.write(build_reply(Framing.RTU, reply), Side.ANSWERING, 2 * number + 1, "hall-1")
    return path


@pytest.mark.parametrize(("data", "end"), [(b"\0\7", (7, "ok")), (b"", (None, "no reply"))])
def test_more_requests_than_are_remembered_are_decoded_all_the_same(
    tmp_path: Path, data: bytes, end: tuple[float | None, str]
) -> None:
    """Of 16384 places three quarters are taken; long before, two requests come to want the same."""
    asked = [Message(1 + number % 2, 3, number // 2, 1) for number in range(13_000)]
    replies = (Message(it.address, 3, it.start, 1, data) if data else None for it in asked)
    path = frames_of(tmp_path / "a.pcapng", zip(asked, replies, strict=True))
    told = asked if data else asked[:-1]  # nobody knows whether the last one was answered
    assert [(row.drive, row.register, row.value, row.status) for row in rows(path)] == [
        (f"address {it.address}", f"holding_register_{it.start}", *end) for it in told
    ]


def test_a_request_for_more_than_a_reply_can_hold_is_rows_of_what_it_can(tmp_path: Path) -> None:
    """Noise or a mistaken master asks for all there is, of every kind."""
    path = tmp_path / "a.pcapng"
    with CaptureWriter(path) as capture:
        for time, function in enumerate((3, 4, 1, 2, 3)):
            capture.write(checksums.rtu(f"01 {function:02X} 00 00 FF FF"), Side.ASKING, time, "hall-1")
    assert [(row.register, row.status) for row in rows(path)] == [
        (f"{table}_{at}", "no reply")
        for table, most in (
            ("holding_register", 125),
            ("input_register", 125),
            ("coil", 2000),
            ("discrete_input", 2000),
        )
        for at in range(most)
    ]


@pytest.mark.parametrize(
    ("reply", "end"), [(Message(1, 3, 0, 100, bytes(200)), (0, "ok")), (None, (None, "no reply"))]
)
def test_more_rows_than_a_batch_can_hold_are_more_batches(
    tmp_path: Path, reply: Message | None, end: tuple[float | None, str]
) -> None:
    """The rows of an exchange are never parted."""
    count = 700 if reply else 701
    path = frames_of(tmp_path / "a.pcapng", [(Message(1, 3, 0, 100), reply)] * count)
    with Capture(path) as capture:
        batches = list(Decoding(capture))
    assert [len(batch) for batch in batches] == [65_500, 4_500]
    found = [(row.time, row.register, row.value, row.status) for batch in batches for row in batch]
    assert found == [(2 * n, f"holding_register_{at}", *end) for n in range(700) for at in range(100)]


# ---- files that are large, or change under the reader ----


@pytest.mark.parametrize("piece", [200, 256, 333, 512])
def test_pieces_of_a_file_are_one_capture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, piece: int
) -> None:
    path = write(tmp_path / "it.pcapng", RTU[:40])
    path.write_bytes(path.read_bytes() + OTHER_BLOCK)
    whole, torn = spans(path), rows(path)
    monkeypatch.setattr("multidrop.capture.pcapng_reader._PIECE", piece)
    assert spans(path) == whole
    assert rows(path) == torn
    path.write_bytes(path.read_bytes()[:-3])
    with Capture(path) as capture:
        for _ in capture:
            pass
        assert capture.torn == len(OTHER_BLOCK) - 3


OTHER_BLOCK = struct.pack("<II", 5, 1024) + bytes(1012) + struct.pack("<I", 1024)  # of statistics


def test_a_capture_that_is_cut_short_while_it_is_read_is_a_sentence(tmp_path: Path) -> None:
    """In a process of its own: where the file is mapped, the end of its bytes is the end of the process."""
    path = write(tmp_path / "it.pcapng", RTU * 20)
    code = (
        "import os, sys\nfrom multidrop.capture import Capture, CaptureError\n"
        "with Capture(sys.argv[1]) as capture:\n"
        "    os.truncate(sys.argv[1], 64)\n"
        "    try:\n"
        "        for _ in capture: pass\n"
        "    except CaptureError as cut:\n"
        "        print(cut)\n"
    )
    size = path.stat().st_size
    done = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True)
    assert (done.returncode, done.stderr, done.stdout) == (
        0,
        "",
        f"{path} was cut short while it was read: it had {size} bytes, and ends at byte 64 now\n",
    )
