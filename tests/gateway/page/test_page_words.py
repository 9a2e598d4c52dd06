"""Words, numbers and marks on the web page: digits, one drive, alarms, and a lost gateway."""

from __future__ import annotations

import re
import struct
import time
from typing import Any

import fake_plant
import pytest
from fake_gateway import FakeGateway
from fake_plant import alarm, lines, ms
from watching import SIZES, Opener, cell, until, until_met, until_settled

pytestmark = pytest.mark.long

MINUTE_MS = 60_000
# Draw a plot of one minute with a tick at its end; return True if a pixel at the right edge is drawn.
EDGE = """async () => {
  const { makePlot, line } = await import("/page/ui/plots.js");
  const place = document.querySelector("#lines");
  place.hidden = false;
  const times = [1764115200, 1764115260];
  const { ctx } = makePlot(place, [times, [1, 2]],
    { series: [line(0, "x")], height: 120, window: () => times });
  await new Promise(done => setTimeout(done, 200));
  const { width, height } = ctx.canvas;
  return [...ctx.getImageData(width - 1, height - 24, 1, 24).data].some(value => value > 0);
}"""

TELL_NUMBERS = """async numbers => {
  const { text } = await import("/page/ui/values.js");
  return numbers.map(([value, digits]) => text(value, { kind: "number", digits }));
}"""


def test_a_number_is_shown_with_the_decimal_places_of_its_register(opened: Opener) -> None:
    # 0.1 as float32, which the core delivers as 0.10000000149011612
    single = struct.unpack(">f", struct.pack(">f", 0.1))[0]
    told = {
        (12.5, 1): "12.5",
        (12.0, 2): "12.00",
        (12.5, None): "12.5",
        (230.0, None): "230",
        (single, None): "0.1",
        (-16777216.0, None): "-16777216",
        (1 / 3, None): "0.333333333333",  # a double
    }
    assert opened().evaluate(TELL_NUMBERS, [list(each) for each in told]) == list(told.values())


def test_plots_and_markers_show_float_values(opened: Opener, gateway: FakeGateway) -> None:
    line = fake_plant.plant({})["lines"][0]
    floats = [r | {"digits": None, "step": None} for r in line["drives"][0]["registers"]]
    gateway.plant_changes = {
        "lines": [line | {"drives": [d | {"registers": floats} for d in line["drives"]]}]
    }
    page = opened("#/trends?drive=pump-2&from=1764075600000&to=1764079200000")
    plot, fraction = page.locator("#trend-plots .plotbox").first, r"\d+\.\d+"
    until_met(page, lambda: re.search(f" {fraction} Hz", plot.get_attribute("aria-label") or "") is not None)
    page.get_by_role("button", name="Marker A").press("Enter")
    cell = page.locator("#marks tbody tr td").first
    until_met(page, lambda: re.fullmatch(fraction, cell.inner_text()) is not None)


def test_numbers_look_old_if_the_gateway_cannot_be_reached(opened: Opener, gateway: FakeGateway) -> None:
    page = opened()
    figures = [page.locator(where).last for where in ("tr.head .wire span", "#chips b", "#strip li")]
    style = "element => getComputedStyle(element).fontStyle"
    assert [figure.evaluate(style) for figure in figures] == ["normal"] * 3
    gateway.kill()
    until(page, "document.body.classList.contains('dead')")
    assert [figure.evaluate(style) for figure in figures] == ["italic"] * 3
    page.evaluate("location.hash = '#/lines'")
    page.locator("#lines").get_by_text("The gateway cannot be reached.", exact=True).wait_for()
    assert "counted yet" not in page.locator("#lines").inner_text()


def test_fault_durations_are_shown_before_the_first_values_arrive(
    opened: Opener, gateway: FakeGateway
) -> None:
    gateway.is_silent = True
    page = opened("#/faults", live=False)
    lasted = page.locator("#faults td").get_by_text("so far").nth(1)
    lasted.wait_for()
    minutes = re.fullmatch(r"(\d+) min so far", lasted.inner_text())
    assert minutes
    assert 87 <= int(minutes[1]) < 120


def test_durations_of_faults_freeze_when_the_gateway_is_lost(opened: Opener, gateway: FakeGateway) -> None:
    page = opened("#/faults")
    lasted = page.locator("#faults td").get_by_text("so far").first
    lasted.wait_for()
    gateway.kill()
    until(page, "document.body.classList.contains('dead')")
    told = []
    for _ in range(2):
        # the page draws durations again after 5 s
        page.evaluate("(now => { Date.now = () => now() + 5100 })(Date.now)")
        page.evaluate("import('/page/views/faults.js').then(m => m.show())")
        told.append(lasted.inner_text())
    assert told[0] == told[1]


