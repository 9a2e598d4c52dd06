"""Captures: Wireshark reads the library's captures, and the library reads other programs' captures."""

from __future__ import annotations

import struct
import subprocess
from collections.abc import Iterable
from pathlib import Path

import pytest
from captures import BEGIN, RTU, STEP, TEXT, decimal, spans, tshark, write
from disks import full_at
from frames import PRINTED
from peers import require_program

from multidrop.capture import CaptureWriter, Side
from multidrop.core import (
    Kind,
    Message,
)
from multidrop.recording import RecordingError

READ = bytes.fromhex("01 03 00 16 00 01 65 CE")


# ---- Wireshark reads our captures ----


def registers(data: bytes) -> list[int]:
    return list(struct.unpack(f">{len(data) // 2}H", data))


@pytest.mark.long
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


@pytest.mark.long
def test_wireshark_sees_a_bad_checksum(tmp_path: Path) -> None:
    bad = next(each for each in PRINTED if each.verdict == "bad checksum")
    with CaptureWriter(tmp_path / "a.pcapng") as capture:
        capture.write(bad.frame, Side.ASKING, BEGIN, "hall-1")
    assert tshark(tmp_path / "a.pcapng")[0]["mbrtu.crc16.status"] == "0"


@pytest.mark.long
def test_wireshark_shows_ascii_and_delixi_frames_as_they_are(tmp_path: Path) -> None:
    packets = tshark(write(tmp_path / "a.pcapng", TEXT))
    frames = [frame.hex() for each in TEXT for frame in (each.request_frame, each.frame)]
    assert [packet["data.data"] for packet in packets] == frames
    assert {packet["modbus.func_code"] for packet in packets} == {""}


@pytest.mark.long
def test_a_line_is_an_interface_with_its_name(tmp_path: Path) -> None:
    with CaptureWriter(tmp_path / "a.pcapng") as capture:
        for number, line in enumerate(("hall-1", "Halle zwei", "hall-1")):
            capture.write(RTU[0].frame, Side.ANSWERING, BEGIN + number, line)
    names = [packet["frame.interface_name"] for packet in tshark(tmp_path / "a.pcapng")]
    assert names == ["hall-1", "Halle zwei", "hall-1"]
    assert {line: len(each) for line, each in spans(tmp_path / "a.pcapng").items()} == {
        "hall-1": 2,
        "Halle zwei": 1,
    }


# ---- our reader, with captures of ours and of other programs ----


def test_frames_are_read_as_they_were_written(tmp_path: Path) -> None:
    exchanges = [*RTU, *TEXT]
    (found,) = spans(write(tmp_path / "a.pcapng", exchanges)).values()
    assert [(span.kind, span.time_ns, span.raw) for span in found] == [
        (kind, BEGIN + (2 * number + after) * STEP, frame)
        for number, each in enumerate(exchanges)
        for kind, after, frame in ((Kind.REQUEST, 0, each.request_frame), (Kind.REPLY, 1, each.frame))
    ]


def test_noise_is_read_as_noise(tmp_path: Path) -> None:
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


@pytest.mark.parametrize("format", ["pcap", "pcapng", "nsecpcap"])
@pytest.mark.parametrize("link", [147, 162, 250])
def test_captures_of_wireshark_s_tools_are_read(tmp_path: Path, format: str, link: int) -> None:
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


def test_frames_split_over_packets_and_several_in_one_packet_are_read(tmp_path: Path) -> None:
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


# ---- write errors ----


def test_a_capture_on_a_full_disk_raises_one_sentence(tmp_path: Path) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("needs /dev/full")
    path = tmp_path / "a.pcapng"
    path.symlink_to("/dev/full")
    files = sorted(Path("/proc/self/fd").iterdir())
    with pytest.raises(RecordingError) as failure:
        CaptureWriter(path, ["hall-1"])
    assert str(failure.value) == f"{path}: cannot be written: No space left on device"
    assert sorted(Path("/proc/self/fd").iterdir()) == files


def test_a_capture_in_a_missing_directory_raises_one_sentence(tmp_path: Path) -> None:
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
