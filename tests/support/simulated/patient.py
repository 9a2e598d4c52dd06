"""Lengthen the library's timeouts for busy test machines; not for tests with silent drives.

`python patient.py PROGRAM ARGUMENTS` runs a Python program with the longer timeouts.
"""

from __future__ import annotations

import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from multidrop import bus
from multidrop.core import Peer
from multidrop.transport import drive_records

PATIENCE = 60.0  # s; each shorter timeout of the library is replaced by this one


def patient_peer(*, interval: float, **timeouts: float) -> Peer:
    """Return a `Peer` for a drive as the library does, but with longer timeouts."""
    return Peer(interval=interval, **{name: max(one, PATIENCE) for name, one in timeouts.items()})


def be_patient(set_attribute: Callable[..., None], set_item: Callable[..., None]) -> None:
    """Lengthen the timeouts of drives and writes, with functions like monkeypatch.setattr and .setitem."""
    set_attribute(drive_records, "Peer", patient_peer)
    await_turns(set_attribute, set_item)


def await_turns(set_attribute: Callable[..., None], set_item: Callable[..., None]) -> None:
    """Lengthen only the expiry of writes, for tests with silent drives."""
    defaults: dict[str, Any] = bus.Bus.__init__.__kwdefaults__
    set_attribute(bus, "EXPIRY", PATIENCE)
    set_item(defaults, "expiry", PATIENCE)


if __name__ == "__main__":
    be_patient(setattr, dict.__setitem__)
    sys.argv.pop(0)
    sys.path[0] = str(Path(sys.argv[0]).parent)
    runpy.run_path(sys.argv[0], run_name="__main__")
