"""Recordings in memory and the figures computed from them: delays, missed values, utilisation of lines."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from batches import METADATA, SECOND, UTC_0, example
from peers import require_installed
from recordings import ABOUT, record, row

from multidrop.plant.loader import load_plant
from multidrop.polling.batch import Row
from multidrop.recording import open_writer

require_installed("matplotlib")

REQUEST_9600 = 9 * 10 / 9600  # s: 8 characters of the request, and the first character of the reply


@pytest.fixture(scope="module", autouse=True)
def _imported() -> None:
    """Import matplotlib only when these tests run. At collection, it would cost each worker 0.5 s."""
    global np, Recording, TimeSpan, load, report_page
    global MOST_REASONS, delays, draw_rates, miss_shares, reasons_of, line_uses
    import numpy as np

    from multidrop.report import Recording, TimeSpan, load, report_page
    from multidrop.report.health import MOST_REASONS, delays, draw_rates, line_uses, miss_shares, reasons_of


def test_a_loaded_recording_has_every_value_and_every_miss(look: Recording) -> None:
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


@pytest.mark.parametrize("set_by_s", [-3600, 0, 3 * 86400])
def test_the_duration_of_a_recording_does_not_change_if_the_clock_is_set(
    tmp_path: Path, set_by_s: int
) -> None:
    times = [(at + set_by_s * (at > 49), at) for at in range(100)]
    rows = [Row(UTC_0 + t * SECOND, at * SECOND, 1000, "pump", "speed", 1.0, "ok") for t, at in times]
    assert load(record(tmp_path / "a.arrows", rows, ABOUT)).seconds == 99


@pytest.mark.parametrize("set_by_s", [0, -5, -3600])
def test_the_duration_of_a_fault_is_right_if_the_clock_is_set_back(tmp_path: Path, set_by_s: int) -> None:
    """The fault lasts from 8 s to 13 s, and the clock is set at 10 s."""
    rows = []
    for at in range(30):
        utc, value = at + set_by_s * (at >= 10), 8.0 if 8 <= at < 13 else 0.0
        rows.append(Row(UTC_0 + utc * SECOND, at * SECOND, 1000, "pump", "fault", value, "ok"))
    (pump,) = load(record(tmp_path / "a.arrows", rows, ABOUT)).series
    assert pump.faults() == [TimeSpan(UTC_0 + 8 * SECOND, UTC_0 + 13 * SECOND, "OVERHEAT")]


def test_a_recording_of_several_computers_is_timed_by_the_time_of_day(tmp_path: Path) -> None:
    rows = [
        Row(UTC_0 + at * SECOND, (uptime + at) * SECOND, 1000, drive, "speed", 1.0, "ok")
        for drive, uptime in (("pump", 100), ("fan", 3_000_000))
        for at in range(60)
    ]
    assert load(record(tmp_path / "a.arrows", rows, ABOUT)).seconds == 59


def test_the_duration_of_a_recording_includes_restarts_of_the_computer(tmp_path: Path) -> None:
    """The monotonic clock was at 500 s, and starts again at 20 s after a pause of 60 s."""
    times = [(at, 450 + at) for at in range(51)] + [(110 + at, 20 + at) for at in range(11)]
    rows = [Row(UTC_0 + t * SECOND, at * SECOND, 1000, "pump", "speed", 1.0, "ok") for t, at in times]
    assert load(record(tmp_path / "a.arrows", rows, ABOUT)).seconds == 50 + 60 + 10


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


def test_missed_values_do_not_end_a_fault(look: Recording) -> None:
    (span,) = look.of("pump", "fault")[0].faults()
    assert span.what == "OVERHEAT"
    assert (span.begin - UTC_0, span.end - UTC_0) == (40 * SECOND, 50 * SECOND)


def test_unnamed_faults_and_combined_fault_bits_are_shown(tmp_path: Path) -> None:
    flags = {"LOW": 1, "HIGH": 2, "HOT": 64}
    about = {"drives": {"pump": {"registers": {"fault": {"unit": "", "values": flags, "bits": True}}}}}
    rows = [row(at, "pump", "fault", value) for at, value in enumerate([0, 66, 66, 128, 0])]
    (series,) = load(record(tmp_path / "it.arrows", rows, about)).series
    assert [(fault.what, fault.end - fault.begin) for fault in series.faults()] == [
        ("HIGH HOT", 2 * SECOND),
        ("bit 7", SECOND),
    ]


def test_an_unnamed_fault_number_is_not_shown_as_a_sum_of_faults(tmp_path: Path) -> None:
    """The names of 8 and 16 must not be shown for 24."""
    series = load(record(tmp_path / "it.arrows", [row(0, "pump", "fault", 9 + 2)], ABOUT)).series[0]
    assert [series.name_of(count) for count in (8.0, 9.0, 24.0, 1e308, -1.0, 0.5)] == [
        "OVERHEAT",
        "OVERLOAD",
        "code 24",
        "code 1e+308",
        "code -1",
        "code 0.5",
    ]


def test_a_negative_value_is_shown_by_its_name(tmp_path: Path) -> None:
    about = {"drives": {"pump": {"registers": {"fault": {"unit": "", "values": {"REVERSE": -1}}}}}}
    (series,) = load(record(tmp_path / "it.arrows", [row(0, "pump", "fault", -1)], about)).series
    assert (series.name_of(-1.0), series.name_of(-2.0)) == ("REVERSE", "code -2")


@pytest.mark.parametrize(
    ("limit", "value", "mistake"),
    [
        ("MOST_NAMES", 9, "names more than 9 drives, registers or statuses"),
        ("MOST_ROWS", 19, "is too large to draw: it has more than 19 rows"),
        ("LONGEST_NAME", 5, "a name has 7 bytes: names in a recording have at most 5"),
    ],
)
def test_a_recording_too_large_to_draw_raises_value_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str, value: int, mistake: str
) -> None:
    path = record(tmp_path / "it.arrows", [row(at, f"pump-{at:02}", "x", at) for at in range(20)], {})
    assert len(load(path).series) == 20
    of_module = load.__globals__ if limit in load.__globals__ else load.__globals__["codes_of"].__globals__
    monkeypatch.setitem(of_module, limit, value)
    with pytest.raises(ValueError, match=mistake):
        load(path)


def test_a_recording_that_has_only_events_cannot_be_drawn(tmp_path: Path) -> None:
    path = record(tmp_path / "run.arrows", [row(1, "event", "comment", None, "nothing")])
    with pytest.raises(ValueError, match="only events"):
        load(path)


def test_the_response_delay_excludes_the_time_of_the_request(look: Recording) -> None:
    pump, fan = delays(look)
    assert pump.exact
    assert pump.seconds == pytest.approx(np.full(1000, 0.020 - REQUEST_9600))
    assert not fan.exact  # the recording lacks the line settings of this drive
    assert fan.quantile(0.5) == pytest.approx(0.0165)
    assert fan.quantile(1.0) == pytest.approx(0.021)


def test_a_reply_after_a_lost_request_has_no_response_delay(tmp_path: Path) -> None:
    rows = [row(tick / 10, "pump", "fault", 0.0, ms=10.0) for tick in range(10)]
    rows += [row(1.0, "pump", "fault", None, "no reply"), row(1.0, "pump", "fault", 0.0, ms=488.0)]
    rows += [
        row(2.0, "pump", "fault", None, "not asked: drive is silent"),
        row(2.0, "pump", "fault", 0.0, ms=30),
    ]
    (pump,) = delays(load(record(tmp_path / "it.arrows", rows, {})))
    assert pump.seconds * 1e3 == pytest.approx([10.0] * 10 + [30.0])


def test_missed_values_that_increase_with_motor_speed_are_found(look: Recording) -> None:
    shares = miss_shares(look, "pump")
    assert shares is not None
    slow = shares[1][shares[0] < 28]
    fast = shares[1][shares[0] > 32]
    assert slow.max() == 0
    # half of the values of `fault` are missed, and none of the other register: a quarter of all values
    assert fast == pytest.approx(np.full(len(fast), 0.25), abs=0.02)
    assert miss_shares(look, "fan") is None


def test_the_share_of_missed_values_is_unknown_at_a_constant_frequency(tmp_path: Path) -> None:
    rows = [row(at, "pump", "output_frequency", 50.0) for at in range(50)]
    rows.append(row(50, "pump", "output_frequency", None, "bad checksum"))
    assert miss_shares(load(record(tmp_path / "it.arrows", rows)), "pump") is None


def test_missed_values_are_counted_by_reason(look: Recording) -> None:
    assert reasons_of(look, "pump") == {"bad checksum": 200}
    assert reasons_of(look, "fan") == {"no reply": 1}


def test_rare_reasons_for_missed_values_are_drawn_as_other_reasons(tmp_path: Path) -> None:
    rows = [row(at, "pump", "output_frequency", None, f"reason {at % 8}") for at in range(80)]
    rows += [row(at, "pump", "output_frequency", None, "no reply") for at in range(80)]
    (_, misses) = draw_rates(load(record(tmp_path / "it.arrows", rows))).axes
    names = [text.get_text() for text in misses.get_legend().get_texts()]
    assert (names[0], len(names), names[-1]) == ("no reply", MOST_REASONS + 1, "other reasons")


@pytest.mark.slow
@pytest.mark.usefixtures("_unpainted")
def test_line_utilisation_is_computed_from_a_recording(
    planned: dict[str, Any], turns: list[Row], tmp_path: Path
) -> None:
    look = load(record(tmp_path / "it.arrows", turns, ABOUT | {"planned": planned}))
    (line,) = line_uses(look)
    # Pump: 14 ms from the request to the reply's first character, and 8 ms for the reply's other characters.
    # Fan: 13 ms and 6 ms. Between two exchanges the line is silent: 10 ms if one exchange is with the fan,
    # otherwise 4 ms.
    assert line.needed[1:99] == pytest.approx(np.array([0.029, 0.032] * 49))
    assert line.needed[101:] == pytest.approx(np.full(49, 0.026))
    assert line.utilisation == pytest.approx((50 * 0.029 + 50 * 0.032 + 50 * 0.026) / 9.976, rel=0.01)
    assert line.rate("pump") == pytest.approx(10, rel=0.01)
    assert line.rate("fan") == pytest.approx(5, rel=0.01)
    assert line.cycle == pytest.approx(9.976 * 3 / 250, rel=0.01)  # 3 registers in a cycle; 250 values
    page = report_page(look)
    assert "fan, exchanges/s" in page
    assert re.search(r"bus cycle, ms</td><td[^>]*>70\.0</td><td[^>]*>119\.\d</td>", page)


def test_utilisation_of_a_network_port_is_at_most_1(planned: dict[str, Any], tmp_path: Path) -> None:
    """The port is a network port with a request every 2 ms. On a wire, each exchange would need 32 ms."""
    rows = [row(tick / 500, "fan", "output_current", 1.0, ms=0.5) for tick in range(1000)]
    line_plan = {"hall-1": planned["hall-1"] | {"drives": {"fan": planned["hall-1"]["drives"]["fan"]}}}
    (line,) = line_uses(load(record(tmp_path / "it.arrows", rows, ABOUT | {"planned": line_plan})))
    assert 0.9 < line.utilisation <= 1.0 + 1e-9


def test_utilisation_counts_requests_outside_the_plan(planned: dict[str, Any], tmp_path: Path) -> None:
    """In the first half, two requests read the pump's two registers, although the plan has one request."""
    rows = [
        row(tick / 10 + (0.05 if name == "fault" and tick < 50 else 0), "pump", name, 1.0, ms=14.0)
        for tick in range(100)
        for name in ("output_frequency", "fault")
    ]
    line_plan = {"hall-1": planned["hall-1"] | {"drives": {"pump": planned["hall-1"]["drives"]["pump"]}}}
    (line,) = line_uses(load(record(tmp_path / "it.arrows", rows, ABOUT | {"planned": line_plan})))
    assert line.asked == {"pump": 150}
    assert line.needed == pytest.approx(np.array([0.024] * 100 + [0.026] * 50))
    assert line.cycle == pytest.approx(0.1, rel=0.01)


