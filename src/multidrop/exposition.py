"""Format metrics as text, in the two formats that scrapers such as Prometheus read. No I/O."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import lru_cache
from math import isfinite
from typing import NamedTuple

OPEN_METRICS = "application/openmetrics-text"
OPEN_METRICS_TYPE = f"{OPEN_METRICS}; version=1.0.0; charset=utf-8"
# text format of Prometheus, which the program promtool reads
PLAIN_TYPE = "text/plain; version=0.0.4; charset=utf-8"
# replacements for kinds of metrics that the plain format lacks
PLAIN_KINDS = {"info": "gauge", "stateset": "gauge"}
# in the plain format: suffixes of metric names, by kind of metric
NAMED_WITH_SUFFIX = {"info": "_info", "counter": "_total"}
MOST_LABELS = 16_384  # limit of label texts in the cache, about 5 MB

Labels = Mapping[str, str]
Sample = tuple[str, Labels, float]  # suffix of the metric's name, labels, value


class MetricFamily(NamedTuple):
    """A metric: its name, kind and help text, and its samples, each with its labels."""

    name: str
    kind: str  # "gauge", "counter", "summary", "info" or "stateset"
    text: str
    samples: Iterable[Sample]


def expose_metrics(families: Iterable[MetricFamily], accept: str) -> tuple[str, str]:
    """Return content type and text, in the format that the request's `Accept` header asks for."""
    if OPEN_METRICS in accept:
        return OPEN_METRICS_TYPE, open_metrics(families)
    return PLAIN_TYPE, plain_text(families)


def open_metrics(families: Iterable[MetricFamily]) -> str:
    """Return the metrics in the format OpenMetrics 1.0."""
    return "".join(_written(one, one.name, one.kind) for one in families) + "# EOF\n"


def plain_text(families: Iterable[MetricFamily]) -> str:
    """Return the metrics in Prometheus' text format 0.0.4, in which the name of a counter ends in _total."""
    return "".join(
        _written(one, one.name + NAMED_WITH_SUFFIX.get(one.kind, ""), PLAIN_KINDS.get(one.kind, one.kind))
        for one in families
    )


def _written(family: MetricFamily, name: str, kind: str) -> str:
    lines = [f"# TYPE {name} {kind}\n# HELP {name} {family.text}\n"]
    for suffix, labels, value in family.samples:
        if isfinite(value):
            lines.append(f"{family.name}{suffix}{_braced(*labels.items())} {float(value)!r}\n")
    return "".join(lines)


@lru_cache(maxsize=MOST_LABELS)
def _braced(*labels: tuple[str, str]) -> str:
    """Return a sample's labels as text in braces. Cached, because the next scrape has the same labels."""
    inside = ",".join(f'{label}="{_escaped(value)}"' for label, value in labels)
    return f"{{{inside}}}" if inside else ""


def _escaped(text: str) -> str:
    return text.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")
