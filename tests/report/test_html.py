"""Reports as HTML pages, and the figures of a test run's steps, compared with pandas."""

from __future__ import annotations

import base64
import math
import random
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from batches import METADATA, SECOND, UTC_0, example
from peers import require_installed
from recordings import ABOUT, record, row
from tables import usually

from multidrop.polling.batch import Row
from multidrop.recording import open_recording, open_writer
from multidrop.recording.rows import from_rows, phase_row, with_phases

require_installed("matplotlib")

PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(scope="module", autouse=True)
def _imported() -> None:
    """Import matplotlib only when these tests run. At collection, it would cost each worker 0.5 s."""
    global np, Recording, load, plot, plot_page, png, report_page
    global _about, _drives, values_of, delays, line_uses
    import numpy as np

    from multidrop.report import Recording, load, plot, plot_page, png, report_page
    from multidrop.report.health import delays, line_uses
    from multidrop.report.html import _about, _drives, values_of


@pytest.mark.slow
@pytest.mark.usefixtures("_unpainted")
def test_the_report_is_one_self_contained_page(look: Recording) -> None:
    page = report_page(look)
    assert page.startswith("<!DOCTYPE html>")
    images = re.findall(r'src="data:image/png;base64,([^"]+)"', page)
    assert len(images) == 4
    assert all(base64.b64decode(image).startswith(PNG) for image in images)
    assert "http" not in re.sub(r'src="data:[^"]+"', "", page)
    for text in ("OVERHEAT", "bad checksum", "no reply", "invt-che", "9600 8N1 rtu", "Response delays"):
        assert text in page
    # number of values, and the least response delay in ms
    assert re.search(r"<td[^>]*>pump</td><td[^>]*>1000</td><td[^>]*>10\.6</td>", page)


@pytest.mark.usefixtures("_unpainted")
def test_drive_names_with_html_markup_are_escaped_in_the_report(tmp_path: Path) -> None:
    rows = [row(at, "<script>&", "output_frequency", at) for at in range(3)]
    look = load(record(tmp_path / "<b>.arrows", rows))
    for page in (report_page(look), plot_page(look, plot(look)[0])):
        assert "<script>" not in page
        assert "<b>" not in page


@pytest.mark.slow
@pytest.mark.long
def test_drive_names_in_any_alphabet_are_drawn(tmp_path: Path) -> None:
    with open_writer(tmp_path / "it.arrows", METADATA) as writer:
        writer.write(example())
    loaded = load(tmp_path / "it.arrows")
    assert png(plot(loaded)[0]).startswith(PNG)
    assert "насос" in report_page(loaded)


@pytest.mark.long
def test_a_recording_without_values_has_a_report(tmp_path: Path) -> None:
    rows = [row(at, "pump", "output_frequency", None, "no reply") for at in range(3)]
    look = load(record(tmp_path / "it.arrows", rows))
    page = report_page(look)
    assert "No drive ever answered." in page
    assert "100.00%" in page


@pytest.mark.long
def test_a_recording_of_one_row_has_a_report(tmp_path: Path) -> None:
    look = load(record(tmp_path / "it.arrows", [row(1, "pump", "output_frequency", 50.0)], pieces=1))
    assert "Report on it.arrows" in report_page(look)


@pytest.mark.usefixtures("_unpainted")
@pytest.mark.parametrize(("value", "status"), [(0.0, "ok"), (None, "no reply")])
def test_the_report_states_that_there_was_no_fault(tmp_path: Path, value: float | None, status: str) -> None:
    rows = [row(at, "pump", "fault", value, status) for at in range(3)]
    look = load(record(tmp_path / "it.arrows", rows))
    assert look.series[0].faults() == []
    assert "<p>None was seen.</p>" in report_page(look)


@pytest.mark.slow
@pytest.mark.usefixtures("_unpainted")
def test_the_report_states_that_the_recording_has_no_plan(turns: list[Row], tmp_path: Path) -> None:
    assert "does not carry a plan" in report_page(load(record(tmp_path / "it.arrows", turns)))


@pytest.mark.usefixtures("_unpainted")
def test_the_length_of_a_long_recording_is_in_hours(tmp_path: Path) -> None:
    rows = [row(second, "pump", "output_frequency", 50.0) for second in (0, 7384)]
    assert "UTC, 2 h 03 min; 1 drive; 2 values" in report_page(load(record(tmp_path / "it.arrows", rows)))


def test_events_are_in_plots_and_reports(tmp_path: Path) -> None:
    rows = [row(at, "pump-1", "output_frequency", float(at)) for at in range(9)]
    comment = "bearing <b>changed</b>"
    rows.insert(5, row(4.5, "event", "comment", None, comment))
    about = {**ABOUT, "trigger": {"condition": "output_frequency > 3", "time_ns": UTC_0 + 4 * SECOND}}
    recording = load(record(tmp_path / "run.arrows", rows, about))
    assert [(event.kind, event.text) for event in recording.events] == [
        ("trigger", "output_frequency > 3"),
        ("comment", comment),
    ]
    assert recording.drives == ("pump-1",)
    figure, _ = plot(recording)
    texts = [text.get_text() for axes in figure.axes for text in axes.texts]
    assert {"output_frequency > 3", comment} <= set(texts)
    page = report_page(recording)
    assert '<td class="short">bearing &lt;b&gt;changed&lt;/b&gt;</td>' in page
    assert "1 miss" not in page


ODD: list[Any] = [10**400, None, True, -1, 1e308, "", "x", [], [1], {}, {"a": {}}, {"FORWARD": 10**400}]


