"""Channels that are computed from polled rows: totals, outages, statuses, and totals after a restart."""

from __future__ import annotations

import json
import math
import random
from collections.abc import Iterable
from dataclasses import replace

import pytest
from tables import table

from multidrop.channels import OLD, Channel, ChannelSet, DriveSeries, SlotRow
from multidrop.core import Status

S = 10**9
UTC = 1_700_000_000 * S
HOLD_S = 1.0


def channels(*declared: Channel, **units: str) -> ChannelSet:
    """Return the channels of a drive "pump"; `units` are the units of its polled registers."""
    polled = {name: (unit, HOLD_S) for name, unit in units.items()}
    made = ChannelSet([DriveSeries("pump", polled, polled, declared)])
    assert made.mistakes == []
    return made


def row(slot: int, at_s: float, value: float | None, status: int = Status.NO_REPLY) -> SlotRow:
    ns = round(at_s * S)
    return SlotRow(slot, UTC + ns, ns, 1000, value or 0.0, Status.OK if value is not None else status)


def last_value(made: ChannelSet, rows: Iterable[SlotRow]) -> float:
    return [one.value for one in made.compute(rows) if one.status == Status.OK][-1]


def missing(share: float, seed: int = 1) -> random.Random:
    return random.Random(f"{share} {seed}")


ENERGY = Channel("energy", "integral(power)", "kWh")


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in range(1, 10))])
def test_energy_total_is_accurate_with_5_percent_of_values_missing(seed: int) -> None:
    """The power is 2 + sin(t / 7 s) kW for 10 minutes, read about every 100 ms."""
    random_, made = missing(0.05, seed), channels(ENERGY, power="kW")
    rows, missed = [], 0
    for at in range(6001):
        at_s = at / 10 + random_.uniform(0, 0.02)
        is_missed = 0 < at < 6000 and random_.random() < 0.05
        missed += is_missed
        rows.append(row(0, at_s, None if is_missed else 2 + math.sin(at_s / 7)))
    begin_s, end_s = rows[0].monotonic_ns / S, rows[-1].monotonic_ns / S
    exact = sum(sign * (2 * t - 7 * math.cos(t / 7)) for sign, t in ((1, end_s), (-1, begin_s))) / 3600
    assert missed > 230
    assert last_value(made, rows) == pytest.approx(exact, rel=1e-3)
    assert made.outages == []


@table("flow_unit, unit, total", [("m3/h", "m3", 0.5), ("m3/h", "l", 500.0), ("l/min", "m3", 0.03)])
def test_the_volume_is_the_integral_of_a_flow(flow_unit: str, unit: str, total: float) -> None:
    """A pump at 25 Hz delivers 5 of the flow's unit for 6 minutes, after a table of its curve."""
    flow = Channel("flow", f'table(frequency, "{flow_unit}", 0, 0, 50, 10)', flow_unit)
    made = channels(flow, Channel("volume", "integral(flow)", unit), frequency="Hz")
    found = made.compute([row(0, at / 2, 25.0) for at in range(721)])
    assert [one.value for one in found if one.slot == 2][-1] == pytest.approx(total)


def test_outage_adds_nothing_to_a_computed_total() -> None:
    made = channels(ENERGY, power="kW")
    assert last_value(made, [row(0, at, 3600.0) for at in (0.0, 1.0)]) == 1.0
    silent = made.compute([row(0, at, None) for at in (2.0, 3.0, 4.0)])
    assert [one.status for one in silent] == [Status.NO_REPLY] * 3
    assert last_value(made, [row(0, at, 3600.0) for at in (5.0, 6.0)]) == 2.0
    assert list(map(str, made.outages)) == ["pump.energy: 4 s without values are not counted"]
    assert made.outages[0].end_ns == UTC + 5 * S
    weekend = made.outages[0]._replace(seconds=216_000.4)
    assert str(weekend) == "pump.energy: 216000 s without values are not counted"


def test_total_continues_after_a_short_gap_without_an_outage() -> None:
    made = channels(ENERGY, power="kW")
    rows = [row(0, 0.0, 3600.0), row(0, 0.5, None), row(0, 1.0, 7200.0)]
    assert last_value(made, rows) == 1.5
    assert made.outages == []


