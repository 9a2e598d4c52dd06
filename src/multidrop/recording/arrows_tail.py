"""Read what comes to an .arrows file while it grows, and any batch of it again."""

from __future__ import annotations

import os
import struct
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from multidrop.core import Names
from multidrop.recording.arrow_decoder import BatchDecoder, RecordedColumns
from multidrop.recording.arrow_ipc import RECORD_BATCH, IpcMessage, messages
from multidrop.recording.arrows import ArrowsReader


class BatchPlace(NamedTuple):
    """A batch's place in the file, and the names that its codes stand for."""

    message: IpcMessage
    names: dict[int, Names]


class RecordedBatch(NamedTuple):
    """A batch, and where it is."""

    columns: RecordedColumns
    place: BatchPlace


class ArrowsTail:
    """Yields each whole batch of a file once, also when the file is removed meanwhile.

    Raises ValueError for a file that is no recording, and OSError.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = path.open("rb", buffering=0)  # a buffer would keep what was cut off
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
        """Bytes at the end that are no whole batch yet, or never will be."""
        return self._size() - self._end

    def new(self) -> Iterator[RecordedBatch]:
        """Yield the batches that came since the last call. Raises ValueError where the file is damaged."""
        for message in messages(self._file, self._size(), self._end):
            if not message.header:
                return
            body = self._body(message)
            try:
                if message.kind != RECORD_BATCH:  # again with its batch: a full disk may have cut both off
                    self._decoder.decode(message, message.header, body)
                    continue
                place = BatchPlace(message, self._decoder.known)
                batch = RecordedBatch(self._decoder.columns(message.header, body, place.names), place)
            except (struct.error, RuntimeError, ValueError) as error:
                raise ValueError(f"{self.path} is damaged: {error}") from error
            self._end = message.end
            yield batch

    def again(self, place: BatchPlace) -> RecordedColumns:
        """Return a batch that `new` gave before. Raises ValueError."""
        assert place.message.header
        return self._decoder.columns(place.message.header, self._body(place.message), place.names)

    def _body(self, message: IpcMessage) -> memoryview:
        length, place = message.end - message.body, message.body
        if sys.platform != "win32":
            return memoryview(os.pread(self._file.fileno(), length, place))
        with self.path.open("rb") as file:  # Windows keeps the name of a file that is open
            file.seek(place)
            return memoryview(file.read(length))

    def close(self) -> None:
        self._file.close()
