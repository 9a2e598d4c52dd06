"""Captures as columns: a row for every register that was read or written, and for every miss.

Rows are as a poll's: `time` is the request's time stamp, and the value was taken between it and the
reply's. The captures' clock is the only one, so that `monotonic_ns` is the same number as `time`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from multidrop.capture.lookup import Meaning, Meanings, line_of
from multidrop.capture.pcapng_reader import Capture
from multidrop.core import Columns, Decoded, Decoder, Field, Names, RowLayout, Stream
from multidrop.plant import model as plant
from multidrop.plant.model import Plant
from multidrop.polling.batch import Batch

ROWS = 1 << 16  # of a batch, at most
_MOST_NAMES = 60_000  # of registers; a column's codes end at 65535


class Decoding:
    """The rows of a capture, some thousands at a time, those of each line apart."""

    def __init__(self, capture: Capture, known: Plant | None = None) -> None:
        self._capture = capture
        self._plant = known
        self._lines: list[_Line] = []

    def __iter__(self) -> Iterator[Batch]:
        lines, names = self._lines, self._capture.lines
        for _ in self._capture:
            lines += [_Line(line_of(self._plant, name)) for name in names[len(lines) :]]
            for line, stream in zip(lines, self._capture.streams, strict=True):
                yield from line.hear(stream)
        for line in lines:
            yield from line.rest()

    def counts(self) -> Counter[str]:
        """How much was decoded so far, of all lines: exchanges, frames, unknown bytes and so on."""
        return sum((Counter(line.decoder.counts()) for line in self._lines), Counter())


class _Line:
    """One line's exchanges, as rows that have not been taken yet."""

    def __init__(self, line: plant.PlantLine | None) -> None:
        self._meanings = Meanings(line)
        self.decoder = Decoder()
        self._begin()

    def _begin(self) -> None:
        self._columns = Columns(ROWS)
        self._drives = Names()
        self._registers = Names()

    def hear(self, stream: Stream) -> Iterator[Batch]:
        while (done := self.decoder.decode(stream, self._columns)) is not Decoded.ALL:
            if done is Decoded.UNKNOWN and self._learn():
                continue
            yield Batch(self._columns, self._drives, self._registers)
            self._columns = Columns(ROWS)
            if done is Decoded.UNKNOWN:  # it knows too much
                self.decoder.forget()
                self._begin()

    def rest(self) -> Iterator[Batch]:
        if len(self._columns):
            yield Batch(self._columns, self._drives, self._registers)

    def _learn(self) -> bool:
        framing, request = self.decoder.asked
        if len(self._registers) > _MOST_NAMES:
            return False
        meaning = self._meanings.of(framing, request)
        block = self._block(meaning) if request.address else None  # nobody answers a broadcast
        return self.decoder.know(block)

    def _block(self, meaning: Meaning) -> RowLayout:
        drive = self._drives.number(meaning.drive)
        fields = []
        for place in meaning.places:
            scale = place.register.scale if place.register else None
            fields.append(
                Field(
                    place.at,
                    place.number_format,
                    self._registers.number(place.name),
                    scale.numerator if scale else 1,
                    scale.denominator if scale else 1,
                )
            )
        return RowLayout(drive, fields)
