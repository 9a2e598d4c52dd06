"""Reload of the plant file: a file with mistakes changes nothing, and a valid file is polled."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from broken_part import BrokenFeed
from gateways import (
    POLL,
    Answer,
    Served,
    certificate,
    gateway_of,
    plant_text,
    running,
    served,
    simulated_plant,
    tokens,
)
from lines import HOST_LATE, PATIENCE, until

import multidrop
from multidrop import Batch, Bus, InvtCHE, LineError, Plant
from multidrop.core import Names, boottime_ns, now_ns
from multidrop.gateway import reload
from multidrop.gateway.http.rights import Right, new_token
from multidrop.gateway.live import drive_reads
from multidrop.polling.added_rows import AddedRow, JoinedColumns
from multidrop.recording.segments import segments_of
from multidrop.sim import Simulator, Wire, simulated

MAY = '[serve.may]\nstop = "anyone"\nwrite = ["pump-1.setpoint"]\nverbs = ["pump-1.start"]\n'


def edit(gateway: Served, old: str, new: str) -> None:
    """Replace a text that occurs once in the plant file."""
    path = gateway.gateway.plant.path
    text = path.read_text()
    assert text.count(old) == 1
    path.write_text(text.replace(old, new))


class Rows:
    """A gateway part that records the rows it receives."""

    def __init__(self) -> None:
        self.found: list[tuple[str, str, int]] = []  # (drive, status, time of the request in ns) of each row
        self.adopted: list[Plant] = []

    def take(self, batch: Batch) -> None:
        self.found += [(row.drive, str(row.status), row.monotonic_ns) for row in batch]

    def adopt(self, plant: Plant) -> None:
        self.adopted.append(plant)

    async def run(self) -> None: ...

    async def close(self) -> None: ...


@contextmanager
def two_lines(
    folder: Path, serve: str = MAY, fans: Sequence[str] = ("fan-1",)
) -> Iterator[tuple[Served, Rows]]:
    """Yield a gateway with the lines hall (pump-1) and roof (`fans`; only fan-1 answers), and its rows."""
    secrets, known = tokens()
    sims = {name: simulated(InvtCHE(1, name=name, baudrate=38400)) for name in ("pump-1", "fan-1")}
    path = folder / "plant.toml"
    with Simulator([Wire([sim], unpaced=True) for sim in sims.values()]) as simulator:
        hall, roof = (wire.path for wire in simulator.wires)
        path.write_text(
            plant_text(hall, ["pump-1"])
            + plant_text(roof, fans, serve).replace('name = "hall"', 'name = "roof"')
        )
        gateway, rows = gateway_of(path, tokens=known), Rows()
        gateway.feeds["rows"] = rows
        with running(gateway) as loop:
            yield Served(gateway, sims, secrets, loop), rows


@pytest.mark.slow
def test_a_reload_changes_nothing_if_the_plant_file_has_mistakes(tmp_path: Path) -> None:
    with served(tmp_path) as gateway:
        revision = gateway.gateway.revision
        gateway.await_state("pump-2", "stands")
        path = gateway.gateway.plant.path
        good = path.read_text()
        drives = [polled.drive for polled in gateway.gateway.plant.lines[0].drives]
        path.write_text(
            good.replace('model = "invt-che"', 'model = "invt-chf"').replace("= 38400", '= "fast"')
        )
        told = gateway.reload()
        assert told["done"] is False
        assert told["text"] == "the previous plant stays in use: the file has mistakes"
        lines = told["mistakes"]
        assert [mistake.partition(": ")[0] for mistake in lines] == [f"{path}:{line}" for line in (4, 7, 13)]
        path.write_text(path.read_text() + '[serve]\nlisten = 80\n[serve.may]\nwrite = ["pump-9.setpoint"]\n')
        (of_serve,) = [one for one in gateway.reload()["mistakes"] if one not in lines]
        assert of_serve == f'{path}:18: [serve]: listen = 80 is not right; write listen = "127.0.0.1:8750"'
        path.write_text(good + '[serve]\nlisten = 80\n[serve.may]\nwrite = ["pump-9.setpoint"]\n')
        mistakes = gateway.reload()["mistakes"]
        assert mistakes == [
            f'{path}:18: [serve]: listen = 80 is not right; write listen = "127.0.0.1:8750"',
            f"{path}:20: [serve.may]: write: there is no drive 'pump-9'; did you mean pump-2 or pump-1?",
        ]
        health = gateway.get("/health")
        assert (health.status, health.json["status"]) == (200, "degraded")
        assert health.json["mistakes"] == mistakes
        plant = gateway.get("/api/plant").json
        assert (plant["mistakes"], plant["revision"]) == (mistakes, revision)
        assert drives == [polled.drive for polled in gateway.gateway.plant.lines[0].drives]
        taken = gateway.gateway.hub.last_answer("pump-2") or (0,)
        until(lambda: (gateway.gateway.hub.last_answer("pump-2") or (0,)) > taken)

        path.unlink()
        (mistake,) = gateway.reload()["mistakes"]
        assert "plant.toml" in mistake
        path.write_text(good)
        assert gateway.reload() == {
            "done": True,
            "text": "plant.toml is in effect",
            "mistakes": [],
            "restart": [],
        }
        plant = gateway.get("/api/plant").json
        assert (plant["mistakes"], plant["revision"]) == ([], revision + 1)
        assert gateway.get("/health").json["status"] == "ok"
        assert drives == [polled.drive for polled in gateway.gateway.plant.lines[0].drives]


@pytest.mark.long
def test_a_reload_adds_and_removes_drives_and_keeps_unchanged_lines(tmp_path: Path) -> None:
    with two_lines(tmp_path) as (gateway, rows):
        revision = gateway.gateway.revision
        gateway.await_state("fan-1", "stands")
        (pump,) = gateway.gateway.plant.lines[0].drives
        gateway.sims["fan-1"].deaf_until = float("inf")
        gateway.await_state("fan-1", "silent")
        until(lambda: [one for one in gateway.frame()["alarms"] if one["drive"] == "fan-1"])
        edit(gateway, 'name = "fan-1"', 'name = "fan-2"')
        assert gateway.reload()["done"] is True
        gateway.sims["fan-1"].deaf_until = 0.0
        gateway.await_state("fan-2", "stands")
        frame = gateway.frame()
        assert (frame["revision"], frame["drives"].keys()) == (revision + 1, {"pump-1", "fan-2"})
        ended = [one["ended"] for one in frame["alarms"] if one["drive"] == "fan-1"]
        assert ended  # on a busy machine, fan-1 may have had several alarms
        assert None not in ended
        names = [line["drives"][0]["name"] for line in gateway.get("/api/plant").json["lines"]]
        assert names == ["pump-1", "fan-2"]
        assert rows.adopted == [gateway.gateway.plant]
        assert gateway.gateway.plant.lines[0].drives[0].drive is pump.drive
        adopted_ns = time.monotonic_ns()  # rows requested before this time may still arrive

        def later() -> list[str]:
            return [drive for drive, _, at_ns in rows.found if at_ns > adopted_ns]

        until(lambda: later().count("pump-1") > 12)
        statuses = {status for drive, status, _ in rows.found if drive == "pump-1"}
        assert "ok" in statuses
        assert statuses <= {"ok", *HOST_LATE}
        assert "fan-1" not in later()
        told = gateway.post("/api/stop").json
        assert {name: one["done"] for name, one in told.items()} == {"pump-1": True, "fan-2": True}
        until(lambda: gateway.gateway.recent.line("roof")["rate"])
        assert gateway.gateway.failures == {}


def test_late_rows_of_a_changed_drive_are_dropped_after_a_reload(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A late row was requested before the reload, so the measuring unit of its value is unknown."""
    with two_lines(tmp_path) as (gateway, rows):
        edit(gateway, 'name = "fan-1"', 'name = "fan-2"')
        asked_ns = now_ns()
        assert gateway.reload()["done"] is True
        later_ns = now_ns()
        added = [AddedRow(0, ns, 0, drive, 0, 0, 3.0) for drive in (0, 1) for ns in (asked_ns, later_ns)]
        batches = [Batch(JoinedColumns(None, added), Names(["pump-1", "fan-2"]), Names(["status"]))]
        late = SimpleNamespace(take=lambda: batches.pop() if batches else None)
        gateway.loop.call_soon_threadsafe(gateway.gateway.hand_out, late)
        until(lambda: ("fan-2", "ok", later_ns) in rows.found)
        assert ("pump-1", "ok", asked_ns) in rows.found
        assert ("fan-2", "ok", asked_ns) not in rows.found
        assert gateway.gateway.reload._changed == {"fan-1", "fan-2"}
        monkeypatch.setattr(reload, "SETTLED_NS", 0)
        until(lambda: not gateway.gateway.reload._changed)  # by the next polled rows of fan-2


