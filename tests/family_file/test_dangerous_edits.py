"""Edits of files with verbs: each that could start a motor unasked, or keep a stop from working, is refused.

Two judges: a table of edits that are known to be dangerous, and a program that makes every edit of some kinds
(`verb_edits`) and has what is not refused drive a motor that obeys its document alone (`nasty_drives`).
All of them: `EDITS=all pytest -m '' tests/family_file/test_dangerous_edits.py -k survives`.
"""

from __future__ import annotations

import copy
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from itertools import islice
from typing import Any

import pytest
from declared_families import NAMES, class_of, document_of, mistakes_of
from examples import PART, in_turn
from nasty_drives import RESETS, NastyDrive
from simulated_bus import SimulatedBus
from tables import table
from verb_edits import KINDS, Document

from multidrop.drive import Condition, Drive
from multidrop.drive.verbs import STOPPING
from multidrop.errors import BusError, Unsupported

# One edit in so many is tried.
STEP = 1 if os.environ.get("EDITS") == "all" else 8 * PART

ADDRESS = 7
Change = Callable[[Document], object]


def steps(verb: str) -> Callable[[Document], list[Any]]:
    return lambda document: document["verb"][verb]["steps"]


def control(**changes: Any) -> Change:
    return lambda document: document["command"]["control"].update(changes)


def step(verb: str, number: int, **changes: Any) -> Change:
    return lambda document: document["verb"][verb]["steps"][number].update(changes)


def replaced(verb: str, number: int, new: dict[str, Any]) -> Change:
    return lambda document: document["verb"][verb]["steps"].__setitem__(number, new)


def without(verb: str, number: int) -> Change:
    return lambda document: document["verb"][verb]["steps"].pop(number)


def inserted(verb: str, number: int, new: dict[str, Any]) -> Change:
    return lambda document: document["verb"][verb]["steps"].insert(number, new)


def section(name: str, **changes: Any) -> Change:
    return lambda document: document[name].update(changes)


def no(*keys: str | int) -> Change:
    def change(document: Any) -> None:
        for key in keys[:-1]:
            document = document[key]
        del document[keys[-1]]

    return change


