"""Accessibility: axe-core finds no violation in any view of the web page, at any size and theme."""

from __future__ import annotations

import fake_plant
import pytest
from fake_gateway import FakeGateway
from watching import Opener, press_enter, until, until_settled, violations

pytestmark = pytest.mark.long

VIEWS = (
    "#/drives",
    "#/drives/pump-1",
    "#/trends",
    "#/faults",
    "#/lines",
    "#/log",
    "#/fleet",
    "settings",
    "stop",
    "reload",
)
LOOKS = [("desk", "light"), ("tablet", "light"), ("phone", "dark")]


@pytest.mark.parametrize(("size", "theme"), LOOKS)
def test_axe_core_finds_no_accessibility_violation_in_any_view(
    opened: Opener, gateway: FakeGateway, axe: str, size: str, theme: str
) -> None:
    gateway.reloaded |= {"done": False, "mistakes": ["plant.toml: a mistake"] * 40}
    page = opened(size=size, color_scheme=theme)
    page.evaluate(axe)
    found = {}
    for view in VIEWS if size == "phone" else VIEWS[:-1]:  # the last view scrolls only on a phone
        if view == "settings":
            page.get_by_role("button", name="Settings").click()
        elif view == "stop":
            page.keyboard.press("Escape")
            page.locator("#stopall").click()
        elif view == "reload":
            page.keyboard.press("Escape")
            page.locator("#more").click()
            page.get_by_role("button", name="Reload the plant file").click()
            page.get_by_role("button", name="Reload bottling plant.toml").click()
            page.get_by_role("heading", name="The file has 40 mistakes").wait_for()
        else:
            page.evaluate("view => { location.hash = view }", view)
        until_settled(page)
        found[view] = violations(page)
    assert {view: some for view, some in found.items() if some} == {}


@pytest.mark.parametrize(("size", "theme"), [("desk", "dark"), ("phone", "light")])
def test_axe_core_finds_no_accessibility_violation_in_rare_states(
    opened: Opener, gateway: FakeGateway, axe: str, size: str, theme: str
) -> None:
    """The states: dialogs, results of writes, a drive without values, a single drive, a lost gateway."""
    gateway.token = "right"
    page = opened("#/drives/pump-1", size=size, color_scheme=theme)
    page.evaluate(axe)
    found = {}

    def look(state: str) -> None:
        until_settled(page)
        found[state] = violations(page)

    page.get_by_role("button", name="start", exact=True).click()
    look("a start")
    page.keyboard.press("Escape")
    page.get_by_role("button", name="Change frequency setpoint").click()
    page.get_by_label("New value").fill("30")
    look("a write")
    page.get_by_role("button", name="Write to pump-1").click()
    page.get_by_label("Token").fill("wrong")
    press_enter(page)
    page.get_by_text("No such token is known.").wait_for()
    look("a wrong token")
    page.get_by_label("Token").fill("right")
    press_enter(page)
    page.locator("#outcomes").get_by_text("held by the drive").wait_for()
    look("an outcome")
    page.evaluate("location.hash = '#/trends'")
    page.get_by_role("button", name="Marker A").click()
    look("a marker")
    unknown = {"state": "unknown", "fault": None, "seen": None, "ages_ms": [], "values": {}, "missed": None}
    gateway.changes = {
        "drives": {name: unknown for names in fake_plant.NAMES for name in names.split()},
        "lines": {},
        "alarms": [],
        "troubles": ["history: the disk is full"],
    }
    page.goto(f"{gateway.url}?again#/drives/pump-2")  # a newly loaded page that has no values yet
    page.evaluate(axe)
    page.get_by_text("10 in unknown state").wait_for()
    look("nothing known")
    first = fake_plant.plant({})["lines"][0]
    gateway.plant_changes = {"lines": [first | {"drives": first["drives"][:1]}], "fleet": False}
    page.reload()
    page.evaluate(axe)
    page.get_by_text("1 drive, no known fault").wait_for()
    look("one drive")
    gateway.kill()
    until(page, "document.body.classList.contains('dead')")
    for view in ("#/drives", "#/trends", "#/faults", "#/lines", "#/log"):
        page.evaluate("view => { location.hash = view }", view)
        look(f"dead {view}")
    assert {state: some for state, some in found.items() if some} == {}
