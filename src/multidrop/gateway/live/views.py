"""Views: what pages and probes are told of a gateway, made when they ask."""

from __future__ import annotations

import contextlib
import time
from functools import partial
from typing import TYPE_CHECKING, Any

from multidrop import Drive
from multidrop.control import Ledger
from multidrop.exposition import MetricFamily
from multidrop.gateway.live.frames import lost_of
from multidrop.gateway.live.recent_statistics import asked_of, misses_of
from multidrop.gateway.metrics import Figures
from multidrop.gateway.stops_amid_reload import drives_of
from multidrop.plant import drive_meant
from multidrop.supervisor import Hung, supervisor
from multidrop.transport import Statistics

if TYPE_CHECKING:
    from multidrop.gateway.gateway import Gateway

LEDGER_S = 6.0  # that the ledger may take: it waits 5 s for a lock


async def look_at(gateway: Gateway, name: str) -> dict[str, Any]:
    """Return what the page shows of one drive alone. Raises ValueError for an unknown one."""
    name = drive_meant(name, drives_of(gateway.plant))
    line, drive = gateway.plant.find_drive(name)
    bus = gateway.poller.buses.get(line.name) if gateway.poller else None
    port = bus.line.identity if bus else line.port
    wear = await _wear_within(gateway.ledger, port, drive)
    found = gateway.side_reads.look(gateway.plant, name)
    statistics = gateway.recent.drive(line.name, name)
    return {
        "drive": name,
        "delays": _delays(statistics),
        "misses": misses_of(statistics) if statistics else {},
        "asked": asked_of(statistics) if statistics else 0,
        "timeout_ms": round(statistics.timeout * 1e3, 1) if statistics else None,
        "values": found,
        "ledger": wear,
    }


def _delays(statistics: Statistics | None) -> dict[str, Any] | None:
    if statistics is None:
        return None
    delays = statistics.delays
    return {
        **_usual_delays(statistics),
        "longest": round(delays.longest * 1e3, 3),
        "replies": delays.replies,
        "counts": [[round(least * 1e3, 3), count] for least, count in statistics.delay_counts],
    }


def _usual_delays(statistics: Statistics) -> dict[str, float | None]:
    """Return the median and the 99th percentile of the response delays, in ms; None where nothing replied."""
    delays = statistics.delays
    quantiles = {"p50": delays.p50, "p99": delays.p99}
    return {name: round(s * 1e3, 3) if delays.replies else None for name, s in quantiles.items()}


async def _wear_within(ledger: Ledger, port: str, drive: Drive) -> list[dict[str, Any]]:
    """Return the wear, or none if the ledger's file is locked for long, or its disk does not answer."""
    with contextlib.suppress(Hung):
        return await supervisor().within("ledger", LEDGER_S, partial(_wear, ledger, port, drive))
    return []


def _wear(ledger: Ledger, port: str, drive: Drive) -> list[dict[str, Any]]:
    """Return the writes of a year to each cell of a drive's EEPROM, and how many it may have."""
    with contextlib.suppress(OSError):
        book = ledger.at(port)
        return [
            {
                "register": wear.cell.register,
                "year": wear.this_year,
                "budget": book.budget,
                "total": wear.writes,
            }
            for wear in book.wear_of(port, drive.address, drive.ledger_name, time.time())
        ]
    return []


def look_at_lines(gateway: Gateway) -> dict[str, Any]:
    """Return what the page shows of the lines alone."""
    return {
        line.name: {
            "lost": lost_of(gateway.hub, line.name),
            "minutes": gateway.recent.hour(line.name),
            "drives": {
                polled.drive.name: _drive_figures(gateway.recent.drive(line.name, polled.drive.name))
                for polled in line.drives
            },
        }
        for line in gateway.plant.lines
    }


