"""Locks on files that end with their process."""

from __future__ import annotations

import os
import uuid
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from multidrop.fleet.errors import FleetError


def lock(file: int) -> None:
    """Lock an open file for this process alone. Raises BlockingIOError while another one has it."""
    import fcntl  # which Windows lacks

    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


IDS = (Path("/etc/machine-id"), Path("/proc/sys/kernel/random/boot_id"))


class LifeLock:
    """A lock on a local file, held for life: who gets it knows that the one before has died.

    The file has a random id of its own: containers may have the same machine's id and the same path.
    Raises FleetError when another process of this machine holds it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.resolve()
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("a+b")
        try:
            lock(self._file.fileno())
        except OSError:
            self._file.close()
            sentence = f"another gateway of this machine runs with {path}; end that one first"
            raise FleetError(sentence) from None
        self._file.seek(0)
        self.id = self._file.read().decode("ascii", "replace").strip()
        if not self.id:
            self.id = uuid.uuid4().hex
            self._file.write(self.id.encode())
            self._file.flush()
            os.fsync(self._file.fileno())

    def proves_death(self, value: Mapping[str, Any]) -> bool:
        """Say whether a record is of a process that held this very lock, and so is dead."""
        mine = (str(self.path), self.id, machine_id())
        return "" not in mine and (value.get("lock"), value.get("lock_id"), value.get("machine")) == mine

    def close(self) -> None:
        self._file.close()


def machine_id() -> str:
    """Return an id of this machine since it was started; "" where it has none, which proves nothing.

    Copies of a disk have the machine's own id in common, and the lock's file with its id too. Who finds a
    record of another boot waits: after a real one the lease has run out anyway.
    """
    with suppress(OSError):
        ids = [path.read_text("utf-8", "replace").strip() for path in IDS]
        return ".".join(ids) if all(ids) else ""
    return ""
