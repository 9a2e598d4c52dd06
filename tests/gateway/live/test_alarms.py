"""Alarms: faults of every family, lost ports, restarts, acknowledgements, and a full disk."""

from __future__ import annotations

import json
import logging
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from batches import SECOND, UTC_0, add_rows, completion
from commands import Run
from gateways import POLL, Served, gateway_of, plant_text, running, served, written
from lines import until
from tables import table

from multidrop import BusError, Drive, Plant, PlantError, PlantLine, PolledDrive, WriteForbidden, reading
from multidrop.cli.serve import blind_spots
from multidrop.core import Columns, Field, Names, NumberFormat, RowLayout
from multidrop.drive import can_show_fault
from multidrop.errors import Advice
from multidrop.families import MODELS
from multidrop.families.erman_er_g_220 import ErmanFault
from multidrop.gateway.commands import in_words
from multidrop.gateway.http.rights import Right
from multidrop.gateway.live.alarm_file import AlarmFile, alarm_in
from multidrop.gateway.live.alarms import Alarm, Alarms, Limit, Limits
from multidrop.gateway.live.hub import RAN_NS, Hub, Shown
from multidrop.gateway.settings import read_settings
from multidrop.polling.batch import Batch

ERMAN = '["status", "output_frequency", "last_fault"]'
REGISTERS = ("status", "output_frequency", "last_fault", "fault_record_1")
NOT_AT_REST = "at rest its state needs two readings in a row, which polled values do not give"
RUNNING, STOPPED = 1, 0  # values of the ERMAN status register


def hub_of(folder: Path, model: str, poll: str) -> Hub:
    text = plant_text("/dev/ttyUSB0", ["pump-1"]).replace("invt-che", model)
    text = text.replace("38400", str(MODELS[model].baudrates[0]))
    start = text.index("poll = ")
    path = folder / f"{model}.toml"
    path.write_text(f"{text[:start]}poll = {poll}\n")
    return Hub(Plant.load(path), lambda: (now_ns[0], 0))


now_ns = [0]  # present time of the clock that the Hub reads, in ns


def take(hub: Hub, at_s: float, **values: int) -> None:
    """Set the clock to `at_s`, and give the hub a successful read of each register in `values`."""
    columns = Columns(len(values))
    for name, value in values.items():
        layout = RowLayout(0, [Field(0, NumberFormat.U16, REGISTERS.index(name), 1.0, 1.0)])
        assert add_rows(columns, layout, completion(round(at_s * SECOND), words=(value,)), UTC_0)
    now_ns[0] = round(at_s * SECOND)
    hub.take(Batch(columns, Names(("pump-1",)), Names(REGISTERS)))


def test_a_change_of_the_fault_record_is_shown_as_a_fault(tmp_path: Path) -> None:
    hub = hub_of(tmp_path, "erman-er-g-220", ERMAN)
    take(hub, 10, status=RUNNING, output_frequency=500, last_fault=0)
    assert hub.seen("pump-1").state == "runs"
    take(hub, 11, last_fault=ErmanFault.OVERHEAT | 1 << 8)
    # the fault is shown although the older status and frequency belong to a running motor
    assert hub.seen("pump-1") == Shown("fault", "overheat, bit 8")
    take(hub, 12, status=STOPPED, output_frequency=0, last_fault=ErmanFault.OVERHEAT | 1 << 8)
    assert hub.seen("pump-1")[:2] == ("fault", "overheat, bit 8")
    for at_s in (20, 20 + RAN_NS / SECOND):
        take(hub, at_s, status=RUNNING, output_frequency=500, last_fault=ErmanFault.OVERHEAT | 1 << 8)
    assert hub.seen("pump-1").state == "runs"
    take(hub, 30, status=STOPPED, output_frequency=0, last_fault=ErmanFault.OVERHEAT | 1 << 8)
    assert hub.seen("pump-1").state == "stands"


