"""Historian: the gateway's part `history`, which records all rows and answers queries about them."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
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
from multidrop.history import Buckets, HistoryState, HistoryWriter
from multidrop.recording import parse_age, parse_size
from multidrop.supervisor import supervisor

MS_NS = 1_000_000
LOOK_S = 1.0  # interval of checking that the writing thread is alive
CLOSING_S = 3.0  # time limit for writing the last rows
QUERY_S = 30.0  # time limit of a query, and of its wait for other queries
MOST_QUERIES = 2  # limit of concurrent queries
PIECE = 1 << 16  # bytes of an export read at a time
UNFINISHED = ".export-"  # prefix of temporary folders of exports
MOST_BUCKETS = 200_000  # limit of one answer (5 MB): the page's 24 series on a screen of 8000 px


@dataclass(frozen=True)
class HistorySettings:
    """The settings in the table `[serve.history]`. Raises ValueError with a line for each mistake."""

    folder: str = "history"
    keep: str = "30 days"
    most: str = "20 GB"
    rotate: str = "10 min"

    def __post_init__(self) -> None:
        mistakes = []
        for key, parse in (("keep", parse_age), ("most", parse_size), ("rotate", parse_age)):
            try:
                parse(getattr(self, key))
            except ValueError as mistake:
                mistakes.append(f"{key} = {mistake}")
        if mistakes:
            raise ValueError("\n".join(mistakes))


Settings = HistorySettings


def build(settings: HistorySettings, context: PartContext) -> Historian:
    """Return the historian of a gateway. Imports DuckDB now, so that the first query is not delayed."""
    with suppress(ImportError):
        import_module("duckdb")
    folder = context.folder / settings.folder
    try:
        return Historian(context.plant, folder, settings)
    except OSError as failure:
        if failure.filename is None:  # the message is already a sentence
            raise
        raise OSError(f"folder {folder} cannot be written: {failure.strerror}") from failure


class Historian:
    """Records rows and answers queries.

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
        for left in folder.glob(f"{UNFINISHED}*"):  # left by a killed process: no other one records here now
            rmtree(left, ignore_errors=True)
        self.history = History(folder)
        self._is_closed = False

    # ---- part of the gateway ----

    def take(self, batch: Batch) -> None:
        """Copy the rows within microseconds; another thread writes them."""
        self._writer.take(batch)

    async def run(self) -> None:
        """Watch the writing thread. Raises RuntimeError if it ends before `close`."""
        while self._writer.is_alive:
            await asyncio.sleep(LOOK_S)
        if not self._is_closed:
            raise RuntimeError("the writing thread has ended")

    async def close(self) -> None:
        """Write the pending rows. Raises Hung if the disk does not answer."""
        self._is_closed = True
        await supervisor().within("history", CLOSING_S, self._close)

    def _close(self) -> None:
        self._writer.close()
        self.history.close()

    def adopt(self, plant: Plant) -> None:
        """Use another plant: the next file of the history has its metadata."""
        self._writer.begin(plant.metadata())

    def health(self) -> str:
        """Return why recording fails now; "" if it works."""
        trouble = self.state.trouble
        return f"nothing is recorded: {trouble}" if trouble else ""

    def figures(self) -> list[MetricFamily]:
        """Return metrics: rows written and rows lost since the start."""
        state = self.state
        return [
            counter("multidrop_history_rows", "Rows written to the history.", state.rows),
            counter(
                "multidrop_history_dropped", "Rows that the history could not take or write.", state.dropped
            ),
        ]

    @property
    def state(self) -> HistoryState:
        """The number of rows written and lost so far, and the present problem."""
        return self._writer.state()

    # ---- queries; times are UTC in ms ----

    async def series(self, names: Sequence[str], begin: int, end: int, points: int) -> bytes:
        """Return each series between two times as JSON, reduced to `points` buckets.

        A thread does the work, to keep the event loop free for stops. Raises ValueError for wrong arguments,
        OSError (Hung included) if files cannot be read, and ImportError without DuckDB.
        """
        names = list(dict.fromkeys(names))
        if len(names) * points > MOST_BUCKETS:
            raise ValueError(f"{len(names)} series of {points} points: an answer has {MOST_BUCKETS} at most")
        work = partial(self._series, names, begin * MS_NS, end * MS_NS, points)
        return await supervisor().within("history queries", QUERY_S, work, most=MOST_QUERIES)

    def _series(self, names: Sequence[str], begin: int, end: int, points: int) -> bytes:
        found = self.history.buckets(names, begin, end, points)
        step = next(iter(found.values())).step
        pieces = (f"{json.dumps(name)}:{json.dumps(as_json(made))}" for name, made in found.items())
        return f'{{"step_ms":{step / MS_NS},"series":{{{",".join(pieces)}}}}}'.encode()

    def export(self, names: Sequence[str], begin: int, end: int, kind: str) -> Iterator[bytes]:
        """Return a file of these series (of all if `names` is empty) in pieces; `kind` is "csv" or "parquet".

        Call and iterate it in threads, because it reads files. Raises the errors of `series`: those for wrong
        arguments at the call, the others also during the iteration.
        """
        series, begin_ns, end_ns = names or None, begin * MS_NS, end * MS_NS
        if kind not in ("csv", "parquet"):
            raise ValueError(f"format = {kind!r} is neither csv nor parquet")
        if kind == "csv":
            return self.history.csv(series, begin_ns, end_ns)
        self.history.read(series, begin_ns, end_ns)  # raises the errors for wrong arguments now
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