def test_a_plant_with_one_drive_is_described_in_the_singular(opened: Opener, gateway: FakeGateway) -> None:
    first = fake_plant.plant({})["lines"][0]
    gateway.plant_changes = {"lines": [first | {"drives": first["drives"][:1]}], "fleet": False}
    gateway.changes = {"alarms": []}
    page = opened()
    until_met(page, lambda: page.locator("#strip").inner_text() == "1 drive, no known fault, none silent.")
    page.locator("#stopall").click()
    assert page.locator("#ask-title").inner_text() == "Stop all drives?"
    page.keyboard.press("Escape")
    page.get_by_role("button", name="Settings").click()
    settings = page.locator("#ask").inner_text()
    assert "You may write 1 register." in settings
    assert "1 to 5" in settings
    page.keyboard.press("Escape")
    page.evaluate("location.hash = '#/lines'")
    page.get_by_text(re.compile("· 1 drive$")).wait_for()


def test_the_alarm_strip_has_the_fault_colour_if_the_fault_is_hidden(
    opened: Opener, gateway: FakeGateway
) -> None:
    now = fake_plant.ms(time.time())
    silent, fault = ({"text": "no reply", "kind": "silent"}, {"text": "undervoltage", "kind": "fault"})
    kinds = zip(("labeller", "screw", "booster-1"), (silent, silent, fault), strict=True)
    gateway.changes = {
        "alarms": [
            {"time": now - age * 1000, "drive": drive, "ended": None, **kind}
            for age, (drive, kind) in enumerate(kinds)
        ]
    }
    page = opened(size="phone")
    page.get_by_role("link", name="and 1 more").wait_for()
    assert page.locator("#strip.bad").count() == 1


def test_the_newest_minute_is_at_the_right_end_of_the_chart(opened: Opener, gateway: FakeGateway) -> None:
    """The chart of a gateway that started two minutes ago has two bars, both at the right end."""
    newest = 1_764_115_200_000  # 00:00 UTC
    minutes = [
        {"time": newest - MINUTE_MS, "asked": 90, "misses": {"no reply": 2}},
        {"time": newest, "asked": 90, "misses": {"no reply": 1}},
    ]
    page = opened()
    told = {"hall-1": {"minutes": minutes, "drives": {}}, "hall-2": {"minutes": [], "drives": {}}}
    page.route("**/api/lines", lambda route: route.fulfill(json=told))
    page.evaluate("location.hash = '#/lines'")
    hour = page.get_by_role("article", name="hall-1")
    hour.get_by_text("Missed in the last hour: 3 of 180").wait_for()
    bars = "bars => bars.map(bar => bar.children.length)"
    assert hour.locator(".minutes > div").evaluate_all(bars) == [0] * 58 + [1, 1]
    assert hour.locator(".ends span").all_inner_texts() == ["23:01 UTC", "at most 2 a minute", "00:00"]
    begun = page.get_by_role("article", name="hall-2")
    assert "No full minute counted yet." in begun.inner_text()


def test_long_names_with_different_ends_are_shown_whole(opened: Opener, gateway: FakeGateway) -> None:
    names = [f"conveyor-of-the-bottling-hall-south-no-{n:02}" for n in (1, 2)]
    gateway.renamed = dict(zip(("pump-1", "pump-2"), names, strict=True))
    page = opened()
    is_whole = "a => a.scrollWidth <= a.clientWidth && a.scrollHeight <= a.clientHeight"
    for width, height in SIZES.values():
        page.set_viewport_size({"width": width, "height": height})
        until_settled(page)
        assert all(page.locator("td.name a", has_text=name).evaluate(is_whole) for name in names)


def test_the_time_label_at_the_end_of_a_plot_is_not_cut_off(opened: Opener) -> None:
    assert opened().evaluate(EDGE) is False


def test_the_age_of_an_old_value_is_shown(opened: Opener) -> None:
    page = opened()
    row = page.locator("#panel tr", has_text="acceleration time")
    until_met(page, lambda: bool(re.fullmatch(r"\d+ min", row.locator(".age").inner_text())))


def test_a_rarely_read_value_is_shown_as_old_if_its_drive_is_silent(
    opened: Opener, gateway: FakeGateway
) -> None:
    """A viewed register may be read only once a minute. Its value stays current while the drive answers."""
    page = opened()
    value = page.locator("#panel tr", has_text="run hours").locator(".value")
    until_met(page, lambda: value.inner_text() == "4012h")
    assert "old" not in str(value.get_attribute("class"))
    page.evaluate("location.hash = '#/drives/labeller'")
    page.locator("#panel h2", has_text="labeller").wait_for()
    page.locator("#panel .value.old", has_text="4012").wait_for()
    page.evaluate("location.hash = '#/drives/pump-1'")
    page.locator("#panel h2", has_text="pump-1").wait_for()
    until_met(page, lambda: (value.inner_text(), value.get_attribute("class")) == ("4012h", "value"))
    gateway.kill()
    page.locator("#panel .value.old", has_text="4012").wait_for()


def test_a_fault_text_ends_with_an_ellipsis_if_its_bar_is_too_short(opened: Opener) -> None:
    page: Any = opened("#/trends?drive=pump-1")
    bar = page.locator(".lane .fault")
    bar.wait_for()
    assert bar.evaluate("bar => [bar.scrollWidth > bar.clientWidth, getComputedStyle(bar).textOverflow]") == [
        True,
        "ellipsis",
    ]


