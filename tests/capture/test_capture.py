"""Captures: Wireshark reads the library's captures, and the library reads other programs' captures."""

from __future__ import annotations

import os
import re
import struct
import subprocess
from collections.abc import Iterable
from pathlib import Path

import checksums
import pytest
from captures import BEGIN, RTU, STEP, TEXT, decimal, rows, spans, tshark, write
from frames import PRINTED
from interruptions import full_at
from lines import PATIENCE, until
from peers import require_program
from tables import table, usually
from toy import Toy

from multidrop.capture import (
    Capture,
    CaptureError,
    CaptureWriter,
    Decoding,
    Pairing,
    Side,
    SniffedExchange,
    Tapped,
)
from multidrop.capture.replay import Replay
from multidrop.core import STREAM_ROOM, FrameSpan, Framing, Kind, Message, Unpacker
from multidrop.families import InnovertIBD
from multidrop.plant.loader import load_plant
from multidrop.plant.model import Plant, PlantLine, PolledDrive
from multidrop.poller import Poller
from multidrop.polling.batch import Row
from multidrop.recording import RecordingError
from multidrop.sim import EncodedDrive, Simulator, Wire, proof

Captured = tuple[Path, Path, list[Row]]

READ = bytes.fromhex("01 03 00 16 00 01 65 CE")


def registers(data: bytes) -> list[int]:
    return list(struct.unpack(f">{len(data) // 2}H", data))


@pytest.mark.long
def test_wireshark_decodes_every_exchange_printed_in_manuals(tmp_path: Path) -> None:
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


@pytest.mark.long
def test_wireshark_reports_a_bad_checksum_in_a_capture(tmp_path: Path) -> None:
    bad = next(each for each in PRINTED if each.verdict == "bad checksum")
    with CaptureWriter(tmp_path / "a.pcapng") as capture:
        capture.write(bad.frame, Side.ASKING, BEGIN, "hall-1")
    assert tshark(tmp_path / "a.pcapng")[0]["mbrtu.crc16.status"] == "0"


@pytest.mark.long
def test_wireshark_shows_ascii_and_delixi_frames_as_plain_data(tmp_path: Path) -> None:
    packets = tshark(write(tmp_path / "a.pcapng", TEXT))
    frames = [frame.hex() for each in TEXT for frame in (each.request_frame, each.frame)]
    assert [packet["data.data"] for packet in packets] == frames
    assert {packet["modbus.func_code"] for packet in packets} == {""}


@pytest.mark.long
def test_packets_of_each_line_have_the_line_name_as_pcapng_interface(tmp_path: Path) -> None:
    with CaptureWriter(tmp_path / "a.pcapng") as capture:
        for number, line in enumerate(("hall-1", "Halle zwei", "hall-1")):
            capture.write(RTU[0].frame, Side.ANSWERING, BEGIN + number, line)
    names = [packet["frame.interface_name"] for packet in tshark(tmp_path / "a.pcapng")]
    assert names == ["hall-1", "Halle zwei", "hall-1"]
    assert {line: len(each) for line, each in spans(tmp_path / "a.pcapng").items()} == {
        "hall-1": 2,
        "Halle zwei": 1,
    }


def test_a_capture_is_read_back_with_the_written_frames(tmp_path: Path) -> None:
    exchanges = [*RTU, *TEXT]
    (found,) = spans(write(tmp_path / "a.pcapng", exchanges)).values()
    assert [(span.kind, span.time_ns, span.raw) for span in found] == [
        (kind, BEGIN + (2 * number + after) * STEP, frame)
        for number, each in enumerate(exchanges)
        for kind, after, frame in ((Kind.REQUEST, 0, each.request_frame), (Kind.REPLY, 1, each.frame))
    ]


