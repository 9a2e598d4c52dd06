"""Edits of documents with verbs: one at a time, each with a name, at every possible place.

Addresses and the numbers of bits and values stay, because only the manual can verify them.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

Document = dict[str, Any]
Path = tuple[str | int, ...]


class Edit(NamedTuple):
    name: str
    document: Callable[[], Document]  # creates it on demand: most edits are only counted


def at(document: Any, path: Path) -> Any:
    for key in path:
        document = document[key]
    return document


def edited(document: Document, path: Path, change: Callable[[Any, Any], None]) -> Document:
    """Return a copy on which `change(parent, key)` was called for this place."""
    made = copy.deepcopy(document)
    change(at(made, path[:-1]), path[-1])
    return made


def put(document: Document, path: Path, value: Any) -> Edit:
    def change(parent: Any, key: Any) -> None:
        parent[key] = copy.deepcopy(value)

    return Edit(f"{shown(path)} = {value!r}", partial(edited, document, path, change))


def dropped(document: Document, path: Path) -> Edit:
    def change(parent: Any, key: Any) -> None:
        del parent[key]

    return Edit(f"without {shown(path)}", partial(edited, document, path, change))


def inserted(document: Document, path: Path, value: Any) -> Edit:
    def change(parent: Any, key: Any) -> None:
        parent.insert(key, copy.deepcopy(value))

    return Edit(f"{shown(path)} gets {value!r}", partial(edited, document, path, change))


def shown(path: Path) -> str:
    return ".".join(map(str, path))


def steps_of(document: Document) -> Iterator[Path]:
    """Yield the paths of all steps, including those in else branches."""
    for verb, table in document["verb"].items():
        for number, step in enumerate(table["steps"]):
            yield ("verb", verb, "steps", number)
            for inner in range(len(step.get("else", ()))):
                yield ("verb", verb, "steps", number, "else", inner)


def words_of(value: Any) -> list[Any]:
    if isinstance(value, dict):
        return [value["forward"], value["reverse"]]
    return [value]


def all_words(document: Document) -> list[Any]:
    """Return every word that any verb sends, once each."""
    found: list[Any] = []
    for path in steps_of(document):
        for word in words_of(at(document, path).get("value", ())):
            if word not in ((), *found):
                found.append(word)
    return found


def all_edits(document: Document) -> Iterator[Edit]:
    """Yield every edit of all kinds."""
    for kind in KINDS:
        yield from kind(document)


# ---- kinds of edits ----


def without_a_part(document: Document) -> Iterator[Edit]:
    for section in ("look", "state", "identify", "set_frequency", "shows", "verb", "option"):
        if section not in document:
            continue
        yield dropped(document, (section,))
        for key in document[section]:
            yield dropped(document, (section, key))
    for path in steps_of(document):
        yield dropped(document, path)
        for key in at(document, path):
            yield dropped(document, (*path, key))
    for kind in ("command", "reading", "setting"):
        for name, table in document.get(kind, {}).items():
            yield dropped(document, (kind, name))
            for key in {"harmless", "span", "never_together", "kept", "broadcast", "values", "bits"} & {
                *table
            }:
                yield dropped(document, (kind, name, key))


def steps_elsewhere(document: Document) -> Iterator[Edit]:
    verbs = document["verb"]
    for path in steps_of(document):
        steps, number = at(document, path[:-1]), int(path[-1])
        yield inserted(document, path, steps[number])
        for other in range(len(steps)):
            if other != number:
                moved = [step for at_, step in enumerate(steps) if at_ != number]
                moved.insert(other, steps[number])
                yield put(document, path[:-1], moved)
    for verb in verbs:
        for other in verbs:
            if verb != other:
                yield put(document, ("verb", verb, "steps"), verbs[other]["steps"])
                for step in verbs[other]["steps"]:
                    for number in (0, len(verbs[verb]["steps"])):
                        yield inserted(document, ("verb", verb, "steps", number), step)
    for verb in ("jog", "emergency_stop", "coast", "reset_fault"):
        if verb not in verbs:
            for other in verbs:
                yield put(document, ("verb", verb), verbs[other])


def steps_of_another_kind(document: Document) -> Iterator[Edit]:
    looks = [*document["look"], "nowhere"]
    for path in steps_of(document):
        step = at(document, path)
        for kind, other in (("write", "insist"), ("insist", "write")):
            if kind in step:
                yield put(document, path, {other: step[kind], "value": step["value"]})
        for key in ("await", "refuse", "when"):
            for look in looks if key in step or key == "when" else ():
                yield put(document, (*path, key), look)
        if "else" not in step and "await" in step:
            for word in all_words(document):
                for name in document["command"]:
                    for kind in ("write", "insist"):
                        yield put(document, (*path, "else"), [{kind: name, "value": word}])
        for key in ("limit", "wait") if "limit" in step or "wait" in step else ():
            for time in ("0 s", "50 ms", "10 s", "10 min", "1 h", "24 h", 5, True, ""):
                yield put(document, (*path, key), time)
        yield put(document, path, {"repeat": 10, **step})


def other_words(document: Document) -> Iterator[Edit]:
    words = all_words(document)
    for path in steps_of(document):
        value = at(document, path).get("value")
        if value is None:
            continue
        places: list[Path] = [(*path, "value")]
        if isinstance(value, dict):
            places = [(*path, "value", "forward"), (*path, "value", "reverse")]
            for without in ("forward", "refuse", "as it turns", "either"):
                yield put(document, (*path, "value", "without"), without)
        for place in places:
            for word in words:
                if word != at(document, place):
                    yield put(document, place, word)
            own = at(document, place)
            if isinstance(own, int):
                for bit in range(16):
                    yield put(document, place, own ^ 1 << bit)
        for name in [*document.get("command", {}), *document.get("setting", {})]:
            for key in ("write", "insist"):
                if key in at(document, path):
                    yield put(document, (*path, key), name)


def other_harmless(document: Document) -> Iterator[Edit]:
    for kind in ("command", "setting"):
        for name, table in document.get(kind, {}).items():
            words = [word for word in all_words(document) if isinstance(word, int)]
            for key in ("harmless", "broadcast"):
                own = table.get(key, [])
                for word in dict.fromkeys(
                    [*words, *range(10), *(word ^ 1 << bit for word in words for bit in range(16))]
                ):
                    if word not in own:
                        yield put(document, (kind, name, key), [*own, word])
                        yield put(document, (kind, name, key), [word, *own])
                for number in range(len(own)):
                    yield dropped(document, (kind, name, key, number))
            for key, value in (
                ("moves", False),
                ("kept", "eeprom"),
                ("ram_address", 1),
                ("span", [-100, 100]),
            ):
                yield put(document, (kind, name, key), value)
            for other_kind in ("setting", "reading", "command"):
                if other_kind != kind:
                    moved = dropped(document, (kind, name)).document()
                    moved.setdefault(other_kind, {})[name] = {
                        key: value for key, value in table.items() if key not in ("harmless", "broadcast")
                    }
                    yield Edit(f"{kind}.{name} is a {other_kind}", partial(copy.deepcopy, moved))
            for other in ("setting", "command"):
                alias = {key: value for key, value in table.items() if key not in ("harmless", "broadcast")}
                yield (
                    put(document, (other, "alias"), alias)
                    if other in document
                    else put(document, (other,), {"alias": alias})
                )


def other_looks(document: Document) -> Iterator[Edit]:
    looks = document["look"]
    for name, look in looks.items():
        yield put(document, ("look", f"{name}_"), look)
        renamed = dropped(document, ("look", name)).document()
        renamed["look"][f"{name}_"] = look
        yield Edit(f"{name} is called {name}_", partial(copy.deepcopy, renamed))
        for other in looks:
            if other != name:
                yield put(document, ("look", name), looks[other])
        for path in (
            [("look", name)] if isinstance(look, dict) else [("look", name, at_) for at_ in range(len(look))]
        ):
            yield from _other_criteria(document, path)
        if isinstance(look, list):
            for number in range(len(look)):
                yield dropped(document, ("look", name, number))
            yield put(document, ("look", name), [])
    identity: Path = ("identify",)
    yield from _other_criteria(document, identity)
    for name in looks:
        yield put(document, identity, looks[name])


def _other_criteria(document: Document, path: Path) -> Iterator[Edit]:
    criterion = at(document, path)
    register = criterion["register"]
    table = document["reading"][register]
    for key in ("has", "lacks", "is"):
        names = [*table.get("bits" if key != "is" else "values", {})]
        if key in criterion:
            yield put(document, (*path, key), [])
            yield dropped(document, (*path, key))
            for number in range(len(criterion[key])):
                yield dropped(document, (*path, key, number))
            for bit in names:
                yield put(document, (*path, key), [bit])
                yield put(document, (*path, key), [*criterion[key], bit])
            yield put(document, (*path, key), names)
    for key, other in (("has", "lacks"), ("lacks", "has")):
        if key in criterion:
            yield put(document, path, {"register": register, other: criterion[key]})
        for bit in table.get("bits", {}):
            yield put(document, (*path, key), [*criterion.get(key, []), bit])
    for key in ("below", "above"):
        for value in (-1e9, -1000, -1, -0.5, 0, 0.05, 0.5, 2, 60, 100, 1e4, 1e9):
            if key in criterion or "below" in criterion:
                yield put(document, (*path, key), value)
    if "below" in criterion and "above" in criterion:
        yield dropped(document, (*path, "above"))
    for other in document["reading"]:
        yield put(document, (*path, "register"), other)


def other_states(document: Document) -> Iterator[Edit]:
    states = document["state"]
    for look in states:
        for word in ("fault", "running", "stopped", "accelerating", "running reverse", "unknown", "ok"):
            if word != states[look]:
                yield put(document, ("state", look), word)
    for look in document["look"]:
        for word in ("fault", "running", "stopped"):
            if look not in states:
                yield put(document, ("state", look), word)
                first = copy.deepcopy(document)
                first["state"] = {look: word, **states}
                yield Edit(f"state begins with {look} = {word}", partial(copy.deepcopy, first))
    backwards = copy.deepcopy(document)
    backwards["state"] = dict(reversed(states.items()))
    yield Edit("state backwards", partial(copy.deepcopy, backwards))


def other_setpoints(document: Document) -> Iterator[Edit]:
    for kind in ("reading", "setting", "command"):
        for name in document.get(kind, {}):
            yield put(document, ("set_frequency", "register"), name)
            yield put(document, ("set_frequency", "of"), name)
    for value in ({"register": "reference"}, [], "reference", {"register": "reference", "of": "nothing"}):
        yield put(document, ("set_frequency",), value)


KINDS = (
    without_a_part,
    steps_elsewhere,
    steps_of_another_kind,
    other_words,
    other_harmless,
    other_looks,
    other_states,
    other_setpoints,
)
