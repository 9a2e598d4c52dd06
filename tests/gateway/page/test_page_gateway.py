"""The page with a real gateway, which polls and stops a simulated plant."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from statistics import median
from typing import Any

import pytest
from gateways import served
from lines import until as until_here
from watching import LIVE, STALE, cell, until, until_met

pytestmark = pytest.mark.long  # Chromium is started for each file


def test_page_shows_and_stops_a_polled_plant(page: Any, tmp_path: Path) -> None:
    with served(tmp_path, '[serve.may]\nstop = "anyone"\n') as gateway:
        page.goto(f"http://localhost:{gateway.gateway.port}/")
        until(page, LIVE)
        assert page.locator("tr.drive").count() == 2
        until(page, "document.querySelectorAll('tr.drive.stands').length === 2")
        until_met(page, lambda: cell(page, "pump-1", "frequency").inner_text().strip() == "0.00Hz")
        for view, text in (
            ("lines", "Line time used"),
            ("faults", "Active: 0"),
            ("log", "No writes yet."),
        ):
            page.evaluate("view => { location.hash = `#/${view}` }", view)
            page.locator(f"#{view}").get_by_text(text).first.wait_for()
        page.locator("#stopall").click()
        page.get_by_role("button", name="Stop all 2 drives").click()
        page.get_by_role("heading", name="All 2 drives are stopped").wait_for()
        page.keyboard.press("Escape")
        until_here(lambda: gateway.get("/api/audit").json["entries"])
        page.evaluate("location.hash = '#/drives'")
        page.evaluate("location.hash = '#/log'")
        page.locator("#log-list tbody tr").first.wait_for()


def test_stop_asks_for_a_token_if_the_gateway_needs_one(page: Any, tmp_path: Path) -> None:
    with served(tmp_path) as gateway:
        page.goto(f"http://localhost:{gateway.gateway.port}/")
        until(page, LIVE)
        page.keyboard.press("Shift+S")
        page.get_by_role("button", name="Stop all 2 drives").click()
        page.get_by_label("Token").fill(
            next(s for right, s in gateway.secrets.items() if right.name == "STOP")
        )
        page.get_by_role("button", name="Sign in and send").click()
        page.get_by_role("heading", name="All 2 drives are stopped").wait_for()
        until(page, "document.querySelector('#role').textContent === 'may stop'")


def test_a_killed_gateway_is_reported(page: Any) -> None:
    command = [sys.executable, "-m", "multidrop", "serve", "--demo", "--no-browser"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        assert process.stdout is not None
        url = next(found[0] for line in process.stdout if (found := re.search(r"http://\S+", line)))
        page.goto(url)
        until(page, LIVE)
        assert page.locator("tr.drive").count() == 17
        tasks = Path(f"/proc/{process.pid}/task").glob("*/children")
        simulators = " ".join(task.read_text() for task in tasks).split()
        process.send_signal(signal.SIGKILL)
        for simulator in simulators:
            os.kill(int(simulator), signal.SIGTERM)
        until(page, STALE)
        assert "cannot be reached" in page.locator("#notice").inner_text()
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def test_delay_of_a_viewer_with_8_kb_a_second_does_not_grow(page: Any, tmp_path: Path) -> None:
    """`python -m bench.questions.page` measures the age of the shown values."""
    with served(tmp_path, "", *(f"drive-{n}" for n in range(1, 13))) as gateway:
        page.goto(f"http://localhost:{gateway.gateway.port}/")
        until(page, LIVE)
        network = page.context.new_cdp_session(page)
        network.send("Network.enable")
        limits = {"latency": 0, "downloadThroughput": 8000, "uploadThroughput": 8000}
        network.send("Network.emulateNetworkConditions", {"offline": False, **limits})
        look = """import('/page/store.js').then(m => [m.store.frame.n, Date.now() - m.store.time])"""
        seen = []
        for _ in range(60):
            seen.append(page.evaluate(look))
            page.wait_for_timeout(100)
        numbers, ages = zip(*seen, strict=True)
        assert len(set(numbers)) > 5
        assert list(numbers) == sorted(numbers)
        until_met(page, lambda: page.evaluate(look)[1] < median(ages[10:30]) + 1000)
        assert gateway.gateway.frames.viewers <= 1
        until(page, LIVE)
