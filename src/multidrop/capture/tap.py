"""Tap polled lines: pass all of their traffic to captures and flight recorders."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Protocol, Self

from multidrop.bus import Bus
from multidrop.capture.pcapng import TCP_WRAPPINGS, WRAPPINGS, CaptureWriter
from multidrop.core import Status, Tap, utc_minus_monotonic_ns
from multidrop.drive.family import Drive
from multidrop.recording.format import writing
from multidrop.transport.clock import now_ns


class Sink(Protocol):
    """Receives the packets and anomalies of tapped lines: a capture or a flight recorder."""

    def append(self, packets: bytes) -> None: ...

    def report(self, anomalies: list[str]) -> None: ...


class Tapped:
    """Taps lines, given by name, and passes their traffic to sinks. Call `collect` several times a second.

        poller = Poller(plant)
        with CaptureWriter("hall.pcapng", list(poller.buses)) as capture:
            with Tapped(poller.buses, capture) as tapped, poller:
                for batch in poller.batches():
                    tapped.collect()

    Bytes that are not collected in time are dropped, and counted in `lost`.
    """

    def __init__(self, buses: Mapping[str, Bus], *sinks: Sink) -> None:
        self._sinks = sinks
        self._watches = [AnomalyWatch(name, bus) for name, bus in buses.items()]
        self._taps = [Tap() for _ in buses]
        self._wrappings = [TCP_WRAPPINGS if bus.line.is_tcp else WRAPPINGS for bus in buses.values()]
        for bus, tap in zip(buses.values(), self._taps, strict=True):
            bus.line.tap(tap)

    def collect(self) -> None:
        """Pass new traffic and anomalies to the sinks. Raises RecordingError."""
        self._hand_on()
        anomalies = [anomaly for watch in self._watches for anomaly in watch.check()]
        for sink in self._sinks:
            sink.report(anomalies)

    def _hand_on(self) -> None:
        offset = utc_minus_monotonic_ns()
        for interface, (tap, wrappings) in enumerate(zip(self._taps, self._wrappings, strict=True)):
            for packets in tap.take(wrappings, interface, offset):
                for sink in self._sinks:
                    sink.append(packets)

    @property
    def lost(self) -> int:
        return sum(tap.lost for tap in self._taps)

    def close(self) -> None:
        """Pass the remaining traffic to the sinks, without a last check for anomalies."""
        self._hand_on()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


AFTER_S = 2.0  # seconds of traffic that a file records after an anomaly
PAUSE_S = 60.0  # minimum time in s between two files, so that a noisy line does not fill the disk
_NAME = re.compile(r"flight-\d{8}T\d{6}Z\.pcapng")
_MOST_NAMED = 20  # largest number of anomalies in a file's comment


class FlightRecorder:
    """Keeps the traffic of the last `seconds`, at most `most_bytes`, and writes it after an anomaly.

    `AFTER_S` seconds after an anomaly, but at least `PAUSE_S` seconds after its last file, the recorder
    writes a capture `flight-<UTC>.pcapng` into `directory`. The file's comment names the anomaly. The
    recorder keeps the newest `most_files` captures. `written` lists the files of this recorder. Methods raise
    RecordingError.
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
            raise ValueError(f"most_files = {most_files} is not 1 or more")
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
        """Add packets of the lines, and drop the oldest packets beyond the limits of age and size."""
        self._packets.append((now_ns(), packets))
        self._bytes += len(packets)
        while self._packets and (
            self._bytes > self._most_bytes or self._packets[0][0] < self._packets[-1][0] - self._kept_ns
        ):
            self._bytes -= len(self._packets.popleft()[1])

    def report(self, anomalies: Sequence[str]) -> None:
        """Record these anomalies, and write a capture file if it is due."""
        now = now_ns()
        if anomalies and not self._anomalies:
            self._due_ns = max(now + round(AFTER_S * 1e9), self._next_ns)
        self._anomalies += anomalies[: _MOST_NAMED - len(self._anomalies)]
        if self._anomalies and now >= self._due_ns:
            self._write(now)

    def close(self) -> None:
        """Write the anomalies that are in no file yet, if PAUSE_S has passed since the last file."""
        if self._anomalies and now_ns() >= self._next_ns:
            self._write(now_ns())

    def _write(self, now: int) -> None:
        second = (now + utc_minus_monotonic_ns()) // 10**9
        while (path := self.directory / _name(second)).exists():  # another recorder has a file with this name
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


SILENT = 3  # a drive is reported as silent after this many unanswered exchanges in a row
_BAD = (
    Status.NO_START,
    Status.BAD_CHARACTER,
    Status.BAD_CHECKSUM,
    Status.BAD_ADDRESS,
    Status.BAD_FUNCTION,
    Status.BAD_LENGTH,
    Status.BAD_ECHO,
    Status.CUT_SHORT,
)


class AnomalyWatch:
    """Finds the anomalies of one line, such as damaged replies, silent drives and lost ports."""

    def __init__(self, name: str, bus: Bus) -> None:
        self._name = name
        self._bus = bus
        self._drives = [_TappedDrive(bus, drive) for drive in bus.drives]
        self._is_lost = False

    def check(self) -> Iterator[str]:
        """Yield a sentence for each anomaly since the last check."""
        port = self._bus.line.queue
        was_lost, self._is_lost = self._is_lost, port is None or port.lost
        if self._is_lost and not was_lost:
            yield f"{self._name}: the port was lost"
        for drive in self._drives:
            for anomaly in drive.check():
                yield f"{self._name}: {drive.name}: {anomaly}"


class _TappedDrive:
    def __init__(self, bus: Bus, drive: Drive) -> None:
        self.name = drive.name
        self._peer = bus.peer(drive)
        self._exchanges = self._late = 0
        self._is_silent = True
        self._bad: dict[Status, int] = {}

    def check(self) -> Iterator[str]:
        if self._peer.exchanges == self._exchanges:
            return
        counters = self._peer.counters()
        self._exchanges = counters.exchanges
        was_silent = self._is_silent
        self._is_silent = self._peer.failures >= SILENT or not counters.answered
        if self._is_silent and not was_silent:
            yield "fell silent"
        if counters.late > self._late:
            yield "late reply"
        bad = {result: counters.ended[result] for result in _BAD if result in counters.ended}
        for result, count in bad.items():
            if count > self._bad.get(result, 0):
                yield str(result)
        self._late, self._bad = counters.late, bad
