"""Writes and reloads through the web page: the user confirms each, and its result is shown."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest
from fake_gateway import FakeGateway
from gateways import served
from watching import LIVE, Opener, await_title, center, press_enter, until, until_met, until_still

from multidrop.gateway.http.rights import Right

pytestmark = pytest.mark.long

# Moves the confirming button of the next dialogs to this point.
CONFIRMED_AT = """([x, y]) => new MutationObserver(() => {
  const yes = document.querySelector('#ask button.danger');
  const place = { position: 'fixed', left: `${x - 20}px`, top: `${y - 20}px`, width: '40px', height: '40px' };
  if (yes) Object.assign(yes.style, place);
}).observe(document.querySelector('#ask'), { childList: true })"""


def test_a_write_is_sent_once_if_the_user_double_clicks(opened: Opener, gateway: FakeGateway) -> None:
    page = opened("#/drives/pump-1")
    # the plant file allows writes to one register
    assert page.get_by_role("button", name="Change").count() == 1
    page.get_by_role("button", name="Change frequency setpoint").click()
    assert page.locator("#ask-title").inner_text() == "Change frequency setpoint of pump-1?"
    assert "frequency setpoint is 20.0 Hz. Allowed: from 0 to 50 Hz." in page.locator("#ask").inner_text()
    page.get_by_label("New value, Hz").fill("31.5")
    page.get_by_role("button", name="Write to pump-1").dblclick()
    page.locator("#outcomes li").wait_for()
    assert gateway.posts == [
        ("/api/write", {"drive": "pump-1", "register": "frequency_setpoint", "value": 31.5})
    ]
    assert page.evaluate("location.hash") == "#/drives/pump-1"
    assert "frequency setpoint = 31.5 Hz: held by the drive" in page.locator("#outcomes").inner_text()


def test_the_result_of_a_write_is_shown_in_the_gateways_words(opened: Opener, gateway: FakeGateway) -> None:
    gateway.outcomes = {"pump-1": {"done": False, "text": "the drive took 30.0 Hz instead"}}
    page = opened("#/drives/pump-1")
    page.get_by_role("button", name="Change frequency setpoint").click()
    page.get_by_label("New value, Hz").fill("31.5")
    press_enter(page)
    assert "bad" in page.locator("#outcomes li").get_attribute("class")
    assert "the drive took 30.0 Hz instead" in page.locator("#outcomes").inner_text()


def test_the_page_does_not_repeat_an_unanswered_command(opened: Opener, gateway: FakeGateway) -> None:
    page = opened("#/drives/pump-1")
    page.route("**/api/act", lambda route: route.abort())
    page.get_by_role("button", name="start").click()
    page.get_by_role("button", name="start pump-1").click()
    assert "The outcome is unknown." in page.locator("#outcomes li").inner_text()
    assert gateway.posts == []


CUT_SHORT = '{"done": tr'


def test_a_command_with_a_truncated_answer_is_shown_as_unknown(opened: Opener, gateway: FakeGateway) -> None:
    page = opened("#/drives/pump-1")
    page.route("**/api/act", lambda route: route.fulfill(status=200, body=CUT_SHORT))
    page.route("**/api/audit*", lambda route: route.fulfill(status=200, body=CUT_SHORT))
    page.get_by_role("button", name="start").click()
    page.get_by_role("button", name="start pump-1").click()
    outcome = page.locator("#outcomes li").inner_text()
    assert "The gateway's answer was cut off." in outcome
    assert "The outcome is unknown." in outcome
    page.locator("#writes").get_by_text("The gateway's answer was cut off.").wait_for()


def test_the_enter_key_does_not_confirm_the_start_of_a_motor(opened: Opener, gateway: FakeGateway) -> None:
    page = opened("#/drives/pump-1")
    page.get_by_role("button", name="start").click()
    assert page.locator("#ask-title").inner_text() == "start: pump-1?"
    assert "The motor will turn." in page.locator("#ask").inner_text()
    press_enter(page)
    assert gateway.posts == []
    page.get_by_role("button", name="start").click()
    page.get_by_role("button", name="start pump-1").click()
    page.locator("#outcomes li").wait_for()
    assert gateway.posts == [("/api/act", {"drive": "pump-1", "verb": "start", "options": {}})]


def test_pressing_enter_in_an_unchanged_dialog_writes_no_value(opened: Opener, gateway: FakeGateway) -> None:
    page = opened("#/drives/pump-1")
    page.get_by_role("button", name="Change frequency setpoint").click()
    page.keyboard.press("Enter")
    assert page.locator("#ask").evaluate("dialog => dialog.open")
    assert gateway.posts == []


def test_a_held_key_counts_as_one_press(opened: Opener, gateway: FakeGateway) -> None:
    page = opened("#/drives/pump-1")
    change = page.get_by_role("button", name="Change frequency setpoint")
    change.click()
    page.get_by_label("New value, Hz").fill("31.5")
    for _ in range(9):
        page.keyboard.down("Enter")  # the first press and eight automatic repetitions
    page.keyboard.up("Enter")
    page.locator("#outcomes li").wait_for()
    assert len(gateway.posts) == 1
    assert not page.locator("#ask").evaluate("dialog => dialog.open")
    change.press("Enter")  # a new press is accepted immediately
    assert page.locator("#ask").evaluate("dialog => dialog.open")


@pytest.mark.parametrize("size", ["desk", "phone"])
def test_a_double_click_on_start_does_not_confirm_the_dialog(
    opened: Opener, gateway: FakeGateway, size: str
) -> None:
    """The confirming button of the dialog covers the start button, as on a scrolled phone."""
    page = opened("#/drives/pump-1", size)
    until_still(page)
    start = page.get_by_role("button", name="start", exact=True)
    start.scroll_into_view_if_needed()
    x, y = center(start)
    page.evaluate(CONFIRMED_AT, [x, y])
    start.dblclick()
    assert page.locator("#ask").evaluate("dialog => dialog.open")
    assert gateway.posts == []
    page.wait_for_timeout(600)  # so that the next click is not part of a double click
    page.mouse.click(x, y)
    page.locator("#outcomes li").wait_for()
    assert gateway.posts == [("/api/act", {"drive": "pump-1", "verb": "start", "options": {}})]


def tap(page: Any, x: float, y: float, made_s: float) -> None:
    """Send a tap to the page with the time stamp `made_s`, as if it had waited in a queue since then."""
    session = page.context.new_cdp_session(page)
    for kind, points in (("touchStart", [{"x": x, "y": y}]), ("touchEnd", [])):
        touch = {"type": kind, "touchPoints": points, "timestamp": made_s}
        session.send("Input.dispatchTouchEvent", touch)
    session.detach()


SLOW_S = 1.0
SLOW_AT_CLICKS = f"""button => button.addEventListener('click', () => {{
  const end = performance.now() + {SLOW_S * 1000};
  while (performance.now() < end);
}})"""


@pytest.mark.parametrize(("slows", "later_s"), [(False, 0.2), (True, 0.9)], ids=["at once", "on a slow page"])
def test_a_second_tap_on_start_does_not_confirm_the_dialog(
    opened: Opener, gateway: FakeGateway, slows: bool, later_s: float
) -> None:
    """On a slow page, the second tap waits in the browser's queue until the dialog is drawn."""
    page = opened("#/drives/pump-1", "phone", has_touch=True)
    until_still(page)
    start = page.get_by_role("button", name="start", exact=True)
    start.scroll_into_view_if_needed()
    if slows:
        start.evaluate(SLOW_AT_CLICKS)
    x, y = center(start)
    page.evaluate(CONFIRMED_AT, [x, y])
    made_s = time.time()
    tap(page, x, y, made_s)
    tap(page, x, y, made_s + later_s)
    assert page.locator("#ask").evaluate("dialog => dialog.open")
    assert gateway.posts == []
    page.wait_for_timeout(600)  # so that the next tap is not part of a double tap
    tap(page, x, y, time.time())
    page.locator("#outcomes li").wait_for()
    assert gateway.posts == [("/api/act", {"drive": "pump-1", "verb": "start", "options": {}})]


