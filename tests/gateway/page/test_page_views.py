"""Each view of the web page: drives, one drive, trends, faults, lines, and the log."""

from __future__ import annotations

import re
import time
from typing import Any
from urllib.parse import parse_qs, urlsplit

import fake_plant
import pytest
from fake_gateway import FakeGateway
from watching import Opener, cell, until, until_met

from multidrop.printable import iso_time

pytestmark = pytest.mark.long

DRAWN = "document.querySelectorAll('#trend-plots canvas').length === 2"


def asked(page: Any) -> list[dict[str, list[str]]]:
    """Return a list to which the query of each later history request is appended."""
    questions: list[dict[str, list[str]]] = []
    page.on(
        "request",
        lambda r: questions.append(parse_qs(urlsplit(r.url).query)) if "/api/history" in r.url else None,
    )
    return questions


def asked_width(questions: list[dict[str, list[str]]]) -> int:
    """Return the width in ms of the time range in the last history request."""
    return int(questions[-1]["to"][0]) - int(questions[-1]["from"][0])


def test_the_filter_finds_drives_by_name_state_and_family(opened: Opener, gateway: FakeGateway) -> None:
    gateway.drive_changes = {"booster-1": {"fault": "undervoltage (UV)"}}
    page = opened()
    shown = page.locator("tr.drive:visible")
    page.keyboard.press("/")
    page.keyboard.type("pump")
    until_met(page, lambda: shown.count() == 4)
    page.get_by_label("Filter drives").fill("UV")
    until_met(page, lambda: shown.locator("td.name").all_inner_texts() == ["booster-1"])
    page.get_by_label("Filter drives").fill("")
    page.get_by_role("button", name=re.compile("Fault, silent")).click()
    names = ["conveyor-2", "labeller", "booster-1"]
    until_met(page, lambda: shown.locator("td.name").all_inner_texts() == names)
    page.get_by_role("button", name=re.compile("^All")).click()
    until_met(page, lambda: shown.count() == 10)


def test_the_filter_hides_lines_without_matches(opened: Opener) -> None:
    page = opened()
    page.get_by_label("Filter drives").fill("labeller")
    until_met(page, lambda: page.locator("tr.head:visible").count() == 1)
    page.get_by_label("Filter drives").fill("no such drive")
    until_met(page, lambda: page.locator("#none").inner_text() == "No drive matches the filter.")
    assert page.locator("#table tbody tr:visible").count() == 0


def test_lines_without_problems_are_collapsed_in_a_large_plant(opened: Opener, gateway: FakeGateway) -> None:
    lines = [line_of_one(n, 50) for n in range(2)]
    for n, line in enumerate(lines):
        line["drives"] = [line["drives"][0] | {"name": f"fan-{n}-{i}"} for i in range(40)]
    one = {"state": "runs", "fault": None, "seen": 0, "ages_ms": [0], "values": {}}
    silent = one | {"state": "silent", "why": "no reply"}
    gateway.plant_changes = {"lines": lines}
    names = [drive["name"] for line in lines for drive in line["drives"]]
    gateway.changes = {"drives": dict.fromkeys(names, one) | {"fan-1-7": silent}}
    page = opened()
    shown = page.locator("tr.drive:visible td.name")
    chosen = page.locator("tr.chosen td.name").all_inner_texts()
    until_met(page, lambda: {*shown.all_inner_texts()} == {*chosen, "fan-1-7"})
    head = page.locator(".linehead").first
    assert "40 drives, 40 running" in head.inner_text()
    head.get_by_role("button").click()
    until_met(page, lambda: shown.count() == 41)
    page.get_by_label("Filter drives").fill("fan-1-3")
    until_met(page, lambda: shown.count() == 11)


