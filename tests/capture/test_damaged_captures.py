"""Captures that are damaged, truncated, large, or that change during reading."""

from __future__ import annotations

import struct
import subprocess
import sys
from pathlib import Path

import pytest
from captures import RTU, rows, spans, write
from peers import require_program

from multidrop.capture import Capture, CaptureError, Decoding
from multidrop.core import (
    STREAM_ROOM,
    Kind,
    Unpacker,
)

READ = bytes.fromhex("01 03 00 16 00 01 65 CE")


# ---- other files ----


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
def test_a_file_that_is_not_a_capture_raises_one_sentence(
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
    """Return a pcapng file without packets, and with one interface that has these options."""
    fields = b"".join(
        struct.pack("<HH", code, len(value)) + value + bytes(-len(value) % 4) for code, value in options
    )
    interface = struct.pack("<HHI", 147, 0, 0) + fields
    size = len(interface) + 12
    section = struct.pack("<IIIHHqI", 0x0A0D0D0A, 28, 0x1A2B3C4D, 1, 0, -1, 28)
    return section + struct.pack("<II", 1, size) + interface + struct.pack("<I", size)


def test_an_empty_resolution_is_the_default(tmp_path: Path) -> None:
    (tmp_path / "a.pcapng").write_bytes(described((9, b"")))
    assert spans(tmp_path / "a.pcapng") == {"a-0": []}


def test_a_clock_with_a_huge_offset_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.pcapng").write_bytes(described((14, struct.pack("<q", 1 << 40))))
    with pytest.raises(CaptureError, match=r"byte 28: its clock is 1099511627776 s off"):
        spans(tmp_path / "a.pcapng")


def block(kind: int, body: bytes) -> bytes:
    return struct.pack("<II", kind, len(body) + 12) + body + struct.pack("<I", len(body) + 12)


def packet(interface: int, content: bytes, stated: int | None = None) -> bytes:
    """Return an enhanced packet block; its header states the length `stated`, or by default the right one."""
    length = len(content) if stated is None else stated
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
        (described() + packet(1, READ), NO_PACKET),  # the file has no interface 1
        (described() + packet(0, READ, stated=9), NO_PACKET),  # the stated length exceeds the block
        (described() + packet(0, READ)[:-4] + bytes(4), NO_PACKET),  # its lengths at both ends differ
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
def test_an_unreadable_pcapng_file_raises_one_sentence(tmp_path: Path, content: bytes, sentence: str) -> None:
    path = tmp_path / "a.pcapng"
    path.write_bytes(content)
    with pytest.raises(CaptureError) as mistake:
        spans(path)
    assert str(mistake.value) == f"{path}{sentence}"


def test_a_capture_cut_within_an_interface_is_read_up_to_it(tmp_path: Path) -> None:
    path = tmp_path / "a.pcapng"
    path.write_bytes(described()[:-6])
    with Capture(path) as capture:
        assert list(capture) == [None]
        assert (capture.lines, capture.truncated) == ([], 14)


@pytest.mark.parametrize(
    "tags", [b"\0\x0c\0\x05mb", b"\0\x0c\0\x05mbrtu", b"\0\x0c\xff\xff", b"\0\0\0\0", b"\0"]
)
def test_a_packet_that_ends_within_its_tags_is_empty(tmp_path: Path, tags: bytes) -> None:
    """Tags describe an exported frame, and precede it; this packet ends within or after its tags."""
    path = tmp_path / "a.pcapng"
    interface = block(1, struct.pack("<HHI", 252, 0, 0))
    path.write_bytes(SECTION + interface + packet(0, tags) + packet(0, b"\0\0\0\0" + READ))
    (found,) = spans(path).values()
    assert [span.raw for span in found] == [READ]


@pytest.mark.slow
@pytest.mark.parametrize(("content", "count"), [(READ, 33_000), (b"\xff" * 700, STREAM_ROOM // 700 + 1)])
@pytest.mark.parametrize("format", ["pcapng", "pcap"])
def test_a_capture_may_exceed_the_room_of_a_stream(
    tmp_path: Path, format: str, content: bytes, count: int
) -> None:
    """The capture has more packets, or more bytes, than the buffer between reader and decoder can hold."""
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


# ---- files that are large, or change under the reader ----


@pytest.mark.parametrize("piece", [200, 256, 333, 512])
def test_pieces_of_a_file_are_one_capture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, piece: int
) -> None:
    path = write(tmp_path / "it.pcapng", RTU[:40])
    path.write_bytes(path.read_bytes() + OTHER_BLOCK)
    whole, whole_rows = spans(path), rows(path)
    monkeypatch.setattr("multidrop.capture.pcapng_reader._PIECE", piece)
    assert spans(path) == whole
    assert rows(path) == whole_rows
    path.write_bytes(path.read_bytes()[:-3])
    with Capture(path) as capture:
        for _ in capture:
            pass
        assert capture.truncated == len(OTHER_BLOCK) - 3


OTHER_BLOCK = struct.pack("<II", 5, 1024) + bytes(1012) + struct.pack("<I", 1024)  # statistics


@pytest.mark.slow
def test_a_capture_truncated_during_reading_raises_one_sentence(tmp_path: Path) -> None:
    """A separate process reads it: if the file were mapped, reading past its end would kill the process."""
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
