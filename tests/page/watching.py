"""Waiting for what a page shows: from outside, because its CSP forbids code that is made of texts."""

from __future__ import annotations

import time
from typing import Any

LIVE = "document.querySelector('#link').textContent.trim() === 'live'"
STALE = "document.body.classList.contains('stale')"


def until(page: Any, expression: str, within: float = 30) -> float:
    """Wait until this is true on the page. Return the seconds. Raises AssertionError."""
    began = time.monotonic()
    while not page.evaluate(expression):
        assert time.monotonic() - began < within, f"not within {within} s: {expression}; {told(page)}"
        page.wait_for_timeout(20)
    return time.monotonic() - began


def told(page: Any) -> str:
    """Return what the head says, for who reads of a failure."""
    return str(
        page.evaluate("['link', 'notice'].map(id => document.getElementById(id).textContent).join(', ')")
    )


def cell(page: Any, drive: str, part: str) -> Any:
    """Return a cell of the table of drives."""
    return page.locator("tr.drive", has=page.get_by_role("link", name=drive, exact=True)).locator(
        f"td.{part}"
    )


def link(page: Any) -> str:
    """Return what the head says of the way to the daemon."""
    return str(page.locator("#link").inner_text().strip())
