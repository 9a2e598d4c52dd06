"""The readers of files that may be foreign or damaged. A reader must accept a file or reject it with one
sentence. Other exceptions, hangs and unlimited memory are failures. Accepted content must stay the same when
it is written and read again.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

from modbus_requests import read_requests
from recordings import is_kept

from multidrop.capture import Capture, CaptureError, Decoding, Junk, Pairing
from multidrop.core import Splitter
from multidrop.drive.declaration_check import UNIT_IDS
from multidrop.drive.line_settings import SERIAL_ADDRESSES
from multidrop.drive.register import Access
from multidrop.families.files import FamilyError
from multidrop.families.files.loader import load_family
from multidrop.history.growing import GrowingSegment
from multidrop.importers import SUFFIXES, ImportedDevice, family_text, plant_text, read_devices
from multidrop.planning.blocks import blocks
from multidrop.plant.loader import PlantError, load_plant
from multidrop.plant.model import Plant
from multidrop.polling.batch import Row, Rows
from multidrop.recording import Metadata, open_recording, open_writer, repair
from multidrop.recording.rows import from_rows
from multidrop.samples.message import MOST_ROWS, ROWS, MessageError, unpack
from multidrop.sim.faults import load_faults

PLANT = """
[[line]]
name = "hall-1"
port = "/dev/ttyUSB0"
baudrate = 9600
format = "8N1"

[[line.drive]]
name = "pump-1"
model = "innovert-ibd"
address = 1
framing = "rtu"
every = "50 ms"
poll = ["output_current", { register = "motor_speed", every = "20 ms" }]

[[line.drive]]
name = "fan"
model = "erman-er-g-220"
address = 2
baudrate = 38400

[[line.drive]]
name = "belt"
model = "delixi-native"
address = 3
"""


@contextmanager
def refused(kind: type[ValueError], path: Path) -> Iterator[None]:
    """Allow this kind of error in the block, and check that each line of the error's text names the file."""
    mistakes: list[ValueError] = []
    try:
        yield
    except kind as mistake:
        mistakes.append(mistake)
    for mistake in mistakes:
        assert type(mistake) is kind, repr(mistake)
        for sentence in str(mistake).split("\n"):
            assert sentence.startswith(str(path)), mistake
            assert len(sentence) > len(str(path)) + 10, mistake


def read_plant(path: Path) -> None:
    with refused(PlantError, path):
        plant = load_plant(path)
        names = [polled.drive.name for line in plant.lines for polled in line.drives]
        assert len(names) == len(set(names)) > 0
        json.dumps(plant.metadata())


def read_family(path: Path) -> None:
    """Read a family's TOML file and its CSV file; in the input, a line with a NUL byte separates them."""
    toml, _, csv = path.read_bytes().partition(b"\n\0\n")
    path.write_bytes(toml)
    path.with_suffix(".csv").write_bytes(csv)
    with refused(FamilyError, path.with_suffix("")):
        family = load_family(path)
        assert load_family(path) is family
        drive = family(family.addresses[0])
        for register in drive.readings():
            (block,) = blocks(drive, [register])
            assert block.offset(register) >= 0
            register.format(register.decode(1))


def read_import(path: Path) -> None:
    """Import another program's file, and load the imported families; the input's first line is the suffix."""
    first, _, contents = path.read_bytes().partition(b"\n")
    suffix = first.decode(errors="replace")
    source = path.with_name(f"imported{suffix if suffix in SUFFIXES else '.csv'}")
    source.write_bytes(contents)
    devices: list[ImportedDevice] = []
    with refused(ValueError, source), suppress(ImportError):
        devices = read_devices(source)
    for device in devices:
        made = path.with_name("made.toml")
        made.write_text(family_text(device, source.name), "utf-8")
        family = load_family(made)
        assert list(family.registers) == [register.name for register in device.registers]
        assert list(family.texts) == [text.name for text in device.texts]
        assert {register.access for register in family.registers.values()} <= {Access.READING}
        is_serial = bool(device.line.port) and not device.line.is_network
        addresses = SERIAL_ADDRESSES if is_serial else UNIT_IDS
        if device.address in addresses and device.registers:
            plant = path.with_name("plant.toml")
            plant.write_text(plant_text(device, made.name), "utf-8")
            load_plant(plant)


def read_faults(path: Path) -> None:
    with refused(ValueError, path):
        load_faults(path)


