"""Tap polled lines: hand all of their traffic to captures and flight recorders."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol, Self

from multidrop.bus import Bus
from multidrop.capture.anomalies import AnomalyWatch
from multidrop.capture.pcapng_writer import TCP_WRAPPINGS, WRAPPINGS
from multidrop.core import Tap, utc_minus_monotonic_ns


class Sink(Protocol):
    """Take the packets of tapped lines, and their anomalies."""

    def append(self, packets: bytes) -> None: ...

    def report(self, anomalies: list[str]) -> None: ...


class Tapped:
    """Taps on these lines, by name; call `collect` some times a second.

        poller = Poller(plant)
        with CaptureWriter("hall.pcapng", list(poller.buses)) as capture:
            with Tapped(poller.buses, capture) as tapped, poller:
                for batch in poller.batches():
                    tapped.collect()

    Bytes that are not collected in time are lost, and counted in `lost`.
    """

    def __init__(self, buses: Mapping[str, Bus], *sinks: Sink) -> None:
        self._sinks = sinks
        self._watches = [AnomalyWatch(name, bus) for name, bus in buses.items()]
        self._taps = [Tap() for _ in buses]
        self._wrappings = [TCP_WRAPPINGS if bus.line.is_tcp else WRAPPINGS for bus in buses.values()]
        for bus, tap in zip(buses.values(), self._taps, strict=True):
            bus.line.tap(tap)

    def collect(self) -> None:
        """Hand traffic and anomalies to the sinks. Raises RecordingError."""
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
        """Hand on the rest; a port that is closed by now is no anomaly."""
        self._hand_on()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()