@pytest.mark.parametrize("wrong", [None, [], "hall", {"hall-1": 7}, {"hall-1": {"drives": {"pump": {}}}}])
def test_an_invalid_plan_in_a_recording_is_ignored(turns: list[Row], tmp_path: Path, wrong: Any) -> None:
    look = load(record(tmp_path / "it.arrows", turns, ABOUT | {"planned": wrong}))
    assert line_uses(look) == []


def test_the_plan_in_a_recording_equals_the_polled_requests(tmp_path: Path) -> None:
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
def test_a_line_whose_registers_have_polling_rates_has_no_bus_cycle(
    planned: dict[str, Any], turns: list[Row], tmp_path: Path
) -> None:
    planned["hall-1"]["drives"]["fan"]["blocks"][0]["every_ms"] = 100
    look = load(record(tmp_path / "it.arrows", turns, ABOUT | {"planned": planned}))
    (line,) = line_uses(look)
    assert line.cycle is None
    assert line.utilisation > 0.4
    assert "bus cycle" not in report_page(look)


def test_utilisation_is_unknown_if_the_plan_lacks_polling_periods(
    planned: dict[str, Any], turns: list[Row], tmp_path: Path
) -> None:
    del planned["hall-1"]["drives"]["fan"]["blocks"][0]["every_ms"]
    look = load(record(tmp_path / "it.arrows", turns, ABOUT | {"planned": planned}))
    assert line_uses(look) == []


@pytest.mark.usefixtures("_unpainted")
@pytest.mark.long
def test_a_line_without_drives_has_no_utilisation(turns: list[Row], tmp_path: Path) -> None:
    line_plan = {"hall-2": {"utilisation": 0.0, "cycle_ms": 0.0, "drives": {}}}
    look = load(record(tmp_path / "it.arrows", turns, ABOUT | {"planned": line_plan}))
    (line,) = line_uses(look)
    assert (line.utilisation, line.cycle) == (0, None)
    assert "hall-2" in report_page(look)
