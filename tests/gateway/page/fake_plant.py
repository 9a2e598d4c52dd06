"""A fake plant of three lines with changing values, as JSON answers of the gateway."""

from __future__ import annotations

import math
import time
from typing import Any

from multidrop.printable import iso_time

# Names by line: one drive in each state. Few, because Chromium draws each drive several times a second.
NAMES = ("pump-1 pump-2 pump-3 pump-4 conveyor-2", "filler-1 filler-2 labeller", "booster-1 tower-fan-2")
MANY_NAMES = (
    "pump-1 pump-2 pump-3 pump-4 fan-north fan-south mixer-1 mixer-2 conveyor-1 conveyor-2 screw",
    "filler-1 filler-2 filler-3 capper-1 capper-2 labeller infeed outfeed accumulator rinser",
    "tower-fan-1 tower-fan-2 tower-fan-3 chilled-1 chilled-2 booster-1 booster-2 exhaust-1 exhaust-2 "
    "compressor",
)
FAMILIES = ("innovert-ibd", "invt-che", "yd1000", "delixi-modbus", "erman-er-g-220")
STANDING = {"pump-4", "mixer-2", "screw", "capper-2", "chilled-2", "exhaust-2"}
FAULTS = {"conveyor-2": ("overcurrent in acceleration", 240), "booster-1": ("undervoltage", 5220)}
SILENT = {"labeller": 42}
KINDS = ("fault", "stopped", "port", "silent")  # kinds of alarms, most serious first
SPEEDS = ("38400 8N1", "9600 8N1", "38400 8N1")

UNPOLLED: dict[str, Any] = {"period_s": None, "holds_s": None}


def register(name: str, unit: str, digits: int, place: str, **more: Any) -> dict[str, Any]:
    return {
        "name": name, "unit": unit, "digits": digits, "kind": "number", "words": {}, "access": "reading",
        "place": place, "period_s": 0.1, "holds_s": 1.0, "least": None, "most": None, "step": 10.0**-digits,
        "at_least": "", "at_most": "",
        **more,
    }  # fmt: skip


REGISTERS = [
    register("output_frequency", "Hz", 2, "section 7.2, 1000H"),
    register(
        "frequency_setpoint",
        "Hz",
        1,
        "section 7.1, 2001H",
        access="setting",
        least=0,
        most=50,
        at_most="maximum_frequency",
    ),
    register("output_current", "A", 1, "section 7.2, 1001H"),
    register("dc_bus_voltage", "V", 0, "section 7.2, 1002H"),
    register("output_torque", "%", 1, "section 7.2, 1005H"),
    register("output_power", "kW", 1, "section 7.2, 1006H"),
    register("heatsink_temperature", "°C", 0, "section 7.2, 1007H", period_s=1.0, holds_s=3.0),
    register("run_state", "", 0, "table 9-2, 3000H", kind="words", words={"1": "runs", "3": "standby"}),
    register("status_bits", "", 0, "table 9-3, 3001H", kind="bits", words={"1": "ready", "4": "at_setpoint"}),
    register(
        "acceleration_time",
        "s",
        1,
        "P0.11",
        access="setting",
        least=0,
        most=3600,
        period_s=None,
        holds_s=None,
    ),
    register("run_hours", "h", 0, "P7.11", **UNPOLLED),
    register("maximum_frequency", "Hz", 1, "P0.03", **UNPOLLED),
]
KEY = {"frequency": "output_frequency", "current": "output_current", "setpoint": "frequency_setpoint"}


def plant(renamed: dict[str, str]) -> dict[str, Any]:
    """Return the answer to `GET /api/plant`; `renamed` has new names for drives."""
    lines = [
        {
            "name": f"hall-{n + 1}", "port": f"/dev/ttyUSB{n}", "speed": SPEEDS[n],
            "drives": [
                {
                    "name": renamed.get(name, name), "family": FAMILIES[(2 * n + (i > 5)) % 5],
                    "address": i + 1, "speed": SPEEDS[n], "key": KEY, "registers": REGISTERS,
                    "verbs": ["start", "stop", "reset_fault", "set_frequency", "emergency_stop"],
                }
                for i, name in enumerate(names.split())
            ],
        }
        for n, names in enumerate(NAMES)
    ]  # fmt: skip
    return {
        "revision": 1, "version": "0.2", "name": "bottling plant.toml", "demo": False, "lines": lines,
        "file": True, "mistakes": [], "fleet": True,
        "may": {
            "role": "write",
            "write": ["pump-1.frequency_setpoint"],
            "verbs": [f"pump-1.{v}" for v in ("start", "reset_fault", "set_frequency", "emergency_stop")],
        },
    }  # fmt: skip


def state(name: str) -> str:
    if name in FAULTS:
        return "fault"
    if name in SILENT:
        return "silent"
    return "stands" if name in STANDING else "runs"


def values(name: str, number: int, now: float) -> dict[str, float]:
    """Return the values of a drive's registers at the time `now` (s)."""
    runs = state(name) == "runs"
    set_to = 20 + number * 7 % 28
    swing = math.sin(now / 9 + number * 1.7)
    load = (0.55 + 0.25 * math.sin(now / 23 + number * 3)) if runs else 0
    frequency = set_to + 0.35 * swing if runs else 0
    return {
        "output_frequency": round(frequency, 2),
        "frequency_setpoint": set_to if state(name) != "fault" else 0,
        "output_current": round(load * 22 + 2 * runs, 1),
        "dc_bus_voltage": round(538 + 4 * math.sin(now / 31 + number)),
        "output_torque": round(load * 92, 1),
        "output_power": round(frequency * load * 0.21, 1),
        "heatsink_temperature": round(33 + 16 * load + number % 6),
        "run_state": 1 if runs else 3,
        "status_bits": 5 if runs else 1,
        "acceleration_time": 20,
        "run_hours": 4012 + 37 * number,
        "maximum_frequency": 50,
    }


