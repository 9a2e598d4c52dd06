"""Fixtures: Chromium, a gateway with invented values, and its pages. Without Chromium, tests are skipped."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from typing import Any

import fake_plant
import pytest
from fake_gateway import FakeGateway
from namespaces import steady_network
from watching import LIVE, PATIENCE_S, SIZES, Opener, missing, until

# The first program is Chromium's engine without windows, which needs a third of the processor time.
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


@pytest.fixture
def gateway() -> Iterator[FakeGateway]:
    gateway = FakeGateway()
    yield gateway
    gateway.kill()


@pytest.fixture
def few_drives(monkeypatch: pytest.MonkeyPatch) -> int:
    """Reduce the plant to a few drives of every state, to save drawing time; return their number."""
    monkeypatch.setattr(fake_plant, "NAMES", fake_plant.FEW_NAMES)
    return len(" ".join(fake_plant.FEW_NAMES).split())


@pytest.fixture
def opened(browser: Any, gateway: FakeGateway) -> Iterator[Opener]:
    """Return a function that opens a view; the test fails if the page had an error or violated its CSP."""
    contexts, problems = [], []

    def open_page(view: str = "#/drives", size: str = "desk", live: bool = True, **options: Any) -> Any:
        width, height = SIZES[size]
        context = browser.new_context(viewport={"width": width, "height": height}, **options)
        context.set_default_timeout(PATIENCE_S * 1000)
        contexts.append(context)
        page = context.new_page()
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.on("console", lambda said: problems.append(said.text) if is_problem(said) else None)
        page.on("requestfailed", lambda request: print("failed:", request.url, request.failure))
        page.goto(gateway.url + view)
        if live:
            until(page, LIVE)
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert problems == []


@pytest.fixture
def page(browser: Any) -> Iterator[Any]:
    """A page without a gateway; the test fails if the page had an error or violated its CSP."""
    context = browser.new_context(viewport={"width": 1440, "height": 900})
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
