"""Views of a plant over HTTP: description, live values, a drive, lines, alarms, unpolled registers."""

from __future__ import annotations

import asyncio
import logging
import time
import weakref
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from gateways import Served, served, written
from lines import line, plant, polled, until

from multidrop import LineError, NoReply, WriteForbidden
from multidrop.control.eeprom_ledger import LedgerCell
from multidrop.core import Counters, Status
from multidrop.drive import parameters
from multidrop.drive.parameters import ParameterGroup, ParameterSpace
from multidrop.drive.register import Register
from multidrop.families import ErmanERG220, InvtCHE
from multidrop.gateway.live import drive_reads
from multidrop.gateway.live.drive_reads import Identities
from multidrop.gateway.live.hub import Hub
from multidrop.gateway.live.recent_statistics import MINUTES, RecentStatistics
from multidrop.gateway.live.views import describe_line, line_views
from multidrop.gateway.metrics import plant_families
from multidrop.transport.statistics import LineStatistics, line_statistics

MAY = '[serve.may]\nwrite = ["pump-1.setpoint"]\nverbs = ["pump-1.start"]\n'


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with served(tmp_path_factory.mktemp("views"), MAY) as found:
        yield found


@pytest.fixture
def gateway(shared: Served) -> Iterator[Served]:
    """The shared gateway. When a test starts, both drives answer, and no reads for viewers are pending."""
    shared.await_state("pump-2", "stands")
    yield shared
    for sim in shared.sims.values():
        sim.deaf_until = 0.0
    shared.loop.call_soon_threadsafe(shared.gateway.side_reads.cancel)
    until(lambda: not shared.gateway.side_reads.under_way)


def test_the_plant_description_combines_the_plant_file_and_the_manuals(gateway: Served) -> None:
    plant = gateway.get("/api/plant").json
    assert (plant["name"], plant["history"]) == ("plant.toml", False)
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


def test_a_line_is_described_with_the_baud_rates_of_all_its_drives() -> None:
    drives = [polled(drive, drive.readings()) for drive in (ErmanERG220(1), InvtCHE(2), InvtCHE(3))]
    hub = Hub(plant(line("/dev/null", *drives)))
    told = describe_line(hub, hub.plant.lines[0], "en")
    assert told["speed"] == "38400 8N1, 9600 8N1"
    assert [drive["speed"] for drive in told["drives"]] == ["38400 8N1", "9600 8N1", "9600 8N1"]


def test_messages_to_the_web_page_contain_the_age_of_each_value(gateway: Served) -> None:
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
    assert "revision" not in following  # a frame of changes has no revision if the plant has not changed


@pytest.mark.long
def test_a_newly_opened_web_page_gets_the_values_of_the_last_minute(gateway: Served) -> None:
    began_ms, values = time.time() * 1e3, set[float]()

    def has_new_values() -> bool:
        points = gateway.get("/api/minute").json.get("pump-1", {}).get("output_frequency", [])
        now_ms = time.time() * 1e3
        values.update(value for ms, value in points if began_ms <= ms <= now_ms and value is not None)
        return bool(values)

    until(has_new_values)
    assert values == {0.0}


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

    until(lasting)  # on a busy machine, the drive may have had shorter alarms before
    begun = lasting()[0]
    assert begun["kind"] == "silent"
    gateway.sims["pump-2"].deaf_until = 0.0  # the drive answers again
    until(lambda: begun["time"] in [one["time"] for one in alarms() if one["ended"]])
    told = gateway.get("/api/alarms?from=0&to=9999999999999").json
    assert begun["time"] in [one["time"] for one in told["alarms"]]
    assert told["since"] <= begun["time"]
    assert gateway.get("/api/alarms?from=0&to=1").json["alarms"] == []


