"""Make the fuzzers' seeds: frames from the manuals, captures of the frames, and valid files.

python tests/fuzz/seeds.py DIRECTORY HARNESS...    write each harness's seeds to DIRECTORY/HARNESS-seeds
"""

from __future__ import annotations

import struct
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

sys.path.extend(map(str, (Path(__file__).parents[1] / "support").iterdir()))

import pyarrow as pa
from batches import counting, example
from frames import PRINTED, Printed
from imported import FILES
from profile_families import METER, METER_CSV
from readers import PLANT

from multidrop.capture import CaptureWriter, Side
from multidrop.core import Framing, Message
from multidrop.recording import open_writer
from multidrop.samples.message import RowBuffer

EXCHANGES = [each for each in PRINTED if each.request is not None]
RTU = [exchange for exchange in EXCHANGES if exchange.framing is Framing.RTU]
TCP = 15  # Modbus TCP, in the framing byte of fuzz.h
WAKE, TAKE, NOISE = 2, 3, 4  # steps in an input of fuzz_line.c
TIME = 1_700_000_000


def asked(printed: Printed) -> bytes:
    """Return the request in the format of `request_of` in fuzz.h."""
    message = printed.request or printed.says
    assert isinstance(message, Message)
    data = (message.data + bytes(2))[:2]
    return struct.pack(
        ">BBBHH2s", printed.framing, message.address, message.function, message.start, message.count, data
    )


def over_tcp(printed: Printed, transaction: int) -> Iterator[bytes]:
    """Yield the request in the format of `request_of`, and both frames of the exchange in Modbus TCP."""
    yield bytes([TCP]) + asked(printed)[1:]
    for frame in (printed.request_frame, printed.frame):
        yield struct.pack(">HHH", transaction, 0, len(frame) - 2) + frame[:-2]


def frame() -> Iterator[bytes]:
    for exchange in EXCHANGES:
        yield asked(exchange) * 2 + exchange.frame
        yield asked(exchange) * 2 + exchange.request_frame
    for each in RTU:
        request, sent, answered = over_tcp(each, 7)
        yield request * 2 + answered
        yield request * 2 + sent


def came(frame: bytes) -> bytes:
    return bytes([3, len(frame)]) + frame


def tcp() -> Iterator[bytes]:
    for header in (bytes([0, 20]), bytes([1, 20])):
        for each in RTU:
            request, _, answered = over_tcp(each, 1)
            yield header + b"\0" + request + bytes([3, len(answered)]) + answered
            yield header + b"\0" + request + bytes([2, 2, 0]) + request + bytes([3, len(answered)]) + answered
            good, again = header + b"\0" + request + came(answered), b"\0" + request
            second, third = (struct.pack(">H", number) + answered[2:] for number in (2, 3))
            lying = second[:5] + bytes([second[5] + 1]) + second[6:]
            for odd in (second[:-1], lying, second + b"\0\0"):  # a wrong reply, then another exchange
                yield good + again + came(odd) + b"\2\2" + again + came(third)


def line() -> Iterator[bytes]:
    header = bytes([0, 20, 20, 0])
    for exchange in EXCHANGES:
        begun = bytes([0, 4, 40]) + asked(exchange) + bytes([WAKE, TAKE, 255])
        yield header + begun + bytes([WAKE, NOISE, len(exchange.frame)]) + exchange.frame
        yield header + begun + bytes([WAKE, WAKE, NOISE, len(exchange.frame)]) + exchange.frame + begun


def split() -> Iterator[bytes]:
    pieces = [
        bytes([0, len(exchange.request_frame)])
        + exchange.request_frame
        + bytes([8, len(exchange.frame)])
        + exchange.frame
        for exchange in EXCHANGES
    ]
    yield from pieces
    yield b"".join(pieces)[:2000]


def rtac(printed: Printed) -> Iterator[bytes]:
    """Yield packets of the exchange's frames with the header of RTAC serial (link type 250)."""
    for event, raw in ((1, printed.request_frame), (2, printed.frame)):
        yield struct.pack(">IIBBH", TIME, 5000 * event, event, 0, 0) + raw


def pcap(packets: list[bytes]) -> bytes:
    return b"".join(struct.pack("<4I", TIME, 0, len(packet), len(packet)) + packet for packet in packets)


