"""PostgreSQL, InfluxDB, mosquitto and a web server receive each row exactly once."""

from __future__ import annotations

import json
import os
import random
import re
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.parse
import urllib.request
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import forwarded
import pytest
from brokers import Listener, mosquitto
from commands import BoundProcess
from forwarded import DRAIN, Key, forwarding, keys_in, rows_at_noon, store, web_server
from free_ports import free_ports
from lines import until
from peers import require_module, require_program
from postgres_clusters import postgres
from spooled import NOON, STEP, rows_of
from tables import first_in_ci

from multidrop.gateway.forward.http import line_protocol
from multidrop.gateway.sending import post
from multidrop.printable import parse_time
from multidrop.samples import unpack

DOCS = Path(__file__).parents[3] / "docs"
KINDS = ("postgres", "influx", "upload", "mqtt")


@dataclass
class Receiver:
    """A running receiver of rows: its address, and a function that returns the keys of the received rows."""

    where: str
    keys: Callable[[], list[Key]]


@contextmanager
def receiver(kind: str, folder: Path) -> Iterator[Receiver]:
    with ExitStack() as stack:
        if kind == "postgres":
            database = stack.enter_context(postgres())
            query = "select time_ns, drive, register from multidrop.samples"

            def rows() -> list[Any]:
                return [*map(tuple, database.ask(query))]

            yield Receiver(database.where, rows)
        elif kind == "influx":
            server = stack.enter_context(influx(folder / "influx"))
            names = ("time", "drive", "register")
            yield Receiver(
                server.url,
                lambda: [
                    tuple(row[name] for name in names)  # type: ignore[misc]
                    for row in server.ask("select * from multidrop")
                ],
            )
        elif kind == "upload":
            posted = stack.enter_context(web_server())
            yield Receiver(posted.url, lambda: keys_in(posted.batches))
        else:
            require_module("paho.mqtt.client")
            broker = stack.enter_context(mosquitto(folder))
            listener = Listener(broker, "multidrop/#")
            stack.callback(listener.close)

            def keys() -> list[Key]:
                listener.drain()
                found = [(one.topic, json.loads(one.payload)) for one in listener.all]
                return keys_in([said | {"topic": topic} for topic, said in found])

            yield Receiver(broker.address, keys)


def wanted(exchanges: range) -> Counter[Key]:
    """Return a Counter that has the key of each row of the exchanges once."""
    return Counter(
        (NOON + number * STEP, f"pump-{number % 4 + 1}", f"value_{at}")
        for number in exchanges
        for at in range(1, 11)
    )


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("kills", first_in_ci(3, 20))
def test_each_row_arrives_once_although_the_gateway_is_killed(tmp_path: Path, kind: str, kills: int) -> None:
    """Each run of the gateway has its own exchange numbers. Each row on the disk must arrive exactly once."""
    dice = random.Random(kills)
    support = os.pathsep.join(map(str, Path(forwarded.__file__).parents[1].iterdir()))
    here = {**os.environ, "PYTHONPATH": support}
    command = [sys.executable, forwarded.__file__, kind]
    with receiver(kind, tmp_path) as target:
        told = []
        for run in range(kills):
            words = [*command, target.where, str(tmp_path / "gateway"), str(run * 1_000_000)]
            with BoundProcess(words, stdout=subprocess.PIPE, text=True, env=here) as child:
                assert child.stdout is not None
                least = [int(child.stdout.readline()) for _ in range(2)][1]
                time.sleep(dice.uniform(0, 0.4))
                child.kill()
                said = child.stdout.read().split("\n")[:-1]
            told.append(int(said[-1]) if said else least)
        words = [*command, target.where, str(tmp_path / "gateway"), str(DRAIN)]
        drained = subprocess.run(words, env=here, capture_output=True, text=True, check=True)
        assert "done" in drained.stdout
        least_rows = Counter[Key]()
        for run, count in enumerate(told):
            least_rows += wanted(range(run * 1_000_000, run * 1_000_000 + count))
        until(lambda: sum(Counter(target.keys()).values()) >= sum(least_rows.values()))
        found = Counter(target.keys())
    print(f"{kind}: {kills} kills, {sum(told)} exchanges on the disk, {sum(found.values())} rows arrived")
    assert min(told) > 0
    assert least_rows - found == Counter()
    assert set(found.values()) == {1}


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("kills", first_in_ci(3, 20))
def test_each_row_arrives_once_although_the_database_is_killed(tmp_path: Path, kills: int) -> None:
    """The database is killed while rows arrive, and is then started again."""
    dice = random.Random(kills)
    with postgres() as database:
        part = forwarding("postgres", database.where, tmp_path / "gateway")
        thread = threading.Thread(target=part._forwarder.run)
        thread.start()
        try:
            for number in range(kills):
                store(part._spool, number * 500, 250)
                time.sleep(dice.uniform(0, 0.1))
                database.kill()
                store(part._spool, number * 500 + 250, 250)
                database.start()
                database.wait()
            until(lambda: not part._forwarder.behind)
        finally:
            part._forwarder.close()
            thread.join()
            part._spool.close()
        found = Counter(database.ask("select time_ns, drive, register from multidrop.samples"))
    assert found == wanted(range(kills * 500))


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_receiver_gets_all_rows_with_and_without_values(tmp_path: Path, kind: str) -> None:
    with receiver(kind, tmp_path) as target:
        part = forwarding(kind, target.where, tmp_path / "gateway")
        store(part._spool, 0, 20)
        part._forwarder.step()
        part._spool.close()
        assert part.health() == ""
        until(lambda: Counter(target.keys()) == wanted(range(20)))
        part._forwarder._receiver.close()


