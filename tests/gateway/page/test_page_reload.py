"""Reload of the plant file by a writer, and the list of all mistakes in it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from fake_gateway import FakeGateway
from gateways import served
from watching import LIVE, Opener, press_enter, until

from multidrop.gateway.http.rights import Right

pytestmark = pytest.mark.long  # Chromium is started for each file

READ_AGAIN = "Reload the plant file"


def tab_to(page: Any, name: str) -> None:
    """Move the focus to a button by the Tab key alone."""
    for _ in range(30):
        page.keyboard.press("Tab")
        if page.evaluate("document.activeElement.textContent") == name:
            return
    raise AssertionError(f"no way to {name}")


def told(page: Any, title: str) -> None:
    page.get_by_role("heading", name=title, exact=True).wait_for()


def test_reload_by_keyboard_lists_all_mistakes(opened: Opener, gateway: FakeGateway) -> None:
    mistakes = [f"plant.toml: [[line]] {n}: port is missing" for n in range(30)]
    text = "the previous plant stays in use: the file has mistakes"
    gateway.reloaded = {"done": False, "text": text, "mistakes": mistakes, "restart": []}
    page = opened()
    page.locator("#more").focus()
    press_enter(page)
    tab_to(page, READ_AGAIN)
    press_enter(page)
    told(page, "Reload bottling plant.toml?")
    press_enter(page)  # Cancel has the focus
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


def test_reload_is_not_offered_without_a_file_or_right(opened: Opener, gateway: FakeGateway) -> None:
    for changed in ({"file": False}, {"may": {"role": "stop", "write": [], "verbs": []}}):
        gateway.plant_changes = changed
        page = opened()
        page.locator("#more").click()
        told(page, "Settings")
        assert page.get_by_role("button", name=READ_AGAIN).count() == 0


def test_real_gateway_refuses_a_broken_file_and_reloads_a_good_one(page: Any, tmp_path: Path) -> None:
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
        page.get_by_role("link", name="fan-2", exact=True).wait_for()  # not an alarm that names it
        notice.wait_for(state="hidden")