@pytest.mark.long
def test_unpolled_registers_are_read_while_a_user_views_the_drive(
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
def test_unpolled_registers_are_not_read_from_a_silent_drive(gateway: Served) -> None:
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


def test_an_unpolled_register_without_a_reply_is_read_once(
    gateway: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each attempt costs a timeout."""
    asked: list[str] = []

    def read(register: Register[Any]) -> None:
        asked.append(register.name)
        raise NoReply("pump-1")

    pump = next(each for each in gateway.gateway.bus("hall").drives if each.name == "pump-1")
    monkeypatch.setattr(drive_reads, "PAUSE_S", 0.0)
    monkeypatch.setattr(drive_reads, "SHARE", 0)
    monkeypatch.setattr(pump, "read", read)
    gateway.get("/api/drive/pump-1")
    until(lambda: asked and not gateway.gateway.side_reads.under_way)
    assert len(asked) == len(set(asked))


@pytest.mark.long
def test_http_returns_the_reply_delays_of_each_drive(gateway: Served) -> None:
    until(lambda: gateway.get("/api/lines").json["hall"]["minutes"])
    line = gateway.get("/api/lines").json["hall"]
    assert line["lost"] is None
    assert line["minutes"][0]["asked"] > 0
    assert set(line["drives"]) == {"pump-1", "pump-2"}
    assert line["drives"]["pump-1"]["asked"] > 0


@pytest.mark.long
def test_failed_reads_of_a_silent_drive_are_counted_per_value(gateway: Served) -> None:
    """A request reads several values at once. Both failures and requests are counted per value."""
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


def test_eeprom_writes_of_another_port_address_or_family_are_not_shown(gateway: Served) -> None:
    """Another drive may have the same address on another port, or may have had this address before."""
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
def test_the_gateway_can_read_words_at_any_address(gateway: Served) -> None:
    """Modbus masters need the words exactly as the drive stores them."""
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


def test_a_gateway_without_triggers_answers_with_an_empty_list(gateway: Served) -> None:
    assert gateway.get("/api/triggers").json == {"triggers": []}


# ---- statistics of the last hour, from few stored readings ----


MINUTE_MS = 60_000


def reading(seconds: int, *, per_s: int = 10) -> LineStatistics:
    """Return the statistics of a line after `seconds` s, with one failed read every 30 s."""
    missed = Counter({int(Status.NO_REPLY): seconds // 30})
    counters = Counters()._replace(values=seconds * per_s, sent=seconds * per_s, missed=missed)
    return line_statistics(float(seconds), {"pump-1": counters}, None)


@pytest.fixture
def recent(tmp_path: Path) -> RecentStatistics:
    return RecentStatistics(written(tmp_path))


@pytest.mark.slow
def test_the_last_hour_has_60_minutes_of_statistics(recent: RecentStatistics) -> None:
    alive: list[weakref.ref[LineStatistics]] = []
    for second in range(0, 70 * 60 + 31, 5):
        found = reading(second)
        alive.append(weakref.ref(found))
        recent.tick(float(second), second * 1000, {"hall": found})
    del found
    hour = recent.hour("hall")
    assert len(hour) == MINUTES
    assert [one["time"] for one in hour] == [minute * MINUTE_MS for minute in range(11, 71)]
    assert all(one["asked"] == 602 and one["misses"] == {"no reply": 2} for one in hour[:-1])
    assert hour[-1] == {"time": 70 * MINUTE_MS, "asked": 301, "misses": {"no reply": 1}}
    assert sum(one() is not None for one in alive) < 10
    assert recent.hour("roof") == []


def test_statistics_of_a_line_exclude_old_readings(recent: RecentStatistics) -> None:
    for second in range(200):
        recent.tick(float(second), second * 1000, {"hall": reading(second)})
        if second == 100:
            assert recent.line("hall")["misses"] == 3
    assert recent.line("hall")["rate"] == 10.0
    assert recent.drive_figures("pump-1")["missed"] == pytest.approx(2 / 600, abs=1e-3)
    assert recent.line("roof")["rate"] is None


@pytest.mark.parametrize("by_s", [-3600, 3600])
def test_the_statistics_of_a_line_are_right_although_the_clock_is_set(
    recent: RecentStatistics, by_s: int
) -> None:
    for second in range(600):
        utc_s = second + (by_s if second >= 90 else 0)
        recent.tick(float(second), utc_s * 1000, {"hall": reading(second)})
    assert recent.line("hall")["misses"] == 3  # number of misses in 90 to 120 s
    assert {one["asked"] for one in recent.hour("hall")[:-1]} == {602}


def test_statistics_of_a_line_without_replies_are_none(recent: RecentStatistics, tmp_path: Path) -> None:
    assert recent.line("hall")["misses"] is None
    for second in range(100):
        # statistics without any reply
        recent.tick(float(second), second * 1000, {"hall": reading(second)})
    assert recent.line("hall")["p99"] is None
    plant = written(tmp_path)
    gateway: Any = SimpleNamespace(plant=plant, hub=Hub(plant), recent=recent)
    drive = line_views(gateway)["hall"]["drives"]["pump-1"]
    assert (drive["p50"], drive["p99"]) == (None, None)
    families = plant_families(gateway.hub, recent.newest)
    (delays,) = [one for one in families if one.name == "multidrop_response_delay_seconds"]
    assert delays.samples == [("_count", {"line": "hall", "drive": "pump-1"}, 0.0)]


def test_a_reopened_line_has_no_rate_before_its_second_reading(recent: RecentStatistics) -> None:
    recent.tick(100.0, 100_000, {"hall": replace(reading(100), epoch=1)})
    recent.tick(101.0, 101_000, {"hall": replace(reading(1), epoch=2)})
    assert (recent.line("hall")["rate"], recent.line("hall")["used"]) == (None, None)
    recent.tick(106.0, 106_000, {"hall": replace(reading(6), epoch=2)})
    assert recent.line("hall")["rate"] == 10.0


def test_the_polling_rate_is_not_negative_after_a_drive_is_removed(recent: RecentStatistics) -> None:
    recent.tick(100.0, 100_000, {"hall": reading(100)})
    recent.tick(101.0, 101_000, {"hall": replace(reading(1), seconds=101.0)})
    assert recent.line("hall")["rate"] == 0.0


# ---- identities are checked before the first stop is called, so that the stop is sent immediately ----


MAY_STOP = '[serve.may]\nstop = "anyone"\n'


@pytest.mark.long
def test_a_stop_is_sent_without_reading_the_identity_of_the_drive(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No identity is read between the call of the stop and the Modbus request that stops the drive."""
    asked: list[str] = []
    with served(tmp_path, MAY_STOP) as gateway:
        bus = gateway.gateway.bus("hall")
        check = bus._performer._writer.identity_check
        until(lambda: all(map(check.is_known, bus.drives)))
        with monkeypatch.context() as patched:
            patched.setattr(check, "_read", lambda drive, *more, **options: asked.append(drive.name))
            told = gateway.post("/api/stop").json
        assert [one["done"] for one in told.values()] == [True, True]
    assert asked == []


class AskedBus:
    """A fake bus that records whose identity was checked, and raises the exceptions in `failures`."""

    def __init__(self, failures: dict[str, Exception]) -> None:
        self.names: list[str] = []
        self.known: set[str] = set()
        self._failures = failures

    def knows_identity(self, drive: Any) -> bool:
        return drive.name in self.known

    def check_identity(self, drive: Any, *, rest_s: float) -> None:
        self.names.append(drive.name)
        if drive.name in self._failures:
            raise self._failures[drive.name]


def ask_all(bus: AskedBus, is_there: Callable[[str], bool], *names: str) -> list[str]:
    """Check the identities of the named drives twice; return "failed" for each unexpected exception."""
    drives = [SimpleNamespace(drive=SimpleNamespace(name=name)) for name in names]
    plant = SimpleNamespace(lines=[SimpleNamespace(name="hall", drives=drives)])
    failed: list[str] = []
    rounds = 0

    def present() -> Any:
        nonlocal rounds
        rounds += 1
        if rounds > 2:
            raise asyncio.CancelledError
        return plant

    of: Any = Identities
    identities = of(present, lambda line: bus, is_there, lambda: failed.append("failed"))
    with suppress(asyncio.CancelledError):
        asyncio.run(identities.run())
    return failed


@pytest.fixture
def _at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drive_reads, "PAUSE_S", 0.0)
    monkeypatch.setattr(drive_reads, "ROUND_S", 0.0)


@pytest.mark.usefixtures("_at_once")
def test_the_identity_of_a_silent_drive_is_not_read() -> None:
    bus = AskedBus({})
    assert ask_all(bus, lambda name: name != "silent", "pump-1", "silent", "pump-2") == []
    assert bus.names == ["pump-1", "pump-2"] * 2


@pytest.mark.usefixtures("_at_once")
def test_a_known_identity_is_not_read_again() -> None:
    """No thread is started for a drive whose identity is known."""
    bus = AskedBus({})
    bus.known.add("pump-1")
    assert ask_all(bus, lambda name: True, "pump-1", "pump-2") == []
    assert bus.names == ["pump-2"] * 2


@pytest.mark.usefixtures("_at_once")
def test_a_drive_of_the_wrong_family_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    stranger = WriteForbidden(
        "nothing is written to fan-1, so it is not a CHE", rule="it does not look like its family"
    )
    failures = {"fan-1": stranger, "lost": LineError("/dev/x", "gone"), "broken": RuntimeError("a bug")}
    bus = AskedBus(failures)
    with caplog.at_level(logging.WARNING):
        assert ask_all(bus, lambda name: True, *failures, "pump-1") == ["failed", "failed"]
    # Leave out the supervisor's log lines: it may report threads that end later than this test's event loop.
    told = [one.message for one in caplog.records if one.name == "multidrop.gateway"]
    assert told == [str(stranger)]
    assert bus.names == [*failures, "pump-1"] * 2


# ---- parameters over HTTP: read on request only, and exported as files ----


PARAMETERS = "/api/parameters/pump-1"


def parameter_state(gateway: Served) -> str:
    return str(gateway.get(PARAMETERS).json["state"])


def test_parameters_are_read_on_request_and_exported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    space = ParameterSpace(groups=(ParameterGroup("P.", 0x2000, range(3)),))
    monkeypatch.setattr(InvtCHE, "parameter_space", space)
    parameters._parameters_of.cache_clear()
    with served(tmp_path) as gateway:
        gateway.sims["pump-1"]["setpoint"] = 12.5
        assert parameter_state(gateway) == "none"
        assert gateway.get(f"{PARAMETERS}?format=toml").status == 409
        assert gateway.get(f"{PARAMETERS}?read=1").json["state"] in ("reading", "read")
        until(lambda: parameter_state(gateway) == "read")
        (row,) = gateway.get(PARAMETERS).json["parameters"]
        assert (row["code"], row["name"], row["value"]) == ("P.00", "setpoint", "12.50 %")
        answer = gateway.get(f"{PARAMETERS}?format=csv")
        assert b"\nP.00;1250;setpoint;12.50 %;\n" in answer.body
        assert "attachment" in answer.headers["content-disposition"]
        assert b'"P.00" = 1250' in gateway.get(f"{PARAMETERS}?format=toml").body
        assert gateway.get(f"{PARAMETERS}?format=exe").status == 400
        assert gateway.sims["pump-1"].counters.functions[6] == 0
    parameters._parameters_of.cache_clear()


def test_reading_parameters_is_refused_for_a_family_without_known_addresses(tmp_path: Path) -> None:
    with served(tmp_path) as gateway:
        gateway.get(f"{PARAMETERS}?read=1")
        until(lambda: parameter_state(gateway) == "failed")
        assert "addresses of parameters are not known" in gateway.get(PARAMETERS).json["error"]
        assert gateway.get("/api/parameters/nobody").status == 404
