"""The hub keeps the newest row of each register. It computes the drives' states, and alarms from these."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from batches import SECOND, UTC_0, add_miss, add_rows, completion
from gateways import written
from hypothesis import given
from hypothesis import strategies as st
from lines import line, plant, polled
from tables import table

from multidrop import Drive, Plant, PolledDrive, reading, setting
from multidrop.core import Columns, Field, Names, NumberFormat, RowLayout, Status
from multidrop.families import MODELS, DelixiModbus, InvtCHE
from multidrop.gateway.live.alarms import Alarms
from multidrop.gateway.live.frames import frame_of, lost_of
from multidrop.gateway.live.hub import (
    INCOMPLETE,
    LEAST_SLEEP_NS,
    NOT_ASKED,
    Hub,
    KeptRow,
    Known,
    Shown,
    published_values,
)
from multidrop.gateway.live.recent_statistics import RecentStatistics
from multidrop.gateway.live.views import describe_line
from multidrop.gateway.metrics import OTHER, base_unit, plant_families
from multidrop.gateway.modbus_server import words as modbus_words
from multidrop.gateway.modbus_server.words import NO_NUMBER, CommonBlock
from multidrop.polling.batch import Batch

REGISTERS = ("status", "output_frequency", "output_current", "fault")
STATUS, FREQUENCY, CURRENT, FAULT = range(4)
FORWARD, STANDBY, TRIPPED = 1, 3, 4
PERIOD = SECOND // 10
DRIVES = ("pump-1", "pump-2", "pump-9")


class HubClock:
    """A clock that a test sets: the monotonic time and the time the machine has slept, both in ns."""

    def __init__(self) -> None:
        self.now_ns = 10 * PERIOD
        self.slept_ns = 0

    def __call__(self) -> tuple[int, int]:
        return self.now_ns, self.slept_ns


@pytest.fixture
def clock() -> HubClock:
    return HubClock()


@pytest.fixture
def hub(tmp_path: Path, clock: HubClock) -> Hub:
    return Hub(written(tmp_path), clock)


def rows(*found: tuple[int, int, int | Status], drive: str = "pump-1", utc_0: int = UTC_0) -> Batch:
    """Return rows of a drive, given as (time in periods, register, raw count or status of a failed read)."""
    columns = Columns(len(found))
    for at, register, said in found:
        layout = RowLayout(DRIVES.index(drive), [Field(0, NumberFormat.U16, register, 1.0, 1.0)])
        if isinstance(said, Status):
            assert add_miss(columns, layout, said, at * PERIOD, utc_0)
        else:
            assert add_rows(columns, layout, completion(at * PERIOD, words=(said,)), utc_0)
    return Batch(columns, Names(DRIVES), Names(REGISTERS))


def all_of(at: int, status: int, frequency: int = 0, fault: int = 0) -> Batch:
    return rows((at, STATUS, status), (at, FREQUENCY, frequency), (at, CURRENT, 0), (at, FAULT, fault))


def is_fresh(hub: Hub) -> bool:
    """Return True if the last good frequency of pump-1 is still current, even if a later read has failed."""
    return next(current for one, _, _, current in hub.known("pump-1") if one.name == "output_frequency")


def test_values_of_registers_are_unknown_before_their_first_request(hub: Hub) -> None:
    assert hub.newest("pump-1", "status") is None
    assert {good for _, _, good, _ in hub.known("pump-1")} == {None}
    assert hub.state("pump-1") == "unknown"
    assert hub.last_answer("pump-1") is None
    assert hub.newest("pump-9", "status") is None
    assert hub.state("pump-9") == "unknown"


def test_the_time_of_the_newest_row_goes_back_with_the_clock(hub: Hub) -> None:
    hub.take(rows((10, FREQUENCY, 25)))
    assert hub.time == UTC_0 + 10 * PERIOD
    hub.take(rows((11, FREQUENCY, 25), utc_0=UTC_0 - 3600 * SECOND))
    assert hub.time == UTC_0 - 3600 * SECOND + 11 * PERIOD
    hub.take(rows((9, CURRENT, 25)))  # a slower exchange, which was requested earlier
    assert hub.time == UTC_0 - 3600 * SECOND + 11 * PERIOD


def test_a_failed_read_does_not_replace_the_last_good_value(hub: Hub) -> None:
    hub.take(rows((10, FREQUENCY, 25), (11, FREQUENCY, Status.NO_REPLY)))
    sent, missed = 10 * PERIOD, 11 * PERIOD
    good = next(good for one, _, good, _ in hub.known("pump-1") if one.name == "output_frequency")
    assert good == (UTC_0 + sent, sent, 25.0, 0)
    newest = hub.newest("pump-1", "output_frequency")
    assert newest is not None
    assert (*newest[:2], hub.status(newest[3])) == (UTC_0 + missed, missed, "no reply")
    assert hub.fresh("pump-1", "output_frequency") is None
    assert is_fresh(hub)


@pytest.mark.parametrize(
    ("status", "frequency", "state"),
    [(FORWARD, 25, "runs"), (FORWARD, 0, "runs"), (STANDBY, 0, "stands"), (2, 25, "runs"), (9, 0, "unknown")],
)
def test_the_status_register_determines_the_state_of_a_drive(
    hub: Hub, status: int, frequency: int, state: str
) -> None:
    hub.take(all_of(10, status, frequency))
    assert hub.state("pump-1") == state
    assert hub.seen("pump-1").fault is None


def test_a_fault_is_shown_with_the_text_of_the_drives_family(hub: Hub) -> None:
    hub.take(all_of(10, TRIPPED, fault=4))
    assert hub.state("pump-1") == "fault"
    assert hub.seen("pump-1").fault == "overcurrent while accelerating (OC1)"
    assert hub.seen("pump-1").why_silent is None
    assert hub.state("pump-2") == "unknown"


def test_the_status_register_alone_can_show_a_fault(hub: Hub) -> None:
    hub.take(rows((10, STATUS, TRIPPED), (10, FREQUENCY, 0)))
    assert hub.seen("pump-1") == Shown("fault", "it shows a fault")
    hub.take(rows((11, FAULT, 4)))
    assert hub.seen("pump-1").fault == "overcurrent while accelerating (OC1)"


def test_a_drive_is_silent_after_many_lost_replies_but_not_after_one(hub: Hub, clock: HubClock) -> None:
    hub.take(all_of(10, FORWARD, 25))
    for at in range(11, 20):
        hub.take(rows(*((at, register, Status.NO_REPLY) for register in range(4))))
        clock.now_ns = at * PERIOD
        assert hub.state("pump-1") == "runs", at
    hub.take(rows(*((21, register, Status.NO_REPLY) for register in range(4))))
    hub.take(rows(*((22, register, Status.NOT_ASKED) for register in range(4))))
    clock.now_ns = 22 * PERIOD
    assert hub.seen("pump-1") == Shown("silent", "no reply")
    assert hub.seen("pump-1").why_silent == "no reply"
    assert hub.seen("pump-1").fault is None
    assert hub.last_answer("pump-1")[:2] == (UTC_0 + 10 * PERIOD, 10 * PERIOD)
    hub.take(all_of(23, STANDBY))
    assert hub.state("pump-1") == "stands"


def test_a_drive_is_not_silent_if_the_replies_are_exceptions(hub: Hub) -> None:
    columns = Columns(4)
    for register in range(4):
        layout = RowLayout(0, [Field(0, NumberFormat.U16, register, 1.0, 1.0)])
        assert add_rows(columns, layout, completion(SECOND, exception=6), UTC_0)
    hub.take(Batch(columns, Names(DRIVES), Names(REGISTERS)))
    assert hub.state("pump-1") == "unknown"


def test_a_port_counts_as_lost_if_all_newest_rows_say_line_lost(hub: Hub, clock: HubClock) -> None:
    hub.take(all_of(10, FORWARD, 25))
    assert lost_of(hub, "hall") is None
    hub.take(rows(*((30, register, Status.LINE_LOST) for register in range(3))))
    assert lost_of(hub, "hall") is None
    hub.take(rows((31, FAULT, Status.LINE_LOST)))
    assert lost_of(hub, "hall") == "port lost"
    hub.stalled["hall"] = "/dev/ttyUSB0: stalled"
    assert lost_of(hub, "hall") == "/dev/ttyUSB0: stalled"
    clock.now_ns = 31 * PERIOD
    assert hub.seen("pump-1") == Shown("silent", "port lost")


def test_a_fresh_value_is_neither_old_nor_requested_before_a_command(hub: Hub, clock: HubClock) -> None:
    hub.take(rows((10, FREQUENCY, 25)))
    sent_ns = 10 * PERIOD
    row = (UTC_0 + sent_ns, sent_ns, 25.0, 0)
    assert hub.fresh("pump-1", "output_frequency", sent_ns) == row
    assert hub.fresh("pump-1", "output_frequency", sent_ns + 1) is None
    clock.now_ns = sent_ns + SECOND
    assert hub.fresh("pump-1", "output_frequency") == row
    clock.now_ns += 1
    assert hub.fresh("pump-1", "output_frequency") is None
    assert hub.fresh("pump-1", "status") is hub.fresh("pump-9", "status") is None


def test_values_become_stale_if_no_new_rows_arrive(hub: Hub, clock: HubClock) -> None:
    """The event loop does not run, as in a suspended process."""
    hub.take(all_of(10, FORWARD, 25))
    clock.now_ns += SECOND
    assert is_fresh(hub)
    assert hub.state("pump-1") == "runs"
    clock.now_ns += 1
    assert not is_fresh(hub)
    assert hub.seen("pump-1") == Shown("unknown", NOT_ASKED)


def test_values_are_stale_if_the_computer_slept_since_they_were_read(hub: Hub, clock: HubClock) -> None:
    """The monotonic clock stops while the machine sleeps, so the rows' ages do not include the sleep."""
    hub.take(all_of(10, FORWARD, 25))
    assert hub.state("pump-1") == "runs"
    # the hub has not read its clock since the sleep
    clock.now_ns, clock.slept_ns = 11 * PERIOD + 1, 8 * 3600 * SECOND
    assert not is_fresh(hub)
    assert hub.fresh("pump-1", "output_frequency") is None
    assert hub.seen("pump-1") == Shown("unknown", NOT_ASKED)
    assert not any(fresh for *_, fresh in hub.known("pump-1"))
    hub.take(all_of(11, FORWARD, 25))  # requested before the sleep and received after it
    assert not is_fresh(hub)
    clock.now_ns = 12 * PERIOD
    hub.take(all_of(12, FORWARD, 25))
    assert is_fresh(hub)
    assert hub.state("pump-1") == "runs"


