"""Pictures of a recording's values: the numbers in them are tested, but not their appearance."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from batches import SECOND, UTC_0
from commands import Run
from peers import require_installed
from recordings import record, row
from tables import usually

from multidrop.polling.batch import Row

require_installed("matplotlib")

PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(scope="module", autouse=True)
def _imported() -> None:
    """Import matplotlib only when these tests run. At collection, it would cost each worker 0.5 s."""
    global np, Recording, load, plot, png, report_page, _drives
    global MOST_DRIVES, MOST_LANES, MOST_PANELS, MOST_POINTS, thinned
    import numpy as np

    from multidrop.report import Recording, load, plot, png, report_page
    from multidrop.report.html import _drives
    from multidrop.report.style import MOST_DRIVES
    from multidrop.report.value_plot import MOST_LANES, MOST_PANELS, MOST_POINTS, thinned


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [0.01, 0.3, 2, 7, 90, 4000, 200_000])
def test_neighbouring_ticks_of_the_time_axis_have_different_labels(seconds: float) -> None:
    from multidrop.report.style import day, label_time, new_figure

    figure, (axes,) = new_figure([2.0])
    axes.set_xlim(day(UTC_0), day(UTC_0 + round(seconds * SECOND)))
    label_time(axes)
    figure.canvas.draw()
    labels = [label.get_text() for label in axes.get_xticklabels()]
    assert len(labels) > 1
    assert all(one != other for one, other in pairwise(labels))


def test_a_thinned_curve_keeps_every_minimum_and_maximum() -> None:
    time = np.arange(1_000_000)
    value = np.sin(time / 1e5)
    value[123_456], value[777_777] = 9.0, -9.0
    value[500_000:510_000] = np.nan
    few, kept = thinned(time, value)
    assert len(few) <= MOST_POINTS + 500
    assert (np.nanmax(kept), np.nanmin(kept)) == (9.0, -9.0)
    assert np.isnan(kept[(few >= 501_000) & (few < 509_000)]).all()
    assert np.all(np.diff(few) > 0)


@pytest.mark.long
def test_a_plot_has_a_panel_for_every_quantity_and_unit(look: Recording) -> None:
    figure, left = plot(look)
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles == ["faults", "output_frequency, Hz", "output_current, raw count"]
    assert left == []
    assert png(figure).startswith(PNG)


def test_a_plot_can_be_limited_to_some_drives_and_registers(look: Recording) -> None:
    figure, _ = plot(look, ["fan"])
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["output_current, raw count"]
    figure, _ = plot(look, [], ["output_frequency"])
    assert "output_frequency, Hz" in [axes.get_title(loc="left") for axes in figure.axes]


def test_an_empty_fault_panel_is_drawn_only_on_request(tmp_path: Path) -> None:
    rows = [row(at, "pump", name, 0) for at in range(3) for name in ("fault", "output_frequency")]
    look = load(record(tmp_path / "it.arrows", rows))

    def titles(registers: list[str]) -> list[str]:
        return [axes.get_title(loc="left") for axes in plot(look, [], registers)[0].axes]

    assert titles([]) == ["output_frequency, Hz"]
    assert titles(["fault"]) == ["faults: none"]


def test_a_fault_is_shaded_in_the_panels_of_the_faulty_drive(tmp_path: Path) -> None:
    units = {"output_frequency": "Hz", "output_current": "A", "output_torque": "%"}
    meanings = {name: {"unit": unit} for name, unit in units.items()}
    status = {"status": {"unit": "", "values": {"RUN": 1}, "bits": False}}
    about = {"drives": {name: {"registers": {**meanings, **status}} for name in ("pump", "fan")}}
    rows = [row(at, "pump", "fault", float(at > 5)) for at in range(10)]
    drawn = {"pump": ("output_frequency", "output_current", "status"), "fan": ("output_current", "status")}
    rows += [row(at, name, one, 1.0) for at in range(10) for name in drawn for one in drawn[name]]
    rows += [row(at, "fan", "output_torque", 1.0) for at in range(10)]
    figure, _ = plot(load(record(tmp_path / "it.arrows", sorted(rows, key=lambda row: row.time_ns), about)))
    shaded = {
        axes.get_title(loc="left"): [patch.get_y() for patch in axes.patches if patch.get_alpha() == 0.08]
        for axes in figure.axes
    }
    names = [text.get_text() for text in figure.axes[-1].get_yticklabels()]
    assert shaded == {
        "faults": [],
        "output_frequency, Hz": [0],
        "output_current, A": [0],
        "output_torque, %": [],
        "status": [names.index("pump") - 0.5],
    }


def test_plotted_curves_break_at_a_pause_of_polling(tmp_path: Path) -> None:
    """A suspended process records no rows, not even misses: that is a pause. A changed rate is not."""
    times = [0.0, 0.1, 0.2, 10.2, 10.3, 10.4, 30.4, 50.4, 70.4]
    rows = [row(at, "pump", name, 1.0) for at in times for name in ("output_frequency", "status")]
    about = {"drives": {"pump": {"registers": {"status": {"values": {"runs": 1}}}}}}
    figure, _ = plot(load(record(tmp_path / "it.arrows", rows, about)))
    lane, curve = (
        next(axes for axes in figure.axes if axes.get_title(loc="left").startswith(name))
        for name in ("status", "output_frequency")
    )
    (line,) = (one for one in curve.lines if len(one.get_xdata()) > 2)
    drawn = ["-" if np.isnan(value) else "o" for value in line.get_ydata()]
    assert "".join(drawn) == "ooo-oooooo"
    (bars,) = lane.collections
    spans = [path.get_extents() for path in bars.get_paths()]
    seconds = [round(span.width * 86400, 1) for span in spans]
    assert seconds == [0.2, 60.2]


@pytest.mark.slow
@pytest.mark.parametrize(("drives", "name"), [(30, "drive"), (12, "conveyor-of-the-bottling-hall-south")])
def test_a_long_legend_takes_no_room_from_the_plot(tmp_path: Path, drives: int, name: str) -> None:
    rows = [row(at, f"{name}-{n:02}", "output_frequency", n) for at in range(3) for n in range(drives)]
    figure, _ = plot(load(record(tmp_path / "it.arrows", rows)))
    figure.draw_without_rendering()
    (axes,), (legend,) = figure.axes, figure.legends
    inches = axes.get_window_extent().height / figure.dpi
    assert inches > 1
    shown = legend.get_window_extent()
    assert shown.x0 >= 0
    assert shown.x1 <= figure.bbox.width


def test_the_value_axis_of_a_constant_value_includes_zero(tmp_path: Path) -> None:
    rows = [row(at, "pump", "output_frequency", 50.0) for at in range(3)]
    (axes,) = plot(load(record(tmp_path / "it.arrows", rows)))[0].axes
    low, high = axes.get_ylim()
    assert low <= 0 < 50 < high


def test_the_value_axis_includes_zero_if_the_values_are_near_it(tmp_path: Path) -> None:
    for least, bottom in ((10.0, 0.0), (45.0, None)):
        rows = [row(at, "pump", "output_frequency", value) for at, value in enumerate((least, 50.0))]
        (axes,) = plot(load(record(tmp_path / f"{least:g}.arrows", rows)))[0].axes
        low, _ = axes.get_ylim()
        assert low == bottom if bottom is not None else 0 < low < least


STATUS = {  # metadata of status registers, as in the families' documents
    "erman": {"STOPPED": 0, "RUNNING": 1, "ACCELERATING": 2, "DECELERATING": 3},
    "che": {"FORWARD": 1, "REVERSE": 2, "STANDBY": 3, "FAULT": 4},
}


def states(path: Path, rows: list[Row]) -> Recording:
    """Return a recording of three drives; `status` is an enumeration in two, and a set of bits in one."""
    meanings: dict[str, Any] = {
        name: {"unit": "", "values": names, "bits": False} for name, names in STATUS.items()
    }
    meanings["yd"] = {"unit": "", "values": {"JOG": 4, "REVERSE": 2, "RUN": 16}, "bits": True}
    about = {"drives": {name: {"registers": {"status": meaning}} for name, meaning in meanings.items()}}
    return load(record(path / "it.arrows", rows, about))


def drawn(axes: Any) -> dict[str, list[tuple[str, float, float]]]:
    """Return the texts in each lane, by the lane's label, each with the start and end of its bar in s."""
    lanes = {text.get_text(): [] for text in axes.get_yticklabels()}
    names = list(lanes)
    bars: dict[int, list[tuple[float, float]]] = {}
    for collection in axes.collections:
        for path in collection.get_paths():
            left, right = path.vertices[:, 0].min(), path.vertices[:, 0].max()
            bars.setdefault(round(path.vertices[:, 1].mean()), []).append((left, right))
    texts = {(round(at.xy[1]), at.xy[0]): at.get_text() for at in axes.texts}
    epoch = min(left for found in bars.values() for left, _ in found)
    for lane, found in bars.items():
        for left, right in sorted(found):
            span = ((left - epoch) * 86400, (right - epoch) * 86400)
            lanes[names[lane]].append((texts.get((lane, left), ""), *(round(at, 2) for at in span)))
    return lanes