def test_noise_in_a_capture_is_read_back_as_noise(tmp_path: Path) -> None:
    with CaptureWriter(tmp_path / "a.pcapng") as capture:
        capture.write(b"\xff\x00\xff", Side.EITHER, BEGIN, "hall-1")
        capture.write(RTU[0].frame[:-1], Side.ANSWERING, BEGIN, "hall-1")
    (found,) = spans(tmp_path / "a.pcapng").values()
    assert {span.kind for span in found} == {Kind.JUNK}
    assert b"".join(span.raw for span in found) == b"\xff\x00\xff" + RTU[0].frame[:-1]


def hexdump(packets: Iterable[bytes]) -> str:
    """Return input for text2pcap: one packet per line, with time stamps 1 ms apart."""
    return "".join(
        f"2026-11-21T09:30:00.{number:03}Z 0000 {packet.hex(' ')}\n" for number, packet in enumerate(packets)
    )


@pytest.mark.parametrize("format", usually("pcapng", "pcap", "nsecpcap"))
@pytest.mark.parametrize("link", [147, 162, 250])
def test_captures_written_by_text2pcap_are_read(tmp_path: Path, format: str, link: int) -> None:
    frames = [frame for each in (*RTU, *TEXT) for frame in (each.request_frame, each.frame)]
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


def test_frames_split_between_packets_are_read_whole(tmp_path: Path) -> None:
    frames = b"".join(each.request_frame + each.frame for each in RTU)
    packets = [frames[at : at + 7] for at in range(0, len(frames), 7)]
    header = struct.pack(">IHHiIII", 0xA1B23C4D, 2, 4, 0, 0, 65535, 147)  # big-endian, ns
    path = tmp_path / "a.pcap"
    path.write_bytes(
        header + b"".join(struct.pack(">IIII", 1, 5, len(packet), len(packet)) + packet for packet in packets)
    )
    (found,) = spans(path).values()
    assert b"".join(span.raw for span in found) == frames
    assert {span.kind for span in found[1:]} <= {Kind.REQUEST, Kind.REPLY, Kind.EITHER}
    assert {span.time_ns for span in found} == {10**9 + 5}


def test_reply_split_into_packets_with_pauses_is_one_frame(tmp_path: Path) -> None:
    """A reply of 165 bytes comes in pieces of 32, as in alerighi/modbus-sniffer#9."""
    reply = checksums.rtu("0B 03 A0" + bytes((at * 7 + 3) % 256 for at in range(160)).hex())
    pieces = [checksums.rtu("0B 03 08 36 00 50"), *(reply[at : at + 32] for at in range(0, len(reply), 32))]
    path = tmp_path / "a.pcap"
    path.write_bytes(
        pcap(147)
        + b"".join(
            struct.pack("<IIII", 1, 45_000 * at, len(piece), len(piece)) + piece
            for at, piece in enumerate(pieces)
        )
    )
    (found,) = spans(path).values()
    assert [(span.kind, span.raw) for span in found] == [(Kind.REQUEST, pieces[0]), (Kind.REPLY, reply)]


@pytest.mark.parametrize(
    ("resolution", "time_ns"),
    [(b"\x09", 5_000_007), (b"\x06", 5_000_007_000), (b"\x03", 5_000_007_000_000), (b"\x94", 4_768_378_257)],
    ids=["ns", "us", "ms", "2^-20 s"],
)
def test_time_stamps_of_any_resolution_are_read(tmp_path: Path, resolution: bytes, time_ns: int) -> None:
    path = tmp_path / "a.pcapng"
    with CaptureWriter(path) as capture:
        capture.write(RTU[0].frame, Side.ANSWERING, 5_000_007, "hall-1")
    option = b"\x09\0\x01\0"
    path.write_bytes(path.read_bytes().replace(option + b"\x09", option + resolution))
    (found,) = spans(path).values()
    assert [span.time_ns for span in found] == [time_ns]