@pytest.mark.slow
def test_a_missing_port_is_reported_after_a_reload(tmp_path: Path) -> None:
    with two_lines(tmp_path) as (gateway, _):
        roof = gateway.gateway.plant.lines[1].port
        edit(gateway, roof, str(tmp_path / "nosuch"))
        assert gateway.reload()["done"] is True
        assert gateway.frame()["lines"]["roof"]["lost"] == f"{tmp_path}/nosuch: there is no such port"
        assert gateway.reload()["done"] is True  # the reason is still reported after another reload
        assert gateway.frame()["lines"]["roof"]["lost"] == f"{tmp_path}/nosuch: there is no such port"
        edit(gateway, str(tmp_path / "nosuch"), roof)
        assert gateway.reload()["done"] is True
        gateway.await_state("fan-1", "stands")
        until(lambda: gateway.frame()["lines"]["roof"]["lost"] is None)


def test_a_reload_applies_changed_rights_and_host_names(tmp_path: Path) -> None:
    with served(tmp_path, f'[serve]\nnames = ["old.example"]\nlisten = "localhost:1"\n{MAY}') as gateway:
        gateway.await_state("pump-1", "stands")
        assert gateway.get("/health", host="old.example").status == 200
        assert gateway.get("/health", host="new.example").status == 421
        edit(gateway, "old.example", "new.example")
        edit(gateway, "localhost:1", "localhost:2")
        edit(gateway, 'stop = "anyone"\nwrite = ["pump-1.setpoint"]', 'write = ["pump-2.setpoint"]')
        restart = ["listen of [serve] takes effect after a restart"]
        assert gateway.reload()["restart"] == restart
        assert gateway.get("/health").json["restart"] == restart
        assert gateway.get("/health", host="old.example").status == 421
        assert gateway.get("/health", host="new.example").status == 200
        assert gateway.post("/api/stop").status == 401
        assert gateway.get("/api/plant", **gateway.writer).json["may"]["write"] == ["pump-2.setpoint"]

        def write(drive: str) -> Answer:
            body = {"drive": drive, "register": "setpoint", "value": 10.0}
            return gateway.command("/api/write", body, **gateway.writer)

        assert write("pump-1").status == 403
        assert write("pump-2").json["done"] is True


