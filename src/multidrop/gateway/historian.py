"""Historian: the gateway's part `history`, which records all polled values and answers queries about them."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from math import isfinite
from pathlib import Path
from shutil import rmtree
from tempfile import TemporaryDirectory
from typing import Any

from multidrop import Batch, History, Plant
from multidrop.exposition import MetricFamily
from multidrop.gateway.metrics import counter
from multidrop.gateway.parts import PartContext
from multidrop.gateway.settings import parsing_mistakes, refuse
from multidrop.history import Buckets, HistoryState, HistoryWriter
from multidrop.recording import parse_age, parse_size
from multidrop.supervisor import supervisor
from multidrop.toml_check import SIZE

MS_NS = 1_000_000
LOOK_S = 1.0  # interval, in s, of checking that the writing thread still runs
CLOSING_S = 3.0  # time limit, in s, for writing the last values at shutdown
QUERY_S = 30.0  # time limit, in s, of a query, and of the wait until other queries have ended
MOST_QUERIES = 2  # limit of concurrent queries
PIECE = 1 << 16  # number of bytes of an export file that are read at once
UNFINISHED = ".export-"  # prefix of temporary folders of exports
# regular expression of the ages that `parse_age` accepts, for the JSON Schema
AGE = r"^\s*\d+(\.\d+)?\s*(s|min|h|days?|weeks?)\s*$"
# limit of points in one answer (5 MB), enough for the page's 24 series on a screen of 8000 px
MOST_BUCKETS = 200_000


@dataclass(frozen=True)
class HistorySettings:
    """The settings in the table `[serve.history]`. Raises ValueError with a line for each mistake."""

    folder: str = "history"
    keep: str = field(default="30 days", metadata={"pattern": AGE})
    most: str = field(default="20 GB", metadata=SIZE)
    rotate: str = field(default="10 min", metadata={"pattern": AGE})

    def __post_init__(self) -> None:
        refuse(parsing_mistakes(self, keep=parse_age, most=parse_size, rotate=parse_age))


def build(settings: HistorySettings, context: PartContext) -> Historian:
    """Return the historian of a gateway. Imports DuckDB now, so that the first query is not delayed."""
    with suppress(ImportError):
        import_module("duckdb")
    folder = context.folder / settings.folder
    try:
        return Historian(context.plant, folder, settings)
    except OSError as failure:
        # this OSError has a sentence as its message, instead of a file name and a reason
        if failure.filename is None:
            raise
        raise OSError(f"folder {folder} cannot be written: {failure.strerror}") from failure


class Historian:
    """Records polled values and answers queries.

    Raises ValueError if another process records in the folder, OSError if the folder cannot be written.
    """

    def __init__(self, plant: Plant, folder: Path, settings: HistorySettings) -> None:
        self._writer = HistoryWriter(
            folder,
            plant.metadata(),
            rotate=parse_age(settings.rotate),
            keep=parse_age(settings.keep),
            most=parse_size(settings.most),
        )
        # Delete exports that a killed process left; no other process uses this folder now.
        for left in folder.glob(f"{UNFINISHED}*"):
            rmtree(left, ignore_errors=True)
        self.history = History(folder)
        self._is_closed = False

    # ---- the methods of Part ----

    def take(self, batch: Batch) -> None:
        """Copy the values of the batch within microseconds; another thread writes them."""
        self._writer.take(batch)

    async def run(self) -> None:
        """Watch the writing thread. Raises RuntimeError if it ends before `close`."""
        while self._writer.is_alive:
            await asyncio.sleep(LOOK_S)
        if not self._is_closed:
            raise RuntimeError("the thread that writes the history has ended")

    async def close(self) -> None:
        """Write the values that are still in memory. Raises Hung if the disk does not answer."""
        self._is_closed = True
        await supervisor().within("history", CLOSING_S, self._close)

    def _close(self) -> None:
        self._writer.close()
        self.history.close()

    def adopt(self, plant: Plant) -> None:
        """Use another plant; the next file of the history gets its metadata."""
        self._writer.begin(plant.metadata())

    def health(self) -> str:
        """Return why recording fails now; "" if it works."""
        trouble = self.state.trouble
        return f"nothing is recorded: {trouble}" if trouble else ""

    def figures(self) -> list[MetricFamily]:
        state = self.state
        return [
            counter("multidrop_history_rows", "Rows written to the history.", state.rows),
            counter(
                "multidrop_history_dropped", "Rows that the history could not take or write.", state.dropped
            ),
        ]

    @property
    def state(self) -> HistoryState:
        """The number of values written and lost so far, and the present problem."""
        return self._writer.state()

    # ---- queries; times are UTC in ms ----

    async def series(self, names: Sequence[str], begin: int, end: int, points: int) -> bytes:
        """Return each register's values between two times (UTC, ms) as JSON, reduced to `points` buckets.

        A thread does the work, to keep the event loop free for stops. Raises ValueError for wrong arguments,
        OSError (Hung included) if files cannot be read, and ImportError without DuckDB.
        """
        names = list(dict.fromkeys(names))
        if len(names) * points > MOST_BUCKETS:
            raise ValueError(
                f"{len(names)} series of {points} points exceed the limit of {MOST_BUCKETS} points per answer"
            )
        work = partial(self._series, names, begin * MS_NS, end * MS_NS, points)
        return await supervisor().within("history queries", QUERY_S, work, most=MOST_QUERIES)

    def _series(self, names: Sequence[str], begin: int, end: int, points: int) -> bytes:
        found = self.history.buckets(names, begin, end, points)
        step = next(iter(found.values())).step
        pieces = (f"{json.dumps(name)}:{json.dumps(as_json(made))}" for name, made in found.items())
        return f'{{"step_ms":{step / MS_NS},"series":{{{",".join(pieces)}}}}}'.encode()

    def export(self, names: Sequence[str], begin: int, end: int, kind: str) -> Iterator[bytes]:
        """Return an iterator over the pieces of a file with the values of the named registers.

        If `names` is empty, the file has all registers. `kind` is "csv" or "parquet".

        This call and the iterator read files, so use both in threads. Both may raise OSError and ImportError;
        only this call raises ValueError.
        """
        series, begin_ns, end_ns = names or None, begin * MS_NS, end * MS_NS
        if kind == "csv":
            return self.history.csv(series, begin_ns, end_ns)
        self.history.read(series, begin_ns, end_ns)  # raises ValueError here, before the first piece is sent
        return self._parquet(series, begin_ns, end_ns)

    def _parquet(self, names: Sequence[str] | None, begin: int, end: int) -> Iterator[bytes]:
        with TemporaryDirectory(prefix=UNFINISHED, dir=self.history.folder) as directory:
            path = Path(directory) / "export.parquet"
            self.history.export(path, names, begin, end)
            with path.open("rb") as file:
                while piece := file.read(PIECE):
                    yield piece


def as_json(made: Buckets) -> dict[str, Any]:
    """Return the buckets of a series as a JSON object, with None in place of infinity."""
    return {
        "time": [time // MS_NS for time in made.times],
        "least": _finite(made.least),
        "mean": _finite(made.mean),
        "most": _finite(made.most),
        "missed": made.missed,
        "unit": made.unit,
        "left_out": made.left_out,
    }


def _finite(values: Sequence[float | None]) -> list[float | None]:
    return [None if value is None or not isfinite(value) else value for value in values]