def test_a_recorded_fault_is_no_longer_shown_after_a_reset(tmp_path: Path) -> None:
    hub = hub_of(tmp_path, "erman-er-g-220", ERMAN)
    take(hub, 10, status=STOPPED, output_frequency=0, last_fault=ErmanFault.OVERHEAT)
    past = "last fault overheat, which may still be in force"
    assert hub.seen("pump-1") == Shown("stands", None, past)
    take(hub, 11, status=STOPPED, last_fault=ErmanFault.LOW_DC_VOLTAGE)
    assert hub.seen("pump-1").fault == "low DC voltage"
    hub.note_reset("pump-1")
    assert hub.seen("pump-1").state == "stands"
    take(hub, 12, status=STOPPED, last_fault=ErmanFault.OVERHEAT)
    assert hub.seen("pump-1").state == "fault"
    take(hub, 13, status=STOPPED, last_fault=0)
    assert hub.seen("pump-1").state == "stands"


def test_a_new_fault_record_of_a_yd1000_is_shown_as_a_fault(tmp_path: Path) -> None:
    hub = hub_of(tmp_path, "yd1000", '["output_frequency", "status", "fault_record_1"]')
    take(hub, 10, output_frequency=0, status=0, fault_record_1=1)
    shown = hub.seen("pump-1")
    assert (shown.state, shown.note) == ("unknown", NOT_AT_REST)
    take(hub, 12, output_frequency=0, fault_record_1=18)
    assert hub.seen("pump-1").fault == "fault record 1: 18"


def test_a_reason_is_shown_if_the_state_of_a_drive_is_unknown(tmp_path: Path) -> None:
    hub = hub_of(tmp_path, "erman-er-g-220", '["status", "output_frequency"]')
    take(hub, 10, output_frequency=0, status=STOPPED)
    assert hub.seen("pump-1") == Shown("unknown", None, "last_fault is not polled")


@table(
    ("model", "polled", "is_seen"),
    [
        ("erman-er-g-220", ("status", "output_frequency"), False),
        ("erman-er-g-220", ("status", "last_fault"), True),
        ("yd1000", ("output_frequency", "status"), False),
        ("yd1000", ("output_frequency", "fault_record_1"), True),
        ("invt-che", ("output_frequency",), False),
        ("invt-che", ("status",), True),
        ("innovert-ibd", ("terminals",), False),
        ("innovert-ibd", ("terminals", "output_m01", "output_m02", "output_yabc", "output_virtual"), True),
        ("delixi-modbus", ("output_frequency",), False),
        ("delixi-native", ("status",), True),
    ],
)
def test_faults_can_be_shown_only_if_suitable_registers_are_polled(
    model: str, polled: tuple[str, ...], is_seen: bool
) -> None:
    assert can_show_fault(MODELS[model](1), polled) is is_seen


def test_the_command_serve_check_warns_if_no_polled_register_can_show_a_fault(
    run: Run, tmp_path: Path
) -> None:
    plant = written(tmp_path, "[serve]\n")
    status, _, errors = run("serve", "--check", plant.path)
    assert (status, errors) == (0, "")
    plant.path.write_text(plant.path.read_text().replace(POLL, '["output_frequency"]', 1))
    status, _, errors = run("serve", "--check", plant.path)
    advice = "no polled register can show a fault: poll status or fault too"
    assert (status, errors.count("\n")) == (0, 1)
    assert f"pump-1: {advice}" in errors


def test_the_missing_fault_register_of_a_meter_causes_no_warning() -> None:
    class Meter(Drive):
        has_motor = False
        voltage = reading(0, "V", step=1)

    meter = PolledDrive(Meter(1))
    assert blind_spots(Plant([PlantLine("hall", "/dev/a", drives=[meter])])) == []


RUNS, STANDS = Shown("runs", None), Shown("stands", None)


def seen(events: Alarms) -> list[tuple[str, str, int, int | None]]:
    return [(one.drive or one.line, one.kind, one.time, one.ended) for one in events.between(0, 10**9)]


@pytest.mark.parametrize("standing", [STANDS, Shown("unknown", None)])
def test_an_alarm_is_raised_if_a_motor_stops_without_a_command(standing: Shown) -> None:
    events = Alarms()
    for time, shown in ((1000, standing), (2000, RUNS), (3000, standing), (4999, standing)):
        events.look(time, "pump-1", shown, 0)
    assert seen(events) == []  # no alarm yet: the motor may only be changing its direction
    events.look(5000, "pump-1", standing, 0)
    assert seen(events) == [("pump-1", "stopped", 3000, None)]
    events.look(6000, "pump-1", RUNS, 0)
    told = [("pump-1", "stopped", 3000, 6000)]
    assert seen(events) == told
    # stops = 1: a stop was called
    for time, shown, stops in ((7000, standing, 1), (9000, standing, 1), (10000, RUNS, 1)):
        events.look(time, "pump-1", shown, stops)
    # stops = None: a jog or setpoint 0 may have ended the run
    for time, stops in ((11000, None), (13000, 1)):
        events.look(time, "pump-1", standing, stops)
    assert seen(events) == told