def test_values_are_fresh_if_the_computer_slept_before_the_start(tmp_path: Path) -> None:
    hub = Hub(written(tmp_path), lambda: (20 * PERIOD, 8 * 3600 * SECOND))
    hub.take(all_of(19, FORWARD, 25))
    assert is_fresh(hub)
    assert hub.woke_ns() == 0


def test_a_small_difference_between_two_clocks_does_not_count_as_sleep(tmp_path: Path) -> None:
    slept = [0]
    hub = Hub(written(tmp_path), lambda: (20 * PERIOD, slept[0]))
    hub.take(all_of(19, FORWARD, 25))
    for slept[0] in (-SECOND, 0, -PERIOD, LEAST_SLEEP_NS):
        assert is_fresh(hub)


def test_values_of_a_slowly_polled_register_stay_fresh_longer(tmp_path: Path, clock: HubClock) -> None:
    path = written(tmp_path).path
    path.write_text(path.read_text().replace("100 ms", "10 s"))
    hub = Hub(Plant.load(path), clock)
    hub.take(all_of(10, FORWARD, 25))
    clock.now_ns = (10 + 300) * PERIOD
    assert is_fresh(hub)
    clock.now_ns += 1
    assert not is_fresh(hub)


@pytest.mark.slow
def test_values_of_an_overloaded_line_stay_fresh_for_three_cycles(tmp_path: Path, clock: HubClock) -> None:
    path = written(tmp_path, "", *(f"pump-{n}" for n in range(1, 31))).path
    path.write_text(path.read_text().replace("baudrate = 38400", "baudrate = 1200"))
    hub = Hub(Plant.load(path), clock)
    cycle_s = hub.plant.metadata()["planned"]["hall"]["cycle_ms"] / 1000
    assert cycle_s > 1  # longer than the 0.1 s in the plant file
    hub.take(all_of(10, FORWARD, 25))
    holds_s = hub.holds_s("pump-1", "output_frequency")
    assert holds_s == pytest.approx(3 * cycle_s)
    assert is_fresh(hub)
    clock.now_ns += round(holds_s * SECOND) + 1
    assert not is_fresh(hub)


