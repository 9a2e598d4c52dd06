"""Metrics in the OpenMetrics format, read by the parser of prometheus_client and by Prometheus itself."""

from __future__ import annotations

import json
import os
import re
import subprocess
import time
import urllib.parse
import urllib.request
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
import yaml
from commands import BoundProcess
from free_ports import free_port
from gateways import Served, served, serving
from lines import PATIENCE, until
from peers import require_program

from multidrop import exposition
from multidrop.exposition import MetricFamily, expose_metrics
from multidrop.gateway.http.files import PAGE
from multidrop.gateway.http.rights import Right


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
        """Return the present value of each series that a query finds, by the values of its labels."""
        found = self.ask("query", query=text)["result"]
        return {tuple(sorted(one["metric"].values())): float(one["value"][1]) for one in found}

    def targets(self) -> dict[str, tuple[str, str]]:
        """Return the health and the last error of each scrape job's target."""
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
    with (folder / "prometheus.log").open("w") as log, BoundProcess(command, stderr=log) as process:
        found = Prometheus(port)
        until(lambda: process.poll() is not None or found.is_there())
        assert process.poll() is None, (folder / "prometheus.log").read_text()
        yield found
        process.kill()


try:
    from prometheus_client.openmetrics.parser import text_string_to_metric_families as parse
except ImportError:
    if os.environ.get("CI"):
        raise
    pytest.skip("prometheus-client, which is the judge, is not installed", allow_module_level=True)


def families(gateway: Served) -> dict[str, Any]:
    answer = gateway.get("/metrics", accept="application/openmetrics-text; version=1.0.0")
    assert answer.headers["content-type"] == "application/openmetrics-text; version=1.0.0; charset=utf-8"
    return {family.name: family for family in parse(answer.body.decode())}


def values(gateway: Served) -> dict[tuple[str, str], float]:
    found = [
        one
        for name, family in families(gateway).items()
        if name.startswith("multidrop_register_") and name != "multidrop_register_age_seconds"
        for one in family.samples
    ]
    return {(one.labels["drive"], one.labels["register"]): one.value for one in found}


def process_start() -> float:
    """Return the start time of this process in s since 1970, as `ps` reports it."""
    age = subprocess.run(["ps", "-o", "etimes=", "-p", str(os.getpid())], capture_output=True, text=True)
    return time.time() - int(age.stdout)


def states(gateway: Served) -> dict[str, str]:
    found = families(gateway)["multidrop_drive_state"].samples
    return {one.labels["drive"]: one.labels["multidrop_drive_state"] for one in found if one.value}


@pytest.mark.long
def test_metrics_contain_values_states_and_counters(tmp_path: Path) -> None:
    odd = 'fan, the \\"old\\" one'  # escaped for a TOML string
    with served(tmp_path, "", "pump-1", odd) as gateway:
        until(lambda: len(values(gateway)) == 8)
        found = families(gateway)
        assert values(gateway)["pump-1", "status"] == 3.0
        assert values(gateway)['fan, the "old" one', "fault"] == 0.0
        assert states(gateway) == {"pump-1": "stands", 'fan, the "old" one': "stands"}
        labels = {"line": "hall", "drive": "pump-1", "register": "output_current"}
        assert labels in [one.labels for one in found["multidrop_register_amperes"].samples]
        assert {one.value < 60 for one in found["multidrop_register_age_seconds"].samples} == {True}
        about = {"line": "hall", "drive": "pump-1", "model": "invt-che", "address": "1"}
        assert about in [one.labels for one in found["multidrop_drive"].samples]
        alarms = [one.value for one in found["multidrop_alarm_active"].samples]
        # 9 series: the kind `port` for one line, and four other kinds for each of two drives
        assert alarms == [0.0] * 9
        health = {one.labels["multidrop_health"]: one.value for one in found["multidrop_health"].samples}
        assert health == {"ok": 1.0, "degraded": 0.0, "failed": 0.0}
        assert found["process_open_fds"].samples[0].value > 5
        assert abs(found["process_start_time_seconds"].samples[0].value - process_start()) < 60
        until(lambda: families(gateway)["multidrop_line_samples"].samples[0].value > 8)
        assert found["multidrop_line_samples"].type == "counter"
        assert found["multidrop_build"].samples[0].labels == {"version": gateway.gateway.version}
        delays = {  # delays appear when a drive has replied; updated once a second
            (one.name.removeprefix("multidrop_response_delay_seconds"), one.labels.get("quantile"))
            for one in families(gateway)["multidrop_response_delay_seconds"].samples
        }
        assert delays == {("", "0.5"), ("", "0.9"), ("", "0.99"), ("_count", None)}


