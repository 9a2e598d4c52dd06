"""Recordings as an Arrow IPC stream (.arrows), in which every whole batch outlives a crash.

The stream has no end marker, which Arrow allows: it is complete after every batch, and a recording
under way can be read as a finished one.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import Any

from multidrop.polling.batch import Rows, assemble, schema
from multidrop.recording.arrow_ipc import RECORD_BATCH, SCHEMA, FlatTable, IpcMessage, messages
from multidrop.recording.format import METADATA_KEY, AppendingWriter, Metadata, RecordingReader, dump_metadata
from multidrop.recording.rows import RecordedRows

INT, FLOAT, UTF8, TIMESTAMP = 2, 3, 5, 10  # Field.type_type
COLUMNS = [  # name, type, and the first field of the type: bits, precision (double) or unit (ns)
    (b"time", TIMESTAMP, 3),
    (b"monotonic_ns", INT, 64),
    (b"uncertainty_ns", INT, 64),
    (b"drive", UTF8, 0),
    (b"register", UTF8, 0),
    (b"value", FLOAT, 2),
    (b"status", UTF8, 0),
]
BUFFERS = {INT: 2, FLOAT: 2, TIMESTAMP: 2, UTF8: 3}  # that a column has in a batch


class ArrowsWriter(AppendingWriter):
    """Write each batch as one message."""

    def __init__(self, path: Path, metadata: Metadata) -> None:
        from nanoarrow.c_array_stream import CArrayStream
        from nanoarrow.ipc import StreamWriter

        described = schema().modify(metadata={METADATA_KEY: dump_metadata(metadata)})
        self._message = BytesIO()
        self._encoder = StreamWriter.from_writable(self._message)
        super().__init__(path)
        try:
            self._append_message(CArrayStream.from_c_arrays([], described))
        except OSError:
            self.discard()
            raise

    def write(self, batch: Rows) -> None:
        self._append_message(batch.arrow())
        self.rows += len(batch)

    def _append_message(self, source: Any) -> None:
        self._message.seek(0)
        self._encoder.write_stream(source)
        # Released here: a view that an exception's traceback keeps would forbid the next message.
        with self._message.getbuffer() as room, room[: self._message.tell()] as message:
            self._append(message)

    def close(self) -> None:
        self._encoder.release()
        super().close()


class ArrowsReader(RecordingReader):
    """Read every whole message; a truncated one at the end is left out."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        with path.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            self._whole = 0
            for message in messages(file, size):
                if not self._whole:
                    self.metadata = self._read_schema(message)
                self._whole = message.end
        if not self._whole:
            raise self._not_a_recording("it does not begin like an Arrow stream")
        self.truncated = size - self._whole

    def __iter__(self) -> Iterator[Rows]:
        rows = 0
        with self.path.open("rb") as file:
            for message in islice(messages(file, self._whole), 1, None):
                if not message.header:
                    return
                file.seek(message.body)
                body = memoryview(file.read(message.end - message.body))
                try:
                    batch = _decode(message, message.header, body)
                except (struct.error, RuntimeError, ValueError) as error:
                    raise self._damaged(rows, error) from error
                yield batch
                rows += len(batch)

    def _read_schema(self, message: IpcMessage) -> Metadata:
        try:
            head = message.header if message.kind == SCHEMA else None
            if not head or [_column(field) for field in head.tables(1)] != COLUMNS:
                raise self._not_a_recording("it is an Arrow stream with other columns")
            entries = {entry.text(0): entry.text(1) for entry in head.tables(2)}
        except struct.error as error:
            raise self._not_a_recording("it does not begin like an Arrow stream") from error
        return self._parse_metadata(entries.get(METADATA_KEY.encode(), b"{}"))


def _column(field: FlatTable) -> tuple[bytes, int, int]:
    detail = field.table(3)
    return field.text(0), field.number(2, "<B"), detail.number(0, "<h") if detail else 0


def _check_text(offsets: memoryview, text: memoryview) -> None:
    """Raise ValueError unless each row's text is UTF-8: libraries that take the batch rely on it."""
    if str(text, "utf-8").isascii():
        return
    for at in offsets[: len(offsets) // 4 * 4].cast("i"):
        if 0 <= at < len(text) and text[at] & 0xC0 == 0x80:  # within a character
            raise ValueError("its text is not UTF-8")


def _decode(message: IpcMessage, batch: FlatTable, body: memoryview) -> RecordedRows:
    if message.kind != RECORD_BATCH:
        raise ValueError("there is a message that is not a batch of rows")
    if batch.table(3):
        raise ValueError("its batches are compressed, which only pyarrow and polars read")
    rows, places = batch.number(0, "<q"), batch.pairs(2)
    if not 0 <= rows <= len(body):  # sums with it must not wrap around
        raise ValueError(f"there is a batch of {rows} rows in {len(body)} bytes")
    if len(places) != sum(BUFFERS[kind] for _, kind, _ in COLUMNS):
        raise ValueError(f"there is a batch of {len(places)} buffers")
    buffers = iter([body[at : at + length] for at, length in places])
    columns: list[tuple[memoryview | None, ...]] = []
    for _, kind, _ in COLUMNS:
        valid, *data = islice(buffers, BUFFERS[kind])
        if kind == UTF8:
            _check_text(*data)
        columns.append((valid or None, *data))
    return RecordedRows(assemble(rows, *columns))


writer, reader = ArrowsWriter, ArrowsReader
