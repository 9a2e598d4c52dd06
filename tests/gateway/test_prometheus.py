"""Prometheus itself scrapes the gateway: up at one scrape a second, and a silent drive's series are stale."""

from __future__ import annotations

import json
import subprocess
import urllib.parse
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from brokers import free_port
from gateways import served
from lines import PATIENCE, until
from peers import require_program

from multidrop.gateway.http.rights import Right

JOBS = """
global: {{scrape_interval: 1s}}
scrape_configs:
  - job_name: stranger
    static_configs: [{{targets: ["127.0.0.1:{port}"]}}]
  - job_name: known
    authorization: {{credentials: "{secret}"}}
    static_configs: [{{targets: ["127.0.0.1:{port}"]}}]
"""
SAMPLES = 'multidrop_value{job="known"}'


class Prometheus:
    """Questions to a Prometheus, over its HTTP API."""

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
        """Return the samples of this moment, by their labels' values."""
        found = self.ask("query", query=text)["result"]
        return {tuple(sorted(one["metric"].values())): float(one["value"][1]) for one in found}

    def drives(self) -> set[str]:
        return {name for (name,) in self.query(f"count by (drive) ({SAMPLES})")}

    def targets(self) -> dict[str, tuple[str, str]]:
        """Return health and error of each job."""
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


@pytest.mark.slow
@pytest.mark.long
def test_prometheus_scrapes_each_second_and_a_silent_drive_is_stale(tmp_path: Path) -> None:
    with served(tmp_path, '[serve]\ntokens = "tokens"\n[serve.may]\nlook = "token"\n') as gateway:
        jobs = JOBS.format(port=gateway.gateway.port, secret=gateway.secrets[Right.LOOK])
        with scraping(tmp_path, jobs) as prometheus:
            until(lambda: prometheus.drives() == {"pump-1", "pump-2"})
            until(lambda: prometheus.targets()["stranger"][0] != "unknown")  # not scraped yet
            assert prometheus.targets() == {
                "known": ("up", ""),
                "stranger": ("down", "server returned HTTP status 401 Unauthorized"),
            }
            read_as = prometheus.ask("targets/metadata", metric="multidrop_drive_state", limit="1")
            assert [one["type"] for one in read_as] == ["stateset"]  # by the parser of OpenMetrics

            gateway.sims["pump-2"].deaf_until = float("inf")
            # Without a mark that they ended, its values would be given for five minutes.
            until(lambda: prometheus.drives() == {"pump-1"})
            states = prometheus.query('multidrop_drive_state{job="known", drive="pump-2"} == 1')
            assert [1 for labels in states if "silent" in labels] == [1]
            until(
                lambda: all(n >= 5 for n in prometheus.query('count_over_time(up{job="known"}[5s])').values())
            )
            assert prometheus.query('min_over_time(up{job="known"}[5s])').popitem()[1] == 1.0
            assert (
                prometheus.query('increase(multidrop_line_samples_total{job="known"}[4s])').popitem()[1] > 0
            )

            gateway.sims["pump-2"].deaf_until = 0.0
            until(lambda: prometheus.drives() == {"pump-1", "pump-2"})


@pytest.mark.slow
def test_promtool_finds_nothing_to_say_of_the_metrics(tmp_path: Path) -> None:
    program = require_program("promtool")
    with served(tmp_path, '[serve.history]\nfolder = "history"\n', "pump-1", 'the \\"old\\" fan') as gateway:
        gateway.await_state("pump-1", "stands")
        until(lambda: b"multidrop_line_samples_total{" in gateway.get("/metrics").body)
        answer = gateway.get("/metrics", accept="*/*")
        assert answer.headers["content-type"] == "text/plain; version=0.0.4; charset=utf-8"
        checked = subprocess.run([program, "check", "metrics"], input=answer.body, capture_output=True)
        assert (checked.returncode, checked.stdout, checked.stderr) == (0, b"", b"")
        assert b"multidrop_value{" in answer.body
