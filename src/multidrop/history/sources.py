"""Read the files of a history, segments and Parquet, while compaction may replace them."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

from multidrop.history.buckets import Grid, UnitBuckets
from multidrop.history.database import (
    FINITE,
    Database,
    copy_out,
    files_of,
    insert,
    kept_metadata,
    quoted,
    rows_of,
    texts_of_metadata,
    with_units,
)
from multidrop.history.folder import HistoryFile, Listing, listing
from multidrop.history.growing import GrowingSegment
from multidrop.history.units import FileUnits, OtherColumn, Query, Series, SeriesUnit, file_units_of
from multidrop.polling.batch import Rows
from multidrop.recording.format import Metadata

T = TypeVar("T")
ALWAYS = -(2**63), 2**63 - 1  # in ns UTC: a range that includes every time
MEMORY = "200MB"  # limit for DuckDB
MOST_TRIES = 50  # limit of attempts to read files that are being replaced
MOST_GROWING = 4  # largest number of segments with a cached index
FILES_AT_ONCE = 200  # files per query of metadata, because a file's metadata may take 100 kB


class Replaced(Exception):
    """Raised if a listed file no longer exists, because it was merged into another file or was too old."""


class Sources:
    """The open files of a history's folder; any thread may use this object."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.damage: dict[int, str] = {}  # a sentence for each damaged segment, by number
        self._growing: dict[int, GrowingSegment] = {}
        self._bounds: dict[int, tuple[int, int]] = {}  # first and last time of each closed segment
        self._known: dict[int, FileUnits] = {}  # each segment's units, by segment number
        self._changing = threading.Lock()
        self._database = Database(MEMORY)

    def close(self) -> None:
        with self._changing:
            while self._growing:
                self._growing.popitem()[1].let_go()
            self._database.close()

    def listing(self) -> Listing:
        """List the current files of the history, and close files that were removed from it."""
        found = listing(self.folder)
        with self._changing:
            for number in set(self._growing) - set(found.segments):
                self._growing.pop(number).let_go()
        return found

    @contextmanager
    def segment(self, number: int, found: Listing, begin: int, end: int) -> Iterator[GrowingSegment | None]:
        """Yield a segment that was read up to its current end, and whose file stays open in the `with` block.

        Yield None if the segment has no rows in this range or cannot be read. Raises Replaced if its file no
        longer exists.
        """
        segment: GrowingSegment | None = None
        with self._changing:
            least, most = self._bounds.get(number, ALWAYS)
            if least < end and begin <= most:
                segment = self._held(number, found.segments[number])
            if segment and number < max(found.segments):  # a closed segment: its bounds are final
                self._bounds[number] = segment.bounds
                if segment.left_out:
                    left_out = (
                        f"{found.segments[number]} ends within a batch: "
                        f"its last {segment.left_out} bytes were skipped"
                    )
                    self.damage.setdefault(number, left_out)
        try:
            yield segment
        finally:
            if segment:
                segment.let_go()

    def _held(self, number: int, path: Path) -> GrowingSegment | None:
        """Return a segment, with cached indexes if it is one of the newest. The caller must call `let_go`."""
        segment = self._growing.get(number)
        if segment is None:
            try:
                segment = GrowingSegment(path)
            except FileNotFoundError:
                raise Replaced from None
            except ValueError as error:
                # An empty file is not damaged: it was just created, or its data was lost in a power cut.
                if path.exists() and path.stat().st_size:
                    self.damage[number] = str(error)
                return None
            self._growing[number] = segment
        self.damage.pop(number, None)
        segment.read_new()
        segment.hold()
        if segment.damage:
            self.damage[number] = segment.damage
        for older in sorted(self._growing)[:-MOST_GROWING]:
            self._growing.pop(older).let_go()
        return segment

    def known(self, found: Listing, begin: int, end: int) -> dict[int, FileUnits]:
        """Return the units of the registers in each file that may have rows in this range of time.

        The key is the number of the file's segment. Raises Replaced if a file no longer exists.
        """
        files = {number: file for number, file in found.rows.items() if file.may_have(begin, end)}
        unread = [file for number, file in files.items() if number not in self._known]
        for at in range(0, len(unread), FILES_AT_ONCE):
            self._read_units(unread[at : at + FILES_AT_ONCE])
        numbers = [*files]
        for number in found.segments:
            with self.segment(number, found, begin, end) as segment:
                if segment and segment.batches(begin, end):
                    numbers.append(number)
                    if number not in self._known:
                        self._known[number] = file_units_of(segment.metadata)
        return {number: self._known[number] for number in numbers}

    def _read_units(self, files: Sequence[HistoryFile]) -> None:
        numbers = {str(file.path): file.first for file in files}
        read: dict[int, FileUnits] = {number: {} for number in numbers.values()}
        with self.cursor() as cursor, while_there(files):
            for text, paths in texts_of_metadata(cursor, [file.path for file in files]):
                known = file_units_of(_parsed(text))
                read |= {numbers[path]: known for path in paths}
        self._known |= read

    def metadata(self) -> Metadata:
        """Return the metadata of the newest segment; {} without segments."""
        return self.again(self._newest_metadata)

    def _newest_metadata(self, found: Listing) -> Metadata:
        number = max([*found.segments, *found.rows], default=0)
        if number in found.rows:
            with self.cursor() as cursor, while_there([found.rows[number]]):
                return kept_metadata(cursor, found.rows[number].path)
        if number in found.segments:
            with self.segment(number, found, *ALWAYS) as segment:
                return segment.metadata if segment else {}
        return {}

    def cursor(self) -> Any:
        """Return a cursor of DuckDB, which the caller closes. Raises ImportError."""
        with self._changing:
            return self._database.cursor()

    def again(self, act: Callable[[Listing], T]) -> T:
        """Return `act(listing)`. If `act` raises Replaced, call it again with a new listing."""
        for _ in range(MOST_TRIES):
            try:
                return act(self.listing())
            except Replaced:
                continue
        raise self.too_often()

    def too_often(self) -> OSError:
        return OSError(f"{self.folder}: files were replaced {MOST_TRIES} times while they were read")


