"""The gateway's parts `upload` and `influx`, which send all polled values by HTTP POST.

`upload` sends batches in JSON. `influx` sends InfluxDB's line protocol, also to stdout instead of a URL.
"""

from __future__ import annotations

import gzip
import json
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from math import isfinite
from typing import Any, ClassVar
from urllib.parse import parse_qs, urlsplit

from multidrop import Plant
from multidrop.gateway.forward.forwarder import (
    NOT_FINITE,
    Forwarding,
    Outgoing,
    RepeatingReceiver,
    listed,
    pieces,
    row_objects,
)
from multidrop.gateway.parts import PartContext
from multidrop.gateway.sending import host_of, post, url_mistakes
from multidrop.gateway.settings import parsing_mistakes, refuse, secret_in, secret_mistakes
from multidrop.recording import parse_size
from multidrop.toml_check import SIZE

STDOUT = "stdout"
NANOSECONDS = ("ns", "n", "nanosecond")  # names of nanosecond precision in the APIs of InfluxDB 1, 2 and 3


@dataclass(frozen=True)
class UploadSettings:
    """The settings in the table `[serve.upload]`. Raises ValueError with a line for each mistake."""

    url: str = "http://localhost:1880/rows"
    token: str = ""  # path of the file with a bearer token
    spool: str = "spool/upload"
    most: str = field(default="1 GB", metadata=SIZE)

    name: ClassVar[str] = "upload"

    def __post_init__(self) -> None:
        refuse((*self._mistakes(), *parsing_mistakes(self, most=parse_size)))

    def _mistakes(self) -> Iterator[str]:
        return url_mistakes(self.url, "https://plant.example/rows")

    def check(self, plant: Plant) -> Iterator[str]:
        return secret_mistakes("token", self.token, plant)

    def sender(self, token: str, plant: str) -> Callable[[Outgoing], None]:
        """Return the function that sends the rows of a message; `plant` is the plant file's name."""
        headers = {"content-type": "application/json"}
        if token:
            headers["authorization"] = f"Bearer {token}"

        def send(message: Outgoing) -> None:
            for number, rows in enumerate(pieces(message.rows)):
                name, is_historical = f"{message.id}-{number}", message.is_historical
                batch = {"id": name, "plant": plant, "historical": is_historical, "rows": row_objects(rows)}
                post(self.url, json.dumps(batch).encode(), {**headers, "idempotency-key": name})

        return send


@dataclass(frozen=True)
class InfluxSettings(UploadSettings):
    """The settings in the table `[serve.influx]`. Raises ValueError with a line for each mistake."""

    url: str = "http://localhost:8086/write?db=multidrop"  # or "stdout", which means standard output
    spool: str = "spool/influx"
    measurement: str = "multidrop"

    name: ClassVar[str] = "influx"

    def _mistakes(self) -> Iterator[str]:
        wrong = [] if self.url == STDOUT else [*url_mistakes(self.url, InfluxSettings.url)]
        yield from wrong
        if not wrong and set(parse_qs(urlsplit(self.url).query).get("precision", ())) - {*NANOSECONDS}:
            yield "url names another precision; times are in ns: write precision=ns, or none"
        if not self.measurement.strip() or self.measurement.startswith("#"):
            yield f'measurement = "{self.measurement}" is not a name; write measurement = "multidrop"'

    def sender(self, token: str, plant: str) -> Callable[[Outgoing], None]:
        headers = {"content-type": "text/plain; charset=utf-8", "content-encoding": "gzip"}
        if token:
            headers["authorization"] = f"Token {token}"

        def send(message: Outgoing) -> None:
            for rows in pieces(message.rows):
                lines = line_protocol(rows, self.measurement)
                if self.url == STDOUT:
                    left = memoryview(lines)
                    while left:  # without Python's buffer, which stays locked while the reading program hangs
                        left = left[os.write(sys.stdout.fileno(), left) :]
                else:
                    post(self.url, gzip.compress(lines, 1), headers)

        return send


def build(settings: UploadSettings, context: PartContext) -> Forwarding:
    """Return the forwarder that sends rows to `settings.url`. Raises OSError if the token cannot be read."""
    plant = context.plant
    send = settings.sender(secret_in(settings.token, plant), plant.path.stem)
    receiver = STDOUT if settings.url == STDOUT else host_of(settings.url)
    folder = context.folder / settings.spool
    return Forwarding(
        settings.name, receiver, folder, settings.most, plant, lambda at: RepeatingReceiver(at, send)
    )


def line_protocol(rows: Any, measurement: str) -> bytes:
    """Return the rows in line protocol.

    Drive, register and unit are tags. The field is the value, or for a failed read its status. If a row is
    written twice, InfluxDB replaces the point by the same point.
    """
    name, lines = _escaped(measurement, ", "), []
    # start of a line, without its value and time, by drive, register and unit
    heads: dict[tuple[str, str, str | None], str] = {}
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
