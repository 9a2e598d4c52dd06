"""Payloads of Sparkplug B: encoding and decoding in Protocol Buffers' wire format.

Source: Eclipse Sparkplug specification 3.0.0, section 6.4.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from enum import IntEnum
from typing import NamedTuple

Value = float | str | None  # a metric's value; None stands for Sparkplug's null value

# Field numbers in the messages Payload and Metric (section 6.4.1).
_TIMESTAMP, _METRICS, _SEQ = 1, 2, 3
_NAME, _ALIAS, _METRIC_TIME, _DATATYPE, _IS_HISTORICAL, _IS_NULL, _PROPERTIES = 1, 2, 3, 4, 5, 7, 9
_INT, _LONG, _FLOAT, _DOUBLE, _BOOLEAN, _STRING = 10, 11, 12, 13, 14, 15

# Field numbers in the messages PropertySet and PropertyValue.
_KEYS, _VALUES = 1, 2
_TYPE, _TEXT = 1, 8
ENGINEERING_UNIT = "engUnit"  # name of the property that Sparkplug hosts show as a metric's unit

_VARINT, _EIGHT, _BYTES, _FOUR = 0, 1, 2, 5  # wire types
MOST_PAYLOAD = 65_536  # limit, in bytes, of a received command
_MOST_VARINT = 10  # limit, in bytes, of a varint (an integer of variable length)


class DataType(IntEnum):
    """Sparkplug's numbers of the data types used here (section 6.4.16)."""

    INT64 = 4
    DOUBLE = 10
    BOOLEAN = 11
    STRING = 12


class Metric(NamedTuple):
    """A metric to be sent.

    Only in a birth message does it have a name; later messages have only its alias.
    """

    datatype: DataType
    value: Value
    time_ms: int
    name: str = ""
    alias: int | None = None
    unit: str = ""  # the value's unit, sent only in a birth message
    is_historical: bool = False  # True: this is not the present value


class ReceivedMetric(NamedTuple):
    """A metric in a received command."""

    name: str  # "" if the metric has only an alias
    alias: int | None
    value: Value


def payload(time_ms: int, metrics: Iterable[Metric], seq: int | None) -> bytes:
    """Return an encoded payload. The payload of an NDEATH has no `seq`, so `seq` is None."""
    parts = [_number(_TIMESTAMP, time_ms), *(_bytes(_METRICS, _metric(metric)) for metric in metrics)]
    if seq is not None:
        parts.append(_number(_SEQ, seq))
    return b"".join(parts)


def _metric(metric: Metric) -> bytes:
    parts = []
    if metric.name:
        parts.append(_bytes(_NAME, metric.name.encode()))
    if metric.alias is not None:
        parts.append(_number(_ALIAS, metric.alias))
    parts += [_number(_METRIC_TIME, metric.time_ms), _number(_DATATYPE, metric.datatype)]
    if metric.is_historical:
        parts.append(_number(_IS_HISTORICAL, 1))
    if metric.unit:
        value = _number(_TYPE, DataType.STRING) + _bytes(_TEXT, metric.unit.encode())
        parts.append(_bytes(_PROPERTIES, _bytes(_KEYS, ENGINEERING_UNIT.encode()) + _bytes(_VALUES, value)))
    parts.append(_number(_IS_NULL, 1) if metric.value is None else _value(metric.datatype, metric.value))
    return b"".join(parts)


def _value(datatype: DataType, value: float | str) -> bytes:
    if datatype is DataType.STRING:
        return _bytes(_STRING, str(value).encode())
    if datatype is DataType.DOUBLE:
        return _key(_DOUBLE, _EIGHT) + struct.pack("<d", float(value))
    if datatype is DataType.BOOLEAN:
        return _number(_BOOLEAN, bool(value))
    return _number(_LONG, int(value) & 0xFFFF_FFFF_FFFF_FFFF)


def _key(field: int, wire: int) -> bytes:
    return _varint(field << 3 | wire)


def _number(field: int, value: int) -> bytes:
    return _key(field, _VARINT) + _varint(value)


def _bytes(field: int, value: bytes) -> bytes:
    return _key(field, _BYTES) + _varint(len(value)) + value


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def read_command(data: bytes) -> tuple[int, list[ReceivedMetric]]:
    """Return the time (UTC in ms; 0 if missing) and the metrics of a received NCMD or DCMD payload.

    Raises ValueError for an invalid payload.
    """
    if len(data) > MOST_PAYLOAD:
        raise ValueError(f"the payload has {len(data)} bytes; the limit is {MOST_PAYLOAD}")
    time_ms, given = 0, []
    for field, value in _fields(data):
        if field == _TIMESTAMP and isinstance(value, int):
            time_ms = value
        elif field == _METRICS and isinstance(value, bytes):
            given.append(_given(value))
    return time_ms, given


def _given(data: bytes) -> ReceivedMetric:
    name, alias, value = "", None, None
    for field, found in _fields(data):
        if field == _NAME and isinstance(found, bytes):
            name = _text(found)
        elif field == _ALIAS and isinstance(found, int):
            alias = found
        else:
            value = _found_value(field, found, value)
    return ReceivedMetric(name, alias, value)


def _found_value(field: int, found: int | bytes, before: Value) -> Value:
    if field in (_INT, _LONG, _BOOLEAN) and isinstance(found, int):
        return found
    if field == _STRING and isinstance(found, bytes):
        return _text(found)
    if field in (_FLOAT, _DOUBLE) and isinstance(found, bytes):
        form = {4: "<f", 8: "<d"}.get(len(found))
        if form is None:
            raise ValueError(f"a float has {len(found)} bytes; it must have 4 or 8")
        return float(struct.unpack(form, found)[0])
    return before


def _text(found: bytes) -> str:
    try:
        return found.decode()
    except UnicodeDecodeError:
        raise ValueError("a string in the payload is not UTF-8") from None


def _fields(data: bytes) -> Iterator[tuple[int, int | bytes]]:
    """Yield the number and value of each field: an int for a varint, else bytes."""
    at = 0
    while at < len(data):
        key, at = _read_varint(data, at)
        wire = key & 7
        if wire == _VARINT:
            value, at = _read_varint(data, at)
            yield key >> 3, value
            continue
        if wire == _BYTES:
            length, at = _read_varint(data, at)
        elif wire in (_EIGHT, _FOUR):
            length = 8 if wire == _EIGHT else 4
        else:
            raise ValueError(f"a field has wire type {wire}; it must be 0, 1, 2 or 5")
        if length > len(data) - at:
            raise ValueError("a field extends beyond the end of the payload")
        yield key >> 3, data[at : at + length]
        at += length


def _read_varint(data: bytes, at: int) -> tuple[int, int]:
    value = 0
    for shift, byte in enumerate(data[at : at + _MOST_VARINT]):
        value |= (byte & 0x7F) << 7 * shift
        if byte < 0x80:
            return value & 0xFFFF_FFFF_FFFF_FFFF, at + shift + 1
    raise ValueError("a varint has no last byte: the payload is incomplete, or the varint is too long")