def test_the_states_of_each_drive_are_drawn_in_a_row_with_their_names(tmp_path: Path) -> None:
    """The raw value 3 means decelerating on one drive, and standby on the other."""
    rows = [row(at, "erman", "status", value) for at, value in enumerate((0, 2, 1, 3, 3, 3))]
    rows += [row(at, "che", "status", value) for at, value in enumerate((3, 3, 1, None, 3, 7))]
    (axes,) = plot(states(tmp_path, rows))[0].axes
    assert drawn(axes) == {
        "erman": [("stopped", 0, 1), ("accelerating", 1, 2), ("running", 2, 3), ("decelerating", 3, 5)],
        "che": [("standby", 0, 2), ("forward", 2, 3), ("standby", 4, 5), ("", 5, 5)],
    }
    (ticks,) = axes.lines  # the mark of the missed value, in its drive's lane
    assert ticks.get_ydata()[0] == pytest.approx(1.4)
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["code 7"]


def test_no_state_has_the_colour_of_a_drive(tmp_path: Path) -> None:
    """A panel of curves and a panel of states share one picture and one legend of drives."""
    from matplotlib.colors import to_hex

    from multidrop.report.style import line_style

    values = [*range(1, 5), *range(20, 45)]
    rows = [row(at, "che", "status", value) for at, value in enumerate(values)]
    rows += [row(at, "yd", "status", 2) for at in range(2)]  # REVERSE is the name of a state, and of a bit
    (axes,) = plot(states(tmp_path, rows))[0].axes
    *of_states, of_bit = (to_hex(colour) for bars in axes.collections for colour in bars.get_facecolor())
    of_drives = [to_hex(line_style(number)["color"]) for number in range(len(values))]
    assert len(of_states) == len(values)
    assert set(of_states) & set(of_drives) == set()
    assert of_bit == of_drives[1]


