"""The answers to requests of pages and of health probes, made on request."""

from __future__ import annotations

import contextlib
import time
from enum import Flag
from typing import TYPE_CHECKING, Any, cast

from multidrop import Drive, PlantLine, PolledDrive, Register
from multidrop.control import Ledger
from multidrop.drive import verbs_of
from multidrop.gateway.commands import drives_of
from multidrop.gateway.http.rights import Right
from multidrop.gateway.live.frames import lost_of
from multidrop.gateway.live.hub import FREQUENCIES, Hub, digits_of
from multidrop.gateway.live.recent_statistics import asked_of, misses_of
from multidrop.plant import drive_meant
from multidrop.printable import iso_time
from multidrop.supervisor import supervisor
from multidrop.transport import Statistics

if TYPE_CHECKING:
    from multidrop.gateway.gateway import Gateway

CURRENTS = ("output_current",)
LEDGER_S = 6.0  # time limit, in s, of reading the ledger of EEPROM writes, which waits up to 5 s for a lock


# ---- the description of a plant: lines, drives, registers and the caller's rights ----


def describe(gateway: Gateway, right: Right | None, language: str) -> dict[str, Any]:
    """Return the answer to GET /api/plant for a caller with this right.

    It has the registers' titles in this language.
    """
    is_writer = right is Right.WRITE
    may, fleet = gateway.settings.may, gateway.feeds.get("fleet")
    return {
        "revision": gateway.revision,
        "version": gateway.version,
        "name": gateway.hub.plant.path.name,
        "demo": gateway.settings.is_demo,
        "file": gateway.reload.has_file,  # True: the gateway can reload its plant file
        "history": "history" in {**gateway.feeds, **gateway.parts.pending},  # True: /api/history is available
        "fleet": fleet is not None,  # True: /api/fleet is available
        "fleet_stop": getattr(fleet, "can_stop", False),  # True: /api/fleet/stop is available
        # mistakes in the plant file that the latest reload found; empty if it succeeded
        "mistakes": gateway.reload.mistakes,
        "may": {
            "role": None if right is None else right.name.lower(),
            "write": sorted(may.write) if is_writer else [],
            "verbs": sorted(may.verbs) if is_writer else [],
        },
        "lines": [describe_line(gateway.hub, line, language) for line in gateway.hub.plant.lines],
    }


def describe_line(hub: Hub, line: PlantLine, language: str) -> dict[str, Any]:
    speeds = dict.fromkeys(str(polled.drive.settings) for polled in line.drives)
    return {
        "name": line.name,
        "port": line.port,
        "speed": ", ".join(speeds),
        "drives": [_drive(hub, polled, language) for polled in line.drives],
    }


def _drive(hub: Hub, polled: PolledDrive, language: str) -> dict[str, Any]:
    drive = polled.drive
    periods = {poll.register.name: poll.every or 0.0 for poll in polled.series}
    return {
        "name": drive.name,
        "family": drive.model or type(drive).__name__,
        "title": drive.title,
        "address": drive.address,
        "speed": str(drive.settings),
        "key": _key_registers(drive, periods),
        "registers": [
            _register(register, language)
            | {"period_s": periods.get(register.name), "holds_s": hub.holds_s(drive.name, register.name)}
            for register in (*drive.registers.values(), *(one.register for one in polled.channels))
        ],
        "verbs": verbs_of(drive),
    }


def _key_registers(drive: Drive, periods: dict[str, float]) -> dict[str, str | None]:
    """Return the names of a drive's registers for frequency, electric current and setpoint, by purpose.

    If several registers fit, a polled one is preferred. The name is None if no register fits.
    """
    wanted = {"frequency": FREQUENCIES, "current": CURRENTS, "setpoint": (drive.setpoint_name,)}
    found: dict[str, str | None] = {}
    for name, registers in wanted.items():
        there = [one for one in registers if one in drive.registers]
        found[name] = next((one for one in there if one in periods), next(iter(there), None))
    return found