def test_a_capture_on_a_full_disk_raises_a_one_sentence_error(tmp_path: Path) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("needs /dev/full")
    path = tmp_path / "a.pcapng"
    path.symlink_to("/dev/full")
    files = sorted(Path("/proc/self/fd").iterdir())
    with pytest.raises(RecordingError) as failure:
        CaptureWriter(path, ["hall-1"])
    assert str(failure.value) == f"{path}: cannot be written: No space left on device"
    assert sorted(Path("/proc/self/fd").iterdir()) == files


def test_a_capture_in_a_missing_directory_raises_a_one_sentence_error(tmp_path: Path) -> None:
    path = tmp_path / "none" / "a.pcapng"
    with pytest.raises(RecordingError) as failure:
        CaptureWriter(path)
    assert str(failure.value) == f"{path}: cannot be written: No such file or directory"


def test_disk_that_becomes_full_leaves_whole_packets_in_a_capture(tmp_path: Path) -> None:
    path = tmp_path / "a.pcapng"
    with CaptureWriter(path) as capture:
        capture.write(READ, Side.ASKING, BEGIN, "hall-1")
        with full_at(path.stat().st_size + 50), pytest.raises(RecordingError, match="File too large"):
            capture.write(READ, Side.ASKING, BEGIN + STEP, "hall-1")
        capture.write(READ, Side.ASKING, BEGIN + 2 * STEP, "hall-1")
    (found,) = spans(path).values()
    assert [span.time_ns for span in found] == [BEGIN, BEGIN + 2 * STEP]


READ_REQUEST = Message(1, 3, 1, 1)  # the output frequency
S = 10**9  # ns
FRAMES = (  # time in s, request, reply; the replies: 10.0 Hz, none, 25.0 Hz, a refusal, 30.0 Hz
    (0, "01 03 0001 0001", "01 03 02 0064"),
    (2, "01 03 0001 0001", ""),
    (4, "01 03 0001 0001", "01 03 02 00FA"),
    (6, "01 03 0001 0001", "01 83 06"),
    (8, "01 03 0000 0002", "01 03 04 0000 012C"),
)


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    path = tmp_path / "hall.pcapng"
    with CaptureWriter(path) as writer:
        for second, request, reply in FRAMES:
            writer.write(checksums.rtu(request), Side.ASKING, 1_700_000_000 * S + second * S, "hall")
            if reply:
                writer.write(
                    checksums.rtu(reply), Side.ANSWERING, 1_700_000_000 * S + second * S + S // 100, "hall"
                )
    return path


def plant(*drives: Toy) -> Plant:
    return Plant([PlantLine("hall", "pty", drives=[PolledDrive(drive) for drive in drives])])


def test_replayed_drive_repeats_captured_values_at_the_captured_times(capture: Path) -> None:
    drive = Replay(capture, plant(Toy(1))).drive(Toy(1))
    assert drive["output_frequency"] == 10.0
    start = 1000.0  # the time of the first request
    found = [drive.answer(READ_REQUEST, start + after) for after in (0, 1.9, 2.1, 3.9, 4.1, 6.1, 8.1, 99)]
    frequencies = [None if one is None else int.from_bytes(one.data) / 10 for one in found]
    assert frequencies == [10.0, 10.0, None, None, 25.0, 25.0, 30.0, 30.0]


def test_a_write_to_a_replayed_drive_lasts_until_the_next_captured_value(capture: Path) -> None:
    drive = Replay(capture, plant(Toy(1))).drive(Toy(1))
    drive.answer(READ_REQUEST, 0.0)
    drive["output_frequency"] = 5.0
    reply = drive.answer(READ_REQUEST, 1.0)
    assert reply is not None
    assert reply.data == bytes([0, 50])
    drive.answer(READ_REQUEST, 4.0)
    assert drive["output_frequency"] == 25.0


def test_replayed_drive_sends_no_reply_if_missing_from_the_capture(capture: Path) -> None:
    replay = Replay(capture, plant(Toy(1), Toy(2, name="other")))
    assert replay.drive(Toy(2, name="other")).answer(Message(2, 3, 1, 1), 0.0) is None


