"""The button "Stop all" of the web page: it never moves, asks one question, and sends immediately."""

from __future__ import annotations

import threading
from functools import partial
from typing import Any

import fake_gateway
import pytest
from fake_gateway import FakeGateway
from watching import (
    AT_ITS_PLACE,
    LIVE,
    PATIENCE_S,
    SIZES,
    VIEWS,
    Opener,
    aborting,
    await_new_value,
    await_title,
    center,
    press_enter,
    stop_all,
    until,
    until_met,
    until_settled,
)

from multidrop.control.stops import LEAST_S

pytestmark = pytest.mark.long


def title(page: Any) -> Any:
    return page.locator("#ask-title")


def test_the_stop_all_button_is_always_at_the_same_place_and_never_covered(opened: Opener) -> None:
    page = opened()
    for size, (wide, high) in SIZES.items():
        page.set_viewport_size({"width": wide, "height": high})
        places = set()
        for view in VIEWS:
            page.evaluate("view => { location.hash = view }", view)
            until_settled(page)
            seen, *place = page.evaluate(AT_ITS_PLACE)
            assert seen, (size, view)
            places.add(tuple(place))
        assert len(places) == 1
        x, y, width, height = places.pop()
        assert min(width, height) >= (30 if size == "desk" else 40)
        assert 0 <= x <= x + width <= wide
        assert 0 <= y <= y + height <= high


def test_the_stop_all_button_works_on_a_phone_in_the_view_of_a_drive(
    opened: Opener, gateway: FakeGateway
) -> None:
    page = opened("#/drives/filler-2", "phone", has_touch=True)
    page.locator("#panel.open h2").wait_for()
    page.locator("#stopall").tap()
    assert title(page).inner_text() == "Stop all 10 drives?"
    page.get_by_role("button", name="Stop all 10 drives").tap()
    await_title(page, "All 10 drives are stopped")
    assert gateway.posts == [("/api/stop", {"drives": None})]


def test_one_drive_can_be_stopped_by_keyboard_alone(opened: Opener, gateway: FakeGateway) -> None:
    page = opened()
    for _ in range(40):
        page.keyboard.press("Tab")
        if page.evaluate("document.activeElement.closest('tr.drive') !== null"):
            break
    page.keyboard.press("ArrowDown")
    page.keyboard.press("s")
    assert title(page).inner_text() == "Stop pump-2?"
    press_enter(page)  # presses Cancel, which has the focus
    assert gateway.posts == []
    page.keyboard.press("s")
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    await_title(page, "The drive is stopped")
    assert gateway.posts == [("/api/stop", {"drives": ["pump-2"]})]
    page.keyboard.press("Escape")
    assert not page.locator("#ask").evaluate("dialog => dialog.open")


def test_all_drives_can_be_stopped_by_keyboard_alone(opened: Opener, gateway: FakeGateway) -> None:
    page = opened("#/log")
    page.keyboard.press("Shift+S")
    press_enter(page)
    assert gateway.posts == []
    page.keyboard.press("Shift+S")
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    await_title(page, "All 10 drives are stopped")
    assert gateway.posts == [("/api/stop", {"drives": None})]


def test_the_stop_key_works_as_soon_as_a_dialog_is_closed(opened: Opener) -> None:
    """The browser takes some milliseconds to move the focus out of a closed dialog."""
    page = opened()
    page.keyboard.press("Shift+S")
    assert title(page).inner_text() == "Stop all 10 drives?"
    assert page.evaluate("""() => {
        const key = { key: 'S', shiftKey: true, bubbles: true };
        document.activeElement.click();
        const isClosed = !document.querySelector('#ask').open;
        document.activeElement.dispatchEvent(new KeyboardEvent('keydown', key));
        return isClosed && document.querySelector('#ask').open;
    }""")


def test_the_stop_all_button_accepts_a_click_right_after_a_dialog_closed(
    opened: Opener, gateway: FakeGateway
) -> None:
    """Even the second click of a double click is accepted, because it only opens the question."""
    page = opened("#/drives/pump-1")
    x, y = center(page.locator("#stopall"))
    page.get_by_role("button", name="start", exact=True).click()
    page.evaluate(
        """([x, y]) => Object.assign(document.querySelector('#ask button.calm').style, {
            position: 'fixed', left: `${x - 20}px`, top: `${y - 20}px`, width: '40px', height: '40px' })""",
        [x, y],
    )
    # the first click hits Cancel, and the second hits Stop all, which is behind the dialog
    page.mouse.dblclick(x, y)
    assert title(page).inner_text() == "Stop all 10 drives?"
    assert gateway.posts == []