def _parsed(text: str) -> object:
    with suppress(ValueError, RecursionError):
        return json.loads(text)
    return None


@contextmanager
def while_there(files: Sequence[HistoryFile]) -> Iterator[None]:
    """Convert an error of the `with` block to Replaced if a file in `files` no longer exists."""
    try:
        yield
    except Exception as failure:
        if all(file.path.exists() for file in files):
            raise
        raise Replaced from failure


COLUMNS = "time, monotonic_ns, uncertainty_ns, drive, register, value, status"
_IN_RANGE = "epoch_ns(time) >= $begin and epoch_ns(time) < $end"
_ROWS = f"select {COLUMNS} from (select * {{}} from {{}} where {_IN_RANGE}{{}})"
_BUCKETS = f"""
select drive, register, {{unit}}, (epoch_ns(time) - $begin) // $step, {{sums}}
from {{files}} where {_IN_RANGE}{{condition}} group by all
"""
_BY_UNIT = "unit, max(epoch_ns(time))"
_UNITS = f"""
select filename, drive, register, unit
from {{files}} where {_IN_RANGE}{{condition}} and unit is not null group by all order by max(epoch_ns(time))
"""
OF_ROWS = f"count({FINITE}), count(*) - count({FINITE}), sum({FINITE}), min({FINITE}), max({FINITE})"
OF_TENS = "sum(n)::bigint, sum(missed)::bigint, sum(mean * n), min(least), max(most)"


def rows_of_file(
    sources: Sources, file: HistoryFile, query: Query, others: Iterable[OtherColumn]
) -> Iterator[Rows]:
    """Yield the rows of a query by request time.

    Raises Replaced if the file no longer exists, but only before the first row.
    """
    condition, values = _condition(query)
    # Only `multidrop hub` writes files with several segments. Their rows come from several computers, whose
    # monotonic clocks differ, so sort them by UTC.
    order = "monotonic_ns" if file.first == file.last else "time"
    with sources.cursor() as cursor, while_there([file]):
        # Sorting reads the whole file before the first row, so Replaced cannot be raised between rows.
        selected = _ROWS.format(_columns(others), with_units([file.path]), condition)
        yield from rows_of(cursor, f"{selected} order by {order}", values)