def ours() -> tuple[bytes, int]:
    """Return a capture from CaptureWriter, and the offset of its packets."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.pcapng"
        with CaptureWriter(path) as capture:
            for number, each in enumerate(EXCHANGES):
                capture.write(each.request_frame, Side.ASKING, TIME * 10**9 + number, "hall-1")
                begin = 0 if number else path.stat().st_size
                capture.write(each.frame, Side.ANSWERING, TIME * 10**9 + number, "hall-1")
                if number == 0:
                    first = begin
        whole = path.read_bytes()
    return whole, first


def capture() -> Iterator[bytes]:
    packets = [packet for exchange in EXCHANGES for packet in rtac(exchange)]
    yield bytes([0b0000, 9]) + pcap(packets)
    yield bytes([0b1000, 0]) + pcap([exchange.request_frame + exchange.frame for exchange in EXCHANGES])
    whole, first = ours()
    yield bytes([0b10101, 1]) + whole[first:][:4000]


def columns() -> Iterator[bytes]:
    for wire in range(10):
        field = bytes([0, 1, wire, 3, 4, 9])
        yield bytes([4, 9, 4, 99, 5, 0x55, 0, 1]) + field * 4 + bytes(range(200, 230))


def plant() -> Iterator[bytes]:
    yield PLANT.encode()
    yield b'[[line]]\nname = "a"\nport = "b"\n[[line.drive]]\nname = "c"\nmodel = "yd1000"\naddress = 1\n'


def family() -> Iterator[bytes]:
    for path in sorted((Path(__file__).parents[1] / "data" / "families").glob("*.toml")):
        yield path.read_bytes()
    meter = METER.replace("meter.csv", "fuzzed.csv")
    yield meter.encode() + b"\n\0\n" + METER_CSV.encode()


def imported() -> Iterator[bytes]:
    for suffix, texts in FILES.items():
        for text in texts:
            yield f"{suffix}\n{text}".encode()


def faults() -> Iterator[bytes]:
    yield b'seed = 7\ndrop = 0.01\nflip = 0.5\nlate = "100 ms"\nburst = 32\nhang_up = 0\naway = "1 s"\n'


def recorded(suffix: str) -> Iterator[bytes]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a{suffix}"
        with open_writer(path, {"plant": "a.toml"}) as writer:
            writer.write(example())
            writer.write(counting(3))
        yield path.read_bytes()


def captures() -> Iterator[bytes]:
    yield ours()[0][:1500]
    magic = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 250)
    yield magic + pcap([packet for exchange in EXCHANGES[:6] for packet in rtac(exchange)])


def requests() -> Iterator[bytes]:
    """Yield byte streams of Modbus TCP clients: reads, writes, stops, a broadcast and invalid bytes."""
    bodies = [
        *("01 03 30 00 00 02", "01 04 F0 00 00 0B", "02 01 00 00 00 04", "02 02 00 00 00 01"),
        *("01 06 20 00 13 88", "01 06 10 00 00 05", "01 06 F0 0A 00 01", "02 05 00 01 FF 00"),
        *("01 10 20 00 00 01 02 13 88", "02 0F 00 01 00 01 01 01", "01 2B 0E 01 00", "00 06 10 00 00 05"),
    ]
    frames = [
        struct.pack(">HHH", number, 0, len(bytes.fromhex(body))) + bytes.fromhex(body)
        for number, body in enumerate(bodies)
    ]
    yield b"\x3f" + b"".join(frames)
    yield b"\x00" + b"".join(frames[:3]) + b"GET / HTTP/1.1"
    for frame in frames:
        yield b"\x0b" + frame


def samples() -> Iterator[bytes]:
    """Yield messages with samples of a fleet: compressed, and, from pyarrow, without compression."""
    for batch in (example(), counting(3)):
        buffer = RowBuffer()
        buffer.add(batch.columns())
        for message in buffer.messages(900_000):
            yield message.data
    with pa.ipc.open_stream(message.data) as reader, pa.BufferOutputStream() as bare:
        with pa.ipc.new_stream(bare, reader.schema) as writer:
            writer.write_table(reader.read_all())
        yield bare.getvalue().to_pybytes()


SEEDS: dict[str, Callable[[], Iterator[bytes]]] = {
    "frame": frame,
    "line": line,
    "tcp": tcp,
    "split": split,
    "capture": capture,
    "columns": columns,
    "plant": plant,
    "family": family,
    "import": imported,
    "faults": faults,
    "arrows": lambda: recorded(".arrows"),
    "csv": lambda: recorded(".csv"),
    "parquet": lambda: recorded(".parquet"),
    "pcap": captures,
    "mbap": requests,
    "samples": samples,
}


def main(directory: str, *harnesses: str) -> None:
    for harness in harnesses:
        into = Path(directory) / f"{harness}-seeds"
        into.mkdir()
        for number, seed in enumerate(SEEDS[harness]()):
            (into / f"seed-{number}").write_bytes(seed)


if __name__ == "__main__":
    main(*sys.argv[1:])