def press(page: Any, key: str, made_s: float, text: str = "") -> None:
    """Send a key press to the page with the time stamp `made_s`."""
    session = page.context.new_cdp_session(page)
    code = {"Enter": 13, "Tab": 9, " ": 32}[key]
    named = {"key": key, "code": "Space" if key == " " else key, "windowsVirtualKeyCode": code}
    for kind in ("keyDown", "keyUp"):
        typed = {"text": text} if text and kind == "keyDown" else {}
        session.send("Input.dispatchKeyEvent", {"type": kind, "timestamp": made_s, **named, **typed})
    session.detach()


@pytest.mark.parametrize(("key", "text"), [("Enter", "\r"), (" ", " ")], ids=["Enter", "Space"])
def test_keys_pressed_before_a_dialog_is_visible_do_not_confirm_the_dialog(
    opened: Opener, gateway: FakeGateway, key: str, text: str
) -> None:
    """On a slow page, Tab and Enter could otherwise confirm a dialog before the user has seen it."""
    page = opened("#/drives/pump-1")
    until_still(page)
    start = page.get_by_role("button", name="start", exact=True)
    start.evaluate(SLOW_AT_CLICKS)
    start.focus()
    made_s = time.time()
    press(page, key, made_s, text)
    assert page.locator("#ask").evaluate("dialog => dialog.open")
    press(page, "Tab", made_s + 0.3)
    press(page, key, made_s + 0.6, text)
    assert page.locator("#ask").evaluate("dialog => dialog.open")
    assert gateway.posts == []
    page.wait_for_timeout(600)  # until the dialog is drawn
    press(page, key, time.time(), text)
    page.locator("#outcomes li").wait_for()
    assert gateway.posts == [("/api/act", {"drive": "pump-1", "verb": "start", "options": {}})]