def test_a_reload_grants_no_rights_while_a_proxy_setting_needs_a_restart(tmp_path: Path) -> None:
    with served(tmp_path, "[serve]\nbehind_proxy = false\n") as gateway:
        edit(gateway, "behind_proxy = false\n", f"behind_proxy = true\n{MAY}")
        assert gateway.reload()["restart"] == ["behind_proxy of [serve] takes effect after a restart"]
        assert gateway.post("/api/stop").status == 401


def test_a_reload_reports_that_a_renewed_certificate_needs_a_restart(tmp_path: Path) -> None:
    """Users would notice only when the old certificate expires."""
    certificate(tmp_path, "own")
    serve = '[serve]\ncertificate = "own.pem"\nkey = "own.key"\n'
    with served(tmp_path, serve, tls=None) as gateway:
        assert gateway.reload()["restart"] == []
        certificate(tmp_path, "own")
        assert gateway.reload()["restart"] == ["certificate of [serve] takes effect after a restart"]
        assert gateway.get("/health").json["restart"] == [
            "certificate of [serve] takes effect after a restart"
        ]


def test_a_token_removed_from_the_file_is_invalid_after_a_reload(tmp_path: Path) -> None:
    secrets, known = tokens()
    newer, newcomer = new_token("bert", Right.LOOK)
    file = tmp_path / "tokens"
    file.write_text("".join(f"{token.line}\n" for token in known))
    serve = '[serve]\ntokens = "tokens"\n[serve.may]\nlook = "token"\n'
    with simulated_plant(tmp_path, serve) as path:
        gateway = gateway_of(path)
        with running(gateway):
            client = Served(gateway, {}, secrets)

            def answers() -> list[int]:
                bearers = [*(client.bearer(right) for right in Right), f"Bearer {newer}"]
                return [client.get("/api/plant", authorization=bearer).status for bearer in bearers]

            assert answers() == [200, 200, 200, 401]
            file.write_text(f"{known[-1].line}\n{newcomer.line}\n")
            assert answers() == [200, 200, 200, 401]  # until the reload, the removed token is valid
            assert gateway.commands.plant_ns is None
            begun_ns = boottime_ns()
            assert client.reload()["done"] is True
            assert answers() == [401, 401, 200, 200]
            read_ns = gateway.commands.plant_ns  # time of the latest reload
            assert read_ns is not None
            assert begun_ns <= read_ns <= boottime_ns()


