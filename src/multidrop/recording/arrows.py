"""Recordings as an Arrow IPC stream (.arrows): every complete batch is readable after a crash.

The stream has no end marker, which Arrow permits. So the file is valid after every batch, and a recording in
progress is read like a finished recording.
"""

from __future__ import annotations

import os
import struct
import sys
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from multidrop.core import Names
from multidrop.polling.batch import Rows
from multidrop.recording.arrow_decoder import BatchDecoder, FlatTable, IpcMessage, RecordedColumns, messages
from multidrop.recording.arrow_encoder import (
    COLUMNS,
    COLUMNS_BEFORE,
    DICTIONARY_BATCH,
    RECORD_BATCH,
    SCHEMA,
    Encoder,
    FileColumn,
    schema_message,
)
from multidrop.recording.format import METADATA_KEY, AppendingWriter, Metadata, RecordingReader, dump_metadata


class ArrowsWriter(AppendingWriter):
    """Appends each batch, with the dictionaries that it needs, in one write."""

    def __init__(self, path: Path, metadata: Metadata) -> None:
        schema = schema_message({METADATA_KEY.encode(): dump_metadata(metadata).encode()})
        self._encoder = Encoder()
        super().__init__(path)
        try:
            self._append(schema)
        except OSError:
            self.discard()
            raise

    def write(self, batch: Rows) -> None:
        try:
            self._append(self._encoder.encode(batch))
        except BaseException:  # any exception, because a signal handler may raise it
            self._encoder.forget_dictionaries()
            raise
        self.rows += len(batch)


class ArrowsReader(RecordingReader):
    """Reads all complete messages of a file, and skips a truncated message at its end."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        with path.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            self._whole = 0
            for message in messages(file, size):
                if not self._whole:
                    self.metadata = self._read_schema(message)
                # Count a dictionary at the end of the file, without its batch, as truncated. Other libraries
                # cannot read such a file.
                elif message.kind == DICTIONARY_BATCH:
                    continue
                self._whole = message.end
        if not self._whole:
            raise self._not_a_recording("it does not start like an Arrow stream")
        self.truncated = size - self._whole

    def __iter__(self) -> Iterator[Rows]:
        rows = 0
        decoder = BatchDecoder(self._columns)
        with self.path.open("rb") as file:
            for message in islice(messages(file, self._whole), 1, None):
                if not message.header:
                    return
                file.seek(message.body)
                body = memoryview(file.read(message.end - message.body))
                try:
                    batch = decoder.decode(message, message.header, body)
                except (struct.error, RuntimeError, ValueError) as error:
                    raise self._damaged(rows, error) from error
                if batch is not None:
                    yield batch
                    rows += len(batch)

    @property
    def columns(self) -> list[tuple[FileColumn, int | None]]:
        """The columns of the file, each with the id of its dictionary or None."""
        return self._columns

    def _read_schema(self, message: IpcMessage) -> Metadata:
        try:
            head = message.header if message.kind == SCHEMA else None
            fields = head.tables(1) if head else []
            known = _described(*map(_column, fields))
            if not head or not known:
                raise self._not_a_recording("it is an Arrow stream with other columns")
            self._columns = list(zip(known, map(_dictionary, fields), strict=True))
            entries = {entry.text(0): entry.text(1) for entry in head.tables(2)}
        except struct.error as error:
            raise self._not_a_recording("it does not start like an Arrow stream") from error
        return self._parse_metadata(entries.get(METADATA_KEY.encode(), b"{}"))


def _column(field: FlatTable) -> FileColumn:
    """Return a column as the file describes it. `code_bits` is -1 if its codes are not unsigned integers."""
    detail, coded = field.table(3), field.table(4)
    index = coded.table(1) if coded else None
    is_unsigned = index is not None and not index.number(1, "<?")
    bits = index.number(0, "<i") if index and is_unsigned else -1 if coded else 0
    return FileColumn(field.text(0), field.number(2, "<B"), detail.number(0, "<h") if detail else 0, bits)


def _dictionary(field: FlatTable) -> int | None:
    coded = field.table(4)
    return coded.number(0, "<q") if coded else None


def _described(*found: FileColumn) -> tuple[FileColumn, ...] | None:
    """Return COLUMNS or COLUMNS_BEFORE if these are the file's columns, else None."""
    for known in (COLUMNS, COLUMNS_BEFORE):
        if found == tuple(column._replace(nullable=False) for column in known):
            return known
    return None


writer, reader = ArrowsWriter, ArrowsReader


class BatchPlace(NamedTuple):
    """The position of a batch in its file, and the dictionaries of its codes."""

    message: IpcMessage
    names: dict[int, Names]


class RecordedBatch(NamedTuple):
    """The columns of a batch, and its position in the file."""

    columns: RecordedColumns
    place: BatchPlace


class ArrowsTail:
    """Reads each complete batch of a growing file once. It continues if the file is removed while open.

    Raises ValueError for a file that is not a recording, and OSError.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        # unbuffered, because a buffer could still hold bytes that the writer has cut off
        self._file = path.open("rb", buffering=0)
        try:
            reader = ArrowsReader(path)
            self.metadata = reader.metadata
            self._decoder = BatchDecoder(reader.columns)
            self._end = next(messages(self._file, self._size())).end
        except BaseException:
            self._file.close()
            raise

    def _size(self) -> int:
        return os.fstat(self._file.fileno()).st_size

    @property
    def left_out(self) -> int:
        """The number of bytes of an incomplete batch at the file's end."""
        return self._size() - self._end

    def new(self) -> Iterator[RecordedBatch]:
        """Yield the batches appended since the last call. Raises ValueError if the file is damaged."""
        for message in messages(self._file, self._size(), self._end):
            if not message.header:  # the end marker of a stream that another program wrote
                self._end = message.end
                return
            body = self._body(message)
            try:
                # Read a dictionary again in the next call until its batch is complete: if the writer cannot
                # write the batch, it removes both from the file.
                if message.kind != RECORD_BATCH:
                    self._decoder.decode(message, message.header, body)
                    continue
                place = BatchPlace(message, self._decoder.known)
                batch = RecordedBatch(self._decoder.columns(message.header, body, place.names), place)
            except (struct.error, RuntimeError, ValueError) as error:
                raise ValueError(f"{self.path} is damaged: {error}") from error
            self._end = message.end
            yield batch

    def again(self, place: BatchPlace) -> RecordedColumns:
        """Return the columns of a batch that `new` yielded before. Raises ValueError if it is damaged."""
        assert place.message.header
        return self._decoder.columns(place.message.header, self._body(place.message), place.names)

    def _body(self, message: IpcMessage) -> memoryview:
        length, place = message.end - message.body, message.body
        if sys.platform != "win32":
            return memoryview(os.pread(self._file.fileno(), length, place))
        # Windows has no pread. The path still leads to the same file: Windows does not remove an open file.
        with self.path.open("rb") as file:
            file.seek(place)
            return memoryview(file.read(length))

    def close(self) -> None:
        self._file.close()
