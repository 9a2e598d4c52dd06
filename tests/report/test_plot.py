"""Pictures and pages of a recording: the numbers in them are tested, but not their appearance."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from batches import METADATA, SECOND, UTC_0, example
from commands import Run
from examples import usually
from peers import require_installed
from recordings import ABOUT, record, row

import multidrop.cli.support.files
from multidrop.plant.loader import load_plant
from multidrop.polling.batch import Row
from multidrop.recording import open_writer

require_installed("matplotlib")

PNG = b"\x89PNG\r\n\x1a\n"
REQUEST_9600 = 9 * 10 / 9600  # s: 8 characters of the request, and the first character of the reply


@pytest.fixture(scope="module", autouse=True)
def _imported() -> None:
    """Import matplotlib only when these tests run. At collection, it would cost each worker 0.5 s."""
    global np, Recording, load, plot, plot_page, png, report_page, _about, _drives
    global MOST_REASONS, delays, draw_rates, miss_shares, reasons_of, line_uses
    global MOST_DRIVES, MOST_LANES, MOST_PANELS, MOST_POINTS, thinned
    import numpy as np

    from multidrop.report import Recording, load, plot, plot_page, png, report_page
    from multidrop.report.health import MOST_REASONS, delays, draw_rates, line_uses, miss_shares, reasons_of
    from multidrop.report.html import _about, _drives
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


def noisy_ramp() -> list[Row]:
    """Return rows of a pump whose speed rises for 100 s. From 30 Hz on, every second `fault` is a miss."""
    rows = []
    for tick in range(1000):
        second, hz = tick / 10, tick / 20
        damaged = hz >= 30 and tick % 2
        fault = 8 if 400 <= tick < 500 else 0
        rows.append(row(second, "pump", "output_frequency", hz))
        rows.append(
            row(second, "pump", "fault", None, "bad checksum")
            if damaged
            else row(second, "pump", "fault", fault)
        )
        rows.append(row(second, "fan", "output_current", 5.0, ms=12.0 + tick % 10))
    rows.append(row(100, "fan", "output_current", None, "no reply"))
    return rows


@pytest.fixture(scope="module")
def ramp(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("ramp") / "ramp.arrows", noisy_ramp())


@pytest.fixture(scope="module")
def look(ramp: Path) -> Recording:
    return load(ramp)


# ---- loading ----


def test_series_have_every_value_and_every_miss(look: Recording) -> None:
    assert [(each.drive, each.register, each.unit, len(each.time)) for each in look.series] == [
        ("pump", "output_frequency", "Hz", 1000),
        ("pump", "fault", "", 1000),
        ("fan", "output_current", "raw count", 1001),
    ]
    frequency, fault, current = look.series
    assert frequency.value.tolist() == [tick / 20 for tick in range(1000)]
    assert not frequency.missed.any()
    assert fault.missed.sum() == 200
    assert fault.reasons() == {"bad checksum": 200}
    assert current.reasons() == {"no reply": 1}
    assert look.drives == ("pump", "fan")
    assert look.seconds == 100


@pytest.mark.parametrize("suffix", [".arrows", ".csv", ".parquet"])
def test_recordings_of_every_format_are_read_as_the_same_data(tmp_path: Path, suffix: str) -> None:
    with open_writer(tmp_path / f"it{suffix}", METADATA) as writer:
        writer.write(example())
    loaded = load(tmp_path / f"it{suffix}")
    assert [(series.drive, series.register) for series in loaded.series] == [
        ("pump-1", "output_frequency"),
        ("pump-1", "motor_speed"),
        ('fan, the "old" one', "output_frequency"),
        ("насос", "motor_speed"),
        ('fan, the "old" one', "motor_speed"),
    ]
    assert loaded.series[0].value.tolist() == [49.99]
    assert [dict(series.reasons()) for series in loaded.series[2:]] == [
        {"exception 12": 1},
        {"no reply": 1},
        {"not asked: drive is silent": 1},
    ]


@pytest.mark.slow
@pytest.mark.long
def test_names_of_any_script_are_drawn(tmp_path: Path) -> None:
    with open_writer(tmp_path / "it.arrows", METADATA) as writer:
        writer.write(example())
    loaded = load(tmp_path / "it.arrows")
    assert png(plot(loaded)[0]).startswith(PNG)
    assert "насос" in report_page(loaded)


def test_misses_do_not_end_a_fault(look: Recording) -> None:
    (span,) = look.of("pump", "fault")[0].faults()
    assert span.what == "OVERHEAT"
    assert (span.begin - UTC_0, span.end - UTC_0) == (40 * SECOND, 50 * SECOND)


def test_faults_without_a_name_and_sets_of_fault_bits_are_shown(tmp_path: Path) -> None:
    flags = {"LOW": 1, "HIGH": 2, "HOT": 64}
    about = {"drives": {"pump": {"registers": {"fault": {"unit": "", "values": flags, "bits": True}}}}}
    rows = [row(at, "pump", "fault", value) for at, value in enumerate([0, 66, 66, 128, 0])]
    (series,) = load(record(tmp_path / "it.arrows", rows, about)).series
    assert [(fault.what, fault.end - fault.begin) for fault in series.faults()] == [
        ("HIGH HOT", 2 * SECOND),
        ("bit 7", SECOND),
    ]


# ---- figures ----


def test_the_response_delay_excludes_the_time_of_the_request(look: Recording) -> None:
    pump, fan = delays(look)
    assert pump.exact
    assert pump.seconds == pytest.approx(np.full(1000, 0.020 - REQUEST_9600))
    assert not fan.exact  # the settings of this drive are unknown
    assert fan.quantile(0.5) == pytest.approx(0.0165)
    assert fan.quantile(1.0) == pytest.approx(0.021)


def test_reply_that_may_answer_a_lost_request_has_no_response_delay(tmp_path: Path) -> None:
    rows = [row(tick / 10, "pump", "fault", 0.0, ms=10.0) for tick in range(10)]
    rows += [row(1.0, "pump", "fault", None, "no reply"), row(1.0, "pump", "fault", 0.0, ms=488.0)]
    rows += [
        row(2.0, "pump", "fault", None, "not asked: drive is silent"),
        row(2.0, "pump", "fault", 0.0, ms=30),
    ]
    (pump,) = delays(load(record(tmp_path / "it.arrows", rows, {})))
    assert pump.seconds * 1e3 == pytest.approx([10.0] * 10 + [30.0])


def test_misses_that_grow_with_speed_are_found(look: Recording) -> None:
    shares = miss_shares(look, "pump")
    assert shares is not None
    slow = shares[1][shares[0] < 28]
    fast = shares[1][shares[0] > 32]
    assert slow.max() == 0
    assert fast == pytest.approx(np.full(len(fast), 0.25), abs=0.02)  # 0.25: half of `fault`
    assert miss_shares(look, "fan") is None


# A character takes 1 ms. A request has 8 characters; a reply has 7 for one register, and 9 for two.
PLANNED: dict[str, Any] = {
    "hall-1": {
        "utilisation": 1.0,
        "cycle_ms": 70.0,
        "drives": {
            "pump": {
                "exchanges_per_second": 20.0,
                "silence_ms": 4.0,
                "character_ms": 1.0,
                "response_delay_ms": 5.0,
                "blocks": [
                    {
                        "registers": ["output_frequency", "fault"],
                        "every_ms": None,
                        "request_characters": 8,
                        "reply_characters": 9,
                    }
                ],
            },
            "fan": {
                "exchanges_per_second": 20.0,
                "silence_ms": 10.0,
                "character_ms": 1.0,
                "response_delay_ms": 5.0,
                "blocks": [
                    {
                        "registers": ["output_current"],
                        "every_ms": None,
                        "request_characters": 8,
                        "reply_characters": 7,
                    }
                ],
            },
        },
    }
}


def turns() -> list[Row]:
    """Return rows of two registers of a pump and one of a fan, every 100 ms. From half-way on, the fan is
    silent.
    """
    rows = []
    for tick in range(100):
        second = tick / 10
        rows += [row(second, "pump", name, 1.0, ms=14.0) for name in ("output_frequency", "fault")]
        lost = tick >= 50
        rows.append(
            row(second + 0.05, "fan", "output_current", *((None, "no reply") if lost else (1.0,)), ms=13.0)
        )
    return rows


@pytest.mark.slow
@pytest.mark.usefixtures("_unpainted")
def test_utilisation_of_a_line_is_computed_from_its_recording(tmp_path: Path) -> None:
    look = load(record(tmp_path / "it.arrows", turns(), ABOUT | {"planned": PLANNED}))
    (line,) = line_uses(look)
    # Pump: 14 ms to the reply's first character, then 8 ms; fan: 13 and 6 ms. The longer of two silences
    # follows.
    assert line.needed[1:99] == pytest.approx(np.array([0.029, 0.032] * 49))
    assert line.needed[101:] == pytest.approx(np.full(49, 0.026))
    assert line.utilisation == pytest.approx((50 * 0.029 + 50 * 0.032 + 50 * 0.026) / 9.976, rel=0.01)
    assert line.rate("pump") == pytest.approx(10, rel=0.01)
    assert line.rate("fan") == pytest.approx(5, rel=0.01)
    assert line.cycle == pytest.approx(9.976 * 3 / 250, rel=0.01)  # 3 registers in a cycle; 250 values
    page = report_page(look)
    assert "fan, exchanges/s" in page
    assert re.search(r"bus cycle, ms</td><td[^>]*>70\.0</td><td[^>]*>119\.\d</td>", page)


def test_utilisation_of_a_port_without_a_wire_is_at_most_1(tmp_path: Path) -> None:
    """The port is a network port with a request every 2 ms. On a wire, each exchange would need 32 ms."""
    rows = [row(tick / 500, "fan", "output_current", 1.0, ms=0.5) for tick in range(1000)]
    planned = {"hall-1": PLANNED["hall-1"] | {"drives": {"fan": PLANNED["hall-1"]["drives"]["fan"]}}}
    (line,) = line_uses(load(record(tmp_path / "it.arrows", rows, ABOUT | {"planned": planned})))
    assert 0.9 < line.utilisation <= 1.0 + 1e-9


def test_utilisation_counts_requests_that_differ_from_the_plan(tmp_path: Path) -> None:
    """In the first half, the pump's two registers are read by two requests, although the plan has one
    request.
    """
    rows = [
        row(tick / 10 + (0.05 if name == "fault" and tick < 50 else 0), "pump", name, 1.0, ms=14.0)
        for tick in range(100)
        for name in ("output_frequency", "fault")
    ]
    planned = {"hall-1": PLANNED["hall-1"] | {"drives": {"pump": PLANNED["hall-1"]["drives"]["pump"]}}}
    (line,) = line_uses(load(record(tmp_path / "it.arrows", rows, ABOUT | {"planned": planned})))
    assert line.asked == {"pump": 150}
    assert line.needed == pytest.approx(np.array([0.024] * 100 + [0.026] * 50))
    assert line.cycle == pytest.approx(0.1, rel=0.01)


@pytest.mark.parametrize("planned", [None, [], "hall", {"hall-1": 7}, {"hall-1": {"drives": {"pump": {}}}}])
def test_an_invalid_plan_is_ignored(tmp_path: Path, planned: Any) -> None:
    look = load(record(tmp_path / "it.arrows", turns(), ABOUT | {"planned": planned}))
    assert line_uses(look) == []


@pytest.mark.slow
@pytest.mark.usefixtures("_unpainted")
def test_the_report_states_that_the_recording_has_no_plan(tmp_path: Path) -> None:
    assert "does not carry a plan" in report_page(load(record(tmp_path / "it.arrows", turns())))


def test_the_plan_equals_the_polled_blocks(tmp_path: Path) -> None:
    path = tmp_path / "hall.toml"
    path.write_text(
        '[[line]]\nname = "hall-1"\nport = "x"\n[[line.drive]]\nname = "pump"\naddress = 1\nevery = "1 s"\n'
        'model = "invt-che"\npoll = ["output_frequency", "output_current"]\n'
    )
    told = json.loads(json.dumps(load_plant(path).metadata()))["planned"]
    (block,) = told["hall-1"]["drives"]["pump"]["blocks"]
    assert set(block["registers"]) == {"output_frequency", "output_current"}
    assert (block["every_ms"], block["request_characters"]) == (1000, 8)
    assert told["hall-1"]["drives"]["pump"]["exchanges_per_second"] == 1
    assert told["hall-1"]["drives"]["pump"]["character_ms"] == pytest.approx(10 / 9.6, abs=1e-6)


@pytest.mark.slow
@pytest.mark.usefixtures("_unpainted")
def test_a_line_polled_at_rates_has_no_bus_cycle(tmp_path: Path) -> None:
    planned = json.loads(json.dumps(PLANNED))
    planned["hall-1"]["drives"]["fan"]["blocks"][0]["every_ms"] = 100
    look = load(record(tmp_path / "it.arrows", turns(), ABOUT | {"planned": planned}))
    (line,) = line_uses(look)
    assert line.cycle is None
    assert line.utilisation > 0.4
    assert "bus cycle" not in report_page(look)


@pytest.mark.usefixtures("_unpainted")
@pytest.mark.long
def test_a_line_without_drives_has_no_utilisation(tmp_path: Path) -> None:
    planned = {"hall-2": {"utilisation": 0.0, "cycle_ms": 0.0, "drives": {}}}
    look = load(record(tmp_path / "it.arrows", turns(), ABOUT | {"planned": planned}))
    (line,) = line_uses(look)
    assert (line.utilisation, line.cycle) == (0, None)
    assert "hall-2" in report_page(look)


def test_misses_by_frequency_need_a_varying_speed(tmp_path: Path) -> None:
    rows = [row(at, "pump", "output_frequency", 50.0) for at in range(50)]
    rows.append(row(50, "pump", "output_frequency", None, "bad checksum"))
    assert miss_shares(load(record(tmp_path / "it.arrows", rows)), "pump") is None


def test_misses_are_listed_by_reason(look: Recording) -> None:
    assert reasons_of(look, "pump") == {"bad checksum": 200}
    assert reasons_of(look, "fan") == {"no reply": 1}


def test_thinning_keeps_every_extreme() -> None:
    time = np.arange(1_000_000)
    value = np.sin(time / 1e5)
    value[123_456], value[777_777] = 9.0, -9.0
    value[500_000:510_000] = np.nan
    few, kept = thinned(time, value)
    assert len(few) <= MOST_POINTS + 500
    assert (np.nanmax(kept), np.nanmin(kept)) == (9.0, -9.0)
    assert np.isnan(kept[(few >= 501_000) & (few < 509_000)]).all()
    assert np.all(np.diff(few) > 0)


# ---- pictures and pages ----


@pytest.mark.long
def test_there_is_a_panel_for_every_quantity_and_unit(look: Recording) -> None:
    figure, left = plot(look)
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles == ["faults", "output_frequency, Hz", "output_current, raw count"]
    assert left == []
    assert png(figure).startswith(PNG)


def test_drives_and_registers_can_be_chosen(look: Recording) -> None:
    figure, _ = plot(look, ["fan"])
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["output_current, raw count"]
    figure, _ = plot(look, [], ["output_frequency"])
    assert "output_frequency, Hz" in [axes.get_title(loc="left") for axes in figure.axes]


def test_without_a_fault_no_panel_of_faults_is_drawn_unless_requested(tmp_path: Path) -> None:
    rows = [row(at, "pump", name, 0) for at in range(3) for name in ("fault", "output_frequency")]
    look = load(record(tmp_path / "it.arrows", rows))

    def titles(registers: list[str]) -> list[str]:
        return [axes.get_title(loc="left") for axes in plot(look, [], registers)[0].axes]

    assert titles([]) == ["output_frequency, Hz"]
    assert titles(["fault"]) == ["faults: none"]


def test_a_fault_is_shaded_if_its_drive_is_plotted_alone(tmp_path: Path) -> None:
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


def test_lines_and_states_end_at_a_pause(tmp_path: Path) -> None:
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


def test_a_constant_value_has_a_wide_axis(tmp_path: Path) -> None:
    rows = [row(at, "pump", "output_frequency", 50.0) for at in range(3)]
    (axes,) = plot(load(record(tmp_path / "it.arrows", rows)))[0].axes
    low, high = axes.get_ylim()
    assert low <= 0 < 50 < high


def test_the_y_axis_includes_a_zero_near_the_values(tmp_path: Path) -> None:
    for least, bottom in ((10.0, 0.0), (45.0, None)):
        rows = [row(at, "pump", "output_frequency", value) for at, value in enumerate((least, 50.0))]
        (axes,) = plot(load(record(tmp_path / f"{least:g}.arrows", rows)))[0].axes
        low, _ = axes.get_ylim()
        assert low == bottom if bottom is not None else 0 < low < least


STATUS = {  # metadata of status registers, as in the documents of these families
    "erman": {"STOPPED": 0, "RUNNING": 1, "ACCELERATING": 2, "DECELERATING": 3},
    "che": {"FORWARD": 1, "REVERSE": 2, "STANDBY": 3, "FAULT": 4},
}


def states(path: Path, rows: list[Row]) -> Recording:
    """Return a recording of three drives. On two of them `status` is an enumeration, each with other names;
    on the third it is a set of bits.
    """
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


def test_each_drives_states_have_a_lane_with_the_drives_own_names(tmp_path: Path) -> None:
    """The raw value 3 means decelerating on one drive, and standby on the other."""
    rows = [row(at, "erman", "status", value) for at, value in enumerate((0, 2, 1, 3, 3, 3))]
    rows += [row(at, "che", "status", value) for at, value in enumerate((3, 3, 1, None, 3, 7))]
    (axes,) = plot(states(tmp_path, rows))[0].axes
    assert drawn(axes) == {
        "erman": [("stopped", 0, 1), ("accelerating", 1, 2), ("running", 2, 3), ("decelerating", 3, 5)],
        "che": [("standby", 0, 2), ("forward", 2, 3), ("standby", 4, 5), ("", 5, 5)],
    }
    (ticks,) = axes.lines  # the mark of the miss, in its drive's lane
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


def test_a_state_of_one_row_is_drawn(tmp_path: Path) -> None:
    """The state's bar is pale and one pixel wide. Without a dark edge it would be invisible."""
    rows = [row(at, "che", "status", 3 if at == 500 else None) for at in range(1000)]
    (axes,) = plot(states(tmp_path, rows))[0].axes
    (bars,) = axes.collections
    assert bars.get_linewidth()[0] > 0
    assert sum(bars.get_edgecolor()[0][:3]) < 1.5  # darker than a medium grey


