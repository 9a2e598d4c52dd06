"""A plant file of what a scan has found, ready to be polled; what is doubtful stands in comments."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence

from multidrop.drive.family import Drive
from multidrop.scan.identify import candidate
from multidrop.scan.results import GUESS, Found


def plant_text(port: str, found: Sequence[Found], families: Mapping[str, type[Drive]]) -> str:
    """The file's text; `families` by what a plant file calls them. ValueError where no drive is known."""
    names = {family.model or family.__name__: name for name, family in families.items()}
    taken: dict[int, str] = {}
    tables = [f'[[line]]\nname = "line-1"\nport = {_text(port)}\n']
    for it in sorted(found, key=lambda it: (not it.models, it.address)):
        if not it.models:
            tables.append(f"# address {it.address}: an unknown Modbus device at {it.settings} {it.framing}\n")
            continue
        model = names[it.models[0]]
        lines = list(_drive(it, model, families[model]))
        if it.address in taken:
            reason = f"# {taken[it.address]} has this address too: give one of them another, then use this"
            lines = [reason, *(f"# {line}" for line in lines)]
        taken.setdefault(it.address, f"{it.models[0]}-{it.address}")
        tables.append("\n".join(lines) + "\n")
    if not taken:
        raise ValueError("no drive of a known family was found: there is nothing to write a plant file of")
    return "\n".join(tables)


def _drive(it: Found, model: str, family: type[Drive]) -> Iterator[str]:
    drive = candidate(family, it.settings, it.framing, it.address)
    assert drive is not None  # else it would not have been recognised
    yield "[[line.drive]]"
    if it.doubt:
        yield f"# {it.doubt}"
    if len(it.models) > 1:
        yield f"# it may as well be {' or '.join(it.models[1:])}"
    yield f'name = "{it.models[0]}-{it.address}"'
    yield f"model = {_text(model)}"
    yield f"address = {it.address}"
    yield f'framing = "{it.framing}"'
    yield f"baudrate = {drive.settings.baudrate}"
    yield f'format = "{drive.settings.format}"'
    if GUESS in it.doubt and "confirmed" in family.options:
        yield "# confirmed = 1  # once its name plate says so: before, nothing is written to it"


def _text(value: str) -> str:
    """A basic string of TOML: JSON's, as far as paths and names go."""
    return json.dumps(value, ensure_ascii=False)
