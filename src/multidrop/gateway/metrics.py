"""The plant as Prometheus metric families. Pure.

A silent drive has no values: its series disappear, so an old value never looks current.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

from multidrop.exposition import MetricFamily
from multidrop.gateway.live.frames import lost_of
from multidrop.gateway.live.hub import FAULT, RUNS, SILENT, STANDS, UNKNOWN, Hub
from multidrop.transport import LineStatistics

Sample = tuple[str, Mapping[str, str], float]  # the name's suffix, labels, value
STATES = (RUNS, STANDS, FAULT, SILENT, UNKNOWN)


class Figures(NamedTuple):
    """Figures of the gateway itself."""

    version: str
    viewers: int
    frames: int
    dropped: int  # number of rows
    failures: Mapping[str, int]  # number of failures of each part, by name
    parts: Sequence[MetricFamily]  # the parts' own metrics


def families_of(
    hub: Hub, statistics: Mapping[str, LineStatistics], figures: Figures
) -> Iterator[MetricFamily]:
    """Yield the metrics of the plant, and of the gateway itself."""
    yield MetricFamily(
        "multidrop_build", "info", "The version.", [("_info", {"version": figures.version}, 1)]
    )
    yield MetricFamily(
        "multidrop_value", "gauge", "Newest values of polled registers, in their units.", _values(hub)
    )
    yield MetricFamily("multidrop_drive_state", "stateset", "State of each drive.", _states(hub))
    yield MetricFamily(
        "multidrop_line_up", "gauge", "1 while a line's port is present, 0 while it is lost.", _ups(hub)
    )
    yield from _line_families(statistics)
    yield from _drive_families(statistics)
    yield counter(
        "multidrop_rows_dropped", "Rows dropped because they were not taken in time.", figures.dropped
    )
    yield counter("multidrop_frames", "Frames made for viewers.", figures.frames)
    yield MetricFamily("multidrop_viewers", "gauge", "Waiting viewers.", [("", {}, figures.viewers)])
    failures = [("_total", {"part": name}, float(n)) for name, n in figures.failures.items()]
    yield MetricFamily("multidrop_part_failures", "counter", "Failures by part.", failures)
    yield from figures.parts


def _values(hub: Hub) -> Iterator[Sample]:
    for line in hub.plant.lines:
        for polled in line.drives:
            name = polled.drive.name
            for register, (_, _, good, is_fresh) in zip(hub.polled(name), hub.known(name), strict=True):
                if good is None or not is_fresh:
                    continue
                labels = {"line": line.name, "drive": name, "register": register.name}
                labels["unit"] = register.value_unit
                yield "", labels, good[2]


def _states(hub: Hub) -> Iterator[Sample]:
    for line in hub.plant.lines:
        for polled in line.drives:
            present = hub.state(polled.drive.name)
            for state in STATES:
                labels = {"line": line.name, "drive": polled.drive.name, "multidrop_drive_state": state}
                yield "", labels, float(state == present)


def _ups(hub: Hub) -> Iterator[Sample]:
    for line in hub.plant.lines:
        yield "", {"line": line.name}, float(lost_of(hub, line.name) is None)


def _line_families(statistics: Mapping[str, LineStatistics]) -> Iterator[MetricFamily]:
    counters: dict[str, tuple[str, Callable[[LineStatistics], float]]] = {
        "multidrop_line_exchanges": ("Requests sent.", lambda line: line.exchanges),
        "multidrop_line_samples": ("Values received.", lambda line: line.samples),
        "multidrop_line_used_seconds": (
            "Line time of answered exchanges.",
            lambda line: line.used_s,
        ),
    }
    for name, (text, count) in counters.items():
        samples = [("_total", {"line": line}, count(found)) for line, found in statistics.items()]
        yield MetricFamily(name, "counter", text, samples)


def _drive_families(statistics: Mapping[str, LineStatistics]) -> Iterator[MetricFamily]:
    drives = [
        ({"line": line, "drive": name}, drive)
        for line, found in statistics.items()
        for name, drive in found.drives.items()
    ]
    misses = [
        ("_total", {**labels, "reason": reason}, float(n))
        for labels, drive in drives
        for reason, n in drive.misses.items()
    ]
    yield MetricFamily("multidrop_misses", "counter", "Missing values by reason.", misses)
    delays: list[Sample] = []
    for labels, drive in drives:
        found = drive.delays
        if found.replies:
            for quantile, value in (("0.5", found.p50), ("0.9", found.p90), ("0.99", found.p99)):
                delays.append(("", {**labels, "quantile": quantile}, value))
        delays.append(("_count", labels, float(found.replies)))
    yield MetricFamily(
        "multidrop_response_delay_seconds",
        "summary",
        "Time from the end of a request to the start of its reply.",
        delays,
    )


def counter(name: str, text: str, value: float) -> MetricFamily:
    """Return a metric family with a single counter."""
    return MetricFamily(name, "counter", text, [("_total", {}, value)])