def test_each_bit_has_a_lane_instead_of_one_sum(tmp_path: Path) -> None:
    rows = [row(at, "yd", "status", value) for at, value in enumerate((0, 16, 18, 2, 2 + 64, 1e308, 0.5, 0))]
    (axes,) = plot(states(tmp_path, rows))[0].axes
    assert drawn(axes) == {  # bars start at 1 s, when the first bit is set
        "yd reverse": [("", 1, 4)],
        "yd jog": [],
        "yd run": [("", 0, 2)],
        "yd bit 6": [("", 3, 4)],
    }
    assert axes.get_legend() is None


def test_an_unnamed_number_is_not_a_sum_of_names(tmp_path: Path) -> None:
    """A fault number that is not in the enumeration is not shown as the sum of several faults."""
    series = load(record(tmp_path / "it.arrows", [row(0, "pump", "fault", 9 + 2)], ABOUT)).series[0]
    assert [series.name_of(count) for count in (8.0, 9.0, 24.0, 1e308, -1.0, 0.5)] == [
        "OVERHEAT",
        "OVERLOAD",
        "code 24",
        "code 1e+308",
        "code -1",
        "code 0.5",
    ]


@pytest.mark.long
def test_lanes_that_do_not_fit_into_a_panel_are_counted(tmp_path: Path) -> None:
    bits = {f"B{bit}": 1 << bit for bit in range(16)}
    drives = [f"yd{number}" for number in range(80)]
    meaning = {"unit": "", "values": bits, "bits": True}
    about = {"drives": {name: {"registers": {"status": meaning}} for name in drives}}
    rows = [row(at, name, "status", at) for at in range(2) for name in drives]
    (axes,) = plot(load(record(tmp_path / "it.arrows", rows, about)))[0].axes
    assert len(axes.get_yticklabels()) == MOST_LANES
    assert axes.get_yticklabels()[0].get_text() == "yd0 b0"
    assert "(16 more lanes: choose with --drive)" in axes.get_title(loc="left")


