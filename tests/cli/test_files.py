"""New files of commands are complete or absent."""

from __future__ import annotations

from pathlib import Path

import pytest
from batches import counting
from disks import full_at

from multidrop import Plant
from multidrop.cli.support import polling
from multidrop.cli.support.files import write_new
from multidrop.cli.support.polling import polling_session
from multidrop.polling.batch import Batch
from multidrop.recording import RecordingError, open_recording


def test_a_page_that_does_not_fit_on_the_disk_leaves_no_file(tmp_path: Path) -> None:
    page = tmp_path / "report.html"
    with full_at(100), pytest.raises(OSError, match=f"^{page}: cannot be written: File too large"):
        write_new(page, "x" * 101)
    assert not page.exists()
    write_new(page, "x" * 101)
    with pytest.raises(ValueError, match="exists already"):
        write_new(page, "y")
    assert page.read_text() == "x" * 101


class PollerOf:
    """A poller that delivers these batches."""

    batches: tuple[Batch, ...] = ()

    def __init__(self, plant: Plant) -> None:
        self._left = list(self.batches)

    def take(self) -> Batch | None:
        return self._left.pop(0) if self._left else None

    def close(self) -> None:
        pass


def test_the_error_of_a_full_disk_counts_the_readable_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second batch does not fit. The third batch would fit, but must not follow a gap."""
    monkeypatch.setattr(PollerOf, "batches", (counting(20), counting(2000), counting(5)))
    monkeypatch.setattr(polling, "Poller", PollerOf)
    out = tmp_path / "run.arrows"
    with (
        full_at(20_000),
        pytest.raises(RecordingError, match="the 20 rows before that can be read"),
        polling_session(Plant((), Path()), out) as session,
    ):
        session.hand_out()
    assert sum(map(len, open_recording(out))) == 20
