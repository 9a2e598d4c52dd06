"""Acquaintance: whether the drive at an address is of its family, found out before the first write."""

from __future__ import annotations

from contextlib import suppress

from multidrop.drive import Drive, Read, Step, Wait, carry_out
from multidrop.errors import BadReply, DriveRefused, NoReply, Refused
from multidrop.exchanges import READ_ATTEMPTS, Exchanges
from multidrop.line import sleep


class Acquaintance:
    """Which drives were looked at, each on the port as it was opened last."""

    def __init__(self, exchanges: Exchanges) -> None:
        self._exchanges = exchanges
        self._known: dict[Drive, object] = {}  # the open port on which it was found to be of its family
        self._unheard: dict[Drive, object] = {}  # or on which it did not answer a glance

    def is_known(self, drive: Drive) -> bool:
        return self._known.get(drive, self) is self._exchanges.line.queue

    def forget(self, drive: Drive) -> None:
        self._known.pop(drive, None)
        self._unheard.pop(drive, None)

    def make(self, drive: Drive, attempts: int = READ_ATTEMPTS) -> None:
        """Look, once; Refused when it is of another family, NoReply when it cannot be heard.

        At least one value is read, so that a line on which an adapter echoes is known to do so before
        a write could take its echo for the drive's confirmation. After the port was opened anew it is
        done again, because something else may be on it.
        """
        if self.is_known(drive):
            return

        def look(step: Step) -> object:
            if isinstance(step, Wait):
                return sleep(step.seconds)
            if not isinstance(step, Read):
                raise Refused(f"{drive.name}: a look at its identity must not write")
            return self._exchanges.values(drive, [step.register], attempts)[step.register.name]

        try:
            carry_out(drive.identify.script(), look)
        except DriveRefused as refusal:
            kind = drive.title or type(drive).__name__
            raise Refused(
                f"nothing is written to {drive.name}: it refuses what every {kind} answers ({refusal})",
                rule="it does not look like its family",
            ) from refusal
        if not self._exchanges.is_heard(drive):
            self._read_something(drive, attempts)
        self._known[drive] = self._exchanges.line.queue

    def _read_something(self, drive: Drive, attempts: int) -> None:
        register = drive.telling or next((it for it in drive.registers.values() if it.readable), None)
        if register is not None:
            with suppress(DriveRefused):  # an answer too
                self._exchanges.values(drive, [register], attempts)

    def tell_echo(self, drive: Drive) -> None:
        """Read once, so that the line learns whether what it heard was its adapter's echo.

        Another client that asks the same seems to be one: then the drive's confirmations of writes, which
        are copies too, would not count, until something is read.
        """
        with suppress(NoReply, BadReply):
            self._read_something(drive, 1)

    def glance(self, drive: Drive) -> None:
        """Before a stop, which is sent to a drive that cannot be heard too: it is asked once, at first."""
        if self._unheard.get(drive, self) is self._exchanges.line.queue:
            return
        try:
            self.make(drive, 1)
        except (NoReply, BadReply):
            self._unheard[drive] = self._exchanges.line.queue