def test_a_capture_of_other_drives_cannot_be_replayed(capture: Path) -> None:
    with pytest.raises(ValueError, match=r"hall\.pcapng has no exchange with other$"):
        Replay(capture, plant(Toy(2, name="other")))


POLLED = ("output_current", "motor_speed")


def test_unit_id_0_of_modbus_tcp_is_not_a_broadcast() -> None:
    request, reply = Message(0, 0x03, 1, 1), Message(0, 0x03, data=b"\0\7")
    spans = {
        framing: [
            FrameSpan(Kind.REQUEST, framing, 1, request, b"?"),
            FrameSpan(Kind.REPLY, framing, 2, reply, b"!"),
        ]
        for framing in (Framing.TCP, Framing.RTU)
    }
    (exchange,) = Pairing().pair(spans[Framing.TCP])
    assert isinstance(exchange, SniffedExchange)
    assert (exchange.request, exchange.reply, exchange.is_broadcast) == (request, reply, False)
    serial = list(Pairing().pair(spans[Framing.RTU]))
    assert [isinstance(each, SniffedExchange) and each.is_broadcast for each in serial] == [True, False]


@pytest.fixture
def captured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Captured:
    """Return a plant file, the capture of its poll with one silent drive, and the poll's rows."""
    monkeypatch.setattr(InnovertIBD, "response_timeout", PATIENCE)
    monkeypatch.setattr(InnovertIBD, "answering_time", PATIENCE)
    plant, path = tmp_path / "plant.toml", tmp_path / "a.pcapng"
    wire = Wire([EncodedDrive(InnovertIBD(3))], port="tcp://127.0.0.1:0", unpaced=True)
    with Simulator([wire]):
        plant.write_text(
            f'[[line]]\nname = "net"\nport = "{wire.path}"\n'
            + "".join(
                f'[[line.drive]]\nname = "{name}"\nmodel = "{model}"\naddress = {address}\n'
                f"poll = {list(POLLED)}\n"
                for name, model, address in (("pump", "innovert-ibd", 3), ("gone", "invt-che", 4))
            )
        )
        poller, rows = Poller(load_plant(plant)), []

        def is_enough() -> bool:
            tapped.collect()
            while batch := poller.take():
                rows.extend(batch)
            return len(rows) > 200 and "gone" in {row.drive for row in rows}

        with CaptureWriter(path, list(poller.buses)) as capture:
            with Tapped(poller.buses, capture) as tapped, poller:
                until(is_enough)
            while batch := poller.take():
                rows.extend(batch)
        assert tapped.lost == 0
    return plant, path, rows


@pytest.mark.long
def test_wireshark_decodes_modbus_tcp(captured: Captured) -> None:
    _, path, rows = captured
    packets = tshark(path)
    read = [packet for packet in packets if packet["mbtcp.unit_id"] == "3"]
    answered = [packet for packet in read if packet["_ws.col.Info"].strip().startswith("Response")]
    asked = [packet for packet in read if packet["_ws.col.Info"].strip().startswith("Query")]
    assert len(answered) == len({row.monotonic_ns for row in rows if row.value is not None})
    assert {each["mbtcp.trans_id"] for each in answered} <= {each["mbtcp.trans_id"] for each in asked}
    functions = {(packet["mbtcp.unit_id"], packet["modbus.func_code"]) for packet in packets}
    assert functions == {("3", "3"), ("4", "3")}
    assert not [packet for packet in packets if "Malformed" in packet["_ws.col.Info"]]


@pytest.mark.slow
def test_a_decoded_capture_of_modbus_tcp_has_the_polled_values(captured: Captured) -> None:
    plant, path, polled = captured
    known = load_plant(plant)
    with Capture(path) as capture:
        decoding = Decoding(capture, known)
        found = [row for batch in decoding for row in batch]
        assert decoding.counts()["unknown_bytes"] == 0
    drive = known.lines[0].drives[0].drive
    assert {row.value for row in found if row.drive == "pump" and row.register == "output_current"} == {
        proof(drive, drive.register("output_current"))
    }
    told = [(row.drive, row.register, row.value, row.status) for row in polled if row.status != NOT_ASKED]
    assert [(row.drive, row.register, row.value, row.status) for row in found][: len(told) - 8] == told[:-8]