WRITE_047F = {"write": "control", "value": 0x047F}
AWAIT = {"await": "stands", "limit": "60 s"}
# abb.toml's steps: 0 refuse, 1 refuse, 2 setpoint, 3 insist 0476, 4 await, 5 wait, 6 write 0477, 7 await,
# 8 write 047F, 9 started. The first eleven break one rule each that a file is checked for.
EDITS: dict[str, tuple[Change, str]] = {
    "start insists on the word that runs": (
        replaced("start", 8, {"insist": "control", "value": 0x047F}),
        "no harmless word",
    ),
    "stop is written once": (replaced("stop", 0, {"write": "control", "value": 0x0476}), "keep a stop back"),
    "stop is not watched": (without("stop", 1), "does not end with an await"),
    "a start word is harmless": (control(harmless=[0x0476, 0x0474, 0x047F]), "047FH"),
    "a reset starts": (step("reset_fault", 1, value=0x04FF), "never written together"),
    "start does not refuse on a fault": (without("start", 0), "does not refuse on tripped"),
    "no stop": (no("verb", "stop"), r"\[verb.stop\] is missing"),
    "no identify": (no("identify"), r"\[identify\] is missing"),
    "an await without a limit": (no("verb", "stop", "steps", 1, "limit"), "lacks 'limit'"),
    "a look that is none": (step("stop", 1, **{"await": "still"}), "no look"),
    "start without the setpoint": (without("start", 2), "does not ask for the setpoint"),
    # ---- words ----
    "stop sends the start word": (step("stop", 0, value=0x047F), "no harmless word"),
    "stop sends the start word, said to be harmless": (
        lambda document: (
            control(harmless=[0x0476, 0x0474, 0x047F])(document),
            step("stop", 0, value=0x047F)(document),
        ),
        "adds no bit|of a start",
    ),
    "coast sends the start word": (step("coast", 0, value=0x047F), "no harmless word"),
    "a word with one bit of a start is harmless": (control(harmless=[0x0476, 0x0474, 0x0477]), "0477H"),
    "a word that nobody sends is harmless": (control(harmless=[0x0476, 0x0474, 0x0400]), "sent by no stop"),
    "the reset word is harmless": (control(harmless=[0x0476, 0x0474, 0x04F6]), "of a reset"),
    "the start word is broadcast": (control(broadcast=[0x047F]), "no word of stop"),
    "a coast is broadcast as a stop": (control(broadcast=[0x0474]), "no word of stop"),
    "reset and start in one word": (
        lambda document: (
            no("command", "control", "never_together")(document),
            step("start", 8, value=0x04FF)(document),
        ),
        "of a reset",
    ),
    "reset with the run bits, without never_together": (
        lambda document: (
            no("command", "control", "never_together")(document),
            step("reset_fault", 1, value=0x04FF)(document),
        ),
        "it would start the motor",
    ),
    "a word with a reserved bit": (step("start", 8, value=0x0C7F), "reserved"),
    "a word of 17 bits": (step("start", 8, value=0x1047F), "does not take"),
    "a word that is true": (step("start", 8, value=True), "no bit True"),
    "start writes the stop word": (step("start", 8, value=0x0476), "is harmless"),
    "start is written twice": (inserted("start", 9, WRITE_047F), "twice"),
    "start is written in an else": (step("start", 7, **{"else": [WRITE_047F]}), "in an else"),
    "start in a reset": (inserted("reset_fault", 3, WRITE_047F), "of a start|resets a fault"),
    "reset in a start": (
        inserted("start", 3, {"write": "control", "value": 0x04F6}),
        "resets a fault|of a reset",
    ),
    "reset is insisted on": (
        replaced("reset_fault", 1, {"insist": "control", "value": 0x04F6}),
        "no harmless word",
    ),
    # ---- stops ----
    "stop waits first": (inserted("stop", 0, {"wait": "10 s"}), "begin with an insist"),
    "stop looks first": (inserted("stop", 0, {"await": "ready_on", "limit": "60 s"}), "begin with an insist"),
    "stop only when": (step("stop", 0, when="runs"), "begin with an insist"),
    "stop refuses": (inserted("stop", 1, {"refuse": "tripped", "because": "no"}), "keep a stop back"),
    "stop awaits that it runs": (step("stop", 1, **{"await": "runs"}), "does not end with an await"),
    "stop is watched only when": (step("stop", 1, when="tripped"), "does not end with an await"),
    "stop goes on for a day": (step("stop", 1, limit="24 h"), "outside"),
    "stop has a loop": (inserted("stop", 1, {"repeat": 10}), "is no step"),
    "emergency stop starts": (
        lambda document: document["verb"].update(emergency_stop={"steps": [WRITE_047F, AWAIT]}),
        "keep a stop back",
    ),
    # ---- guards ----
    "refuses on a fault only when": (step("start", 0, when="inhibited"), "does not refuse on tripped"),
    "refuses on a fault after the start": (
        lambda document: steps("start")(document).append(steps("start")(document).pop(0)),
        "does not refuse on tripped",
    ),
    "refuses on another look": (step("start", 0, refuse="inhibited"), "does not refuse on tripped"),
    "asks for the setpoint after the start": (
        lambda document: steps("start")(document).insert(8, steps("start")(document).pop(2)),
        "does not ask for the setpoint",
    ),
    "start is not watched": (without("start", 9), "does not end with started"),
    "start sleeps before it starts": (step("start", 4, limit="10 min"), "60 s at most"),
    "reset while it runs": (without("reset_fault", 0), "does not refuse on runs"),
    "jog in a fault": (
        lambda document: document["verb"].update(jog={"steps": [WRITE_047F, {"started": True}]}),
        "does not refuse on tripped",
    ),
    "start writes only when": (
        lambda document: [
            step.update(when="inhibited") for step in steps("start")(document) if "write" in step
        ],
        "without `when`",
    ),
    "start asks for its direction where no state tells one": (
        step("start", 8, value={"forward": 0x047F, "reverse": 0x047D, "without": "as it turns"}),
        "cannot tell how it turns",
    ),
    "a jog with the word that starts": (
        lambda document: document["verb"].update(
            jog={"steps": [steps("start")(document)[0], WRITE_047F, {"started": True}]}
        ),
        "jog word 047FH starts the motor, as 047FH does",
    ),
    "reset writes nothing": (without("reset_fault", 1), "writes nothing"),
    "reset awaits that it runs": (inserted("reset_fault", 3, {"started": True}), "belongs to a start"),
    "reset has directions": (
        step("reset_fault", 1, value={"forward": 0x04F6, "reverse": 0x04F4, "without": "refuse"}),
        "turns nothing",
    ),
    # ---- looks ----
    "a stop look that always holds": (
        section("look", stands={"register": "status", "lacks": []}),
        "always true",
    ),
    "a stop look that holds while it runs": (
        section("look", stands=[{"register": "output_frequency", "below": 0.2}]),
        "may hold while runs",
    ),
    "a stop look without the run-down": (
        section("look", stands={"register": "status", "lacks": ["rdy_ref"]}),
        "does not look at output_frequency",
    ),
    "a stop look that holds at any frequency": (
        lambda document: document["look"]["stands"][1].update(below=1000),
        "for a standstill",
    ),
    "a stop look at a frequency in no known unit": (
        lambda document: (
            document["reading"]["output_frequency"].update(unit="hz"),
            document["look"]["stands"][1].update(below=30),
        ),
        "in hz for a standstill",
    ),
    "a stop look at a frequency that the device scales": (
        lambda document: (
            document["reading"]["output_frequency"].update(scale_register="power"),
            document["reading"].update(power={"at": "40102", "number_format": "I16"}),
        ),
        "whose scale the device may change",
    ),
    "a stop look at a signed part of the frequency": (
        lambda document: document["reading"]["output_frequency"].update(number_format="I16", part=[0, 14]),
        "which is reverse",
    ),
    "a running look that is called stopped": (section("state", runs="stopped"), "running|may hold|stand"),
    "nothing says what a running drive shows": (no("shows", "running"), "missing"),
    "nothing says what a tripped drive shows": (no("shows", "fault"), "missing"),
    "nothing says what a standing drive shows": (no("shows", "status"), "missing"),
    "a fault that is called stopped": (section("state", tripped="stopped"), "no fault to refuse on"),
    "a fault that comes last": (
        lambda document: document.update(state=dict(reversed(document["state"].items()))),
        "comes after",
    ),
    "a fault look that a tripped drive does not show": (
        section("look", tripped={"register": "status", "has": ["alarm"]}),
        "shows.fault",
    ),
    "a fault look that needs an alarm too": (
        lambda document: (
            section("look", tripped={"register": "status", "has": ["tripped", "alarm"]})(document),
            document["shows"]["fault"]["status"].append("alarm"),
        ),
        "would not be seen",
    ),
    "a fault look that needs remote too": (
        section("look", tripped={"register": "status", "has": ["tripped", "remote"]}),
        "would not be seen",
    ),
    "an identify that always holds": (section("identify", has=[]), "always true"),
    "an identify that a running drive fails": (
        section("identify", has=["remote"], lacks=["rdy_ref"]),
        "would not be known",
    ),
    # ---- registers ----
    "anyone may write the control word": (control(moves=False), "moves = false"),
    "the control word is a setting": (
        lambda document: document.update(setting={"control": document["command"].pop("control")}),
        r"under \[command\]",
    ),
    "the control word has no bits": (no("command", "control", "bits"), "no names"),
    "nothing is harmless": (no("command", "control", "harmless"), "no harmless word"),
    "the control word wears the EEPROM": (control(kept="eeprom"), "EEPROM"),
    "the control word goes elsewhere": (control(ram_address=1), "ram_address|written at the same address"),
    "a setting writes the control word": (
        lambda document: document.update(setting={"speed": {"at": "40001"}}),
        "past the verbs",
    ),
    "a setting's alias writes the control word": (
        lambda document: document.update(setting={"speed": {"at": "40009", "ram_address": 0}}),
        "past the verbs",
    ),
    "a long setting reaches into the control word": (
        lambda document: document["command"].update(
            control={**document["command"]["control"], "at": "40012"},
            speed={"at": "40011", "number_format": "U32", "moves": False},
        ),
        "past the verbs",
    ),
    "the setpoint is the control word": (section("set_frequency", register="control"), "bits or names"),
    "the setpoint may reverse": (
        lambda document: document["command"]["reference"].update(span=[-100, 100]),
        "reverse",
    ),
    "the setpoint has no limits": (no("command", "reference", "span"), "no span"),
    "a setpoint is broadcast": (
        lambda document: document["command"]["reference"].update(broadcast=[0, 20000]),
        "only 0",
    ),
    "a setpoint that falls as its count rises": (
        lambda document: document["command"]["reference"].update(step=-0.005, number_format="I16"),
        "its count 0 is to be 0",
    ),
    "a setpoint whose count 0 is not 0": (
        lambda document: document["command"]["reference"].update(offset=-50),
        "its count 0 is to be 0",
    ),
    "100 % of nothing": (section("set_frequency", of="nothing"), "neither an option nor"),
}


