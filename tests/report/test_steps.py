"""The figures of a test run's steps, compared with pandas and with a known response."""

from __future__ import annotations

import math
import random
from pathlib import Path
from typing import Any

import pytest
from batches import SECOND, UTC_0

from multidrop.polling.batch import Row
from multidrop.recording import open_recording, open_writer
from multidrop.recording.phases import phase_row, with_phases
from multidrop.recording.rows import from_rows

EDGES = (2.0, 7.5, 19.0)  # start of each step in s; the last step is the stop
REGISTERS = {
    "output_frequency": {"unit": "Hz", "step": 0.01},
    "output_power": {"unit": "kW", "step": 0.1},
    "fault": {"unit": "", "step": 1, "values": {"NONE": 0}},
}


def recorded_run(path: Path) -> None:
    """Record 25 s of three registers at irregular times; one value in twenty is missed."""
    chance = random.Random(5)
    rows, seconds = [], 0.0
    while seconds < 25:
        seconds += chance.uniform(0.05, 0.15)
        at = round(seconds * SECOND)
        level = sum(10 * (1 - math.exp(-(seconds - edge) / 0.4)) for edge in EDGES[:2] if seconds > edge)
        for name, value in (("output_frequency", level), ("output_power", level**2 / 100), ("fault", 0.0)):
            is_missed = chance.random() < 0.05
            sample = (None, None, "no reply") if is_missed else (0, value + chance.gauss(0, 0.002), "ok")
            rows.append(Row(UTC_0 + at, at, sample[0], "pump", name, sample[1], sample[2]))
    about: dict[str, Any] = {"drives": {"pump": {"registers": REGISTERS}}}
    with open_writer(path, with_phases(about, ["one", "two", "stop"])) as writer:
        for number, edge in enumerate(EDGES):
            at = round(edge * SECOND)
            writer.write(phase_row(number, UTC_0 + at, at))
        writer.write(from_rows(rows))


def by_pandas(table: Any, edge: float, step: float) -> tuple[Any, ...]:
    """Return the fields of `StepValues` after `unit`, computed with pandas from one register's rows."""
    inside = table[(table.s >= 0) & (table.s < table.length)]
    known = inside.dropna(subset="value").set_index("s").value
    before = table[table.s < 0].value.dropna()
    last = known[known.index >= known.index[-1] * 0.8].mean()
    band = max(0.02 * abs(last - before.iloc[-1]), step)
    outside = known[(known - last).abs() > band]
    later = known[known.index > outside.index[-1]] if len(outside) else known
    settling = (later.index[0] if len(outside) else 0.0) if len(later) else None
    frame = known.reset_index()
    slope = frame.s.cov(frame.value) / frame.s.var()
    mean_power = inside.value.rolling(2).mean()  # NaN beside a miss
    energy = (mean_power * inside.s.diff()).sum() / 3600
    return known.count(), known.mean(), known.min(), known.max(), settling, slope, energy


def test_figures_of_a_step_equal_those_computed_with_pandas(tmp_path: Path) -> None:
    pytest.importorskip("pandas")
    report = pytest.importorskip("multidrop.report")
    from multidrop.report.html import values_of

    path = tmp_path / "run.arrows"
    recorded_run(path)
    recording = report.load(path)
    assert [step.what for step in recording.steps] == ["one", "two", "stop"]
    table = open_recording(path).to_pandas()
    for step in recording.steps:
        found = values_of(recording, step)
        assert [values.register for values in found] == ["output_frequency", "output_power"]
        for values in found:
            rows = table[(table.drive == "pump") & (table.register == values.register)].copy()
            rows["s"] = (rows.time.astype("int64") - step.begin) / 1e9
            rows["length"] = (step.end - step.begin) / 1e9
            expected = by_pandas(rows, 0.0, REGISTERS[values.register]["step"])
            *numbers, energy = values[3:]
            assert numbers == pytest.approx(expected[:-1], rel=1e-9, abs=1e-12)
            assert energy == (pytest.approx(expected[-1], rel=1e-9) if values.unit == "kW" else None)
    (first, _) = values_of(recording, recording.steps[0])
    assert first.settling == pytest.approx(0.4 * math.log(50), abs=0.3)  # time constant 0.4 s


@pytest.mark.slow
def test_plot_marks_the_start_of_each_step(tmp_path: Path) -> None:
    report = pytest.importorskip("multidrop.report")
    from multidrop.report.style import day

    recorded_run(tmp_path / "run.arrows")
    figure = report.load(tmp_path / "run.arrows").plot(registers=["output_frequency", "output_power"])
    for axes in figure.axes:
        dashed = [line.get_xdata()[0] for line in axes.lines if line.get_linestyle() == "--"]
        assert dashed == [day(UTC_0 + round(edge * SECOND)) for edge in EDGES]
    assert [text.get_text() for text in figure.axes[-1].texts] == ["one", "two", "stop"]
    assert figure._repr_png_().startswith(b"\x89PNG")


@pytest.mark.long
def test_the_report_has_a_table_for_each_step(tmp_path: Path) -> None:
    report = pytest.importorskip("multidrop.report")
    path = tmp_path / "run.arrows"
    recorded_run(path)
    page = report.report_page(report.load(path))
    heads = [f"<h3>{number}. {name}, from" for number, name in enumerate(("one", "two", "stop"), 1)]
    assert all(head in page for head in heads)
    assert "<td>test</td>" not in page