def test_a_state_that_lasts_one_row_is_drawn(tmp_path: Path) -> None:
    """The state's bar is pale and one pixel wide. Without a dark edge it would be invisible."""
    rows = [row(at, "che", "status", 3 if at == 500 else None) for at in range(1000)]
    (axes,) = plot(states(tmp_path, rows))[0].axes
    (bars,) = axes.collections
    assert bars.get_linewidth()[0] > 0
    assert sum(bars.get_edgecolor()[0][:3]) < 1.5  # the edge is darker than a medium grey


def test_each_bit_of_a_status_register_is_drawn_in_its_own_row(tmp_path: Path) -> None:
    rows = [row(at, "yd", "status", value) for at, value in enumerate((0, 16, 18, 2, 2 + 64, 1e308, 0.5, 0))]
    (axes,) = plot(states(tmp_path, rows))[0].axes
    assert drawn(axes) == {  # bars start at 1 s, when the first bit is set
        "yd reverse": [("", 1, 4)],
        "yd jog": [],
        "yd run": [("", 0, 2)],
        "yd bit 6": [("", 3, 4)],
    }
    assert axes.get_legend() is None


@pytest.mark.slow
def test_fast_state_changes_do_not_hide_a_fault_in_a_plot(tmp_path: Path) -> None:
    rows = [row(at / 100, "che", "status", 1 + at % 2) for at in range(20_000)]
    rows[10_001] = row(100.01, "che", "status", 4)
    (axes,) = plot(states(tmp_path, rows))[0].axes
    assert len(drawn(axes)["che"]) == 3
    order = [text.get_text() for text in axes.get_legend().get_texts()]
    assert order == ["fault"]


