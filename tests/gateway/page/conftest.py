"""Fixtures: Chromium, a fake gateway, and its web pages. Without Chromium, these tests are skipped."""

from __future__ import annotations

import json
import shutil
import socket
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from importlib.resources import files
from typing import Any

import fake_plant
import pytest
from fake_gateway import FakeGateway
from namespaces import steady_network
from watching import LIVE, PATIENCE_S, SIZES, Opener, missing, note_requests, until

# The first program has no windows, so it needs a third of the others' processor time.
BROWSERS = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
# evil.example resolves to this machine, for tests of DNS rebinding
OPTIONS = ("--no-sandbox", "--host-resolver-rules=MAP evil.example 127.0.0.1")


# Once per file, because playwright keeps an event loop running in this thread, which would break other tests.
@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        missing("playwright is not installed")
    chromium = next(filter(None, map(shutil.which, BROWSERS)), None)
    if chromium is None:
        missing("no Chromium is installed")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=OPTIONS)
        yield browser
        browser.close()


@pytest.fixture(autouse=True)
def _steady() -> Iterator[None]:
    with steady_network():
        yield


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    """Reserve a port for the gateways of a test file, so that the browser's cache keeps the page's files."""
    with socket.socket() as reserved:
        reserved.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        reserved.bind(("127.0.0.1", 0))
        yield reserved.getsockname()[1]


@pytest.fixture
def gateway(port: int) -> Iterator[FakeGateway]:
    gateway = FakeGateway(port)
    yield gateway
    gateway.kill()


class Tab:
    """A browser tab that tests use one after the other, because each new tab costs a process."""

    def __init__(self, context: Any) -> None:
        self.page = context.new_page()
        self.problems: list[str] = []
        note_problems(self.page, self.problems)
        self.page.on("requestfailed", lambda request: print("failed:", request.url, request.failure))
        note_requests(self.page)

    def leave(self) -> None:
        """Leave the gateway's web page, and reset everything that a test may have changed."""
        self.page.unroute_all(behavior="ignoreErrors")
        with suppress(Exception):  # storage may be forbidden in this test
            self.page.evaluate("localStorage.clear()")
        self.page.context.clear_cookies()
        self.page.mouse.move(0, 0)
        self.page.goto("about:blank")


@pytest.fixture(scope="module")
def tab_with(browser: Any) -> Iterator[Callable[..., AbstractContextManager[Tab]]]:
    """Yield a function that takes options for a browser context, and returns an unused tab that has them."""
    contexts: dict[str, Any] = {}
    unused: defaultdict[str, list[Tab]] = defaultdict(list)

    @contextmanager
    def tab_with(is_reusable: bool, **options: Any) -> Iterator[Tab]:
        key = json.dumps(options, sort_keys=True)
        if key not in contexts:
            contexts[key] = browser.new_context(**options)
            contexts[key].set_default_timeout(PATIENCE_S * 1000)
        tab = unused[key].pop() if is_reusable and unused[key] else Tab(contexts[key])
        tab.problems.clear()
        yield tab
        tab.leave()
        if is_reusable:
            unused[key].append(tab)
        else:
            tab.page.close()

    yield tab_with
    for context in contexts.values():
        context.close()


@pytest.fixture
def many_drives(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give the fake plant 31 drives, the most on one line."""
    monkeypatch.setattr(fake_plant, "NAMES", fake_plant.MANY_NAMES)


@pytest.fixture
def opened(tab_with: Callable[..., AbstractContextManager[Tab]], gateway: FakeGateway) -> Iterator[Opener]:
    """Return a function that opens a view of the web page.

    The test fails if the page had an error or violated its content security policy (CSP). The page is passed
    to `prepare` before it is loaded.
    """
    with ExitStack() as tabs:
        problems: list[list[str]] = []

        def open_page(
            view: str = "#/drives",
            size: str = "desk",
            live: bool = True,
            prepare: Callable[[Any], object] | None = None,
            **options: Any,
        ) -> Any:
            width, height = SIZES[size]
            viewport = {"width": width, "height": height}
            chosen = {"viewport": viewport, "locale": "en-US", **options}
            tab = tabs.enter_context(tab_with(prepare is None, **chosen))
            problems.append(tab.problems)
            tab.page.set_viewport_size(viewport)
            if prepare is not None:
                prepare(tab.page)
            tab.page.goto(gateway.url + view)
            if live:
                until(tab.page, LIVE)
            return tab.page

        yield open_page
    assert [each for each in problems if each] == []


@pytest.fixture
def page(browser: Any) -> Iterator[Any]:
    """An empty browser page without a gateway. The test fails if it has an error or violates its CSP."""
    context = browser.new_context(viewport={"width": 1440, "height": 900}, locale="en-US")
    context.set_default_timeout(PATIENCE_S * 1000)
    page, problems = context.new_page(), list[str]()
    note_problems(page, problems)
    yield page
    context.close()
    assert problems == []


def note_problems(page: Any, problems: list[str]) -> None:
    """Append the page's errors and CSP violations to a list, as they occur."""
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.on("console", lambda said: problems.append(said.text) if is_problem(said) else None)


def is_problem(said: Any) -> bool:
    """Return True for errors and warnings, except about failed requests, which some tests cause."""
    return said.type in ("error", "warning") and "Failed to load resource" not in said.text


@pytest.fixture(scope="module")
def axe() -> str:
    """Return the script of axe-core, which checks accessibility."""
    try:
        return (files("axe_playwright_python") / "axe.min.js").read_text("utf-8")
    except ImportError:
        missing("axe-playwright-python is not installed")