@pytest.mark.long
def test_values_polled_before_a_reload_are_not_shown_after_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After the reload, the name may mean another drive, and this drive may be silent."""
    monkeypatch.setattr(drive_reads, "PAUSE_S", 0.0)
    with served(tmp_path, MAY) as gateway:
        gateway.await_state("pump-1", "stands")

        def values() -> list[object]:
            told = gateway.get("/api/drive/pump-1").json["values"]
            return [value for value, *_ in told.values() if value is not None]

        until(values)
        gateway.sims["pump-1"].deaf_until = float("inf")
        gateway.await_state("pump-1", "silent")
        assert values()
        edit(gateway, MAY, "")
        assert gateway.reload()["done"] is True
        assert values() == []


def test_a_reload_grants_no_rights_while_a_changed_address_needs_a_restart(tmp_path: Path) -> None:
    """Until the restart, the gateway listens on the old address, which other clients may reach."""
    serve = '[serve]\nlisten = "127.0.0.1:0"\ntokens = "tokens"\n[serve.may]\nlook = "token"\n'
    with served(tmp_path, serve) as gateway:
        edit(gateway, "127.0.0.1:0", "127.0.0.2:0")
        edit(gateway, 'look = "token"', 'stop = "anyone"')
        assert gateway.reload()["restart"] == ["listen of [serve] takes effect after a restart"]
        assert gateway.get("/api/plant").status == 401
        assert gateway.post("/api/stop").status == 401
        edit(gateway, "127.0.0.2:0", "127.0.0.1:0")
        assert gateway.reload()["restart"] == []
        assert gateway.get("/api/plant").json["may"]["role"] == "stop"


def test_a_reload_needs_the_right_to_write_and_a_confirmation(tmp_path: Path) -> None:
    with served(tmp_path, MAY) as gateway:
        revision = gateway.gateway.revision
        assert gateway.post("/api/reload", {"confirm": True}).status == 401
        stopper = {"authorization": gateway.bearer(Right.STOP)}
        assert gateway.post("/api/reload", {"confirm": True}, **stopper).status == 403
        unconfirmed = gateway.post("/api/reload", {}, **gateway.writer)
        assert unconfirmed.status == 400
        assert unconfirmed.json == {
            "error": 'a reload can change the polled drives: confirm it with {"confirm": true} in the body'
        }
        assert gateway.gateway.revision == revision


@pytest.mark.slow
def test_a_start_sent_before_a_reload_does_not_reach_a_new_drive_of_that_name(tmp_path: Path) -> None:
    with served(tmp_path, MAY) as gateway:
        seen = gateway.frame()["n"]
        path = gateway.gateway.plant.path
        names = {"pump-1": "pump-2", "pump-2": "pump-1"}
        path.write_text(
            re.sub(r'name = "(pump-.)"', lambda found: f'name = "{names[found[1]]}"', path.read_text())
        )
        assert gateway.reload()["done"] is True
        start = {"drive": "pump-1", "verb": "start", "options": {}, "seen": seen}
        told = gateway.post("/api/act", start, **gateway.writer).json
        assert told["text"].startswith(
            f"pump-1.start was not sent: the plant file was reloaded after the values seen (frame {seen})"
        )
        assert not any(sim.motor.goal for sim in gateway.sims.values())  # type: ignore[attr-defined]


@pytest.mark.slow
def test_a_stop_during_a_reload_stops_the_new_drive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with two_lines(tmp_path, MAY.replace("pump-1", "fan-1")) as (gateway, _):
        revision = gateway.gateway.revision
        gateway.start("fan-1")
        poller = gateway.gateway.poller
        assert poller is not None
        adopt, changed, answered = poller.adopt, threading.Event(), threading.Event()

        def hold(plant: Plant) -> dict[str, LineError]:
            found = adopt(plant)
            changed.set()
            assert answered.wait(PATIENCE)
            return found

        monkeypatch.setattr(poller, "adopt", hold)
        old = gateway.gateway.plant.lines[1].drives[0].drive
        edit(gateway, 'name = "fan-1"', 'name = "fan-1"\nmaximum_frequency = 50.0')
        told: list[Any] = []
        threads = [threading.Thread(target=lambda: told.append(gateway.reload()))]
        threads[0].start()
        assert changed.wait(PATIENCE)
        assert old.bus is None
        threads += [
            threading.Thread(target=lambda drives=drives: told.append(gateway.post("/api/stop", drives).json))
            for drives in ({"drives": None}, {"drives": ["fan-1"]})
        ]
        called = gateway.gateway.commands.called
        for thread in threads[1:]:
            thread.start()
        until(lambda: gateway.gateway.commands.called == called + 2)
        answered.set()
        for thread in threads:
            thread.join(PATIENCE)
        stops = [one for one in told if "fan-1" in one]
        assert [one["fan-1"]["done"] for one in stops] == [True, True]
        assert gateway.stands("fan-1")
        assert gateway.gateway.revision == revision + 1


def held_up(monkeypatch: pytest.MonkeyPatch) -> tuple[threading.Event, threading.Event]:
    """Delay the opening of each bus; return the events "opening has started" and "opening may go on"."""
    opening, go_on = threading.Event(), threading.Event()
    open_bus = Bus.__init__

    def slow(bus: Bus, *arguments: Any, **details: Any) -> None:
        opening.set()
        assert go_on.wait(PATIENCE)
        open_bus(bus, *arguments, **details)

    monkeypatch.setattr(Bus, "__init__", slow)
    return opening, go_on


@pytest.mark.slow
@pytest.mark.parametrize("way", ["stop", "coast"])
def test_a_stop_is_sent_while_a_reload_opens_another_port(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, way: str
) -> None:
    """The drive has been replaced already, and the port of another line is still being opened."""
    verbs = '"fan-1.start", "fan-1.coast"'
    may = MAY.replace("pump-1", "fan-1").replace('"fan-1.start"', verbs)
    with two_lines(tmp_path, may, ("fan-1", "fan-2")) as (gateway, _):
        gateway.start("fan-1")
        opening, go_on = held_up(monkeypatch)
        edit(gateway, 'name = "fan-1"', 'name = "fan-1"\nmaximum_frequency = 50.0')
        # the changed key makes the reload open this line again
        edit(gateway, 'name = "hall"', 'name = "hall"\necho = "off"')
        told: list[Any] = []
        reloading = threading.Thread(target=lambda: told.append(gateway.reload()))
        reloading.start()
        try:
            assert opening.wait(PATIENCE)
            if way == "coast":
                asked = "/api/act", {"drive": "fan-1", "verb": way, "options": {}}
            else:
                asked = "/api/stop", {"drives": ["fan-1"]}
            stopping = threading.Thread(target=lambda: gateway.post(*asked, **gateway.writer))
            stopping.start()
            until(lambda: gateway.stands("fan-1"))
            assert reloading.is_alive()
        finally:
            go_on.set()
            reloading.join(PATIENCE)
            stopping.join(PATIENCE)
        assert told[0]["done"]


OTHER = """
[family]
title = "Another"
manual = "made for this test"
baudrates = [38400]
formats = ["8N1"]
counts_from = 0
[reading]
dc_bus_voltage = { at = 0x3002, unit = "A", step = 0.5, place = "1" }
"""  # in the family INVT CHE, `dc_bus_voltage` is a raw count instead


@pytest.mark.long
@pytest.mark.slow
def test_old_values_never_get_the_unit_of_measurement_of_a_new_drive(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The new drive has another family. It is polled already while another line is still being opened."""
    (tmp_path / "other.toml").write_text(OTHER)
    with two_lines(tmp_path, "[serve.history]\n" + MAY) as (gateway, _):
        path, poller, hub = gateway.gateway.plant.path, gateway.gateway.poller, gateway.gateway.hub
        assert poller is not None
        path.write_text(path.read_text().replace(POLL, '["dc_bus_voltage"]'))
        assert gateway.reload()["done"]
        until(lambda: hub.fresh("fan-1", "dc_bus_voltage") is not None)
        opening, go_on = held_up(monkeypatch)
        # the changed key makes the reload open this line again
        text = path.read_text().replace('name = "hall"', 'name = "hall"\necho = "off"')
        before, _, roof = text.rpartition('model = "invt-che"')
        path.write_text(f'{before}model = "other.toml"\nformat = "8N1"{roof}')
        told: list[Any] = []
        reloading = threading.Thread(target=lambda: told.append(gateway.reload()))
        reloading.start()
        try:
            assert opening.wait(PATIENCE), told
            exchanges, taken = poller.statistics()["roof"].exchanges, hub.taken
            until(lambda: poller.statistics()["roof"].exchanges > exchanges + 5)
            until(lambda: hub.taken > taken + 3)
        finally:
            go_on.set()
            reloading.join(PATIENCE)
        assert told[0]["done"]
        taken = hub.taken
        until(lambda: hub.taken > taken + 3)
    found = set()
    segments = [path for _, path in segments_of(tmp_path / "history" / "rows.arrows")]
    for path in [*segments, *(tmp_path / "history" / "rows").glob("*.parquet")]:
        recording = multidrop.open_recording(path)
        about = recording.metadata["drives"]["fan-1"]["registers"].get("dc_bus_voltage")
        found |= {
            (about["unit"], about["step"], row.value)
            for batch in recording
            for row in batch
            if row.drive == "fan-1" and row.register == "dc_bus_voltage" and row.value is not None
        }
    raw = next((value for _, step, value in found if step is None), 0.0)
    assert found == {("V", None, raw), ("A", 0.5, raw / 2)}