@pytest.mark.long
def test_state_rows_omitted_from_a_plot_are_counted(tmp_path: Path) -> None:
    bits = {f"B{bit}": 1 << bit for bit in range(16)}
    drives = [f"yd{number}" for number in range(80)]
    meaning = {"unit": "", "values": bits, "bits": True}
    about = {"drives": {name: {"registers": {"status": meaning}} for name in drives}}
    rows = [row(at, name, "status", at) for at in range(2) for name in drives]
    (axes,) = plot(load(record(tmp_path / "it.arrows", rows, about)))[0].axes
    assert len(axes.get_yticklabels()) == MOST_LANES
    assert axes.get_yticklabels()[0].get_text() == "yd0 b0"
    assert "(16 more lanes: choose with --drive)" in axes.get_title(loc="left")


def test_drives_omitted_from_a_plot_are_counted(tmp_path: Path) -> None:
    """The tables of a report list all drives."""
    rows = [row(at, f"pump-{number}", "x", at) for at in range(2) for number in range(MOST_DRIVES + 2)]
    look = load(record(tmp_path / "it.arrows", rows, {}))
    assert plot(look)[1] == ["2 more drives"]
    assert plot(look, [f"pump-{MOST_DRIVES + 1}"])[1] == []
    tables = "".join(_drives(look))
    assert f'<td class="short">pump-{MOST_DRIVES + 1}</td>' in tables
    assert f"The pictures show the first {MOST_DRIVES} of these drives" in tables


@pytest.mark.usefixtures("_unpainted")
@pytest.mark.slow
@pytest.mark.long
def test_series_omitted_from_a_plot_are_named(run: Run, tmp_path: Path) -> None:
    rows = [row(at, "pump", f"r{number}", at) for at in range(3) for number in range(MOST_PANELS + 2)]
    look = load(record(tmp_path / "it.arrows", rows))
    figure, left = plot(look)
    assert len(figure.axes) == MOST_PANELS
    assert left == [f"r{MOST_PANELS}", f"r{MOST_PANELS + 1}"]
    assert plot(look, [], left)[1] == []
    assert f"<p>Not shown: r{MOST_PANELS}; r{MOST_PANELS + 1}. <code>multidrop plot" in report_page(look)
    assert run("plot", tmp_path / "it.arrows") == (
        0,
        f"{tmp_path}/it.png\nnot shown: {'; '.join(left)} (choose with --drive and --register)\n",
        "",
    )


@pytest.mark.slow
@pytest.mark.usefixtures("_unpainted")
def test_a_register_with_two_omitted_panels_is_named_only_once(tmp_path: Path) -> None:
    """A register whose values are numbers on one drive and states on another has two panels."""
    rows = [row(0, "pump", f"r{number}", 1) for number in range(MOST_PANELS)]
    rows += [row(0, drive, "status", 1) for drive in ("pump", "che")]
    assert plot(states(tmp_path, rows))[1] == ["status"]


LARGEST_VALUES = [1e308, float("-inf"), 1e149]


@pytest.mark.long
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("value", usually(*LARGEST_VALUES))
@pytest.mark.parametrize("register", usually("output_frequency", "fault", "output_current"))
def test_values_too_large_for_an_axis_are_counted(tmp_path: Path, register: str, value: float) -> None:
    drive = "fan" if register == "output_current" else "pump"
    rows = [row(at, drive, register, 1.0 if at % 2 else value) for at in range(40)]
    rows += [row(at + 0.5, drive, register, None, "no reply") for at in range(40)]
    rows += [row(40, drive, register, value), row(40.5, drive, register, -value)]
    look = load(record(tmp_path / "it.arrows", rows))
    figure, _ = plot(look)
    assert report_page(look)
    title = figure.axes[-1].get_title(loc="left")
    assert ("are not drawn" in title) == (abs(value) >= 1e150 and register != "fault")
