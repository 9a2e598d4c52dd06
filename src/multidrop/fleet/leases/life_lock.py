"""LifeLock: a file lock that shows a gateway that its previous process on this computer is dead."""

from __future__ import annotations

import os
import uuid
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from multidrop.fleet.errors import FleetError
from multidrop.recording import FileLock

IDS = (Path("/etc/machine-id"), Path("/proc/sys/kernel/random/boot_id"))


class LifeLock:
    """A lock on a local file, held until the process ends. Its next holder knows that this process is dead.

    The file holds a random id, because containers may share the machine id and the path. Raises FleetError if
    another process of this computer holds the lock.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.resolve()
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            self._lock = FileLock(path)
        except BlockingIOError:
            sentence = f"another gateway of this machine uses {path}; stop that one first"
            raise FleetError(sentence) from None
        self.id = path.read_text("ascii", "replace").strip()
        if not self.id:
            self.id = uuid.uuid4().hex
            with path.open("w", encoding="ascii") as file:
                file.write(self.id)
                file.flush()
                os.fsync(file.fileno())

    def proves_death(self, value: Mapping[str, Any]) -> bool:
        """Return True if this record's process held exactly this lock file, and is dead therefore."""
        mine = (str(self.path), self.id, machine_id())
        return "" not in mine and (value.get("lock"), value.get("lock_id"), value.get("machine")) == mine

    def close(self) -> None:
        self._lock.close()


def machine_id() -> str:
    """Return an id of this computer's present boot; "" if it is unknown, which never proves a death.

    Computers with copies of one disk have the same machine id and the same lock file, but different boot ids.
    After a reboot, a gateway waits until the lease in its earlier record has expired.
    """
    with suppress(OSError):
        ids = [path.read_text("utf-8", "replace").strip() for path in IDS]
        return ".".join(ids) if all(ids) else ""
    return ""
