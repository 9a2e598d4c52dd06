"""Functions that wait for a state of a page by polling it, because its CSP forbids evaluated code."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any, NoReturn

import pytest

SIZES = {"desk": (1440, 900), "tablet": (820, 1180), "phone": (390, 844)}
Opener = Callable[..., Any]


def missing(what: str) -> NoReturn:
    """Skip the test on a user's machine; fail it in CI, where all tests must run."""
    if os.environ.get("CI") == "true":
        pytest.fail(what)
    pytest.skip(what)


PATIENCE_S = 60.0  # time limit for events that are immediate on an idle machine
LOOK_MS = 60  # polling interval; each check costs 2 ms of processor time
LIVE = "document.querySelector('#link').textContent.trim() === 'live'"
STALE = "document.body.classList.contains('stale')"
VIEWS = ("#/drives", "#/drives/pump-3", "#/trends", "#/faults", "#/lines", "#/log")
AT_ITS_PLACE = """() => {
  const box = document.querySelector('#stopall').getBoundingClientRect();
  const points = [[0.02, 0.5], [0.5, 0.1], [0.5, 0.5], [0.5, 0.9], [0.98, 0.5]];
  const seen = points.every(([x, y]) =>
    document.elementFromPoint(box.x + box.width * x, box.y + box.height * y)?.id === 'stopall');
  return [seen, box.x, box.y, box.width, box.height];
}"""


def until(page: Any, expression: str) -> None:
    """Wait until this expression is true on the page, which may reload meanwhile.

    Raises AssertionError after PATIENCE_S.
    """

    def met() -> object:
        try:
            return page.evaluate(expression)
        except Exception as failure:
            if "Execution context was destroyed" not in str(failure):
                raise
            return False

    until_met(page, met, expression)


def until_met(page: Any, met: Callable[[], object], what: str = "") -> None:
    """Wait until a condition is met, because the page may change with a delay.

    Raises AssertionError after PATIENCE_S.
    """
    end = time.monotonic() + PATIENCE_S
    while not met():
        assert time.monotonic() < end, f"not within {PATIENCE_S:g} s: {what}; {told(page)}"
        page.wait_for_timeout(LOOK_MS)


def until_still(page: Any) -> None:
    """Wait until all animations have ended, except endless ones."""
    until(
        page,
        "document.getAnimations().every(a => a.effect.getTiming().iterations === Infinity"
        " || a.playState !== 'running')",
    )


def press_enter(page: Any) -> None:
    """Press Enter when the opened or closed dialog is drawn: until then the page ignores the key."""
    page.evaluate("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
    page.keyboard.press("Enter")


def told(page: Any) -> str:
    """Return the text of the page's head, for the message of a failed wait."""
    return str(
        page.evaluate("['link', 'notice'].map(id => document.getElementById(id).textContent).join(', ')")
    )


def cell(page: Any, drive: str, part: str) -> Any:
    """Return a cell of the table of drives, by drive and column."""
    return page.locator("tr.drive", has=page.get_by_role("link", name=drive, exact=True)).locator(
        f"td.{part}"
    )


def link(page: Any) -> str:
    """Return the text about the connection in the page's head."""
    return str(page.locator("#link").inner_text().strip())
