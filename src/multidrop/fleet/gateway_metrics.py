"""Metrics of a fleet's gateway: what it says of itself, as families of samples. Pure.

What is not known, such as the margin of a lease where there is none, has no sample.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from multidrop.exposition import MetricFamily
from multidrop.fleet.leases.member import MemberState


class _Figure(NamedTuple):
    """A figure of a gateway's state, and where it stands there."""

    name: str
    kind: str  # "gauge" or "counter"
    text: str
    keys: tuple[str, ...]


_FIGURES = (
    _Figure("lines", "gauge", "Lines that are polled.", ("lines",)),
    _Figure("moves", "counter", "Lines that were claimed or given away.", ("moves",)),
    _Figure("spool_bytes", "gauge", "Bytes of all messages on the disk.", ("spool", "bytes")),
    _Figure("spool_waiting_rows", "gauge", "Rows in memory, not on the disk yet.", ("spool", "waiting")),
    _Figure("spool_rows", "counter", "Rows that reached the disk.", ("spool", "rows")),
    _Figure("spool_lost_rows", "counter", "Rows that did not, or went unsent.", ("spool", "lost")),
    _Figure("sent_messages", "counter", "Messages that the stream took.", ("spool", "sent")),
    _Figure("behind_messages", "gauge", "Messages that the stream lacks.", ("spool", "behind")),
    _Figure("behind_seconds", "gauge", "Age of the oldest message that it lacks.", ("spool", "lag_s")),
)
_LINES = {
    "lost": "Lines of its own that nobody polls, for their port is lost.",
    "failing": "Lines on which polling raised an exception lately, and is tried again.",
    "unopened": "Lines that others should take, for it cannot open their ports.",
}
_SUFFIXES = {"gauge": "", "counter": "_total"}
_PREFIX = "multidrop_fleet_"


def families_of(state: Mapping[str, Any], version: str) -> Iterator[MetricFamily]:
    """Yield all there is to be scraped, of what a gateway answers that is asked for its state."""
    about = {"gateway": state["gateway"], "version": version}
    yield MetricFamily(f"{_PREFIX}gateway", "info", "Name and version.", [("_info", about, 1.0)])
    label = f"{_PREFIX}gateway_state"
    states = [("", {label: one.value}, float(one.value == state["state"])) for one in MemberState]
    yield MetricFamily(label, "stateset", "State of the gateway.", states)
    if state["session"]:
        margin, text = state["margin_s"], "Time for which the gateway may still send."
        yield _family("lease_margin_seconds", "gauge", text, margin)
        yield _family("session", "gauge", "Number of the session.", state["session"])
    servers = len(set(filter(None, state["paths"])))
    yield _family("servers", "gauge", "Servers that its three connections are at.", servers)
    yield _family("troubled_lines", "gauge", "Lines that cannot be taken.", len(state["troubles"]))
    for key, text in _LINES.items():
        if key in state:  # no earlier version says so
            yield _family(f"{key}_lines", "gauge", text, len(state[key]))
    for figure in _FIGURES:
        value: Any = state
        for key in figure.keys:
            value = value[key]
        if value is not None:
            yield _family(figure.name, figure.kind, figure.text, value)


def _family(name: str, kind: str, text: str, value: float) -> MetricFamily:
    return MetricFamily(_PREFIX + name, kind, text, [(_SUFFIXES[kind], {}, float(value))])
