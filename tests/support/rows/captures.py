"""Write captures of the exchanges printed in documents, and decode them with Wireshark and the library."""

from __future__ import annotations

import subprocess
from collections.abc import Iterable
from pathlib import Path

from frames import PRINTED, Printed
from peers import require_program

from multidrop.capture import Capture, CaptureWriter, Decoding, Side
from multidrop.core import FrameSpan, Framing, Message, Splitter
from multidrop.plant.model import Plant
from multidrop.polling.batch import Row

BEGIN = 1_700_000_000_123_456_789
STEP = 5_000_001  # ns between two frames

RTU = [
    each
    for each in PRINTED
    if each.request is not None and isinstance(each.says, Message) and each.framing is Framing.RTU
]
TEXT = [each for each in PRINTED if each.request is not None and each.framing is not Framing.RTU]


def write(path: Path, exchanges: Iterable[Printed], line: str = "hall-1") -> Path:
    with CaptureWriter(path) as capture:
        time = BEGIN
        for exchange in exchanges:
            capture.write(exchange.request_frame, Side.ASKING, time, line)
            capture.write(exchange.frame, Side.ANSWERING, time + STEP, line)
            time += 2 * STEP
    return path


FIELDS = (
    *("frame.interface_name", "frame.time_epoch", "frame.packet_flags_direction"),
    *("mbrtu.unit_id", "modbus.func_code", "modbus.exception_code", "modbus.reference_num"),
    *("modbus.word_cnt", "modbus.bit_cnt", "modbus.regval_uint16", "modbus.data", "mbrtu.crc16.status"),
    *("modbus.request_frame", "data.data", "mbtcp.trans_id", "mbtcp.unit_id", "_ws.col.Info"),
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


def spans(path: Path) -> dict[str, list[FrameSpan]]:
    """Return the frames in a capture file, by line name."""
    found: dict[str, list[FrameSpan]] = {}
    splitters: dict[str, Splitter] = {}
    with Capture(path) as capture:
        for _ in capture:
            for name, stream in zip(capture.lines, capture.streams, strict=True):
                splitter = splitters.setdefault(name, Splitter())
                found.setdefault(name, []).extend(splitter.spans(stream))
    return found


def rows(path: Path, plant: Plant | None = None) -> list[Row]:
    with Capture(path) as capture:
        return [row for batch in Decoding(capture, plant) for row in batch]
