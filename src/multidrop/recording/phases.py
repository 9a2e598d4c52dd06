"""The phases of a test run in its recording.

At the start of each step, the run records a row. The row's drive is `test`, its register is `phase`, and its
value is a number. The metadata maps this number to the name of the step's phase. Tables made from such a
recording have a further column, `phase`, with the name of the phase in which a row's request was sent.
"""

from __future__ import annotations

from array import array
from bisect import bisect_right
from collections.abc import Iterable, Mapping, Sequence
from itertools import accumulate
from typing import Any

from multidrop.polling.batch import Row, Rows, nanoarrow, schema
from multidrop.recording.rows import RecordedRows, from_rows, texts_of

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
