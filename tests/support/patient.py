"""Wait for every drive and every turn however busy the machine is; not for tests in which one is silent.

`python patient.py PROGRAM ARGUMENTS` runs a program so.
"""

from __future__ import annotations

import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from multidrop import bus
from multidrop.core import Peer
from multidrop.transport import peers

PATIENCE = 60.0  # s


def patient_peer(*, interval: float, **timeouts: float) -> Peer:
    """Return what the library makes for a drive, with longer time-outs."""
    return Peer(interval=interval, **{name: max(one, PATIENCE) for name, one in timeouts.items()})


def be_patient(set_attribute: Callable[..., None], set_item: Callable[..., None]) -> None:
    """Wait for every drive, and for every write's turn: the given functions change what the library has."""
    set_attribute(peers, "Peer", patient_peer)
    await_turns(set_attribute, set_item)


def await_turns(set_attribute: Callable[..., None], set_item: Callable[..., None]) -> None:
    """Wait for every write's turn alone: for tests in which a drive may be silent."""
    defaults: dict[str, Any] = bus.Bus.__init__.__kwdefaults__
    set_attribute(bus, "EXPIRY", PATIENCE)
    set_item(defaults, "expiry", PATIENCE)


if __name__ == "__main__":
    be_patient(setattr, dict.__setitem__)
    sys.argv.pop(0)
    sys.path[0] = str(Path(sys.argv[0]).parent)
    runpy.run_path(sys.argv[0], run_name="__main__")