@table(
    ("misses", "status", "known_until_s"),
    [([], OLD, 30), ([row(1, 10.0, None)], Status.NO_REPLY, 10)],
    ids=["without rows", "with a miss"],
)
@table("value", ["integral(power + pump-2.power)", "integral(both)"])
def test_total_has_an_outage_while_another_drives_value_is_too_old(
    value: str, misses: list[SlotRow], status: int, known_until_s: int
) -> None:
    """Each of two drives has a power of 1800 kW, and values are valid for 30 s. One is silent for 40 s."""
    declared = Channel("both", "power + pump-2.power", "kW"), Channel("energy", value, "kWh")
    first = DriveSeries("pump", {"power": ("kW", HOLD_S)}, ["power"], declared)
    made = ChannelSet([first, DriveSeries("pump-2", {"power": ("kW", 30.0)}, ["power"], [])])
    own = [row(0, at / 2, 1800.0) for at in range(80)]
    found = made.compute(sorted([row(1, 0.0, 1800.0), *own, *misses], key=lambda one: one.monotonic_ns))
    assert {one.status for one in found if one.monotonic_ns > known_until_s * S} == {status}
    after = [row(1, 40.0, 1800.0), *(row(0, at / 2, 1800.0) for at in range(80, 85))]
    assert last_value(made, after) == known_until_s + 2
    (outage,) = made.outages
    assert outage.seconds == 40 - known_until_s


def test_the_run_hours_and_the_number_of_starts_are_computed() -> None:
    declared = Channel("hours", "integral(frequency > 0)", "h"), Channel("starts", "count(frequency > 0)")
    made = channels(*declared, frequency="Hz")
    # the motor turns from the beginning, which does not count as a start
    speeds = [50, 50, 0, 0, 50, 0, 50, 50]
    found = made.compute([row(0, at, float(hz)) for at, hz in enumerate(speeds)])
    assert [one.value for one in found if one.slot == 2] == [0, 0, 0, 0, 1, 1, 2, 2]
    assert found[-2].value == pytest.approx((1 + 0.5 + 0.5 + 0.5 + 0.5 + 1) / 3600)


def test_derivative_has_no_value_directly_after_an_outage() -> None:
    made = channels(Channel("slope", "derivative(frequency)", "Hz/s"), frequency="Hz")
    found = made.compute([row(0, 0.0, 10.0), row(0, 0.5, 15.0), row(0, 5.0, 0.0), row(0, 5.5, 1.0)])
    shown = [(one.value, one.status) for one in found]
    assert shown == [(0.0, Status.NO_VALUE), (10.0, 0), (0.0, Status.NO_VALUE), (2.0, 0)]


def test_computed_row_has_the_status_of_the_missing_value() -> None:
    made = channels(Channel("power", "voltage * current", "W"), voltage="V", current="A")
    assert made.compute([row(0, 1.0, 400.0)]) == []  # the register with the current has no value yet
    (first,) = made.compute([row(0, 2.0, 400.0), row(1, 2.0, 2.0)])  # one request
    assert first == SlotRow(2, UTC + 2 * S, 2 * S, 1000, 800.0, Status.OK)
    (second,) = made.compute([row(1, 3.0, None, Status.BAD_CHECKSUM)])
    assert (second.status, second.monotonic_ns) == (Status.BAD_CHECKSUM, 3 * S)
    found = made.compute([row(0, 4.0, None), row(1, 5.0, 2.0)])
    assert [one.status for one in found] == [Status.NO_REPLY, Status.NO_REPLY]


def test_rows_with_the_same_time_each_give_a_computed_row() -> None:
    made = channels(Channel("double", "2 * current", "A"), current="A")
    found = made.compute([row(0, 1.0, None), row(0, 1.0, None), row(0, 1.0, 3.0)])
    assert [one.status for one in found] == [Status.NO_REPLY, Status.NO_REPLY, Status.OK]


def test_an_expression_may_use_a_channel_that_was_declared_earlier() -> None:
    made = channels(
        Channel("power", "u * i", "kW"), Channel("energy", "integral(power)", "kWh"), u="V", i="A"
    )
    rows = [row(slot, at, value) for at in (0.0, 1.0) for slot, value in ((0, 1000.0), (1, 3600.0))]
    found = made.compute(rows)
    assert [(one.slot, one.value) for one in found] == [(2, 3600.0), (3, 0.0), (2, 3600.0), (3, 1.0)]