def test_the_stop_all_button_works_while_another_dialog_is_open(opened: Opener, gateway: FakeGateway) -> None:
    page = opened("#/drives/pump-1")
    x, y = center(page.locator("#stopall"))
    page.get_by_role("button", name="Change frequency setpoint").click()
    page.mouse.click(x, y)
    assert title(page).inner_text() == "Stop all 10 drives?"
    page.get_by_role("button", name="Stop all 10 drives").click()
    await_title(page, "All 10 drives are stopped")
    assert gateway.posts == [("/api/stop", {"drives": None})]


def test_the_result_of_a_stop_does_not_replace_an_open_stop_dialog(
    opened: Opener, gateway: FakeGateway
) -> None:
    """The result of the stop of one drive arrives while the question of Stop all is open."""
    page = opened("#/drives/pump-1")
    gateway.is_held = threading.Event()
    page.get_by_role("button", name="Stop pump-1").click()
    page.get_by_role("button", name="Stop pump-1").last.click()
    until_met(page, lambda: gateway.posts)
    page.mouse.click(*center(page.locator("#stopall")))
    with page.expect_response("**/api/stop"):
        gateway.is_held.set()
    page.wait_for_timeout(100)
    assert title(page).inner_text() == "Stop all 10 drives?"
    page.get_by_role("button", name="Stop all 10 drives").click()
    await_title(page, "All 10 drives are stopped")
    assert [body for _, body in gateway.posts] == [{"drives": ["pump-1"]}, {"drives": None}]


def test_the_stop_all_button_works_if_a_view_fails_to_load(opened: Opener, gateway: FakeGateway) -> None:
    """If one view cannot be loaded, no view is shown, but stops work."""
    broken = ("**/page/views/drives/table.js", "**/page/vendor/*", "**/api/frame*")
    page = opened(live=False, prepare=aborting(*broken))
    page.locator("#notice").get_by_text("was not fully loaded").wait_for()
    page.locator("#stopall").click()
    assert title(page).inner_text() == "Stop all drives?"
    page.get_by_role("button", name="Stop all drives").click()
    await_title(page, "All 10 drives are stopped")
    assert gateway.posts == [("/api/stop", {"drives": None})]


def test_the_web_page_works_without_its_plot_library(opened: Opener) -> None:
    page = opened("#/drives/pump-1", prepare=aborting("**/page/vendor/*.js"))
    page.get_by_text("Plots could not be loaded.").wait_for()
    assert page.locator(".registers tbody tr").count() == 12


def test_the_result_of_a_stop_names_drives_still_running(opened: Opener, gateway: FakeGateway) -> None:
    gateway.outcomes = {"pump-3": {"done": False, "text": "no reply; it may still run"}}
    page = opened()
    stop_all(page)
    await_title(page, "1 of 10 drives are not confirmed as stopped")
    assert page.locator("#ask .outcome li").all_inner_texts() == ["pump-3: no reply; it may still run"]
    assert "hard-wired stop" in page.locator("#ask").inner_text()
    gateway.outcomes = {}
    page.get_by_role("button", name="Send the stop again").click()
    await_title(page, "All 10 drives are stopped")


def test_a_stop_without_an_answer_is_shown_as_unknown(opened: Opener, gateway: FakeGateway) -> None:
    page = opened()
    gateway.kill()
    stop_all(page)
    await_title(page, "It is unknown whether the stop was sent")
    assert "cannot be reached" in page.locator("#ask").inner_text()
    assert page.get_by_role("button", name="Send the stop again").is_visible()


UNTAKEN = "The gateway has not accepted the stop"
# Clicks "Close" in a dialog as soon as the button is drawn.
CLOSED = """() => new MutationObserver((_, observer) => {
  const close = [...document.querySelectorAll('#ask button')].find(one => one.textContent === 'Close');
  if (close) { observer.disconnect(); close.click(); window.wasClosed = true; }
}).observe(document.querySelector('#ask'), { childList: true, subtree: true })"""


@pytest.mark.parametrize("is_closed", [False, True])
def test_a_frozen_gateway_is_reported_in_2_s(opened: Opener, gateway: FakeGateway, is_closed: bool) -> None:
    gateway.is_held = threading.Event()
    page = opened()
    if is_closed:
        page.evaluate(CLOSED)
    stop_all(page)
    until_met(page, lambda: gateway.posts)
    await_title(page, UNTAKEN)
    assert page.evaluate("window.wasClosed === true") is is_closed
    assert "Use the hard-wired stop at the machine now." in page.locator("#ask p.bad").inner_text()
    gateway.is_held.set()
    await_title(page, "All 10 drives are stopped")


