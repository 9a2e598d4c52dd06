"""Rows of many small batches, copied together into a large one."""

from __future__ import annotations

from typing import Any

from multidrop.core import Columns
from multidrop.core.columns import COLUMNS, Names
from multidrop.polling.batch import Batch, bitmap_of


class GatheredRows(Columns):
    """Columns that grow by a copy of each batch: the core has its memory back at once."""

    def __init__(self, drives: Names, registers: Names) -> None:
        self._drives, self._registers = drives, registers
        self._rows = 0
        self._gathered = {name: bytearray() for name in COLUMNS}

    def __len__(self) -> int:
        return self._rows

    def add(self, batch: Batch) -> bool:
        """Copy the rows; False for those of another poller, whose codes stand for other names."""
        columns, drives, registers = batch.parts()
        if drives is not self._drives or registers is not self._registers:
            return False
        for name, gathered in self._gathered.items():
            gathered += columns.array(name).cast("B")
        self._rows += len(columns)
        return True

    def array(self, name: str) -> memoryview[Any]:
        if name != "valid":
            return memoryview(bytes(self._gathered[name])).cast(COLUMNS[name])
        size, codes = (self._rows + 7) // 8, self._gathered["status"]
        if codes.count(0) == len(codes):
            return memoryview(b"\xff" * size)
        return bitmap_of(self.array("status"))

    def batch(self) -> Batch:
        """Return all rows so far; none may be added afterwards."""
        return Batch(self, self._drives, self._registers)


def gather(gathered: list[GatheredRows], batch: Batch) -> None:
    """Copy the rows to the last of these, or to a new one where its codes are others."""
    if not gathered or not gathered[-1].add(batch):
        _, drives, registers = batch.parts()
        gathered.append(GatheredRows(drives, registers))
        gathered[-1].add(batch)
