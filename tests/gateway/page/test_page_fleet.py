"""The web page's view of a fleet of gateways: old values are marked, and missing values are dashes."""

from __future__ import annotations

from typing import Any

import pytest
from fake_gateway import FakeGateway
from watching import Opener, until, until_met

NONE = "\u2013"  # a dash
pytestmark = pytest.mark.long


def cells(page: Any, table: str) -> list[list[str]]:
    read = "rows => rows.map(row => [...row.cells].map(cell => cell.textContent.trim()))"
    found: list[list[str]] = page.locator(f"#fleet-{table} tr").evaluate_all(read)
    return found


def await_note(page: Any, text: str) -> None:
    until(page, f"document.querySelector('#fleet-age').textContent.includes({text!r})")


def test_the_fleet_view_shows_which_gateway_polls_each_line(opened: Opener) -> None:
    page = opened("#/fleet")
    await_note(page, "Updated once a second")
    first, second, third = cells(page, "gateways")
    assert first[:10] == ["gw-1", "pc-hall-1", "working", "4", "2.1 s", "81 MB", "2", "1.4 s", "0", "5"]
    assert second[:9] == ["gw-2", "pc-hall-2", "no answer", "4", NONE, NONE, NONE, NONE, NONE]
    assert third[0] == "gw-3"
    lines = cells(page, "lines")
    assert lines[0] == ["hall-1", "socket://10.0.0.1:4001", "none", NONE]
    assert [line[0] for line in lines] == [f"hall-{n}" for n in (1, 4, 7, 10, 2, 3, 5, 6, 8, 9, 11, 12)]
    assert {line[2] for line in lines[1:4]} == {"gw-2, no answer"}
    assert {line[2] for line in lines[4:]} == {"gw-1", "gw-3"}
    note = "12 lines, 1 without a master, 3 with a master that does not answer"
    assert page.locator("#fleet-lines-note.bad").inner_text() == note
    assert [[row[0], *row[2:]] for row in cells(page, "moves")] == [
        ["hall-3", "gw-2", "gw-1"],
        ["hall-6", "nobody", "gw-1"],
        ["hall-9", NONE, "gw-1"],
    ]


def test_the_fleet_tables_fit_a_small_screen(opened: Opener) -> None:
    page = opened("#/fleet")
    await_note(page, "Updated once a second")
    tables = page.locator("#fleet .scroll")
    wide = "tables => tables.map(table => table.scrollWidth - table.clientWidth)"
    lag = "getComputedStyle(document.querySelectorAll('#fleet-gateways td')[6], '::before').content"
    for width in (768, 390, 360):
        page.set_viewport_size({"width": width, "height": 844})
        until_met(page, lambda: tables.count() == 3)
        until_met(page, lambda: max(tables.evaluate_all(wide)) <= 0)
        # on small screens, each cell starts with the title of its column
        until(page, f"{lag} === '\"Lag \"'")


def test_old_fleet_values_show_their_age_and_the_reason(opened: Opener, gateway: FakeGateway) -> None:
    page = opened("#/fleet")
    await_note(page, "Updated once a second")
    gateway.fleet = {"age_s": 40.0, "trouble": "no connection to nats://a:4222"}
    await_note(page, "Seen ")
    told = page.locator("#fleet-age.bad").inner_text()
    assert told.endswith(" s ago: no connection to nats://a:4222. Times are UTC.")
    style = "getComputedStyle(document.querySelector('#fleet-gateways td')).fontStyle"
    assert page.evaluate(style) == "italic"
    gateway.fleet = {}
    await_note(page, "Updated once a second")
    until_met(page, lambda: page.evaluate(style) == "normal")


def test_fleet_values_of_a_lost_gateway_are_marked_as_old(opened: Opener, gateway: FakeGateway) -> None:
    page = opened("#/fleet")
    await_note(page, "Updated once a second")
    gateway.kill()
    await_note(page, "Seen")
    assert "The gateway cannot be reached" in page.locator("#fleet-age").inner_text()


def test_the_fleet_view_is_empty_before_the_fleet_was_seen(opened: Opener, gateway: FakeGateway) -> None:
    gateway.fleet = {"age_s": None, "trouble": "no such server", "gateways": {}, "lines": {}, "moves": []}
    page = opened("#/fleet")
    await_note(page, "The fleet has not been seen yet: no such server")
    assert cells(page, "gateways") == []