def test_the_last_minute_of_values_has_one_point_per_second(hub: Hub) -> None:
    assert hub.last_minute() == {}
    for at in range(0, 1000, 5):  # time in units of 100 ms, so 100 s in all
        hub.take(rows((at, FREQUENCY, Status.NO_REPLY if at == 990 else at)))
        hub.note_minute()
    points = hub.last_minute()["pump-1"]["output_frequency"]
    assert len(points) == 60
    assert [after - before for (before, _), (after, _) in pairwise(points)] == [1000] * 59
    assert points[-1] == (points[0][0] + 59_000, None)
    assert points[-2][1] == 980.0


def test_rows_of_a_removed_drive_are_ignored(hub: Hub) -> None:
    hub.take(rows((10, STATUS, FORWARD), drive="pump-9"))
    assert "pump-9" not in list(hub.drives)


def test_a_reload_keeps_the_values_of_unchanged_drives(hub: Hub) -> None:
    hub.take(all_of(10, FORWARD, 25))
    hub.adopt(hub.plant)
    assert hub.state("pump-1") == "runs"


def test_a_late_row_of_a_replaced_drive_is_ignored(tmp_path: Path) -> None:
    now = [0]
    hub = Hub(written(tmp_path, "", "pump-1", "pump-2"), lambda: (now[0], 0))
    now[0] = 20 * PERIOD
    hub.adopt(written(tmp_path, "", "pump-2", "pump-1"))  # the two drives swap their addresses
    hub.take(all_of(19, FORWARD, 25))
    assert hub.newest("pump-1", "output_frequency") is None
    hub.take(all_of(21, STANDBY))
    hub.take(rows((19, STATUS, FORWARD)))
    assert hub.state("pump-1") == "stands"


