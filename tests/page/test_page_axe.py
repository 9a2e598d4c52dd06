"""Nobody is shut out: axe-core finds nothing in any view, at any size, in either theme."""

from __future__ import annotations

from importlib.resources import files
from typing import Any

import pytest
from conftest import Opener, missing
from fake_gateway import FakeGateway
from watching import until_still

pytestmark = pytest.mark.long  # Chromium is started for each file

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
TAGS = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"]
# What is no violation is a long list of all elements of the page, to be made and to be sent.
RUN = """tags => axe.run(document, { runOnly: tags, resultTypes: ["violations"] })
  .then(found => found.violations)"""


@pytest.fixture(scope="module")
def axe() -> str:
    try:
        return (files("axe_playwright_python") / "axe.min.js").read_text("utf-8")
    except ImportError:
        missing("axe-playwright-python is not installed")


def violations(page: Any) -> list[str]:
    found = page.evaluate(RUN, TAGS)
    return [f"{v['id']}: {node['target']} {node['failureSummary']}" for v in found for node in v["nodes"]]


@pytest.mark.parametrize(("size", "theme"), LOOKS)
def test_axe_finds_nothing(opened: Opener, gateway: FakeGateway, axe: str, size: str, theme: str) -> None:
    gateway.reloaded |= {"done": False, "mistakes": ["plant.toml: a mistake"] * 40}
    page = opened(size=size, color_scheme=theme)
    page.evaluate(axe)
    found = {}
    for view in VIEWS if size == "phone" else VIEWS[:-1]:  # long lists scroll where there is little room
        if view == "settings":
            page.get_by_role("button", name="Settings").click()
        elif view == "stop":
            page.keyboard.press("Escape")
            page.locator("#stopall").click()
        elif view == "reload":
            page.keyboard.press("Escape")
            page.locator("#more").click()
            page.get_by_role("button", name="Read the plant file again").click()
            page.get_by_role("button", name="Read bottling plant.toml").click()
            page.get_by_role("heading", name="The file has 40 mistakes").wait_for()
        else:
            page.evaluate("view => { location.hash = view }", view)
        page.wait_for_timeout(700)
        until_still(page)
        found[view] = violations(page)
    assert {view: some for view, some in found.items() if some} == {}