def test_drives_that_do_not_fit_into_the_picture_are_counted_and_stay_in_the_tables(tmp_path: Path) -> None:
    rows = [row(at, f"pump-{number}", "x", at) for at in range(2) for number in range(MOST_DRIVES + 2)]
    look = load(record(tmp_path / "it.arrows", rows, {}))
    assert plot(look)[1] == ["2 more drives"]
    assert plot(look, [f"pump-{MOST_DRIVES + 1}"])[1] == []
    tables = "".join(_drives(look))
    assert f'<td class="short">pump-{MOST_DRIVES + 1}</td>' in tables
    assert f"The pictures show the first {MOST_DRIVES} of these drives" in tables


@pytest.mark.parametrize(
    ("limit", "value", "mistake"),
    [
        ("MOST_NAMES", 9, "names more than 9 drives, registers or statuses"),
        ("MOST_ROWS", 19, "is too large to draw: it has more than 19 rows"),
        ("LONGEST_NAME", 5, "a name has 7 bytes: names in a recording have at most 5"),
    ],
)
def test_recording_too_large_to_draw_raises_value_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str, value: int, mistake: str
) -> None:
    path = record(tmp_path / "it.arrows", [row(at, f"pump-{at:02}", "x", at) for at in range(20)], {})
    assert len(load(path).series) == 20
    of_module = load.__globals__ if limit in load.__globals__ else load.__globals__["codes_of"].__globals__
    monkeypatch.setitem(of_module, limit, value)
    with pytest.raises(ValueError, match=mistake):
        load(path)


