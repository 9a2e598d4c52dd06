"""The web page shows the newest value of each drive, and its age if it is old."""

from __future__ import annotations

import re
import time
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any

import fake_gateway
import fake_plant
import pytest
from fake_gateway import FakeGateway
from gateways import served
from lines import until as until_here
from watching import LIVE, STALE, Opener, aborting, await_new_value, cell, link, until, until_met

from multidrop.gateway.http.rights import Right

pytestmark = pytest.mark.long

DASH = "\u2013"
OVER = "cell => cell.scrollWidth - cell.clientWidth"
FRESH = "tr.drive td.frequency .value:not(.old)"


@pytest.mark.usefixtures("many_drives")
def test_the_web_page_shows_live_values_of_all_drives(opened: Opener, gateway: FakeGateway) -> None:
    gateway.clocked = "pump-1"  # the frequency of this drive changes with the time
    page = opened()
    assert page.locator("tr.drive").count() == 31
    number = cell(page, "pump-1", "frequency").locator(".number")
    for _ in range(5):
        await_new_value(page, lambda: float(number.inner_text()))
    old = page.locator("tr.drive .old")
    until_met(page, lambda: old.count() == 2)  # two old values: frequency and current of the silent drive


def test_a_killed_gateway_is_reported(opened: Opener, gateway: FakeGateway) -> None:
    page = opened("#/drives/pump-1")
    with page.expect_event("requestfailed", lambda request: request.url.endswith("/api/plant")):
        gateway.kill()
    until(page, STALE)
    assert re.fullmatch(r"\d+ s old", link(page))
    notice = r"The gateway cannot be reached\. The values shown are from (\d+ \w+, )?\d\d:\d\d:\d\d UTC\."
    assert re.fullmatch(notice, page.locator("#notice").inner_text())
    until_met(page, lambda: page.locator(FRESH).count() == 0)
    shown = cell(page, "pump-1", "frequency").inner_text().replace("\n", "")
    assert re.search(r"^\d+\.\d+Hz\d+(\.\d)? s old$", shown)
    assert cell(page, "pump-1", "state").inner_text().strip() == "last: running"
    assert page.locator("#said").inner_text() == "Values are old: no new values arrive."


def test_values_are_marked_as_old_if_the_gateway_hangs(opened: Opener, gateway: FakeGateway) -> None:
    page = opened()
    gateway.is_silent = True
    until(page, STALE)
    assert re.fullmatch(r"\d+ s old", link(page))
    assert "sends no new values" in page.locator("#notice").inner_text()
    gateway.is_silent = False
    until(page, LIVE)
    page.locator("#notice").wait_for(state="hidden")