NOT_ASKED = "not asked: drive is silent"


def block(kind: int, body: bytes) -> bytes:
    return struct.pack("<II", kind, len(body) + 12) + body + struct.pack("<I", len(body) + 12)


def described(*options: tuple[int, bytes]) -> bytes:
    """Return a pcapng file without packets, and with one interface that has these options."""
    fields = b"".join(
        struct.pack("<HH", code, len(value)) + value + bytes(-len(value) % 4) for code, value in options
    )
    section = block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1))
    return section + block(1, struct.pack("<HHI", 147, 0, 0) + fields)


def test_capture_with_an_empty_time_resolution_option_is_read(tmp_path: Path) -> None:
    (tmp_path / "a.pcapng").write_bytes(described((9, b"")))
    assert spans(tmp_path / "a.pcapng") == {"a-0": []}


def test_a_capture_with_a_huge_time_offset_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.pcapng").write_bytes(described((14, struct.pack("<q", 1 << 40))))
    with pytest.raises(CaptureError, match=r"byte 28: the time offset of 1099511627776 s is too large"):
        spans(tmp_path / "a.pcapng")


def packet(interface: int, content: bytes, stated: int | None = None) -> bytes:
    """Return an enhanced packet block, whose header states its true length or `stated`."""
    length = len(content) if stated is None else stated
    return block(6, struct.pack("<5I", interface, 0, 0, length, length) + content + bytes(-len(content) % 4))


def pcap(link: int) -> bytes:
    """Return the header of a pcap file with this link type."""
    return struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, link)


NO_PACKET = " is damaged: at byte 48 a packet should start"
SECTION, INTERFACE = described()[:28], described()[28:]
BIG_ENDIAN_SECTION = struct.pack(">IIIHHqI", 0x0A0D0D0A, 28, 0x1A2B3C4D, 1, 0, -1, 28)


@table(
    ("content", "sentence"),
    [
        (b"", " is not a capture: it is empty"),
        (b"hello, world", " is not a capture: it does not start like a pcap or pcapng file"),
        (b"\xd4\xc3\xb2\xa1\x02\0", " is not a capture: it ends within its header"),
        (b"\x0a\x0d\x0d\x0a\x1c\0", " is not a capture: it ends within its header"),
        (pcap(1), ": a is Ethernet (link type 1), not a serial line"),
        (pcap(147) + b"\xff" * 40, " is damaged: at byte 24 a packet should start"),
        (SECTION[:8] + b"\xde\xad\xbe\xef" + SECTION[12:], " is damaged: at byte 0 a packet should start"),
        (SECTION + struct.pack("<III", 1, 7, 7), " is damaged: at byte 28 a packet should start"),
        (SECTION + block(1, bytes(4)), " is damaged: at byte 28 a packet should start"),
        (
            described((9, b"\x0a")),
            ": byte 28: time stamps finer than a nanosecond cannot be read",
        ),
        (described() + packet(1, READ), NO_PACKET),  # the file has no interface 1
        (described() + packet(0, READ, stated=9), NO_PACKET),  # its stated length exceeds the block
        (described() + packet(0, READ)[:-4] + bytes(4), NO_PACKET),  # its block ends with another length
        (
            described() + SECTION,
            ": byte 48: a second section starts here, and only the first one can be read",
        ),
        (
            described() + BIG_ENDIAN_SECTION,
            ": byte 48: a section has another byte order than the first one; such a file cannot be read",
        ),
        (
            SECTION + block(3, bytes(8)),
            ": byte 28: simple and obsolete packet blocks cannot be read; `editcap` converts them to "
            "enhanced packet blocks",
        ),
        (
            SECTION + INTERFACE * (Unpacker.MOST_CHANNELS + 1),
            f": more than {Unpacker.MOST_CHANNELS} interfaces",
        ),
    ],
)
def test_invalid_captures_raise_a_one_sentence_error(tmp_path: Path, content: bytes, sentence: str) -> None:
    path = tmp_path / "a.pcapng"
    path.write_bytes(content)
    with pytest.raises(CaptureError) as mistake:
        spans(path)
    assert str(mistake.value) == f"{path}{sentence}"


