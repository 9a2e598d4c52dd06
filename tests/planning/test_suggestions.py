"""The gain of readable gaps: suggested for a class that declares none, and never for a built-in family."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from meter import ADDRESSES, Meter, StatedMeter

from multidrop.cli import main
from multidrop.drive import Drive
from multidrop.drive.register import HOLDING, INPUT, reading
from multidrop.families import MODELS
from multidrop.families.files.loader import load_family
from multidrop.families.registry import SHIPPED
from multidrop.planning.suggestions import reading_gain

SUPPORT = Path(__file__).parents[1] / "support" / "drives"
PLANT = f"""
[[line]]
name = "hall"
port = "/dev/ttyUSB0"

[[line.drive]]
name = "meter-1"
model = '{SUPPORT / "meter.py"}:Meter'
address = 1
baudrate = 9600
format = "8N1"

[[line.drive]]
name = "pump-1"
model = "innovert-ibd"
address = 2
baudrate = 9600
format = "8N1"
"""
SENTENCE = (
    "4 requests with readable_gaps = {INPUT: range(0x36, 0x46)} instead of 8: 0.268 s instead of 0.341 s; "
    "state them if the document allows reading there"
)


def test_readable_gaps_would_save_a_fifth_of_the_meters_reading_time() -> None:
    drive = Meter(1, baudrate=9600, format="8N1")
    gain = reading_gain(drive, [(drive.register(name), None) for name in ADDRESSES])
    assert gain is not None
    assert str(gain) == SENTENCE
    assert drive.readable_gaps == Meter.readable_gaps == {}
    stated = type("Told", (Meter,), {"__doc__": "As advised.", "readable_gaps": dict(gain.gaps)})
    told = stated(1, baudrate=9600, format="8N1")
    assert reading_gain(told, [(told.register(name), None) for name in ADDRESSES]) is None


def test_the_suggestion_for_a_family_file_uses_its_notation(tmp_path: Path) -> None:
    source = (
        "[family]\ntitle = 'Meter'\nmanual = 'of this test'\ncounts_from = 0\n[reading]\n"
        "low = { at = 1, unit = 'V' }\nhigh = { at = 3, unit = 'V' }\n"
    )
    path = tmp_path / "meter.toml"
    path.write_text(source, "utf-8")
    gains = []
    for line in ("counts_from = 0", "counts_from = 0\ngaps = { holding = [0x2, 0x2] }"):
        path.write_text(source.replace("counts_from = 0", line), "utf-8")
        drive = load_family(path)(1)
        gains.append(reading_gain(drive, [(register, None) for register in drive.readings()]))
    assert str(gains[0]).startswith("1 request with gaps = { holding = [0x2, 0x2] } instead of 2: ")
    assert gains[1] is None


def test_gaps_are_not_suggested_if_declared_or_useless() -> None:
    class Compact(Drive):
        a = reading(1)
        b = reading(2)
        far = reading(2000)

    for drive in (StatedMeter(1), Compact(1)):
        assert reading_gain(drive, [(register, None) for register in drive.readings()]) is None


def test_a_stated_limit_bounds_the_gain_of_readable_gaps() -> None:
    class Limited(Drive):
        most_registers = {HOLDING: 3}
        a = reading(1)
        b = reading(3)
        c = reading(5)

    gain = reading_gain(Limited(1), [(register, None) for register in Limited.registers.values()])
    assert gain is not None
    assert (gain.requests, gain.requests_now) == (2, 3)
    assert [len(gap) for _, gap in gain.gaps] == [1]


def test_plan_and_models_suggest_gaps_only_for_a_users_own_class(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plant = tmp_path / "hall.toml"
    plant.write_text(PLANT, "utf-8")
    main(["plan", str(plant), "--json"])
    warnings = json.loads(capsys.readouterr().out)["lines"]["hall"]["warnings"]
    assert len(warnings) == 1
    assert warnings[0].startswith(
        "meter-1: 5 requests with readable_gaps = {INPUT: range(0x36, 0x46)} instead of 9"
    )
    main(["models", f"{SUPPORT / 'meter.py'}:Meter"])
    told = " ".join(capsys.readouterr().out.split())
    assert "reading all readings in 5 requests with readable_gaps" in told
    assert "read 04H, at most 125, the standard's limit: the family states none" in told
    for model in (*MODELS, *SHIPPED):
        main(["models", model])
        told = " ".join(capsys.readouterr().out.split())
        assert "readable_gaps" not in told
        assert "the family states none" not in told or model in SHIPPED  # some document no limit


def test_plan_and_models_show_a_familys_groups_and_interval(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = (
        "from multidrop import Drive, reading\n"
        "class Own(Drive):\n"
        "    least_interval = 0.1\n"
        "    read_together = (('high', 'low'),)\n"
        "    high = reading(1)\n"
        "    low = reading(2)\n"
    )
    (tmp_path / "own.py").write_text(source, "utf-8")
    main(["models", f"{tmp_path / 'own.py'}:Own"])
    told = capsys.readouterr().out
    assert "interval        100 ms from the end of an exchange to the next request" in told
    assert "read together   high, low" in told
    main(["models", f"{tmp_path / 'own.py'}:Own", "--json"])
    facts = json.loads(capsys.readouterr().out)
    assert (facts["least_interval_s"], facts["read_together"]) == (0.1, [["high", "low"]])
    assert facts["read_limits"] == {"holding register": 125}
    assert INPUT.name not in facts["read_limits"]