def test_frequency_bars_of_all_drives_have_the_same_scale(opened: Opener, gateway: FakeGateway) -> None:
    """Bars of equal frequency have equal length, whatever the maximum frequencies of the drives."""
    gateway.plant_changes = {"lines": [line_of_one(0, 50), line_of_one(1, 320)]}
    rows = {"output_frequency": [41.0, 0], "frequency_setpoint": [48.0, 0]}
    one = {"state": "runs", "fault": None, "seen": 0, "ages_ms": [0], "values": rows}
    gateway.changes = {"drives": {"pump-1": one, "filler-1": one}}
    page = opened()
    head = page.locator("#table th.frequency")
    bars = page.locator("#table .bar:visible")
    styles = "bars => bars.map(bar => [bar.children[0].style.width, bar.children[1].style.left])"
    until_met(page, lambda: bars.evaluate_all(styles) == [["82%", "96%"]] * 2)
    assert head.inner_text().split() == ["full", "bar", "50", "Hz", "Frequency"]
    fast = one | {"values": rows | {"output_frequency": [160.0, 0]}}
    gateway.changes = {"drives": {"pump-1": one, "filler-1": fast}}
    until_met(page, lambda: head.inner_text().split() == ["full", "bar", "200", "Hz", "Frequency"])
    until_met(page, lambda: bars.evaluate_all(styles) == [["20.5%", "24%"], ["80%", "24%"]])


def line_of_one(number: int, most: float) -> dict[str, Any]:
    """Return a line with only its first drive, whose highest setpoint is `most` Hz."""
    line = fake_plant.plant({})["lines"][number]
    drive = line["drives"][0]
    registers = [
        r | ({"most": most} if r["name"] == "frequency_setpoint" else {}) for r in drive["registers"]
    ]
    return line | {"drives": [drive | {"registers": registers}]}


def test_parameters_are_read_when_the_user_asks(opened: Opener, gateway: FakeGateway) -> None:
    row = {"code": "P00.11", "name": "acceleration_time", "value": "10.0 s", "factory": "20.0 s"}
    gateway.parameters = [
        {"state": "reading", "done": 0, "total": 0},
        {"state": "reading", "done": 40, "total": 200},
        {"state": "read", "saved": "2026-11-29T07:00:00Z", "parameters": [row]},
    ]
    page = opened()
    page.get_by_role("link", name="pump-1").click()
    page.get_by_role("button", name="Read all parameters").click()
    page.locator("#parameters", has_text="Read 40 of 200 addresses.").wait_for()
    shown = page.locator("#parameters tbody tr")
    until_met(page, lambda: shown.count() == 1)
    assert shown.inner_text().split() == ["P00.11", "acceleration", "time", "10.0", "s", "20.0", "s"]
    link = page.get_by_role("link", name="Save as CSV").get_attribute("href")
    assert link == "api/parameters/pump-1?format=csv"


def test_motor_speed_in_rpm_is_not_labelled_as_frequency(opened: Opener, gateway: FakeGateway) -> None:
    line = line_of_one(0, 50)
    (drive,) = line["drives"]
    names = {"output_frequency": "motor_speed"}
    registers = [r | {"name": names.get(r["name"], r["name"])} for r in drive["registers"]]
    drive |= {"registers": registers, "key": drive["key"] | {"frequency": "motor_speed"}}
    gateway.plant_changes = {"lines": [line]}
    page = opened()
    page.get_by_role("link", name="pump-1").click()
    page.locator("#panel dt", has_text="Motor speed").wait_for()
    assert page.locator("#panel dt", has_text="Frequency").count() == 0


def resize(page: Any, width: int, height: int) -> None:
    page.set_viewport_size({"width": width, "height": height})


def test_a_long_unit_stays_within_its_table_column(opened: Opener, gateway: FakeGateway) -> None:
    line = fake_plant.plant({})["lines"][0]
    raw = [
        r | {"unit": "raw count", "digits": 3} if r["unit"] == "A" else r
        for r in line["drives"][0]["registers"]
    ]
    gateway.plant_changes = {"lines": [line | {"drives": [d | {"registers": raw} for d in line["drives"]]}]}
    page = opened()
    cells, states = page.locator("#table td.current"), page.locator("#table td.state")
    until_met(page, lambda: "raw count" in cells.first.inner_text())
    wide = "cells => cells.map(cell => cell.scrollWidth - cell.clientWidth)"
    width = "cells => cells.map(cell => cell.clientWidth)"
    for size in ((1440, 900), (1366, 768), (1200, 800), (1181, 800), (820, 1180), (390, 844)):
        resize(page, *size)
        until_met(page, lambda: max(cells.evaluate_all(wide)) <= 0)
        # px; wide enough for the word "overcurrent"
        until_met(page, lambda: min(states.evaluate_all(width)) >= 120)


