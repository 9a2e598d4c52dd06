"""The plant as Prometheus metric families.

A silent drive has no values: its series disappear, so an old value never looks current.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from typing import TYPE_CHECKING

from multidrop.exposition import MetricFamily
from multidrop.gateway.live.frames import lost_of
from multidrop.gateway.live.hub import FAULT, RUNS, SILENT, STANDS, UNKNOWN, Hub
from multidrop.transport import LineStatistics

if TYPE_CHECKING:
    from multidrop.gateway.gateway import Gateway

Sample = tuple[str, Mapping[str, str], float]  # the name's suffix, labels, value
STATES = (RUNS, STANDS, FAULT, SILENT, UNKNOWN)


def families_of(gateway: Gateway) -> Iterator[MetricFamily]:
    """Yield the metrics of the plant, and of the gateway itself."""
    version = [("_info", {"version": gateway.version}, 1.0)]
    yield MetricFamily("multidrop_build", "info", "The version.", version)
    yield from plant_families(gateway.hub, gateway.recent.newest)
    dropped = gateway.poller.dropped if gateway.poller else 0
    yield counter("multidrop_rows_dropped", "Rows dropped because they were not taken in time.", dropped)
    yield counter("multidrop_frames", "Frames made for viewers.", gateway.frames.made)
    yield MetricFamily("multidrop_viewers", "gauge", "Waiting viewers.", [("", {}, gateway.frames.viewers)])
    counts = dict.fromkeys(("hub", *gateway.feeds), 0) | gateway.failures
    failures = [("_total", {"part": name}, float(n)) for name, n in counts.items()]
    yield MetricFamily("multidrop_part_failures", "counter", "Failures by part.", failures)
    for feed in gateway.feeds.values():
        with suppress(Exception):  # a failing part hides only its own figures
            yield from getattr(feed, "figures", list)()


def plant_families(hub: Hub, statistics: Mapping[str, LineStatistics]) -> Iterator[MetricFamily]:
    """Yield the metrics of values, drives and lines."""
    values, text = _values(hub), "Newest values of polled registers, in their units."
    yield MetricFamily("multidrop_value", "gauge", text, values)
    yield MetricFamily("multidrop_drive_state", "stateset", "State of each drive.", _states(hub))
    up = "1 while a line's port is present, 0 while it is lost."
    yield MetricFamily("multidrop_line_up", "gauge", up, _ups(hub))
    yield from _line_families(statistics)
    yield from _drive_families(statistics)


def _values(hub: Hub) -> Iterator[Sample]:
    for line in hub.plant.lines:
        for polled in line.drives:
            name = polled.drive.name
            for register, _, good, is_current in hub.known(name):
                if good is None or not is_current:
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
