"""Documents of any kind: what is wrong with their verbs is told, and nothing else is raised."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest
from declared_families import NAMES, class_of, document_of, registers_of
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from multidrop.drive import Drive
from multidrop.drive.family import START_TIME
from multidrop.drive.script import MOST_UNANSWERED, Read, Wait, Write
from multidrop.drive.verbs import STOPPING
from multidrop.errors import BusError
from multidrop.family_file.steps import longest
from multidrop.family_file.verbs import SECTIONS, add_verbs
from multidrop.toml_check import TomlPlace

DOCUMENTS = {name: document_of(name) for name in NAMES}
REGISTERS = {name: registers_of(document) for name, document in DOCUMENTS.items()}


def _strings(value: Any) -> set[str]:
    if isinstance(value, dict):
        return set(value).union(*map(_strings, value.values()))
    if isinstance(value, list):
        return set().union(*map(_strings, value))
    return {value} if isinstance(value, str) else set()


KNOWN = sorted(set().union(*(_strings(document) for document in DOCUMENTS.values())))
TEXTS = st.one_of(st.sampled_from(KNOWN), st.text(max_size=8))
LEAVES = st.one_of(
    TEXTS,
    st.booleans(),
    st.integers(-(2**63), 2**63 - 1),
    st.integers(0, 0xFFFF),
    st.floats(),
)
VALUES = st.recursive(
    LEAVES,
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(TEXTS, inner, max_size=4)),
    max_leaves=12,
)


def told(name: str, document: dict[str, Any]) -> list[str]:
    place, namespace = TomlPlace(Path("file.toml")), dict(REGISTERS[name])
    before = set(namespace)
    add_verbs(namespace, document, REGISTERS[name], place)
    assert all("\n" not in mistake and mistake.startswith("file.toml: ") for mistake in place.config_errors)
    if place.config_errors:
        assert set(namespace) == before, "something was put into the class all the same"
    return place.config_errors


@pytest.mark.slow
@settings(max_examples=examples(40))
@given(name=st.sampled_from(NAMES), sections=st.dictionaries(st.sampled_from(SECTIONS), VALUES))
def test_any_sections_are_told_about(name: str, sections: dict[str, Any]) -> None:
    told(name, sections)


@st.composite
def damaged(draw: st.DrawFn) -> tuple[str, dict[str, Any]]:
    """Return a good document in which one to three values are others, or are missing."""
    name = draw(st.sampled_from(NAMES))
    document = copy.deepcopy(DOCUMENTS[name])
    for _ in range(draw(st.integers(1, 3))):
        parent, key = (
            document,
            draw(st.sampled_from([section for section in SECTIONS if section in document])),
        )
        while isinstance(parent[key], (dict, list)) and parent[key] and draw(st.integers(0, 4)):
            parent = parent[key]
            keys = [*parent] if isinstance(parent, dict) else [*range(len(parent))]
            key = draw(st.sampled_from(keys))
        if draw(st.booleans()):
            parent[key] = draw(VALUES)
        elif isinstance(parent, dict) and parent is not document:
            parent[draw(TEXTS)] = parent.pop(key)
    return name, document


@pytest.mark.long
@settings(max_examples=examples(500))
@given(damaged())
def test_damaged_documents_are_told_about(case: tuple[str, dict[str, Any]]) -> None:
    told(*case)


def ends(family: type[Drive], verb: str, answer: Any) -> float:
    """Return the seconds that a verb waits where each read is answered by `answer(register)`."""
    options = {"reference_maximum": 50} if "reference_maximum" in family.options else {}
    drive = family(1, confirmed=1, **options)
    drive.commanded = 20.0
    script, waited, result, steps = getattr(drive, verb).script(), 0.0, None, 0
    try:
        while True:
            step = script.send(result)
            steps += 1
            assert steps < 100_000
            waited += step.seconds if isinstance(step, Wait) else 0
            result = answer(step.register) if isinstance(step, Read) else getattr(step, "value", None)
            assert isinstance(step, (Wait, Read, Write))
    except (StopIteration, BusError):
        return waited


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
@given(raws=st.lists(st.integers(0, 0xFFFF), min_size=1, max_size=5))
@settings(max_examples=10)
def test_every_verb_ends_within_the_sum_of_its_limits(name: str, raws: list[int]) -> None:
    family = class_of(DOCUMENTS[name])
    declared: Any = vars(family)["declared_verbs"]
    at = 0

    def answer(register: Any) -> Any:
        nonlocal at
        at += 1
        return register.decode(raws[at % len(raws)])

    for verb, steps in declared.steps.items():
        slack = 0.11 * (len(steps) + MOST_UNANSWERED) + (
            0 if verb in STOPPING else 1.1
        )  # a reset looks after it
        assert ends(family, verb, answer) <= longest(steps, START_TIME) + slack
