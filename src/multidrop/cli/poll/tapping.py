"""A poll's lines tapped as the command line says: into a capture, a flight recorder, both or none."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any

from multidrop.capture import CaptureWriter, FlightRecorder, Tapped
from multidrop.poller import Poller


class Tapping:
    """Taps the lines of a poller, if there is any use for it; leaving the `with` block closes the files."""

    def __init__(self, poller: Poller, capture: Path | None, flight: Path | None) -> None:
        lines = list(poller.buses)
        self._capture = CaptureWriter(capture, lines) if capture else None
        self._flight = FlightRecorder(flight, lines) if flight else None
        sinks = [sink for sink in (self._capture, self._flight) if sink]
        self._tapped = Tapped(poller.buses, *sinks) if sinks else None

    def collect(self) -> None:
        if self._tapped:
            self._tapped.collect()

    def summary(self) -> dict[str, Any]:
        """What was written; nothing where nothing was tapped."""
        told: dict[str, Any] = {}
        if self._capture:
            told["capture"] = str(self._capture.path)
        if self._flight:
            told["flight_recordings"] = [str(path) for path in self._flight.written]
        if self._tapped:
            told["untapped_bytes"] = self._tapped.lost
        return told

    def __enter__(self) -> Tapping:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with ExitStack() as stack:
            for closed in (self._capture, self._flight, self._tapped):
                if closed:
                    stack.callback(closed.close)


def tapping_text(summary: Mapping[str, Any]) -> list[str]:
    """The same in words."""
    lines = [f"captured in {summary['capture']}"] if "capture" in summary else []
    lines += [f"trouble: see {path}" for path in summary.get("flight_recordings", [])]
    if summary.get("untapped_bytes"):
        lines.append(f"{summary['untapped_bytes']} bytes were not captured: this machine was too slow")
    return lines