@pytest.mark.slow
def test_a_postgres_database_stores_rows_and_the_newest_message_number(tmp_path: Path) -> None:
    """The gateway's database user either may create a schema, or owns one."""
    with postgres() as database:
        database.ask("create role gateway login")
        database.ask("create schema multidrop authorization gateway")
        where = database.where.replace("user=multidrop", "user=gateway")
        part = forwarding("postgres", where, tmp_path)
        store(part._spool, 0, 20)
        assert part._forwarder.step() == 0
        query = "select time_ns, drive, register, value, status from multidrop.samples order by 1, 2, 3"
        found = database.ask(query)
        [stored] = [*(tmp_path / "spool" / "postgres").glob("*.arrows")]
        polled = rows_of(unpack(stored.read_bytes()))
        assert found == sorted((row[0], row[3], row[4], row[5], row[6]) for row in polled)
        assert database.ask("select newest, gaps from multidrop.spools") == [(1, [])]
        page = (DOCS / "gateway" / "database.md").read_text("utf-8")
        queries = re.findall(r"```text\n((?:select|delete)[^`]*)```", page)
        assert len(queries) == 3
        for query in queries:
            if "hypertable" not in query:
                database.ask(query)
        part._spool.close()
        part._forwarder._receiver.close()


@pytest.mark.slow
def test_a_database_gets_each_row_once_after_two_hours_of_downtime(tmp_path: Path) -> None:
    with postgres() as database:
        part = forwarding("postgres", database.where, tmp_path)
        sender, now_s = part._forwarder, [0.0]
        sender._clock = lambda: now_s[0]
        store(part._spool, 0, 5)
        assert sender.step() == 0
        database.kill()
        due_s = 0.0
        for number in range(1, 61):  # 60 steps of two minutes
            store(part._spool, number * 5, 5)
            now_s[0] += 120.0
            if now_s[0] >= due_s:
                due_s = now_s[0] + sender.step()
        assert "PostgreSQL" in part.health()
        database.start()
        database.wait()
        while sender.step() < 0.5:
            pass
        assert part.health() == ""
        query = "select time_ns, drive, register from multidrop.samples"
        assert Counter(map(tuple, database.ask(query))) == wanted(range(61 * 5))
        part._spool.close()
        sender._receiver.close()