def test_computed_totals_are_exact_after_a_restart() -> None:
    declared = ENERGY, Channel("starts", "count(power > 1)")
    values = [row(0, at / 7, 3 * random.Random(at).random()) for at in range(1000)]
    whole, first = channels(*declared, power="kW"), channels(*declared, power="kW")
    whole.compute(values)
    first.compute(values[:500])
    second = channels(*declared, power="kW")
    assert second.restore(json.loads(json.dumps(first.totals()))) == []
    assert second.totals() == first.totals()
    # the monotonic clock starts again, as after a reboot
    later = [one._replace(monotonic_ns=one.monotonic_ns - 100 * S) for one in values[499:]]
    second.compute(later[1:])
    assert second.totals()["pump.starts"]["totals"][0] == whole.totals()["pump.starts"]["totals"][0]
    assert str(second.outages[0]) == "pump.energy: 0.143 s without values are not counted"


def test_a_reload_of_the_plant_continues_totals_without_an_outage() -> None:
    values = [row(0, at / 7, 3 * random.Random(at).random()) for at in range(100)]
    whole, first, second = (channels(ENERGY, power="kW") for _ in range(3))
    whole.compute(values)
    first.compute(values[:50])
    second.restore(first.totals())
    second.take_over(first)
    second.compute(values[50:])
    assert second.totals() == whole.totals()
    assert second.outages == []


def test_an_integral_skips_the_time_while_a_drive_is_replaced() -> None:
    ratio = Channel("ratio", "power / 2", "kW")
    energy, change = (
        Channel("energy", "integral(ratio)", "kW*s"),
        Channel("change", "derivative(ratio)", "kW/s"),
    )
    first, second = (channels(ratio, energy, change, power="kW") for _ in range(2))
    first.compute([row(0, 0.0, 2.0), row(0, 0.5, 2.0)])
    second.take_over(first, {"pump"})
    energies = [one for one in second.compute([row(0, 1.0, 100.0), row(0, 1.5, 100.0)]) if one.slot == 2]
    assert [one.value for one in energies] == [0.5, 25.5]
    changes = [one for one in second.compute([row(0, 2.0, 100.0)]) if one.slot == 3]
    assert [one.value for one in changes] == [0.0]
    assert list(map(str, second.outages)) == ["pump.energy: 0.5 s without values are not counted"]


def test_total_starts_at_zero_if_the_saved_total_does_not_fit() -> None:
    before = channels(ENERGY, power="kW")
    before.compute([row(0, at, 3600.0) for at in (0.0, 1.0)])
    good = before.totals()["pump.energy"]
    for wrong in (
        {"value": "integral(power + 1)"},
        {"units": ["W*s"]},
        {"totals": [["1"]]},
        {"totals": [[math.nan]]},
        {"totals": 3},
    ):
        made = channels(ENERGY, power="kW")
        assert made.restore({"pump.energy": good | wrong}) == ["pump.energy"]
        assert made.totals()["pump.energy"]["totals"] == [[0.0]]
    assert channels(ENERGY, power="kW").restore({"pump.energy": 3}) == ["pump.energy"]


@table("time_ns", [1 << 63, 10**400, None, "1"], ids=["late", "huge", "none", "text"])
def test_a_saved_total_with_an_invalid_time_is_restored(time_ns: object) -> None:
    made = channels(ENERGY, power="kW")
    kept = {"value": ENERGY.value, "units": ["kW*s"], "totals": [[7200.0]], "time_ns": time_ns}
    assert made.restore({"pump.energy": kept}) == []
    assert last_value(made, [row(0, 0.0, 1.0)]) == 2.0


def test_total_declared_as_not_kept_is_not_restored() -> None:
    kept, other = channels(ENERGY, power="kW"), channels(replace(ENERGY, is_kept=False), power="kW")
    for made in (kept, other):
        made.compute([row(0, at, 3600.0) for at in (0.0, 1.0)])
    assert other.totals() == {}
    assert other.restore(kept.totals()) == []
    assert last_value(other, [row(0, 2.0, 0.0)]) == 1.5


