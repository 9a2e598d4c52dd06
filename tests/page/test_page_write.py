"""Nothing is written unasked: one register of one drive, confirmed by name, sent once, told of as it was."""

from __future__ import annotations

import pytest
from conftest import Opener
from fake_gateway import FakeGateway

pytestmark = pytest.mark.long  # Chromium is started for each file


def test_a_write_is_confirmed_by_name_and_sent_once(opened: Opener, gateway: FakeGateway) -> None:
    page = opened("#/drives/pump-1")
    assert page.get_by_role("button", name="Change").count() == 1  # the plant file allows one register
    page.get_by_role("button", name="Change frequency setpoint").click()
    assert page.locator("#ask-title").inner_text() == "Change frequency setpoint of pump-1?"
    assert "It is 20.0 Hz. From 0 to 50 Hz." in page.locator("#ask").inner_text()
    page.get_by_label("New value, Hz").fill("31.5")
    page.get_by_role("button", name="Write to pump-1").dblclick()
    page.locator("#outcomes li").wait_for()
    assert gateway.posts == [
        ("/api/write", {"drive": "pump-1", "register": "frequency_setpoint", "value": 31.5})
    ]
    assert "frequency setpoint = 31.5 Hz: held by the drive" in page.locator("#outcomes").inner_text()


def test_a_value_out_of_range_or_none_is_not_sent(opened: Opener, gateway: FakeGateway) -> None:
    page = opened("#/drives/pump-1")
    page.get_by_role("button", name="Change frequency setpoint").click()
    for value in ("50.5", "-1", ""):
        page.get_by_label("New value, Hz").fill(value)
        page.get_by_role("button", name="Write to pump-1").click()
        assert page.locator("#ask").evaluate("dialog => dialog.open")
    page.keyboard.press("Escape")
    assert gateway.posts == []


def test_what_a_write_became_is_said_in_the_gateways_words(opened: Opener, gateway: FakeGateway) -> None:
    gateway.outcomes = {"pump-1": {"done": False, "text": "the drive took 30.0 Hz instead"}}
    page = opened("#/drives/pump-1")
    page.get_by_role("button", name="Change frequency setpoint").click()
    page.get_by_label("New value, Hz").fill("31.5")
    page.keyboard.press("Enter")
    assert "bad" in page.locator("#outcomes li").get_attribute("class")
    assert "the drive took 30.0 Hz instead" in page.locator("#outcomes").inner_text()


def test_a_write_whose_answer_is_lost_is_not_called_sent_nor_sent_again(
    opened: Opener, gateway: FakeGateway
) -> None:
    page = opened("#/drives/pump-1")
    page.route("**/api/act", lambda route: route.abort())
    page.get_by_role("button", name="start").click()
    page.get_by_role("button", name="start pump-1").click()
    assert "not known whether it was carried out" in page.locator("#outcomes li").inner_text()
    assert gateway.posts == []


def test_a_start_warns_and_enter_alone_sends_nothing(opened: Opener, gateway: FakeGateway) -> None:
    page = opened("#/drives/pump-1")
    page.get_by_role("button", name="start").click()
    assert page.locator("#ask-title").inner_text() == "start: pump-1?"
    assert "The motor will turn." in page.locator("#ask").inner_text()
    page.keyboard.press("Enter")
    assert gateway.posts == []
    page.get_by_role("button", name="start").click()
    page.get_by_role("button", name="start pump-1").click()
    page.locator("#outcomes li").wait_for()
    assert gateway.posts == [("/api/act", {"drive": "pump-1", "verb": "start", "options": {}})]


def test_what_may_not_be_done_is_not_offered(opened: Opener) -> None:
    page = opened("#/drives/pump-2")
    page.locator(".registers").wait_for()
    assert page.locator(".verbs button, .change").count() == 0
    assert page.get_by_role("button", name="Stop pump-2").is_visible()