def test_the_web_page_waits_for_the_result_of_an_accepted_stop(opened: Opener, gateway: FakeGateway) -> None:
    """A stop of silent drives may take half a minute."""
    gateway.is_held, gateway.confirms = threading.Event(), True
    page = opened()
    stop_all(page)
    until_met(page, lambda: gateway.posts)
    page.wait_for_timeout(2500)
    assert title(page).inner_text() == "Stopping all 10 drives …"
    assert "The gateway has accepted the stop." in page.locator("#ask").inner_text()
    gateway.is_held.set()
    await_title(page, "All 10 drives are stopped")


def test_a_warning_is_shown_if_an_emergency_stop_is_not_answered(
    opened: Opener, gateway: FakeGateway
) -> None:
    page = opened("#/drives/pump-1")
    held: list[Any] = []
    page.route("**/api/act", lambda route: held.append(route))
    page.get_by_role("button", name="emergency stop").click()
    page.get_by_role("button", name="emergency stop pump-1").click()
    await_title(page, UNTAKEN)
    held[0].fulfill(json={"done": True, "text": "stopped"})
    page.locator("#outcomes li").wait_for()


def test_typing_a_token_slowly_shows_no_warning(opened: Opener, gateway: FakeGateway) -> None:
    gateway.token = "right"
    page = opened()
    stop_all(page)
    page.get_by_label("Token").fill("right")
    page.wait_for_timeout(2500)
    assert title(page).inner_text() == "Sign in"
    press_enter(page)
    await_title(page, "All 10 drives are stopped")


def test_a_stop_asks_for_a_token_if_the_gateway_requires_one(opened: Opener, gateway: FakeGateway) -> None:
    gateway.token = "right"
    page = opened()
    stop_all(page)
    page.get_by_label("Token").fill("wrong")
    press_enter(page)
    page.get_by_text("No such token is known.").wait_for()
    page.get_by_label("Token").fill("right")
    page.get_by_role("button", name="Sign in and send").click()
    await_title(page, "All 10 drives are stopped")
    assert gateway.posts == [("/api/stop", {"drives": None})]


SECOND_CLICK = """([x, y]) => document.querySelector('#ask form button:not(.calm)').dispatchEvent(
    new MouseEvent('click', { clientX: x, clientY: y, detail: 2, bubbles: true, cancelable: true }))"""


@pytest.mark.parametrize(
    ("view", "asks", "confirms", "sent"),
    [
        ("", "#stopall", "Stop all 10 drives", [("/api/stop", {"drives": None})]),
        (
            "#/drives/pump-1",
            "button:text-is('emergency stop')",
            "emergency stop pump-1",
            [("/api/act", {"drive": "pump-1", "verb": "emergency_stop", "options": {}})],
        ),
        ("#/drives/pump-1", "button:text-is('start')", "start pump-1", []),
    ],
)
def test_a_double_click_submits_the_sign_in_form_only_for_a_stop(
    opened: Opener, gateway: FakeGateway, view: str, asks: str, confirms: str, sent: list[Any]
) -> None:
    """The form opens after the first click, and a password manager may fill in the token immediately."""
    gateway.token = "right"
    page = opened(view)
    page.locator(asks).click()
    button = page.get_by_role("button", name=confirms, exact=True)
    x, y = center(button)
    button.click()
    page.get_by_label("Token").fill("right")
    page.evaluate(SECOND_CLICK, [x, y])
    if sent:
        until_met(page, lambda: gateway.posts)
    page.wait_for_timeout(300)  # time in which a further request would be sent
    assert gateway.posts == sent


def test_a_stop_is_shown_as_not_sent_if_the_sign_in_is_cancelled(
    opened: Opener, gateway: FakeGateway
) -> None:
    gateway.token = "right"
    page = opened()
    stop_all(page)
    page.get_by_role("button", name="Cancel").click()
    await_title(page, "The stop was not sent")
    assert gateway.posts == []


