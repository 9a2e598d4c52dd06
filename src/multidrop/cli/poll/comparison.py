"""The prediction for a polled line beside what was measured."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from multidrop.cli.support.values import aligned, shortened
from multidrop.planning.prediction import Prediction, predict
from multidrop.plant.metadata import planned_on
from multidrop.plant.model import PlantLine

Figures = dict[str, Any]


def compare(line: PlantLine, summary: dict[str, Any]) -> dict[str, Figures]:
    """Predict a line with the documents' delays and with the measured ones, beside its summary."""
    drives = summary["drives"]
    delays = {
        polled.drive: drives[polled.drive.name]["response_delay_ms"] / 1e3
        for polled in line.drives
        if drives[polled.drive.name]["exchanges_per_second"]  # a silent drive has no delay
    }
    polls = [poll for polled in line.drives for poll in polled.polls]
    is_timed = any(poll.every is not None for poll in polls)  # cycles then do not follow each other
    cycles = (summary["samples"] + sum(summary["misses"].values())) / len(polls)
    by_delays = predict(planned_on(line, delays), delays, summary["switching_ms"] / 1e3)
    return {
        "predicted": _figures(predict(planned_on(line), switching=line.switching)),
        "predicted_with_measured_delays": _figures(by_delays),
        "measured": {
            "cycle_ms": None if is_timed or not cycles else round(summary["seconds"] / cycles * 1e3, 3),
            "utilisation": summary["utilisation"],
            "switching_ms": summary["switching_ms"],
            "exchanges_per_second": {name: drive["exchanges_per_second"] for name, drive in drives.items()},
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
    """Format the comparison as a table."""
    columns = list(found.values())
    cycles = ("-" if column["cycle_ms"] is None else f"{column['cycle_ms']:.1f} ms" for column in columns)
    rows = [
        ("", "PREDICTED", "BY DELAYS", "MEASURED"),
        ("bus cycle", *cycles),
        ("utilisation", *(f"{column['utilisation']:.1%}" for column in columns)),
    ]
    for name in found["measured"]["exchanges_per_second"]:
        rates = (f"{column['exchanges_per_second'][name]:.1f}" for column in columns)
        rows.append((f"{shortened(name)}, exchanges/s", *rates))
    yield from (f"  {row}" for row in aligned(rows, "<>>>"))
    yield "  by delays: predicted with the response delays that were measured"
    if found["predicted"]["switches"]:
        took = found["measured"]["switching_ms"]
        yield f"  and with the {took:.2f} ms that the port needed to change its settings"