def read_recording(path: Path) -> None:
    with refused(ValueError, path):
        reader = open_recording(path)
        batches = list(reader)
        rows = _comparable(batches)
        again = _written_again(path, ".arrows", reader.metadata, batches)
        assert len(again) == len(rows)
        assert all(map(is_kept, again, rows))
        if reader.truncated:
            assert repair(path) == reader.truncated
            repaired = open_recording(path)
            assert (repaired.truncated, _comparable(repaired)) == (0, rows)


def read_segment(path: Path) -> None:
    """Read an .arrows file, also as a segment of a history, which must have the same rows."""
    read_recording(path)
    batches: list[Rows] = []
    found: list[Row] = []
    with suppress(ValueError):
        segment = GrowingSegment(path)
        segment.read_new()
        for batch in segment.batches(*ALWAYS):
            found += segment.rows_of(batch, None, *ALWAYS)
        segment.let_go()
    with suppress(ValueError):
        batches.extend(open_recording(path))
    assert _comparable([from_rows(found)] if found else []) == _comparable(batches)


ALWAYS = -(1 << 64), 1 << 64  # ns; before and after the time of every row


@cache
def known_plant(folder: Path) -> Plant:
    (folder / "known.toml").write_text(PLANT)
    return load_plant(folder / "known.toml")


def read_capture(path: Path) -> None:
    for known in (known_plant(path.parent), None):
        with refused(CaptureError, path), Capture(path) as capture:
            for batch in Decoding(capture, known):
                assert len(_comparable([batch])) == len(batch)
    with refused(CaptureError, path), Capture(path) as capture:
        _pair(capture)


def read_samples(path: Path) -> None:
    """Read a message with samples of a fleet; errors need not name the file."""
    with suppress(MessageError):
        rows = unpack(path.read_bytes())
        assert rows.schema == ROWS
        assert len(rows) <= MOST_ROWS
        rows.validate(full=True)


def _pair(capture: Capture) -> None:
    """Pair requests and replies of a capture; check that every exchange, frame and byte is counted."""
    pairings: list[Pairing] = []
    splitters: list[Splitter] = []
    junk = exchanges = 0
    for _ in capture:
        for at, stream in enumerate(capture.streams):
            if at == len(pairings):
                pairings.append(Pairing())
                splitters.append(Splitter())
            told = list(pairings[at].pair(splitters[at].spans(stream)))
            junk += sum(len(record.raw) for record in told if isinstance(record, Junk))
            exchanges += sum(
                1 for record in told if not isinstance(record, Junk) and record.request and record.reply
            )
    for pairing in pairings:
        junk += sum(len(each.raw) for each in pairing.flush() if isinstance(each, Junk))
    assert junk == sum(each.counts()["unknown_bytes"] for each in pairings)
    assert exchanges == sum(each.counts()["exchanges"] for each in pairings)


def _comparable(batches: Iterable[Rows]) -> list[Row]:
    """Return all rows, with NaN moved into the status, because NaN does not equal itself."""
    rows = [row for batch in batches for row in batch]
    return [
        row._replace(value=None, status=f"nan {row.status}") if row.value != row.value else row
        for row in rows
    ]


def _written_again(path: Path, suffix: str, metadata: Metadata, batches: list[Rows]) -> list[Row]:
    copy = path.with_name("again" + suffix)
    copy.unlink(missing_ok=True)
    with open_writer(copy, metadata) as writer:
        for batch in batches:
            writer.write(batch)
    assert json.dumps(open_recording(copy).metadata) == json.dumps(metadata)
    return _comparable(open_recording(copy))


READERS: dict[str, tuple[str, Callable[[Path], None]]] = {  # reader: suffix of its files, function
    "plant": (".toml", read_plant),
    "family": (".toml", read_family),
    "import": (".txt", read_import),
    "faults": (".toml", read_faults),
    "arrows": (".arrows", read_segment),
    "csv": (".csv", read_recording),
    "parquet": (".parquet", read_recording),
    "pcap": (".pcapng", read_capture),
    "mbap": (".bin", read_requests),
    "samples": (".bin", read_samples),
}


def read(name: str, data: bytes, folder: Path) -> None:
    """Write these bytes into a file, and pass the file to the reader."""
    suffix, reader = READERS[name]
    path = folder / f"fuzzed{suffix}"
    path.write_bytes(data)
    reader(path)