def test_old_values_stay_old_when_the_clock_of_the_browser_is_set_back(
    opened: Opener, gateway: FakeGateway, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Delay the gateway's answers until the test has ended, because each answer contains the gateway's time.
    monkeypatch.setattr(fake_gateway, "HOLD_S", 120)
    page = opened()
    gateway.is_silent = True
    page.evaluate("(now => { Date.now = () => now() - 3600e3; })(Date.now)")
    until(page, STALE)
    assert "sends no new values" in page.locator("#notice").inner_text()
    age = cell(page, "pump-1", "age")
    until_met(page, lambda: float(age.inner_text().removesuffix(" s")) >= 2)


def test_the_page_shows_live_values_again_after_a_gateway_restart(
    opened: Opener, gateway: FakeGateway
) -> None:
    page = opened()
    gateway.kill()
    until(page, "document.body.classList.contains('dead')")
    again = FakeGateway(gateway.port)  # its messages to the page start at number 1 again
    try:
        until(page, LIVE)
        until_met(page, lambda: page.locator(FRESH).count() == 9)
    finally:
        again.kill()


def test_an_old_value_is_never_shown_as_new(opened: Opener, gateway: FakeGateway) -> None:
    gateway.stuck = {"pump-2": time.time()}
    page = opened("#/drives/pump-2")
    until(
        page,
        """[...document.querySelectorAll('tr.drive')].some(row => row.querySelector('a').title === 'pump-2'
           && row.querySelector('td.frequency .value').classList.contains('old'))""",
    )
    shown = cell(page, "pump-2", "frequency")
    assert re.search(r"\d s old", shown.inner_text())
    style = shown.locator(".value").evaluate(
        "e => [getComputedStyle(e).fontStyle, getComputedStyle(e).color]"
    )
    fresh = cell(page, "pump-1", "frequency").locator(".value")
    assert style[0] == "italic"
    until_met(page, lambda: fresh.evaluate("e => getComputedStyle(e).fontStyle") == "normal")
    until_met(page, lambda: fresh.evaluate("e => getComputedStyle(e).color") != style[1])
    until_met(page, lambda: page.locator(".keys .value.old").count() == 3)
    assert cell(page, "pump-2", "frequency").locator(".bar").is_hidden()


SET_BACK = """([name, register, known]) => import('/page/data/store.js').then(s => {
  const frame = structuredClone(s.store.frame), [value] = frame.drives[name].values[register];
  frame.time = new Date(Date.parse(frame.time) - 3600e3).toISOString();
  if (!known) frame.drives[name].values[register] = [null, 0, 'not asked yet'];
  s.takeFrame(frame);
  const { age, isOld } = s.reading(name, register, s.store.time);
  return [value, age, isOld];
})"""


def test_values_stay_old_when_the_gateways_clock_is_set_back(opened: Opener) -> None:
    page = opened()
    until(page, LIVE)
    value, age, is_old = page.evaluate(SET_BACK, ["labeller", "output_frequency", True])
    assert value is None
    assert 42_000 <= age < 3_000_000
    assert is_old
    until(page, LIVE)
    # as after a restart: the drive has not been polled yet
    value, age, is_old = page.evaluate(SET_BACK, ["labeller", "output_frequency", False])
    assert value is None
    assert is_old
    until(page, LIVE)
    _, age, is_old = page.evaluate(SET_BACK, ["pump-1", "output_frequency", True])
    assert age < 1000
    assert not is_old


def test_the_page_shows_values_as_current_for_the_time_the_gateway_states(
    opened: Opener, gateway: FakeGateway, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Here the gateway reports that values stay current for ten minutes."""
    held = [one | {"holds_s": one["holds_s"] and 600.0} for one in fake_plant.REGISTERS]
    monkeypatch.setattr(fake_plant, "REGISTERS", held)
    gateway.stuck = {"pump-2": time.time() - 20}
    page = opened("#/drives/pump-2")
    until(page, LIVE)
    page.locator(".keys .value:not(.old)").nth(2).wait_for()
    assert page.locator("tr.drive", has_text="pump-2").locator(".value.old").count() == 0


def test_problems_of_the_gateway_are_shown_in_a_notice(opened: Opener, gateway: FakeGateway) -> None:
    gateway.changes = {"troubles": ["history: nothing is recorded: No space left on device", "mqtt: <b>"]}
    page = opened()
    notice = page.locator("#notice")
    notice.wait_for()
    assert notice.inner_text() == "history: nothing is recorded: No space left on device. mqtt: <b>."
    gateway.changes = {}
    notice.wait_for(state="hidden")


def test_a_silent_drive_keeps_its_last_value_with_its_age(opened: Opener) -> None:
    page = opened("#/drives/labeller")
    state = cell(page, "labeller", "state")  # the text may be "last: silent for ..." if the machine is busy
    until_met(page, lambda: state.inner_text().strip().startswith("silent for "))
    assert re.search(r"Hz\d\d s old", cell(page, "labeller", "frequency").inner_text().replace("\n", ""))
    assert "since then: no reply" in cell(page, "labeller", "frequency").locator(".value").get_attribute(
        "title"
    )


def test_unknown_values_are_shown_as_a_dash_and_never_as_zero(opened: Opener, gateway: FakeGateway) -> None:
    rows = {"output_frequency": [None, 0, "no reply"], "output_current": [None, 0, "not asked yet"]}
    drive = {"state": "unknown", "fault": None, "seen": None, "ages_ms": [0], "values": rows}
    gateway.changes = {"drives": {"pump-1": drive}, "lines": {}}
    page = opened("#/drives/pump-1")
    for part in ("frequency", "current", "age", "missed"):
        assert cell(page, "pump-1", part).inner_text().strip() == DASH
    assert cell(page, "pump-2", "frequency").inner_text().strip() == DASH
    assert cell(page, "pump-1", "state").inner_text().strip() == "unknown"
    shown = page.locator(".registers .number")
    until_met(page, lambda: {*shown.all_inner_texts()} == {DASH, "20.0", "4012", "50.0"})  # dash: unknown
    assert page.locator("tr.head .wire").first.inner_text().split() == [
        "wire",
        DASH,
        "used,",
        DASH,
        "planned",
    ]


@pytest.mark.parametrize("off_s", [-90, 90])
def test_a_wrong_clock_of_the_browser_does_not_change_ages_of_values(opened: Opener, off_s: int) -> None:
    wrong = f"const now = Date.now; Date.now = () => now() + {off_s * 1000}"
    page = opened(prepare=lambda page: page.add_init_script(wrong))
    notice = page.locator("#notice")
    notice.wait_for()
    assert re.search(r"clock is (8\d|9\d) s (slow|fast); times", notice.inner_text())
    assert ("slow" in notice.inner_text()) == (off_s < 0)
    until_met(page, lambda: page.locator(FRESH).count() == 9)


def test_times_are_shown_in_utc_or_local_time_as_the_user_chooses(opened: Opener) -> None:
    page = opened(timezone_id="Asia/Kolkata", locale="en-US")
    clock = page.locator("#clock")
    assert re.fullmatch(r"\d\d:\d\d:\d\d UTC", clock.inner_text())
    utc = int(clock.inner_text()[:2]) * 60 + int(clock.inner_text()[3:5])
    page.keyboard.press("u")
    until(page, "document.querySelector('#clock').textContent.endsWith('local')")
    local = int(clock.inner_text()[:2]) * 60 + int(clock.inner_text()[3:5])
    assert (local - utc) % 1440 in (330, 331)
    afternoon = 1764075600  # 2025-11-25 13:00 UTC, 18:30 in Kolkata
    asked = f"[c.ticks([{afternoon}], 3600), c.moment({afternoon}000), c.isUtc()]"
    tick = f"import('/page/ui/clock.js').then(c => {asked})"
    assert page.evaluate(tick)[0] == ["18:30"]
    clock.click()
    ticks, moment, is_utc = page.evaluate(tick)
    assert (ticks, is_utc) == (["13:00"], True)
    assert "13:00:00" in moment
    assert not re.search(r"\b[ap]m\b", page.locator("body").inner_text(), re.IGNORECASE)
    page.keyboard.press("u")
    page.reload()
    # the choice survives a reload of the page
    until(page, "document.querySelector('#clock').textContent.endsWith('local')")


FORBIDDEN = """for (const name of ['sessionStorage', 'localStorage'])
  Object.defineProperty(window, name, { get() { throw new DOMException('forbidden', 'SecurityError'); } })"""


def test_the_page_reloads_itself_if_a_network_change_aborts_its_scripts(opened: Opener) -> None:
    """Chromium aborts all requests if the network changes. In this test, it also forbids storage."""
    broken = []

    def break_two_off(route: Any) -> None:
        if len(broken) < 2:
            broken.append(route.request.url)
            route.abort()
        else:
            route.continue_()

    def prepare(page: Any) -> None:
        page.add_init_script(FORBIDDEN)
        page.route("**/page/data/api.js", break_two_off)

    page = opened(live=False, prepare=prepare)
    page.locator("#link").get_by_text("live", exact=True).wait_for()
    assert len(broken) == 2
    assert page.evaluate("history.state") is None
    assert page.locator("#stopall").is_enabled()


def test_a_page_without_scripts_says_that_stop_all_does_not_work(opened: Opener) -> None:
    page = opened(live=False, prepare=aborting("**/page/data/api.js"))
    page.locator("#notice").get_by_text("Stop all does not work").wait_for()
    assert page.locator("#link.stale").inner_text() == "connecting"
    assert page.locator("#stopall").is_disabled()


def test_a_plot_has_a_gap_where_no_values_were_received(opened: Opener) -> None:
    """The page received no values for an hour, as on a laptop that slept."""
    page = opened()
    seen = page.evaluate("""() => import('/page/data/store.js').then(({ store, takeFrame }) => {
        const ring = store.drives.get('pump-1').pasts.get('output_frequency');
        const later = s => new Date(Date.parse(store.frame.time) + s * 1e3).toISOString();
        const taken = [];
        for (const s of [1, 3600, 1]) {
            const before = ring.count;
            takeFrame({ ...store.frame, time: later(s) });
            taken.push(ring.since(-Infinity)[1].slice(before).map(value => value === null));
        }
        return taken;
    })""")
    assert seen == [[False], [True, False], [False]]


def test_a_plot_of_the_newest_samples_does_not_round_32_bit_counters(opened: Opener) -> None:
    numbers = [2**32 - 1 - at for at in range(100)]
    added = """numbers => import('/page/data/ring.js').then(({ Ring }) => {
        const ring = new Ring(200);
        for (const [ms, number] of numbers.entries()) ring.add(ms, number);
        return ring.since(-Infinity)[1];
    })"""
    assert opened(live=False).evaluate(added, numbers) == numbers


TAKEN_ANEW = """change => import('/page/data/store.js').then(({ store, takePlant }) => {
  window.original ??= store.plant;
  const plant = structuredClone(window.original);
  const drive = plant.lines[0].drives.find(one => one.name === 'pump-1');
  Object.assign(drive, change.drive);
  for (const register of drive.registers) Object.assign(register, change.registers?.[register.name]);
  takePlant(plant);
  const { good, pasts } = store.drives.get('pump-1');
  return ['output_frequency', 'output_current'].map(name => good.has(name) && pasts.has(name));
})"""
KEPT = """import('/page/data/store.js').then(({ store }) => {
  const { good, pasts } = store.drives.get('pump-1');
  return ['output_frequency', 'output_current'].map(name => good.has(name) && pasts.has(name));
})"""


def test_old_values_are_dropped_if_a_drive_or_unit_changes_under_the_same_name(opened: Opener) -> None:
    page = opened("#/drives/pump-1")
    changes: list[tuple[dict[str, Any], list[bool]]] = [
        ({}, [True, True]),
        ({"drive": {"family": "delixi-modbus"}}, [False, False]),
        ({"drive": {"address": 99}}, [False, False]),
        ({"registers": {"output_frequency": {"step": 0.5}}}, [False, True]),
        ({"registers": {"output_current": {"unit": "%"}}}, [True, False]),
    ]
    for change, kept in changes:
        page.evaluate(TAKEN_ANEW, {})
        until_met(page, lambda: page.evaluate(KEPT) == [True, True])
        assert page.evaluate(TAKEN_ANEW, change) == kept, change


def test_a_phone_shows_ages_and_failed_reads_of_each_drive(opened: Opener, gateway: FakeGateway) -> None:
    gateway.renamed["pump-2"] = "a" * 40
    page = opened(size="phone")
    for name in ("pump-1", "conveyor-2", "labeller", "tower-fan-2", "a" * 40):
        check_row_on_a_phone(page, name)
    assert page.evaluate("document.documentElement.scrollWidth") == 390


def check_row_on_a_phone(page: Any, name: str) -> None:
    until(page, LIVE)
    row = page.locator("tr.drive", has=page.get_by_title(name, exact=True))
    parts = ("name", "age", "missed", "state", "frequency")
    title, age, missed, state, frequency = (row.locator(f"td.{one}") for one in parts)
    if name == "labeller":
        until_met(page, lambda: re.fullmatch(r"silent for \d+ s", state.inner_text().strip()))
    else:
        assert age.is_visible()
        assert age.evaluate("td => getComputedStyle(td, '::before').content") == '"age "'
        edges = [one.bounding_box() for one in (title, age, frequency)]
        assert all(left["x"] + left["width"] <= right["x"] for left, right in pairwise(edges))
        assert max(cell.evaluate(OVER) for cell in (title, age, frequency)) <= 0
    share = {"labeller": "100 %", "tower-fan-2": "3.1 %"}.get(name)
    assert missed.is_visible() is (share is not None)
    if share:
        assert missed.inner_text().replace("\n", "") == share


# ---- with a real gateway that polls simulated drives ----


def test_the_web_page_can_stop_a_polled_plant_with_a_token(page: Any, tmp_path: Path) -> None:
    with served(tmp_path) as gateway:
        page.goto(f"http://localhost:{gateway.gateway.port}/")
        until(page, LIVE)
        assert page.locator("tr.drive").count() == 2
        until(page, "document.querySelectorAll('tr.drive.stands').length === 2")
        until_met(page, lambda: cell(page, "pump-1", "frequency").inner_text().strip() == "0.00Hz")
        for view, text in (("lines", "Line time used"), ("faults", "Active: 0"), ("log", "No writes yet.")):
            page.evaluate("view => { location.hash = `#/${view}` }", view)
            page.locator(f"#{view}").get_by_text(text).first.wait_for()
        page.keyboard.press("Shift+S")
        page.get_by_role("button", name="Stop all 2 drives").click()
        page.get_by_label("Token").fill(gateway.secrets[Right.STOP])
        page.get_by_role("button", name="Sign in and send").click()
        page.get_by_role("heading", name="All 2 drives are stopped", exact=True).wait_for()
        until(page, "document.querySelector('#role').textContent === 'may stop'")
        page.keyboard.press("Escape")
        until_here(lambda: gateway.get("/api/audit").json["entries"])
        page.evaluate("location.hash = '#/drives'")
        page.evaluate("location.hash = '#/log'")
        page.locator("#log-list tbody tr").first.wait_for()


def test_the_delay_of_values_does_not_grow_on_a_slow_network(page: Any, tmp_path: Path) -> None:
    """`python -m bench.questions.gateway.page` measures the delay itself."""
    with served(tmp_path, "", *(f"drive-{n}" for n in range(1, 13))) as gateway:
        page.goto(f"http://localhost:{gateway.gateway.port}/")
        until(page, LIVE)
        network = page.context.new_cdp_session(page)
        network.send("Network.enable")
        limits = {"latency": 0, "downloadThroughput": 8000, "uploadThroughput": 8000}
        network.send("Network.emulateNetworkConditions", {"offline": False, **limits})
        look = """import('/page/data/store.js').then(m => [m.store.frame.n, Date.now() - m.store.time])"""
        seen = []
        for _ in range(60):
            seen.append(page.evaluate(look))
            page.wait_for_timeout(100)
        numbers, ages = zip(*seen, strict=True)
        assert len(set(numbers)) > 5
        assert list(numbers) == sorted(numbers)
        until_met(page, lambda: page.evaluate(look)[1] < median(ages[10:30]) + 1000)
        assert gateway.gateway.frames.viewers <= 1
        until(page, LIVE)
