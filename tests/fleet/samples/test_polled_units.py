"""Units of a fleet's samples: each row keeps the unit that its register had when it was polled."""

from __future__ import annotations

import socket
import time
from email.parser import BytesParser
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from nats.aio.client import Client
from nats_clusters import Cluster
from peers import require_module
from spooled import NOON, STEP, empty_stream, numbered

import multidrop
from multidrop import History
from multidrop.core import Mastership
from multidrop.fleet.gateway import FleetLines
from multidrop.fleet.samples.hub import Commit, ParquetSink
from multidrop.fleet.samples.samples_stream import StreamMessage, read_after
from multidrop.fleet.servers.buckets import Record
from multidrop.fleet.servers.plant_store import line_of
from multidrop.history import compact
from multidrop.history.units import RAW as HISTORY_RAW
from multidrop.history.units import unit_texts_of
from multidrop.samples.message import RAW, PolledUnits, RowBuffer, unpack

FAMILY = """
[family]
title = "A meter"
manual = "none"
baudrates = [9600]
formats = ["8N1"]
together = {{ input = 80 }}

[reading]
value_1 = {{ at = "30001", {load}, place = "table 1" }}
value_2 = {{ at = "30002", values = {{ OFF = 0, ON = 1 }}, place = "table 1" }}
value_3 = {{ at = "30003", place = "table 1" }}
"""
AMPERES = 'unit = "A", step = 0.1'


def record(load: str) -> Record:
    drive: dict[str, object] = {"name": "pump-1", "model": "meter.toml", "address": 1, "baudrate": 9600}
    drive["poll"] = [{"register": f"value_{at}", "every": "1 s"} for at in (1, 2, 3)]
    line = {"name": "line-1", "port": "socket://127.0.0.1:1", "drive": [drive]}
    return Record("line-1", 1, {"line": line, "files": {"meter.toml": FAMILY.format(load=load)}})


def changed(folder: Path) -> PolledUnits:
    """Return the units of a line whose first register is in volts until exchange 20, and then in amperes."""
    units = PolledUnits()
    units.note(line_of(record('unit = "V"'), folder), 0)
    units.note(line_of(record(AMPERES), folder), 20 * STEP)
    return units


def tables(units: PolledUnits | None, first: int = 0) -> list[pa.Table]:
    buffer = RowBuffer()
    assert buffer.add(numbered(first, 40).columns())
    return [unpack(message.data) for message in buffer.messages(units=units)]


