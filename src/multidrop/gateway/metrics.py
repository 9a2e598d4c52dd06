"""The values of a plant and its gateway as Prometheus metrics, in base units such as volts and seconds.

A silent drive has no values: its time series end, so an old value never looks current.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from multidrop import Register
from multidrop.exposition import MetricFamily
from multidrop.gateway.live.alarms import KINDS, PORT, Alarm
from multidrop.gateway.live.frames import lost_of
from multidrop.gateway.live.hub import STATES, Hub
from multidrop.gateway.live.views import health_of
from multidrop.transport import LineStatistics

if TYPE_CHECKING:
    from multidrop.gateway.gateway import Gateway

# one sample of a metric: suffix of the metric's name, labels, value
Sample = tuple[str, Mapping[str, str], float]
HEALTH = ("ok", "degraded", "failed")


class BaseUnit(NamedTuple):
    """The unit of a metric, and the factor that converts a register's value to this unit."""

    name: str
    factor: float = 1.0


UNITS = {  # units of metrics, by the unit of the register
    "Hz": BaseUnit("hertz"),
    "kHz": BaseUnit("hertz", 1e3),
    "A": BaseUnit("amperes"),
    "mA": BaseUnit("amperes", 1e-3),
    "V": BaseUnit("volts"),
    "W": BaseUnit("watts"),
    "kW": BaseUnit("watts", 1e3),
    "kWh": BaseUnit("joules", 3.6e6),
    "%": BaseUnit("ratio", 0.01),
    "°C": BaseUnit("celsius"),
    "ms": BaseUnit("seconds", 1e-3),
    "s": BaseUnit("seconds"),
    "min": BaseUnit("seconds", 60.0),
    "h": BaseUnit("seconds", 3600.0),
    "rpm": BaseUnit("rpm"),
    "Nm": BaseUnit("newton_meters"),
    "bar": BaseUnit("pascals", 1e5),
    "kgf/cm²": BaseUnit("pascals", 98_066.5),
    "atm": BaseUnit("pascals", 101_325.0),
    "raw count": BaseUnit("raw"),
    "": BaseUnit("number"),
}
CODE = BaseUnit("code")  # unit of registers with named values; their metrics have the raw counts
OTHER = BaseUnit("other")  # for all other units: the register's own unit is in a label
TEXTS = {
    "code": "Numbers of named values, such as states.",
    "number": "Values without a unit.",
    "raw": "Raw counts of registers whose document states no scale.",
    "other": "Values in the unit that the label says.",
}


def families_of(gateway: Gateway) -> Iterator[MetricFamily]:
    """Yield all metrics of the plant, and of the gateway itself."""
    version = [("_info", {"version": gateway.version}, 1.0)]
    yield MetricFamily("multidrop_build", "info", "The version.", version)
    status = health_of(gateway)["status"]
    health = [("", {"multidrop_health": one}, float(one == status)) for one in HEALTH]
    yield MetricFamily("multidrop_health", "stateset", "Health of the gateway.", health)
    yield from plant_families(gateway.hub, gateway.recent.newest)
    active = "1 while an alarm of this kind is active."
    yield MetricFamily(
        "multidrop_alarm_active", "gauge", active, _alarms(gateway.hub, gateway.alarms.lasting)
    )
    dropped = gateway.poller.dropped if gateway.poller else 0
    yield counter("multidrop_rows_dropped", "Rows dropped because they were not taken in time.", dropped)
    yield counter("multidrop_frames", "Frames made for viewers.", gateway.frames.made)
    yield MetricFamily("multidrop_viewers", "gauge", "Waiting viewers.", [("", {}, gateway.frames.viewers)])
    counts = dict.fromkeys(("hub", *gateway.feeds), 0) | gateway.failures
    failures = [("_total", {"part": name}, float(n)) for name, n in counts.items()]
    yield MetricFamily("multidrop_part_failures", "counter", "Failures by part.", failures)
    for feed in gateway.feeds.values():
        with suppress(Exception):  # a part that raises an exception loses only its own metrics
            yield from getattr(feed, "figures", list)()
    with suppress(OSError):  # no /proc, or no file descriptor left
        yield from process_families()


def plant_families(hub: Hub, statistics: Mapping[str, LineStatistics]) -> Iterator[MetricFamily]:
    models = "Model and address of each drive."
    yield MetricFamily("multidrop_drive", "info", models, _models(hub))
    yield from _value_families(hub)
    yield MetricFamily("multidrop_drive_state", "stateset", "State of each drive.", _states(hub))
    up = "1 while a line's port is present, 0 while it is lost."
    ups = [("", {"line": line.name}, float(lost_of(hub, line.name) is None)) for line in hub.plant.lines]
    yield MetricFamily("multidrop_line_up", "gauge", up, ups)
    yield from _line_families(statistics)
    yield from _drive_families(statistics)


