"""Convert register tables of other programs into family files.

In the family file, a comment "gap: ..." marks each property of a register that the table does not state.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from multidrop.importers.csv_tables import read_table
from multidrop.importers.device import ImportedDevice, drop_undeclarable, family_text, plant_text
from multidrop.importers.esphome import is_esphome, read_esphome
from multidrop.importers.home_assistant import read_home_assistant
from multidrop.importers.parsing import parse_yaml
from multidrop.importers.sunspec import is_sunspec, read_sunspec
from multidrop.importers.telegraf import read_telegraf
from multidrop.importers.wb import json_without_comments, read_wb
from multidrop.printable import printable
from multidrop.toml_document import DocumentError, parse_document, read_bounded

__all__ = ["SUFFIXES", "ImportedDevice", "all_devices", "family_text", "plant_text", "read_devices"]

MOST_BYTES = 5_000_000
MOST_REASONS = 3  # limit of reasons in one error


def read_devices(path: Path) -> list[ImportedDevice]:
    """Return the devices in another program's file. Suffix and contents of the file show its format.

    The family file of each device is loadable. Raises ValueError if the format is unknown or no register can
    be imported, and ImportError for YAML if PyYAML is missing.
    """
    devices = all_devices(path)
    found = [device for device in devices if device.registers or device.texts]
    if not found:
        lost = sorted((lost for device in devices for lost in device.lost), key=lambda one: not one.is_entry)
        reasons = "; ".join(printable(str(one))[:200] for one in lost[:MOST_REASONS])
        more = f"; and {len(lost) - MOST_REASONS} more" if len(lost) > MOST_REASONS else ""
        raise ValueError(
            f"{path} has no register that can be imported: {reasons or 'the file is empty'}{more}"
        )
    _make_titles_unique(found, path.stem)
    return found


def _make_titles_unique(devices: list[ImportedDevice], stem: str) -> None:
    """Change titles until no two devices with the same address have the same title."""
    for device in devices:
        device.title = device.title or stem
    addresses = Counter(device.address for device in devices)
    titles = Counter(device.title for device in devices)
    given = Counter[str]()
    for device in devices:
        spelt = device.title
        if titles[spelt] > 1 and (addresses[device.address] > 1 or device.address is None):
            given[spelt] += 1
            device.title = f"{spelt} {given[spelt]}" if given[spelt] > 1 else spelt


def all_devices(path: Path) -> list[ImportedDevice]:
    """Return all devices, including those without a register that can be imported.

    Errors as in `read_devices`.
    """
    read = _READERS.get(path.suffix.lower())
    if read is None:
        raise ValueError(f"{path}: the file's suffix is not one of {', '.join(_READERS)}")
    try:
        devices = read(read_bounded(path, MOST_BYTES, "file"), path)
        for device in devices:
            drop_undeclarable(device)
    except KeyError as missing:
        key = printable(str(missing.args[0]))[:200]
        raise ValueError(
            f"{path} is not a file of a supported program: the key or column {key} is missing"
        ) from missing
    except (AttributeError, TypeError, IndexError, OverflowError, RecursionError) as failure:
        kind = f"{type(failure).__name__} {printable(str(failure))[:200]}"
        raise ValueError(f"{path} is not a file of a supported program: {kind}") from failure
    except DocumentError as mistake:
        raise ValueError(printable(mistake.in_file(path))) from mistake
    except ValueError as mistake:
        raise ValueError(f"{path}: {printable(str(mistake))[:1000]}") from mistake
    return devices


def _table(data: bytes, path: Path) -> list[ImportedDevice]:
    return read_table(_text(data), path.stem)


def _yaml(data: bytes, path: Path) -> list[ImportedDevice]:
    document = parse_yaml(_text(data))
    return read_esphome(document) if is_esphome(document) else read_home_assistant(document)


def _toml(data: bytes, path: Path) -> list[ImportedDevice]:
    return read_telegraf(parse_document(data))


def _json(data: bytes, path: Path) -> list[ImportedDevice]:
    document: Any = json.loads(json_without_comments(_text(data)))
    return read_sunspec(document) if is_sunspec(document) else read_wb(document)


def _text(data: bytes) -> str:
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as failure:
        raise ValueError(f"the file is not text in UTF-8, from byte {failure.start} on") from failure


_READERS: Mapping[str, Callable[[bytes, Path], list[ImportedDevice]]] = {
    ".csv": _table,
    ".tsv": _table,
    ".yaml": _yaml,
    ".yml": _yaml,
    ".toml": _toml,
    ".conf": _toml,
    ".json": _json,
}
SUFFIXES = tuple(_READERS)