@pytest.mark.slow
def test_states_that_change_faster_than_can_be_drawn_hide_no_fault(tmp_path: Path) -> None:
    rows = [row(at / 100, "che", "status", 1 + at % 2) for at in range(20_000)]
    rows[10_001] = row(100.01, "che", "status", 4)
    (axes,) = plot(states(tmp_path, rows))[0].axes
    assert len(drawn(axes)["che"]) == 3
    order = [text.get_text() for text in axes.get_legend().get_texts()]
    assert order == ["fault"]


def test_reasons_beyond_the_limit_are_combined_as_other_reasons(tmp_path: Path) -> None:
    rows = [row(at, "pump", "output_frequency", None, f"reason {at % 8}") for at in range(80)]
    rows += [row(at, "pump", "output_frequency", None, "no reply") for at in range(80)]
    (_, misses) = draw_rates(load(record(tmp_path / "it.arrows", rows))).axes
    names = [text.get_text() for text in misses.get_legend().get_texts()]
    assert (names[0], len(names), names[-1]) == ("no reply", MOST_REASONS + 1, "other reasons")


@pytest.mark.usefixtures("_unpainted")
@pytest.mark.slow
@pytest.mark.long
def test_series_that_do_not_fit_into_the_picture_are_named(run: Run, tmp_path: Path) -> None:
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
def test_a_register_of_two_panels_without_room_is_named_only_once(tmp_path: Path) -> None:
    """A register whose values are numbers on one drive and states on another has two panels."""
    rows = [row(0, "pump", f"r{number}", 1) for number in range(MOST_PANELS)]
    rows += [row(0, drive, "status", 1) for drive in ("pump", "che")]
    assert plot(states(tmp_path, rows))[1] == ["status"]


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
    assert re.search(r"<td[^>]*>pump</td><td[^>]*>1000</td><td[^>]*>10\.6</td>", page)  # least delay, ms


