"""Test files: their steps, their planned times, and a sentence with its line for each mistake."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from simulated_pumps import CHE, write_test
from tables import table

from multidrop.families.registry import find_model
from multidrop.plant.model import Plant, PlantLine, Polled, PolledDrive
from multidrop.polling.batch import Row
from multidrop.runs import RunPlan, RunStep, load_test, loader
from multidrop.runs.checks import misfits, silence_of
from multidrop.runs.model import length, timeline
from multidrop.runs.watch import LimitWatch

EEPROM = {"model": "delixi-modbus", "framing": "rtu", "poll": ["output_frequency"]}


def test_each_list_and_repetition_in_a_test_file_becomes_planned_steps(tmp_path: Path) -> None:
    text = """
    [abort]
    limits = ["fan.output_current >= 30", "pump.fault != 0"]
    silence = "3 s"
    [[phase]]
    name = "cycle"
    repeat = 2
    [[phase.step]]
    frequency = { fan = [10, 20.0], pump = 15 }
    start = ["fan", "pump"]
    dwell = "4 s"
    [[phase.step]]
    frequency = { fan = 40.0 }
    rate = 2.0
    dwell = "1 s"
    [[phase]]
    name = "cool"
    [[phase.step]]
    stop = ["fan"]
    until = "fan.output_frequency < 0.5"
    within = "1 min"
    [[phase.step]]
    dwell = "10 s"
    """
    plan = load_test(write_test(tmp_path, text, fan=CHE, pump=CHE))
    planned = timeline(plan.steps)
    assert [(one.step.name, one.begin, one.seconds, one.is_latest) for one in planned] == [
        *[("cycle 1", 0, 4, False), ("cycle 2", 4, 4, False), ("cycle 3", 8, 11, False)],
        *[("cycle 1", 19, 4, False), ("cycle 2", 23, 4, False), ("cycle 3", 27, 11, False)],
        *[("cool 1", 38, 0, False), ("cool 2", 98, 10, True)],
    ]
    assert length(planned) == 108
    assert [dict(step.frequency) for step in plan.steps[:3]] == [
        {"fan": 10, "pump": 15},
        {"fan": 20, "pump": 15},
        {"fan": 40},
    ]
    assert [limit.number for limit in plan.limits.conditions] == [30, 0]
    assert plan.commanded == ("fan", "pump")


STEP = '[[phase]]\nname = "a"\n[[phase.step]]\n'  # lines 2 to 4 of a test file
MISTAKES = {  # text of a test file: number of the wrong line, part of the error
    "": (0, "'phase' is missing; add [[phase]], in two brackets"),
    "abort = 3\n" + STEP + 'dwell = "1 s"': (2, "abort = 3 is not right; write [abort], a table"),
    '[abort]\nlimits = ["fan.current > 3"]\n' + STEP + 'dwell = "1 s"': (3, "has no register 'current'"),
    '[abort]\nlimits = ["fan.output_voltage > 3"]\n' + STEP + 'dwell = "1 s"': (
        3,
        "is not polled: add it to",
    ),
    '[abort]\nlimits = ["fan.output_current is 3"]\n' + STEP + 'dwell = "1 s"': (
        3,
        "is not a condition such as",
    ),
    '[abort]\nlimits = ["fan.output_current > nan"]\n' + STEP + 'dwell = "1 s"': (
        3,
        "'nan' in 'fan.output_current > nan' is not a finite number",
    ),
    "[abort]\nlimits = [3]\n" + STEP + 'dwell = "1 s"': (3, "3 is not a text"),
    '[abort]\nsilence = "soon"\n' + STEP + 'dwell = "1 s"': (3, "silence = 'soon' is not a duration"),
    STEP: (4, "the step does nothing; add a command, or dwell"),
    STEP + "dwel = 3": (5, "unknown key 'dwel'; did you mean dwell?"),
    STEP + 'start = ["fen"]': (5, "has no drive 'fen'; did you mean fan?"),
    STEP + "start = [1]": (5, "start: 1 is not a text"),
    STEP + 'start = ["fan"]\ndirection = "left"': (
        6,
        'direction = \'left\' is neither "forward" nor "reverse"',
    ),
    STEP + 'dwell = "1 s"\ndirection = "forward"': (6, 'direction needs start; add start = ["pump-1"]'),
    STEP + "frequency = { fan = 51 }": (5, "51"),
    STEP + 'frequency = { fan = "x" }': (5, "'x' is not a number in Hz"),
    STEP + "frequency = { fan = [1, 2, 3], pump = [1, 2] }": (5, "must all have the same length"),
    STEP + "frequency = { fan = 20 }\nrate = 1": (6, "a ramp of fan needs a start"),
    STEP + "frequency = { fan = 20 }\nrate = -1": (6, "rate = -1 is not right"),
    STEP + "rate = 1": (5, "rate needs frequency; add frequency"),
    STEP + 'until = "fan.fault == 0"': (5, "until needs within; add within"),
    STEP + 'dwell = "1 s"\nwithin = "1 s"': (6, "within needs until; add until"),
    STEP + 'stop = ["fan"]\nfrequency = { fan = 20 }': (5, "fan is stopped and also commanded in this step"),
    STEP + "write = { fan = 3 }": (5, "write of fan: 3 is not right"),
    STEP + "write = { fan = { setpoint = 101 } }": (5, "setpoint"),
    STEP + "write = { fan = { control = 'forward' } }": (5, "which only verbs may do: use start()"),
    STEP + "frequency = { eeprom = 20 }": (5, "may be kept in EEPROM, which steps would wear out"),
    STEP + "write = { eeprom = { frequency = 20 } }": (5, 'declare ram = ["frequency"]'),
    STEP.replace('"a"', '"stop"') + 'dwell = "1 s"': (3, 'name "stop" is reserved for the stops at the end'),
    STEP + 'dwell = "1 s"\n' + STEP + 'dwell = "1 s"': (7, "another phase already has this name"),
    STEP.replace("\n[[", "\nrepeat = 0\n[[") + 'dwell = "1 s"': (4, "repeat = 0 is not right"),
    STEP.replace("\n[[", "\nrepeat = 99999\n[[") + 'dwell = "1 s"\n[[phase.step]]\ndwell = "1 s"': (
        2,
        "the phases have",
    ),
}


@table("text, line, sentence", [(text, *found) for text, found in MISTAKES.items()])
def test_each_mistake_in_a_test_file_is_reported_with_its_line(
    text: str, line: int, sentence: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("mistake")
    path = write_test(folder, text, fan=CHE, pump=CHE, eeprom=EEPROM)
    with pytest.raises(ValueError) as mistake:  # noqa: PT011 (the sentence is compared below)
        load_test(path)
    first = str(mistake.value).splitlines()[0]
    assert first.startswith(f"{path}:{line}: " if line else f"{path}: ")
    assert sentence in first


def test_mistakes_are_listed_by_line_without_consequential_errors(tmp_path: Path) -> None:
    text = (
        'abort.silence = "soon"\n[[phase]]\nname = "a"\n[[phase.step]]\ndwel = "1 s"\n'
        'frequncy = { fan = 1 }\nrate = 1\n[[phase.step]]\nstart = ["fen"]\n[[phase.step]]\n[aborted]\n'
    )
    with pytest.raises(ValueError) as mistakes:  # noqa: PT011 (the sentences are compared below)
        load_test(write_test(tmp_path, text, fan=CHE))
    found = [sentence.split(":", 2)[1:] for sentence in str(mistakes.value).splitlines()]
    assert [int(line) for line, _ in found] == [2, 6, 7, 10, 11, 12]
    for (_, sentence), part in zip(
        found, ["silence", "'dwel'", "'frequncy'", "'fen'", "does nothing", "'aborted'"], strict=True
    ):
        assert part in sentence


def test_a_plant_file_used_as_a_test_file_is_reported_with_advice(tmp_path: Path) -> None:
    plant = write_test(tmp_path, "").with_name("plant.toml")
    with pytest.raises(ValueError, match=r"plant\.toml: this is a plant file; poll .* `multidrop poll .*`"):
        load_test(plant)


def test_a_condition_may_compare_a_computed_channel(tmp_path: Path) -> None:
    path = write_test(tmp_path, STEP + 'until = "fan.double > 3"\nwithin = "1 s"')
    with (tmp_path / "plant.toml").open("a") as plant:
        plant.write('[[line.drive.channel]]\nname = "double"\nvalue = "output_current * 2"\nunit = "A"\n')
    (step,) = load_test(path).steps
    assert step.until
    assert (step.until.register, step.until.number) == ("double", 3.0)


def test_a_missing_plant_file_is_reported_with_the_line_that_names_it(tmp_path: Path) -> None:
    path = write_test(tmp_path, STEP + 'dwell = "1 s"', fan=CHE)
    (tmp_path / "plant.toml").unlink()
    with pytest.raises(ValueError, match=r'test\.toml:1: plant = "plant\.toml": there is no such file$'):
        load_test(path)


def test_a_plant_with_a_drive_named_test_is_refused(tmp_path: Path) -> None:
    path = write_test(tmp_path, '[[phase]]\nname = "a"\n[[phase.step]]\ndwell = "1 s"', test=CHE)
    with pytest.raises(ValueError, match=r'test.toml:1: the drive name "test" is reserved'):
        load_test(path)


@table(
    "line, keys, sentence",
    [
        (
            STEP + 'dwell = "50 ms"\nfrequency = { fan = 1 }',
            {},
            "a lasts 50 ms, less than 2 bus cycles of line hall",
        ),
        (STEP + "frequency = { fan = 1 }", {}, "it would fit with"),
        (
            STEP + 'dwell = "9 s"\nfrequency = { fan = 1 }',
            {"every": "5 ms"},
            "line hall does not reach its polling",
        ),
        (
            '[abort]\nsilence = "10 ms"\nlimits = ["fan.fault > 0"]\n' + STEP + 'dwell = "9 s"',
            {},
            "silence = 10 ms",
        ),
        (
            '[abort]\nsilence = "3 s"\nlimits = ["fan.fault > 0"]\n' + STEP + 'dwell = "9 s"',
            {"every": "2 s"},
            "4 s",
        ),
    ],
)
def test_a_test_file_too_fast_for_the_line_is_reported_with_a_correction(
    line: str, keys: dict[str, str], sentence: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    plan = load_test(write_test(tmp_path_factory.mktemp("misfit"), line, fan=CHE | keys))
    (found,) = misfits(plan)
    assert sentence in found
    assert "would fit with" in found


def test_the_default_silence_limit_exceeds_the_polling_period_of_faults() -> None:
    fan = find_model("invt-che")(1, maximum_frequency=50, name="fan")
    polled = PolledDrive(fan, ["output_frequency", Polled(fan.register("fault"), 2.0)])
    plant = Plant([PlantLine("hall", "nowhere", drives=[polled])])
    assert silence_of(RunPlan(plant, [RunStep("a", {"fan": 10.0}, dwell=9.0)])) == 6.0


def test_a_step_must_be_long_enough_for_all_its_writes(tmp_path: Path) -> None:
    plan = load_test(write_test(tmp_path, STEP + 'dwell = "400 ms"\nfrequency = { fan = 1 }', fan=CHE))
    assert misfits(plan) == []
    many = replace(plan.steps[0], write={"fan": dict.fromkeys(map(str, range(20)), 1)})
    (found,) = misfits(replace(plan, steps=(many,)))
    assert found.startswith("a lasts 400 ms, less than ")


@table("dwell, within", [(float("nan"), 0.0), (float("inf"), 0.0), (-1.0, 0.0), (0.0, float("nan"))])
def test_a_step_that_would_never_end_is_refused(dwell: float, within: float) -> None:
    with pytest.raises(ValueError, match="`dwell` and `within` must be finite times of 0 s or more"):
        RunStep("a", dwell=dwell, within=within)


def test_too_many_ramps_at_once_are_refused(tmp_path: Path) -> None:
    names = [f"fan-{number}" for number in range(12)]
    zero = ", ".join(f"{name} = 0" for name in names)
    text = (
        STEP
        + f'frequency = {{ {zero} }}\ndwell = "9 s"\n'
        + f'[[phase.step]]\nfrequency = {{ {zero} }}\nrate = 1\ndwell = "9 s"'
    )
    (found,) = misfits(load_test(write_test(tmp_path, text, **dict.fromkeys(names, CHE))))
    assert found.startswith("a 2 ramps 12 drives of line hall at once: it would fit with ")


def test_every_key_of_a_test_file_is_documented() -> None:
    page = (Path(__file__).parents[2] / "docs" / "reference" / "test-file.md").read_text("utf-8")
    keys = [key for table in (loader._TEST, loader._ABORT, loader._PHASE, loader._STEP) for key in table]
    assert [key for key in keys if f"\n| `{key}` | " not in page] == []


S = 10**9
TEXT = """
[abort]
limits = ["fan.output_current > 30"]
[[phase]]
name = "cool"
[[phase.step]]
until = "pump.output_frequency < 5"
within = "1 min"
"""


@pytest.fixture
def watch(tmp_path: Path) -> LimitWatch:
    return LimitWatch(load_test(write_test(tmp_path, TEXT, fan=CHE, pump=CHE, spare=CHE)), 2 * S, 0)


def row(drive: str, register: str, value: float | None, seconds: float = 1.0) -> Row:
    at = round(seconds * S)
    return Row(
        at,
        at,
        None if value is None else 0,
        drive,
        register,
        value,
        "ok" if value is not None else "no reply",
    )


def test_a_single_row_beyond_a_limit_aborts_the_run(watch: LimitWatch) -> None:
    assert watch.add([row("fan", "output_current", 30.0), row("pump", "output_current", 99.0)]) == ""
    assert watch.add([row("fan", "output_current", 30.1)]) == "fan.output_current > 30: it is 30.1 A"


def test_a_fault_aborts_only_if_the_test_uses_the_drive(watch: LimitWatch) -> None:
    assert watch.add([row("fan", "fault", 0.0), row("spare", "fault", 4.0)]) == ""
    assert watch.add([row("pump", "fault", 4.0)]).startswith("pump has a fault, ")


def test_only_a_new_fault_in_a_fault_record_aborts_a_run(tmp_path: Path) -> None:
    pump = {"model": "erman-er-g-220", "poll": ["output_frequency", "last_fault"]}
    watch = LimitWatch(load_test(write_test(tmp_path, TEXT, fan=CHE, pump=pump)), 2 * S, 0)
    assert watch.add([row("pump", "last_fault", 3.0), row("pump", "last_fault", 3.0)]) == ""
    assert watch.add([row("pump", "last_fault", None), row("pump", "last_fault", 0.0)]) == ""
    assert watch.add([row("pump", "last_fault", 4.0)]).startswith("pump had a fault, ")


def test_missing_values_of_a_drive_or_a_limited_register_are_reported(watch: LimitWatch) -> None:
    watch.add([row("fan", "fault", 0.0, 1.9), row("pump", "fault", 0.0, 1.9)])
    assert watch.silent(2 * S) == ""
    assert watch.silent(3 * S) == "no value of fan.output_current came for 3.0 s"
    watch.add([row("fan", "output_current", 1.0, 2.9)])
    assert watch.silent(3 * S) == ""
    watch.add([row("pump", "fault", None, 3.9)])  # a row without a value
    assert watch.silent(4 * S) == "no value of pump came for 2.1 s"


def test_missing_values_of_a_fault_code_are_reported(watch: LimitWatch) -> None:
    for drive in ("fan", "pump"):
        watch.add([row(drive, "output_current", 1.0, 2.9), row(drive, "fault", 0.0, 2.0)])
    assert watch.silent(4 * S) == ""
    watch.add([row("fan", "output_current", 1.0, 4.9), row("pump", "output_current", 1.0, 4.9)])
    watch.add([row("fan", "fault", 0.0, 4.9), row("pump", "fault", None, 4.9)])
    assert watch.silent(5 * S) == "no value of pump.fault came for 3.0 s"


def test_computed_channels_do_not_hide_a_silent_drive(watch: LimitWatch) -> None:
    watch.add([row("fan", "output_current", 1.0, 3.0), row("pump", "power_of_all", 1.0, 3.0)])
    assert watch.silent(3 * S) == "no value of pump came for 3.0 s"


def test_a_step_condition_ignores_values_read_before_the_step(watch: LimitWatch, tmp_path: Path) -> None:
    (condition,) = (step.until for step in load_test(tmp_path / "test.toml").steps)
    assert condition
    assert not watch.holds(condition, 0)
    watch.add([row("pump", "output_frequency", 4.0)])
    assert watch.holds(condition, S)
    assert not watch.holds(condition, S + 1)
    watch.add([row("pump", "output_frequency", None)])
    assert not watch.holds(condition, S)