@pytest.mark.slow
def test_a_stop_in_progress_continues_during_a_reload(tmp_path: Path) -> None:
    """The reload waits for the stop before it replaces the drive."""
    with two_lines(tmp_path) as (gateway, _):
        revision = gateway.gateway.revision
        gateway.await_state("fan-1", "stands")
        gateway.sims["fan-1"].deaf_until = float("inf")
        told: list[Any] = []
        stopping = threading.Thread(target=lambda: told.append(gateway.post("/api/stop").json))
        called = gateway.gateway.commands.called
        stopping.start()
        until(lambda: gateway.gateway.commands.called > called)
        edit(gateway, 'name = "fan-1"', 'name = "fan-1"\nmaximum_frequency = 50.0')
        reloading = threading.Thread(target=lambda: told.append(gateway.reload()))
        reloading.start()
        gateway.await_state("pump-1", "stands")
        gateway.sims["fan-1"].deaf_until = 0.0
        stopping.join(PATIENCE)
        reloading.join(PATIENCE)
        (stopped,) = [one for one in told if "fan-1" in one]
        assert {name: one["done"] for name, one in stopped.items()} == {"pump-1": True, "fan-1": True}
        assert gateway.gateway.revision == revision + 1


def test_a_reload_works_after_a_failed_reload(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Deaf(BrokenFeed):
        def adopt(self, plant: Plant) -> None:
            raise RuntimeError("no plant")

    with two_lines(tmp_path) as (gateway, rows):
        gateway.gateway.feeds["deaf"] = Deaf()
        assert gateway.reload()["done"] is True
        assert gateway.gateway.failures["deaf"] > 0
        monkeypatch.setattr(gateway.gateway.poller, "adopt", lambda plant: 1 // 0)
        edit(gateway, 'name = "fan-1"', 'name = "fan-2"')
        told = gateway.reload()
        assert (told["done"], told["mistakes"]) == (False, ["integer division or modulo by zero"])
        assert [one["done"] for one in gateway.post("/api/stop").json.values()] == [True, True]
        failed_ns = now_ns()
        until(lambda: any(drive == "fan-1" and at_ns > failed_ns for drive, _, at_ns in rows.found))
