"""Summaries of polled lines and drives, as plain numbers that JSON can hold."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from multidrop.core import Peer
from multidrop.transport.statistics import Statistics, line_statistics


def line_summary(seconds: float, peers: Mapping[str, Peer]) -> dict[str, Any]:
    """Return what came of a line's exchanges in so many seconds, in all and by drive."""
    line = line_statistics(seconds, {name: peer.counters() for name, peer in peers.items()}, None)
    return {
        "seconds": round(seconds, 3),
        "exchanges": line.counters.exchanges,
        "samples": line.samples,
        "misses": dict(line.misses),
        "late_replies": line.late_replies,
        "stray_bytes": line.skipped_bytes,
        "utilisation": round(line.utilisation, 4),
        "drives": {
            name: _drive_summary(line.drives[name], peer.response_delay) for name, peer in peers.items()
        },
    }


def _drive_summary(drive: Statistics, response_delay: float) -> dict[str, Any]:
    return {
        "exchanges": drive.counters.exchanges,
        "samples": drive.samples,
        "exchanges_per_second": round(drive.counters.answered / drive.seconds, 2),
        "samples_per_second": round(drive.samples / drive.seconds, 2),
        "response_delay_ms": round(response_delay * 1e3, 3),
        "timeout_ms": round(drive.timeout * 1e3, 3),
        "p99_delay_ms": round(drive.delays.p99 * 1e3, 3),
        "misses": dict(drive.misses),
    }
