"""Mark ports with simulated drives, so that clients do not count those drives' writes as EEPROM wear.

On Linux, a simulator binds a name for each of its ports (an abstract Unix address, see unix(7)).
The kernel removes the name when the process ends, even by SIGKILL. Other systems have no such names, so a
simulated drive's writes are counted there like those of a real drive.
"""

from __future__ import annotations

import os
import socket
import sys
from contextlib import suppress
from pathlib import Path
from urllib.parse import quote

_HAS_NAMES = sys.platform == "linux"


def _name(identity: str) -> bytes:
    return b"\0multidrop/simulated/%d/%s" % (os.getuid(), identity.encode()[-60:])


def ledger_of(identity: str, directory: Path) -> Path:
    """Return the path of a simulated port's EEPROM ledger, kept while its simulator runs."""
    return directory / "simulated" / f"{quote(identity, safe='')}.sqlite"


class SimulatedPort:
    """The mark of a simulated port. Creating and closing the mark delete the port's EEPROM ledger."""

    def __init__(self, identity: str, directory: Path) -> None:
        self._ledger = ledger_of(identity, directory)
        self._holder: socket.socket | None = None
        self._forget_writes()
        if _HAS_NAMES:
            self._holder = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            with suppress(OSError):  # another simulator has marked a port of the same name
                self._holder.bind(_name(identity))

    def _forget_writes(self) -> None:
        with suppress(OSError):
            self._ledger.unlink(missing_ok=True)

    def close(self) -> None:
        if self._holder is not None:
            self._holder.close()
        self._forget_writes()


def is_simulated(identity: str) -> bool:
    """Return True while a simulator of this user has marked this port."""
    if not _HAS_NAMES:
        return False
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as asking:
        try:
            asking.connect(_name(identity))
        except OSError:
            return False
    return True
