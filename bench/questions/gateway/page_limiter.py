"""The delay that Chromium's network limiter adds, compared with a relay of the same rate.

A page in Chromium requests answers of several sizes, one after another, at random times. The limiter is
Network.emulateNetworkConditions, which `bench.questions.gateway.page` uses too.
"""

from __future__ import annotations

import argparse
import random
import shutil
import statistics
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from bench.players.slow_way import slow_way
from bench.support import tables

RATES = (8000, 4000)  # limited rates, in bytes per second
SIZES = (0, 300, 1000, 1300, 1600, 3000)  # bytes of an answer's body; its headers have 80 more
PAUSE_MS = 250  # longest pause between two requests
ASK = """async ([size, pauses]) => {
  const took = [];
  for (const pause of pauses) {
    await new Promise(done => setTimeout(done, pause));
    const begun = performance.now();
    await (await fetch(`/${size}`, { cache: 'no-store' })).text();
    took.push((performance.now() - begun) / 1000);
  }
  return took;
}"""


class Sized(BaseHTTPRequestHandler):
    """Answers a request with as many bytes as its path states."""

    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True

    def do_GET(self) -> None:
        size = self.path.strip("/")
        body = b"x" * (int(size) if size.isdigit() else 0)
        head = f"HTTP/1.1 200 OK\r\nContent-Type: text/html\r\nContent-Length: {len(body)}\r\n\r\n"
        self.wfile.write(head.encode() + body)

    def log_message(self, *words: object) -> None:
        """Log nothing."""


@contextmanager
def sized_answers() -> Iterator[int]:
    with ThreadingHTTPServer(("127.0.0.1", 0), Sized) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server.server_address[1]
        server.shutdown()


def rows(what: str, page: Any, count: int) -> Iterator[tuple[object, ...]]:
    chance = random.Random(1)
    for size in SIZES:
        took = sorted(page.evaluate(ASK, [size, [chance.uniform(0, PAUSE_MS) for _ in range(count)]]))
        yield what, size, *(f"{one:.3f}" for one in (took[0], statistics.median(took), took[-1]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--requests", type=int, default=40, help="of each size")
    count = parser.parse_args().requests
    from playwright.sync_api import sync_playwright

    tables.heading("What does Chromium's network limiter add to an answer?")
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))))
    found: list[tuple[object, ...]] = []
    with sync_playwright() as playwright, sized_answers() as port:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        for rate in RATES:
            page = browser.new_page()
            page.goto(f"http://127.0.0.1:{port}/")
            network = page.context.new_cdp_session(page)
            network.send("Network.enable")
            limits = {"downloadThroughput": rate, "uploadThroughput": rate}
            network.send("Network.emulateNetworkConditions", {"offline": False, "latency": 0, **limits})
            found += rows(f"{rate / 1000:g} kB/s, by Chromium", page, count)
            page.close()
        with slow_way(port) as way:
            page = browser.new_page()
            page.goto(f"http://127.0.0.1:{way.port}/")
            way.rate = RATES[0]
            found += rows(f"{RATES[0] / 1000:g} kB/s, by bytes", page, count)
        browser.close()
    tables.show(["way", "bytes", "s: least", "median", "most"], found)


if __name__ == "__main__":
    main()
