"""Run a Prometheus server that scrapes a gateway, and query it."""

from __future__ import annotations

import json
import subprocess
import urllib.parse
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from brokers import free_port
from lines import PATIENCE, until
from peers import require_program


class Prometheus:
    """A client of the HTTP API of a Prometheus server."""

    def __init__(self, port: int) -> None:
        self._url = f"http://127.0.0.1:{port}/api/v1/"

    def ask(self, path: str, **query: str) -> Any:
        url = f"{self._url}{path}?{urllib.parse.urlencode(query)}"
        with urllib.request.urlopen(url, timeout=PATIENCE) as answer:
            return json.load(answer)["data"]

    def is_there(self) -> bool:
        try:
            return bool(self.ask("targets")["activeTargets"])
        except OSError:
            return False

    def query(self, text: str) -> dict[tuple[str, ...], float]:
        """Return the present samples of a query, by the values of their labels."""
        found = self.ask("query", query=text)["result"]
        return {tuple(sorted(one["metric"].values())): float(one["value"][1]) for one in found}

    def targets(self) -> dict[str, tuple[str, str]]:
        """Return health and last error of the target of each job."""
        found = self.ask("targets")["activeTargets"]
        return {one["labels"]["job"]: (one["health"], one["lastError"]) for one in found}


@contextmanager
def scraping(folder: Path, jobs: str) -> Iterator[Prometheus]:
    program = require_program("prometheus")
    (folder / "prometheus.yml").write_text(jobs)
    port = free_port()
    command = [
        *(program, f"--config.file={folder}/prometheus.yml", f"--storage.tsdb.path={folder}/tsdb"),
        *(f"--web.listen-address=127.0.0.1:{port}", "--log.level=error"),
    ]
    with (folder / "prometheus.log").open("w") as log, subprocess.Popen(command, stderr=log) as process:
        try:
            found = Prometheus(port)
            until(lambda: process.poll() is not None or found.is_there())
            assert process.poll() is None, (folder / "prometheus.log").read_text()
            yield found
        finally:
            process.kill()
