"""The web page with a real gateway that polls and stops simulated drives."""

from __future__ import annotations

from pathlib import Path
from statistics import median
from typing import Any

import pytest
from fake_gateway import FakeGateway
from gateways import served
from lines import until as until_here
from watching import LIVE, Opener, cell, press_enter, until, until_met

from multidrop.gateway.http.rights import Right

pytestmark = pytest.mark.long


def test_the_web_page_shows_a_polled_plant_and_stops_it_with_a_token(page: Any, tmp_path: Path) -> None:
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
        told(page, "All 2 drives are stopped")
        until(page, "document.querySelector('#role').textContent === 'may stop'")
        page.keyboard.press("Escape")
        until_here(lambda: gateway.get("/api/audit").json["entries"])
        page.evaluate("location.hash = '#/drives'")
        page.evaluate("location.hash = '#/log'")
        page.locator("#log-list tbody tr").first.wait_for()


def test_the_delay_of_values_over_a_network_of_8_kb_a_second_does_not_grow(page: Any, tmp_path: Path) -> None:
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


# ---- reload of the plant file by a writer, and the list of all mistakes in it ----


READ_AGAIN = "Reload the plant file"


def tab_to(page: Any, name: str) -> None:
    """Press Tab until the button of this name has the focus."""
    for _ in range(30):
        page.keyboard.press("Tab")
        if page.evaluate("document.activeElement.textContent") == name:
            return
    raise AssertionError(f"no way to {name}")


def told(page: Any, title: str) -> None:
    page.get_by_role("heading", name=title, exact=True).wait_for()


def test_reload_by_keyboard_shows_mistakes(opened: Opener, gateway: FakeGateway) -> None:
    mistakes = [f"plant.toml: [[line]] {n}: port is missing" for n in range(30)]
    text = "the previous plant stays in use: the file has mistakes"
    gateway.reloaded = {"done": False, "text": text, "mistakes": mistakes, "restart": []}
    page = opened()
    page.locator("#more").focus()
    press_enter(page)
    tab_to(page, READ_AGAIN)
    press_enter(page)
    told(page, "Reload bottling plant.toml?")
    press_enter(page)  # presses Cancel, which has the focus
    assert gateway.posts == []
    page.locator("#more").focus()
    press_enter(page)
    tab_to(page, READ_AGAIN)
    press_enter(page)
    tab_to(page, "Reload bottling plant.toml")
    press_enter(page)
    told(page, "The file has 30 mistakes")
    assert page.locator("#ask .outcome li").all_inner_texts() == mistakes
    tab_to(page, "".join(mistakes))
    page.keyboard.press("End")
    until(page, "document.querySelector('#ask .outcome').scrollTop > 0")
    assert gateway.posts == [("/api/reload", {"confirm": True})]


def test_reload_needs_a_plant_file_and_the_right(opened: Opener, gateway: FakeGateway) -> None:
    for changed in ({"file": False}, {"may": {"role": "stop", "write": [], "verbs": []}}):
        gateway.plant_changes = changed
        page = opened()
        page.locator("#more").click()
        told(page, "Settings")
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
        told(page, "The file has 3 mistakes")
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
        told(page, "plant.toml is in effect")
        assert page.locator("#ask .outcome li").all_inner_texts() == list(gateway.gateway.reload.restart)
        page.keyboard.press("Escape")
        # exact, because an alarm also links to fan-2
        page.get_by_role("link", name="fan-2", exact=True).wait_for()
        notice.wait_for(state="hidden")
