"""Names of drives and lines: reserved names, and names that differ only in their Unicode form."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Final
from unicodedata import normalize

# Names that would collide with a topic, path, file or key, each with its use.
RESERVED_NAMES: Final[Mapping[str, str]] = {
    "gateway": "the MQTT topic PREFIX/gateway",
    "stop": "the MQTT topic PREFIX/stop, which stops all drives",
    "alarms": "the MQTT topic PREFIX/alarms",
    "act": "the MQTT topic PREFIX/DRIVE/act, which takes verbs",
    "set": "the MQTT topics PREFIX/DRIVE/set/REGISTER, which take writes",
    "available": "the MQTT topic PREFIX/DRIVE/available",
    "told": "the MQTT topic PREFIX/DRIVE/told",
    ".": "this folder, in paths of files and URLs",
    "..": "the folder above, in paths of files and URLs",
    "__proto__": "a key of JavaScript's own, on the gateway's page",
}


def check_drive_name(name: str) -> bool:
    """Return True for a valid name of a drive or a line. Raises ValueError for a reserved or invalid one."""
    if name in RESERVED_NAMES:
        raise ValueError(f'name "{name}" is reserved for {RESERVED_NAMES[name]}; give it another name')
    if name.startswith("-"):
        raise ValueError(f'name "{name}" begins with -, as options of commands do; give it another name')
    return True


def drive_meant(name: str, names: Iterable[str]) -> str:
    """Return the listed name that `name` means.

    That is `name` itself if it is listed, else the only listed name with the same Unicode normal form; else
    return `name`. Use this only for stops and reads: a command that moves a motor must name it exactly.
    """
    names = [*names]
    if name in names:
        return name
    alike = [one for one in names if normalize("NFC", one) == normalize("NFC", name)]
    return alike[0] if len(alike) == 1 else name