@pytest.mark.slow
def test_a_broker_gets_each_row_once_after_two_hours_of_downtime(tmp_path: Path) -> None:
    require_module("paho.mqtt.client")
    with ExitStack() as stack:
        broker = stack.enter_context(mosquitto(tmp_path))
        broker.kill()
        part = forwarding("mqtt", broker.address, tmp_path / "gateway")
        sender, now_s, due_s = part._forwarder, [0.0], 0.0
        sender._clock = lambda: now_s[0]
        for number in range(60):
            store(part._spool, number * 5, 5)
            now_s[0] += 120.0
            if now_s[0] >= due_s:
                due_s = now_s[0] + sender.step()
        assert "Connection refused" in part.health()
        broker.start()
        listener = Listener(broker, "multidrop/#")
        stack.callback(listener.close)
        while sender.step() < 0.5:
            pass
        part._spool.close()
        received = [json.loads(listener.wait_for(lambda _: True).payload) for _ in range(60 * 4)]
    assert Counter(keys_in([one | {"topic": one["rows"][0]["drive"]} for one in received])) == wanted(
        range(300)
    )
    first = parse_time(received[0]["rows"][0]["time"])
    assert first >= NOON + 295 * STEP  # the newest message is sent first
    assert [one["historical"] for one in received] == [*[False] * 4, *[True] * 59 * 4]


@pytest.mark.slow
def test_influx_stores_repeated_rows_with_special_characters_once(tmp_path: Path) -> None:
    given = [
        ("a b,c=d", "n", 1e-7, "ok", "kgf/cm²"),
        ("насос", "n", 1.0, "ok", "names of yd1000"),
        ("fan", "n", None, 'a "b" \\', ""),
    ]
    with influx(tmp_path / "influx") as server:
        for _ in range(2):
            post(server.url, line_protocol(rows_at_noon(*given), "multidrop"), {})
        found = server.ask('select "drive", "register", "value", "miss", "unit" from multidrop')
    assert [tuple(row.values()) for row in found] == [
        (NOON + at, drive, register, value, None if value else status, unit or None)
        for at, (drive, register, value, status, unit) in enumerate(given)
    ]


PATIENCE_S = 30.0
CONFIG = """
reporting-disabled = true
bind-address = "127.0.0.1:{rpc}"
[meta]
dir = "{folder}/meta"
[data]
dir = "{folder}/data"
wal-dir = "{folder}/wal"
query-log-enabled = false
[http]
bind-address = "127.0.0.1:{http}"
log-enabled = false
[monitor]
store-enabled = false
"""


class Influx:
    """A server with a database `plant`."""

    def __init__(self, folder: Path) -> None:
        program = require_program("influxd")
        folder.mkdir()
        rpc, self.port = free_ports(2)
        (folder / "influxdb.conf").write_text(CONFIG.format(rpc=rpc, http=self.port, folder=folder))
        self.process = subprocess.Popen(
            [program, "-config", str(folder / "influxdb.conf")],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        ends = time.monotonic() + PATIENCE_S
        while True:
            try:
                self.ask("create database plant", method="POST")
            except OSError:
                assert time.monotonic() < ends, "InfluxDB does not answer"
                time.sleep(0.05)
            else:
                return

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}/write?db=plant"

    def ask(self, query: str, method: str = "GET") -> list[dict[str, Any]]:
        """Return the rows of the first series of a query's answer, with times in ns."""
        words = urllib.parse.urlencode({"db": "plant", "q": query, "epoch": "ns"})
        request = urllib.request.Request(f"http://127.0.0.1:{self.port}/query?{words}", method=method)
        with urllib.request.urlopen(request, timeout=PATIENCE_S) as answer:
            [result] = json.load(answer)["results"]
        [series] = result.get("series") or [{"columns": [], "values": []}]
        return [dict(zip(series["columns"], row, strict=True)) for row in series["values"]]


@contextmanager
def influx(folder: Path) -> Iterator[Influx]:
    running = Influx(folder)
    try:
        yield running
    finally:
        running.process.kill()
        running.process.wait()