def test_the_text_about_the_state_of_a_drive_is_not_cut_off(opened: Opener) -> None:
    page = opened()
    words = page.locator("#table .word", has_text="overcurrent in acceleration")
    parts = "([word]) => [word.scrollWidth - word.clientWidth, word.clientHeight]"

    def is_whole() -> bool:
        too_wide, height = words.evaluate_all(parts)
        # The text has at most the height of two lines (px). With a broken word it would need three lines.
        return bool(too_wide <= 0 and height <= 2 * 14 * 1.2 + 1)

    for size in ((1440, 900), (768, 1024), (390, 844)):
        resize(page, *size)
        until_met(page, lambda: words.count() == 1)
        until_met(page, is_whole)  # the page's layout needs a moment after a change of size


def test_the_reason_for_a_lost_port_is_shown_completely(opened: Opener, gateway: FakeGateway) -> None:
    lines = fake_plant.lines()
    why = "could not open port /dev/serial/by-id/usb-FTDI_FT232R_USB_UART-if00: No such file or directory"
    gateway.changes = {"lines": lines | {"hall-3": lines["hall-3"] | {"lost": why}}}
    page = opened()
    head = page.locator("#table .linehead").last
    for size in ((1440, 900), (768, 1024)):
        resize(page, *size)
        until_met(page, lambda: why in head.inner_text())
        until_met(page, lambda: head.evaluate("head => head.scrollWidth - head.clientWidth") <= 0)


def test_problems_are_marked_by_shape_and_word_as_well_as_colour(opened: Opener) -> None:
    page = opened()
    state = cell(page, "conveyor-2", "state")
    assert state.inner_text().strip() == "overcurrent in acceleration"
    assert state.locator("use").get_attribute("href") == "#glyph-fault"
    assert cell(page, "labeller", "state").locator("use").get_attribute("href") == "#glyph-silent"
    silent = page.locator("#strip a").nth(2)
    assert re.fullmatch(r"labeller: no reply, \d+ s", silent.inner_text().strip())
    page.locator("#strip a", has_text="booster-1").click()
    until_met(page, lambda: page.locator("#panel h2").inner_text() == "booster-1")


def test_the_view_of_a_drive_lists_all_registers_with_unit_and_manual_section(opened: Opener) -> None:
    page = opened("#/drives/filler-2")
    rows = page.locator(".registers tbody tr")
    assert rows.count() == 12
    assert "section 7.1, 2001H · setting · 0 to 50 Hz by 0.1" in rows.nth(1).inner_text()
    assert re.search(r"538|53\d|54\d", rows.nth(3).inner_text())
    assert rows.nth(7).locator(".value").inner_text() == "runs (1)"
    assert rows.nth(8).locator(".value").inner_text() == "ready, at setpoint"
    page.get_by_text("50 % within 4.1 ms, 99 % within 6.1 ms").wait_for()
    assert "Missed 4 of 5120 values" in page.locator("#delays").inner_text()
    looked_at = rows.nth(10).locator(".value")  # an unpolled register, which was read just now
    until_met(page, lambda: looked_at.get_attribute("class") == "value")
    # an unpolled register, which was read an hour ago
    assert rows.nth(9).locator(".value").get_attribute("class") == "value old"
    assert page.locator("#plots canvas").count() == 3


def test_dragging_zooms_into_trends_and_escape_zooms_out(opened: Opener) -> None:
    page = opened("#/lines")
    questions = asked(page)
    page.evaluate("location.hash = '#/trends?drive=pump-2'")
    until(page, DRAWN)
    first = questions[-1]
    assert first["series"] == ["pump-2.output_frequency", "pump-2.output_current"]
    width = asked_width(questions)
    assert abs(width - 3600_000) < 1000
    box = page.locator("#trend-plots .u-over").first.bounding_box()
    y = box["y"] + 50
    page.mouse.move(box["x"] + box["width"] * 0.25, y)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] * 0.3, y, steps=4)
    seen = len(questions)
    # waits for two requests, because the page sends one after the other
    until_met(page, lambda: len(questions) > seen + 1)
    page.mouse.move(box["x"] + box["width"] * 0.5, y, steps=4)
    page.mouse.up()
    until_met(page, lambda: abs(asked_width(questions) - width / 4) < width / 50)
    assert abs(int(questions[-1]["from"][0]) - int(first["from"][0]) - width / 4) < width / 50
    page.keyboard.press("Escape")
    until_met(page, lambda: abs(asked_width(questions) - width) < 1000)