def test_the_fleet_view_shows_problems_of_gateways(opened: Opener, gateway: FakeGateway) -> None:
    spool = {"bytes": 5, "lost": 7, "behind": None, "lag_s": None, "trouble": "the disk is full"}
    says = {"state": "working", "margin_s": 2.0, "trouble": "", "spool": spool}
    says["troubles"] = {"hall-1": "cannot be opened"}
    gateway.fleet = {
        "gateways": {"gw-1": {"host": "pc", "session": 1, "began_ms": 0, "lines": 1, "says": says}}
    }
    page = opened("#/fleet")
    until(page, "document.querySelector('#fleet-gateways-note').textContent !== ''")
    note = page.locator("#fleet-gateways-note").inner_text()
    assert note == "gw-1: line hall-1: cannot be opened; gw-1: the disk is full"
    assert cells(page, "gateways")[0][5:9] == ["5 B", NONE, NONE, "7"]


def test_the_fleet_view_draws_at_most_200_lines(opened: Opener, gateway: FakeGateway) -> None:
    line = {"port": "socket://h:1", "master": "gw-1", "since_ms": 0}
    gateway.fleet = {"lines": {f"l{n}": line | ({"master": None} if n == 999 else {}) for n in range(1000)}}
    page = opened("#/fleet")
    until(page, "document.querySelectorAll('#fleet-lines tr').length === 200")
    assert cells(page, "lines")[0][0] == "l999"
    note = page.locator("#fleet-lines-note").inner_text()
    assert note == "1000 lines, 1 without a master; the first 200 are shown"


def test_the_fleet_view_is_hidden_for_a_plant_without_a_fleet(opened: Opener, gateway: FakeGateway) -> None:
    gateway.plant_changes = {"fleet": False}
    page = opened()
    assert page.locator("nav a:visible").all_inner_texts()[-1] == "Log"
    page.keyboard.press("6")
    assert page.evaluate("location.hash") == "#/drives"
    page.keyboard.press("5")
    assert page.evaluate("location.hash") == "#/log"


def test_key_6_opens_the_fleet_view(opened: Opener) -> None:
    page = opened()
    page.keyboard.press("6")
    await_note(page, "Updated once a second")
    assert page.locator("nav a[aria-current]").inner_text() == "Fleet"


def test_the_stop_all_button_in_the_fleet_view_stops_only_the_plant(
    opened: Opener, gateway: FakeGateway
) -> None:
    page = opened("#/fleet")
    stopall = page.locator("#stopall")
    assert stopall.inner_text() == "Stop this plant"
    stopall.click()
    assert page.locator("#ask-title").inner_text() == "Stop all 10 drives of bottling plant?"
    asked = page.locator("#ask").inner_text()
    assert "drives of this plant only" in asked
    assert "multidrop fleet stop --all" in asked
    page.get_by_role("button", name="Stop all 10 drives of bottling plant").click()
    page.get_by_role("heading", name="All 10 drives are stopped").wait_for()
    assert gateway.posts == [("/api/stop", {"drives": None})]
    page.keyboard.press("Escape")
    page.evaluate("location.hash = '#/drives'")
    until(page, "document.querySelector('#stopall').textContent === 'Stop all'")


def test_the_stop_all_button_stops_the_fleet_if_the_settings_allow_it(
    opened: Opener, gateway: FakeGateway
) -> None:
    gateway.plant_changes = {"fleet_stop": True}
    gateway.fleet_outcomes = {"hall-9.pump": {"done": True, "text": "stopped"}}
    page = opened("#/fleet")
    assert page.locator("#stopall").inner_text() == "Stop the fleet"
    page.locator("#stopall").click()
    assert page.locator("#ask-title").inner_text() == "Stop the whole fleet?"
    assert "all 10 drives of bottling plant" in page.locator("#ask").inner_text()
    page.get_by_role("button", name="Stop the whole fleet").click()
    page.get_by_role("heading", name="All 11 drives are stopped").wait_for()
    assert sorted(gateway.posts) == [("/api/fleet/stop", {}), ("/api/stop", {"drives": None})]


def test_a_failed_stop_of_the_fleet_is_reported(opened: Opener, gateway: FakeGateway) -> None:
    """The servers of the fleet do not answer, but the gateway's own drives are stopped."""
    gateway.plant_changes = {"fleet_stop": True}
    gateway.fleet_outcomes = {"the fleet": {"done": False, "text": "the stop was NOT sent"}}
    page = opened("#/fleet")
    page.locator("#stopall").click()
    page.get_by_role("button", name="Stop the whole fleet").click()
    page.get_by_role("heading", name="1 of 11 drives are not confirmed as stopped").wait_for()
    assert page.locator("#ask .outcome li").all_inner_texts() == ["the fleet: the stop was NOT sent"]
    page.route("**/api/fleet/stop", lambda route: route.abort())
    page.get_by_role("button", name="Send the stop again").click()
    page.get_by_role("heading", name="It is unknown whether the stop was sent").wait_for()
    assert "All 10 drives are stopped." in page.locator("#ask").inner_text()
