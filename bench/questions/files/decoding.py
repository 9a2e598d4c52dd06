"""The speed of decoding RTU captures to columns on one CPU core, in megabytes of frames per second.

Captures are in the page cache. Each packet has one frame, without information about its sender.
"""

from __future__ import annotations

import argparse
import random
import struct
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from bench.support import tables
from multidrop.capture import Capture, Decoding
from multidrop.core import Framing, Message, build_reply, build_request

USER_LINK_TYPE = 147
EXCHANGES = 2000  # number of different exchanges, repeated in a capture


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--megabytes", type=float, default=60.0, help="of frames, in each capture")
    parser.add_argument("--slices", type=int, default=5)
    parser.add_argument("--registers", type=int, nargs="+", default=[1, 4, 10, 100], help="in a reply")
    arguments = parser.parse_args()
    tables.heading(f"{arguments.megabytes:g} MB of RTU frames decoded, best of {arguments.slices}.")

    rows = []
    with TemporaryDirectory() as directory:
        path = Path(directory) / "line.pcap"
        for registers in arguments.registers:
            size = write(path, registers, arguments.megabytes * 1e6)
            values, seconds = min((decoded(path) for _ in range(arguments.slices)), key=lambda each: each[1])
            of_frames, of_file = size / seconds / 1e6, path.stat().st_size / seconds / 1e6
            rows.append(
                (registers, values, f"{of_frames:.0f}", f"{of_file:.0f}", f"{values / seconds / 1e6:.1f}")
            )
    tables.show(("registers", "values", "MB/s of frames", "MB/s of file", "million values/s"), rows)


def write(path: Path, registers: int, least_bytes: float) -> int:
    """Write a capture with at least `least_bytes` bytes of frames; return their actual number."""
    records, size = [], 0
    for time_us, frame in enumerate(frames(registers)):
        records.append(struct.pack("<IIII", 0, time_us, len(frame), len(frame)) + frame)
        size += len(frame)
    times = int(least_bytes // size) + 1
    header = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, USER_LINK_TYPE)
    path.write_bytes(header + times * b"".join(records))
    return times * size


def frames(registers: int) -> Iterator[bytes]:
    chance = random.Random(1)
    for _ in range(EXCHANGES):
        asked = Message(chance.randint(1, 31), 3, chance.choice([0, 100, 500, 0x2000]), registers)
        yield build_request(Framing.RTU, asked)
        yield build_reply(Framing.RTU, Message(asked.address, 3, data=chance.randbytes(2 * registers)))


def decoded(path: Path) -> tuple[int, float]:
    """Decode a capture; return the number of values, and the CPU seconds."""
    begun = time.process_time()
    with Capture(path) as capture:
        values = sum(map(len, Decoding(capture)))
    return values, time.process_time() - begun


if __name__ == "__main__":
    main()
