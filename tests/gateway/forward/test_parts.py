"""Forwarding of rows by `postgres`, `influx` and `upload`: settings, units, health, hanging receivers."""

from __future__ import annotations

import json
import os
import select
import sys
import threading
import time
from collections import Counter
from math import inf, nan
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from forwarded import forwarding, keys_in, rows_at_noon, store, web_server
from gateways import served, written
from lines import PATIENCE, until
from spooled import NOON, numbered
from tables import table

from multidrop import PlantError
from multidrop.gateway.forward import http
from multidrop.gateway.forward.forwarder import MOST_ROWS, Outgoing, pieces, row_objects
from multidrop.gateway.forward.http import InfluxSettings, line_protocol
from multidrop.gateway.http.rights import Right
from multidrop.gateway.parts import missing_library
from multidrop.gateway.settings import read_settings
from multidrop.samples import SpoolState


@table(
    ("serve", "mistake"),
    [
        (
            '[serve.influx]\nurl = "influx:8086"',
            '[serve.influx]: url = "influx:8086" is not a URL; '
            'write url = "http://localhost:8086/write?db=multidrop"',
        ),
        (
            '[serve.influx]\nurl = "http://anna:T0K3N@influx/write"',
            '[serve.influx]: url contains a user, password or token; write token = "FILE" instead',
        ),
        (
            '[serve.influx]\nurl = "http://influx/write?db=a&p=T0K3N"',
            '[serve.influx]: url contains a user, password or token; write token = "FILE" instead',
        ),
        (
            '[serve.upload]\nurl = "http://[T0K3N/"',
            '[serve.upload]: url = "http://[T0K3N/" is not a URL; write url = "https://plant.example/rows"',
        ),
        (
            '[serve.upload]\nurl = "http://anna:T0K3N@[db/"',
            '[serve.upload]: url = "http://[db/" is not a URL; write url = "https://plant.example/rows"',
        ),
        ('[serve.upload]\nurl = "http://db:port/"', '[serve.upload]: url = "http://db:port/" is not a URL'),
        ('[serve.upload]\nurl = "http://db/a b"', '[serve.upload]: url = "http://db/a b" is not a URL'),
        (
            '[serve.influx]\nurl = "http://influx/write?db=a&precision=ms"',
            "[serve.influx]: url names another precision; times are in ns: write precision=ns, or none",
        ),
        (
            '[serve.influx]\nmeasurement = "#m"',
            '[serve.influx]: measurement = "#m" is not a name; write measurement = "multidrop"',
        ),
        (
            '[serve.influx]\ntoken = "plant.toml"',
            '[serve.influx]: token = "plant.toml": {folder}/plant.toml has ',
        ),
        (
            '[serve.postgres]\ndatabase = "plant"',
            '[serve.postgres]: database is not a connection string; write database = "host=db dbname=plant"',
        ),
        (
            '[serve.upload]\nmost = "much"',
            '[serve.upload]: most = invalid size \'much\': write 1 kB or more, such as "500 MB" or "20 GB"',
        ),
        ('[serve.upload]\nulr = "http://a/"', "[serve.upload]: unknown key 'ulr'; did you mean url?"),
        (
            '[serve.postgres]\ndatabase = "dbname=a password=T0K3N"',
            '[serve.postgres]: database has a password in it; write password = "FILE" instead',
        ),
        (
            '[serve.postgres]\ndatabase = "postgresql://anna:T0K3N@db/a"',
            '[serve.postgres]: database has a password in it; write password = "FILE" instead',
        ),
        (
            '[serve.postgres]\npassword = "none"',
            '[serve.postgres]: password = "none": {folder}/none cannot be read: No such file or directory',
        ),
        ('[serve.mqtt]\nrows = true\nmost = "1"', "[serve.mqtt]: most = invalid size '1': write 1 kB or"),
    ],
)
def test_a_mistake_in_database_or_upload_settings_is_reported_in_one_sentence(
    tmp_path: Path, serve: str, mistake: str
) -> None:
    with pytest.raises(PlantError) as wrong:
        read_settings(written(tmp_path, serve), {})
    [found] = wrong.value.mistakes
    assert mistake.format(folder=tmp_path) in found


def test_a_missing_library_of_a_receiver_is_reported_in_one_sentence() -> None:
    missing = ImportError("No module named 'pyarrow'", name="pyarrow")
    assert missing_library("influx", missing).startswith(
        "the library pyarrow is not installed: pip install 'pyarrow"
    )
    missing = ImportError("No module named 'psycopg'", name="psycopg")
    assert "# multidrop[postgres]" in missing_library("postgres", missing)