SHOWN = st.sampled_from(
    [
        Shown("runs", None),
        Shown("fault", "a"),
        Shown("fault", "b"),
        Shown("silent", "x"),
        Shown("unknown", None),
        Shown("unknown", NOT_ASKED),
        Shown("unknown", INCOMPLETE),
    ]
)


@given(st.lists(SHOWN, max_size=30))
def test_each_alarm_starts_and_ends_once(shown: list[Shown]) -> None:
    """For random sequences of states, the alarms equal those of a simple reference implementation."""
    events = Alarms()
    fault: str | None = None
    silent = False
    for time, one in enumerate(shown):
        events.look(time, "pump-1", one)
        if one.state == "silent":
            silent = True
        elif one.words != NOT_ASKED:
            silent = False
            if one.words != INCOMPLETE:
                fault = one.words if one.state == "fault" else None
        lasting = {alarm.text for alarm in events.lasting}
        assert lasting == ({fault} - {None}) | ({"x"} if silent else set())
    found = events.between(0, len(shown))
    assert [alarm.time for alarm in found] == sorted((alarm.time for alarm in found), reverse=True)
    assert all(alarm.ended is None or alarm.ended > alarm.time for alarm in found)
    assert len([alarm for alarm in found if alarm.ended is None]) == len(events.lasting)


