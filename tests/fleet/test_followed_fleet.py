"""A gateway without its own lines: it shows and exports a whole fleet's values, and stops its drives."""

from __future__ import annotations

import asyncio
import json
import time
from array import array
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pyarrow as pa
import pytest
from brokers import Listener, has, mosquitto
from commands import kill_all
from fleets import HandClock, MemoryBucket
from gateways import Served, running
from lines import until
from spooled import NOON, numbered
from tables import table

from multidrop import PlantError
from multidrop.control import CommandOutcome
from multidrop.fleet import followed
from multidrop.fleet.errors import FleetError
from multidrop.fleet.followed import FollowedFleet, RowReader
from multidrop.fleet.lines.rules import owner_value
from multidrop.fleet.overview import MISSED_MS, FleetView, FleetWatch
from multidrop.fleet.samples.samples_stream import StreamMessage
from multidrop.fleet.servers import names
from multidrop.fleet.servers.connections import ServerPath
from multidrop.gateway.commands import FleetStops
from multidrop.gateway.gateway import Gateway
from multidrop.gateway.http.rights import Caller, May, Right
from multidrop.gateway.settings import read_plant
from multidrop.plant.loader import load_plant, load_served_plant
from multidrop.samples.message import RowBuffer, unpack

S = 1_000_000_000
GATEWAYS = ("gw-a", "gw-b")
SERVERS = '[serve.fleet]\nnats = ["nats://127.0.0.1:1"]\n'


def message(first: int, gateway: str = "gw-1", sequence: int = 1) -> StreamMessage:
    """Return a stream message with eight exchanges of simulated drives, from exchange number `first`."""
    rows = RowBuffer()
    rows.add(numbered(first, 8).columns())
    [packed] = rows.messages()
    return StreamMessage(1, gateway, "log", sequence, 0, packed.data)


class Clocks:
    """The clocks of the computer that reads the samples; `utc_s` is 0 at the first exchange."""

    def __init__(self, utc_s: float) -> None:
        self.utc_s = utc_s

    def __call__(self) -> tuple[int, int]:
        return round(1000 * S + self.utc_s * S), round(NOON + self.utc_s * S)


def reader_by(clocks: Callable[[], tuple[int, int]]) -> RowReader:
    """Return a reader that reads all registers of the simulated drives."""
    reader, columns = RowReader(clocks), numbered(0, 1).columns()
    reader.known = {(drive, register) for drive in columns.drives for register in columns.registers}
    return reader


def test_samples_of_unknown_drives_are_ignored_and_not_remembered() -> None:
    reader = RowReader(Clocks(1.0))
    assert reader.rows([message(0)]) is None
    assert not reader._newest


def test_an_ok_sample_without_value_is_shown_as_no_valid_value(monkeypatch: pytest.MonkeyPatch) -> None:
    table = unpack(message(0).data)
    at = table.schema.get_field_index("value")
    empty = table.set_column(at, table.schema.field("value"), pa.nulls(len(table), pa.float64()))
    monkeypatch.setattr(followed, "unpack", lambda data: empty)
    found = reader_by(Clocks(1.0)).rows([message(0)])
    columns = found.columns()
    assert {columns.statuses[code] for code in columns.status} == {"no valid value"}
    assert not any(columns.valid)


def test_number_of_names_and_statuses_from_samples_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    array("H", [followed.MOST_NAMES, followed.MOST_STATUSES])  # raises OverflowError above 16 bits
    monkeypatch.setattr(followed, "MOST_NAMES", 5)
    monkeypatch.setattr(followed, "MOST_STATUSES", 3)
    reader, count = reader_by(Clocks(1.0)), 20
    registers, statuses = ([f"{name} {number}" for number in range(count)] for name in ("register", "status"))
    rows = {"drive": ["pump"] * count, "register": registers, "status": statuses, "time": [NOON] * count}
    nothing = pa.nulls(count, pa.int64())
    hostile = pa.table({**rows, "uncertainty_ns": nothing, "value": nothing})
    monkeypatch.setattr(followed, "unpack", lambda data: hostile)
    reader.known = {("pump", register) for register in registers}
    found = reader.rows([message(0)])
    columns = found.columns()
    assert (len(columns.registers), columns.registers[-1], max(columns.register)) == (6, "", 5)
    assert (len(columns.statuses), columns.statuses[-1], max(columns.status)) == (4, "other", 3)