@pytest.mark.usefixtures("_unpainted")
def test_names_cannot_break_the_page(tmp_path: Path) -> None:
    rows = [row(at, "<script>&", "output_frequency", at) for at in range(3)]
    look = load(record(tmp_path / "<b>.arrows", rows))
    for page in (report_page(look), plot_page(look, plot(look)[0])):
        assert "<script>" not in page
        assert "<b>" not in page


@pytest.mark.long
def test_a_recording_of_misses_only_has_a_report(tmp_path: Path) -> None:
    rows = [row(at, "pump", "output_frequency", None, "no reply") for at in range(3)]
    look = load(record(tmp_path / "it.arrows", rows))
    page = report_page(look)
    assert "No drive ever answered." in page
    assert "100.00%" in page


@pytest.mark.usefixtures("_unpainted")
@pytest.mark.parametrize(("value", "status"), [(0.0, "ok"), (None, "no reply")])
def test_the_report_states_that_there_was_no_fault(tmp_path: Path, value: float | None, status: str) -> None:
    rows = [row(at, "pump", "fault", value, status) for at in range(3)]
    look = load(record(tmp_path / "it.arrows", rows))
    assert look.series[0].faults() == []
    assert "<p>None was seen.</p>" in report_page(look)


@pytest.mark.usefixtures("_unpainted")
def test_a_long_recording_s_length_is_in_hours(tmp_path: Path) -> None:
    rows = [row(second, "pump", "output_frequency", 50.0) for second in (0, 7384)]
    assert "UTC, 2 h 03 min; 1 drive; 2 values" in report_page(load(record(tmp_path / "it.arrows", rows)))