def test_a_confirmed_command_contains_the_newest_message_number(opened: Opener, gateway: FakeGateway) -> None:
    page = opened("#/drives/pump-1")
    newest = "import('/page/data/store.js').then(m => m.store.frame.n)"
    page.get_by_role("button", name="start").click()
    asked = page.evaluate(newest)
    until_met(page, lambda: page.evaluate(newest) > asked + 5)
    before = page.evaluate(newest)
    page.get_by_role("button", name="start pump-1").click()
    page.locator("#outcomes li").wait_for()
    assert before <= gateway.seen[0] <= page.evaluate(newest)


@pytest.mark.parametrize("event", ["a stop", "a reload"])
def test_a_start_is_not_sent_after_a_stop_or_reload_during_its_dialog(
    opened: Opener, gateway: FakeGateway, event: str
) -> None:
    """After a reload, the name in the dialog may mean another drive."""
    page = opened("#/drives/pump-1")
    page.get_by_role("button", name="start", exact=True).click()
    if event == "a stop":
        gateway.stops = {"pump-1": 1}
        until(page, "import('/page/data/store.js').then(m => m.stops('pump-1') === 1)")
    else:
        gateway.changes = gateway.plant_changes = {"revision": 2}
        until(page, "import('/page/data/store.js').then(m => m.store.plant.revision === 2)")
    page.get_by_role("button", name="start pump-1").click()
    page.locator("#outcomes li").wait_for()
    why = "drive was stopped" if event == "a stop" else "plant file was reloaded"
    said = page.locator("#outcomes").inner_text()
    assert f"start: not sent. The {why} in the meantime." in said
    assert gateway.posts == []
    page.get_by_role("button", name="start", exact=True).click()
    page.get_by_role("button", name="start pump-1").click()
    until_met(page, lambda: gateway.posts)


def test_an_emergency_stop_is_sent_although_another_stop_came_before(
    opened: Opener, gateway: FakeGateway
) -> None:
    page = opened("#/drives/pump-1")
    page.get_by_role("button", name="emergency stop").click()
    gateway.stops = {"pump-1": 1}
    until(page, "import('/page/data/store.js').then(m => m.stops('pump-1') === 1)")
    page.get_by_role("button", name="emergency stop pump-1").click()
    until_met(page, lambda: gateway.posts)
    body = {"drive": "pump-1", "verb": "emergency_stop", "options": {}}
    assert gateway.posts == [("/api/act", body)]
    assert gateway.seen == []


def test_no_button_moves_when_values_grow_old(opened: Opener, gateway: FakeGateway) -> None:
    page = opened("#/drives/pump-1")
    start = page.get_by_role("button", name="start", exact=True)
    before = start.bounding_box()
    gateway.stuck["pump-1"] = time.time()
    page.locator(".keys .dated", has_text="old").first.wait_for()
    assert start.bounding_box() == before


def test_the_page_has_no_buttons_for_forbidden_commands(opened: Opener) -> None:
    page = opened("#/drives/pump-2")
    page.locator(".registers").wait_for()
    assert page.locator(".verbs button, .change").count() == 0
    assert page.get_by_role("button", name="Stop pump-2").is_visible()


def test_the_dialog_set_frequency_checks_the_input(opened: Opener, gateway: FakeGateway) -> None:
    gateway.maximum_hz = 45.0
    page = opened("#/drives/pump-1")
    page.locator(".registers tr", has_text="maximum frequency").get_by_text("45.0").wait_for()
    page.get_by_role("button", name="set frequency", exact=True).click()
    asked = page.locator("#ask").inner_text()
    assert "frequency setpoint is 20.0 Hz. Allowed: from 0 to 45 Hz." in asked
    for value in ("", "-1", "45.5", "500"):
        page.locator("#new-value").fill(value)
        page.get_by_role("button", name="set frequency pump-1").click()
        assert page.locator("#ask").evaluate("dialog => dialog.open"), value
    assert gateway.posts == []
    page.locator("#new-value").fill("45")
    page.get_by_role("button", name="set frequency pump-1").click()
    page.locator("#outcomes li").wait_for()
    assert gateway.posts == [
        ("/api/act", {"drive": "pump-1", "verb": "set_frequency", "options": {"hz": 45}})
    ]


