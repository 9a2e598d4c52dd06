"""The cost of converting columns to Arrow, and of writing them to a recording of each format."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from multidrop._core import ffi, lib

from multidrop.core import Columns, Field, Names, NumberFormat, RowLayout
from multidrop.polling.batch import Batch
from multidrop.recording import open_writer

ROWS = 4096
REGISTERS = [f"register_{at}" for at in range(16)]


@pytest.fixture
def batch() -> Batch:
    """Return a batch with 4096 rows of one drive with sixteen registers."""
    found = ffi.new("struct md_completion *")
    found.result, found.sent_ns, found.first_ns = 37, 1, 2
    found.reply.data_len, found.reply.data[0:32] = 32, list(range(32))
    block = RowLayout(0, [Field(at, NumberFormat.U16, at, 1, 10) for at in range(16)])
    columns = Columns(ROWS)
    while lib.md_columns_add(columns.c, block.c, found, 0):
        pass
    return Batch(columns, Names(["pump-1"]), Names(REGISTERS))


def test_time_to_convert_4096_rows_to_arrow(benchmark: Any, batch: Batch) -> None:
    assert benchmark(batch.arrow) is not None


@pytest.mark.parametrize("suffix", [".arrows", ".csv", ".parquet"])
def test_time_to_record_4096_rows(benchmark: Any, batch: Batch, tmp_path: Path, suffix: str) -> None:
    with open_writer(tmp_path / f"run{suffix}", {}) as writer:
        benchmark(writer.write, batch)
        assert writer.rows % ROWS == 0
        assert writer.rows > 0
