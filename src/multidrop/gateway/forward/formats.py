"""Rows as JSON and as InfluxDB's line protocol."""

from __future__ import annotations

from collections.abc import Iterator
from math import isfinite
from typing import Any

import pyarrow as pa

from multidrop.iso_time import format_time

MOST_ROWS = 2000  # limit of rows in one request or MQTT message, about 250 kB of JSON
NOT_FINITE = "not a finite number"  # status of a row whose value JSON and InfluxDB cannot represent


def pieces(rows: Any) -> Iterator[Any]:
    """Yield the table in pieces of at most MOST_ROWS rows."""
    for begin in range(0, len(rows), MOST_ROWS):
        yield rows.slice(begin, MOST_ROWS)


def listed(rows: Any) -> Iterator[tuple[int, str, str, float | None, str, str | None]]:
    """Yield time (UTC in ns), drive, register, value, status and unit of each row."""
    times = rows.column("time").cast(pa.int64())
    names = ("drive", "register", "value", "status", "unit")
    return zip(times.to_pylist(), *(rows.column(name).to_pylist() for name in names), strict=True)


def row_objects(rows: Any) -> list[dict[str, Any]]:
    """Return each row as a JSON object."""
    return [
        {
            "time": format_time(time_ns),
            "drive": drive,
            "register": register,
            "value": value if value is not None and isfinite(value) else None,
            "status": status if value is None or isfinite(value) else NOT_FINITE,
            "unit": unit,
        }
        for time_ns, drive, register, value, status, unit in listed(rows)
    ]


def line_protocol(rows: Any, measurement: str) -> bytes:
    """Return the rows in line protocol.

    Drive, register and unit are tags; the value or the miss is the field. If a row is written twice,
    InfluxDB replaces the point by the same point.
    """
    name, lines = _escaped(measurement, ", "), []
    heads: dict[tuple[str, str, str | None], str] = {}  # how a line starts, by drive, register and unit
    for time_ns, drive, register, value, status, unit in listed(rows):
        head = heads.get((drive, register, unit))
        if head is None:
            tags = {"drive": drive, "register": register, "unit": unit}
            head = heads[drive, register, unit] = name + "".join(
                f",{key}={_escaped(text, ',= ')}" for key, text in tags.items() if text
            )
        if value is not None and isfinite(value):
            lines.append(f"{head} value={value!r} {time_ns}\n")
        else:
            lines.append(f"{head} miss={_quoted(status if value is None else NOT_FINITE)} {time_ns}\n")
    return "".join(lines).encode()


def _escaped(text: str, special: str) -> str:
    """Return a name with its special characters escaped.

    A backslash at the name's end becomes a slash, because it would escape the character after the name.
    """
    text = "".join(f"\\{one}" if one in special else one for one in text.replace("\n", " "))
    return f"{text[:-1]}/" if text.endswith("\\") else text


def _quoted(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", " ") + '"'
