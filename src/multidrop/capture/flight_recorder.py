"""A flight recorder: the last minutes of the lines' traffic, written when something goes wrong."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from multidrop.capture.pcapng_writer import CaptureWriter
from multidrop.core import utc_minus_monotonic_ns
from multidrop.recording.format import writing
from multidrop.transport.clock import now_ns

AFTER_S = 2.0  # of traffic after the anomaly are written too
PAUSE_S = 60.0  # between two files, so that a noisy line does not fill the disk
_NAME = re.compile(r"flight-\d{8}T\d{6}Z\.pcapng")
_MOST_NAMED = 20  # anomalies in a file's comment


class FlightRecorder:
    """Keep the last `seconds` of the lines' traffic in memory, and no more than `most_bytes`.

    `AFTER_S` after an anomaly, and not before `PAUSE_S` have passed since the last file, a capture
    `flight-<UTC>.pcapng` is written into `directory`, with the anomaly in its comment. The newest
    `most_files` of them are kept. `written` lists those of this recorder. Raises RecordingError.
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
        if most_files < 1:
            raise ValueError(f"most_files = {most_files} would keep no capture")
        self.directory = Path(directory)
        self.written: list[Path] = []
        self._lines = lines
        self._kept_ns = round(seconds * 1e9)
        self._most_bytes = most_bytes
        self._most_files = most_files
        self._packets: deque[tuple[int, bytes]] = deque()
        self._bytes = 0
        self._anomalies: list[str] = []
        self._due_ns = 0
        self._next_ns = now_ns()
        with writing(self.directory):
            self.directory.mkdir(parents=True, exist_ok=True)

    def append(self, packets: bytes) -> None:
        """Keep packets of the lines, and drop those that are too old or too many."""
        self._packets.append((now_ns(), packets))
        self._bytes += len(packets)
        while self._packets and (
            self._bytes > self._most_bytes or self._packets[0][0] < self._packets[-1][0] - self._kept_ns
        ):
            self._bytes -= len(self._packets.popleft()[1])

    def report(self, anomalies: Sequence[str]) -> None:
        """Take note of anomalies, and write a capture if one is due."""
        now = now_ns()
        if anomalies and not self._anomalies:
            self._due_ns = max(now + round(AFTER_S * 1e9), self._next_ns)
        self._anomalies += anomalies[: _MOST_NAMED - len(self._anomalies)]
        if self._anomalies and now >= self._due_ns:
            self._write(now)

    def close(self) -> None:
        """Write the capture that is still due."""
        if self._anomalies and now_ns() >= self._next_ns:
            self._write(now_ns())

    def _write(self, now: int) -> None:
        second = (now + utc_minus_monotonic_ns()) // 10**9
        while (path := self.directory / _name(second)).exists():  # of another recorder in this directory
            second += 1
        with CaptureWriter(path, self._lines, "; ".join(dict.fromkeys(self._anomalies))) as capture:
            for _, packets in self._packets:
                capture.append(packets)
        self.written.append(path)
        self._anomalies = []
        self._next_ns = now + round(PAUSE_S * 1e9)
        files = sorted(file for file in self.directory.iterdir() if _NAME.fullmatch(file.name))
        for oldest in files[: -self._most_files]:
            oldest.unlink(missing_ok=True)  # another recorder may have removed it


def _name(second: int) -> str:
    return f"flight-{datetime.fromtimestamp(second, UTC):%Y%m%dT%H%M%SZ}.pcapng"
