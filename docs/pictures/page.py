"""Take the picture of the page of `multidrop demo --web`: `python docs/pictures/page.py`.

This takes more than a minute, because the page's plots show the last minute. With a file name, a width and a
height as arguments, the picture has this size and is saved under this name. Needs `pip install '.[serve]'
playwright` and Chromium.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from pathlib import Path

from playwright.sync_api import sync_playwright

HERE = Path(__file__).parent
COMMAND = [str(Path(sys.executable).with_name("multidrop")), "demo", "--web", "--no-browser"]
MINUTE_S = 62.0  # s until the gateway has the values of a whole minute
SHOWN_MS = 5_000  # ms until the page has drawn its plots


def main(out: Path = HERE / "page.png", width: int = 1440, height: int = 900, place: str = "") -> None:
    names = ("chromium", "google-chrome", "chromium-headless-shell")
    chromium = next(filter(None, map(shutil.which, names)), None)
    with sync_playwright() as player, subprocess.Popen(COMMAND, stdout=subprocess.PIPE, text=True) as demo:
        try:
            assert demo.stdout is not None
            url = demo.stdout.readline().split()[1]
            time.sleep(MINUTE_S)
            browser = player.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
            page = browser.new_page(viewport={"width": width, "height": height}, color_scheme="light")
            page.goto(url + place)
            page.wait_for_timeout(SHOWN_MS)
            page.screenshot(path=out)
            browser.close()
        finally:
            demo.terminate()


if __name__ == "__main__":
    given = sys.argv[1:]
    if given:
        main(Path(given[0]), int(given[1]), int(given[2]), *given[3:])
    else:
        main(place="#/drives/fan-1")