def test_trends_can_be_zoomed_and_moved_and_marked_by_keyboard(opened: Opener) -> None:
    page = opened("#/trends?drive=pump-2&from=1764075600000&to=1764079200000")
    until(page, DRAWN)
    span = "25 Nov 2025, 13:00:00 \u2013 25 Nov 2025, 14:00:00 UTC"
    assert page.locator("#span").inner_text() == span
    for name in ("A", "B"):
        page.get_by_role("button", name=f"Marker {name}").focus()
        page.keyboard.press("Enter")
    page.keyboard.press("Shift+ArrowRight")
    table = page.locator("#marks")
    assert "A 13:20:00.000" in table.inner_text()
    assert "B 13:43:00.000" in table.inner_text()
    assert "23 min" in table.inner_text()
    row = table.locator("tbody tr").first.locator("td").all_inner_texts()
    assert abs(float(row[1]) - float(row[0]) - float(row[2])) < 0.011
    page.get_by_role("button", name="Zoom in").press("Enter")
    assert page.locator("#span").inner_text().count(":15:00") == 1
    assert page.locator("#span").inner_text().count(":45:00") == 1


def trigger(name: str, ms: int, *registers: str) -> dict[str, Any]:
    """Return a trigger as in /api/triggers. Its range is from 5 s before to 10 s after its moment `ms`."""
    times = {"time": iso_time(ms), "from": iso_time(ms - 5000), "to": iso_time(ms + 10000)}
    signals = [{"drive": "pump-2", "register": register} for register in registers]
    return {"name": name, "condition": f"pump-2.{registers[0]} > 30", "signals": signals, **times}


WRITTEN = """() => {
window.written = [];
const write = CanvasRenderingContext2D.prototype.fillText;
CanvasRenderingContext2D.prototype.fillText = function (text, x, y) {
  window.written.push([text, x / devicePixelRatio]);
  return write.call(this, text, x, y);
};
}"""


def test_trends_mark_the_moment_of_the_last_trigger(opened: Opener, gateway: FakeGateway) -> None:
    at = 1764075600000
    gateway.triggers = [
        trigger("trip", at, "output_current", "fault"),
        trigger("fast", at - 60_000, "output_frequency"),
    ]
    page = opened("#/lines")
    page.evaluate(WRITTEN)
    questions = asked(page)
    page.evaluate("location.hash = '#/trends'")
    page.locator("#trigger option").nth(2).wait_for(state="attached")
    choice = page.get_by_label("Last trigger")
    assert choice.locator("option").all_inner_texts()[1:] == ["trip, 13:00:00.000", "fast, 12:59:00.000"]
    choice.select_option("trip")
    until_met(page, lambda: questions and questions[-1]["series"] == ["pump-2.output_current"])
    assert (questions[-1]["from"], questions[-1]["to"]) == ([str(at - 5000)], [str(at + 10000)])
    note = "Trigger trip at 13:00:00.000: pump-2.output_current > 30."
    until_met(page, lambda: page.locator("#trend-note").inner_text() == note)
    until(page, "window.written.some(([text]) => text === 'trigger')")
    over, canvas = page.locator("#trend-plots .u-over"), page.locator("#trend-plots canvas")
    left = over.bounding_box()["x"] - canvas.bounding_box()["x"]
    x = page.evaluate("window.written.findLast(([text]) => text === 'trigger')[1]")
    # the mark is 5 s after the start of a range of 15 s
    assert abs(x - 3 - left - over.bounding_box()["width"] / 3) < 1.5
    # the view shows the newest moment of the chosen trigger
    gateway.triggers[0] = trigger("trip", at + 100_000, "output_current")
    until_met(page, lambda: questions[-1]["from"] == [str(at + 95_000)])
    page.get_by_role("button", name="Zoom in").click()
    assert choice.input_value() == ""
    until_met(page, lambda: page.locator("#trend-note").is_hidden())