def _register(register: Register[Any], language: str) -> dict[str, Any]:
    values = register.values
    least, most = _span(register)
    kind = "number" if values is None else "bits" if issubclass(values, Flag) else "words"
    members: list[Any] = [] if values is None else list(cast(Any, values))
    words = {str(int(member)): register.in_words(member) for member in members}
    return {
        "name": register.name,
        "title": register.title_in(language),
        "unit": register.value_unit,
        "digits": digits_of(register),
        "kind": kind,
        "words": words,
        "access": register.access.value,
        "place": register.place,
        "note": register.note,
        "least": least,
        "most": most,
        "at_least": register.at_least,  # name of the register that holds the least allowed value
        "at_most": register.at_most,
        "step": None if register.is_float else register.step,
    }


def _span(register: Register[Any]) -> tuple[float | None, float | None]:
    """Return the least and the largest value that may be written to a register.

    They are the manual's range, or else that of the number format. Both are None for a float without a range,
    for named values, and if the register cannot be written.
    """
    if register.span is not None:
        return register.span
    if register.values is not None or register.is_float or not register.writable:
        return None, None
    ends = (register.coding.value_of(float(raw)) for raw in register.coding.raw_span)
    least, most = sorted(ends)
    return least, most


# ---- one drive, all lines, and health ----


async def drive_view(gateway: Gateway, name: str) -> dict[str, Any]:
    """Return the details of one drive that the page shows. Raises ValueError for an unknown drive."""
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

    with contextlib.suppress(OSError):  # Hung, raised if the disk hangs, is an OSError too
        return await supervisor().within("ledger", LEDGER_S, wear)
    return []


def line_views(gateway: Gateway) -> dict[str, Any]:
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
    """Return the gateway's health as "ok", "degraded" or "failed", with details by line and part.

    "failed" means that no values were polled yet, or that a task or thread that must run forever has ended.
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
    """Return the health of each part of the gateway: "ok", or a sentence about its problem."""
    parts, dead, kept = gateway.parts, supervisor().dead, gateway.alarm_file
    return (
        {name: _health_of_part(feed) for name, feed in parts.feeds.items()}
        | dict.fromkeys(parts.pending, "it is not ready: the disk with its files does not answer")
        | parts.dead
        | {name: why for name, why in dead.items() if name in parts.feeds}
        | ({"alarms": kept.trouble} if kept is not None and kept.trouble else {})
    )


def failing_lines_of(gateway: Gateway) -> dict[str, str]:
    """Return why polling fails, by line. For example, a user's drive class may raise an exception."""
    failures = {} if gateway.poller is None else gateway.poller.line_failures
    return {line: f"polling fails: {why}" for line, why in failures.items()}


def audit_trouble_of(gateway: Gateway) -> str:
    """Return why the newest write on a line is missing in the audit log; "" if no line has this problem."""
    if gateway.unaudited:
        return gateway.unaudited
    buses = gateway.poller.buses if gateway.poller else {}
    found = (bus.audit_trouble for bus in buses.values())
    return next((f"the newest write is missing in the audit log: {why}" for why in found if why), "")


def troubles_of(gateway: Gateway) -> list[str]:
    """Return a sentence for the page about each problem of the gateway. A lost port is an alarm instead."""
    troubles = {f"line {line}": why for line, why in failing_lines_of(gateway).items()}
    troubles |= supervisor().hung | supervisor().dead
    troubles |= {name: one for name, one in parts_of(gateway).items() if one != "ok"}
    audit = audit_trouble_of(gateway)
    return [f"{name}: {one}" for name, one in (troubles | ({"audit log": audit} if audit else {})).items()]


def _health_of_part(feed: object) -> str:
    try:
        return str(getattr(feed, "health", str)()) or "ok"
    except Exception as failure:  # the part's method `health` itself has failed
        return f"{type(failure).__name__}: {failure}"


def _drive_figures(statistics: Statistics | None) -> dict[str, Any] | None:
    if statistics is None:
        return None
    return {
        **_usual_delays(statistics),
        "asked": asked_of(statistics),
        "missed": sum(statistics.misses.values()),
    }