def test_eight_tabs_with_six_connections_show_live_values_and_can_stop_drives(
    browser: Any, gateway: FakeGateway, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A browser allows six connections to a host. The requests of other tabs hold all six."""
    # so long that a stop which waits for these requests would fail the test
    monkeypatch.setattr(fake_gateway, "HOLD_S", 2 * PATIENCE_S)
    gateway.clocked = "pump-1"  # the frequency of this drive changes with the time
    context = browser.new_context(viewport={"width": 390, "height": 844})  # without plots
    pages = [context.new_page() for _ in range(8)]
    for page in pages:
        page.goto(gateway.url)
    for page in pages:
        until(page, LIVE)
    shown = "Number([...document.querySelectorAll('tr.drive .number')][0].textContent)"
    for page in pages:
        await_new_value(page, partial(page.evaluate, shown))
        until(page, LIVE)
    gateway.is_silent = True
    pages[0].wait_for_timeout(1000)
    page = pages[-1]
    page.bring_to_front()
    page.keyboard.press("Shift+S")
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    await_title(page, "All 10 drives are stopped")
    context.close()


@pytest.mark.parametrize("case", ["a write that wants a token", "a reload"])
def test_a_late_dialog_never_replaces_a_stop_dialog(opened: Opener, gateway: FakeGateway, case: str) -> None:
    """The answer to an earlier request arrives while the question is open."""
    path = "api/reload" if case == "a reload" else "api/write"
    held: list[Any] = []
    if case == "a reload":
        gateway.plant_changes = {
            "file": True,
            "may": {"role": "write", "write": ["pump-1.frequency_setpoint"], "verbs": []},
        }
    page = opened("#/drives/pump-1")
    page.route(f"**/{path}", lambda route: held.append(route))
    if case == "a reload":
        page.locator("#more").click()
        page.get_by_role("button", name="Reload the plant file").click()
        page.get_by_role("button", name="Reload bottling plant.toml").click()
    else:
        page.get_by_role("button", name="Change frequency setpoint").click()
        page.get_by_label("New value, Hz").fill("31.5")
        page.get_by_role("button", name="Write to pump-1").click()
    until_met(page, lambda: held)
    # a script can click the button behind the dialog
    page.evaluate("document.querySelector('#stopall').click()")
    assert title(page).inner_text() == "Stop all 10 drives?"
    with page.expect_response(f"**/{path}"):
        held[0].fulfill(status=401, json={"error": "This wants a token."})
    page.wait_for_timeout(300)
    assert title(page).inner_text() == "Stop all 10 drives?"
    page.get_by_role("button", name="Stop all 10 drives").click()
    await_title(page, "All 10 drives are stopped")
    assert gateway.posts == [("/api/stop", {"drives": None})]


KEYS = {  # (key, its position on the keyboard, is Shift held): title of the dialog that the page then opens
    ("S", "KeyS", True): "Stop all 10 drives?",
    ("s", "KeyS", False): "Stop pump-1?",
    ("s", "KeyS", True): "Stop all 10 drives?",  # with caps lock
    ("S", "KeyS", False): "Stop all 10 drives?",
    ("Ы", "KeyS", True): "Stop all 10 drives?",  # Russian layout
    ("ы", "KeyS", False): "Stop pump-1?",
    ("Process", "KeyS", True): "Stop all 10 drives?",  # Chinese input method
    ("S", "Semicolon", True): "Stop all 10 drives?",  # Dvorak
    ("o", "KeyS", False): None,
    ("O", "KeyS", True): None,
    ("ж", "Semicolon", False): None,
}
PRESSED = """([key, code, shiftKey]) => {
    const ask = document.querySelector('#ask');
    document.querySelector('h1, body').dispatchEvent(
        new KeyboardEvent('keydown', { key, code, shiftKey, bubbles: true }));
    const asked = ask.open ? document.querySelector('#ask-title').innerText : null;
    if (ask.open) ask.querySelector('button.calm').click();
    return [asked, ask.open];
}"""


def test_the_stop_keys_work_on_every_keyboard_layout(opened: Opener) -> None:
    page = opened("#/drives/pump-1")
    assert {key: page.evaluate(PRESSED, key) for key in KEYS} == {
        key: [asks, False] for key, asks in KEYS.items()
    }


def test_the_stop_key_works_in_an_open_dialog_but_not_in_a_text_field(opened: Opener) -> None:
    page = opened("#/drives/pump-1")
    page.get_by_role("button", name="Change frequency setpoint").click()
    page.keyboard.press("Shift+S")  # typed into the text field
    assert title(page).inner_text() == "Change frequency setpoint of pump-1?"
    page.get_by_role("button", name="Cancel").focus()
    page.keyboard.press("Shift+S")
    assert title(page).inner_text() == "Stop all 10 drives?"


@pytest.mark.parametrize("verb", ["stop", "emergency stop"])
def test_the_page_waits_until_the_gateway_has_given_up_a_stop(
    opened: Opener, gateway: FakeGateway, verb: str
) -> None:
    """With one dead drive, the page could otherwise never show which drives have stopped."""
    page = opened("#/drives/pump-1")
    page.evaluate("""() => {
        const make = AbortSignal.timeout;
        window.patience = [];
        AbortSignal.timeout = ms => (window.patience.push(ms), make.call(AbortSignal, ms));
    }""")
    page.get_by_role("button", name="Stop pump-1" if verb == "stop" else verb, exact=True).click()
    page.locator("#ask button.stop").click()
    until_met(page, lambda: gateway.posts)
    assert max(page.evaluate("window.patience")) > (LEAST_S + 10) * 1e3
