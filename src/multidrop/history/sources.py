"""The files of a history while they are replaced: segments that are open here, and DuckDB."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

from multidrop.history.database import Database, texts_of_metadata
from multidrop.history.folder import HistoryFile, Listing, listing
from multidrop.history.growing import GrowingSegment
from multidrop.history.quantities import Known, known_by

T = TypeVar("T")
ALWAYS = -(2**63), 2**63 - 1  # ns
MEMORY = "200MB"  # of DuckDB
MOST_TRIES = 50  # for files that are replaced: a busy machine takes longer than some of them last
MOST_GROWING = 4  # segments of which what was learnt is kept
FILES_AT_ONCE = 200  # of which metadata is read: a text may take 100 kB


class Replaced(Exception):
    """A file that was listed is gone: its rows are in another one, or were too old."""


class Sources:
    """All that is open of a folder; any thread may use it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.damage: dict[int, str] = {}  # sentences by segment
        self._growing: dict[int, GrowingSegment] = {}
        self._bounds: dict[int, tuple[int, int]] = {}  # of times in closed segments
        self._known: dict[int, Known] = {}  # quantities in segments
        self._changing = threading.Lock()
        self._database = Database(MEMORY)

    def close(self) -> None:
        with self._changing:
            while self._growing:
                self._growing.popitem()[1].let_go()
            self._database.close()

    def listing(self) -> Listing:
        """List the files that hold the history now, and close those that no longer do."""
        found = listing(self.folder)
        with self._changing:
            for number in set(self._growing) - set(found.segments):
                self._growing.pop(number).let_go()
        return found

    @contextmanager
    def segment(self, number: int, found: Listing, begin: int, end: int) -> Iterator[GrowingSegment | None]:
        """Give a segment, as far as it is written, open until the block is left.

        None where nothing of it is in this range, or can be read. Raises Replaced.
        """
        segment: GrowingSegment | None = None
        with self._changing:
            least, most = self._bounds.get(number, ALWAYS)
            if least < end and begin <= most:
                segment = self._held(number, found.segments[number])
            if segment and number < max(found.segments):  # it is closed: nothing will come to it
                self._bounds[number] = segment.bounds
                if segment.left_out:
                    left_out = (
                        f"the last {segment.left_out} bytes of {found.segments[number]} are no whole batch"
                    )
                    self.damage.setdefault(number, left_out)
        try:
            yield segment
        finally:
            if segment:
                segment.let_go()

    def _held(self, number: int, path: Path) -> GrowingSegment | None:
        """Return a segment for the caller to let go of. The indexes of the newest ones are kept."""
        segment = self._growing.get(number)
        if segment is None:
            try:
                segment = GrowingSegment(path)
            except FileNotFoundError:
                raise Replaced from None
            except ValueError as error:  # it has no head: the machine lost power, or it begins just now
                if path.exists() and path.stat().st_size:
                    self.damage[number] = str(error)
                return None
            self._growing[number] = segment
        self.damage.pop(number, None)
        segment.look()
        segment.hold()
        if segment.damage:
            self.damage[number] = segment.damage
        for older in sorted(self._growing)[:-MOST_GROWING]:
            self._growing.pop(older).let_go()
        return segment

    def known(self, found: Listing, begin: int, end: int) -> dict[int, Known]:
        """Return the quantities of each segment that may have rows of this range. Raises Replaced."""
        files = {number: file for number, file in found.rows.items() if file.may_have(begin, end)}
        unread = [file for number, file in files.items() if number not in self._known]
        for at in range(0, len(unread), FILES_AT_ONCE):
            self._read_quantities(unread[at : at + FILES_AT_ONCE])
        numbers = [*files]
        for number in found.segments:
            with self.segment(number, found, begin, end) as segment:
                if segment and segment.batches(begin, end):
                    numbers.append(number)
                    if number not in self._known:
                        self._known[number] = known_by(segment.metadata)
        return {number: self._known[number] for number in numbers}

    def _read_quantities(self, files: Sequence[HistoryFile]) -> None:
        numbers = {str(file.path): file.first for file in files}
        read: dict[int, Known] = {number: {} for number in numbers.values()}
        with self.cursor() as cursor, while_there(files):
            for text, paths in texts_of_metadata(cursor, [file.path for file in files]):
                known = known_by(_parsed(text))
                read |= {numbers[path]: known for path in paths}
        self._known |= read

    def cursor(self) -> Any:
        """Return a cursor of DuckDB, to be closed. Raises ImportError."""
        with self._changing:
            return self._database.cursor()

    def again(self, act: Callable[[Listing], T]) -> T:
        """Return act(listing), called again as long as files are replaced meanwhile."""
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
    """Raise Replaced where the block fails because one of the files is gone."""
    try:
        yield
    except Exception as failure:
        if all(file.path.exists() for file in files):
            raise
        raise Replaced from failure
