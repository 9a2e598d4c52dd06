"""Wait for every drive however busy the machine is; not for tests in which one is silent.

`python patient.py PROGRAM ARGUMENTS` runs a program so.
"""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

from multidrop.core import Peer

PATIENCE = 60.0  # s


def patient_peer(*, interval: float, **timeouts: float) -> Peer:
    """Return what the library makes for a drive, with longer time-outs."""
    return Peer(interval=interval, **{name: max(one, PATIENCE) for name, one in timeouts.items()})


if __name__ == "__main__":
    from multidrop.transport import exchange

    exchange.Peer = patient_peer
    sys.argv.pop(0)
    sys.path[0] = str(Path(sys.argv[0]).parent)
    runpy.run_path(sys.argv[0], run_name="__main__")