@pytest.mark.usefixtures("_unpainted")
def test_series_without_values_are_not_plotted(run: Run, tmp_path: Path) -> None:
    rows = [row(at, "pump", "output_frequency", None, "no reply") for at in range(3)]
    rows += [row(at, "fan", "output_frequency", 5.0) for at in range(3)]
    path = record(tmp_path / "it.arrows", rows)
    assert run("plot", path, "--drive", "pump") == (
        2,
        "",
        "multidrop: there is no value to draw, only misses: no reply 3; `multidrop report` shows more\n",
    )
    assert run("plot", path)[0] == 0


@pytest.mark.long
def test_a_single_row_has_a_report(tmp_path: Path) -> None:
    look = load(record(tmp_path / "it.arrows", [row(1, "pump", "output_frequency", 50.0)], pieces=1))
    assert "Report on it.arrows" in report_page(look)


# ---- invalid metadata and values ----

ODD: list[Any] = [10**400, None, True, -1, 1e308, "", "x", [], [1], {}, {"a": {}}, {"FORWARD": 10**400}]


def with_odd(about: Any, odd: Any) -> Iterator[Any]:
    """Yield copies of the metadata, in each of which a different part is replaced by `odd`."""
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
def test_invalid_parts_of_metadata_are_left_out_of_a_report(tmp_path: Path, odd: Any) -> None:
    """All parts of the report are made from the rest of the metadata, which is valid."""
    about = {"plant": "hall.toml", "planned": PLANNED, "drives": ABOUT["drives"]}
    rows = turns()[:30]
    for number, metadata in enumerate(with_odd(about, odd)):
        if not isinstance(metadata, dict):
            continue  # this copy cannot be a recording's metadata
        look = load(record(tmp_path / f"{number}.arrows", rows, metadata, pieces=1))
        assert all(
            np.isfinite([each.utilisation, each.rate("pump"), each.cycle or 0]).all()
            for each in line_uses(look)
        )
        assert {delay.drive for delay in delays(look)} == {"pump", "fan"}
        assert len(_about(look) + "".join(_drives(look))) > 100
        if metadata.get("planned") is odd or metadata.get("drives") is odd:
            assert report_page(look)


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


