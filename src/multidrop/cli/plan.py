"""`multidrop plan`: predicts the polling rates of a plant's lines, and suggests changes if they do not fit.

No port is opened.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from multidrop.cli.support.arguments import add_json_argument, add_plant_argument
from multidrop.cli.support.output import print_json, print_text
from multidrop.cli.support.values import Row, aligned, counted, shortened, wrapped
from multidrop.families.registry import is_users_own
from multidrop.planning.prediction import (
    Prediction,
    Rate,
    Suggestions,
    duration_text,
    predict,
    reading_gain,
    suggest,
)
from multidrop.plant.loader import load_plant
from multidrop.plant.model import PlantLine, planned_on

LONG_CYCLE = 1.0  # s; warn of a longer bus cycle of all readings, because the user probably does not want it
_NAMES = 3  # limit of registers named in a sentence


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_plant_argument(parser)
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    plans = [_plan(line) for line in load_plant(arguments.plant).lines]
    if arguments.json:
        print_json({"lines": {plan.line.name: _as_json(plan) for plan in plans}})
    else:
        print_text("\n\n".join("\n".join(_text(plan)) for plan in plans))
    return 0 if all(plan.prediction.fits for plan in plans) else 1


@dataclass(frozen=True)
class _PredictedLine:
    line: PlantLine
    prediction: Prediction
    suggestions: Suggestions | None  # None if the line can reach all rates
    misfits: list[str]  # a sentence for each polling rate that cannot be reached
    warnings: list[str]


def _plan(line: PlantLine) -> _PredictedLine:
    wanted = planned_on(line)
    prediction = predict(wanted, switching=line.switching)
    suggestions = None if prediction.fits else suggest(wanted, prediction, line.switching)
    misfits = [_misfit(rate, rate.every) for rate in prediction.rates if rate.every and not rate.fits]
    warnings = [*_long_cycle(line, prediction)]
    for polled in line.drives:
        gain = reading_gain(polled.drive, polled.wanted) if is_users_own(type(polled.drive)) else None
        if gain:
            warnings.append(f"{polled.drive.name}: {gain}")
    return _PredictedLine(line, prediction, suggestions, misfits, warnings)


def _misfit(rate: Rate, every: float) -> str:
    names = [register.name for register in rate.registers]
    shown = ", ".join(names[:_NAMES]) + (f" and {len(names) - _NAMES} more" if len(names) > _NAMES else "")
    verb = "does" if len(names) == 1 else "do"
    reached = f"{_number(rate.reached)} of {_number(1 / every)} times per second"
    return f"{rate.drive.name}: {shown} {verb} not fit: {reached}"


def _long_cycle(line: PlantLine, prediction: Prediction) -> Iterator[str]:
    """Yield a warning if all readings of a drive are polled and a bus cycle exceeds LONG_CYCLE."""
    whole = [
        polled.drive
        for polled in line.drives
        if tuple(poll.register for poll in polled.polls) == polled.drive.readings()
    ]
    if prediction.cycle > LONG_CYCLE and whole:
        costs = ", ".join(
            f"{drive.name} ({counted(prediction.requests(drive), 'request')} for {len(drive.readings())})"
            for drive in whole
        )
        yield (
            f"a bus cycle takes longer than {duration_text(LONG_CYCLE)}; all readings are polled of {costs}: "
            'name the registers you need, such as poll = ["output_current"]'
        )


# ---- as text ----


def _text(plan: _PredictedLine) -> Iterator[str]:
    prediction = plan.prediction
    yield from wrapped(
        f"{plan.line.name}: utilisation {prediction.utilisation:.1%}, "
        f"bus cycle {prediction.cycle * 1e3:.1f} ms at the fastest"
    )
    if prediction.switches:
        yield from _indented(_switching(plan))
    rows: list[Row] = [("DRIVE", "REQUESTS", "REGISTERS", "EVERY", "ASKED", "REACHED")]
    rows += [_row(rate) for rate in prediction.rates]
    yield from (f"  {row}" for row in aligned(rows, "<>>>>>"))
    for sentence in plan.misfits:
        yield from _indented(f"! {sentence}")
    if plan.suggestions:
        yield from _indented(f"! {plan.suggestions}")
    for sentence in plan.warnings:
        yield from _indented(f"? {sentence}")


def _switching(plan: _PredictedLine) -> str:
    times = f"the line changes its settings {plan.prediction.switches} times in a bus cycle"
    if plan.line.switching:
        return f"{times}, {duration_text(plan.line.switching)} each"
    return f'{times}; `multidrop poll` measures how long that takes: add it, such as switching = "2 ms"'


def _row(rate: Rate) -> Row:
    every, asked = (
        ("-", "-") if rate.every is None else (duration_text(rate.every), f"{_number(1 / rate.every)}/s")
    )
    counts = str(rate.requests), str(len(rate.registers))
    return shortened(rate.drive.name), *counts, every, asked, f"{_number(rate.reached)}/s"


def _number(rate: float) -> str:
    return f"{rate:.0f}" if rate >= 100 else f"{rate:.3g}"


def _indented(sentence: str) -> list[str]:
    return wrapped(sentence, "  ", "    ")


# ---- as JSON ----


def _as_json(plan: _PredictedLine) -> dict[str, Any]:
    prediction, found = plan.prediction, plan.suggestions
    drives: dict[str, list[dict[str, Any]]] = {polled.drive.name: [] for polled in plan.line.drives}
    for rate in prediction.rates:
        drives[rate.drive.name].append(
            {
                "registers": [register.name for register in rate.registers],
                "requests": rate.requests,
                "every_ms": None if rate.every is None else rate.every * 1e3,
                "asked_per_second": None if rate.every is None else round(1 / rate.every, 3),
                "reached_per_second": round(rate.reached, 3),
                "fits": rate.fits,
            }
        )
    remedies = found and {
        "every_ms": [{"asked": old * 1e3, "fits": new * 1e3} for old, new in found.every],
        "baudrate": found.baudrate and found.baudrate[0],
        "baudrate_for": [drive.name for drive in found.baudrate[1]] if found.baudrate else [],
        "registers": found.registers,
    }
    return {
        "fits": prediction.fits,
        "cycle_ms": round(prediction.cycle * 1e3, 3),
        "utilisation": round(prediction.utilisation, 4),
        "switches": prediction.switches,
        "switching_ms": plan.line.switching * 1e3,
        "drives": drives,
        "misfits": plan.misfits,
        "remedies": remedies,
        "warnings": plan.warnings,
    }
