"""Captures become rows: values in units with a plant file, raw registers without one."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from pathlib import Path

import checksums
import pytest
from captures import BEGIN, RTU, STEP, TEXT, rows, write
from tables import usually

from multidrop.capture import Capture, CaptureWriter, Decoding, Side
from multidrop.core import Framing, Message, build_reply, build_request
from multidrop.plant.loader import load_plant
from multidrop.plant.model import Plant
from multidrop.polling.batch import Row

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


# model, framing, request as printed in the manual, register, value in the request or its reply
EXCHANGES = [
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
def test_a_captured_exchange_is_decoded_to_engineering_units(
    tmp_path: Path, model: str, framing: str, request_: str, register: str, value: float
) -> None:
    texts = (request_, f":{request_}\\r\\n")
    exchange = next(each for each in (*RTU, *TEXT) if _text(each.request_frame) in texts)
    path = write(tmp_path / "a.pcapng", [exchange])
    (row,) = rows(path, plant(tmp_path, model, framing))
    assert row == Row(BEGIN, BEGIN, STEP, "pump", register, value, "ok")


def _text(frame: bytes) -> str:
    return frame.decode().replace("\r\n", "\\r\\n") if frame[:1] == b":" else frame.hex(" ").upper()


def test_each_register_of_a_captured_block_write_has_its_own_row(tmp_path: Path) -> None:
    exchange = next(
        each for each in RTU if _text(each.request_frame) == "01 10 00 0C 00 02 04 00 C8 01 90 73 F8"
    )
    found = rows(write(tmp_path / "a.pcapng", [exchange]), plant(tmp_path, "erman-er-g-220", "rtu"))
    assert [(row.register, row.value) for row in found] == [
        ("acceleration_time", 20),
        ("deceleration_time", 40),
    ]


def test_a_capture_without_a_plant_is_decoded_to_raw_registers(tmp_path: Path) -> None:
    exchange = next(each for each in RTU if _text(each.frame) == "01 03 08 01 00 01 F4 01 F4 00 32 25 C4")
    found = rows(write(tmp_path / "a.pcapng", [exchange]))
    assert [(row.drive, row.register, row.value) for row in found] == [
        ("address 1", f"holding_register_{1 + at}", value) for at, value in enumerate((256, 500, 500, 50))
    ]


def test_decoded_exception_reply_has_the_exception_code_as_status(tmp_path: Path) -> None:
    exchange = next(each for each in RTU if _text(each.frame) == "01 83 03 01 31")
    found = rows(write(tmp_path / "a.pcapng", [exchange]))
    assert {(row.value, row.status) for row in found} == {(None, "exception 03")}


def test_decoded_request_without_a_valid_reply_has_the_reason_as_status(tmp_path: Path) -> None:
    exchange = next(each for each in RTU if _text(each.frame) == "01 03 02 13 88 B5 12")
    with CaptureWriter(tmp_path / "a.pcapng") as capture:
        capture.write(exchange.request_frame, Side.ASKING, 1, "hall-1")
        capture.write(exchange.request_frame, Side.ASKING, 2, "hall-1")
        capture.write(exchange.frame[:-1] + b"\0", Side.ANSWERING, 3, "hall-1")
        capture.write(exchange.request_frame, Side.ASKING, 4, "hall-1")
        capture.write(exchange.frame, Side.ANSWERING, 6, "hall-1")
    assert [
        (row.time_ns, row.uncertainty_ns, row.value, row.status) for row in rows(tmp_path / "a.pcapng")
    ] == [(1, None, None, "no reply"), (2, None, None, "bad checksum"), (4, 2, 5000, "ok")]


@pytest.mark.long
def test_decoder_starts_a_new_batch_at_the_limit_of_register_names(tmp_path: Path) -> None:
    """All 65536 holding registers are read, and then some input registers."""
    ends = {3: 65500, 4: 10_000}
    with CaptureWriter(tmp_path / "a.pcapng") as capture:
        for function, end in ends.items():
            for start in range(0, end, 100):
                asked = Message(1, function, start, 100)
                reply = Message(1, function, start, 100, struct.pack(">100H", *range(start, start + 100)))
                capture.write(build_request(Framing.RTU, asked), Side.ASKING, start, "hall-1")
                capture.write(build_reply(Framing.RTU, reply), Side.ANSWERING, start + 1, "hall-1")
    found = rows(tmp_path / "a.pcapng")
    assert [(row.register, row.value) for row in found] == [
        (f"{table}_register_{at}", at)
        for table, end in zip(("holding", "input"), ends.values(), strict=True)
        for at in range(end)
    ]


def frames_of(path: Path, exchanges: Iterable[tuple[Message, Message | None]]) -> Path:
    """Return a capture with these frames, one every 2 ns."""
    with CaptureWriter(path) as capture:
        for number, (asked, reply) in enumerate(exchanges):
            capture.write(build_request(Framing.RTU, asked), Side.ASKING, 2 * number, "hall-1")
            if reply:
                capture.write(build_reply(Framing.RTU, reply), Side.ANSWERING, 2 * number + 1, "hall-1")
    return path


@pytest.mark.long
@pytest.mark.parametrize(("data", "end"), usually((b"\0\7", (7, "ok")), (b"", (None, "no reply"))))
def test_decoder_decodes_more_requests_than_fit_its_cache(
    tmp_path: Path, data: bytes, end: tuple[float | None, str]
) -> None:
    """The decoder's hash table of requests has 16384 places, and counts as full at 12288 requests."""
    asked = [Message(1 + number % 2, 3, number // 2, 1) for number in range(13_000)]
    replies = (Message(each.address, 3, each.start, 1, data) if data else None for each in asked)
    path = frames_of(tmp_path / "a.pcapng", zip(asked, replies, strict=True))
    # if no request was answered, the last one has no row yet, because its reply may still come
    told = asked if data else asked[:-1]
    assert [(row.drive, row.register, row.value, row.status) for row in rows(path)] == [
        (f"address {record.address}", f"holding_register_{record.start}", *end) for record in told
    ]


def test_a_request_for_too_many_registers_is_decoded_to_at_most_125_rows(tmp_path: Path) -> None:
    """Noise or a faulty master may send a request for 65535 registers, but a reply has at most 125."""
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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("reply", "end"), [(Message(1, 3, 0, 100, bytes(200)), (0, "ok")), (None, (None, "no reply"))]
)
def test_decoder_starts_a_new_batch_at_the_limit_of_rows(
    tmp_path: Path, reply: Message | None, end: tuple[float | None, str]
) -> None:
    """The rows of one exchange are never divided between two batches."""
    count = 700 if reply else 701
    path = frames_of(tmp_path / "a.pcapng", [(Message(1, 3, 0, 100), reply)] * count)
    with Capture(path) as capture:
        batches = list(Decoding(capture))
    assert [len(batch) for batch in batches] == [65_500, 4_500]
    found = [(row.time_ns, row.register, row.value, row.status) for batch in batches for row in batch]
    assert found == [(2 * n, f"holding_register_{at}", *end) for n in range(700) for at in range(100)]
