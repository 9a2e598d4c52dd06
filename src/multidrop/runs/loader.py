"""Load a test file, and find all mistakes in the file. Opens no port."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from typing import Any

from multidrop.drive.family import Drive
from multidrop.drive.verbs import Direction
from multidrop.plant.loader import load_plant
from multidrop.plant.model import Plant
from multidrop.printable import is_number
from multidrop.recording.rows import PHASE_DRIVE
from multidrop.runs.checks import check_frequency, check_start, check_stop, check_write, contradictions
from multidrop.runs.model import EXAMPLE, AbortLimits, ReadingCondition, RunPlan, RunStep
from multidrop.toml_check import DURATION, Key, TomlPlace, duration_of, grouped
from multidrop.toml_document import read_document

STOP = "stop"  # the phase in which the drives are stopped, at the end of each run
MOST_STEPS = 100_000  # limit of the number of steps in a test, including repetitions

_TEST = {
    "plant": Key(str, 'plant = "plant.toml"', needed=True),
    "abort": Key(dict, "[abort], a table of limits"),
    "phase": Key(list, "[[phase]], in two brackets, with its name and steps", needed=True),
}
_ABORT = {
    "limits": Key(list, f'limits = ["{EXAMPLE}"]'),
    "silence": Key(str, 'silence = "2 s"', keywords=DURATION),
    "duration": Key(str, 'duration = "10 min"', keywords=DURATION),
}
_PHASE = {
    "name": Key(str, 'name = "warm up"', needed=True),
    "repeat": Key(int, "repeat = 3"),
    "step": Key(list, "[[phase.step]], in two brackets, with commands and a dwell", needed=True),
}
_STEP = {
    "frequency": Key(dict, "frequency = { pump-1 = 20.0 }, in Hz; a list of them makes a step of each"),
    "rate": Key((int, float), "rate = 2.0, in Hz/s"),
    "write": Key(dict, "write = { pump-1.acceleration_time = 5.0 }"),
    "start": Key(list, 'start = ["pump-1"]'),
    "direction": Key(str, 'direction = "reverse"'),
    "stop": Key(list, 'stop = ["pump-1"]'),
    "dwell": Key(str, 'dwell = "10 s"', keywords=DURATION),
    "until": Key(str, f'until = "{EXAMPLE}"'),
    "within": Key(str, 'within = "5 min"', keywords=DURATION),
}


NEEDS = {"rate": "frequency", "direction": "start", "within": "until", "until": "within"}  # key: another key


def load_test(path: Path | str) -> RunPlan:
    """Return the test that the file describes.

    Raises ValueError with a sentence for each mistake, and PlantError for mistakes in the plant file.
    """
    path = Path(path)
    place = TomlPlace.in_file(path)
    document = place.attempt(read_document, path, "test file")
    if document and "line" in document and "phase" not in document:
        raise ValueError(
            f"{path}: this is a plant file; poll its drives with `multidrop poll {path}`, or write a test "
            f'file with plant = "{path.name}"'
        )
    given = {} if document is None else place.check(document, _TEST)
    if "plant" not in given:
        raise ValueError("\n".join(place.config_errors))
    if not (path.parent / given["plant"]).exists():
        place.wrong(f'plant = "{given["plant"]}": there is no such file', "plant")
        raise ValueError("\n".join(place.config_errors))
    plant = load_plant(path.parent / given["plant"])
    if any(polled.drive.name == PHASE_DRIVE for polled in plant.drives):
        place.wrong(
            f'the drive name "{PHASE_DRIVE}" is reserved for phases; rename the drive in the plant file',
            "plant",
        )
    limits = _limits(given.get("abort", {}), place.within("abort", "abort"), plant)
    steps: list[RunStep] = []
    for table, at in place.inside("phase", given.get("phase", [])):
        steps += _phase(table, at, plant)
    if len(steps) > MOST_STEPS:
        place.wrong(
            f"the phases have {len(steps)} steps, repetitions included; at most {MOST_STEPS} fit", "phase"
        )
    if place.config_errors:
        raise ValueError("\n".join(grouped(sorted(place.config_errors, key=attrgetter("line")))))
    return RunPlan(plant, tuple(steps), limits, path)


def _limits(table: Any, place: TomlPlace, plant: Plant) -> AbortLimits:
    given = place.check(table, _ABORT)
    texts = [text for text in given.get("limits", []) if _is_text(text, place, "limits")]
    found = [place.attempt(ReadingCondition.parse, text, plant, key="limits") for text in texts]
    return AbortLimits(
        tuple(filter(None, found)),
        duration_of(given, "silence", place),
        duration_of(given, "duration", place),
    )


def _is_text(value: object, place: TomlPlace, key: str) -> bool:
    if not isinstance(value, str):
        place.wrong(f"{key}: {value!r} is not a text; write {(_ABORT | _STEP)[key].example}", key)
    return isinstance(value, str)


def _phase(table: Any, place: TomlPlace, plant: Plant) -> list[RunStep]:
    """Return the steps of a phase, once for each repetition of the phase."""
    given = place.check(table, _PHASE)
    name, repeat = given.get("name", ""), given.get("repeat", 1)
    if name == STOP:
        place.wrong(
            f'name "{STOP}" is reserved for the stops at the end; give the phase another name', "name"
        )
    if name:
        sentence = "another phase already has this name; give this phase another name"
        place.once("phase", name, sentence=sentence, key="name")
    if not 1 <= repeat <= MOST_STEPS:
        place.wrong(f"repeat = {repeat} is not right; write a number from 1 to {MOST_STEPS}", "repeat")
        repeat = 1
    steps = [
        step for one, at in place.inside("step", given.get("step", [])) for step in _steps(one, at, plant)
    ]
    if len(steps) > 1:
        steps = [replace(step, name=f"{name} {number}") for number, step in enumerate(steps, 1)]
    else:
        steps = [replace(step, name=name) for step in steps]
    times: int = min(repeat, 1 + MOST_STEPS // max(1, len(steps)))
    return steps * times


def _steps(table: Any, place: TomlPlace, plant: Plant) -> Iterator[RunStep]:
    """Yield the step that a table describes, or a step for each of several listed frequencies."""
    errors = len(place.config_errors)
    given = place.check(table, _STEP)
    for key in ("frequency", "write"):
        given[key] = {name: one for name, one in given.get(key, {}).items() if _find(plant, name, place, key)}
    for key in ("start", "stop"):
        names = [name for name in given.get(key, []) if _is_text(name, place, key)]
        given[key] = tuple(name for name in names if _find(plant, name, place, key))
    direction = (
        place.attempt(_direction, given["direction"], key="direction") if "direction" in given else None
    )
    step = RunStep(
        "",
        write=given["write"],
        start=given["start"],
        direction=direction,
        stop=given["stop"],
        dwell=duration_of(given, "dwell", place) or 0.0,
        until=place.attempt(ReadingCondition.parse, given["until"], plant, key="until")
        if "until" in given
        else None,
        within=duration_of(given, "within", place) or 0.0,
        rate=_rate(given, place),
    )
    if len(place.config_errors) == errors:  # only if no key is misspelt or has an invalid value
        _check_keys(given, step, place)
    for key, sentence in contradictions(step, given["frequency"]):
        place.wrong(sentence, key)
    _check_commands(step, place, plant)
    if step.rate:
        for name in given["frequency"]:
            if ("frequency", name) not in place.seen:
                place.wrong(f"a ramp of {name} needs a start: set a frequency in an earlier step", "rate")
    place.seen.update({("frequency", name): "" for name in given["frequency"]})
    for frequency in _each(given["frequency"], place):
        for name, hz in frequency.items():
            place.attempt(check_frequency, _find(plant, name, place, "frequency"), hz, key="frequency")
        yield replace(step, frequency=frequency)


def _direction(name: str) -> Direction:
    try:
        return Direction(name)
    except ValueError:
        raise ValueError(f'direction = {name!r} is neither "forward" nor "reverse"') from None


def _find(plant: Plant, name: str, place: TomlPlace, key: str) -> Drive | None:
    found = place.attempt(plant.find_drive, name, key=key)
    return found[1] if found else None


def _rate(given: Mapping[str, Any], place: TomlPlace) -> float | None:
    rate: float | None = given.get("rate")
    if rate is not None and not 0 < rate < float("inf"):
        place.wrong(f"rate = {rate:g} is not right; write {_STEP['rate'].example}", "rate")
        return None
    return rate


def _check_keys(given: Mapping[str, Any], step: RunStep, place: TomlPlace) -> None:
    """Report keys that need another key; else report a step that does nothing."""
    lacking = [(key, needs) for key, needs in NEEDS.items() if given.get(key) and not given.get(needs)]
    for key, needs in lacking:
        place.wrong(f"{key} needs {needs}; add {_STEP[needs].example}", key)
    if not (lacking or step.drives or given["frequency"] or step.dwell or step.until):
        place.wrong(f"the step does nothing; add a command, or {_STEP['dwell'].example}")


def _each(frequency: Mapping[str, Any], place: TomlPlace) -> Iterator[dict[str, float]]:
    """Yield the frequencies of all drives for each step.

    `frequency` has a list for each drive, with one number per step, or a single number for all steps.
    """
    lists = {name: one if isinstance(one, list) else [one] for name, one in frequency.items()}
    for name, numbers in lists.items():
        for hz in numbers:
            if not is_number(hz):
                place.wrong(f"frequency of {name}: {hz!r} is not a number in Hz", "frequency")
                return
    lengths = {len(numbers) for numbers in lists.values() if len(numbers) != 1}
    if len(lengths) > 1 or 0 in lengths:
        place.wrong("the lists of frequencies must all have the same length", "frequency")
        return
    for at in range(max(lengths, default=1)):
        yield {name: float(numbers[at % len(numbers)]) for name, numbers in lists.items()}


def _check_commands(step: RunStep, place: TomlPlace, plant: Plant) -> None:
    for name in step.start:
        place.attempt(check_start, plant.find_drive(name)[1], step.direction, key="start")
    for name in step.stop:
        place.attempt(check_stop, plant.find_drive(name)[1], key="stop")
    for name, values in step.write.items():
        if not isinstance(values, dict):
            place.wrong(f"write of {name}: {values!r} is not right; write {_STEP['write'].example}", "write")
            continue
        for register, value in values.items():
            place.attempt(check_write, plant.find_drive(name)[1], register, value, key="write")