@pytest.mark.long
@table("name", EDITS)
def test_a_dangerous_edit_is_refused(name: str) -> None:
    document = document_of("abb")
    change, said = EDITS[name]
    change(document)
    assert repr(document) != repr(document_of("abb"))  # the order of [state] counts
    mistakes = mistakes_of(document)
    assert [mistake for mistake in mistakes if re.search(said, mistake)], mistakes
    assert all(mistake.startswith("file.toml: ") and "\n" not in mistake for mistake in mistakes)


@table("name", NAMES)
def test_the_unchanged_files_are_right(name: str) -> None:
    assert mistakes_of(document_of(name)) == []


# ---- every edit of some kinds ----


@cache
def true_class(name: str) -> type[Drive]:
    return class_of(document_of(name))


class Trial:
    """A file's class on a bus whose drive obeys the document that the file was made from."""

    def __init__(self, family: type[Drive], name: str, monkeypatch: pytest.MonkeyPatch) -> None:
        true = true_class(name)
        sim = NastyDrive(true(ADDRESS, name="true", **_options(true)))
        sim.motor.acceleration_time = sim.motor.deceleration_time = 2.0
        sim.judge(name)
        self.name = name
        self.sim = sim
        self.line = SimulatedBus(monkeypatch, sim)
        sim.motor.now = self.line.seconds
        self.drive = self.line.attach(family(ADDRESS, name="pump", **_options(family)))

    def call(self, verb: str, *arguments: Any) -> Exception | None:
        """Call a verb; return the reason where it says that it was not done."""
        try:
            getattr(self.drive, verb)(*arguments)
        except (BusError, ValueError) as failure:
            return failure
        return None

    @property
    def has_reset(self) -> bool:
        return any(RESETS[self.name](write.name, write.raw) for write in self.sim.counters.writes)