def units_in(table: pa.Table, register: str) -> list[tuple[int, str | None]]:
    """Return the exchanges of pump-1 in order: the number of each, and the unit of this register in it."""
    columns = [table.column(name).to_pylist() for name in ("drive", "register", "unit")]
    times = table.column("time").cast("int64").to_pylist()
    rows = zip(times, *columns, strict=True)
    return sorted(((time - NOON) // STEP, unit) for time, *of, unit in rows if of == ["pump-1", register])


def test_stored_row_keeps_its_unit_after_the_register_unit_changes(tmp_path: Path) -> None:
    """The old unit stays even if rows of both units are packed into one message after the change."""
    (table,) = tables(changed(tmp_path))
    assert units_in(table, "value_1") == [(at, "V" if at < 20 else "A") for at in range(0, 40, 4)]
    assert units_in(table, "value_2") == [(at, "names of meter.toml") for at in range(0, 40, 4)]
    assert units_in(table, "value_3") == [(at, "") for at in range(0, 40, 4)]
    # the line does not poll this register, so its unit is unknown
    assert units_in(table, "value_4") == [(at, None) for at in range(0, 40, 4)]


def test_a_gateway_records_a_changed_unit_when_it_polls_a_line_again(tmp_path: Path) -> None:
    units = PolledUnits()
    lines = FleetLines(Mastership(), tmp_path, units)
    lines._take(record('unit = "V"'))
    with pytest.raises(ValueError, match="line-1"):  # refused, because the line is polled already
        lines._take(record('unit = "kW"'))
    lines.poller.remove_line("line-1")
    before_ns = time.monotonic_ns()
    lines._take(record(AMPERES))
    lines.poller.close()
    table = units.table(("pump-1",), ("value_1",))
    [change] = table.changes
    assert (table.texts[change.code], table.texts[table.newest[0].as_py()]) == ("V", "A")
    assert before_ns < change.until_ns <= time.monotonic_ns()


@pytest.mark.slow
def test_merged_files_keep_units_even_if_some_rows_have_no_unit(tmp_path: Path) -> None:
    require_module("duckdb")
    sink = ParquetSink(tmp_path)
    hour = 3600 * 10**9 // STEP
    for at, units in ((0, None), (50, changed(tmp_path / "lines")), (hour, None)):
        found = tables(units, at)
        last = {0: 1, 50: 2}.get(at, 3)
        sink.write(Commit("made", last, last, {"a.x": last}, found, 400))
    sink.close()
    assert compact.main([str(tmp_path), "--below", "0", "--merge-rows"]) == 0
    merged, _ = sorted((tmp_path / "rows").glob("*.parquet"))
    assert merged.name.startswith("00000001-00000002.")
    found = dict(units_in(pq.read_table(merged), "value_1"))
    assert {found[at] for at in range(0, 40, 4)} == {None}
    assert {found[at] for at in range(52, 90, 4)} == {"A"}


def test_gateway_and_history_use_the_same_unit_names() -> None:
    plant = {"drives": {"a": {"model": "meter.toml", "registers": {"b": {"values": {"ON": 1}}}}}}
    assert unit_texts_of(plant) == {("a", "b"): "names of meter.toml"}
    assert RAW == HISTORY_RAW


@pytest.fixture(params=["as they came", "merged"])
def kept(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """Return a hub's folder whose first file has a change of units, and whose last rows have no units."""
    require_module("duckdb")
    folder, units = tmp_path / "kept", changed(tmp_path / "lines")
    sink = ParquetSink(folder)
    hour = 3600 * 10**9 // STEP
    for at, first in enumerate((0, 40, 80, hour), 1):
        found = tables(None if first == 40 else units, first)
        sink.write(Commit("made", at, at, {"a.x": at}, found, 400))
    sink.close()
    if request.param == "merged":
        assert compact.main([str(folder), "--below", "0", "--merge-rows"]) == 0
        assert len(list((folder / "rows").iterdir())) == 2
        assert pq.read_table(*(folder / "tens").glob("00000001-*")).column("unit").null_count
    return folder


@pytest.mark.slow
def test_rows_of_two_gateways_are_read_in_order_of_time(tmp_path: Path) -> None:
    """The second gateway has taken over the lines, and was started later, so its monotonic time is lower."""
    require_module("duckdb")
    (first,), (second,) = tables(None), tables(None, 40)
    at = first.schema.get_field_index("monotonic_ns")
    later = pc.add(first.column(at), 10**15)
    sink = ParquetSink(tmp_path)
    both = [first.set_column(at, first.schema.field(at), later), second]
    sink.write(Commit("made", 1, 2, {"a.x": 1, "b.y": 1}, both, 800))
    sink.close()
    with History(tmp_path) as history:
        rows = history.read(["pump-1.value_1", "pump-2.value_1"])
        times = [row.time_ns for batch in rows for row in batch]
        assert times == sorted(times)
        assert len(times) == 40
        wide = pa.table(rows.wide()).column("time").cast(pa.int64()).to_pylist()
    assert wide == times


BEGIN, BEFORE, END = NOON, NOON + 18 * STEP, NOON + 120 * STEP


@pytest.mark.slow
@pytest.mark.parametrize("points", [1, 120])
def test_a_plot_of_a_hubs_folder_shows_only_the_newest_unit_of_a_register(kept: Path, points: int) -> None:
    with History(kept) as history:
        found = history.buckets([f"pump-1.value_{at}" for at in (1, 2, 3, 4)], BEGIN, END, points)
        before = history.buckets("pump-1.value_1", BEGIN, BEFORE, points)["pump-1.value_1"]
    told = {name[-7:]: (sum(one.n), one.unit, one.left_out) for name, one in found.items()}
    assert told == {
        "value_1": (25, "A", ("V",)),
        "value_2": (30, "names of meter.toml", ()),
        "value_3": (30, "", ()),
        "value_4": (30, None, ()),
    }
    assert (sum(before.n), before.unit, before.left_out) == (5, "V", ())


@pytest.mark.long
def test_each_unit_of_a_register_is_exported_as_a_column(kept: Path, tmp_path: Path) -> None:
    with History(kept) as history:
        rows = history.read("pump-1.value_1", BEGIN, END)
        about = rows.metadata["drives"]["pump-1"]["registers"]
        assert {name: one["unit"] for name, one in about.items()} == {"value_1": "A", "value_1 [V]": "V"}
        history.export(tmp_path / "out.parquet", "pump-1.value_1", BEGIN, END)
        everything = history.read(None, BEGIN, END)
        about = everything.metadata["drives"]["pump-1"]["registers"]
        assert about["value_2"]["unit"] == "names of meter.toml"
        for found in (rows, multidrop.open_recording(tmp_path / "out.parquet"), everything):
            columns: dict[str, set[int]] = {}
            for batch in found:
                for row in batch:
                    if row.drive == "pump-1" and "value_1" in row.register.split(" "):
                        columns.setdefault(row.register, set()).add((row.time_ns - NOON) // STEP)
            assert (max(columns["value_1 [V]"]), min(columns["value_1"])) == (16, 20)


@pytest.mark.slow
def test_a_single_file_from_a_hubs_folder_cannot_be_opened(kept: Path) -> None:
    with pytest.raises(ValueError, match="a file of `multidrop hub`: read its folder with"):
        multidrop.open_recording(min((kept / "rows").iterdir()))


# ---- the gateway and number of a message in the stream are right, whatever headers its writer has set ----


OTHERS = "Nats-Subject: samples.victim.{0}\r\nNats-Sequence: {1}\r\nNats-Last-Sequence: {2}\r\n"
HOSTILE = {
    "another subject": OTHERS,
    "a line that is no header": OTHERS + "no header\r\n",
    "an empty line": OTHERS + "\r\n",
    "an end of all messages": "Status: 404\r\nno header\r\n",
    "an empty name": ": \r\n",
    "a folded line": " Nats-Sequence: 5\r\n\tNats-Subject: samples.victim.x\r\n",
    "half a line's end": "A: b\nNats-Subject: samples.victim.x\r\n",
    "a name with a space": "Nats-Sequence : 5\r\n",
    "no ASCII": "\xff\xfe: 1\r\n",
}


async def _as_mail(self: Client, headers: bytes | None) -> dict[str, str] | None:
    """Parse headers as nats-py did until 2.14, with Python's e-mail parser."""
    parsed = BytesParser().parsebytes((headers or b"").partition(b"\r\n")[2])
    return {name.strip(): str(value).strip() for name, value in parsed.items()} or None


def say_with(url: str, subject: str, headers: str) -> None:
    """Publish a message with headers that no client library would send."""
    block = b"NATS/1.0\r\n" + headers.encode("latin-1") + b"\r\n"
    address = urlsplit(url)
    with socket.create_connection((address.hostname, address.port)) as link, link.makefile("rb") as answers:
        answers.readline()
        link.sendall(b'CONNECT {"headers": true, "verbose": false}\r\n')
        link.sendall(f"HPUB {subject} {len(block)} {len(block) + 1}\r\n".encode() + block + b"x\r\nPING\r\n")
        assert answers.readline() == b"PONG\r\n"


@pytest.mark.slow
@pytest.mark.parametrize("parser", [None, _as_mail])
async def test_no_message_header_can_forge_the_origin_of_samples(
    running: Cluster, parser: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    if parser:
        monkeypatch.setattr(Client, "_process_headers", parser)
    async with empty_stream(running) as path:
        for number, headers in enumerate(HOSTILE.values(), 1):
            text = headers.format(f"log{number}", number, number - 1)
            say_with(running.urls[0], "samples.evil.log", f"{text}Multidrop-Sequence: {number}\r\n")
        say_with(running.urls[0], "samples.good.log", "Multidrop-Sequence: 1\r\nMultidrop-Lost: 7\r\n")
        found: list[StreamMessage] = []
        while more := await read_after(path, found[-1].place if found else 0, 4, 1 << 20):
            found += more
    assert [message.place for message in found] == [*range(1, len(HOSTILE) + 2)]
    assert {(message.gateway, message.log) for message in found[:-1]} == {("evil", "log")}
    assert [message.sequence for message in found[:-1]] == [*range(1, len(HOSTILE) + 1)]
    assert found[-1] == StreamMessage(len(HOSTILE) + 1, "good", "log", 1, 7, b"x")
