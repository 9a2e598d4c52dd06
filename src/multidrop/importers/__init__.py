"""Importers: register tables of other programs become family files, with gaps marked and no verb."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from multidrop.importers.csv_tables import read_table
from multidrop.importers.device import ImportedDevice
from multidrop.importers.family_text import family_text, plant_text
from multidrop.importers.home_assistant import read_home_assistant
from multidrop.importers.sunspec import is_sunspec, read_sunspec
from multidrop.importers.telegraf import read_telegraf
from multidrop.importers.wb import read_wb
from multidrop.toml_check import parse_document

__all__ = ["ImportedDevice", "family_text", "plant_text", "read_devices"]

MOST_BYTES = 5_000_000


def read_devices(path: Path) -> list[ImportedDevice]:
    """Return the devices of a file, which its suffix and its contents tell apart.

    Raises ValueError for what is no such file, ImportError for YAML without PyYAML.
    """
    data = path.read_bytes()
    if len(data) > MOST_BYTES:
        raise ValueError(f"{path} has more than {MOST_BYTES} bytes")
    read = _READERS.get(path.suffix.lower())
    if read is None:
        raise ValueError(f"{path}: its suffix is none of {', '.join(_READERS)}")
    try:
        devices = read(data, path)
    except (KeyError, AttributeError, TypeError, RecursionError) as failure:
        raise ValueError(f"{path} is not laid out as its kind of file is: {failure!r}") from failure
    except ValueError as mistake:
        raise ValueError(f"{path}: {mistake}") from mistake
    found = [device for device in devices if device.registers or device.texts]
    if not found:
        lost = [sentence for device in devices for sentence in device.lost]
        why = f": {lost[0]}" if lost else ""
        raise ValueError(f"{path} has no register that can be imported{why}")
    return found


def _table(data: bytes, path: Path) -> list[ImportedDevice]:
    return read_table(_text(data), path.stem)


def _yaml(data: bytes, path: Path) -> list[ImportedDevice]:
    return read_home_assistant(_text(data))


def _toml(data: bytes, path: Path) -> list[ImportedDevice]:
    document = parse_document(data)
    if "family" in document:
        raise ValueError("is a family's file already: see `multidrop check`")
    return read_telegraf(document)


def _json(data: bytes, path: Path) -> list[ImportedDevice]:
    document: Any = json.loads(_text(data))
    return read_sunspec(document) if is_sunspec(document) else read_wb(document)


def _text(data: bytes) -> str:
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as failure:
        raise ValueError(f"is not text in UTF-8, from byte {failure.start} on") from failure


_READERS: Mapping[str, Callable[[bytes, Path], list[ImportedDevice]]] = {
    ".csv": _table,
    ".tsv": _table,
    ".yaml": _yaml,
    ".yml": _yaml,
    ".toml": _toml,
    ".conf": _toml,
    ".json": _json,
}