def test_no_stop_alarm_is_raised_if_a_fault_stopped_the_motor() -> None:
    events = Alarms()
    for time, shown in enumerate((RUNS, Shown("silent", "no reply"), Shown("fault", "a"), STANDS), 1):
        events.look(time, "pump-1", shown, 0)
    assert {kind for _, kind, _, _ in seen(events)} == {"fault", "silent"}


def test_alarms_are_sorted_by_kind_with_acknowledged_alarms_last() -> None:
    events = Alarms()
    events.look(1, "pump-1", Shown("fault", "overheat"))
    events.look(2, "pump-2", RUNS, 0)
    events.look(3, "pump-2", STANDS, 0)
    events.look(2003, "pump-2", STANDS, 0)
    events.look_at_line(4, "hall", "there is no such port")
    events.look(5, "pump-3", Shown("silent", "no reply"))
    # no alarm for pump-4: the lost port of its line has one
    events.look(6, "pump-4", Shown("silent", "port lost"))
    assert [one.kind for one in events.shown()] == ["fault", "stopped", "port", "silent"]
    first = events.acknowledge(events.shown()[0].id, 7, "anna by page", "fan is dirty")
    assert (first.acknowledged, first.by, first.note) == (7, "anna by page", "fan is dirty")
    assert [one.kind for one in events.shown()] == ["stopped", "port", "silent", "fault"]
    stopped = events.acknowledge(events.shown()[0].id, 8, "anna by page")
    # an alarm of the kind "stopped" ends when it is acknowledged
    assert ("pump-2", "stopped", 3, 8) in seen(events)
    with pytest.raises(KeyError):
        events.acknowledge("1 fault pump-9", 9, "anna")
    events.acknowledge(stopped.id, 10, "boris", "the switch")
    assert next(one for one in events.between(0, 99) if one.kind == "stopped").by == "boris"
    events.look_at_line(11, "hall", None)
    assert ("hall", "port", 4, 11) in seen(events)


def test_alarms_at_the_gateway_start_are_marked_as_possibly_older() -> None:
    events = Alarms()
    events.look(1, "pump-1", Shown("fault", "overheat"))
    events.look(1, "pump-2", RUNS)
    events.look(2, "pump-2", Shown("fault", "overheat"))
    events.look_at_line(3, "hall", "port lost")
    events.note_there("roof")
    events.look_at_line(3, "roof", "port lost")
    assert {one.drive or one.line: one.is_before for one in events.lasting} == {
        "pump-1": True, "pump-2": False, "hall": True, "roof": False,
    }  # fmt: skip


def test_alarms_continue_after_a_restart_if_the_fault_is_still_shown() -> None:
    kept: dict[str, Alarm] = {}
    before = Alarms(0, lambda alarm, change: kept.update({alarm.id: alarm}))
    for drive in ("goes-on", "is-over", "is-another", "is-gone", "is-silent"):
        before.look(1, drive, RUNS, 0)
        before.look(2, drive, Shown("fault", "overheat"))
    before.acknowledge(before.shown()[0].id, 3, "anna", "seen")
    events = Alarms(100)
    events.restore(kept.values(), 101, ["goes-on", "is-over", "is-another", "is-silent"])
    events.look(102, "goes-on", Shown("fault", "overheat"))
    events.look(102, "is-over", STANDS)
    events.look(102, "is-another", Shown("fault", "overcurrent"))
    events.look(102, "is-silent", Shown("silent", "no reply"))
    found = {(one.drive, one.text): (one.time, one.ended) for one in events.between(0, 999)}
    assert found == {
        ("goes-on", "overheat"): (2, None),
        ("is-over", "overheat"): (2, 102),
        ("is-another", "overheat"): (2, 102),
        ("is-another", "overcurrent"): (102, None),
        ("is-gone", "overheat"): (2, 101),
        ("is-silent", "overheat"): (2, None),
        ("is-silent", "no reply"): (102, None),
    }
    assert events.since == 2
    assert [one.note for one in events.between(0, 999) if one.by] == ["seen"]