def unanswered(gateway: Served) -> float:
    misses = families(gateway)["multidrop_misses"].samples
    return sum(float(one.value) for one in misses if one.labels["reason"] == "no reply")


@pytest.mark.long
@pytest.mark.slow
def test_metrics_of_a_silent_drive_disappear_until_it_answers(tmp_path: Path) -> None:
    with served(tmp_path) as gateway:
        until(lambda: len(values(gateway)) == 8)
        gateway.sims["pump-2"].deaf_until = float("inf")
        until(lambda: states(gateway)["pump-2"] == "silent")
        assert {drive for drive, _ in values(gateway)} == {"pump-1"}
        until(lambda: unanswered(gateway) > 0)  # the counter is updated once a second
        gateway.sims["pump-2"].deaf_until = 0.0
        until(lambda: len(values(gateway)) == 8)
        assert states(gateway)["pump-2"] == "stands"


def test_label_texts_are_cached_between_scrapes(monkeypatch: pytest.MonkeyPatch) -> None:
    spelled: list[str] = []
    escaped = exposition._escaped

    def note(text: str) -> str:
        spelled.append(text)
        return escaped(text)

    exposition._braced.cache_clear()
    monkeypatch.setattr(exposition, "_escaped", note)

    def scrape(value: float) -> str:
        labels: list[Mapping[str, str]] = [{"drive": 'the "old"\\fan'}, {"drive": "pump-1"}, {}]
        samples = [("", each, value) for each in labels]
        return expose_metrics([MetricFamily("speed", "gauge", "In rpm.", samples)], "")[1]

    told = [scrape(value).splitlines()[2:] for value in (1.0, 2.0)]
    assert told[0] == [r'speed{drive="the \"old\"\\fan"} 1.0', 'speed{drive="pump-1"} 1.0', "speed 1.0"]
    assert told[1] == [line.replace(" 1.0", " 2.0") for line in told[0]]
    assert spelled == ['the "old"\\fan', "pump-1"]


JOBS = """
global: {{scrape_interval: 1s}}
scrape_configs:
  - job_name: stranger
    static_configs: [{{targets: ["127.0.0.1:{port}"]}}]
  - job_name: known
    authorization: {{credentials: "{secret}"}}
    static_configs: [{{targets: ["127.0.0.1:{port}"]}}]
"""
SAMPLES = 'multidrop_register_hertz{job="known"}'


def drives(prometheus: Prometheus) -> set[str]:
    return {name for (name,) in prometheus.query(f"count by (drive) ({SAMPLES})")}