def _options(family: type[Drive]) -> dict[str, float]:
    wanted = {"confirmed": 1, "reference_maximum": 50}
    return {name: value for name, value in wanted.items() if name in family.options}


Begin = Callable[[], Trial]
# Status words with the bit of a fault, and that by which the drive is known, beside none and all others.
OTHER_FAULTS = {"abb": (0x0208, 0x0230 | 0x0008, 0x07FF, 0x0288), "fc": (0x0009, 0x0209, 0x0BFF, 0x0289)}


def stops_fail(begin: Begin, family: type[Drive]) -> Iterator[str]:
    for verb in STOPPING:
        trial = begin()
        trial.sim.turn(20)
        failure = trial.call(verb)
        if isinstance(failure, Unsupported) and (verb != "stop" or not moves(family)):
            continue
        if trial.sim.motor.energised:
            yield f"it turns after {verb}, {'which says so' if failure else 'which says that it stands'}"


def moves(family: type[Drive]) -> bool:
    return any(getattr(family, name) is not getattr(Drive, name) for name in ("start", "jog"))


def resets_start(begin: Begin, family: type[Drive]) -> Iterator[str]:
    trial = begin()
    trial.call("set_frequency", 20)
    trial.sim.trip(1)
    trial.call("reset_fault")
    if trial.sim.started:
        yield "a reset starts it"
    trial = begin()
    trial.sim.turn(20)
    trial.call("reset_fault")
    if trial.has_reset:
        yield "a reset is sent while it runs"


