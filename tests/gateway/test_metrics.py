"""OpenMetrics, judged by prometheus_client's own parser."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
from gateways import Served, served
from lines import until

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
    found = families(gateway)["multidrop_value"].samples
    return {(one.labels["drive"], one.labels["register"]): one.value for one in found}


def states(gateway: Served) -> dict[str, str]:
    found = families(gateway)["multidrop_drive_state"].samples
    return {one.labels["drive"]: one.labels["multidrop_drive_state"] for one in found if one.value}


@pytest.mark.long
def test_values_states_and_counters(tmp_path: Path) -> None:
    odd = 'fan, the \\"old\\" one'  # as TOML has it
    with served(tmp_path, "", "pump-1", odd) as gateway:
        until(lambda: len(values(gateway)) == 8)
        found = families(gateway)
        assert values(gateway)["pump-1", "status"] == 3.0
        assert values(gateway)['fan, the "old" one', "fault"] == 0.0
        assert states(gateway) == {"pump-1": "stands", 'fan, the "old" one': "stands"}
        labels = [one.labels for one in found["multidrop_value"].samples if one.labels["drive"] == "pump-1"]
        assert {"line": "hall", "drive": "pump-1", "register": "output_current", "unit": "A"} in labels
        until(lambda: families(gateway)["multidrop_line_samples"].samples[0].value > 8)
        assert found["multidrop_line_samples"].type == "counter"
        assert found["multidrop_build"].samples[0].labels == {"version": gateway.gateway.version}
        delays = {  # those of who has replied, as counted once a second
            (one.name.removeprefix("multidrop_response_delay_seconds"), one.labels.get("quantile"))
            for one in families(gateway)["multidrop_response_delay_seconds"].samples
        }
        assert delays == {("", "0.5"), ("", "0.9"), ("", "0.99"), ("_count", None)}


def unanswered(gateway: Served) -> float:
    misses = families(gateway)["multidrop_misses"].samples
    return sum(float(one.value) for one in misses if one.labels["reason"] == "no reply")


@pytest.mark.long
@pytest.mark.slow
def test_a_silent_drives_values_vanish_and_come_back(tmp_path: Path) -> None:
    with served(tmp_path) as gateway:
        until(lambda: len(values(gateway)) == 8)
        gateway.sims["pump-2"].deaf_until = float("inf")
        until(lambda: states(gateway)["pump-2"] == "silent")
        assert {drive for drive, _ in values(gateway)} == {"pump-1"}
        until(lambda: unanswered(gateway) > 0)  # they are counted once a second
        gateway.sims["pump-2"].deaf_until = 0.0
        until(lambda: len(values(gateway)) == 8)
        assert states(gateway)["pump-2"] == "stands"