def health_of(gateway: Gateway) -> dict[str, Any]:
    """Return how all is, by line and by part: "ok", "degraded", or "failed".

    It has failed if nothing is polled, or if a task or a thread that must go on has ended.
    """
    supervisor().look()
    dead, hung = supervisor().dead | gateway.parts.dead, supervisor().hung
    failing = failing_lines_of(gateway)
    lost = {
        line.name: failing.get(line.name) or lost_of(gateway.hub, line.name) or "ok"
        for line in gateway.plant.lines
    }
    parts = parts_of(gateway)
    audit = audit_trouble_of(gateway) or "ok"
    is_well = {"ok", audit, *lost.values(), *parts.values()} == {"ok"} and not gateway.reload.mistakes
    is_well = is_well and not hung
    has_failed = gateway.hub.taken == 0 or bool(dead)
    return {
        "status": "failed" if has_failed else "ok" if is_well else "degraded",
        "version": gateway.version,
        "uptime_s": round(gateway.clock() - gateway.begun, 1),
        "newest_row": gateway.hub.time // 1_000_000,
        "lines": lost,
        "parts": parts,
        "audit": audit,
        "dead": dead,
        "hung": hung,
        "mistakes": gateway.reload.mistakes,
        "restart": gateway.reload.restart,
        "failures": gateway.failures,
    }


def parts_of(gateway: Gateway) -> dict[str, str]:
    """Return "ok" of each part, or what is not well with it."""
    parts, dead, kept = gateway.parts, supervisor().dead, gateway.alarm_file
    return (
        {name: _health_of_part(feed) for name, feed in parts.feeds.items()}
        | dict.fromkeys(parts.pending, "it is not there yet: its files do not answer")
        | parts.dead
        | {name: why for name, why in dead.items() if name in parts.feeds}
        | ({"alarms": kept.trouble} if kept is not None and kept.trouble else {})
    )


def failing_lines_of(gateway: Gateway) -> dict[str, str]:
    """Return by name why a line is not polled at present: an exception, such as one of a user's class."""
    failures = {} if gateway.poller is None else gateway.poller.line_failures
    return {line: f"polling fails: {why}" for line, why in failures.items()}


def audit_trouble_of(gateway: Gateway) -> str:
    """Return why the newest write of a line is not in the audit log; "" is well."""
    if gateway.unaudited:
        return gateway.unaudited
    poller = gateway.poller
    lines = [line.name for line in gateway.plant.lines] if poller else []
    found = (poller.bus(line).audit_trouble for line in lines if poller)
    return next((f"the newest write is not noted: {why}" for why in found if why), "")


def troubles_of(gateway: Gateway) -> list[str]:
    """Return a sentence for each thing beside the lines that is not well, for the page."""
    said = {f"line {line}": why for line, why in failing_lines_of(gateway).items()}
    said |= supervisor().hung | supervisor().dead
    said |= {name: one for name, one in parts_of(gateway).items() if one != "ok"}
    audit = audit_trouble_of(gateway)
    return [f"{name}: {one}" for name, one in (said | ({"audit log": audit} if audit else {})).items()]


def _health_of_part(feed: object) -> str:
    try:
        return str(getattr(feed, "health", str)()) or "ok"
    except Exception as failure:  # it is not well then
        return f"{type(failure).__name__}: {failure}"


def figures_of(gateway: Gateway) -> Figures:
    """Return what the metrics say of the gateway itself."""
    parts: list[MetricFamily] = []
    for feed in gateway.feeds.values():
        said = getattr(feed, "figures", None)
        if said is not None:
            with contextlib.suppress(Exception):  # a part's failure hides its own figures alone
                parts += said()
    dropped = gateway.poller.dropped if gateway.poller else 0
    failures = {name: gateway.failures.get(name, 0) for name in ("hub", *gateway.feeds)} | gateway.failures
    return Figures(gateway.version, gateway.frames.viewers, gateway.frames.made, dropped, failures, parts)


def _drive_figures(statistics: Statistics | None) -> dict[str, Any] | None:
    if statistics is None:
        return None
    return {
        **_usual_delays(statistics),
        "asked": asked_of(statistics),
        "missed": sum(statistics.misses.values()),
    }