def starts_fail(begin: Begin, family: type[Drive]) -> Iterator[str]:
    for verb in ("start", "jog"):
        trial = begin()
        trial.call("set_frequency", 20)
        trial.sim.trip(1)
        trial.call(verb)
        if trial.sim.started or trial.has_reset:
            yield f"a {verb} is sent in a fault"
        for status in OTHER_FAULTS.get(trial.name, ()):
            trial = begin()
            trial.call("set_frequency", 20)
            trial.sim["status"] = status
            trial.call(verb)
            if trial.sim.started or trial.has_reset:
                yield f"a {verb} is sent in a fault that shows {status:04X}H"
        trial = begin()
        trial.call(verb)
        if verb == "start" and trial.sim.started:
            yield "a start is sent without a setpoint"
        trial = begin()
        trial.call("set_frequency", 20)
        failure = trial.call(verb)
        if failure is None and not trial.sim.motor.energised:
            yield f"a {verb} says that it runs, and it stands"
        if len(trial.sim.started) > 1 or trial.has_reset:
            yield f"a {verb} is sent more than once, or resets"
        trial = begin()
        trial.call("set_frequency", 20)
        trial.line.loses = lambda request, trial=trial: bool(trial.sim.started) and request.function in (5, 6)
        trial.call(verb)
        if len(trial.sim.started) > 1:
            yield f"a {verb} whose reply is lost is sent again"
        trial = begin()
        trial.drive.option["confirmed"] = 0
        trial.call("set_frequency", 20)
        trial.call(verb)
        if trial.sim.started:
            yield f"a {verb} is sent to an unconfirmed drive"


def plain_writes_start(begin: Begin, family: type[Drive]) -> Iterator[str]:
    trial = begin()
    trial.sim.motor.target = 20
    for register in family.registers.values():
        for raw in (1, 2, 3, 4, 0x0477, 0x047C, 0x047F, 0x053C, 0x847C, 7, 0x04BC, 0x04F6, 0x04FF):
            for send in (
                lambda value, register=register: trial.line.bus.write(trial.drive, register, value),
                lambda value, register=register: trial.line.bus.broadcast(register, value),
            ):
                try:
                    send(register.decode(raw))
                except (BusError, ValueError, TypeError):
                    continue
    if trial.sim.started:
        yield "a plain write or a broadcast starts it"
    if trial.has_reset:
        yield "a plain write or a broadcast resets a fault"


def setpoints_start(begin: Begin, family: type[Drive]) -> Iterator[str]:
    trial = begin()
    for hz in (20, -20, 1e6, 1, 2):
        trial.call("set_frequency", hz)
    if trial.sim.started or trial.has_reset:
        yield "a setpoint starts it, or resets a fault"
    trial = begin()
    trial.call("set_frequency", -20)
    if trial.sim.counters.writes:
        yield "a setpoint below 0 is sent"


def states_lie(begin: Begin, family: type[Drive]) -> Iterator[str]:
    trial = begin()
    trial.sim.turn(20)
    for _ in range(3):
        try:
            state = trial.drive.state()
        except (BusError, ValueError):
            return
        if state.condition is Condition.STOPPED and trial.sim.motor.energised:
            yield "a motor that turns is said to stand"
        trial.sim.motor.stop()
        trial.line.sleep(0.1)


DANGERS = (stops_fail, resets_start, starts_fail, plain_writes_start, setpoints_start, states_lie)


@contextmanager
def trials(family: type[Drive], name: str) -> Iterator[Begin]:
    with pytest.MonkeyPatch.context() as monkeypatch:
        yield lambda: Trial(family, name, monkeypatch)


def dangers_of(document: Document, name: str) -> list[str]:
    """Return what a drive that the document was made for would do under its changed file."""
    family = class_of(document)
    with trials(family, name) as begin:
        return [danger for find in DANGERS for danger in find(begin, family)]


@pytest.mark.parametrize("name", NAMES)
def test_the_unchanged_files_do_no_harm(name: str) -> None:
    assert dangers_of(document_of(name), name) == []


@pytest.mark.long
@pytest.mark.uncounted
@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "name"), in_turn(KINDS, NAMES), ids=lambda part: getattr(part, "__name__", part)
)
def test_no_dangerous_edit_survives(kind: Any, name: str) -> None:
    document = document_of(name)
    total, survivors, dangerous = 0, [], {}
    for edit in islice(kind(document), 0, None, STEP):
        total += 1
        changed = edit.document()
        if repr(changed) == repr(document):
            continue
        try:
            mistakes = mistakes_of(copy.deepcopy(changed))
        except KeyError:  # of the tests' loader, which has no checks of its own
            continue
        if mistakes:
            continue
        try:
            found = dangers_of(changed, name)
        except ValueError:  # the class refuses its registers
            continue
        survivors.append(edit.name)
        if found:
            dangerous[edit.name] = found
    print(f"{name}, {kind.__name__}: {total} edits, {len(survivors)} survive:", *survivors, sep="\n  ")
    assert total > 0
    assert dangerous == {}