def _models(hub: Hub) -> Iterator[Sample]:
    for line in hub.plant.lines:
        for drive in (polled.drive for polled in line.drives):
            model = drive.model or type(drive).__name__
            labels = {"line": line.name, "drive": drive.name, "model": model, "address": str(drive.address)}
            yield "_info", labels, 1.0


def _value_families(hub: Hub) -> Iterator[MetricFamily]:
    """Yield a metric family of polled values for each unit, then one with the age of each value."""
    values: dict[str, list[Sample]] = {}
    ages: list[Sample] = []
    now_ns, woke_ns, utc_ns = hub.now_ns(), hub.woke_ns(), time.time_ns()
    for line in hub.plant.lines:
        for polled in line.drives:
            name = polled.drive.name
            for register, _, good, is_current in hub.known(name):
                if good is None:
                    continue
                labels = {"line": line.name, "drive": name, "register": register.name}
                age_ns = now_ns - good[1]
                if good[1] < woke_ns:  # the monotonic clock stopped while the computer slept
                    age_ns = max(age_ns, utc_ns - good[0])
                ages.append(("", labels, age_ns / 1e9))
                if is_current:
                    unit = base_unit(register)
                    labels = labels | {"unit": register.value_unit} if unit is OTHER else labels
                    values.setdefault(unit.name, []).append(("", labels, good[2] * unit.factor))
    for unit_name, samples in values.items():
        text = TEXTS.get(unit_name, f"Values of polled registers in {unit_name.replace('_', ' ')}.")
        yield MetricFamily(f"multidrop_register_{unit_name}", "gauge", text, samples)
    text = "Time since the newest value was requested."
    yield MetricFamily("multidrop_register_age_seconds", "gauge", text, ages)


def base_unit(register: Register[Any]) -> BaseUnit:
    return CODE if register.values is not None else UNITS.get(register.value_unit, OTHER)


def _alarms(hub: Hub, lasting: list[Alarm]) -> Iterator[Sample]:
    """Yield a sample for each kind of alarm of each line and drive: 1 if such an alarm is active, else 0."""
    active = {(alarm.drive or alarm.line, alarm.kind) for alarm in lasting}
    for line in hub.plant.lines:
        yield "", {"line": line.name, "drive": "", "kind": PORT}, float((line.name, PORT) in active)
        for name in (polled.drive.name for polled in line.drives):
            for kind in KINDS:
                if kind != PORT:
                    labels = {"line": line.name, "drive": name, "kind": kind}
                    yield "", labels, float((name, kind) in active)


def _states(hub: Hub) -> Iterator[Sample]:
    for line in hub.plant.lines:
        for polled in line.drives:
            present = hub.state(polled.drive.name)
            for state in STATES:
                labels = {"line": line.name, "drive": polled.drive.name, "multidrop_drive_state": state}
                yield "", labels, float(state == present)


def _line_families(statistics: Mapping[str, LineStatistics]) -> Iterator[MetricFamily]:
    counters: dict[str, tuple[str, Callable[[LineStatistics], float]]] = {
        "multidrop_line_exchanges": ("Requests sent.", lambda line: line.exchanges),
        "multidrop_line_samples": ("Values received.", lambda line: line.samples),
        "multidrop_line_used_seconds": ("Line time of answered exchanges.", lambda line: line.used_s),
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


def process_families() -> Iterator[MetricFamily]:
    """Yield the usual metrics of a process; on systems other than Linux only its CPU time."""
    yield counter("process_cpu_seconds", "CPU time of user and system.", time.process_time())
    if sys.platform != "linux":
        return
    resident = int(Path("/proc/self/statm").read_text("ascii").split()[1]) * os.sysconf("SC_PAGE_SIZE")
    figures = {
        "process_resident_memory_bytes": ("Resident memory.", resident),
        "process_open_fds": ("Open file descriptors.", len([*Path("/proc/self/fd").iterdir()])),
        "process_max_fds": ("Limit of open file descriptors.", os.sysconf("SC_OPEN_MAX")),
        "process_start_time_seconds": ("Start of the process, in s since 1970.", _process_start()),
    }
    for name, (text, value) in figures.items():
        yield MetricFamily(name, "gauge", text, [("", {}, float(value))])


@lru_cache(maxsize=1)
def _process_start() -> float:
    ticks = int(Path("/proc/self/stat").read_text("ascii", "replace").rpartition(")")[2].split()[19])
    return time.time() - time.clock_gettime(time.CLOCK_BOOTTIME) + ticks / os.sysconf("SC_CLK_TCK")
