"""Take the picture of the gateway's page: `python docs/pictures/page.py`.

It shows the simulated plant of `multidrop serve --demo` after a minute. Needs `pip install '.[test]'` and
Chromium.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

from playwright.sync_api import sync_playwright

PICTURE = Path(__file__).with_name("page.png")
COMMAND = [sys.executable, "-m", "multidrop", "serve", "--demo", "--no-browser"]
WIDTH, HEIGHT = 1440, 900
MINUTE_MS = 62_000  # until the plots of a minute are full


def main() -> None:
    process = subprocess.Popen(COMMAND, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    assert process.stdout is not None
    try:
        url = next(found[0] for line in process.stdout if (found := re.search(r"http://\S+", line)))
        with sync_playwright() as playwright:
            chromium = shutil.which("chromium") or shutil.which("google-chrome")
            browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
            page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT}, color_scheme="light")
            page.goto(url + "#/drives/che")
            page.wait_for_timeout(MINUTE_MS)
            page.screenshot(path=PICTURE)
            browser.close()
    finally:
        process.terminate()
        process.wait()
        process.stdout.close()


if __name__ == "__main__":
    main()