@pytest.mark.slow
@pytest.mark.long
def test_prometheus_marks_values_of_a_silent_drive_as_stale(tmp_path: Path) -> None:
    with served(tmp_path, '[serve]\ntokens = "tokens"\n[serve.may]\nlook = "token"\n') as gateway:
        jobs = JOBS.format(port=gateway.gateway.port, secret=gateway.secrets[Right.LOOK])
        with scraping(tmp_path, jobs) as prometheus:
            until(lambda: drives(prometheus) == {"pump-1", "pump-2"})
            # wait until Prometheus has tried this target
            until(lambda: prometheus.targets()["stranger"][0] != "unknown")
            assert prometheus.targets() == {
                "known": ("up", ""),
                "stranger": ("down", "server returned HTTP status 401 Unauthorized"),
            }
            read_as = prometheus.ask("targets/metadata", metric="multidrop_drive_state", limit="1")
            assert [one["type"] for one in read_as] == ["stateset"]  # this type exists only in OpenMetrics

            gateway.sims["pump-2"].deaf_until = float("inf")
            # Without staleness markers, Prometheus would return the last values of a drive for five minutes.
            until(lambda: drives(prometheus) == {"pump-1"})
            silent = 'multidrop_drive_state{job="known", drive="pump-2", multidrop_drive_state="silent"} == 1'
            until(lambda: len(prometheus.query(silent)) == 1)
            until(
                lambda: all(n >= 5 for n in prometheus.query('count_over_time(up{job="known"}[5s])').values())
            )
            assert prometheus.query('min_over_time(up{job="known"}[5s])').popitem()[1] == 1.0
            assert (
                prometheus.query('increase(multidrop_line_samples_total{job="known"}[4s])').popitem()[1] > 0
            )

            gateway.sims["pump-2"].deaf_until = 0.0
            until(lambda: drives(prometheus) == {"pump-1", "pump-2"})


@pytest.mark.slow
def test_promtool_accepts_the_metrics(tmp_path: Path) -> None:
    program = require_program("promtool")
    with served(tmp_path, '[serve.history]\nfolder = "history"\n', "pump-1", 'the \\"old\\" fan') as gateway:
        gateway.await_state("pump-1", "stands")
        until(lambda: b"multidrop_register_amperes{" in gateway.get("/metrics").body)
        answer = gateway.get("/metrics", accept="*/*")
        assert answer.headers["content-type"] == "text/plain; version=0.0.4; charset=utf-8"
        checked = subprocess.run([program, "check", "metrics"], input=answer.body, capture_output=True)
        assert (checked.returncode, checked.stdout, checked.stderr) == (0, b"", b"")


FOLDER = PAGE / "prometheus"
DASHBOARD, ALERTS = FOLDER / "dashboard.json", FOLDER / "alerts.yml"
JOB = """
global: {{scrape_interval: 1s}}
scrape_configs:
  - job_name: multidrop
    static_configs: [{{targets: ["127.0.0.1:{port}"]}}]
"""


def alerts() -> Iterator[tuple[str, str]]:
    """Yield the name and the expression of each alert rule."""
    for group in yaml.safe_load(ALERTS.read_text())["groups"]:
        for rule in group["rules"]:
            yield rule["alert"], rule["expr"]


def queries() -> Iterator[tuple[str, str]]:
    """Yield (name, query) for each query of the dashboard, and for each alert without its threshold."""
    dashboard = json.loads(DASHBOARD.read_text())
    for panel in dashboard["panels"]:
        for target in panel["targets"]:
            found = re.sub(r"\$(instance|line|drive)\b", ".*", target["expr"])
            yield panel["title"], found.replace("$__rate_interval", "5s")
    for variable in dashboard["templating"]["list"]:
        if variable["type"] == "query":
            found = re.sub(r"\$(instance|line|drive)\b", ".*", variable["definition"])
            yield variable["name"], re.sub(r"label_values\((.*), (\w+)\)", r"count by (\2) (\1)", found)
    for name, expression in alerts():
        yield name, re.sub(r" (==|>) [\d.]+$", "", expression)


def empty(prometheus: Prometheus) -> list[tuple[str, str]]:
    """Return the queries that find no data."""
    return [(name, text) for name, text in queries() if not prometheus.query(text)]


@pytest.mark.slow
@pytest.mark.long
def test_prometheus_has_data_for_each_query_of_the_dashboard_and_the_alerts(tmp_path: Path) -> None:
    with serving(Path("--demo"), "--no-browser") as (_, url):
        port = int(url.rstrip("/").rpartition(":")[2])
        with scraping(tmp_path, JOB.format(port=port)) as prometheus:
            until(lambda: len(prometheus.query('multidrop_register_hertz{register="output_frequency"}')) > 5)
            with suppress(AssertionError):
                until(lambda: not empty(prometheus))
            assert empty(prometheus) == []