@pytest.mark.parametrize("time", [-(2**63), -1, 2**63 - 1])
def test_times_outside_the_calendar_print_one_sentence(run: Run, tmp_path: Path, time: int) -> None:
    rows = [
        row(0, "pump", "output_frequency", 1.0),
        row(1, "pump", "output_frequency", 1.0)._replace(time_ns=time),
    ]
    path = record(tmp_path / "it.arrows", rows)
    for command in ("plot", "report"):
        assert run(command, path) == (
            2,
            "",
            f"multidrop: {path} cannot be drawn: it has rows from before 1970 or after 2200\n",
        )


def test_metadata_that_is_nested_too_deeply_prints_one_sentence(run: Run, tmp_path: Path) -> None:
    path = record(tmp_path / "it.csv", turns())
    (tmp_path / "it.csv.json").write_text("[" * 100_000)
    for command in ("plot", "report"):
        status, out, err = run(command, path)
        assert (status, out) == (2, "")
        assert "is not a recording: its metadata is nested too deeply" in err


# ---- the commands ----


@pytest.mark.slow
@pytest.mark.usefixtures("_unpainted")
def test_plot_and_report_need_only_the_recording(run: Run, ramp: Path, tmp_path: Path) -> None:
    here = tmp_path / "ramp.arrows"
    here.write_bytes(ramp.read_bytes())
    assert run("plot", here) == (0, f"{tmp_path}/ramp.png\n", "")
    assert (tmp_path / "ramp.png").read_bytes().startswith(PNG)
    assert run("report", here) == (0, f"{tmp_path}/ramp.html\n", "")
    assert "Report on ramp.arrows" in (tmp_path / "ramp.html").read_text()
    status, _, err = run("plot", here)
    assert status == 2
    assert "exists already" in err
    assert run("plot", here, "--drive", "fan", "--out", tmp_path / "fan.html")[0] == 0
    assert "data:image/png" in (tmp_path / "fan.html").read_text()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--drive", "punp"), "the recording has no drive 'punp'; it has pump, fan"),
        (("--register", "speed"), "the recording has no register 'speed'; it has output_frequency, "),
        (("--drive", "fan", "--register", "fault"), "has no register 'fault'; it has output_current"),
        (("--out", "picture.jpg"), "picture.jpg: a plot's name must end in .png or .html"),
    ],
)
def test_mistakes_are_reported_in_one_sentence(
    run: Run, ramp: Path, tmp_path: Path, words: tuple[str, ...], sentence: str
) -> None:
    out = () if "--out" in words else ("--out", tmp_path / "it.png")
    status, text, err = run("plot", ramp, *words, *out)
    assert (status, text) == (2, "")
    assert sentence in err
    assert len(err.splitlines()) == 1


