"""How old are the values on the gateway's page in Chromium: in 1 or 9 tabs, on a slow network, after a kill?

`multidrop serve` polls 31 drives on three simulated lines, with ten values of each every 0.1 s. A frame's age
is the viewer's clock minus the frame's time. It is measured when the frame arrives, and then every 10 ms
until the next frame arrives. The age of values is computed every 10 ms too: it is the age of the newest value
of a drive, for the drive with the greatest such age. A slow network is simulated by Chromium
(Network.emulateNetworkConditions), which counts whole packets of 1500 bytes, and then by a relay that counts
bytes.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from bench.players.slow_way import slow_way
from bench.support import tables
from multidrop import InvtCHE

LINES = (11, 10, 10)  # numbers of drives on each line
SLOW = 8000  # rate of the slow network, in bytes per second
LOOK_MS = 10
AGES = """async ([seconds, every]) => {
  const { store } = await import('/page/data/store.js');
  const end = performance.now() + seconds * 1000, shown = [], came = [];
  let n = store.frame.n;
  while (performance.now() < end) {
    const now = Date.now();
    const values = [...store.drives.values()].map(d => d.newest.get('output_frequency').ms);
    shown.push([now - store.time, now - Math.min(...values)]);
    if (n !== store.frame.n) came.push(now - store.time);
    n = store.frame.n;
    await new Promise(done => setTimeout(done, every));
  }
  return [came, shown, document.hidden];
}"""
STALE = "document.body.classList.contains('stale')"
LIVE = "document.querySelector('#link').textContent.trim() === 'live'"


def plant_text(ports: Path) -> str:
    names = [register.name for register in InvtCHE.readings()][:10]
    text, number = '[serve]\nlisten = "127.0.0.1:0"\n', 0
    for line, drives in enumerate(LINES, 1):
        text += f'[[line]]\nname = "hall-{line}"\nport = "{ports}/hall-{line}"\nbaudrate = 38400\n'
        for address in range(1, drives + 1):
            number += 1
            text += f'[[line.drive]]\nname = "drive-{number}"\nmodel = "invt-che"\naddress = {address}\n'
            text += f'every = "100 ms"\npoll = {names}\n'
    return text


@contextmanager
def program(*words: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Run a multidrop command; yield its process, and the first line that it prints."""
    command = [sys.executable, "-m", "multidrop", *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            yield process, process.stdout.readline()
        finally:
            process.kill()


def until(page: Any, expression: str) -> float:
    began = time.monotonic()
    while not page.evaluate(expression):
        time.sleep(0.01)
    return time.monotonic() - began


def opened(context: Any, url: str, bytes_a_second: int | None = None) -> Any:
    """Open the page, wait until it shows live values, and return it. Then limit its network, if requested."""
    page = context.new_page()
    page.goto(url)
    until(page, LIVE)
    if bytes_a_second is not None:
        network = context.new_cdp_session(page)
        network.send("Network.enable")
        limits = {"downloadThroughput": bytes_a_second, "uploadThroughput": bytes_a_second}
        network.send("Network.emulateNetworkConditions", {"offline": False, "latency": 0, **limits})
    return page


def row(what: str, pages: list[Any], seconds: float) -> list[object]:
    """Measure each page for `seconds`, one after another, while all are open; return a row of the table."""
    arrived: list[float] = []
    frames: list[float] = []
    values: list[float] = []
    hidden = 0
    for page in pages:
        came, shown, is_hidden = page.evaluate(AGES, [seconds, LOOK_MS])
        arrived += [age / 1000 for age in came]
        frames += [age / 1000 for age, _ in shown]
        values += [age / 1000 for _, age in shown]
        hidden += is_hidden
    a_second = f"{len(arrived) / seconds / len(pages):.1f}"
    return [what, hidden, a_second, *figures(arrived), *figures(frames), *figures(values)]


def figures(ages: list[float]) -> list[str]:
    """Return the median and the 99th percentile of the ages, in s."""
    cut = statistics.quantiles(ages, n=100)
    return [f"{statistics.median(ages):.2f}", f"{min(cut[98], max(ages)):.2f}"]


def frame_sizes(url: str) -> str:
    """Return a text with the sizes of a whole frame and of one with changes only, compressed and unpacked."""
    import gzip
    import urllib.request

    def packed(query: str) -> bytes:
        request = urllib.request.Request(f"{url}api/frame{query}", headers={"accept-encoding": "gzip"})
        with urllib.request.urlopen(request) as answer:
            found: bytes = answer.read()
        return found

    whole = packed("")
    changes = packed(f"?after={json.loads(gzip.decompress(whole))['n']}")
    sizes = [
        f"{len(one)} bytes on the wire, {len(gzip.decompress(one))} unpacked" for one in (whole, changes)
    ]
    return f"a whole frame has {sizes[0]}; what changed since the one before {sizes[1]}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0, help="duration of each row")
    parser.add_argument("--kills", type=int, default=5, help="of the gateway")
    arguments = parser.parse_args()
    from playwright.sync_api import sync_playwright

    tables.heading("How old are the values on the page?")
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))))
    with TemporaryDirectory() as directory, sync_playwright() as playwright:
        plant = Path(directory) / "plant.toml"
        plant.write_text(plant_text(Path(directory)))
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        with program("simulate", str(plant), "--ports", directory, "--unpaced"):
            with program("serve", str(plant)) as (_, ready):
                url = ready.split()[-1]
                rows = []
                context = browser.new_context()
                rows.append(row("1 tab", [opened(context, url)], arguments.seconds))
                context.close()
                context = browser.new_context()
                pages = [opened(context, url) for _ in range(9)]
                rows.append(row("9 tabs", pages, arguments.seconds / 9))
                context.close()
                context = browser.new_context()
                slow = opened(context, url, SLOW)
                slow.wait_for_timeout(2000)
                rows.append(row("1 tab at 8 kB/s, by Chromium", [slow], arguments.seconds))
                context.close()
                with slow_way(int(url.rstrip("/").rpartition(":")[2])) as way:
                    context = browser.new_context()
                    slow = opened(context, f"http://localhost:{way.port}/")
                    way.rate = SLOW
                    slow.wait_for_timeout(2000)
                    rows.append(row("1 tab at 8 kB/s, by bytes", [slow], arguments.seconds))
                    context.close()
                print(frame_sizes(url))
            print()
            columns = [
                "hidden tabs",
                "frames/s",
                "s old when it comes: median",
                "p99",
                "while shown: median",
                "p99",
            ]
            tables.show(["viewer", *columns, "a value, while shown: median", "p99"], rows)
            print()
            found = []
            for _ in range(arguments.kills):
                with program("serve", str(plant)) as (served, ready):
                    context = browser.new_context()
                    page = opened(context, re.sub("127.0.0.1", "localhost", ready.split()[-1]))
                    served.send_signal(signal.SIGKILL)
                    found.append(until(page, STALE))
                    context.close()
            columns = ["gateways killed", "s until the page says so: median", "longest"]
            tables.show(columns, [[len(found), f"{statistics.median(found):.2f}", f"{max(found):.2f}"]])
        browser.close()


if __name__ == "__main__":
    main()