@pytest.mark.parametrize(
    ("has_history", "sentence"),
    [(False, "No history is kept"), (True, "The history has no values in this time range.")],
    ids=["no history", "a trigger that is older than the history"],
)
def test_a_message_is_shown_if_a_trigger_has_no_recorded_values(
    opened: Opener, gateway: FakeGateway, has_history: bool, sentence: str
) -> None:
    gateway.has_history = has_history
    gateway.recorded["pump-2.output_current"] = {
        "time": [],
        "mean": [],
        "least": [],
        "most": [],
        "missed": [],
    }
    gateway.triggers = [trigger("trip", 1764075600000, "output_current")]
    page = opened("#/trends")
    page.locator("#trigger option").nth(1).wait_for(state="attached")
    page.get_by_label("Last trigger").select_option("trip")
    note = page.locator("#trend-note")
    until_met(page, lambda: note.inner_text().startswith("Trigger trip at 13:00:00.000: "))
    until_met(page, lambda: sentence in note.inner_text())


def test_plot_markers_show_the_last_value_before_the_marked_time(
    opened: Opener, gateway: FakeGateway
) -> None:
    """In a short range, the samples of the two drives have different times."""
    begin = 1764075600000
    for drive, offset in (("pump-1", 0), ("pump-2", 400)):
        times = [begin + offset + 1000 * n for n in range(10) if n < 5 or drive == "pump-1"]
        means: list[float | None] = [20.0 + n for n in range(len(times))]
        gateway.recorded[f"{drive}.output_frequency"] = {
            "time": times, "mean": means, "least": means, "most": means, "missed": [0] * len(times),
        }  # fmt: skip
    page = opened(f"#/trends?drive=pump-1&from={begin}&to={begin + 10000}")
    page.get_by_label("output current, A").uncheck()
    page.get_by_label("pump-2", exact=True).check()
    until(page, "document.querySelectorAll('#trend-plots .plothead .wide').length === 3")
    for name in ("A", "B"):
        page.get_by_role("button", name=f"Marker {name}").click()  # sets markers at 1/3 and 2/3 of the range
    rows = page.locator("#marks tbody tr")
    until_met(page, lambda: rows.count() == 2)
    assert rows.nth(0).locator("td").all_inner_texts()[:2] == ["23.00", "26.00"]
    # at marker B, the last value of pump-2 is more than a second old
    assert rows.nth(1).locator("td").all_inner_texts()[:2] == ["22.00", "\u2013"]
    plot = page.locator("#trend-plots .u-over").first
    box = plot.bounding_box()
    page.mouse.move(box["x"] + box["width"] * 0.3, box["y"] + 20)
    head = page.locator("#trend-plots .plothead").first
    until_met(page, lambda: head.inner_text().count(".00") == 2)


def test_an_unpolled_register_has_no_empty_plot(opened: Opener, gateway: FakeGateway) -> None:
    """The list has no checkbox for an unpolled register, so users could not remove the plot."""
    gateway.plant_changes = {"lines": fake_plant.plant({})["lines"]}
    for line in gateway.plant_changes["lines"]:
        for drive in line["drives"]:
            drive["registers"] = [
                one | ({"period_s": None} if one["name"] == "output_frequency" else {})
                for one in drive["registers"]
            ]
    page = opened("#/trends?drive=pump-1")
    heads = page.locator("#trend-plots .plothead b")
    until_met(page, lambda: heads.all_inner_texts() == ["output current, A"])
    assert page.get_by_label("output frequency, Hz").count() == 0
    page = opened("#/drives/pump-1")
    until_met(page, lambda: "output current, A" in page.locator("#plots .legend").all_inner_texts())
    assert "output frequency, Hz" not in page.locator("#plots .legend").all_inner_texts()


def test_a_date_range_is_refused_if_the_end_is_before_the_start(opened: Opener) -> None:
    page = opened("#/trends?drive=pump-2&from=1764075600000&to=1764079200000")
    until(page, DRAWN)
    page.locator("#span").click()
    begin, end = page.get_by_label("From, UTC"), page.get_by_label("To, UTC")
    assert (begin.input_value()[:16], end.input_value()[:16]) == ("2025-11-25T13:00", "2025-11-25T14:00")
    begin.fill("2025-11-20T08:30:00")
    end.fill("2025-11-20T08:00:00")
    page.get_by_role("button", name="Show", exact=True).click()
    assert page.locator("#ask").evaluate("dialog => dialog.open")
    end.fill("2025-11-20T09:00:00")
    page.get_by_role("button", name="Show", exact=True).click()
    span = "20 Nov 2025, 08:30:00 \u2013 20 Nov 2025, 09:00:00 UTC"
    until_met(page, lambda: page.locator("#span").inner_text() == span)


