"""Lines that are polled, tapped: all that goes over them, handed on to captures and flight recorders."""

from __future__ import annotations

from collections.abc import Mapping
from types import TracebackType
from typing import Protocol

from multidrop.bus import Bus
from multidrop.capture.anomalies import Watch
from multidrop.capture.pcapng_writer import WRAPPINGS
from multidrop.core import Tap, utc_minus_monotonic_ns


class Sink(Protocol):
    """Takes packets of tapped lines, and is told of what goes wrong on them."""

    def append(self, packets: bytes) -> None: ...

    def heed(self, troubles: list[str]) -> None: ...


class Tapped:
    """Taps on these lines, by name: they are handed on whenever `collect` is called, some times a second.

        poller = Poller(plant)
        with CaptureWriter("hall.pcapng", list(poller.buses)) as capture:
            with Tapped(poller.buses, capture) as tapped, poller:
                for batch in poller.batches():
                    tapped.collect()

    What is not collected in time is lost, and counted in `lost` (bytes).
    """

    def __init__(self, buses: Mapping[str, Bus], *sinks: Sink) -> None:
        self._sinks = sinks
        self._watches = [Watch(name, bus) for name, bus in buses.items()]
        self._taps = [Tap() for _ in buses]
        for bus, tap in zip(buses.values(), self._taps, strict=True):
            bus.line.tap(tap)

    def collect(self) -> None:
        """Hand on what went over the lines, and what went wrong. Raises RecordingError."""
        self._hand_on()
        troubles = [trouble for watch in self._watches for trouble in watch.look()]
        for sink in self._sinks:
            sink.heed(troubles)

    def _hand_on(self) -> None:
        offset = utc_minus_monotonic_ns()
        for interface, tap in enumerate(self._taps):
            for packets in tap.take(WRAPPINGS, interface, offset):
                for sink in self._sinks:
                    sink.append(packets)

    @property
    def lost(self) -> int:
        """Bytes that were not collected in time."""
        return sum(tap.lost for tap in self._taps)

    def close(self) -> None:
        """Hand on the rest. That ports are closed now is no trouble."""
        self._hand_on()

    def __enter__(self) -> Tapped:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