GATEWAY = 'instance="gw"'
PUMP = f'{GATEWAY}, line="hall", drive="pump-1"'
FIRING = {  # by alert: series, with one value a minute, that make the alert fire within 15 min
    "MultidropGatewayDown": {f'up{{{GATEWAY}, job="multidrop"}}': "0x20"},
    "MultidropGatewayFailed": {f'multidrop_health{{{GATEWAY}, multidrop_health="failed"}}': "1x20"},
    "MultidropGatewayDegraded": {f'multidrop_health{{{GATEWAY}, multidrop_health="degraded"}}': "1x20"},
    "MultidropLineLost": {f'multidrop_line_up{{{GATEWAY}, line="hall"}}': "0x20"},
    "MultidropDriveFault": {f'multidrop_alarm_active{{{PUMP}, kind="fault"}}': "1x20"},
    "MultidropMotorStopped": {f'multidrop_alarm_active{{{PUMP}, kind="stopped"}}': "1x20"},
    "MultidropLimit": {f'multidrop_alarm_active{{{PUMP}, kind="limit"}}': "1x20"},
    "MultidropDriveSilent": {f'multidrop_alarm_active{{{PUMP}, kind="silent"}}': "1x20"},
    "MultidropValuesOld": {f'multidrop_register_age_seconds{{{PUMP}, register="load"}}': "0+60x20"},
    "MultidropMisses": {
        f'multidrop_misses_total{{{PUMP}, reason="no reply"}}': "0+300x20",
        f'multidrop_line_samples_total{{{GATEWAY}, line="hall"}}': "0+900x20",
    },
    "MultidropRowsLost": {f"multidrop_rows_dropped_total{{{GATEWAY}}}": "0+1x20"},
    "MultidropPartFailing": {f'multidrop_part_failures_total{{{GATEWAY}, part="mqtt"}}': "0+1x20"},
    "MultidropHistoryLost": {f"multidrop_history_dropped_total{{{GATEWAY}}}": "0+1x20"},
}
CALM = {  # series for which no alert must fire
    f'up{{{GATEWAY}, job="multidrop"}}': "1x20",
    f'multidrop_health{{{GATEWAY}, multidrop_health="failed"}}': "0x20",
    f'multidrop_line_up{{{GATEWAY}, line="hall"}}': "1x20",
    f'multidrop_alarm_active{{{PUMP}, kind="fault"}}': "0x20",
    f'multidrop_register_age_seconds{{{PUMP}, register="load"}}': "1x20",
    f'multidrop_misses_total{{{PUMP}, reason="no reply"}}': "0+1x20",
    f'multidrop_line_samples_total{{{GATEWAY}, line="hall"}}': "0+900x20",
    f"multidrop_rows_dropped_total{{{GATEWAY}}}": "5x20",
}


def rule_test(series: dict[str, str], alert: str, count: int) -> dict[str, Any]:
    """Return a test case of promtool: with these series, `count` alerts of this name fire after 15 min."""
    samples = [{"labels": "{}", "value": count}] if count else []
    query = f'count(ALERTS{{alertname=~"{alert}", alertstate="firing"}})'
    return {
        "interval": "1m",
        "input_series": [{"series": name, "values": values} for name, values in series.items()],
        "promql_expr_test": [{"expr": query, "eval_time": "15m", "exp_samples": samples}],
    }


@pytest.mark.slow
def test_each_prometheus_alert_fires_only_for_its_own_problem(tmp_path: Path) -> None:
    program = require_program("promtool")
    assert {*FIRING} == {name for name, _ in alerts()}
    tests = [rule_test(series, alert, 1) for alert, series in FIRING.items()]
    tests.append(rule_test(CALM, ".*", 0))
    file = tmp_path / "tests.yml"
    file.write_text(json.dumps({"rule_files": [str(ALERTS)], "evaluation_interval": "1m", "tests": tests}))
    ran = subprocess.run([program, "test", "rules", str(file)], capture_output=True, text=True)
    assert ran.returncode == 0, ran.stdout + ran.stderr
