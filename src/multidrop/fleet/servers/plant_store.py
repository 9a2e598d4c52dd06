"""Plant store: the plant's lines, with their family files, as records in the bucket `plant`.

A record has the name of its line. It holds the line's table of the plant file, and the text of the family
files that the line uses. So a gateway needs only the records of the lines that it polls.
"""

from __future__ import annotations

import asyncio
import json
import tomllib
from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from multidrop import Plant, PlantError, PlantLine
from multidrop.fleet.errors import Conflict, FleetError
from multidrop.fleet.servers import names
from multidrop.fleet.servers.buckets import NONE_YET, Bucket, Follower, Record
from multidrop.plant import FLEET_KEYS, MAY_KEYS, allowed, check_channels
from multidrop.toml_check import TomlPlace

AT_ONCE = 64  # limit of concurrent writes to the bucket
SOCKETS = ("socket://", "tcp://")


def read_plant(path: Path) -> tuple[Plant, dict[str, Any]]:
    """Return the plant in a file, and the record of each line by name.

    Raises PlantError for mistakes in the file, and ValueError for a plant that a fleet cannot poll. Each
    port must be a network address. Each line's name must be allowed in a NATS subject. No family may be a
    Python file.
    """
    plant = Plant.load(path)
    document = tomllib.loads(path.read_text("utf-8"))
    for line in plant.lines:
        try:
            names.checked_name("line", line.name)
        except ValueError as mistake:
            raise ValueError(f"{path}: {mistake}") from None
        if not line.port.startswith(SOCKETS):
            raise ValueError(
                f"{path}: line {line.name} has the port {line.port}. A fleet needs a socket:// or tcp:// "
                "port, which every gateway can reach"
            )
        try:
            check_channels(replace(plant, lines=(line,)))
        except PlantError as mistake:
            raise ValueError(
                f"{path}: {mistake}; in a fleet, a channel may only use drives of its own line"
            ) from None
    may = _allowed_commands(document.get("fleet", {}), plant)
    return plant, {table["name"]: _description(table, path.parent, may) for table in document["line"]}


def _allowed_commands(table: Any, plant: Plant) -> dict[str, frozenset[str]]:
    """Return the entries of [fleet.may]: registers and verbs that may be commanded through the fleet."""
    root = TomlPlace.in_file(plant.path)
    place = root.within("[fleet]", "fleet")
    may = place.check(table, FLEET_KEYS).get("may", {})
    inner = root.within("[fleet.may]", "fleet", "may")
    found = allowed(plant, inner.check(may, MAY_KEYS), inner)
    if place.config_errors:
        raise PlantError(tuple(place.config_errors))
    return found


def _description(
    table: Mapping[str, Any], folder: Path, may: Mapping[str, Collection[str]]
) -> dict[str, Any]:
    files: dict[str, str] = {}
    for model in _models(table):
        if model.endswith(".toml"):
            files |= _family_files(folder, model)
    drives = {drive["name"] for drive in table["drive"]}
    own = {
        key: sorted(entry for entry in entries if entry.rpartition(".")[0] in drives)
        for key, entries in may.items()
    }
    lists = {key: entries for key, entries in own.items() if entries}
    return {"line": dict(table), "files": files} | ({"may": lists} if lists else {})


def _models(line: Mapping[str, Any]) -> set[str]:
    """Return the families that a line names. Raises ValueError if one is a Python file."""
    drives = line.get("drive")
    tables = [drive for drive in drives if isinstance(drive, dict)] if isinstance(drives, list) else []
    models = {str(table.get("model")) for table in tables}
    for model in models:
        if ".py" in model:
            raise ValueError(
                f"line {line.get('name')}: the family {model} is a Python file, which gateways of a fleet "
                "do not run. Declare the family in a TOML file"
            )
    return models


def _family_files(folder: Path, model: str) -> dict[str, str]:
    """Return the text of a family's file and of the CSV tables that this file names, by file name."""
    family = (folder / model).resolve()
    text = family.read_text("utf-8")
    found = {model: text}
    for other in family.parent.glob("*.csv"):
        if other.name in text:
            found[str(Path(model).parent / other.name)] = other.read_text("utf-8")
    if any(Path(name).is_absolute() or ".." in Path(name).parts for name in found):
        raise ValueError(f"the family file {model} must be in the plant file's folder, or below it")
    return found


async def store(bucket: Bucket, records: Mapping[str, Any]) -> dict[str, int]:
    """Store these lines as the plant, and return how many are new, changed, removed and unchanged.

    An unchanged line keeps its revision, so it is polled without a break. Raises FleetError if a line
    was changed at the same time, by another `fleet init`.
    """
    follower = Follower(bucket)
    await follower.look()
    before = {name: record for name, record in follower.records.items() if record.value is not None}
    changed = [name for name in records if name in before and before[name].value != records[name]]
    came = [name for name in records if name not in before]
    gone = [name for name in before if name not in records]
    limit = asyncio.Semaphore(AT_ONCE)

    async def put(name: str) -> None:
        async with limit:
            known = follower.records.get(name)
            try:
                await bucket.put(name, records.get(name), known.revision if known else NONE_YET)
            except Conflict:
                raise FleetError(
                    f"the fleet's line {name} has changed in the meantime: run `multidrop fleet init` again"
                ) from None

    await asyncio.gather(*(put(name) for name in (*changed, *came, *gone)))
    kept = len(records) - len(changed) - len(came)
    return {"new": len(came), "changed": len(changed), "removed": len(gone), "kept": kept}


def line_of(record: Record, folder: Path) -> PlantLine:
    """Return the line that a record describes. Its files are written into the line's own folder in `folder`.

    Raises ValueError for an invalid record. Other programs than `fleet init` may have written it, so a Python
    file is refused here too.
    """
    value, home = record.value, folder / record.key
    _models(value["line"])
    home.mkdir(parents=True, exist_ok=True)
    for name, text in value["files"].items():
        path = Path(name)
        if path.is_absolute() or ".." in path.parts:
            raise ValueError(f"line {record.key}: the file {name!r} is outside the line's folder")
        (home / path).parent.mkdir(parents=True, exist_ok=True)
        (home / path).write_text(text, "utf-8")
    plant = home / "line.plant"  # family files never have the suffix `.plant`, so this name is free
    plant.write_text(f"line = [{_toml(value['line'])}]\n", "utf-8")
    return Plant.load(plant).lines[0]


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_toml(str(key))} = {_toml(one)}" for key, one in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (int, float)):
        return repr(value)
    raise ValueError(f"a plant file cannot contain {value!r} of type {type(value).__name__}")
