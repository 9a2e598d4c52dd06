"""A flight recorder: the last minutes of what went over the lines, written when something goes wrong."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from multidrop.capture.pcapng_writer import CaptureWriter
from multidrop.core import utc_minus_monotonic_ns
from multidrop.recording.format import RecordingError
from multidrop.transport.clock import now_ns

AFTER_S = 2.0  # of what comes after the trouble are written too
PAUSE_S = 60.0  # between two files, so that a noisy line does not fill the disk
_NAME = re.compile(r"flight-\d{8}T\d{6}Z\.pcapng")
_MOST_TOLD = 20  # troubles in a file's comment


class FlightRecorder:
    """Keeps what went over these lines in the last `seconds`, and no more than `most_bytes`, in memory.

    When it is told of trouble it writes a capture `flight-<UTC>.pcapng` into `directory`, with the trouble
    in its comment: `AFTER_S` later, and not before `PAUSE_S` have passed since the last one. The newest
    `most_files` of them are kept. `written` has those that were written.
    """

    def __init__(
        self,
        directory: Path | str,
        lines: Sequence[str],
        *,
        seconds: float = 300.0,
        most_bytes: int = 16 << 20,
        most_files: int = 64,
    ) -> None:
        self.directory = Path(directory)
        self.written: list[Path] = []
        self._lines = lines
        self._kept_ns = round(seconds * 1e9)
        self._most_bytes = most_bytes
        self._most_files = most_files
        self._packets: deque[tuple[int, bytes]] = deque()
        self._bytes = 0
        self._troubles: list[str] = []
        self._due_ns = 0
        self._next_ns = now_ns()
        try:
            self.directory.mkdir(parents=True, exist_ok=True)
        except OSError as failure:
            raise RecordingError.of(failure, self.directory) from failure

    def append(self, packets: bytes) -> None:
        """Keep packets of the lines, and forget those that are too old or too many."""
        self._packets.append((now_ns(), packets))
        self._bytes += len(packets)
        while self._packets and (
            self._bytes > self._most_bytes or self._packets[0][0] < self._packets[-1][0] - self._kept_ns
        ):
            self._bytes -= len(self._packets.popleft()[1])

    def heed(self, troubles: Sequence[str]) -> None:
        """Take note of trouble, and write what is due to be written. Raises RecordingError."""
        now = now_ns()
        if troubles and not self._troubles:
            self._due_ns = max(now + round(AFTER_S * 1e9), self._next_ns)
        self._troubles += troubles[: _MOST_TOLD - len(self._troubles)]
        if self._troubles and now >= self._due_ns:
            self._write(now)

    def close(self) -> None:
        """Write what is not written yet of the last trouble."""
        if self._troubles and now_ns() >= self._next_ns:
            self._write(now_ns())

    def _write(self, now: int) -> None:
        moment = datetime.fromtimestamp((now + utc_minus_monotonic_ns()) // 10**9, UTC)
        path = self.directory / f"flight-{moment:%Y%m%dT%H%M%SZ}.pcapng"
        with CaptureWriter(path, self._lines, "; ".join(dict.fromkeys(self._troubles))) as capture:
            for _, packets in self._packets:
                capture.append(packets)
        self.written.append(path)
        self._troubles = []
        self._next_ns = now + round(PAUSE_S * 1e9)
        files = sorted(it for it in self.directory.iterdir() if _NAME.fullmatch(it.name))
        for oldest in files[: -self._most_files]:
            oldest.unlink()