def test_received_samples_get_monotonic_times_of_this_computer() -> None:
    reader = reader_by(Clocks(1.0))
    found = reader.rows([message(0)])
    columns = found.columns()
    assert len(columns.time) == 4 * 10  # four drives with ten registers each
    assert len(columns.valid) == 5
    for at, (moment, monotonic, drive, register, value) in enumerate(
        zip(columns.time, columns.monotonic_ns, columns.drive, columns.register, columns.value, strict=True)
    ):
        # The message has exchanges 0 to 7 with four drives, two with each. Only the second one is shown.
        number = 4 + int(columns.drives[drive][5:]) - 1
        assert moment == NOON + number * 10_000_000
        assert monotonic == 1000 * S + number * 10_000_000
        assert value == number + int(columns.registers[register][6:]) - 1
        assert columns.valid[at // 8] >> at % 8 & 1


def test_older_samples_of_a_former_master_do_not_replace_newer_samples() -> None:
    reader = reader_by(Clocks(1.0))
    assert reader.rows([message(8, "gw-2")]) is not None
    assert reader.rows([message(0, "gw-1")]) is None
    codes = reader.rows([message(16, "gw-2")])
    assert codes.columns().statuses[0] == "ok"


def test_new_samples_are_shown_after_the_computers_clock_was_set_back() -> None:
    times = iter([(1000 * S, NOON + S), (1001 * S, NOON - 3600 * S)])
    reader = reader_by(lambda: next(times))
    assert reader.rows([message(0)]) is not None
    assert reader.rows([message(8)]) is not None


def test_forged_and_damaged_messages_are_ignored() -> None:
    reader = reader_by(Clocks(1.0))
    assert reader.rows([message(0, sequence=0), message(0)._replace(data=b"\xff\xff\xff\xff")]) is None


@table(
    ("utc_s", "sentence"),
    [
        (1.0, ""),
        (60.0, "samples of gw-1 are 60 s old on arrival: it sends a backlog, or its clock is slow"),
        (-40.0, "the clock of gw-1 is 40 s ahead of this computer's"),
    ],
)
def test_wrong_clock_is_reported_and_no_sample_is_in_the_future(
    monkeypatch: pytest.MonkeyPatch, utc_s: float, sentence: str
) -> None:
    clocks = Clocks(utc_s)
    source = FollowedFleet(ServerPath([]), FleetWatch(FleetView(ServerPath([]))))
    source.trouble, source._reader = "", reader_by(clocks)
    found = source._reader.rows([message(0)])
    source.close()
    monkeypatch.setattr(followed.time, "time_ns", lambda: clocks()[1])
    assert max(found.columns().monotonic_ns) <= clocks()[0]
    assert source.health() == sentence
    clocks.utc_s += 7.0
    assert source.health() == ""


class Fleet:
    """A fake FleetWatch. A test sets its view of a fleet."""

    age_s = 0.0

    def __init__(self) -> None:
        self.fleet: dict[str, Any] = {
            "trouble": None,
            "lines": {"hall": {"master": "gw-1"}},
            "gateways": {"gw-1": {"says": {"troubles": {}}}},
        }

    def state(self) -> Mapping[str, Any]:
        return self.fleet


@table(
    ("change", "silent_s", "why"),
    [
        ({}, 5.0, ""),
        ({}, 7.0, "its gateway gw-1 sends no samples"),
        ({"gateways": {"gw-1": {"says": None}}}, 5.0, ""),
        ({"gateways": {"gw-1": {"says": None}}}, 7.0, "its gateway gw-1 does not answer"),
        ({"lines": {"hall": {"master": None}}}, 7.0, "no gateway of the fleet polls it"),
        ({"lines": {}}, 7.0, "no gateway of the fleet polls it"),
        ({"trouble": "no quorum"}, 7.0, "the fleet's servers do not answer: no quorum"),
        (
            {"gateways": {"gw-1": {"says": {"troubles": {"hall": "port lost: EIO"}}}}},
            0.0,
            "gw-1: port lost: EIO",
        ),
    ],
)
def test_a_line_without_samples_for_6_s_counts_as_lost_with_a_reason(
    monkeypatch: pytest.MonkeyPatch, change: dict[str, Any], silent_s: float, why: str
) -> None:
    watch: Any = Fleet()
    watch.fleet |= change
    source = FollowedFleet(ServerPath([]), watch)
    source.close()
    monkeypatch.setattr(followed.time, "monotonic", lambda: source._begun + silent_s)
    assert source._why_lost("hall", watch.state()) == why


def test_only_multidrop_serve_with_a_fleet_accepts_a_plant_without_lines(tmp_path: Path) -> None:
    path = tmp_path / "page.toml"
    path.write_text(SERVERS)
    plant, settings = read_plant(lambda: load_served_plant(path), {})
    assert (plant.lines, [*settings.parts]) == ((), ["fleet"])
    with pytest.raises(PlantError, match="'line' is missing"):
        load_plant(path)
    path.write_text("[serve.mqtt]\n")
    with pytest.raises(PlantError, match="'line' is missing"):
        load_served_plant(path)


@table(
    ("more", "sentence"),
    [
        (
            "[serve.history]",
            "[serve.history] needs [[line]] tables in this plant file; `multidrop hub` stores",
        ),
        ("[serve.modbus]", "[serve.modbus] needs [[line]] tables in this plant file; it serves only values"),
        (
            '[serve.tool]\npty = { hall = "tool" }',
            "[serve.tool] needs [[line]] tables in this plant file; vendors'",
        ),
        (
            '[serve.may]\nverbs = ["a.start"]',
            "[serve.may] lists need [[line]] tables in this file; [fleet.may]",
        ),
    ],
)
def test_settings_that_need_lines_are_refused_in_a_plant_without_lines(
    tmp_path: Path, more: str, sentence: str
) -> None:
    path = tmp_path / "page.toml"
    path.write_text(f"{SERVERS}{more}\n")
    with pytest.raises(PlantError) as raised:
        read_plant(lambda: load_served_plant(path), {})
    assert sentence in str(raised.value)


class Stopper:
    """A fake part `fleet`, whose answers to stops are set by the test."""

    def __init__(self) -> None:
        self.stops: list[tuple[str, Sequence[str] | None]] = []
        self.answer: dict[str, tuple[bool, str]] = {"pump-1": (True, "pump-1: stopped")}

    async def stop(self, by: str, drives: Sequence[str] | None = None) -> Mapping[str, tuple[bool, str]]:
        self.stops.append((by, drives))
        return self.answer


class OneLine:
    """Lines of a plant with one drive, without samples."""

    def __init__(self, folder: Path) -> None:
        path = folder / "plant.toml"
        path.write_text(
            '[[line]]\nname = "hall"\nport = "socket://a:1"\n'
            '[[line.drive]]\nname = "pump-1"\nmodel = "invt-che"\naddress = 1\n'
        )
        self.plant = self.plant_now = load_plant(path)
        self.plant_coming = None


async def test_the_page_of_a_fleet_sends_stops_and_refuses_other_commands(tmp_path: Path) -> None:
    lines: Any = OneLine(tmp_path)
    part = Stopper()
    commands = FleetStops(lines, May(), lambda: part)
    anna = Caller("anna", "page", "127.0.0.1", Right.WRITE)
    viewer = anna._replace(role=Right.LOOK)
    [stopped] = (await commands.stop(["pump-1"], anna)).values()
    assert (stopped.outcome, stopped.text) == (CommandOutcome.DONE, "pump-1: stopped")
    assert (await commands.act("pump-1", "stop", {}, anna)).ok
    assert (await commands.stop(None, anna))["pump-1"].ok
    assert [drives for _, drives in part.stops] == [["pump-1"], ["pump-1"], None]
    assert all("anna by page" in by for by, _ in part.stops)
    part.answer = {"the fleet": (False, "the stop was NOT sent: no server")}
    [failed] = (await commands.stop(["pump-1"], anna)).values()
    assert (failed.ok, failed.text) == (False, "the stop was NOT sent: no server")
    assert not (await commands.stop(None, anna))["the fleet"].ok
    part.answer = {"the fleet": (True, "hall: no drives")}
    [missing] = (await commands.stop(["pump-1"], anna)).values()
    assert missing.outcome is CommandOutcome.UNKNOWN
    calls = len(part.stops)
    refusals = [
        await commands.stop(None, viewer),
        {"": await commands.write("pump-1", "setpoint", 20.0, anna)},
        {"": await commands.act("pump-1", "reset_fault", {}, anna)},
    ]
    assert len(part.stops) == calls
    assert [one.outcome for found in refusals for one in found.values()] == [CommandOutcome.REFUSED] * 3
    assert "`multidrop fleet reset-fault`" in refusals[2][""].text


@pytest.mark.long
def test_one_gateway_can_show_export_and_stop_a_whole_fleet(tmp_path: Path) -> None:
    from secured_clusters import secured_fleet

    with secured_fleet(tmp_path / "fleet", 1, GATEWAYS) as fleet, mosquitto(tmp_path) as broker:
        servers = fleet.servers
        drives = {f"drive-{line}" for line in fleet.hall.lines}
        path = tmp_path / "page.toml"
        path.write_text(
            f'[serve]\nlisten = "127.0.0.1:0"\n[serve.may]\nstop = "anyone"\n'
            f'[serve.fleet]\nnats = ["{servers.urls[0]}"]\nca = "{servers.tls.ca}"\n'
            f'credentials = "{servers.key("viewer")}"\ncommander = "{servers.key("commander")}"\n'
            f'samples = "{servers.key("hub")}"\n'
            f'[serve.mqtt]\nbroker = "{broker.address}"\n'
            '[[serve.limit]]\ndrive = "drive-line-0"\nregister = "output_current"\nbelow = 1.0\n'
        )

        def read() -> Any:
            return read_plant(lambda: load_served_plant(path), {})

        gateway = Gateway(*read(), read=read)
        with running(gateway) as loop:
            page = Served(gateway, {}, {Right.WRITE: ""}, loop)

            def values() -> dict[str, Any]:
                frame = page.frame()
                return {name: drive["values"]["output_current"][0] for name, drive in frame["drives"].items()}

            def alarms(kind: str) -> set[str]:
                found = page.frame()["alarms"]
                return {
                    one["line"] or one["drive"] for one in found if one["kind"] == kind and not one["ended"]
                }

            until(lambda: values() == dict.fromkeys(drives, 0.0))
            with closing(Listener(broker)) as listener:
                for name in sorted(drives):
                    listener.wait_for(has(f"multidrop/{name}"))
            until(lambda: page.get("/health").json["status"] == "ok")
            metrics = page.get("/metrics").body.decode()
            assert all(f',drive="{name}",register="output_current"}} 0.0' in metrics for name in drives)
            until(lambda: alarms("limit") == {"drive-line-0"})
            part: Any = gateway.feeds["fleet"]
            until(lambda: part._commands is not None)
            answer = page.post("/api/stop", {"drives": ["drive-line-1"]}).json
            assert answer["drive-line-1"]["done"], answer
            answer = page.post("/api/stop", {}).json
            assert {name for name, one in answer.items() if one["done"]} == drives, answer
            refused = page.command("/api/act", {"drive": "drive-line-1", "verb": "start"})
            assert refused.status == 401 or "only stops" in refused.json["error"]

            kill_all(fleet.running.values())
            until(lambda: alarms("port") == set(fleet.hall.lines))
            failed = page.post("/api/stop", {"drives": ["drive-line-1"]}).json["drive-line-1"]
            assert "NOT sent" in failed["text"]
            for name in GATEWAYS:
                fleet.start(name)
            until(lambda: alarms("port") == set())
            until(lambda: values() == dict.fromkeys(drives, 0.0))
        assert fleet.hall.overlaps() == 0


# ---- the view: masters from records, states from gateways, and no state of silent gateways ----


SPOOL = {"bytes": 1, "lost": 0, "behind": 0, "lag_s": 0.0, "trouble": None}
STATE = {"state": "working", "lines": 1, "margin_s": 2.0, "troubles": {}, "trouble": "", "spool": SPOOL}
MOVE = {"line": "line-1", "turn": 5, "at_ms": 7, "from": "gw-9", "to": "gw-1"}


class Answering:
    """A fake server connection with the answers of some gateways. No other gateway exists."""

    urls = ["nats://a:4222"]
    is_open = True

    def __init__(self, answers: dict[str, Any]) -> None:
        self.answers = answers

    async def request(self, subject: str, *_: object, **__: object) -> Any:
        for gateway, answer in self.answers.items():
            if f".{gateway}." in subject:
                return SimpleNamespace(data=json.dumps(answer).encode())
        raise FleetError("nobody answers")


def lease(session: int, *, ended: bool = False) -> dict[str, Any]:
    return {"session": session, "ended": ended, "began": 5, "host": "pc", "draining": False}


def view(answers: dict[str, Any] | None = None) -> FleetView:
    """Return a view of five lines and three gateways. The session of gw-3 has ended."""
    made = FleetView(Answering(answers or {}))
    records, leases = made._records, [MemoryBucket(name) for name in names.LEASES]
    for follower, bucket in zip(records.observer.paths, leases, strict=True):
        follower.bucket = bucket
        for gateway, found in (("gw-1", lease(2)), ("gw-2", lease(1)), ("gw-3", lease(4, ended=True))):
            bucket.store(gateway, found)
    plant = records.plant.bucket = MemoryBucket(names.PLANT)
    owners = {name: MemoryBucket(name) for name in names.OWNERS}
    for name, bucket in owners.items():
        records.owners[name].bucket = bucket
    owned = {"line-1": ("gw-1", 2), "line-2": ("gw-1", 1), "line-3": ("gw-3", 4), "line-4": ("", 0)}
    for number in range(1, 6):
        line = f"line-{number}"
        plant.store(line, {"line": {"port": f"socket://h:{number}"}, "files": {}})
        if line in owned:
            for bucket in names.owner_buckets(line)[:2]:
                owners[bucket].store(line, owner_value(owned[line], 5, 1000 * number))
    made._is_checked = True
    return made


def looked(made: FleetView) -> dict[str, Any]:
    asyncio.run(made.look())
    return made.fleet()


def test_line_is_shown_without_a_master_after_the_gateway_session_ended() -> None:
    found = looked(view())
    assert {name: line["master"] for name, line in found["lines"].items()} == {
        "line-1": "gw-1",
        "line-2": None,  # owned by an earlier session of gw-1
        "line-3": None,  # owned by the ended session of gw-3
        "line-4": None,  # released
        "line-5": None,  # no master yet
    }
    first = {"port": "socket://h:1", "revision": 1, "master": "gw-1", "session": 2, "since_ms": 1000}
    assert found["lines"]["line-1"] == first
    assert found["lines"]["line-2"]["since_ms"] is None
    assert {name: gateway["lines"] for name, gateway in found["gateways"].items()} == {"gw-1": 1, "gw-2": 0}


def test_a_gateway_that_does_not_answer_is_shown_without_a_state() -> None:
    made = view({"gw-1": STATE | {"last_moves": [MOVE]}})
    found = looked(made)
    assert found["gateways"]["gw-1"]["says"] == STATE
    assert found["gateways"]["gw-2"]["says"] is None
    assert [move["from"] for move in found["moves"] if move["line"] == "line-1"] == ["gw-9"]
    made._path.answers.clear()
    assert looked(made)["gateways"]["gw-1"]["says"] is None  # its earlier answer is no longer shown


@table("moves", [[{}], [5], "text", None, [MOVE | {"at_ms": "now"}]])
def test_an_invalid_list_of_changed_masters_in_an_answer_is_ignored(moves: Any) -> None:
    found = looked(view({"gw-1": STATE | {"last_moves": moves}}))
    assert found["gateways"]["gw-1"]["says"] == STATE


def test_gateway_is_listed_as_missing_if_another_gateway_ended_its_session() -> None:
    now_ms = time.time_ns() // 1_000_000
    made = view()
    died = {  # newest record in each lease bucket, and whether the gateway counts as missing, by gateway
        "gw-4": (lease(2, ended=True) | {"by": "gw-1", "at_ms": now_ms - 60_000}, True),
        # this gateway has ended its session itself
        "gw-5": (lease(2, ended=True) | {"at_ms": now_ms}, False),
        "gw-6": (lease(2, ended=True) | {"by": "gw-6", "at_ms": now_ms}, False),
        "gw-7": (lease(2, ended=True) | {"by": "gw-1", "at_ms": now_ms - MISSED_MS}, False),
        "gw-9": (lease(2), False),  # this gateway is starting, and has written only one lease record
        "gw-8": (lease(2, ended=True) | {"by": "gw-1"}, True),
    }
    clock = HandClock()
    made._records.observer._clock = clock
    for at, follower in enumerate(made._records.observer.paths):
        for name, (record, _) in died.items():
            if name != "gw-9" or at == 0:
                follower.bucket.store(name, record)
    asyncio.run(made.look())
    clock.pass_s(60)
    found = looked(made)["missing"]
    assert found.keys() == {name for name, (_, is_missing) in died.items() if is_missing}
    assert found["gw-4"] == {"host": "pc", "session": 2, "seen_ms": now_ms - 60_000}
    assert found["gw-8"]["seen_ms"] is None
    for follower in made._records.observer.paths[:2]:
        follower.bucket.store("gw-4", lease(3))
    found = looked(made)
    assert "gw-4" not in found["missing"]
    assert found["gateways"]["gw-4"]["session"] == 3


def test_error_without_a_connection_names_the_server_urls() -> None:
    made = view()
    made._path.is_open = False
    with pytest.raises(FleetError, match="no NATS server can be reached at nats://a:4222"):
        looked(made)


def test_a_gateway_counts_as_seen_only_if_two_lease_records_were_renewed() -> None:
    made = view()
    now = [10 * 10**9]
    observer = made._records.observer
    observer._clock = lambda: now[0]
    looked(made)
    now[0] += 2 * 10**9
    observer.paths[0].bucket.store("gw-1", lease(2))
    found = looked(made)  # one renewed lease record of three is not enough
    assert found["gateways"]["gw-1"]["unseen_s"] == 2.0
    observer.paths[1].bucket.store("gw-1", lease(2))
    assert looked(made)["gateways"]["gw-1"]["unseen_s"] == 0.0
