"""Take the picture of the gateway's page: `python docs/pictures/page.py`.

It shows the plant of the page's tests, with invented values, after a minute. Needs `pip install '.[test]'`
and Chromium.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from playwright.sync_api import sync_playwright

HERE = Path(__file__).parent
sys.path.append(str(HERE.parents[1] / "tests" / "page"))
WIDTH, HEIGHT = 1440, 900
MINUTE_MS = 62_000  # until the one-minute plots are full


def main() -> None:
    from fake_gateway import FakeGateway

    gateway = FakeGateway()
    gateway.has_history = False
    with sync_playwright() as playwright:
        chromium = shutil.which("chromium") or shutil.which("google-chrome")
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT}, color_scheme="light")
        page.goto(f"{gateway.url}#/drives/filler-2")
        page.wait_for_timeout(MINUTE_MS)
        page.screenshot(path=HERE / "page.png")
        browser.close()
    gateway.kill()


if __name__ == "__main__":
    main()
