"""Judgement: are all answers of the simulated drives in the hub's files, once? By files and counts alone.

Each answer has a number, which is its value. A number that is missing is lost, unless a row says at its place
that the answer came too late, or the gateway was killed while it had that answer in its memory alone.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from multidrop.cli.fleet.demo.numbered_lines import NUMBERED
from multidrop.core import UNASKED

_MESSAGE = re.compile(r"(\d+)-(\d+)\.arrows")


class Kill(NamedTuple):
    """The death of a gateway: its drives, and the moments (ns, UTC) right before and after."""

    drives: frozenset[str]
    before_ns: int
    after_ns: int


class KeptRow(NamedTuple):
    """A row of the hub's files: when it was asked for, and the answer's number; None for a miss."""

    time_ns: int
    number: int | None


class Answers(NamedTuple):
    """Answers of one drive, or of all."""

    answered: int = 0
    kept: int = 0
    late: int = 0  # the row says that no answer came in time
    unsaved: int = 0  # in the memory of the gateway that was killed
    lost: int = 0
    doubled: int = 0


class StoredSource(NamedTuple):
    """The messages that a gateway has stored on its disk."""

    name: str  # gateway.log id
    newest: int
    rows: int
    is_whole: bool


def judge_drive(rows: Iterable[KeptRow], answered: int, kill: Kill | None) -> Answers:
    """Return what became of the answers of one drive; `kill` is that of its master, or None."""
    kept = late = unsaved = lost = doubled = misses = last = 0
    last_ns = 0
    ordered = sorted(rows, key=lambda row: row.time_ns)
    for row in (*ordered, KeptRow(1 << 63, answered + 1)):  # behind the last answer there is no gap
        if row.number is None:
            misses += 1
            continue
        gap = row.number - last - 1
        if gap < 0:
            doubled += 1
            continue
        explained = min(gap, misses)
        late += explained
        if kill and last_ns <= kill.after_ns and row.time_ns >= kill.before_ns:
            unsaved += gap - explained
        else:
            lost += gap - explained
        kept, last, last_ns, misses = kept + 1, row.number, row.time_ns, 0
    return Answers(answered, kept - 1, late, unsaved, lost, doubled)


def silence_s(rows: Iterable[KeptRow], kill: Kill) -> float:
    """Return for how long (s) a drive of the killed gateway was not polled."""
    times = sorted(row.time_ns for row in rows if row.number is not None)
    before = max((at for at in times if at <= kill.after_ns), default=kill.before_ns)
    after = min((at for at in times if at > kill.after_ns), default=before)
    return (after - before) / 1e9


def read_rows(parquet: Path) -> dict[str, list[KeptRow]]:
    """Return the rows of a hub's files by drive, but for those of values that no drive was asked for."""
    import pyarrow.parquet as pq

    found: dict[str, list[KeptRow]] = {}
    for path in _files(parquet):
        columns = ["time", "drive", "register", "value", "status"]
        table = pq.read_table(path, columns=columns)
        times = table.column("time").cast("int64").to_pylist()
        others = (table.column(name).to_pylist() for name in columns[1:])
        for at, drive, register, value, status in zip(times, *others, strict=True):
            if register == NUMBERED and not status.startswith(UNASKED):
                found.setdefault(drive, []).append(KeptRow(at, None if value is None else round(value)))
    return found


def all_rows(parquet: Path) -> int:
    import pyarrow.parquet as pq

    return sum(pq.read_metadata(path).num_rows for path in _files(parquet))


def kept_sources(parquet: Path) -> dict[str, int]:
    """Return the last message of each source, as the newest of the hub's files says."""
    import pyarrow.parquet as pq

    newest = max(_files(parquet), default=None)
    if newest is None:
        return {}
    about: dict[str, Any] = json.loads(pq.read_metadata(newest).metadata[b"multidrop"])
    return {str(name): int(last) for name, last in about["hub"]["sources"].items()}


def _files(parquet: Path) -> list[Path]:
    return sorted((parquet / "rows").glob("*.parquet"))


def stored_source(gateway: str, spool: Path) -> StoredSource:
    """Return what stands in a gateway's spool."""
    log = json.loads((spool / "spool.json").read_text("utf-8"))["log"]
    names = (_MESSAGE.fullmatch(path.name) for path in spool.iterdir())
    messages = {int(name[1]): int(name[2]) for name in names if name}
    newest = max(messages, default=0)
    return StoredSource(f"{gateway}.{log}", newest, sum(messages.values()), len(messages) == newest)


class Judgement(NamedTuple):
    """All that was found."""

    total: Answers
    worst: Mapping[str, Answers]  # drives with lost or doubled answers
    silences_s: list[float]  # of the killed gateway's drives
    sources: list[StoredSource]
    kept: Mapping[str, int]  # the last message of each source in the hub's files
    rows: int

    @property
    def holds(self) -> bool:
        return not self.worst and self.total.kept > 0 and not list(self._wrong_sources())

    def sentences(self) -> Iterator[str]:
        """Yield what is to be said."""
        total = self.total
        yield (
            f"the drives gave {total.answered} answers: {total.kept} are in the hub's files, each once; "
            f"{total.late} came too late, and rows say so; {total.unsaved} were in the memory of the killed "
            "gateway, which writes to its disk once a second"
        )
        rows = sum(source.rows for source in self.sources)
        messages = sum(source.newest for source in self.sources)
        yield (
            f"the gateways have written {rows} rows in {messages} messages to their disks, and the hub has "
            f"{self.rows}"
        )
        if self.silences_s:
            longest, middle = max(self.silences_s), sorted(self.silences_s)[len(self.silences_s) // 2]
            yield f"a drive of the killed gateway went unpolled for {middle:.1f} s, at most {longest:.1f} s"
        yield from self._wrong_sources()
        for drive, found in self.worst.items():
            yield f"WRONG: of {drive}, {found.lost} answers are missing and {found.doubled} are there twice"

    def _wrong_sources(self) -> Iterator[str]:
        for source in self.sources:
            if not source.is_whole:
                yield f"WRONG: {source.name} lacks messages below {source.newest} in its spool"
            if self.kept.get(source.name, 0) != source.newest:
                yield (
                    f"WRONG: the hub has {source.name} to message {self.kept.get(source.name, 0)}, and its "
                    f"spool to {source.newest}"
                )
        if self.rows != sum(source.rows for source in self.sources):
            yield "WRONG: the hub has another number of rows than the gateways have written"


def judge(parquet: Path, spools: Mapping[str, Path], answers: Mapping[str, int], kill: Kill) -> Judgement:
    """Return what became of all answers that the drives counted."""
    rows = read_rows(parquet)
    found = {
        drive: judge_drive(rows.get(drive, []), count, kill if drive in kill.drives else None)
        for drive, count in answers.items()
    }
    return Judgement(
        Answers(*map(sum, zip(*found.values(), strict=True))),
        {drive: one for drive, one in found.items() if one.lost or one.doubled},
        [silence_s(rows.get(drive, []), kill) for drive in sorted(kill.drives)],
        [stored_source(gateway, spool) for gateway, spool in spools.items()],
        kept_sources(parquet),
        all_rows(parquet),
    )
