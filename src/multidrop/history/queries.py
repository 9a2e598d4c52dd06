"""Queries of DuckDB for the Parquet files of a history."""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from multidrop.history.buckets import Grid
from multidrop.history.database import (
    copy_out,
    files_of,
    insert,
    kept_metadata,
    quoted,
    rows_of,
    with_units,
)
from multidrop.history.folder import HistoryFile
from multidrop.history.kept_series import Series
from multidrop.history.quantities import Known, OtherColumn, Quantity
from multidrop.history.sources import Sources, while_there
from multidrop.history.told_units import UnitBuckets
from multidrop.polling.batch import Rows
from multidrop.recording.format import Metadata

COLUMNS = "time, monotonic_ns, uncertainty_ns, drive, register, value, status"
_IN_RANGE = "epoch_ns(time) >= $begin and epoch_ns(time) < $end"
_ROWS = f"select {COLUMNS} from (select * {{}} from {{}} where {_IN_RANGE}{{}})"
_BUCKETS = f"""
select drive, register, {{unit}}, (epoch_ns(time) - $begin) // $step, {{sums}}
from {{files}} where {_IN_RANGE}{{condition}} group by all
"""
_TOLD = "unit, max(epoch_ns(time))"
_UNITS = f"""
select filename, drive, register, unit
from {{files}} where {_IN_RANGE}{{condition}} and unit is not null group by all order by max(epoch_ns(time))
"""
OF_ROWS = "count(value), count(*) - count(value), sum(value), min(value), max(value)"
OF_TENS = "sum(n)::bigint, sum(missed)::bigint, sum(mean * n), min(least), max(most)"


def rows_of_file(
    sources: Sources,
    file: HistoryFile,
    series: Sequence[Series] | None,
    begin: int,
    end: int,
    renamed: Iterable[OtherColumn],
) -> Iterator[Rows]:
    """Yield the rows of these series, or of all, in the order of their requests. Raises Replaced, at once."""
    condition, values = _condition(series)
    with sources.cursor() as cursor, while_there([file]):
        # It is sorted, so all of it was read before the first rows come: none are given out twice.
        query = _ROWS.format(_columns(renamed), with_units([file.path]), condition) + " order by monotonic_ns"
        yield from rows_of(cursor, query, {"begin": begin, "end": end, **values})


def gather_files(
    sources: Sources,
    files: Sequence[HistoryFile],
    sums: str,
    into: Mapping[Series, UnitBuckets],
    grid: Grid,
    described: Container[Series],
) -> None:
    """Add the rows, or the tens, of these files to the buckets. Raises Replaced.

    Units that rows tell are looked at only where not all series are described: that takes twice as long.
    """
    condition, values = _condition(list(into))
    values |= {"begin": grid.begin, "end": grid.end, "step": grid.step}
    paths = [file.path for file in files]
    is_known = all(series in described for series in into)
    unit, table = ("null, 0", files_of(paths)) if is_known else (_TOLD, with_units(paths))
    query = _BUCKETS.format(unit=unit, sums=sums, files=table, condition=condition)
    with sources.cursor() as cursor, while_there(files):
        found = cursor.execute(query, values).fetchall()
    for drive, register, unit, newest_ns, bucket, n, missed, *numbers in found:
        into[drive, register].told(unit, newest_ns).add(bucket, n, missed, *numbers)


def told_by(
    sources: Sources, files: Sequence[HistoryFile], series: Sequence[Series] | None, begin: int, end: int
) -> dict[int, Known]:
    """Return what the rows of each file say that they are. Raises Replaced."""
    condition, values = _condition(series)
    query = _UNITS.format(files=with_units(file.path for file in files), condition=condition)
    known: dict[str, dict[Series, list[Quantity]]] = {str(file.path): {} for file in files}
    values |= {"begin": begin, "end": end}
    with sources.cursor() as cursor, while_there(files):
        for path, drive, register, unit in cursor.execute(query, values).fetchall():
            known[path].setdefault((drive, register), []).append(Quantity(unit))
    return {file.first: known[str(file.path)] for file in files}


def metadata_of(sources: Sources, file: HistoryFile) -> Metadata:
    """Return the metadata that a file's segment had. Raises Replaced."""
    with sources.cursor() as cursor, while_there([file]):
        return kept_metadata(cursor, file.path)


def write_parquet(
    sources: Sources,
    target: Path,
    batches: Iterable[Rows],
    files: Sequence[HistoryFile],
    series: Sequence[Series] | None,
    range_ns: tuple[int, int],
    metadata: Metadata,
    renamed: Mapping[int, Iterable[OtherColumn]],
) -> int:
    """Write these batches and the files' rows of these series and times; return how many. Raises Replaced.

    `renamed` has the columns by the first segment of a file, as `rows_of_file` takes them.
    """
    condition, values = _condition(series)
    values |= dict(zip(("begin", "end"), range_ns, strict=True))
    with sources.cursor() as cursor, while_there(files):
        insert(cursor, batches)
        query = f"select {COLUMNS} from recorded"
        alike: dict[str, list[HistoryFile]] = {}
        for file in files:
            alike.setdefault(_columns(renamed[file.first]), []).append(file)
        for columns, some in alike.items():
            found = _ROWS.format(columns, with_units(file.path for file in some), condition)
            query += f" union all by name {found}"
        return copy_out(cursor, query, target, metadata, values if files else {})


def _columns(renamed: Iterable[OtherColumn]) -> str:
    """Return what follows `select *` so that rows have these columns for their registers."""
    whens = " ".join(
        f"when drive = {quoted(drive)} and register = {quoted(register)}"
        f"{'' if unit is None else f' and unit = {quoted(unit)}'} then {quoted(name)}"
        for (drive, register), unit, name in renamed
    )
    return f"replace (case {whens} else register end as register)" if whens else ""


def _condition(series: Sequence[Series] | None) -> tuple[str, dict[str, Any]]:
    """Return what follows a where clause so that it gives these series, and the values for it."""
    if series is None:
        return "", {}
    drives, registers = ({pair[at]: None for pair in series} for at in (0, 1))
    values = {f"d{at}": name for at, name in enumerate(drives)}
    values |= {f"r{at}": name for at, name in enumerate(registers)}
    marks = {name: f"${mark}" for mark, name in values.items() if mark[0] == "d"}
    others = {name: f"${mark}" for mark, name in values.items() if mark[0] == "r"}
    condition = f" and drive in ({', '.join(marks.values())}) and register in ({', '.join(others.values())})"
    if len(drives) * len(registers) > len(series):  # slower, and seldom needed
        pairs = ", ".join(f"({marks[drive]}, {others[register]})" for drive, register in series)
        condition += f" and (drive, register) in ({pairs})"
    return condition, values
