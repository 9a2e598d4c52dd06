"""Functions by which tests wait for a state of the web page."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any, NoReturn
from weakref import WeakKeyDictionary

import pytest

SIZES = {"desk": (1440, 900), "tablet": (820, 1180), "phone": (390, 844)}
Opener = Callable[..., Any]


def missing(what: str) -> NoReturn:
    """Report a missing program. Skips the test on a user's machine, and fails it in CI."""
    if os.environ.get("CI") == "true":
        pytest.fail(what)
    pytest.skip(what)


PATIENCE_S = 60.0  # for events that happen immediately on an idle machine
LOOK_MS = 60  # polling interval
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


AXE_TAGS = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"]
# Return only violations, because the other results would list all elements of the page.
RUN_AXE = """([tags, without]) => axe.run(document, {
  runOnly: tags,
  rules: Object.fromEntries(without.map(rule => [rule, { enabled: false }])),
  resultTypes: ["violations"],
}).then(found => found.violations)"""


# JavaScript that evaluates an expression again and again until it is true. This costs less than calls from
# Python. The page's content security policy forbids Playwright's own `page.wait_for_function`.
POLLED = """new Promise((done, fail) => {
  let left = %(looks)d;
  const look = async () => {
    try {
      if (await (%(expression)s)) done(true);
      else if (--left) setTimeout(look, %(look_ms)d);
      else done(false);
    } catch (error) {
      fail(error);
    }
  };
  look();
})"""


def until(page: Any, expression: str) -> None:
    """Wait until this JavaScript expression is true; the page may reload meanwhile."""

    def met() -> object:
        try:
            return page.evaluate(POLLED % {"expression": expression, "looks": 50, "look_ms": LOOK_MS})
        except Exception as failure:
            if "Execution context was destroyed" not in str(failure):
                raise
            return False

    until_met(page, met, expression)


def until_met(page: Any, met: Callable[[], object], what: str = "") -> None:
    """Wait until `met` returns a true value. Raises AssertionError after PATIENCE_S."""
    end = time.monotonic() + PATIENCE_S
    while not met():
        assert time.monotonic() < end, f"not within {PATIENCE_S:g} s: {what}; {told(page)}"
        page.wait_for_timeout(LOOK_MS)


def await_new_value(page: Any, shown: Callable[[], float]) -> None:
    """Wait until the page shows a value that the gateway made after this call.

    `shown` must return the frequency of the drive `FakeGateway.clocked`, which is the time in s, modulo 1000.
    """
    called_s = time.time()
    until_met(page, lambda: (shown() - called_s) % 1000 < 500)


def until_still(page: Any) -> None:
    """Wait until all animations have ended, except endless ones."""
    until(
        page,
        "document.getAnimations().every(a => a.effect.getTiming().iterations === Infinity"
        " || a.playState !== 'running')",
    )


PENDING: WeakKeyDictionary[Any, set[Any]] = WeakKeyDictionary()


def note_requests(page: Any) -> None:
    """Keep a set of the page's pending requests, except those to /api/frame, for `until_settled`."""
    pending = PENDING[page] = set[Any]()
    page.on("request", lambda request: "/api/frame" in request.url or pending.add(request))
    for event in ("requestfinished", "requestfailed"):
        page.on(event, lambda request: pending.discard(request))


def until_settled(page: Any) -> None:
    """Wait until only the request for the next message is pending, and all animations have ended."""
    page.wait_for_timeout(200)  # a view may send its requests up to 150 ms after it is opened
    until_met(page, lambda: not PENDING[page], "pending requests")
    until_still(page)


def aborting(*urls: str) -> Callable[[Any], None]:
    """Return a `prepare` for `opened` that makes requests for these URLs fail."""

    def prepare(page: Any) -> None:
        for url in urls:
            page.route(url, lambda route: route.abort())

    return prepare


def press_enter(page: Any) -> None:
    """Press Enter after the page was drawn twice: it ignores keys until an opened dialog is drawn."""
    page.evaluate("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
    page.keyboard.press("Enter")


def stop_all(page: Any) -> None:
    page.locator("#stopall").click()
    page.get_by_role("button", name="Stop all 10 drives").click()


def await_title(page: Any, title: str) -> None:
    """Wait until the dialog has this title."""
    page.get_by_role("heading", name=title, exact=True).wait_for()


def center(element: Any) -> tuple[float, float]:
    box = element.bounding_box()
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


def told(page: Any) -> str:
    """Return the texts in the page's header, for the message of a failed wait."""
    return str(
        page.evaluate("['link', 'notice'].map(id => document.getElementById(id).textContent).join(', ')")
    )


def cell(page: Any, drive: str, part: str) -> Any:
    """Return the cell of a drive and a column in the table of drives."""
    return page.locator("tr.drive", has=page.get_by_role("link", name=drive, exact=True)).locator(
        f"td.{part}"
    )


def link(page: Any) -> str:
    """Return the text about the connection in the page's header."""
    return str(page.locator("#link").inner_text().strip())


def violations(page: Any, *without: str) -> list[str]:
    """Return the violations that axe-core finds in the open view; `without` are rules to skip."""
    found = page.evaluate(RUN_AXE, [AXE_TAGS, without])
    return [f"{v['id']}: {node['target']} {node['failureSummary']}" for v in found for node in v["nodes"]]