def test_alarms_from_before_a_restart_are_merged_with_alarms_raised_meanwhile() -> None:
    """A slow disk may return the alarms from before a restart after new alarms were raised."""
    events = Alarms(100)
    events.look(101, "pump-1", Shown("fault", "overheat"))
    events.look(101, "pump-2", STANDS)
    kept = [Alarm(2, name, "overheat", None, "fault") for name in ("pump-1", "pump-2")]
    events.restore(kept, 102, ["pump-1", "pump-2"])
    assert seen(events) == [("pump-1", "fault", 2, None), ("pump-2", "fault", 2, 102)]


ALARM = Alarm(1, "pump-1", "overheat", None, "fault", "", False, 2, "anna", "a note")


def started(path: Path) -> AlarmFile:
    """Return an alarm file with its thread started."""
    kept = AlarmFile(path)
    threading.Thread(target=kept.run, daemon=True).start()
    return kept


def past_of(path: Path) -> list[Alarm]:
    kept = started(path)
    until(lambda: kept.past is not None)
    kept.close()
    return kept.past or []


def test_the_last_line_in_the_alarm_file_gives_the_state_of_an_alarm(tmp_path: Path) -> None:
    path = tmp_path / "alarms.jsonl"
    kept = started(path)
    for alarm in (ALARM, ALARM._replace(ended=5), ALARM._replace(time=9)):
        kept.note(alarm)
    kept.close()
    with path.open("ab") as file:
        file.write(b'{"id": "trunc')
    assert past_of(path) == [ALARM._replace(ended=5), ALARM._replace(time=9)]
    kept = started(path)
    kept.note(ALARM._replace(time=10))  # this line follows the truncated line
    kept.close()
    assert len(past_of(path)) == 3


@table("change", [{"time": "1"}, {"time": True}, {"ended": 1.5}, {"kind": "x"}, {"drive": None}, {"note": 1}])
def test_invalid_lines_of_the_alarm_file_are_ignored(change: Mapping[str, object]) -> None:
    whole = json.loads(json.dumps(ALARM.as_json()))
    assert alarm_in(json.dumps(whole).encode()) == ALARM
    assert alarm_in(json.dumps(whole | change).encode()) is None
    for line in (b"", b"[]", b"{}", b"\xff", b"[" * 100_000):
        assert alarm_in(line) is None