def test_a_spool_folder_with_other_files_is_reported_in_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "spool" / "upload").mkdir(parents=True)
    (tmp_path / "spool" / "upload" / "rows.csv").touch()
    with pytest.raises(ValueError, match=r"is not a spool: it holds 'rows.csv'"):
        forwarding("upload", "http://localhost/", tmp_path)


@pytest.mark.slow
def test_a_gateway_uploads_rows_with_their_units_to_a_web_server(tmp_path: Path) -> None:
    with web_server() as posted:
        (tmp_path / "token").write_text("T0K3N\n")
        serve = f'[serve.upload]\nurl = "{posted.url}"\ntoken = "token"\n'
        with served(tmp_path, serve) as gateway:
            until(lambda: len(posted.batches) >= 2)
            posted.status = 500
            until(lambda: "500" in gateway.get("/health").json["parts"]["upload"])
            shown = gateway.get("/health").body + gateway.get("/metrics").body
            assert b"secret-path" not in shown
            assert b"T0K3N" not in shown
            assert b"multidrop_upload_rows_lost_total 0.0" in shown
            posted.status = 200
        rows = [row for one in posted.batches for row in one["rows"]]
        assert posted.headers[0]["authorization"] == "Bearer T0K3N"
        assert posted.headers[0]["idempotency-key"] == posted.batches[0]["id"]
    units = {(row["register"], row["unit"]) for row in rows}
    assert {("output_frequency", "Hz"), ("output_current", "A"), ("status", "names of invt-che")} <= units
    # Ignore rows without a value: on a busy machine, two failed reads of a register may have the same time.
    for one in posted.batches:
        one["rows"] = [row for row in one["rows"] if row["value"] is not None]
    assert set(Counter(keys_in(posted.batches)).values()) == {1}


@pytest.mark.slow
def test_a_hanging_receiver_delays_neither_polling_nor_stops_nor_the_shutdown(tmp_path: Path) -> None:
    with web_server() as posted:
        posted.hang.clear()
        with served(tmp_path, f'[serve.upload]\nurl = "{posted.url}"\n') as gateway:
            part: Any = gateway.gateway.feeds["upload"]
            until(lambda: part._forwarder._sending_since_s < float("inf"))
            before = part._spool.state().written
            until(lambda: part._spool.state().written > before + 50)
            stopped = gateway.post("/api/stop", {"drives": None}, authorization=gateway.bearer(Right.STOP))
            assert stopped.status == 200
            begun = time.monotonic()
        assert time.monotonic() - begun < PATIENCE
        assert posted.batches == []


@pytest.mark.slow
def test_new_rows_are_accepted_while_the_deletion_of_old_files_hangs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    part = forwarding("upload", "http://localhost:9/", tmp_path)
    store(part._spool, 0, 5)
    part._spool.acknowledge(1)
    hangs, goes_on = threading.Event(), threading.Event()

    def hang(path: Path, missing_ok: bool = False) -> None:
        hangs.set()
        goes_on.wait()

    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", hang)
        part.take(numbered(5, 5))
        assert hangs.wait(PATIENCE)
        taking = threading.Thread(target=part.take, args=[numbered(10, 5)])
        taking.start()
        taking.join(5.0)
        was_delayed = taking.is_alive()
        goes_on.set()
    taking.join()
    part._spool.close()
    assert not was_delayed


def state_with(**counts: Any) -> SpoolState:
    return SpoolState("log", 0, 0, 0, 0, 0, 0, 0, None)._replace(**counts)


def test_health_reports_lost_rows_until_the_backlog_is_sent(tmp_path: Path) -> None:
    part: Any = forwarding("upload", "http://localhost:9/", tmp_path)
    spool = part._spool
    part._spool = SimpleNamespace(state=lambda: state_with(lost=120))
    assert part.health() == "120 rows were lost, because the spool or the disk is full"
    part._lost_before = 120
    assert part.health() == ""
    part._spool = SimpleNamespace(state=lambda: state_with(trouble="No space left on device"))
    part._lost_before = 0
    assert part.health() == "rows are not stored: No space left on device"
    assert {one.name for one in part.figures()} == {
        f"multidrop_upload_{name}"
        for name in ("rows_sent", "rows_lost", "rows_refused", "backlog_messages", "spool_bytes")
    }
    spool.close()


