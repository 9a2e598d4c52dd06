"""The historian: a feed that records all rows; where it fails, all else goes on."""

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
LOOK_S = 1.0  # between looks at the thread that writes
CLOSING_S = 3.0  # that the last rows may take
QUERY_S = 30.0  # that an answer may take, and that one may wait for others
MOST_QUERIES = 2  # at the same time
PIECE = 1 << 16  # bytes of an export
UNFINISHED = ".export-"  # begins the names of exports' own folders
MOST_BUCKETS = 200_000  # of an answer: the page's 24 series on a screen of 8000 px, and 5 MB


@dataclass(frozen=True)
class HistorySettings:
    """The table `[serve.history]`. Raises ValueError with all that is wrong in it, a line each."""

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
    """Return the historian of a gateway; a relative folder is beside its plant file.

    DuckDB is loaded here, before polling begins, and not while the first viewer waits.
    """
    with suppress(ImportError):
        import_module("duckdb")
    folder = context.folder / settings.folder
    try:
        return Historian(context.plant, folder, settings)
    except OSError as failure:
        if failure.filename is None:  # it is a sentence
            raise
        raise OSError(f"folder {folder} cannot be written: {failure.strerror}") from failure


class Historian:
    """Records what it takes, and answers questions of the page about it.

    Raises as HistoryWriter does, when it begins.
    """

    def __init__(self, plant: Plant, folder: Path, settings: HistorySettings) -> None:
        self._writer = HistoryWriter(
            folder,
            plant.metadata(),
            rotate=parse_age(settings.rotate),
            keep=parse_age(settings.keep),
            most=parse_size(settings.most),
        )
        for left in folder.glob(f"{UNFINISHED}*"):  # by a process that was killed; nobody else records here
            rmtree(left, ignore_errors=True)
        self.history = History(folder)
        self._is_closed = False

    # ---- a feed ----

    def take(self, batch: Batch) -> None:
        """Copy the rows, within microseconds; another thread writes them."""
        self._writer.take(batch)

    async def run(self) -> None:
        """Watch the thread that writes. Raises RuntimeError if that ends before it is closed."""
        while self._writer.is_alive:
            await asyncio.sleep(LOOK_S)
        if not self._is_closed:
            raise RuntimeError("the thread that writes has ended")

    async def close(self) -> None:
        """Write what waits. Raises Hung if the disk does not answer."""
        self._is_closed = True
        await supervisor().within("history", CLOSING_S, self._close)

    def _close(self) -> None:
        self._writer.close()
        self.history.close()

    def adopt(self, plant: Plant) -> None:
        """Go on with another plant file: the next segment has its metadata."""
        self._writer.begin(plant.metadata())

    def health(self) -> str:
        """Return why nothing is recorded now; "" is well."""
        trouble = self.state.trouble
        return f"nothing is recorded: {trouble}" if trouble else ""

    def figures(self) -> list[MetricFamily]:
        """Return rows written and rows lost since the start."""
        state = self.state
        return [
            counter("multidrop_history_rows", "Rows written to the history.", state.rows),
            counter(
                "multidrop_history_dropped", "Rows that the history could not take or write.", state.dropped
            ),
        ]

    @property
    def state(self) -> HistoryState:
        """Rows written, rows lost, and what is wrong now."""
        return self._writer.state()

    # ---- questions; times are UTC in ms ----

    async def series(self, names: Sequence[str], begin: int, end: int, points: int) -> bytes:
        """Return the buckets of each series as JSON, made beside the loop, which may have a stop to send.

        Raises ValueError, OSError, which Hung is too, and ImportError.
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
        """Return a file of these series, or of all, piece by piece: "csv" or "parquet".

        Raises as `series`, before the first piece where the series or the times are wrong. To be called, and
        gone through, in threads: it reads files.
        """
        series, begin_ns, end_ns = names or None, begin * MS_NS, end * MS_NS
        if kind not in ("csv", "parquet"):
            raise ValueError(f"format = {kind!r} is neither csv nor parquet")
        if kind == "csv":
            return self.history.csv(series, begin_ns, end_ns)
        self.history.read(series, begin_ns, end_ns)  # a mistake is told before the first piece
        return self._parquet(series, begin_ns, end_ns)

    def _parquet(self, names: Sequence[str] | None, begin: int, end: int) -> Iterator[bytes]:
        with TemporaryDirectory(prefix=UNFINISHED, dir=self.history.folder) as directory:
            path = Path(directory) / "export.parquet"
            self.history.export(path, names, begin, end)
            with path.open("rb") as file:
                while piece := file.read(PIECE):
                    yield piece


def as_json(made: Buckets) -> dict[str, Any]:
    """Return buckets as JSON can have them: a float's infinity is null there."""
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