def with_odd(about: Any, odd: Any) -> Iterator[Any]:
    """Yield copies of the metadata. In each copy, a different part is replaced by `odd`."""
    yield odd
    for key, part in about.items() if isinstance(about, dict) else enumerate(about) if about else ():
        if isinstance(part, dict | list):
            for changed in with_odd(part, odd):
                whole = about.copy()
                whole[key] = changed
                yield whole
        else:
            whole = about.copy()
            whole[key] = odd
            yield whole


@pytest.mark.long
@pytest.mark.usefixtures("_unpainted")
@pytest.mark.slow
@pytest.mark.parametrize("odd", usually(*ODD), ids=lambda odd: repr(odd)[:12])
def test_invalid_parts_of_metadata_are_left_out_of_a_report(
    planned: dict[str, Any], turns: list[Row], tmp_path: Path, odd: Any
) -> None:
    """All parts of the report are made from the rest of the metadata, which is valid."""
    about = {"plant": "hall.toml", "planned": planned, "drives": ABOUT["drives"]}
    rows = turns[:30]
    for number, metadata in enumerate(with_odd(about, odd)):
        if not isinstance(metadata, dict):
            continue  # a recording's metadata must be a dict
        look = load(record(tmp_path / f"{number}.arrows", rows, metadata, pieces=1))
        assert all(
            np.isfinite([each.utilisation, each.rate("pump"), each.cycle or 0]).all()
            for each in line_uses(look)
        )
        assert {delay.drive for delay in delays(look)} == {"pump", "fan"}
        assert len(_about(look) + "".join(_drives(look))) > 100
        if metadata.get("planned") is odd or metadata.get("drives") is odd:
            assert report_page(look)


EDGES = (2.0, 7.5, 19.0)  # start of each step in s; the last step is the stop
REGISTERS = {
    "output_frequency": {"unit": "Hz", "step": 0.01},
    "output_power": {"unit": "kW", "step": 0.1},
    "fault": {"unit": "", "step": 1, "values": {"NONE": 0}},
}


def recorded_run(path: Path, set_by_s: float = 0.0) -> None:
    """Record 25 s of three registers at irregular times; one value in twenty is missed.

    After 10 s, the clock is set by `set_by_s`.
    """

    def utc(at: int) -> int:
        return UTC_0 + at + (round(set_by_s * SECOND) if at >= 10 * SECOND else 0)

    chance = random.Random(5)
    rows, seconds = [], 0.0
    while seconds < 25:
        seconds += chance.uniform(0.05, 0.15)
        at = round(seconds * SECOND)
        level = sum(10 * (1 - math.exp(-(seconds - edge) / 0.4)) for edge in EDGES[:2] if seconds > edge)
        for name, value in (("output_frequency", level), ("output_power", level**2 / 100), ("fault", 0.0)):
            is_missed = chance.random() < 0.05
            sample = (None, None, "no reply") if is_missed else (0, value + chance.gauss(0, 0.002), "ok")
            rows.append(Row(utc(at), at, sample[0], "pump", name, sample[1], sample[2]))
    about: dict[str, Any] = {"drives": {"pump": {"registers": REGISTERS}}}
    with open_writer(path, with_phases(about, ["one", "two", "stop"])) as writer:
        for number, edge in enumerate(EDGES):
            at = round(edge * SECOND)
            writer.write(phase_row(number, utc(at), at))
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
    mean_power = inside.value.rolling(2).mean()  # mean power between two rows; NaN beside a missed value
    energy = (mean_power * inside.s.diff()).sum() / 3600
    return known.count(), known.mean(), known.min(), known.max(), settling, slope, energy


def test_the_statistics_of_a_test_step_equal_those_computed_with_pandas(tmp_path: Path) -> None:
    pytest.importorskip("pandas")
    path = tmp_path / "run.arrows"
    recorded_run(path)
    recording = load(path)
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
    # a first-order step with the time constant 0.4 s
    assert first.settling == pytest.approx(0.4 * math.log(50), abs=0.3)


@pytest.mark.parametrize("set_by_s", [-3600.0, -3.0, 3600.0])
def test_the_statistics_of_a_test_step_do_not_change_if_the_clock_is_set(
    tmp_path: Path, set_by_s: float
) -> None:
    recorded_run(tmp_path / "run.arrows")
    recorded_run(tmp_path / "set.arrows", set_by_s)
    run, other = load(tmp_path / "run.arrows"), load(tmp_path / "set.arrows")
    assert [step.what for step in other.steps] == ["one", "two", "stop"]
    for step, same in zip(run.steps, other.steps, strict=True):
        assert values_of(other, same) == values_of(run, step)


@pytest.mark.slow
def test_a_plot_marks_the_start_of_each_step(tmp_path: Path) -> None:
    from multidrop.report.style import day

    recorded_run(tmp_path / "run.arrows")
    figure = load(tmp_path / "run.arrows").plot(registers=["output_frequency", "output_power"])
    for axes in figure.axes:
        dashed = [line.get_xdata()[0] for line in axes.lines if line.get_linestyle() == "--"]
        assert dashed == [day(UTC_0 + round(edge * SECOND)) for edge in EDGES]
    assert [text.get_text() for text in figure.axes[-1].texts] == ["one", "two", "stop"]
    assert figure._repr_png_().startswith(b"\x89PNG")


@pytest.mark.long
def test_the_report_has_a_table_for_each_step(tmp_path: Path) -> None:
    path = tmp_path / "run.arrows"
    recorded_run(path)
    page = report_page(load(path))
    heads = [f"<h3>{number}. {name}, from" for number, name in enumerate(("one", "two", "stop"), 1)]
    assert all(head in page for head in heads)
    assert "<td>test</td>" not in page