def test_rows_for_influxdb_are_sent_with_a_token(monkeypatch: pytest.MonkeyPatch) -> None:
    sent: list[dict[str, str]] = []
    monkeypatch.setattr(http, "post", lambda url, body, headers: sent.append(headers))
    rows = rows_at_noon(("pump-1", "status", 1.0, "ok", None))
    InfluxSettings().sender("T0K3N", "plant")(Outgoing("1", rows, is_historical=False))
    assert [one["authorization"] for one in sent] == ["Token T0K3N"]


def test_stdout_rows_are_in_line_protocol(tmp_path: Path, capfdbinary: pytest.CaptureFixture[bytes]) -> None:
    part = forwarding("influx", "stdout", tmp_path)
    store(part._spool, 0, 1)
    part._forwarder.step()
    part._spool.close()
    lines = capfdbinary.readouterr().out.decode().splitlines()
    assert lines[0] == "multidrop,drive=pump-1,register=value_1 value=0.0 1795262400000000000"
    assert len(lines) == 10


def test_a_hanging_stdout_blocks_no_other_thread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    part = forwarding("influx", "stdout", tmp_path)
    store(part._spool, 0, 150)  # more bytes than the buffer of a pipe
    reading, writing = os.pipe()
    with os.fdopen(writing, "w", encoding="utf-8") as output:
        monkeypatch.setattr(sys, "stdout", output)
        threads = [
            threading.Thread(target=work, daemon=True) for work in (part._forwarder.step, output.flush)
        ]
        threads[0].start()
        select.select([reading], [], [], PATIENCE)
        threads[1].start()
        threads[1].join(5.0)
        was_blocked, was_sent = threads[1].is_alive(), not threads[0].is_alive()
        while threads[0].is_alive():
            if select.select([reading], [], [], 0.01)[0]:
                os.read(reading, 1 << 16)
    os.close(reading)
    part._spool.close()
    assert not was_sent
    assert not was_blocked


# ---- rows as JSON and in line protocol; InfluxDB itself reads them in `test_receivers.py` ----


def test_rows_are_sent_as_json_objects() -> None:
    found = row_objects(
        rows_at_noon(
            ("pump-1", "output_frequency", 49.5, "ok", "Hz"),
            ("pump-1", "fault", None, "no reply", None),
            ("насос", "ratio", nan, "ok", ""),
        )
    )
    assert json.loads(json.dumps(found, allow_nan=False)) == [
        {
            "time": "2026-11-21T12:00:00.000000000Z",
            "drive": "pump-1",
            "register": "output_frequency",
            "value": 49.5,
            "status": "ok",
            "unit": "Hz",
        },
        {
            "time": "2026-11-21T12:00:00.000000001Z",
            "drive": "pump-1",
            "register": "fault",
            "value": None,
            "status": "no reply",
            "unit": None,
        },
        {
            "time": "2026-11-21T12:00:00.000000002Z",
            "drive": "насос",
            "register": "ratio",
            "value": None,
            "status": "not a finite number",
            "unit": "",
        },
    ]


@table(
    ("row", "line"),
    [
        (("pump-1", "hz", 49.5, "ok", "Hz"), "m,drive=pump-1,register=hz,unit=Hz value=49.5"),
        (("pump-1", "n", 1e-7, "ok", ""), "m,drive=pump-1,register=n value=1e-07"),
        (("a b,c=d", "n", 1.0, "ok", None), "m,drive=a\\ b\\,c\\=d,register=n value=1.0"),
        (("a\\", "n", 1.0, "ok", None), "m,drive=a/,register=n value=1.0"),
        (("a", "n", None, 'a "b" \\', "%"), 'm,drive=a,register=n,unit=% miss="a \\"b\\" \\\\"'),
        (("a", "n", inf, "ok", "%"), 'm,drive=a,register=n,unit=% miss="not a finite number"'),
    ],
)
def test_a_row_is_formatted_in_the_influx_line_protocol(row: Any, line: str) -> None:
    assert line_protocol(rows_at_noon(row), "m").decode() == f"{line} {NOON}\n"


def test_many_rows_are_sent_in_several_requests() -> None:
    table = rows_at_noon(*[("a", "n", float(number), "ok", None) for number in range(2 * MOST_ROWS + 1)])
    assert [len(one) for one in pieces(table)] == [MOST_ROWS, MOST_ROWS, 1]
    assert [row["value"] for one in pieces(table) for row in row_objects(one)] == table["value"].to_pylist()
