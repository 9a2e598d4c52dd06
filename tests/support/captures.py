"""Captures of printed exchanges, and Wireshark's view of a capture."""

from __future__ import annotations

import subprocess
from collections.abc import Iterable
from pathlib import Path

from frames import Printed
from peers import require_program

from multidrop.capture import CaptureWriter, Side

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