def test_on_a_phone_several_drives_can_be_plotted_with_different_line_styles(opened: Opener) -> None:
    page = opened("#/trends?drive=pump-2&from=1764075600000&to=1764079200000", size="phone")
    until(page, DRAWN)
    heads = page.locator("#trend-plots .plothead output")
    assert heads.all_inner_texts() == ["", ""]  # a plot of one drive needs no legend
    page.get_by_text("Drives and quantities").click()
    for name in ("pump-1", "filler-1"):
        page.get_by_label(name, exact=True).check()
    page.get_by_text("Drives and quantities").click()
    until_met(page, lambda: heads.first.locator("canvas").count() == 3)
    assert heads.first.inner_text().split() == ["pump-2", "pump-1", "filler-1"]
    marks = "marks => new Set(marks.map(mark => mark.toDataURL())).size"
    assert heads.first.locator("canvas").evaluate_all(marks) == 3
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    plot = page.locator("#trend-plots .plotbox").first
    before = plot.bounding_box()
    plot.hover(position={"x": 200, "y": 40})
    until_met(page, lambda: ":" in heads.first.inner_text())  # time at the cursor, in the plot's legend
    assert plot.bounding_box() == before


# Click one checkbox after the other, because each click draws the list again. Plots follow the last click.
CHECK = """boxes => {
  for (let at = 1; at < 25; at++) document.querySelectorAll(boxes)[at].click();
  return [...document.querySelectorAll(boxes)].map(box => box.checked);
}"""


@pytest.mark.usefixtures("many_drives")
def test_the_number_of_selected_drives_is_limited_to_the_number_of_line_styles(opened: Opener) -> None:
    page = opened("#/trends?drive=pump-1&from=1764075600000&to=1764079200000")
    until(page, DRAWN)
    checked = page.evaluate(CHECK, "#picker [aria-label=Drives] input")
    assert checked == [True] * 24 + [False] * 7


def test_faults_before_the_gateway_start_are_shown_as_unknown(opened: Opener, gateway: FakeGateway) -> None:
    """The gateway started in the middle of the shown hour."""
    page = opened("#/trends?drive=pump-2&from=1764075600000&to=1764079200000")
    lanes = page.locator("#lane .bars")
    until_met(page, lambda: lanes.all_inner_texts() == ["none"] * 2)
    gateway.knows_since = 1764077400000
    page.get_by_role("button", name="Later").click()
    page.get_by_role("button", name="Back to the previous range").click()
    unknown = "unknown: the gateway started later"
    until_met(page, lambda: lanes.all_inner_texts() == [unknown] * 2)
    part = "bars => bars.map(bar => bar.firstChild.offsetWidth / bar.clientWidth)"
    assert all(abs(part - 0.5) < 0.02 for part in lanes.evaluate_all(part))


def test_trends_draw_an_alarm_although_the_clock_was_set_back(opened: Opener, gateway: FakeGateway) -> None:
    """The clock was set back by an hour, so the alarm ended before the shown hour started."""
    start, quarter = fake_plant.ms(time.time()) - 3_600_000, 900_000
    gateway.changes["alarms"] = [
        fake_plant.alarm(start, "pump-2", "overheating", start - 4 * quarter, "fault")
    ]
    page = opened("#/faults")
    page.locator("#faults a", has_text="Trend").click()
    bar = page.locator("#lane .fault", has_text="overheating")
    bar.wait_for()
    assert page.url.endswith(f"from={start - quarter}&to={start + quarter}")
    part = "bar => bar.offsetLeft / bar.parentNode.clientWidth"
    assert float(bar.evaluate(part)) == pytest.approx(0.5, abs=0.02)