def test_a_long_alarm_file_is_rewritten(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("multidrop.gateway.live.alarm_file.MOST_BYTES", 2000)
    path = tmp_path / "alarms.jsonl"
    kept = started(path)
    for _ in range(100):
        kept.note(ALARM)
        until(kept._waiting.empty)
    kept.close()
    assert path.stat().st_size < 3000
    assert past_of(path) == [ALARM]


def test_the_alarm_file_is_rewritten_after_a_failing_disk_recovers(tmp_path: Path) -> None:
    folder = tmp_path / "none"
    kept = started(folder / "alarms.jsonl")
    kept.note(ALARM)
    until(lambda: "No such file" in kept.trouble)
    folder.mkdir()
    kept.note(ALARM._replace(time=9))
    until(lambda: not kept.trouble)
    kept.close()
    assert past_of(folder / "alarms.jsonl") == [ALARM, ALARM._replace(time=9)]


def faults(gateway: Served) -> list[Any]:
    """Return the alarms of kind "fault" only: on a busy machine, drives may also be silent for a moment."""
    return [one for one in gateway.frame()["alarms"] if one["kind"] == "fault"]


def test_acknowledged_alarms_survive_a_restart(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "multidrop.gateway")
    words = "overcurrent while accelerating (OC1)"
    with served(tmp_path) as gateway:
        gateway.await_state("pump-1", "stands")
        gateway.sims["pump-1"].trip(4)  # type: ignore[attr-defined]
        until(lambda: [(one["drive"], one["text"]) for one in faults(gateway)] == [("pump-1", words)])
        [alarm] = faults(gateway)
        assert alarm["is_before"] is False
        assert gateway.frame()["drives"]["pump-1"]["fault"] == words
        stopper = {"authorization": gateway.bearer(Right.STOP)}
        body = {"alarm": alarm["id"], "note": "belt stuck"}
        assert gateway.post("/api/acknowledge", body).status == 401
        assert gateway.post("/api/acknowledge", body | {"note": "a\x1b[0m"}, **stopper).status == 400
        assert gateway.post("/api/acknowledge", {"alarm": "1 fault x"}, **stopper).status == 404
        told = gateway.post("/api/acknowledge", body, **stopper).json
        assert (told["note"], told["by"].split()[0]) == ("belt stuck", "stopper")
    assert f"alarm of pump-1: fault: {words}" in caplog.messages
    assert any(
        text.startswith(f"alarm of pump-1, {words}, acknowledged by stopper") for text in caplog.messages
    )
    with served(tmp_path) as gateway:  # restart with a new simulated pump-1, which has no fault
        until(lambda: [one for one in faults(gateway) if one["ended"]])
        [again] = faults(gateway)
        kept = ("id", "time", "text", "by", "note", "acknowledged")
        assert {key: again[key] for key in kept} == {key: told[key] for key in kept}
    assert f"alarm of pump-1 is over: fault: {words}" in caplog.messages


def test_an_unwritable_alarm_file_is_reported_in_health(tmp_path: Path) -> None:
    (tmp_path / "alarms.jsonl").mkdir()
    with served(tmp_path) as gateway:
        until(lambda: "alarms are not kept" in gateway.get("/health").json["parts"].get("alarms", ""))
        gateway.await_state("pump-1", "stands")
        assert any("alarms are not kept" in one for one in gateway.frame()["troubles"])


@pytest.mark.long
def test_a_lost_port_raises_one_alarm_for_its_line(tmp_path: Path) -> None:
    (tmp_path / "plant.toml").write_text(plant_text(str(tmp_path / "none"), ["pump-1", "pump-2"]))
    gateway = gateway_of(tmp_path / "plant.toml")
    with running(gateway):
        page = Served(gateway, {}, {})
        page.await_state("pump-1", "silent")
        page.await_state("pump-2", "silent")
        until(lambda: "port" in [one["kind"] for one in page.frame()["alarms"]])
        [alarm] = page.frame()["alarms"]
        assert (alarm["line"], alarm["drive"], alarm["kind"], alarm["is_before"]) == (
            "hall",
            "",
            "port",
            True,
        )
        assert "there is no such port" in alarm["text"]


@pytest.mark.slow
def test_a_motor_stopped_by_the_gateway_raises_no_alarm(tmp_path: Path) -> None:
    serve = '[serve.may]\nstop = "anyone"\nwrite = ["pump-1.setpoint"]\nverbs = ["pump-1.start"]\n'
    with served(tmp_path, serve) as gateway:
        gateway.start("pump-1")
        gateway.await_state("pump-1", "runs")
        assert gateway.post("/api/stop", {"drives": ["pump-1"]}).json["pump-1"]["done"] is True
        gateway.await_state("pump-1", "stands")
        assert "stopped" not in [one["kind"] for one in gateway.frame()["alarms"]]
        assert gateway.act("pump-1", "start")["done"] is True
        gateway.await_state("pump-1", "runs")
        gateway.sims["pump-1"].motor.stop()  # type: ignore[attr-defined]
        until(lambda: "stopped" in [one["kind"] for one in gateway.frame()["alarms"]])


@table(
    ("failure", "said"),
    [
        (
            WriteForbidden("pump-1 has a fault: then call reset_fault()", advice=Advice.call("reset_fault")),
            'pump-1 has a fault: then use "reset fault"',
        ),
        (
            WriteForbidden("x: declare confirmed = 1", advice=Advice.declare("confirmed", 1)),
            "x: write confirmed = 1 below its [[line.drive]]",
        ),
        (WriteForbidden("call set_frequency before start"), 'use "set frequency" before start'),
        (BusError("it needs reset_fault() to start"), 'it needs "reset fault" to start'),
        (BusError("pump-1.coast: no stop of start"), "pump-1.coast: no stop of start"),
    ],
)
def test_error_texts_on_the_web_page_contain_no_function_names(failure: BusError, said: str) -> None:
    assert in_words(str(failure), failure) == said


# ---- limits of values: duration, hysteresis, missing values, mistakes in the plant file ----


ABOVE = Limit("pump", "current", "A", True, 30.0, lasting_s=5.0, hysteresis=2.0)
BELOW = Limit("pump", "pressure", "bar", False, 1.0, hysteresis=0.5)


@table(
    ("values", "beyond"),
    [
        ([31, 31, 31, 31, 31, 31], [False, False, False, False, False, True]),
        ([31, 31, 29, 31, 31, 31], [False] * 6),  # 29 is within the limit, so the duration restarts
        ([31, 31, 31, 31, 31, 31, 28.5, 28.0], [False] * 5 + [True, True, False]),
        ([31, 31, 31, 31, None, 31, 31], [False] * 7),  # a missing value restarts the duration
        ([31, 31, 31, 31, 31, 31, None, 29], [False] * 5 + [True] * 3),
        ([30] * 7, [False] * 7),  # equal to the limit is not above it
    ],
)
def test_an_alarm_limit_has_a_duration_and_a_hysteresis(
    values: list[float | None], beyond: list[bool]
) -> None:
    limits, text, seen = Limits([ABOVE]), "", []
    for second, value in enumerate(values):
        text = limits.exceeded(second, "pump", {} if value is None else {"current": value}, text)
        seen.append(text == "current above 30 A")
    assert seen == beyond


def test_a_new_alarm_is_raised_if_a_second_limit_is_exceeded() -> None:
    limits = Limits([ABOVE._replace(lasting_s=0.0), BELOW])
    noted: list[Alarm] = []
    alarms = Alarms(note=lambda alarm, change: noted.append(alarm))
    for time, current, pressure in ((1, 31, 2), (2, 31, 0.5), (3, 20, 1.4), (4, 20, 1.5)):
        values = {"current": current, "pressure": pressure}
        alarms.look_at_limits(time, "pump", lambda before, v=values: limits.exceeded(0, "pump", v, before))
    assert [(one.time, one.text, one.ended) for one in noted] == [
        (1, "current above 30 A", None),
        (1, "current above 30 A", 2),
        (2, "current above 30 A; pressure below 1 bar", None),
        (2, "pressure below 1 bar", None),
        (2, "pressure below 1 bar", 4),
    ]


def test_an_alarm_limit_stays_exceeded_after_a_restart() -> None:
    assert Limits([ABOVE]).exceeded(0, "pump", {"current": 29}, "current above 30 A")


@table(
    ("limit", "sentence"),
    [
        ('register = "fault"\nabove = 1', "'drive' is missing"),
        ('drive = "pump-1"\nregister = "setpoint"\nabove = 1', "pump-1.setpoint is not polled"),
        ('drive = "pump-1"\nregister = "fault"', "give either key 'above' or key 'below'"),
        (
            'drive = "pump-1"\nregister = "fault"\nabove = 1\nbelow = 0',
            "give either key 'above' or key 'below'",
        ),
        ('drive = "pump-1"\nregister = "fault"\nabove = nan', "must be finite"),
        ('drive = "pump-1"\nregister = "fault"\nabove = 1\nhysteresis = -1', "hysteresis 0 or more"),
        ('drive = "pump-1"\nregister = "fault"\nabove = 1\nfor = "5"', "is not a duration"),
    ],
)
def test_an_invalid_alarm_limit_is_refused(tmp_path: Path, limit: str, sentence: str) -> None:
    path = tmp_path / "plant.toml"
    path.write_text(plant_text("/dev/ttyUSB0", ["pump-1"]) + f"\n[[serve.limit]]\n{limit}\n")
    with pytest.raises(PlantError, match=f"limit number 1: .*{sentence}"):
        read_settings(Plant.load(path), {})


def test_alarms_are_raised_and_found_although_the_clock_is_set_back() -> None:
    """The clock is set back by 1000 s while a motor stands, and again while the alarm is active."""
    events = Alarms()
    for time, shown in ((2_000_000, RUNS), (2_001_000, STANDS), (1_002_000, STANDS), (1_004_000, STANDS)):
        events.look(time, "pump-1", shown, 0)
    events.look(5_000, "pump-1", RUNS, 0)
    [alarm] = events.between(1_000_000, 1_100_000)
    assert (alarm.kind, alarm.time, alarm.ended) == ("stopped", 1_002_000, 5_000)