# ---- alarms on the page: order, one alarm per lost port, and acknowledgements with their senders ----


NOW = time.time()
SEEN = {"acknowledged": ms(NOW), "by": "anna", "note": "fuse"}
ALARMS = [
    alarm(ms(NOW - 240), "conveyor-2", "overcurrent while accelerating", None, "fault"),
    alarm(ms(NOW - 90), "pump-4", "the motor stopped, and no stop was called here", None, "stopped"),
    alarm(ms(NOW - 20), "", "there is no such port", None, "port", "hall-4"),
    alarm(ms(NOW - 10), "labeller", "no reply", None, "silent", is_before=True),
    alarm(
        ms(NOW - 9), "booster-1", "undervoltage", None, "fault", acknowledged=ms(NOW), by="anna", note="fuse"
    ),
]


@pytest.fixture
def alarmed(gateway: FakeGateway) -> FakeGateway:
    gateway.changes = {"alarms": ALARMS}
    return gateway


def strip(page: Any) -> list[str]:
    page.locator("#strip a").nth(4).wait_for()
    found: list[str] = page.locator("#strip a").all_inner_texts()
    return [text.split(":")[0] for text in found]


def test_alarms_are_listed_by_severity_and_acknowledged_ones_last(
    opened: Opener, alarmed: FakeGateway
) -> None:
    page = opened("#/faults")
    wanted = ["conveyor-2", "pump-4", "line hall-4", "labeller", "booster-1"]
    assert strip(page) == wanted
    rows = page.locator("#fault-list section").first.locator("tbody tr")
    until_met(page, lambda: rows.count() == 5)
    assert rows.locator(".who").all_inner_texts() == wanted
    kinds = ["fault", "stopped by itself", "line lost", "silent", "fault"]
    assert [kind.strip() for kind in rows.locator(".kind").all_inner_texts()] == kinds
    assert page.locator("#count").inner_text() == "4"  # alarms that are not acknowledged
    assert "acknowledged" in rows.last.inner_text()
    assert "by anna: fuse" in rows.last.inner_text()
    assert rows.last.get_by_role("button").count() == 0
    assert "before" in rows.nth(3).inner_text()
    assert "since before" in page.locator("#strip").inner_text()


def test_an_alarm_is_acknowledged_with_a_note(opened: Opener, alarmed: FakeGateway) -> None:
    page = opened("#/faults")
    page.get_by_role("button", name="Acknowledge").first.click()
    assert "conveyor-2: overcurrent while accelerating" in page.locator("#ask").inner_text()
    page.get_by_label("Note (optional)").fill(" belt stuck ")
    page.get_by_role("button", name="Acknowledge").last.click()
    until_met(page, lambda: alarmed.posts)
    assert alarmed.posts == [("/api/acknowledge", {"alarm": ALARMS[0]["id"], "note": "belt stuck"})]
    alarmed.has_no_alarm = True
    page.get_by_role("button", name="Acknowledge").first.click()
    page.get_by_role("button", name="Acknowledge").last.click()
    page.get_by_role("heading", name="The alarm was not acknowledged").wait_for()
    assert "there is no such alarm" in page.locator("#ask").inner_text()


def test_a_warning_is_shown_for_many_failed_reads_but_not_for_one(
    opened: Opener, gateway: FakeGateway
) -> None:
    gateway.drive_changes = {"pump-1": {"missed": 0.0003}, "pump-2": {"missed": 0.05}}
    gateway.changes = {"lines": {name: line | {"misses": 1} for name, line in lines().items()}}
    page = opened()
    until_met(page, lambda: cell(page, "pump-1", "missed").inner_text() == "< 0.1 %")
    assert "warn" not in (cell(page, "pump-1", "missed").get_attribute("class") or "")
    assert "warn" in (cell(page, "pump-2", "missed").get_attribute("class") or "")
    assert page.locator(".linehead").first.inner_text().endswith("1 missed in the last minute")
    assert page.locator(".linehead .warn").count() == 0
    gateway.changes = {"lines": {name: line | {"misses": 600} for name, line in lines().items()}}
    page.locator(".linehead .warn").first.wait_for()


def test_a_drive_at_0_hz_in_unknown_state_is_shown_as_at_rest(opened: Opener, gateway: FakeGateway) -> None:
    why = "the outputs are not programmed"
    gateway.drive_changes = {name: {"state": "unknown", "note": why} for name in ("pump-4", "pump-1")}
    page = opened("#/drives/pump-4")
    until_met(page, lambda: cell(page, "pump-4", "state").inner_text().strip() == "at rest: 0 Hz")
    until_met(page, lambda: cell(page, "pump-1", "state").inner_text().strip() == "unknown")
    assert why in page.locator("#panel").inner_text()
    assert page.locator("button[data-show=bad] b").inner_text() == "4"
    page.locator("button[data-show=stands]").click()
    assert cell(page, "pump-4", "state").is_visible()
    assert not cell(page, "pump-1", "state").is_visible()
