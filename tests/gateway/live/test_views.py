"""Views of a plant over HTTP: its description, frames, one drive, lines, alarms, and unpolled registers."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
from gateways import Served, served
from lines import line, plant, polled, until

from multidrop import NoReply
from multidrop.control.eeprom_ledger import LedgerCell
from multidrop.families import ErmanERG220, InvtCHE
from multidrop.gateway.live import drive_reads
from multidrop.gateway.live.descriptions import describe_line
from multidrop.gateway.live.hub import Hub

MAY = '[serve.may]\nwrite = ["pump-1.setpoint"]\nverbs = ["pump-1.start"]\n'


@pytest.fixture
def gateway(tmp_path: Path) -> Iterator[Served]:
    with served(tmp_path, MAY) as found:
        until(lambda: found.frame()["drives"]["pump-2"]["state"] == "stands")
        yield found


def test_plant_description_has_data_of_plant_file_and_manual(gateway: Served) -> None:
    plant = gateway.get("/api/plant").json
    assert plant["name"] == "plant.toml"
    assert plant["may"] == {"role": "look", "write": [], "verbs": []}
    (line,) = plant["lines"]
    assert (line["name"], line["speed"]) == ("hall", "38400 8N1")
    pump, other = line["drives"]
    assert (pump["name"], pump["family"], pump["address"], other["address"]) == ("pump-1", "invt-che", 1, 2)
    assert pump["key"] == {
        "frequency": "output_frequency",
        "current": "output_current",
        "setpoint": "setpoint",
    }
    assert pump["verbs"] == ["start", "jog", "reset_fault", "set_frequency", "coast", "stop"]
    registers = {one["name"]: one for one in pump["registers"]}
    status, frequency, setpoint = (registers[one] for one in ("status", "output_frequency", "setpoint"))
    assert (status["kind"], status["words"]["3"], status["period_s"]) == ("words", "standby", 0.1)
    assert status["holds_s"] >= 1
    assert (frequency["kind"], frequency["unit"], frequency["digits"]) == ("number", "Hz", 2)
    assert (setpoint["access"], setpoint["least"], setpoint["most"]) == ("setting", 0, 100)
    assert setpoint["period_s"] is None
    for right, may in ((1, []), (2, ["pump-1.setpoint"])):
        headers = {"authorization": gateway.bearer(list(gateway.secrets)[right])}
        assert gateway.get("/api/plant", **headers).json["may"]["write"] == may


def test_drives_of_one_line_have_their_own_speeds() -> None:
    drives = [polled(drive, drive.readings()) for drive in (ErmanERG220(1), InvtCHE(2), InvtCHE(3))]
    hub = Hub(plant(line("/dev/null", *drives)))
    told = describe_line(hub, hub.plant.lines[0])
    assert told["speed"] == "38400 8N1, 9600 8N1"
    assert [drive["speed"] for drive in told["drives"]] == ["38400 8N1", "9600 8N1", "9600 8N1"]


def test_a_frame_has_values_with_their_own_times(gateway: Served) -> None:
    gateway.sims["pump-1"]["output_current"] = 12.3
    frame: dict[str, Any] = {}

    def shown() -> list[Any]:
        frame.update(gateway.frame())
        values: list[Any] = frame["drives"]["pump-1"]["values"]["output_current"]
        return values

    until(lambda: shown()[0] == 12.3)
    pump = frame["drives"]["pump-1"]
    _, place = pump["values"]["output_current"]
    assert 0 <= pump["ages_ms"][place] < 60_000
    assert pump["seen"] is not None
    assert abs(datetime.fromisoformat(frame["time"]).timestamp() - time.time()) < 60
    assert frame["lines"]["hall"]["lost"] is None
    following = gateway.get(f"/api/frame?after={frame['n']}").json
    assert following["n"] > frame["n"] == following["since"]
    assert "revision" not in following  # a frame of changes omits equal values


def test_new_page_gets_the_samples_of_the_last_minute(gateway: Served) -> None:
    def points() -> list[Any]:
        found: list[Any] = gateway.get("/api/minute").json.get("pump-1", {}).get("output_frequency", [])
        return found

    until(points)
    ((ms, value), *_) = points()
    assert abs(ms - time.time() * 1e3) < 60_000
    assert value == 0.0


@pytest.mark.long
def test_values_of_a_silent_drive_are_marked_as_old(gateway: Served) -> None:
    gateway.sims["pump-2"]["output_current"] = 45.6
    until(lambda: gateway.frame()["drives"]["pump-2"]["values"]["output_current"][0] == 45.6)
    gateway.sims["pump-2"].deaf_until = float("inf")
    gateway.await_state("pump-2", "silent")
    frame = gateway.frame()
    pump = frame["drives"]["pump-2"]
    now, _, status, last, then = pump["values"]["output_current"]
    assert (now, last) == (None, 45.6)
    assert status
    ages = pump["ages_ms"]
    assert ages[then] >= ages[pump["seen"]] > 900
    assert pump["why"]

    def alarms() -> list[dict[str, Any]]:
        return [one for one in gateway.frame()["alarms"] if one["drive"] == "pump-2"]

    def lasting() -> list[dict[str, Any]]:
        return [one for one in alarms() if one["ended"] is None]

    until(lasting)  # on a busy machine there may have been other alarms before
    begun = lasting()[0]
    assert begun["kind"] == "silent"
    gateway.sims["pump-2"].deaf_until = 0.0
    until(lambda: begun["time"] in [one["time"] for one in alarms() if one["ended"]])
    told = gateway.get("/api/alarms?from=0&to=9999999999999").json
    assert begun["time"] in [one["time"] for one in told["alarms"]]
    assert told["since"] <= begun["time"]
    assert gateway.get("/api/alarms?from=0&to=1").json["alarms"] == []


@pytest.mark.slow
def test_a_fault_has_the_text_of_its_drive(gateway: Served) -> None:
    gateway.sims["pump-1"].trip(4)  # type: ignore[attr-defined]
    gateway.await_state("pump-1", "fault")
    until(lambda: gateway.frame()["drives"]["pump-1"]["fault"] == "overcurrent while accelerating (OC1)")


@pytest.mark.long
def test_unpolled_registers_are_read_while_a_drive_is_viewed(
    gateway: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(drive_reads, "PAUSE_S", 0.0)
    monkeypatch.setattr(drive_reads, "SHARE", 0)
    gateway.sims["pump-1"]["dc_bus_voltage"] = 537.0

    def looked() -> dict[str, list[object]]:
        found: dict[str, list[object]] = gateway.get("/api/drive/pump-1").json["values"]
        return found

    until(lambda: looked().get("dc_bus_voltage", [None])[0] == 537.0)
    assert "output_current" not in looked()
    until(lambda: gateway.get("/api/drive/pump-1").json["delays"]["counts"])
    asked = gateway.get("/api/drive/pump-1").json
    assert asked["asked"] > 0
    assert sum(count for _, count in asked["delays"]["counts"]) == asked["delays"]["replies"]
    monkeypatch.setattr(drive_reads, "LOOKED_S", -1.0)
    until(lambda: not gateway.gateway.side_reads.under_way)


@pytest.mark.long
@pytest.mark.slow
def test_viewing_does_not_read_a_silent_drive(gateway: Served) -> None:
    gateway.sims["pump-2"].deaf_until = float("inf")
    gateway.await_state("pump-2", "silent")
    asked: list[object] = []
    pump = next(each for each in gateway.gateway.bus("hall").drives if each.name == "pump-2")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drive_reads, "PAUSE_S", 0.0)
        patch.setattr(pump, "read", lambda *arguments: asked.append(arguments))
        for _ in range(20):
            assert gateway.get("/api/drive/pump-2").json["values"] == {}
    assert asked == []


@pytest.mark.long
def test_lines_show_the_delays_of_each_drive(gateway: Served) -> None:
    until(lambda: gateway.get("/api/lines").json["hall"]["minutes"])
    line = gateway.get("/api/lines").json["hall"]
    assert line["lost"] is None
    assert line["minutes"][0]["asked"] > 0
    assert set(line["drives"]) == {"pump-1", "pump-2"}
    assert line["drives"]["pump-1"]["asked"] > 0


@pytest.mark.long
def test_misses_of_a_silent_drive_are_counted_against_requested_values(gateway: Served) -> None:
    """Misses count values, of which one request has several, so they must not be divided by requests."""
    recent = gateway.gateway.recent

    def came() -> int:
        statistics = recent.drive("hall", "pump-2")
        return statistics.samples if statistics else 0

    def missed() -> int:
        found: int = gateway.get("/api/lines").json["hall"]["drives"]["pump-2"]["missed"]
        return found

    until(lambda: came() > 40)
    before = came()
    gateway.sims["pump-2"].deaf_until = float("inf")
    until(lambda: missed() > 40)
    line = gateway.get("/api/lines").json["hall"]["drives"]["pump-2"]
    assert line["asked"] >= line["missed"] + before
    drive = gateway.get("/api/drive/pump-2").json
    assert drive["asked"] >= sum(drive["misses"].values()) + before


def test_drive_shows_only_eeprom_writes_of_its_port_address_and_family(gateway: Served) -> None:
    """Another drive may have the same address on another port, or may have had it on this port before."""
    drive = gateway.gateway.plant.find_drive("pump-1")[1]
    assert gateway.gateway.poller
    port = gateway.gateway.poller.bus("hall").line.identity
    cells = [
        LedgerCell(port, 1, drive.ledger_name, "acceleration_time"),
        LedgerCell(port, 1, "yd1000", "foreign_family"),
        LedgerCell(port, 2, drive.ledger_name, "foreign_address"),
        LedgerCell("/dev/elsewhere", 1, drive.ledger_name, "foreign_line"),
    ]
    gateway.gateway.ledger.at(port).note(cells, time.time())
    ledger = gateway.get("/api/drive/pump-1").json["ledger"]
    assert ledger == [{"register": "acceleration_time", "year": 1, "budget": 1000, "total": 1}]


@pytest.mark.slow
def test_ask_reads_words_outside_the_register_table(gateway: Served) -> None:
    """Modbus masters get words as the drive stores them."""
    gateway.sims["pump-1"]["output_current"] = 12.3

    def ask(drive: str, expiry_s: float) -> list[int]:
        return asyncio.run(gateway.gateway.ask(drive, 3, 0x3003, 2, expiry_s))

    sent = gateway.sims["pump-1"].drive.register("output_current")

    def current() -> list[int] | None:
        with suppress(NoReply):  # on a busy machine the simulator may answer too late
            return asyncio.run(gateway.gateway.ask("pump-1", 3, sent.address, 1, 5.0))
        return None

    until(lambda: current() == [123])
    with pytest.raises(ValueError, match="has no drive 'pump-9'"):
        ask("pump-9", 1.0)
    gateway.sims["pump-2"].deaf_until = float("inf")
    with pytest.raises(NoReply):
        ask("pump-2", 60.0)


def test_health_is_ok_while_all_drives_answer(gateway: Served) -> None:
    health = gateway.get("/health")
    assert (health.status, health.json["status"], health.json["lines"]) == (200, "ok", {"hall": "ok"})
