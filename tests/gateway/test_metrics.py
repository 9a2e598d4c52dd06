"""Metrics in the OpenMetrics format, checked by prometheus_client's parser and by Prometheus."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from gateways import Served, served
from lines import until
from peers import require_program
from prometheus_server import Prometheus, scraping

from multidrop import exposition
from multidrop.exposition import MetricFamily, expose_metrics
from multidrop.gateway.http.rights import Right

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
    """Return when this process started, by `ps`, in s since 1970."""
    age = subprocess.run(["ps", "-o", "etimes=", "-p", str(os.getpid())], capture_output=True, text=True)
    return time.time() - int(age.stdout)


def states(gateway: Served) -> dict[str, str]:
    found = families(gateway)["multidrop_drive_state"].samples
    return {one.labels["drive"]: one.labels["multidrop_drive_state"] for one in found if one.value}


@pytest.mark.long
def test_metrics_have_values_states_and_counters(tmp_path: Path) -> None:
    odd = 'fan, the \\"old\\" one'  # escaped as in TOML
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
        assert alarms == [0.0] * 9  # kinds: port for the line, all others for each drive
        health = {one.labels["multidrop_health"]: one.value for one in found["multidrop_health"].samples}
        assert health == {"ok": 1.0, "degraded": 0.0, "failed": 0.0}
        assert found["process_open_fds"].samples[0].value > 5
        assert abs(found["process_start_time_seconds"].samples[0].value - process_start()) < 60
        until(lambda: families(gateway)["multidrop_line_samples"].samples[0].value > 8)
        assert found["multidrop_line_samples"].type == "counter"
        assert found["multidrop_build"].samples[0].labels == {"version": gateway.gateway.version}
        delays = {  # of drives that have replied; updated once a second
            (one.name.removeprefix("multidrop_response_delay_seconds"), one.labels.get("quantile"))
            for one in families(gateway)["multidrop_response_delay_seconds"].samples
        }
        assert delays == {("", "0.5"), ("", "0.9"), ("", "0.99"), ("_count", None)}


def unanswered(gateway: Served) -> float:
    misses = families(gateway)["multidrop_misses"].samples
    return sum(float(one.value) for one in misses if one.labels["reason"] == "no reply")


@pytest.mark.long
@pytest.mark.slow
def test_metrics_of_a_silent_drive_disappear_and_return(tmp_path: Path) -> None:
    with served(tmp_path) as gateway:
        until(lambda: len(values(gateway)) == 8)
        gateway.sims["pump-2"].deaf_until = float("inf")
        until(lambda: states(gateway)["pump-2"] == "silent")
        assert {drive for drive, _ in values(gateway)} == {"pump-1"}
        until(lambda: unanswered(gateway) > 0)  # updated once a second
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
def test_prometheus_scrapes_each_second_and_a_silent_drive_is_stale(tmp_path: Path) -> None:
    with served(tmp_path, '[serve]\ntokens = "tokens"\n[serve.may]\nlook = "token"\n') as gateway:
        jobs = JOBS.format(port=gateway.gateway.port, secret=gateway.secrets[Right.LOOK])
        with scraping(tmp_path, jobs) as prometheus:
            until(lambda: drives(prometheus) == {"pump-1", "pump-2"})
            until(lambda: prometheus.targets()["stranger"][0] != "unknown")  # until the first scrape
            assert prometheus.targets() == {
                "known": ("up", ""),
                "stranger": ("down", "server returned HTTP status 401 Unauthorized"),
            }
            read_as = prometheus.ask("targets/metadata", metric="multidrop_drive_state", limit="1")
            assert [one["type"] for one in read_as] == ["stateset"]  # only OpenMetrics has this type

            gateway.sims["pump-2"].deaf_until = float("inf")
            # Without staleness markers, Prometheus would return the last values for five minutes.
            until(lambda: drives(prometheus) == {"pump-1"})
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
