"""Limits of values: duration, hysteresis, missing values, mistakes in the plant file."""

from __future__ import annotations

from pathlib import Path

import pytest
from gateways import plant_text
from tables import table

from multidrop import Plant, PlantError
from multidrop.gateway.live.alarms import Alarm, Alarms
from multidrop.gateway.live.limits import Limit, Limits
from multidrop.gateway.settings import read_settings

ABOVE = Limit("pump", "current", "A", True, 30.0, lasting_s=5.0, hysteresis=2.0)
BELOW = Limit("pump", "pressure", "bar", False, 1.0, hysteresis=0.5)


@table(
    ("values", "beyond"),
    [
        ([31, 31, 31, 31, 31, 31], [False, False, False, False, False, True]),
        ([31, 31, 29, 31, 31, 31], [False] * 6),  # the time restarts
        ([31, 31, 31, 31, 31, 31, 28.5, 28.0], [False] * 5 + [True, True, False]),
        ([31, 31, 31, 31, None, 31, 31], [False] * 7),  # unknown: the time starts anew
        ([31, 31, 31, 31, 31, 31, None, 29], [False] * 5 + [True] * 3),
        ([30] * 7, [False] * 7),  # the bound itself is allowed
    ],
)
def test_limit_is_exceeded_after_its_duration_and_until_its_hysteresis(
    values: list[float | None], beyond: list[bool]
) -> None:
    limits, text, seen = Limits([ABOVE]), "", []
    for second, value in enumerate(values):
        text = limits.exceeded(second, "pump", {} if value is None else {"current": value}, text)
        seen.append(text == "current above 30 A")
    assert seen == beyond


def test_further_exceeded_limit_begins_a_new_alarm_and_a_smaller_excess_does_not() -> None:
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


def test_limit_stays_exceeded_over_a_restart() -> None:
    assert Limits([ABOVE]).exceeded(0, "pump", {"current": 29}, "current above 30 A")


@table(
    ("limit", "sentence"),
    [
        ('register = "fault"\nabove = 1', "'drive' is missing"),
        ('drive = "pump-1"\nregister = "setpoint"\nabove = 1', "pump-1.setpoint is not polled"),
        ('drive = "pump-1"\nregister = "fault"', "give either above or below"),
        ('drive = "pump-1"\nregister = "fault"\nabove = 1\nbelow = 0', "give either above or below"),
        ('drive = "pump-1"\nregister = "fault"\nabove = nan', "must be finite"),
        ('drive = "pump-1"\nregister = "fault"\nabove = 1\nhysteresis = -1', "not below 0"),
        ('drive = "pump-1"\nregister = "fault"\nabove = 1\nfor = "5"', "is not a duration"),
    ],
)
def test_wrong_limit_is_refused(tmp_path: Path, limit: str, sentence: str) -> None:
    path = tmp_path / "plant.toml"
    path.write_text(plant_text("/dev/ttyUSB0", ["pump-1"]) + f"\n[[serve.limit]]\n{limit}\n")
    with pytest.raises(PlantError, match=f"limit number 1: .*{sentence}"):
        read_settings(Plant.load(path), {})
