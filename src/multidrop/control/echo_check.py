"""EchoCheck: distinguishes a drive's confirmation of a write from its adapter's echo.

Many confirmations are copies of their requests, and so is an echo.
"""

from __future__ import annotations

from contextlib import suppress

from multidrop.drive.family import Drive
from multidrop.errors import BadReply, DriveException, LineError, NoReply, NotAttached, NotMaster, NoValue
from multidrop.transport.exchange import READ_ATTEMPTS, WRITE_TIMEOUT, Exchanges


class EchoCheck:
    """Reads from drives that show whether the line's adapter repeats what it sends."""

    def __init__(self, exchanges: Exchanges) -> None:
        self._exchanges = exchanges

    def read_any(self, drive: Drive, attempts: int, *, insists: bool = False, timeout: float = 0.0) -> None:
        """Read one register, whose reply is no copy of its request; an exception is a reply too."""
        readable = (register for register in drive.registers.values() if register.readable)
        register = drive.echo_probe or next(readable, None)
        if register is not None:
            with suppress(DriveException, NoValue):
                self._exchanges.values(drive, [register], attempts, insists=insists, timeout=timeout)

    def probe(self, drive: Drive, *, insists: bool = False) -> None:
        """Read once, so that the line learns whether the copy of a request was its adapter's echo.

        Another client that asks the same seems to be one: then the drive's confirmations of writes, which
        are copies too, would not count, until something is read.
        """
        with suppress(NoReply, BadReply, LineError, NotAttached, NotMaster):
            self.read_any(drive, 1, insists=insists, timeout=WRITE_TIMEOUT)

    def why_doubtful(self, drive: Drive) -> str:
        """Return why a reply that is a copy of its request may be the adapter's echo; "" where it is not.

        An echo may begin at any time, and the drive may be dead: so something must be read after the write.
        Where the adapter is known to echo, the core has distinguished the two.
        """
        line = self._exchanges.line
        if line.has_echo:
            return ""
        try:
            self.read_any(drive, READ_ATTEMPTS)
        except (NoReply, BadReply, LineError, NotAttached, NotMaster) as failure:
            return f"the reply may be the adapter's echo, for nothing was heard of the drive since: {failure}"
        return "the reply was the adapter's echo" if line.has_echo else ""
