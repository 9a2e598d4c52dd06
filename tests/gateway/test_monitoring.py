"""The shipped dashboard and alert rules: a real Prometheus has data for each query, and each alert fires."""

from __future__ import annotations

import json
import re
import subprocess
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import yaml
from gateways import serving
from lines import until
from peers import require_program
from prometheus_server import Prometheus, scraping

from multidrop.gateway.http.page_files import PAGE

FOLDER = PAGE / "prometheus"
DASHBOARD, ALERTS = FOLDER / "dashboard.json", FOLDER / "alerts.yml"
JOB = """
global: {{scrape_interval: 1s}}
scrape_configs:
  - job_name: multidrop
    static_configs: [{{targets: ["127.0.0.1:{port}"]}}]
"""


def alerts() -> Iterator[tuple[str, str]]:
    """Yield the name and the expression of each alert."""
    for group in yaml.safe_load(ALERTS.read_text())["groups"]:
        for rule in group["rules"]:
            yield rule["alert"], rule["expr"]


def queries() -> Iterator[tuple[str, str]]:
    """Yield the name and text of each query that must return data; queries of alerts lack their limit."""
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
    """Return the queries without data."""
    return [(name, text) for name, text in queries() if not prometheus.query(text)]


@pytest.mark.slow
@pytest.mark.long
def test_prometheus_has_data_for_each_query_of_dashboard_and_alerts(tmp_path: Path) -> None:
    with serving(Path("--demo"), "--no-browser") as (_, url):
        port = int(url.rstrip("/").rpartition(":")[2])
        with scraping(tmp_path, JOB.format(port=port)) as prometheus:
            until(lambda: len(prometheus.query('multidrop_register_hertz{register="output_frequency"}')) > 5)
            with suppress(AssertionError):
                until(lambda: not empty(prometheus))
            assert empty(prometheus) == []


GATEWAY = 'instance="gw"'
PUMP = f'{GATEWAY}, line="hall", drive="pump-1"'
FIRING = {  # by alert: series and their values each minute, which make it fire within 15 min
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
CALM = {  # by series: values that must make no alert fire
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
    """Return a test for promtool: with these series, `count` alerts of this name fire after 15 min."""
    samples = [{"labels": "{}", "value": count}] if count else []
    query = f'count(ALERTS{{alertname=~"{alert}", alertstate="firing"}})'
    return {
        "interval": "1m",
        "input_series": [{"series": name, "values": values} for name, values in series.items()],
        "promql_expr_test": [{"expr": query, "eval_time": "15m", "exp_samples": samples}],
    }


@pytest.mark.slow
def test_each_alert_fires_for_its_series_only(tmp_path: Path) -> None:
    program = require_program("promtool")
    assert {*FIRING} == {name for name, _ in alerts()}
    tests = [rule_test(series, alert, 1) for alert, series in FIRING.items()]
    tests.append(rule_test(CALM, ".*", 0))
    file = tmp_path / "tests.yml"
    file.write_text(json.dumps({"rule_files": [str(ALERTS)], "evaluation_interval": "1m", "tests": tests}))
    ran = subprocess.run([program, "test", "rules", str(file)], capture_output=True, text=True)
    assert ran.returncode == 0, ran.stdout + ran.stderr
