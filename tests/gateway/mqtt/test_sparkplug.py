"""Sparkplug's payloads, against Eclipse's own message definitions and Google's protobuf."""

from __future__ import annotations

import math
from typing import Any

import pytest
from brokers import sparkplug_messages
from hypothesis import given
from hypothesis import strategies as st
from tables import table

from multidrop.gateway.mqtt.sparkplug import DataType, Given, Metric, payload, read_command

SPANS: dict[DataType, st.SearchStrategy[Any]] = {
    DataType.INT64: st.integers(-(2**63), 2**63 - 1),
    DataType.DOUBLE: st.floats(),
    DataType.BOOLEAN: st.booleans(),
    DataType.STRING: st.text(),
}
metrics = st.sampled_from(DataType).flatmap(
    lambda kind: st.builds(
        Metric,
        st.just(kind),
        st.none() | SPANS[kind],
        st.integers(0, 2**63),
        st.text(),
        st.none() | st.integers(0, 2**63),
    )
)


def value_of(metric: Any) -> object:
    """Return a metric's value as a Sparkplug host reads it."""
    if metric.is_null:
        return None
    value = getattr(metric, metric.WhichOneof("value"))
    return value - 2**64 if metric.datatype == DataType.INT64 and value >= 2**63 else value


@pytest.mark.long
@given(st.integers(0, 2**63), st.lists(metrics, max_size=5), st.none() | st.integers(0, 255))
def test_a_host_can_decode_all_payloads(time_ms: int, said: list[Metric], seq: int | None) -> None:
    received = sparkplug_messages().Payload.FromString(payload(time_ms, said, seq))
    assert received.timestamp == time_ms
    assert (received.seq if received.HasField("seq") else None) == seq
    for one, metric in zip(received.metrics, said, strict=True):
        assert (one.name, one.timestamp, one.datatype) == (metric.name, metric.time_ms, metric.datatype)
        assert (one.alias if one.HasField("alias") else None) == metric.alias
        found = value_of(one)
        if isinstance(metric.value, float) and math.isnan(metric.value):
            assert isinstance(found, float)
            assert math.isnan(found)
        else:
            assert found == metric.value


@table(
    ("field", "value"),
    [
        ("int_value", 7),
        ("long_value", 7),
        ("double_value", 7.5),
        ("float_value", 0.5),
        ("boolean_value", True),
        ("string_value", "жар"),
    ],
)
def test_command_of_a_sparkplug_host_is_decoded(field: str, value: object) -> None:
    messages = sparkplug_messages()
    sent = messages.Payload(timestamp=1234, seq=3)
    sent.metrics.add(name="setpoint", alias=9, datatype=10, timestamp=5, **{field: value})
    sent.metrics.add(name="nothing", is_null=True)
    assert read_command(sent.SerializeToString()) == (
        1234,
        [Given("setpoint", 9, value), Given("nothing", None, None)],  # type: ignore[arg-type]
    )


@given(st.binary(max_size=300))
def test_any_bytes_are_decoded_or_refused(data: bytes) -> None:
    try:
        time_ms, found = read_command(data)
    except ValueError:
        return
    assert time_ms >= 0
    assert len(found) <= len(data)


@given(st.data())
def test_damaged_command_is_decoded_or_raises_value_error(data: st.DataObject) -> None:
    whole = bytearray(payload(5, [Metric(DataType.DOUBLE, 2.5, 5, "setpoint", 3)], 1))
    whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    del whole[data.draw(st.integers(0, len(whole))) :]
    test_any_bytes_are_decoded_or_refused.hypothesis.inner_test(bytes(whole))  # type: ignore[attr-defined]