def test_a_value_above_the_maximum_frequency_is_not_sent(opened: Opener, gateway: FakeGateway) -> None:
    gateway.maximum_hz = 45.0
    page = opened("#/drives/pump-1")
    page.locator(".registers tr", has_text="maximum frequency").get_by_text("45.0").wait_for()
    page.get_by_role("button", name="Change frequency setpoint").click()
    assert "frequency setpoint is 20.0 Hz. Allowed: from 0 to 45 Hz." in page.locator("#ask").inner_text()
    for value in ("45.1", "-1", ""):
        page.get_by_label("New value, Hz").fill(value)
        page.get_by_role("button", name="Write to pump-1").click()
        assert page.locator("#ask").evaluate("dialog => dialog.open"), value
    page.keyboard.press("Escape")
    assert gateway.posts == []


# ---- reload of the plant file by a writer, and the list of all mistakes in it ----


READ_AGAIN = "Reload the plant file"


def tab_to(page: Any, name: str) -> None:
    """Press Tab until the button of this name has the focus."""
    for _ in range(30):
        page.keyboard.press("Tab")
        if page.evaluate("document.activeElement.textContent") == name:
            return
    raise AssertionError(f"no way to {name}")


def test_mistakes_are_shown_after_a_reload_by_keyboard(opened: Opener, gateway: FakeGateway) -> None:
    mistakes = [f"plant.toml: [[line]] {n}: port is missing" for n in range(30)]
    text = "the previous plant stays in use: the file has mistakes"
    gateway.reloaded = {"done": False, "text": text, "mistakes": mistakes, "restart": []}
    page = opened()
    page.locator("#more").focus()
    press_enter(page)
    tab_to(page, READ_AGAIN)
    press_enter(page)
    await_title(page, "Reload bottling plant.toml?")
    press_enter(page)  # presses Cancel, which has the focus
    assert gateway.posts == []
    page.locator("#more").focus()
    press_enter(page)
    tab_to(page, READ_AGAIN)
    press_enter(page)
    tab_to(page, "Reload bottling plant.toml")
    press_enter(page)
    await_title(page, "The file has 30 mistakes")
    assert page.locator("#ask .outcome li").all_inner_texts() == mistakes
    tab_to(page, "".join(mistakes))
    page.keyboard.press("End")
    until(page, "document.querySelector('#ask .outcome').scrollTop > 0")
    assert gateway.posts == [("/api/reload", {"confirm": True})]


def test_the_page_offers_no_reload_without_a_plant_file_or_write_role(
    opened: Opener, gateway: FakeGateway
) -> None:
    for changed in ({"file": False}, {"may": {"role": "stop", "write": [], "verbs": []}}):
        gateway.plant_changes = changed
        page = opened()
        page.locator("#more").click()
        await_title(page, "Settings")
        assert page.get_by_role("button", name=READ_AGAIN).count() == 0


def test_reload_refuses_a_broken_plant_file_and_accepts_a_valid_one(page: Any, tmp_path: Path) -> None:
    with served(tmp_path) as gateway:
        path = gateway.gateway.plant.path
        good = path.read_text()
        page.goto(f"http://localhost:{gateway.gateway.port}/")
        until(page, LIVE)
        page.locator("#more").click()
        page.get_by_role("button", name="Enter a token").click()
        page.get_by_label("Token").fill(gateway.secrets[Right.WRITE])
        page.get_by_role("button", name="Sign in").click()
        until(page, "document.querySelector('#role').textContent === 'may write'")

        def read() -> None:
            page.locator("#more").click()
            page.get_by_role("button", name=READ_AGAIN).click()
            page.get_by_role("button", name="Reload plant.toml").click()

        path.write_text(good.replace('"invt-che"', '"invt-chf"').replace("= 38400", '= "fast"'))
        read()
        await_title(page, "The file has 3 mistakes")
        shown = page.locator("#ask .outcome li").all_inner_texts()
        assert shown == list(gateway.gateway.reload.mistakes)
        page.keyboard.press("Escape")
        notice = page.locator("#notice").get_by_text(
            "The plant file has 3 mistakes; the previous plant stays in use."
        )
        notice.wait_for()
        assert page.locator("tr.drive").count() == 2
        until(page, LIVE)

        path.write_text(good.replace('name = "pump-2"', 'name = "fan-2"') + "[serve.history]\n")
        read()
        await_title(page, "plant.toml is in effect")
        assert page.locator("#ask .outcome li").all_inner_texts() == list(gateway.gateway.reload.restart)
        page.keyboard.press("Escape")
        # exact, because an alarm also links to fan-2
        page.get_by_role("link", name="fan-2", exact=True).wait_for()
        notice.wait_for(state="hidden")