def test_capture_ending_in_an_incomplete_interface_block_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.pcapng"
    path.write_bytes(described()[:-6])
    with Capture(path) as capture:
        assert list(capture) == [None]
        assert (capture.lines, capture.truncated) == ([], 14)


@table("tags", [b"\0\x0c\0\x05mb", b"\0\x0c\0\x05mbrtu", b"\0\x0c\xff\xff", b"\0\0\0\0", b"\0"])
def test_packet_with_incomplete_tags_gives_no_frame(tmp_path: Path, tags: bytes) -> None:
    """A packet of the link type "exported PDU" starts with tags that describe its frame."""
    path = tmp_path / "a.pcapng"
    interface = block(1, struct.pack("<HHI", 252, 0, 0))
    path.write_bytes(SECTION + interface + packet(0, tags) + packet(0, b"\0\0\0\0" + READ))
    (found,) = spans(path).values()
    assert [span.raw for span in found] == [READ]


@pytest.mark.slow
@pytest.mark.parametrize(("content", "count"), [(READ, 33_000), (b"\xff" * 700, STREAM_ROOM // 700 + 1)])
@pytest.mark.parametrize("format", ["pcapng", "pcap"])
def test_large_captures_are_read_whole(tmp_path: Path, format: str, content: bytes, count: int) -> None:
    """The capture has more packets, or more bytes, than fit into the buffer between reader and decoder."""
    path = tmp_path / f"a.{format}"
    if format == "pcapng":
        path.write_bytes(described() + packet(0, content) * count)
    else:
        path.write_bytes(
            pcap(147) + (struct.pack("<IIII", 1, 0, len(content), len(content)) + content) * count
        )
    (found,) = spans(path).values()
    assert b"".join(span.raw for span in found) == content * count
    assert {span.kind for span in found} == {Kind.REQUEST if content == READ else Kind.JUNK}


@pytest.mark.parametrize("format", ["pcapng", "pcap"])
def test_a_cut_capture_is_read_up_to_the_last_whole_packet(tmp_path: Path, format: str) -> None:
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
            assert capture.truncated < 300
    assert read == sorted(read, reverse=True)
    assert read[0] > read[-1] == 0


@pytest.mark.parametrize("piece", [200, 256, 333, 512])
def test_size_of_the_read_buffer_does_not_change_decoded_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, piece: int
) -> None:
    path = write(tmp_path / "it.pcapng", RTU[:40])
    path.write_bytes(path.read_bytes() + OTHER_BLOCK)
    whole, whole_rows = spans(path), rows(path)
    monkeypatch.setattr("multidrop.capture.pcapng._PIECE", piece)
    assert spans(path) == whole
    assert rows(path) == whole_rows
    path.write_bytes(path.read_bytes()[:-3])
    with Capture(path) as capture:
        for _ in capture:
            pass
        assert capture.truncated == len(OTHER_BLOCK) - 3


OTHER_BLOCK = block(5, bytes(1012))  # statistics


def test_a_capture_truncated_during_reading_raises_a_one_sentence_error(tmp_path: Path) -> None:
    """If the file were mapped into memory, reading past its end would kill this process."""
    path = write(tmp_path / "it.pcapng", RTU * 20)
    size = path.stat().st_size
    sentence = f"{path} became shorter while it was read: it had {size} bytes, and now ends at byte 64"
    with Capture(path) as capture:
        os.truncate(path, 64)
        with pytest.raises(CaptureError, match=f"^{re.escape(sentence)}$"):
            list(capture)
