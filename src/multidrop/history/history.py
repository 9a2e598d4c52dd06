"""Read a history: months of rows from a folder to which another process may still write."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from multidrop.history.buckets import Buckets, Grid, UnitBuckets, grid_of
from multidrop.history.database import MissingDuckDB
from multidrop.history.folder import HistoryFile, Listing, listing
from multidrop.history.sources import (
    ALWAYS,
    MOST_TRIES,
    OF_ROWS,
    OF_TENS,
    Replaced,
    Sources,
    gather_files,
    rows_of_file,
    units_in_rows,
    write_parquet,
)
from multidrop.history.units import (
    Moment,
    OtherColumn,
    Query,
    Series,
    UnitHistory,
    ns_of,
    parsed_series,
    unit_texts_of,
)
from multidrop.polling.batch import Row, Rows
from multidrop.recording import open_writer
from multidrop.recording.csv import WITH_UNITS, lines_with_units
from multidrop.recording.format import Metadata, RecordingReader, new_file
from multidrop.recording.rows import from_rows


class History:
    """The rows in a folder of `multidrop serve` or `HistoryWriter`, or in segments such as `run.arrows`.

    Another process may write the history at the same time. Each row is read exactly once, and can be
    read about 0.3 s after polling. A series is a drive and a register, such as
    "pump-1.output_frequency". A moment is UTC in ns, or a datetime with a time zone.

    Compacted files need duckdb (`pip install 'multidrop[history]'`). Methods raise ImportError if there
    are such files and duckdb is missing, ValueError for an invalid series or range, and OSError. Any
    thread may call them.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)
        listing(self.folder)  # raises OSError here if the path is wrong
        self._sources = Sources(self.folder)

    def __repr__(self) -> str:
        return f"<History {self.folder}>"

    def __enter__(self) -> History:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Close all files and free memory. The history may be used again."""
        self._sources.close()

    @property
    def damage(self) -> list[str]:
        """Sentences that describe the damaged segments found so far."""
        return list(self._sources.damage.values())

    def metadata(self) -> Metadata:
        """Return the metadata of the newest segment; {} without segments."""
        return self._sources.metadata()

    # ---- rows ----

    def read(
        self,
        series: str | Iterable[str] | None = None,
        begin: Moment | None = None,
        end: Moment | None = None,
    ) -> HistoryRows:
        """Return the rows of the series (None: all series) with begin <= time < end (None: no limit).

        The rows come in the order of recording. The unit of a register, or the names of its values, may have
        changed within the range. Rows with an earlier unit then have another register name, such as
        "motor_load [A]", so `wide()` has a separate column for them. `metadata` describes both names. The
        result is a recording like that of `multidrop.open_recording`: `to_pandas()`, `to_polars()`, `wide()`,
        batches of rows, Arrow.
        """
        first = ALWAYS[0] if begin is None else ns_of(begin)
        last = ALWAYS[1] if end is None else ns_of(end)
        return HistoryRows(self._sources, Query(parsed_series(series), first, last))

    # ---- buckets ----

    def buckets(
        self, series: str | Iterable[str], begin: Moment, end: Moment | None = None, points: int = 800
    ) -> dict[str, Buckets]:
        """Return each series' least, mean and greatest values in at most `points` buckets of the range.

        `end` None means now. Buckets of 2 s and more are rounded up to whole tens of seconds, minutes, hours
        or days of UTC. So the first bucket may start before `begin`, and the last bucket may end after `end`.

        If a register's unit, or the names of its values, changed within the range, only values with the
        newest unit are included. In the `Buckets`, `unit` is this unit, and `left_out` has the other units.
        """
        names = parsed_series(series)
        if not names:
            raise ValueError("name at least one series, such as 'pump-1.output_frequency'")
        grid = grid_of(ns_of(begin), time.time_ns() if end is None else ns_of(end), points)

        def gathered(found: Listing) -> dict[str, Buckets]:
            into = {name: UnitBuckets(grid) for name in names}
            units = UnitHistory(names)
            units.learn(self._sources.known(found, grid.begin, grid.end))
            self._gather(found, into, grid, units)
            return {
                ".".join(name): made.buckets(units.unit_of(name), units.left_out.get(name, ()))
                for name, made in into.items()
            }

        return self._sources.again(gathered)

    def _gather(
        self, found: Listing, into: Mapping[Series, UnitBuckets], grid: Grid, units: UnitHistory
    ) -> None:
        everything = tuple(into)
        # A file of ten-second summaries may cover many segments. If a register changed its unit in between,
        # read each segment instead.
        tens = [file for file in found.tens if grid.is_of_tens and units.is_whole(file.first, file.last)]
        covered = {number for file in tens for number in range(file.first, file.last + 1)}
        by_source: dict[tuple[str, tuple[Series, ...]], list[HistoryFile]] = {(OF_TENS, everything): tens}
        for number, file in found.rows.items():
            if number not in covered:
                by_source.setdefault((OF_ROWS, units.series_of(number)), []).append(file)
        for (sums, series), files in by_source.items():
            files = [file for file in files if file.may_have(grid.begin, grid.end)]
            if files and series:
                gather_files(
                    self._sources, files, sums, {one: into[one] for one in series}, grid, units.newest
                )
        for number in sorted(set(found.segments) - covered):
            with self._sources.segment(number, found, grid.begin, grid.end) as segment:
                if segment:
                    segment.gather({one: into[one].without_unit for one in units.series_of(number)}, grid)

    # ---- export ----

    def csv(
        self,
        series: str | Iterable[str] | None = None,
        begin: Moment | None = None,
        end: Moment | None = None,
    ) -> Iterator[bytes]:
        """Yield a .csv file, piece by piece. It has the rows that `read` returns, and a column `unit`."""
        rows = self.read(series, begin, end)
        units = unit_texts_of(rows.metadata)
        lines = (lines_with_units(batch, units) for batch in rows)
        return (piece for pieces in ([WITH_UNITS.encode()], lines) for piece in pieces)

    def export(
        self,
        path: str | os.PathLike[str],
        series: str | Iterable[str] | None = None,
        begin: Moment | None = None,
        end: Moment | None = None,
    ) -> int:
        """Write the rows that `read` returns into a new .csv, .parquet or .arrows file; return their number.

        Parquet is written by duckdb, with rows in any order, or by pyarrow if duckdb is missing. Raises the
        errors of `open_writer`, and then leaves no file.
        """
        rows, target = self.read(series, begin, end), Path(path)
        if target.suffix.lower() == ".parquet":
            try:
                return rows.write_parquet(target)
            except MissingDuckDB:
                pass
        writer = open_writer(target, rows.metadata)
        try:
            with writer:
                for batch in rows:
                    writer.write(batch)
        except BaseException:  # also after Ctrl-C: remove the file, because it would look complete
            writer.discard()
            raise
        return writer.rows


class HistoryRows(RecordingReader):
    """Rows of a history; every iteration reads the files again."""

    truncated = 0

    def __init__(self, sources: Sources, query: Query) -> None:
        super().__init__(sources.folder)
        self._sources, self._query = sources, query
        self._units = UnitHistory(query.series)
        sources.again(self._learnt)
        self.metadata = self._units.described(sources.metadata())

    def __iter__(self) -> Iterator[Rows]:
        sources = self._sources
        found = sources.again(self._learnt)
        given = 0  # number of the newest segment whose rows were yielded
        for number in sorted({*found.segments, *found.rows}):
            if number <= given:
                continue
            for _ in range(MOST_TRIES):
                try:
                    yield from self._rows_of_segment(number, found)
                    break
                except Replaced:  # no row was yielded yet, so the segment can be read from its new file
                    found = sources.listing()
                    self._check_merged(number, found)
            else:
                raise sources.too_often()
            given = found.rows[number].last if number in found.rows else number

    def _check_merged(self, number: int, found: Listing) -> None:
        """Raise OSError if this segment was merged with segments whose rows were already yielded."""
        if any(file.first < number <= file.last for file in found.rows.values()):
            raise OSError(f"{self.path}: files were merged during this read: read the history again")

    def _learnt(self, found: Listing) -> Listing:
        """Learn the units of all listed segments, and return the listing."""
        known = self._sources.known(found, self._query.begin, self._query.end)
        new = self._units.unknown_of(known)
        if files := [found.rows[number] for number in new if number in found.rows and not known[number]]:
            known |= units_in_rows(self._sources, files, self._query)
        self._units.learn(known)
        return found

    def _rows_of_segment(self, number: int, found: Listing) -> Iterator[Rows]:
        query, file, others = self._query, found.rows.get(number), self._units.other_columns(number)
        if file and file.may_have(query.begin, query.end):
            yield from rows_of_file(self._sources, file, query, others)
        elif number in found.segments:
            wanted = None if query.series is None else frozenset(query.series)
            with self._sources.segment(number, found, query.begin, query.end) as segment:
                for batch in segment.batches(query.begin, query.end) if segment else ():
                    if segment and (rows := segment.rows_of(batch, wanted, query.begin, query.end)):
                        yield from_rows(_renamed(rows, others))

    def write_parquet(self, target: Path) -> int:
        """Write the rows into a new Parquet file with duckdb; return their number. Raises MissingDuckDB."""
        self._sources.cursor().close()  # raises MissingDuckDB before a file is created
        new_file(target).close()
        try:
            return self._sources.again(lambda found: self._copy_to(target, found))
        except BaseException:
            target.unlink(missing_ok=True)
            raise

    def _copy_to(self, target: Path, found: Listing) -> int:
        query = self._query
        files = [file for file in found.rows.values() if file.may_have(query.begin, query.end)]
        batches = (
            batch for number in sorted(found.segments) for batch in self._rows_of_segment(number, found)
        )
        self._learnt(found)
        others = {file.first: self._units.other_columns(file.first) for file in files}
        return write_parquet(self._sources, target, batches, files, query, self.metadata, others)


def _renamed(rows: list[Row], others: Iterable[OtherColumn]) -> list[Row]:
    columns = {other.series: other.column for other in others}
    if not columns:
        return rows
    return [row._replace(register=columns.get((row.drive, row.register), row.register)) for row in rows]
