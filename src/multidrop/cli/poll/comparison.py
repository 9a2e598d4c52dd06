"""What was predicted of a polled line, beside what became of it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from multidrop.cli.plan import shortened
from multidrop.cli.support.values import aligned
from multidrop.planning.prediction import Prediction, predict
from multidrop.plant.metadata import planned_on
from multidrop.plant.model import PlantLine

Figures = dict[str, Any]


def compared(line: PlantLine, summary: dict[str, Any]) -> dict[str, Figures]:
    """Predictions, with the documents' response delays and with what was measured, and the summary."""
    told = summary["drives"]
    known = {
        polled.drive: told[polled.drive.name]["response_delay_ms"] / 1e3
        for polled in line.drives
        if told[polled.drive.name]["exchanges_per_second"]  # only those that answer have one
    }
    polls = [poll for polled in line.drives for poll in polled.polls]
    asked_for = any(poll.every is not None for poll in polls)  # then no cycle follows the other
    cycles = (summary["samples"] + sum(summary["misses"].values())) / len(polls)
    by_delays = predict(planned_on(line, known), known, summary["switching_ms"] / 1e3)
    return {
        "predicted": _figures(predict(planned_on(line), switching=line.switching)),
        "predicted_with_measured_delays": _figures(by_delays),
        "measured": {
            "cycle_ms": None if asked_for or not cycles else round(summary["seconds"] / cycles * 1e3, 3),
            "utilisation": summary["utilisation"],
            "switching_ms": summary["switching_ms"],
            "exchanges_per_second": {
                name: told["exchanges_per_second"] for name, told in summary["drives"].items()
            },
        },
    }


def _figures(prediction: Prediction) -> Figures:
    drives = dict.fromkeys(rate.drive for rate in prediction.rates)
    return {
        "cycle_ms": round(prediction.cycle * 1e3, 3),
        "switches": prediction.switches,
        "utilisation": round(prediction.utilisation, 4),
        "exchanges_per_second": {
            drive.name: round(prediction.exchanges_per_second(drive), 2) for drive in drives
        },
    }


def comparison_text(found: dict[str, Figures]) -> Iterator[str]:
    """The same as a table."""
    columns = list(found.values())
    cycles = ("-" if it["cycle_ms"] is None else f"{it['cycle_ms']:.1f} ms" for it in columns)
    rows = [
        ("", "PREDICTED", "BY DELAYS", "MEASURED"),
        ("bus cycle", *cycles),
        ("utilisation", *(f"{it['utilisation']:.1%}" for it in columns)),
    ]
    for name in found["measured"]["exchanges_per_second"]:
        rates = (f"{it['exchanges_per_second'][name]:.1f}" for it in columns)
        rows.append((f"{shortened(name)}, exchanges/s", *rates))
    yield from (f"  {row}" for row in aligned(rows, "<>>>"))
    yield "  by delays: predicted with the response delays that were measured"
    if found["predicted"]["switches"]:
        took = found["measured"]["switching_ms"]
        yield f"  and with the {took:.2f} ms that the port needed to change its settings"