def test_a_register_recorded_in_a_second_unit_has_a_second_plot(opened: Opener, gateway: FakeGateway) -> None:
    gateway.recorded = {
        "pump-1.output_current": {"unit": "%", "left_out": ["A", ""]},
        "pump-2.output_current": {"unit": "A", "left_out": []},
    }
    page = opened("#/trends?drive=pump-2&from=1764075600000&to=1764079200000")
    until(page, DRAWN)
    page.get_by_label("pump-1", exact=True).check()
    heads = page.locator("#trend-plots .plothead b")
    wanted = ["output frequency, Hz", "output current, A", "output current, %"]
    until_met(page, lambda: heads.all_inner_texts() == wanted)
    note = "pump-1.output_current was also recorded in A, no unit; that is not drawn."
    assert page.locator("#trend-note").inner_text() == note
    said = page.locator("#trend-plots .plotbox").all()[2].get_attribute("aria-label")
    assert said.startswith("output current. pump-1: ")
    assert " %, last " in said


def test_values_recorded_in_a_previous_unit_are_not_drawn(opened: Opener, gateway: FakeGateway) -> None:
    gateway.recorded = {"pump-2.output_current": {"unit": "%", "left_out": ["A"]}}
    page = opened("#/drives/pump-2")
    page.locator(".panel .ranges button", has_text="1 h").click()
    page.locator("#past-note").get_by_text("pump-2.output_current was also recorded in A").wait_for()
    said = page.locator("#plots .plotbox")
    until_met(page, lambda: "Hz, last" in (said.first.get_attribute("aria-label") or ""))
    assert said.nth(1).get_attribute("aria-label") == "output current: no values"


def test_an_export_contains_the_range_and_drives_of_the_shown_trends(opened: Opener) -> None:
    page = opened("#/trends?drive=pump-2&from=1764075600000&to=1764079200000")
    until(page, DRAWN)
    for name in ("CSV", "Parquet"):
        link = parse_qs(urlsplit(page.get_by_role("link", name=name).get_attribute("href")).query)
        assert link == {
            "series": ["pump-2.output_frequency", "pump-2.output_current"],
            "from": ["1764075600000"], "to": ["1764079200000"], "format": [name.lower()],
        }  # fmt: skip
    with page.expect_download() as download:
        page.get_by_role("link", name="CSV").click()
    assert download.value.suggested_filename == "history.csv"


DOTS = """async values => {
    const { makePlot, line } = await import('/page/ui/plots.js');
    const place = document.body.appendChild(document.createElement('div'));
    const plot = makePlot(place, [values.map((_, i) => 1700000000 + i), values], {
        series: [line(0, 'speed')], height: 150 });
    await new Promise(requestAnimationFrame);
    const canvas = place.querySelector('canvas');
    const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
    let coloured = 0;  // the axes are grey
    for (let i = 0; i < data.length; i += 4) {
        const rgb = data.slice(i, i + 3);
        coloured += data[i + 3] > 200 && Math.max(...rgb) - Math.min(...rgb) > 60;
    }
    plot.destroy();
    place.remove();
    return coloured;
}"""


def test_a_value_between_two_gaps_is_drawn_as_a_dot(opened: Opener) -> None:
    """The plot has ten points a second. The register is read once a second and has three values."""
    page = opened()
    nothing = [None] * 9
    assert page.evaluate(DOTS, [None, *nothing, None, *nothing, None]) == 0
    assert page.evaluate(DOTS, [20, *nothing, 21, *nothing, 20]) > 3 * 9  # pixels


def test_a_rarely_polled_register_has_no_gaps_between_its_values(opened: Opener) -> None:
    """Values arrive every 0.6 s. One is missing, and later none is requested for 3 s."""
    answers = {0: 20.0, 600: 21.0, 1200: None, 1800: 22.0, 4800: 23.0}  # value by time (ms)
    times = list(range(0, 4801, 300))
    mean = [answers.get(at) for at in times]
    told = {
        "time": times, "mean": mean, "least": mean, "most": mean,
        "missed": [int(answers.get(at, 0.0) is None) for at in times], "unit": "Hz", "left_out": [],
    }  # fmt: skip
    page = opened()
    answer = {"step_ms": 300, "series": {"pump-1.output_frequency": told}}
    page.route("**/api/history?*", lambda route: route.fulfill(json=answer))
    drawn = page.evaluate(
        """() => import('/page/data/history.js').then(m => m.read(['pump-1.output_frequency'], 0, 4801, 17))
           .then(told => Object.values(told.series)[0])"""
    )
    gap = list(range(2100, 4501, 300))
    assert drawn["time"] == [0, 600, 1200, 1800, *gap, 4800]
    assert drawn["mean"] == drawn["least"] == [20.0, 21.0, None, 22.0, *(None for _ in gap), 23.0]