def alarms(renamed: dict[str, str], now: float) -> list[dict[str, Any]]:
    """Return the active alarms, and two alarms that have ended; newest first."""
    since = {**{name: (text, age, "fault") for name, (text, age) in FAULTS.items()}}
    since |= {name: ("no reply", age, "silent") for name, age in SILENT.items()}
    lasting = [
        alarm(ms(now - age), renamed.get(name, name), text, None, kind)
        for name, (text, age, kind) in since.items()
    ]
    ended = [
        ("pump-1", "overheating of the heatsink", "fault", 1900, 400),
        ("filler-2", "no reply", "silent", 2900, 90),
    ]
    past = [
        alarm(ms(now - ago), renamed.get(name, name), text, ms(now - ago + lasted), kind)
        for name, text, kind, ago, lasted in ended
    ]
    return sorted(lasting, key=lambda one: KINDS.index(one["kind"])) + past


def alarm(
    time_ms: int, drive: str, text: str, ended: int | None, kind: str, line: str = "", **more: Any
) -> dict[str, Any]:
    return {
        "id": f"{time_ms} {kind} {drive or line}", "time": time_ms, "drive": drive, "text": text,
        "ended": ended, "kind": kind, "line": line, "is_before": False, "acknowledged": None, "by": "",
        "note": "", **more,
    }  # fmt: skip


def ms(seconds: float) -> int:
    return int(seconds * 1000)


def frame(n: int, began: float, renamed: dict[str, str], stuck: dict[str, float]) -> dict[str, Any]:
    """Return a message to the page. `stuck`: drives that are not polled, and their last poll (s)."""
    now = time.time()
    drives = {}
    for number, name in enumerate(" ".join(NAMES).split()):
        at = stuck.get(name, now)
        held = values(name, number, at)
        polled = [r["name"] for r in REGISTERS if r["period_s"]]
        if name in SILENT:
            seen = began - SILENT[name]
            old = values(name, number, seen)
            rows = {r: [None, 0, "no reply", old[r], 1] for r in polled}
            ages = [0, ms(now) - ms(seen)]
        else:
            seen = at
            holds = {r["name"]: r["holds_s"] for r in REGISTERS}
            rows = {
                r: [held[r], 0] if now - at <= holds[r] else [None, 1, "overdue", held[r], 0] for r in polled
            }
            ages = [ms(now) - ms(at), 0]
        drives[renamed.get(name, name)] = {
            "state": state(name), "fault": FAULTS[name][0] if name in FAULTS else None, "seen": len(ages) - 1,
            "ages_ms": ages, "values": rows, "why": "no reply" if name in SILENT else None,
            "note": "",
            "missed": {"labeller": 1.0, "tower-fan-2": 0.031}.get(name, 0), "p99": 6.1,
        }  # fmt: skip
    return {
        "n": n, "revision": 1, "time": iso_time(int(now * 1e3)), "drives": drives, "lines": lines(),
        "alarms": alarms(renamed, began), "troubles": [],
    }  # fmt: skip


def lines() -> dict[str, Any]:
    used, planned, misses = (0.72, 0.94, 0.61), (0.71, 0.93, 0.62), (0, 14, 0)
    rate, p99 = (101.3, 24.8, 92.4), (6.1, 11.9, 5.4)
    return {
        f"hall-{n + 1}": {
            "used": used[n], "planned": planned[n], "misses": misses[n], "lost": None, "rate": rate[n],
            "p99": p99[n],
        }
        for n in range(3)
    }  # fmt: skip


def fleet(began: float) -> dict[str, Any]:
    """Return the answer to `GET /api/fleet`: twelve lines and three gateways. One gateway has just died."""
    at = int(began * 1000)
    spool = {"bytes": 81_234_567, "lost": 0, "behind": 2, "lag_s": 1.4, "trouble": None}
    says = {"state": "working", "margin_s": 2.14, "troubles": {}, "trouble": "", "spool": spool}
    gateways = {
        f"gw-{n}": {
            "host": f"pc-hall-{n}", "session": 4 + n, "began_ms": at - 86_400_000 * n, "draining": False,
            "lines": 4, "unseen_s": 0.3, "says": None if n == 2 else says,
        }
        for n in (1, 2, 3)
    }  # fmt: skip
    lines = {
        f"hall-{n}": {
            "port": f"socket://10.0.0.{n}:4001", "revision": n, "session": 5,
            "master": f"gw-{n % 3 + 1}" if n > 1 else None,
            "since_ms": at - 10_000_000 * n if n > 1 else None,
        }
        for n in sorted(range(1, 13), key=str)  # the gateway sorts lines as text
    }  # fmt: skip
    moves = [
        {"line": f"hall-{n}", "revision": n, "at_ms": at - 10_000_000 * n, "from": before, "to": "gw-1"}
        for n, before in ((3, "gw-2"), (6, ""), (9, None))
    ]
    return {"at_ms": at, "age_s": 0.2, "trouble": None, "gateways": gateways, "lines": lines, "moves": moves}