def test_consecutive_outages_of_a_total_are_reported_as_one() -> None:
    made = channels(Channel("both", "integral(a) + b", "A*s"), a="A", b="A*s")
    made.compute([row(0, 0.0, 1.0), row(1, 0.5, 1.0), row(1, 1.0, None), row(0, 5.0, 1.0)])
    made.compute([row(0, 10.0, 1.0), row(1, 10.5, 1.0), row(0, 10.6, 1.0)])
    assert list(map(str, made.outages)) == ["pump.both: 10 s without values are not counted"]


def test_an_infinite_value_does_not_destroy_a_computed_total() -> None:
    made = channels(ENERGY, power="kW")
    rows = [row(0, 0.0, 3600.0), row(0, 1.0, 3600.0), row(0, 1.5, math.inf), row(0, 2.0, 3600.0)]
    assert last_value(made, rows) == pytest.approx(2)


@table(
    ("name", "sentence"),
    [
        ("power", "pump already has a register or channel 'power'; give the channel another name"),
        ("a b", "'a b' is not a valid channel name; use letters, digits and _"),
        ("x" * 101, "a channel's name and its unit have at most 100 characters each"),
    ],
)
def test_an_invalid_name_of_a_computed_channel_is_reported(name: str, sentence: str) -> None:
    made = ChannelSet(
        [DriveSeries("pump", {"power": ("kW", 1.0)}, {"power"}, [Channel(name, "power", "kW")])]
    )
    assert [mistake.sentence for mistake in made.mistakes] == [sentence]
    assert not made


def test_the_number_of_computed_channels_is_limited() -> None:
    many = [Channel(f"c{number}", "power", "kW") for number in range(1001)]
    made = ChannelSet([DriveSeries("pump", {"power": ("kW", 1.0)}, {"power"}, many)])
    assert [str(mistake) for mistake in made.mistakes] == [
        'drive "pump", channel "c1000": a plant has at most 1000 channels'
    ]


def awake(one: SlotRow, slept_s: float) -> SlotRow:
    """Return a row from after a sleep of the computer, in which the monotonic clock stood still."""
    return one._replace(time_ns=one.time_ns + round(slept_s * S))


@pytest.mark.parametrize("batches", [1, 2])
def test_a_sleep_of_the_computer_is_an_outage(batches: int) -> None:
    """It sleeps for an hour at 1.25 s. One batch has all rows, or the sleep is between two batches."""
    change, total = Channel("change", "derivative(power)", "kW/s"), Channel("both", "power + other", "kW")
    made = channels(ENERGY, change, total, power="kW", other="kW")
    before = [row(1, 0.0, 1.0), row(0, 0.0, 3600.0), row(0, 1.0, 3600.0)]
    after = [awake(row(0, at, 7200.0), 3600) for at in (1.5, 2.0)] + [awake(row(1, 2.0, 2.0), 3600)]
    found = made.compute(before[:2], 50 * S)
    found += made.compute(before[2:] + (after if batches == 1 else []), 3650 * S)
    found += made.compute(after if batches == 2 else [], 3650 * S)
    energy, changes, sums = ([one for one in found if one.slot == slot] for slot in (2, 3, 4))
    assert [one.value for one in energy if one.status == 0] == [0.0, 1.0, 1.0, 2.0]
    assert list(map(str, made.outages)) == ["pump.energy: 3600 s without values are not counted"]
    # the first value after the sleep has no derivative
    assert [(one.monotonic_ns / S, one.value) for one in changes if one.status == 0] == [
        (1.0, 0.0),
        (2.0, 0.0),
    ]
    # the sum is OLD after the sleep until the register `other` is read again
    assert [(one.status, one.value) for one in sums][-2:] == [(OLD, 0.0), (0, 7202.0)]


def test_a_clock_change_is_no_outage() -> None:
    made = channels(ENERGY, power="kW")
    made.compute([row(0, 0.0, 3600.0)], 50 * S)
    assert last_value(made, [awake(row(0, 1.0, 3600.0), 3600)]) == 1.0
    assert made.outages == []