@pytest.mark.parametrize("command", ["plot", "report", "convert"])
def test_a_history_s_folder_as_argument_prints_one_sentence(run: Run, tmp_path: Path, command: str) -> None:
    out = () if command != "convert" else (tmp_path / "all.csv",)
    folder = f"multidrop: {tmp_path} is the folder of a history: name one of its files, such as"
    by_program = "or read it from Python with `multidrop.History`\n"
    (tmp_path / "rows").mkdir()
    for name in ("rows.00000003.arrows", "rows/00000001.parquet", "rows/00000002.parquet"):
        (tmp_path / name).touch()
    assert run(command, tmp_path, *out) == (2, "", f"{folder} {tmp_path}/rows.00000003.arrows, {by_program}")
    (tmp_path / "rows.00000003.arrows").unlink()
    assert run(command, tmp_path, *out) == (2, "", f"{folder} {tmp_path}/rows/00000002.parquet, {by_program}")


@pytest.mark.parametrize("command", ["plot", "report"])
def test_a_file_without_rows_or_not_a_recording_prints_one_sentence(
    run: Run, tmp_path: Path, command: str
) -> None:
    assert run(command, ".")[::2] == (2, "multidrop: . is a folder: name the recording in it\n")
    text = tmp_path / "letter.arrows"
    text.write_text("Dear Sir")
    assert "is not a recording" in run(command, text)[2]
    empty = tmp_path / "empty.arrows"
    with open_writer(empty, {}):
        pass
    status, _, err = run(command, empty)
    assert status == 2
    assert "holds no rows: nothing was polled" in err
    with empty.open("ab") as file:
        file.write(b"\xff\xff\xff\xff\x10")
    assert "holds no rows: it ends within the first one" in run(command, empty)[2]


@pytest.mark.parametrize("command", ["plot", "report"])
def test_a_missing_library_is_named_with_the_command_that_installs_it(
    run: Run, ramp: Path, command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(multidrop.cli.support.files.importlib.util, "find_spec", lambda name: None)
    status, _, err = run(command, ramp)
    assert status == 2
    assert "pip install 'matplotlib>" in err


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


def test_recording_of_events_alone_is_refused(tmp_path: Path) -> None:
    path = record(tmp_path / "run.arrows", [row(1, "event", "comment", None, "nothing")])
    with pytest.raises(ValueError, match="only events"):
        load(path)
