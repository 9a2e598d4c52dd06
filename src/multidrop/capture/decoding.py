"""Captures as columns: a row for every register that was read or written, and for every miss.

Rows are those of a poll: `time` is the request's time stamp, and the value was taken between it and the
reply's. A capture has one clock only: `monotonic_ns` equals `time`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from multidrop.capture.lookup import RegisterLookup, RequestTarget, line_of
from multidrop.capture.pcapng_reader import Capture
from multidrop.core import Columns, Decoded, Decoder, Field, Framing, Names, RowLayout, Stream
from multidrop.drive.row_field import row_field
from multidrop.plant.model import Plant, PlantLine
from multidrop.polling.batch import Batch

ROWS = 1 << 16  # of a batch, at most
_MOST_NAMES = 60_000  # of registers; a column's codes end at 65535


class Decoding:
    """The rows of a capture as batches, each of one line."""

    def __init__(self, capture: Capture, known: Plant | None = None) -> None:
        self._capture = capture
        self._plant = known
        self._lines: list[_LineDecoding] = []

    def __iter__(self) -> Iterator[Batch]:
        lines, names = self._lines, self._capture.lines
        for _ in self._capture:
            lines += [_LineDecoding(line_of(self._plant, name)) for name in names[len(lines) :]]
            for line, stream in zip(lines, self._capture.streams, strict=True):
                yield from line.decode(stream)
        for line in lines:
            yield from line.rest()

    def counts(self) -> Counter[str]:
        """Return the numbers of exchanges, frames, unknown bytes and so on decoded so far, of all lines."""
        return sum((Counter(line.decoder.counts()) for line in self._lines), Counter())


class _LineDecoding:
    """The decoder of one line, and the rows of its next batch."""

    def __init__(self, line: PlantLine | None) -> None:
        self._lookup = RegisterLookup(line)
        self.decoder = Decoder()
        self._begin()

    def _begin(self) -> None:
        self._columns = Columns(ROWS)
        self._drives = Names()
        self._registers = Names()

    def decode(self, stream: Stream) -> Iterator[Batch]:
        while (done := self.decoder.decode(stream, self._columns)) is not Decoded.ALL:
            if done is Decoded.UNKNOWN and self._learn():
                continue
            yield Batch(self._columns, self._drives, self._registers)
            self._columns = Columns(ROWS)
            if done is Decoded.UNKNOWN:  # the decoder knows too many requests
                self.decoder.forget()
                self._begin()

    def rest(self) -> Iterator[Batch]:
        if len(self._columns):
            yield Batch(self._columns, self._drives, self._registers)

    def _learn(self) -> bool:
        framing, request = self.decoder.asked
        if len(self._registers) > _MOST_NAMES:
            return False
        target = self._lookup.find(framing, request)
        is_broadcast = request.address == 0 and framing is not Framing.TCP  # nobody answers one
        block = None if is_broadcast else self._layout(target)
        return self.decoder.know(block)

    def _layout(self, target: RequestTarget) -> RowLayout:
        drive = self._drives.number(target.drive)
        fields = []
        for place in target.places:
            code = self._registers.number(place.name)
            if place.register is None:
                fields.append(Field(place.at, place.number_format, code, 1, 1))
            else:
                fields.append(row_field(place.register, place.at, code))
        return RowLayout(drive, fields)
