"""Rows read from a recording, in Arrow's layout, and the phases of a test run in a recording."""

from __future__ import annotations

from array import array
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import accumulate, pairwise
from typing import Any

from multidrop.polling.batch import Row, Rows, assemble, nanoarrow, schema, shown_span


class RecordedRows(Rows):
    """Rows in a nanoarrow array with the schema of a recording."""

    def __init__(self, rows: Any) -> None:
        self._array = rows

    def __len__(self) -> int:
        return int(self._array.length)

    def __iter__(self) -> Iterator[Row]:
        # This generator keeps the array alive: nanoarrow frees an array's buffers even if memoryviews use
        # them.
        yield from map(Row._make, zip(*map(_values, self._array.view().children), strict=True))

    def __repr__(self) -> str:
        return f"<Rows: {shown_span([*self])}>"

    def arrow(self) -> Any:
        return self._array


def _values(column: Any) -> Iterable[Any]:
    """Return the values of a column, with None for each null."""
    if column.n_buffers == 3:
        return texts_of(column)
    numbers = memoryview(column.buffer(1))[: column.length]
    if not column.null_count:
        return numbers
    valid = column.buffer(0).elements()
    return (number if there else None for number, there in zip(numbers, valid, strict=False))


def texts_of(column: Any) -> Iterator[str]:
    """Yield the text in each row of a column."""
    ends, text = memoryview(column.buffer(1))[: column.length + 1], bytes(column.buffer(2))
    if text.isascii():  # usual case: decode all texts together
        letters = text.decode("ascii")
        return (letters[begin:end] for begin, end in pairwise(ends))
    return (text[begin:end].decode(errors="replace") for begin, end in pairwise(ends))


def from_rows(rows: Sequence[Row]) -> RecordedRows:
    """Convert rows to Arrow's layout."""
    time, monotonic_ns, uncertainty_ns, drive, register, value, status = zip(*rows, strict=True)
    return RecordedRows(
        assemble(
            len(rows),
            (None, array("q", time)),
            (None, array("q", monotonic_ns)),
            (_bitmap(uncertainty_ns), array("q", _filled(uncertainty_ns))),
            (None, *_encoded(drive)),
            (None, *_encoded(register)),
            (_bitmap(value), array("d", _filled(value))),
            (None, *_encoded(status)),
        )
    )


def _filled(values: Sequence[Any]) -> list[Any]:
    return [0 if value is None else value for value in values]


def _bitmap(values: Sequence[object]) -> bytes:
    """Return a validity bitmap, least significant bit first: 0 for None, 1 for any other value."""
    bits = "".join("0" if value is None else "1" for value in reversed(values))
    return int(bits, 2).to_bytes((len(values) + 7) // 8, "little")


def _encoded(texts: Sequence[str]) -> tuple[array[int], bytes]:
    encoded = [text.encode() for text in texts]
    return array("i", [0, *accumulate(map(len, encoded))]), b"".join(encoded)


# ---- phases of a test run ----

# At the start of each step, a test run records a row. The row's drive is `test`, its register is `phase`, and
# its value is a number. The metadata maps this number to the name of the step's phase. Tables made from such
# a recording have a further column, `phase`, with the name of the phase in which a row's request was sent.

PHASE_DRIVE, PHASE = "test", "phase"


def with_phases(metadata: Mapping[str, Any], names: Sequence[str]) -> dict[str, Any]:
    """Return the metadata of a plant's recording with these phases added. Phases are numbered from 0."""
    register = {"unit": "", "step": 1, "bits": False, "values": {name: at for at, name in enumerate(names)}}
    test = {"line": "", "model": "test run", "registers": {PHASE: register}}
    return {**metadata, "drives": {**metadata["drives"], PHASE_DRIVE: test}}


def phase_row(number: int, time_ns: int, monotonic_ns: int) -> RecordedRows:
    """Return the row that marks the start of a phase at this time: UTC, and CLOCK_MONOTONIC, in ns."""
    return from_rows([Row(time_ns, monotonic_ns, 0, PHASE_DRIVE, PHASE, float(number), "ok")])


def phase_names(metadata: Mapping[str, Any]) -> dict[float, str]:
    """Return the names of a recording's phases by number; {} if the metadata has none or is damaged."""
    found: Any = metadata
    for key in ("drives", PHASE_DRIVE, "registers", PHASE, "values"):
        found = found.get(key) if isinstance(found, dict) else None
    return {number: name for name, number in found.items()} if isinstance(found, dict) else {}


class PhaseColumn:
    """Adds the column `phase` to a recording's batches. The batches must be passed in their order."""

    def __init__(self, names: Mapping[float, str]) -> None:
        self._names = names
        self._starts: list[int] = []  # monotonic times at which phases started, in ns
        self._phases: list[str] = [""]  # "" for the time before the first phase, then the name of each phase
        arrow = nanoarrow()
        fields = {child.name: arrow.Schema(child) for child in schema().children}
        self.schema = arrow.c_schema(
            arrow.struct({**fields, PHASE: arrow.string(nullable=False)}, nullable=False)
        )

    def added(self, rows: Rows) -> Any:
        """Return the rows as a nanoarrow array with the added column `phase`."""
        array_of_rows = rows.arrow()
        children = list(array_of_rows.view().children)
        times = memoryview(children[1].buffer(1)).cast("B").cast("q")[: len(rows)]
        self._note(times, texts_of(children[3]), texts_of(children[4]), children[5])
        texts = [self._phases[bisect_right(self._starts, at)].encode() for at in times]
        build = nanoarrow().c_array_from_buffers
        ends = array("i", accumulate(map(len, texts), initial=0))
        phases = build(self.schema.child(7), len(texts), [None, ends, b"".join(texts)])
        columns = [array_of_rows.child(at) for at in range(7)]
        return build(self.schema, len(rows), [None], children=[*columns, phases], move=False)

    def _note(self, times: memoryview, drives: Iterable[str], registers: Iterable[str], values: Any) -> None:
        """Store the time and name of each phase that starts in these rows."""
        for at, (drive, register) in enumerate(zip(drives, registers, strict=True)):
            if drive == PHASE_DRIVE and register == PHASE:
                self._starts.append(times[at])
                self._phases.append(self._names.get(memoryview(values.buffer(1))[at], ""))
