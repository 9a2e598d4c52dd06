"""Recordings as an Arrow IPC stream (.arrows), in which every whole batch outlives a crash.

The stream has no end marker, which Arrow allows: it is complete after every batch, and a recording
under way can be read as a finished one.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

from multidrop.polling.batch import Rows
from multidrop.recording.arrow_decoder import BatchDecoder
from multidrop.recording.arrow_encoder import Encoder
from multidrop.recording.arrow_ipc import DICTIONARY_BATCH, SCHEMA, FlatTable, IpcMessage, messages
from multidrop.recording.arrow_schema import COLUMNS, COLUMNS_BEFORE, FileColumn
from multidrop.recording.format import METADATA_KEY, AppendingWriter, Metadata, RecordingReader, dump_metadata


class ArrowsWriter(AppendingWriter):
    """Write each batch as one message, behind the dictionaries that it needs and the file does not have."""

    def __init__(self, path: Path, metadata: Metadata) -> None:
        head = Encoder.head({METADATA_KEY.encode(): dump_metadata(metadata).encode()})
        self._encoder = Encoder()
        super().__init__(path)
        try:
            self._append(head)
        except OSError:
            self.discard()
            raise

    def write(self, batch: Rows) -> None:
        piece, after = self._encoder.piece(batch)
        self._append(piece)
        self._encoder.is_written(after)
        self.rows += len(batch)


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
                elif message.kind == DICTIONARY_BATCH:  # other libraries miss the batch that it is for
                    continue
                self._whole = message.end
        if not self._whole:
            raise self._not_a_recording("it does not begin like an Arrow stream")
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
        """The columns of the file, each with its dictionary's id."""
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
            raise self._not_a_recording("it does not begin like an Arrow stream") from error
        return self._parse_metadata(entries.get(METADATA_KEY.encode(), b"{}"))


def _column(field: FlatTable) -> FileColumn:
    """Return a column as the file describes it: with -1 bits where its codes are none of ours."""
    detail, coded = field.table(3), field.table(4)
    index = coded.table(1) if coded else None
    is_unsigned = index is not None and not index.number(1, "<?")
    bits = index.number(0, "<i") if index and is_unsigned else -1 if coded else 0
    return FileColumn(field.text(0), field.number(2, "<B"), detail.number(0, "<h") if detail else 0, bits)


def _dictionary(field: FlatTable) -> int | None:
    """Return the id of a column's dictionary."""
    coded = field.table(4)
    return coded.number(0, "<q") if coded else None


def _described(*found: FileColumn) -> tuple[FileColumn, ...] | None:
    """Return the columns of a recording, of now or before, that are described so."""
    for known in (COLUMNS, COLUMNS_BEFORE):
        if found == tuple(column._replace(nullable=False) for column in known):
            return known
    return None


writer, reader = ArrowsWriter, ArrowsReader