def test_numbers_at_an_axis_have_a_decimal_point_and_no_digit_groups(opened: Opener) -> None:
    """In some countries "1,000" means one thousand, in others one."""
    page = opened(locale="de-DE")
    told = page.evaluate("""async () => {
        const { makePlot, line } = await import('/page/ui/plots.js');
        const place = document.body.appendChild(document.createElement('div'));
        const plots = [[12000, 16000], [0.3, 0.9]].map(values =>
            makePlot(place, [[1700000000, 1700000001], values], { series: [line(0, 'speed')], height: 150 }));
        await new Promise(requestAnimationFrame);
        place.remove();
        return plots.map(plot => plot.axes[1]._values);
    }""")
    assert [number for number in told[0] if not number.isdigit()] == []
    assert "0.5" in told[1]


def test_the_page_without_a_history_shows_a_message_and_works(opened: Opener, gateway: FakeGateway) -> None:
    gateway.has_history = False
    asked: list[str] = []
    page = opened("#/drives")
    page.on("request", lambda request: asked.append(request.url))
    page.evaluate("location.hash = '#/trends'")
    page.locator("#trend-note").get_by_text("No history is kept").wait_for()
    page.evaluate("location.hash = '#/drives/pump-1'")
    assert page.locator("#plots canvas").count() == 3
    page.get_by_role("button", name="1 h", exact=True).click()
    page.locator("#past-note").get_by_text("No history is kept").wait_for()
    page.get_by_role("button", name="1 min").click()
    until(page, "document.querySelector('#past-note').hidden")
    # The page must not request the history: the browser would log the answer 404 as an error.
    assert [url for url in asked if "api/history" in url] == []


def test_active_and_ended_faults_are_listed_separately(opened: Opener) -> None:
    page = opened("#/faults")
    page.get_by_text("Active: 3").wait_for()
    lasting = page.locator("#fault-list section").nth(0).locator("tbody tr")
    assert [row.split("\t")[1] for row in lasting.all_inner_texts()] == [
        "conveyor-2",
        "booster-1",
        "labeller",
    ]
    ended = page.locator("#fault-list section").nth(1).locator("tbody tr")
    assert re.search(r"pump-1\s+fault\s+overheating of the heatsink\s+7 min\s", ended.first.inner_text())
    edges = "cells => cells.map(cell => cell.getBoundingClientRect().left)"
    columns = [page.locator(".faults thead").nth(at).locator("th, td").evaluate_all(edges) for at in (0, 1)]
    assert columns[0] == columns[1]
    ended.first.get_by_role("link", name="Trend").click()
    until(page, DRAWN)
    page.locator("#lane .fault", has_text="overheating").wait_for()


def test_the_view_of_lines_shows_utilisation_failed_reads_and_delays(opened: Opener) -> None:
    page = opened("#/lines")
    line = page.locator("article", has=page.get_by_role("heading", name="hall-2"))
    line.wait_for()
    assert "94 %" in line.inner_text()
    assert "Missed in the last hour: 282 of 88800" in line.inner_text()
    rows = line.locator("table").first.locator("tbody tr").all_inner_texts()
    assert rows == ["no reply\t266\t0.3 %", "bad CRC\t16\t< 0.1 %"]
    assert line.locator(".minutes > div").count() == 60
    assert "3 of 5120" in line.locator("tr", has_text="labeller").inner_text()


def test_the_log_view_shows_each_write_with_its_sender_and_result(opened: Opener) -> None:
    page = opened("#/log")
    rows = page.locator("#log-list tbody tr")
    rows.first.wait_for()
    assert rows.count() == 5
    for part in ("pump-1", "frequency_setpoint = 38.0", "the drive holds 38", "anna by page", "01 06 20 01"):
        assert part in rows.first.inner_text()
    assert rows.nth(4).locator(".bad").inner_text().strip() == "unconfirmed; no reply"
    for repeated, drive in ((rows.nth(2), "labeller"), (rows.nth(3), "mixer-2")):
        assert drive in repeated.inner_text()
        written = repeated.locator("td").nth(2).inner_text()  # contains how often the entry was repeated
        assert re.search(r"^stop\s+42 times since .*\d\d:\d\d:\d\d", written)
