"""Metrics of a fleet's gateway: valid for promtool, only for this computer, robust against any request."""

from __future__ import annotations

import asyncio
import subprocess
from contextlib import closing
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from peers import require_module, require_program
from tables import table

from multidrop.exposition import expose_metrics
from multidrop.fleet.metrics import MOST_CLIENTS, MOST_HEAD, answer, families_of, listen, serving

OPEN = "application/openmetrics-text"
STATE: dict[str, Any] = {
    "gateway": "gw-1",
    "state": "working",
    "session": 7,
    "margin_s": 1.9,
    "paths": ["n1", "n2", "n1"],
    "lines": 4,
    "moves": 12,
    "troubles": {"hall-1": "no answer"},
    "spool": {
        "bytes": 81234,
        "rows": 900,
        "waiting": 20,
        "lost": 0,
        "sent": 9,
        "behind": 2,
        "lag_s": 1.5,
        "trouble": None,
    },
}


def samples(state: dict[str, Any]) -> dict[str, float]:
    text = expose_metrics(families_of(state, "1.0"), "")[1]
    found = (line.rpartition(" ") for line in text.splitlines() if not line.startswith("#"))
    return {name.removeprefix("multidrop_fleet_"): float(value) for name, _, value in found}


def test_metrics_of_lines_without_a_port_are_complete() -> None:
    found = samples({**STATE, "lost": ["hall-1"], "unopened": ["hall-2", "hall-3"]})
    assert (found["lost_lines"], found["unopened_lines"]) == (1, 2)


def test_metrics_show_the_state_of_a_gateway() -> None:
    found = samples(STATE)
    assert found['gateway_info{gateway="gw-1",version="1.0"}'] == 1
    assert found['gateway_state{multidrop_fleet_gateway_state="working"}'] == 1
    assert found['gateway_state{multidrop_fleet_gateway_state="draining"}'] == 0
    expected = {"lease_margin_seconds": 1.9, "session": 7, "servers": 2, "troubled_lines": 1, "lines": 4}
    expected |= {"moves_total": 12, "spool_bytes": 81234, "spool_rows_total": 900, "spool_waiting_rows": 20}
    expected |= {"spool_lost_rows_total": 0, "sent_messages_total": 9, "behind_messages": 2}
    expected |= {"behind_seconds": 1.5}
    assert {name: value for name, value in found.items() if "{" not in name} == expected


def test_unknown_figures_have_no_sample_in_the_metrics() -> None:
    spool = STATE["spool"] | {"behind": None, "lag_s": None}
    found = samples(STATE | {"session": 0, "margin_s": 0.0, "state": "no lease", "spool": spool})
    missing = {"lease_margin_seconds", "session", "behind_messages", "behind_seconds"}
    assert missing & found.keys() == set()
    assert found["lines"] == 4


def test_promtool_accepts_the_metrics() -> None:
    program = require_program("promtool")
    text = expose_metrics(families_of(STATE, "1.0"), "*/*")[1]
    checked = subprocess.run([program, "check", "metrics"], input=text.encode(), capture_output=True)
    assert (checked.returncode, checked.stdout, checked.stderr) == (0, b"", b"")


def test_an_openmetrics_parser_accepts_the_metrics() -> None:
    parser = require_module("prometheus_client.openmetrics.parser")
    text = expose_metrics(families_of(STATE, "1.0"), OPEN)[1]
    found = {one.name: one.type for one in parser.text_string_to_metric_families(text)}
    assert found["multidrop_fleet_gateway_state"] == "stateset"
    assert found["multidrop_fleet_moves"] == "counter"


# ---- the HTTP port ----


def asked(line: str = "GET /metrics HTTP/1.1", host: str = "localhost:9464", *more: str) -> bytes:
    return "\r\n".join([line, f"Host: {host}", *more, "", ""]).encode("latin-1")


def said(head: bytes) -> tuple[int, str, str]:
    """Return status, content type and text of the response to a request."""
    text = answer(head, lambda: families_of(STATE, "1.0")).decode()
    head_text, _, body = text.partition("\r\n\r\n")
    fields = dict(line.split(": ", 1) for line in head_text.split("\r\n")[1:])
    assert int(fields["content-length"]) == len(body.encode())
    return int(head_text.split()[1]), fields["content-type"], body


def test_both_metrics_formats_are_served() -> None:
    status, kind, text = said(asked())
    assert (status, kind) == (200, "text/plain; version=0.0.4; charset=utf-8")
    assert "multidrop_fleet_lines 4.0\n" in text
    status, kind, text = said(asked("GET /metrics HTTP/1.1", "127.0.0.1:1", f"Accept: {OPEN};version=1.0.0"))
    assert (status, kind) == (200, "application/openmetrics-text; version=1.0.0; charset=utf-8")
    assert text.endswith("# EOF\n")


@table(
    ("head", "status"),
    [
        (asked("GET / HTTP/1.1"), 404),
        (asked("GET /metricsx HTTP/1.1"), 404),
        (asked("POST /metrics HTTP/1.1"), 405),
        (asked("GET /metrics"), 400),
        (asked("GET /metrics GOPHER/1"), 400),
        (asked(host="plant.example"), 403),
        (asked(host="localhost.plant.example"), 403),
        (b"GET /metrics HTTP/1.1\r\n\r\n", 403),
        (asked(host="[::1]:9464"), 200),
        (asked("GET /metrics?x=1 HTTP/1.0"), 200),
    ],
)
def test_requests_for_anything_but_metrics_are_refused(head: bytes, status: int) -> None:
    assert said(head)[0] == status


@given(st.binary(max_size=200))
def test_any_bytes_get_an_http_response(data: bytes) -> None:
    assert said(data + b"\r\n\r\n")[0] in (400, 403, 404, 405)


OPEN_TO_OTHERS = "is open to other machines, without tokens or TLS"
INVALID = r"is not an address and port; write --metrics 127\.0\.0\.1:9464"


@table(
    ("address", "sentence"),
    [
        *(
            (one, OPEN_TO_OTHERS)
            for one in ("0.0.0.0:9464", "192.0.2.1:9464", "plant.example:9464", "[::]:9464")
        ),
        *((one, INVALID) for one in ("9464", "127.0.0.1", "127.0.0.1:x", ":9464", "127.0.0.1:99999")),
    ],
)
def test_addresses_that_are_invalid_or_open_to_others_are_rejected(address: str, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        listen(address)


def test_a_metrics_port_in_use_is_reported_in_one_sentence() -> None:
    with closing(listen("127.0.0.1:0")) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(OSError, match=f"--metrics 127.0.0.1:{port} is not available: "):
            listen(f"127.0.0.1:{port}")


async def test_silent_clients_are_limited_and_do_not_delay_the_end() -> None:
    """Clients beyond the limit, or with too much data, are disconnected; none delays the shutdown."""

    async def ask(port: int, data: bytes) -> bytes:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        try:
            writer.write(data)
            return await reader.read()
        except ConnectionError:
            return b""
        finally:
            writer.close()

    listener = listen("127.0.0.1:0")
    port = listener.getsockname()[1]
    async with serving(listener, lambda: families_of(STATE, "1.0")):
        assert (await ask(port, asked())).startswith(b"HTTP/1.1 200 OK\r\n")
        assert await ask(port, b"x" * 4 * MOST_HEAD) == b""
        silent = [await asyncio.open_connection("127.0.0.1", port) for _ in range(MOST_CLIENTS)]
        assert await ask(port, asked()) == b""
        silent.pop()[1].close()
        while not await ask(port, asked()):
            await asyncio.sleep(0.01)
    for _, writer in silent:
        writer.close()