@pytest.mark.parametrize(("status", "is_over"), [(STANDBY, True), (9, True), (TRIPPED, False)])
def test_a_fault_alarm_continues_while_the_status_is_unknown(
    hub: Hub, clock: HubClock, status: int, is_over: bool
) -> None:
    """A busy line may read other registers but not the status for a second. The fault may still be active."""
    events = Alarms()

    def look() -> list[tuple[int, int | None]]:
        events.look(clock.now_ns // PERIOD, "pump-1", hub.seen("pump-1"))
        return [(one.time, one.ended) for one in events.between(0, 999)]

    hub.take(all_of(10, TRIPPED, fault=4))
    assert look() == [(10, None)]
    clock.now_ns = 30 * PERIOD
    hub.take(rows((30, STATUS, Status.NO_REPLY), (30, FREQUENCY, 0), (30, CURRENT, 0), (30, FAULT, 4)))
    assert hub.seen("pump-1") == Shown("unknown", INCOMPLETE, "status is not known")
    assert look() == [(10, None)]
    clock.now_ns = 31 * PERIOD
    hub.take(all_of(31, status, fault=4))
    assert look() == [(10, 31 if is_over else None)]


def test_no_second_alarm_is_raised_when_the_name_of_a_fault_becomes_known() -> None:
    events = Alarms()
    for time, words in enumerate(("it shows a fault", "overcurrent", "it shows a fault"), 1):
        events.look(time, "pump-1", Shown("fault", words))
    assert [(one.time, one.text, one.ended) for one in events.shown()] == [(1, "overcurrent", None)]


def test_the_number_of_ended_alarms_in_memory_is_limited() -> None:
    events = Alarms(since=7)
    for time in range(4000):
        events.look(time, "pump-1", Shown("fault", "a") if time % 2 else Shown("runs", None))
        assert time > 100 or events.since == 7
    assert len(events.between(0, 9999)) <= 1001
    oldest = events.between(0, 9999)[-1]
    assert events.since == oldest.time - 1  # all alarms after this time are kept
    assert events.begun == 2000
    assert len(events.shown()) <= 21


def test_the_web_page_gets_null_for_overdue_or_failed_values(hub: Hub, clock: HubClock) -> None:
    hub.take(rows((10, FREQUENCY, 25), (10, CURRENT, 12), (11, CURRENT, Status.NO_REPLY)))
    for now, frequency, current in (
        (12, [25.0], [None, "no reply", 12.0]),  # a failed read is shown immediately
        (25, [None, "overdue", 25.0], [None, "no reply", 12.0]),
    ):
        clock.now_ns = now * PERIOD
        frame = frame_of(
            hub, Alarms(), RecentStatistics(hub.plant), {}, n=1, revision=1, time_ns=UTC_0 + clock.now_ns
        )
        told = frame["drives"]["pump-1"]["values"]
        assert [*told["output_frequency"][:1], *told["output_frequency"][2:4]] == frequency
        assert [*told["output_current"][:1], *told["output_current"][2:4]] == current
        assert told["fault"] == (None, told["fault"][1], "not asked yet")
        said = {"status": None, "output_frequency": frequency[0], "output_current": None, "fault": None}
        assert published_values(hub, "pump-1") == said  # the values that MQTT publishes


def test_the_age_of_a_value_is_correct_after_a_clock_change_or_sleep(hub: Hub, clock: HubClock) -> None:
    """If the age were too small, the last value of a silent drive would look new."""
    hub.take(rows((10, FREQUENCY, 25), (20, FREQUENCY, Status.NO_REPLY)))
    asked_ns = UTC_0 + 10 * PERIOD
    hour_ns = 3600 * SECOND
    for told, utc_ns, now_ns, age_ms in (
        ("as it is", asked_ns + 50 * PERIOD, 60 * PERIOD, 5_000),
        ("UTC was set back", asked_ns - hour_ns, 60 * PERIOD, 5_000),
        ("the machine slept", asked_ns + hour_ns, 60 * PERIOD, 3_600_000),
    ):
        clock.now_ns = now_ns
        recent = RecentStatistics(hub.plant)
        frame = frame_of(hub, Alarms(), recent, {}, n=1, revision=1, time_ns=utc_ns)
        pump = frame["drives"]["pump-1"]
        now, missed, status, last, then = pump["values"]["output_frequency"]
        assert (now, status, last) == (None, "no reply", 25.0), told
        assert pump["ages_ms"][then] == pump["ages_ms"][pump["seen"]] == age_ms, told
        assert pump["ages_ms"][missed] == age_ms - 1_000, told


# ---- registers whose documents state no scale: raw counts are never reported in amperes, volts or hertz ----


COMMON = (modbus_words.FREQUENCY, modbus_words.CURRENT, modbus_words.SETPOINT)


class FullHub(Hub):
    """A hub in which every polled register has a fresh value of 25."""

    def fresh(self, drive: str, register: str, since_ns: int = 0) -> KeptRow | None:
        return 1, 1, 25.0, 0

    def known(self, drive: str) -> Iterator[Known]:
        for register, *_ in super().known(drive):
            yield register, (1, 1, 25.0, 0), (1, 1, 25.0, 0), True


class Fan(Drive):
    """A user's own drive class. Its manual states a unit but no scale."""

    pressure = setting(1, "Pa", step=None, moves=False)


def described(*drives: PolledDrive) -> dict[str, Any]:
    hub = Hub(plant(line("/dev/null", *drives)))
    return describe_line(hub, hub.plant.lines[0], "en")


def number(words: list[int], at: int) -> int:
    return int.from_bytes(bytes([*divmod(words[at], 256), *divmod(words[at + 1], 256)]), "big", signed=True)


@table("model", MODELS)
def test_a_value_of_unknown_scale_has_the_unit_raw_count(model: str) -> None:
    drive = MODELS[model](1)
    for register in described(polled(drive, drive.readings()))["drives"][0]["registers"]:
        known = drive.registers[register["name"]]
        assert register["unit"] == ("raw count" if known.step is None else known.unit)
        if known.writable and known.values is None:  # the dialog on the web page needs a range
            assert register["least"] < register["most"], known.name
            known.encode(register["least"])
            known.encode(register["most"])
            assert (register["at_least"], register["at_most"]) == (known.at_least, known.at_most)


def test_common_modbus_registers_hide_values_of_unknown_scale() -> None:
    """The Modbus server has the same registers, such as the frequency in 0.01 Hz, for every drive."""
    delixi, che = DelixiModbus(1, name="fan"), InvtCHE(2, name="pump", maximum_frequency=50)
    names = ("output_frequency", "output_current")
    drives = [polled(drive, [drive.registers[name] for name in names]) for drive in (delixi, che)]
    hub = FullHub(plant(line("/dev/null", *drives)))
    (fan, pump) = (CommonBlock(each).words(hub) for each in drives)
    assert [number(fan, at) for at in COMMON] == [2500, NO_NUMBER, NO_NUMBER]
    assert [number(pump, at) for at in COMMON] == [2500, 2500, NO_NUMBER]


def test_the_prometheus_metric_for_values_of_unknown_scale_is_named_raw() -> None:
    drive = DelixiModbus(1, name="fan")
    hub = FullHub(plant(line("/dev/null", polled(drive, [drive.output_frequency, drive.output_current]))))
    found = {
        family.name: [labels["register"] for _, labels, _ in family.samples]
        for family in plant_families(hub, {})
        if family.name.startswith("multidrop_register_") and "age" not in family.name
    }
    assert found == {
        "multidrop_register_hertz": ["output_frequency"],
        "multidrop_register_raw": ["output_current"],
    }


def test_prometheus_metrics_are_in_base_units() -> None:
    registers = {
        register.value_unit: base_unit(register)
        for family in MODELS.values()
        for register in family.registers.values()
        if register.values is None
    }
    assert {unit for unit, base in registers.items() if base is OTHER} == set()
    assert (registers["V"], registers["%"]) == (("volts", 1.0), ("ratio", 0.01))
    assert base_unit(reading(0, "kW")) == ("watts", 1000.0)
    assert base_unit(reading(0, "m³/h")) is OTHER
    assert base_unit(InvtCHE(1).status).name == "code"


class Transmitter(Drive):
    """A user's own device class. Its registers have different numbers of decimals."""

    pressure = setting(1, "Pa", number_format=NumberFormat.F32, moves=False)
    level = setting(3, "m", step=0.01, moves=False)
    power = reading(4, "W", scale_register="power_scale")
    power_scale = reading(5, number_format=NumberFormat.I16)


def test_the_plant_description_gives_no_decimals_for_a_float_register() -> None:
    told = described(polled(Transmitter(1), Transmitter.readings()))
    registers = {each["name"]: each for each in told["drives"][0]["registers"]}
    assert [registers[name]["digits"] for name in ("pressure", "level", "power")] == [None, 2, None]
    assert [registers[name]["step"] for name in ("pressure", "level")] == [None, 0.01]


def test_a_reload_that_adds_drives_lets_values_stay_fresh_longer(clock: HubClock) -> None:
    """A reload adds drives to a line, and removes them. The first drive stays the same object."""
    first = polled(InvtCHE(1, name="pump-1"), [InvtCHE.output_frequency])
    others = [polled(InvtCHE(address), InvtCHE.readings()) for address in range(2, 20)]
    alone, crowded = plant(line("/dev/none", first)), plant(line("/dev/none", first, *others))
    hub = Hub(alone, clock)
    for one in (crowded, alone):
        hub.adopt(one)
        assert hub.holds_s("pump-1", "output_frequency") == Hub(one).holds_s("pump-1", "output_frequency")
    assert Hub(alone).holds_s("pump-1", "output_frequency") == 1.0
    assert (Hub(crowded).holds_s("pump-1", "output_frequency") or 0.0) > 2.0


def test_ages_in_prometheus_metrics_include_the_time_of_computer_sleep(
    hub: Hub, clock: HubClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    hub.take(rows((10, FREQUENCY, 25)))
    clock.now_ns, clock.slept_ns = 20 * PERIOD, 8 * 3600 * SECOND
    now_ns = UTC_0 + clock.now_ns + clock.slept_ns
    monkeypatch.setattr("multidrop.gateway.metrics.time.time_ns", lambda: now_ns)
    families = {family.name: family.samples for family in plant_families(hub, {})}
    [(_, labels, age_s)] = families["multidrop_register_age_seconds"]
    assert (labels["register"], age_s) == ("output_frequency", 8 * 3600 + 1.0)
