"""Fixtures: Chromium, a gateway with invented values, and its pages. Without Chromium, tests are skipped."""

from __future__ import annotations

import json
import shutil
import socket
from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib.resources import files
from typing import Any

import fake_plant
import pytest
from fake_gateway import FakeGateway
from namespaces import steady_network
from watching import LIVE, PATIENCE_S, SIZES, Opener, missing, note_requests, until

# The first program draws no windows, so it needs a third of the processor time of the others.
BROWSERS = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
OPTIONS = ("--no-sandbox", "--host-resolver-rules=MAP evil.example 127.0.0.1")  # for DNS rebinding


# Scope "module": playwright keeps an event loop running in this thread, which would break other tests.
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
    """Reserve a port for all gateways of a file, so that the browser's cache keeps the page's files."""
    with socket.socket() as reserved:
        reserved.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        reserved.bind(("127.0.0.1", 0))
        yield reserved.getsockname()[1]


@pytest.fixture
def gateway(port: int) -> Iterator[FakeGateway]:
    gateway = FakeGateway(port)
    yield gateway
    gateway.kill()


@pytest.fixture(scope="module")
def context_with(browser: Any) -> Iterator[Callable[..., Any]]:
    """Yield a function that takes options and returns a browser context, one per test file and options."""
    made: dict[str, Any] = {}

    def context_with(**options: Any) -> Any:
        key = json.dumps(options, sort_keys=True)
        if key not in made:
            made[key] = browser.new_context(**options)
            made[key].set_default_timeout(PATIENCE_S * 1000)
        return made[key]

    yield context_with
    for context in made.values():
        context.close()


@pytest.fixture
def few_drives(monkeypatch: pytest.MonkeyPatch) -> int:
    """Reduce the plant to a few drives of every state, to save drawing time; return their number."""
    monkeypatch.setattr(fake_plant, "NAMES", fake_plant.FEW_NAMES)
    return len(" ".join(fake_plant.FEW_NAMES).split())


@pytest.fixture
def opened(context_with: Callable[..., Any], gateway: FakeGateway) -> Iterator[Opener]:
    """Return a function that opens a view; the test fails if the page had an error or violated its CSP.

    `prepare` is called with the page before it is loaded.
    """
    pages, problems = [], []

    def open_page(
        view: str = "#/drives",
        size: str = "desk",
        live: bool = True,
        prepare: Callable[[Any], object] = lambda page: None,
        **options: Any,
    ) -> Any:
        width, height = SIZES[size]
        viewport = {"width": width, "height": height}
        page = context_with(viewport=viewport, **{"locale": "en-US", **options}).new_page()
        pages.append(page)
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.on("console", lambda said: problems.append(said.text) if is_problem(said) else None)
        page.on("requestfailed", lambda request: print("failed:", request.url, request.failure))
        note_requests(page)
        prepare(page)
        page.goto(gateway.url + view)
        if live:
            until(page, LIVE)
        return page

    yield open_page
    for page in pages:
        with suppress(Exception):  # the test may have forbidden storage
            page.evaluate("localStorage.clear()")
        page.context.clear_cookies()
        page.close()
    assert problems == []


@pytest.fixture
def page(browser: Any) -> Iterator[Any]:
    """A page without a gateway; the test fails if the page had an error or violated its CSP."""
    context = browser.new_context(viewport={"width": 1440, "height": 900}, locale="en-US")
    context.set_default_timeout(PATIENCE_S * 1000)
    page, problems = context.new_page(), []
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.on("console", lambda said: problems.append(said.text) if is_problem(said) else None)
    yield page
    context.close()
    assert problems == []


def is_problem(said: Any) -> bool:
    """Return True for errors other than failed requests, which some tests cause."""
    return said.type in ("error", "warning") and "Failed to load resource" not in said.text


@pytest.fixture(scope="module")
def axe() -> str:
    """The script of axe-core."""
    try:
        return (files("axe_playwright_python") / "axe.min.js").read_text("utf-8")
    except ImportError:
        missing("axe-playwright-python is not installed")