def gather_files(
    sources: Sources,
    files: Sequence[HistoryFile],
    sums: str,
    into: Mapping[Series, UnitBuckets],
    grid: Grid,
    described: Container[Series],
) -> None:
    """Add the rows, or the ten-second summaries, in these files to the buckets.

    The column `unit` is read only if the metadata does not describe all series, because reading it doubles
    the time. Raises Replaced if a file no longer exists.
    """
    condition, values = _condition(Query(list(into), grid.begin, grid.end))
    paths = [file.path for file in files]
    is_known = all(series in described for series in into)
    unit, table = ("null, 0", files_of(paths)) if is_known else (_BY_UNIT, with_units(paths))
    query = _BUCKETS.format(unit=unit, sums=sums, files=table, condition=condition)
    with sources.cursor() as cursor, while_there(files):
        found = cursor.execute(query, values | {"step": grid.step}).fetchall()
    for drive, register, unit, newest_ns, bucket, n, missed, *numbers in found:
        into[drive, register].of_unit(unit, newest_ns).add(bucket, n, missed, *numbers)


def units_in_rows(sources: Sources, files: Sequence[HistoryFile], query: Query) -> dict[int, FileUnits]:
    """Return each file's units, from its column `unit`; the key is the number of the file's first segment.

    Raises Replaced if a file no longer exists.
    """
    condition, values = _condition(query)
    selected = _UNITS.format(files=with_units(file.path for file in files), condition=condition)
    known: dict[str, dict[Series, list[SeriesUnit]]] = {str(file.path): {} for file in files}
    with sources.cursor() as cursor, while_there(files):
        for path, drive, register, unit in cursor.execute(selected, values).fetchall():
            known[path].setdefault((drive, register), []).append(SeriesUnit(unit))
    return {file.first: known[str(file.path)] for file in files}


def write_parquet(
    sources: Sources,
    target: Path,
    batches: Iterable[Rows],
    files: Sequence[HistoryFile],
    query: Query,
    metadata: Metadata,
    others: Mapping[int, Iterable[OtherColumn]],
) -> int:
    """Write a Parquet file, and return its number of rows.

    It gets all rows of `batches`, and those rows of `files` that the query selects. `others` has other names
    of registers, for their values in earlier units; the key is the number of a file's first segment. Raises
    Replaced if a file no longer exists.
    """
    condition, values = _condition(query)
    with sources.cursor() as cursor, while_there(files):
        insert(cursor, batches)
        selected = f"select {COLUMNS} from recorded"
        alike: dict[str, list[HistoryFile]] = {}
        for file in files:
            alike.setdefault(_columns(others[file.first]), []).append(file)
        for columns, some in alike.items():
            found = _ROWS.format(columns, with_units(file.path for file in some), condition)
            selected += f" union all by name {found}"
        return copy_out(cursor, selected, target, metadata, values if files else {})


def _columns(others: Iterable[OtherColumn]) -> str:
    """Return an SQL clause that gives registers other names in the result of a query `select *`."""
    whens = " ".join(
        f"when drive = {quoted(drive)} and register = {quoted(register)}"
        f"{'' if unit is None else f' and unit = {quoted(unit)}'} then {quoted(name)}"
        for (drive, register), unit, name in others
    )
    return f"replace (case {whens} else register end as register)" if whens else ""


def _condition(query: Query) -> tuple[str, dict[str, Any]]:
    """Return an SQL condition that selects the series, and the parameters of _IN_RANGE and this condition."""
    values: dict[str, Any] = {"begin": query.begin, "end": query.end}
    if query.series is None:
        return "", values
    drives = {name: f"d{at}" for at, name in enumerate(dict.fromkeys(drive for drive, _ in query.series))}
    registers = {name: f"r{at}" for at, name in enumerate(dict.fromkeys(name for _, name in query.series))}
    values |= {mark: name for marks in (drives, registers) for name, mark in marks.items()}
    listed = (", ".join(f"${mark}" for mark in marks.values()) for marks in (drives, registers))
    condition = " and drive in ({}) and register in ({})".format(*listed)
    # not every drive is wanted with every register, so select pairs, which is slower
    if len(drives) * len(registers) > len(query.series):
        pairs = ", ".join(f"(${drives[drive]}, ${registers[register]})" for drive, register in query.series)
        condition += f" and (drive, register) in ({pairs})"
    return condition, values
