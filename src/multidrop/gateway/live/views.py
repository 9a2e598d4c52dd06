"""Views of a gateway for pages and health probes, made on request: one drive, all lines, and health."""

from __future__ import annotations

import contextlib
import time
from typing import TYPE_CHECKING, Any

from multidrop import Drive
from multidrop.control import Ledger
from multidrop.gateway.clock import iso_time
from multidrop.gateway.commands import drives_of
from multidrop.gateway.live.frames import lost_of
from multidrop.gateway.live.recent_statistics import asked_of, misses_of
from multidrop.plant import drive_meant
from multidrop.supervisor import supervisor
from multidrop.transport import Statistics

if TYPE_CHECKING:
    from multidrop.gateway.gateway import Gateway

LEDGER_S = 6.0  # time limit for the EEPROM ledger, which waits 5 s for a lock


async def drive_view(gateway: Gateway, name: str) -> dict[str, Any]:
    """Return the details of one drive. Raises ValueError for an unknown drive."""
    name = drive_meant(name, drives_of(gateway.plant))
    line, drive = gateway.plant.find_drive(name)
    bus = gateway.poller.buses.get(line.name) if gateway.poller else None
    port = bus.line.identity if bus else line.port
    wear = await _wear_within(gateway.ledger, port, drive)
    statistics = gateway.recent.drive(line.name, name)
    return {
        "drive": name,
        "delays": _delays(statistics),
        "misses": misses_of(statistics) if statistics else {},
        "asked": asked_of(statistics) if statistics else 0,
        "timeout_ms": round(statistics.timeout * 1e3, 1) if statistics else None,
        "values": gateway.side_reads.look(gateway.plant, name),
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
    """Return the median and the 99th percentile of the response delays in ms; None without replies."""
    delays = statistics.delays
    quantiles = {"p50": delays.p50, "p99": delays.p99}
    return {name: round(s * 1e3, 3) if delays.replies else None for name, s in quantiles.items()}


async def _wear_within(ledger: Ledger, port: str, drive: Drive) -> list[dict[str, Any]]:
    """Return this year's writes to each cell of a drive's EEPROM, and the yearly budget.

    The list is empty if the ledger's file is locked or its disk hangs.
    """

    def wear() -> list[dict[str, Any]]:
        book = ledger.at(port)
        found = book.wear_of(port, drive.address, drive.ledger_name, time.time())
        return [
            {"register": one.cell.register, "year": one.this_year, "budget": book.budget, "total": one.writes}
            for one in found
        ]

    with contextlib.suppress(OSError):  # Hung is an OSError
        return await supervisor().within("ledger", LEDGER_S, wear)
    return []


def line_views(gateway: Gateway) -> dict[str, Any]:
    """Return the details of all lines."""
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
    """Return the health as "ok", "degraded" or "failed", with details by line and part.

    "failed" means that no rows have arrived yet, or that a permanent task or thread has ended.
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
        "newest_row": iso_time(gateway.hub.time // 1_000_000) if gateway.hub.time else None,
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
    """Return the health of each part: "ok", or its problem."""
    parts, dead, kept = gateway.parts, supervisor().dead, gateway.alarm_file
    return (
        {name: _health_of_part(feed) for name, feed in parts.feeds.items()}
        | dict.fromkeys(parts.pending, "it is not ready: its files do not answer")
        | parts.dead
        | {name: why for name, why in dead.items() if name in parts.feeds}
        | ({"alarms": kept.trouble} if kept is not None and kept.trouble else {})
    )


def failing_lines_of(gateway: Gateway) -> dict[str, str]:
    """Return the reason for each line whose polling raises an exception, as a user's class may do."""
    failures = {} if gateway.poller is None else gateway.poller.line_failures
    return {line: f"polling fails: {why}" for line, why in failures.items()}


def audit_trouble_of(gateway: Gateway) -> str:
    """Return why a line's newest write is missing in the audit log; "" if the newest writes of all lines are
    there.
    """
    if gateway.unaudited:
        return gateway.unaudited
    buses = gateway.poller.buses if gateway.poller else {}
    found = (bus.audit_trouble for bus in buses.values())
    return next((f"the newest write is not noted: {why}" for why in found if why), "")


def troubles_of(gateway: Gateway) -> list[str]:
    """Return a sentence for the page about each problem other than a lost line."""
    said = {f"line {line}": why for line, why in failing_lines_of(gateway).items()}
    said |= supervisor().hung | supervisor().dead
    said |= {name: one for name, one in parts_of(gateway).items() if one != "ok"}
    audit = audit_trouble_of(gateway)
    return [f"{name}: {one}" for name, one in (said | ({"audit log": audit} if audit else {})).items()]


def _health_of_part(feed: object) -> str:
    try:
        return str(getattr(feed, "health", str)()) or "ok"
    except Exception as failure:  # report the exception as a problem of the part
        return f"{type(failure).__name__}: {failure}"


def _drive_figures(statistics: Statistics | None) -> dict[str, Any] | None:
    if statistics is None:
        return None
    return {
        **_usual_delays(statistics),
        "asked": asked_of(statistics),
        "missed": sum(statistics.misses.values()),
    }
