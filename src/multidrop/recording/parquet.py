"""Recordings as Parquet (.parquet), the smallest format for archiving; needs pyarrow.

A Parquet file can be read only after it was closed, so a crash of the writer loses the whole file. Record
into .arrows, then convert.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from io import BufferedWriter
from pathlib import Path
from typing import Any

from multidrop.polling.batch import Rows, nanoarrow, schema
from multidrop.printable import install_command
from multidrop.recording.format import (
    METADATA_KEY,
    Metadata,
    RecordingError,
    RecordingReader,
    RecordingWriter,
    dump_metadata,
    new_file,
    writing,
)
from multidrop.recording.rows import RecordedRows

GROUP_ROWS = 1 << 17  # rows per group; a group is collected in memory
TEXTS = ("drive", "register", "status")
MOST_TEXT = 1 << 26  # limit in bytes for the texts of one column in a group of rows
MOST_OF_GROUP = 1 << 29  # limit in bytes of an uncompressed group of rows
UNREADABLE = "it cannot be read, because a Parquet file is readable only once it is closed"
ENCODING = {
    "compression": "zstd",
    "use_dictionary": ["drive", "register", "status", "value"],
    "column_encoding": dict.fromkeys(("time", "monotonic_ns", "uncertainty_ns"), "DELTA_BINARY_PACKED"),
}


def _pyarrow(path: Path) -> Any:
    try:
        import pyarrow as arrow
        import pyarrow.compute
        import pyarrow.parquet
    except ImportError as failure:
        raise RecordingError(path, f"Parquet needs pyarrow: {install_command('parquet')}") from failure
    return arrow


class ParquetWriter(RecordingWriter):
    """Collects rows in memory, and writes them in large groups."""

    def __init__(self, path: Path, metadata: Metadata) -> None:
        super().__init__(path)
        self._arrow = _pyarrow(path)
        described = self._arrow.schema(schema()).with_metadata({METADATA_KEY: dump_metadata(metadata)})
        self._waiting: list[Any] = []
        with writing(path):
            self._file = BufferedWriter(new_file(path))
        self._encoder = self._arrow.parquet.ParquetWriter(self._file, described, **ENCODING)

    def write(self, batch: Rows) -> None:
        if self._file.closed:
            raise ValueError(f"{self.path} is closed: nothing can be written to it")
        self._waiting.append(self._arrow.record_batch(batch))
        self.rows += len(batch)
        if sum(map(len, self._waiting)) >= GROUP_ROWS:
            self._guarded(self._write_group)

    def close(self) -> None:
        if not self._file.closed:
            self._guarded(self._finish)

    def _write_group(self) -> None:
        self._encoder.write_table(self._arrow.Table.from_batches(self._waiting), GROUP_ROWS)
        self._waiting.clear()

    def _finish(self) -> None:
        if self._waiting:
            self._write_group()
        self._encoder.close()
        self._file.close()

    def _guarded(self, act: Callable[[], None]) -> None:
        try:
            act()
        except OSError as failure:
            with suppress(OSError):
                self._file.close()
            reason = f"cannot be written: {failure.strerror or failure}; {UNREADABLE}"
            raise RecordingError(self.path, reason) from failure


class ParquetReader(RecordingReader):
    """Reads one group of rows at a time."""

    truncated = 0

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._arrow = _pyarrow(path)
        with self._open() as file:
            found = file.schema_arrow
        wanted = self._arrow.schema(schema())
        has_units = found.names == [*wanted.names, "unit"]  # the column `unit` is in files of a history
        self._columns = wanted.names
        if found.types[: len(wanted)] != wanted.types or not (has_units or found.names == wanted.names):
            raise self._not_a_recording("it is a Parquet file with other columns")
        self.metadata = self._parse_metadata((found.metadata or {}).get(METADATA_KEY.encode(), b"{}"))
        if has_units and not self.metadata.get("drives"):  # `multidrop hub` writes such files
            raise self._not_a_recording(
                "it is a file of `multidrop hub`: read its folder with multidrop.History"
            )

    def __iter__(self) -> Iterator[Rows]:
        c_array = nanoarrow().c_array
        rows = 0
        with self._open(read_dictionary=TEXTS) as file:
            # Read in pieces: a damaged group of rows may claim any size.
            batches = file.iter_batches(GROUP_ROWS, columns=self._columns)
            while (batch := self._next(batches, rows)) is not None:
                yield RecordedRows(c_array(batch))
                rows += len(batch)

    @contextmanager
    def _open(self, read_dictionary: Sequence[str] = ()) -> Iterator[Any]:
        with self.path.open("rb") as file:
            try:
                opened = self._arrow.parquet.ParquetFile(file, read_dictionary=read_dictionary)
            except (OSError, ValueError, self._arrow.ArrowException) as failure:
                raise self._not_a_recording(f"it is not a complete Parquet file; {UNREADABLE}") from failure
            self._check_sizes(opened.metadata)
            yield opened

    def _check_sizes(self, described: Any) -> None:
        """Raise ValueError if a group of rows would take too much memory once it is unpacked."""
        # only a group's size is read: pyarrow aborts the process if the size of a column is damaged
        for number in range(described.num_row_groups):
            size = described.row_group(number).total_byte_size
            if size > MOST_OF_GROUP:
                raise self._not_a_recording(
                    f"one of its row groups has {size} bytes unpacked; the limit is {MOST_OF_GROUP}"
                )

    def _next(self, batches: Iterator[Any], rows: int) -> Any:
        """Return the next batch, or None after the last batch."""
        try:
            batch = next(batches, None)
            if batch is None:
                return None
            batch.validate(full=True)
        except (OSError, ValueError, self._arrow.ArrowException) as failure:
            raise self._damaged(rows, "the next rows cannot be unpacked") from failure
        batch = self._with_texts(batch, rows)
        for field in self._arrow.schema(schema()):
            if not field.nullable and batch[field.name].null_count:
                raise self._damaged(rows, f"a row has no value in the column {field.name}")
        return batch

    def _with_texts(self, batch: Any, rows: int) -> Any:
        """Return the batch with its dictionary codes replaced by the texts."""
        compute, columns = self._arrow.compute, []
        for name, column in zip(self._columns, batch.columns, strict=True):
            if name in TEXTS:
                lengths = compute.take(compute.binary_length(column.dictionary), column.indices)
                if (compute.sum(lengths).as_py() or 0) > MOST_TEXT:
                    raise self._damaged(rows, f"the texts of column {name} take more than {MOST_TEXT} bytes")
                column = column.dictionary_decode()
            columns.append(column)
        return self._arrow.RecordBatch.from_arrays(columns, schema=self._arrow.schema(schema()))


writer, reader = ParquetWriter, ParquetReader
