"""Write recordings for tests, and read their rows with the library and with pyarrow."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pyarrow as pa
from batches import SECOND, UTC_0

from multidrop.polling.batch import Row
from multidrop.recording import open_recording, open_writer
from multidrop.recording.rows import from_rows

FAULTS = {"NONE": 0, "OVERHEAT": 8, "OVERLOAD": 9}
ABOUT: dict[str, Any] = {
    "plant": "hall.toml",
    "drives": {
        "pump": {
            "line": "hall-1",
            "model": "invt-che",
            "address": 1,
            "settings": "9600 8N1",
            "framing": "rtu",
            "registers": {
                "output_frequency": {"unit": "Hz", "step": 0.01, "function": 3, "address": 7, "words": 1},
                "fault": {"unit": "", "step": 1, "values": FAULTS, "function": 3, "address": 8, "words": 1},
            },
        },
        "fan": {
            "framing": "rtu",
            "registers": {
                "output_current": {"unit": "A", "step": None, "function": 3, "address": 4, "words": 1}
            },
        },
    },
}


def row(
    second: float, drive: str, register: str, value: float | None, status: str = "ok", ms: float = 20.0
) -> Row:
    at = round(second * SECOND)
    uncertainty = None if value is None else round(ms * 1e6)
    return Row(UTC_0 + at, at, uncertainty, drive, register, value, status)


def record(path: Path, rows: list[Row], about: dict[str, Any] = ABOUT, pieces: int = 7) -> Path:
    with open_writer(path, about) as writer:
        for at in range(0, len(rows), len(rows) // pieces + 1):
            writer.write(from_rows(rows[at : at + len(rows) // pieces + 1]))
    return path


SCHEMA = pa.schema(
    [
        pa.field("time", pa.timestamp("ns", "UTC"), nullable=False),
        pa.field("monotonic_ns", pa.int64(), nullable=False),
        pa.field("uncertainty_ns", pa.int64()),
        pa.field("drive", pa.string(), nullable=False),
        pa.field("register", pa.string(), nullable=False),
        pa.field("value", pa.float64()),
        pa.field("status", pa.string(), nullable=False),
    ]
)

FILE_SCHEMA = pa.schema(  # schema of .arrows: names are dictionary-encoded, the uncertainty is rounded up
    [
        *(SCHEMA.field(name) for name in ("time", "monotonic_ns")),
        pa.field("uncertainty_ns", pa.float32()),
        pa.field("drive", pa.dictionary(pa.uint16(), pa.string()), nullable=False),
        pa.field("register", pa.dictionary(pa.uint16(), pa.string()), nullable=False),
        SCHEMA.field("value"),
        pa.field("status", pa.dictionary(pa.uint8(), pa.string()), nullable=False),
    ]
)


def is_kept(found: Row, written: Row) -> bool:
    """Return True if the row found in .arrows is the written row; its uncertainty may be slightly larger."""
    bound, least = found.uncertainty_ns, written.uncertainty_ns
    if bound is None or least is None:
        is_near = bound is least
    else:
        is_near = 0 <= bound - least <= (abs(least) // 2**23 if abs(least) > 2**24 else 0)
    return is_near and repr(found._replace(uncertainty_ns=0)) == repr(written._replace(uncertainty_ns=0))


def record_as_before(path: Path, *batches: Any, metadata: bytes = b"{}") -> Path:
    """Write batches with pyarrow in the file format of version 0.1: plain texts, integer nanoseconds."""
    with pa.ipc.new_stream(path, SCHEMA.with_metadata({"multidrop": metadata})) as stream:
        for batch in batches:
            stream.write_batch(pa.record_batch(batch).cast(SCHEMA))
    return path


def rows_of(table: pa.Table | pa.RecordBatch) -> list[Row]:
    """Return a pyarrow table's rows, with numeric time stamps."""
    numbers = table.set_column(0, "time", table.column("time").cast(pa.int64()))
    return [Row(*row.values()) for row in numbers.to_pylist()]


def recorded(path: Path) -> list[Row]:
    return [row for rows in open_recording(path) for row in rows]
