"""Replay a capture: values at the captured times, silences, and drives that were not captured."""

from __future__ import annotations

from pathlib import Path

import checksums
import pytest
from toy import Toy

from multidrop.capture import CaptureWriter, Side
from multidrop.capture.replay import Replay
from multidrop.core import Message
from multidrop.plant.model import Plant, PlantLine, PolledDrive

READ = Message(1, 3, 1, 1)  # the output frequency
S = 10**9  # ns
FRAMES = (  # time in s, request, reply: the frequencies 10.0 Hz, none, 25.0 Hz, a refusal, 30.0 Hz
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


def test_registers_have_the_captured_values_at_the_captured_times(capture: Path) -> None:
    drive = Replay(capture, plant(Toy(1))).drive(Toy(1))
    assert drive["output_frequency"] == 10.0
    start = 1000.0  # the time of the first request
    found = [drive.answer(READ, start + after) for after in (0, 1.9, 2.1, 3.9, 4.1, 6.1, 8.1, 99)]
    frequencies = [None if one is None else int.from_bytes(one.data) / 10 for one in found]
    assert frequencies == [10.0, 10.0, None, None, 25.0, 25.0, 30.0, 30.0]


def test_a_written_value_lasts_until_the_next_captured_one(capture: Path) -> None:
    drive = Replay(capture, plant(Toy(1))).drive(Toy(1))
    drive.answer(READ, 0.0)
    drive["output_frequency"] = 5.0
    reply = drive.answer(READ, 1.0)
    assert reply is not None
    assert reply.data == bytes([0, 50])
    drive.answer(READ, 4.0)
    assert drive["output_frequency"] == 25.0


def test_a_drive_that_was_not_captured_is_silent(capture: Path) -> None:
    replay = Replay(capture, plant(Toy(1), Toy(2, name="other")))
    assert replay.drive(Toy(2, name="other")).answer(Message(2, 3, 1, 1), 0.0) is None


def test_a_capture_of_other_drives_is_refused(capture: Path) -> None:
    with pytest.raises(ValueError, match=r"hall\.pcapng has no exchange with other$"):
        Replay(capture, plant(Toy(2, name="other")))
