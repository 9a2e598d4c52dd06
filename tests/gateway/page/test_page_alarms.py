"""Alarms on the page: order, one alarm per lost port, and acknowledgements with their senders."""

from __future__ import annotations

import time
from typing import Any

import pytest
from fake_gateway import FakeGateway
from fake_plant import alarm, lines, ms
from watching import Opener, cell, until_met

pytestmark = pytest.mark.long  # Chromium is started for each file

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


def test_gravest_alarm_is_listed_first(opened: Opener, alarmed: FakeGateway) -> None:
    page = opened("#/faults")
    wanted = ["conveyor-2", "pump-4", "line hall-4", "labeller", "booster-1"]
    assert strip(page) == wanted
    rows = page.locator("#fault-list section").first.locator("tbody tr")
    until_met(page, lambda: rows.count() == 5)
    assert rows.locator(".who").all_inner_texts() == wanted
    kinds = ["fault", "stopped by itself", "port lost", "silent", "fault"]
    assert [kind.strip() for kind in rows.locator(".kind").all_inner_texts()] == kinds
    assert page.locator("#count").inner_text() == "4"  # number of unacknowledged alarms
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
    alarmed.has_changed = True
    page.get_by_role("button", name="Acknowledge").first.click()
    page.get_by_role("button", name="Acknowledge").last.click()
    page.get_by_role("heading", name="The alarm was not acknowledged").wait_for()
    assert "there is no such alarm" in page.locator("#ask").inner_text()


def test_many_misses_show_a_warning_and_one_does_not(opened: Opener, gateway: FakeGateway) -> None:
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


def test_drive_at_rest_with_unknown_state_is_not_shown_as_fault(opened: Opener, gateway: FakeGateway) -> None:
    why = "the outputs are not programmed"
    gateway.drive_changes = {name: {"state": "unknown", "note": why} for name in ("pump-4", "pump-1")}
    page = opened("#/drives/pump-4")
    assert cell(page, "pump-4", "state").inner_text().strip() == "at rest: 0 Hz"
    assert cell(page, "pump-1", "state").inner_text().strip() == "unknown"
    assert why in page.locator("#panel").inner_text()
    assert page.locator("button[data-show=bad] b").inner_text() == "4"
    page.locator("button[data-show=stands]").click()
    assert cell(page, "pump-4", "state").is_visible()
    assert not cell(page, "pump-1", "state").is_visible()
