"""Text for scrapers: what stays the same from one scrape to the next is made once."""

from __future__ import annotations

from collections.abc import Mapping

import pytest

from multidrop import exposition
from multidrop.exposition import MetricFamily, expose_metrics


def test_labels_are_spelled_out_once_and_not_at_each_scrape(monkeypatch: pytest.MonkeyPatch) -> None:
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
