"""Opens a port to listen only: its descriptor cannot write."""

from __future__ import annotations

import errno
import fcntl
import os
import select
import time
from types import TracebackType

from multidrop.core import REFUSALS, Heard, set_settings
from multidrop.errors import LineError
from multidrop.timing import Settings

_REASONS = {
    errno.ENOENT: "there is no such port",
    errno.EACCES: "no permission to open it (is the user in the group that owns it?)",
    errno.EBUSY: "it is in use by another program",
    errno.EAGAIN: "it is in use by another program",
    errno.ENOTTY: "it is not a serial port",
    errno.EISDIR: "it is not a serial port",
}
_MOST = 4096  # bytes read at once
_BAUDRATE = min(REFUSALS)


class Listener:
    """A serial port that is heard and cannot be spoken to; leaving the `with` block closes it.

    Every failure of the port is a LineError.
    """

    def __init__(self, port: str, settings: Settings) -> None:
        if "://" in port:
            raise LineError(port, "only a device such as /dev/ttyUSB0 can be opened so that nothing is sent")
        self.port = port
        self._character_ns = round(settings.character * 1e9)
        self._pause_ns = round(settings.t3_5 * 1e9)
        self._last_ns = 0
        self.heard = Heard()
        try:
            self._fd = os.open(port, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
        except OSError as failure:
            raise self._lost(failure) from failure
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._set(settings)
        except OSError as failure:
            os.close(self._fd)
            raise failure if isinstance(failure, LineError) else self._lost(failure) from failure

    def _set(self, settings: Settings) -> None:
        refused = set_settings(self._fd, settings.baudrate, settings.format)
        if os.ttyname(self._fd).startswith(("/dev/pts/", "/dev/ttys")):
            refused &= _BAUDRATE  # a pty stays at 8 bits without parity whatever it is told
        if refused:
            names = ", ".join(name for bit, name in REFUSALS.items() if refused & bit)
            raise LineError(self.port, f"the port does not take the {names} of {settings}")

    def _lost(self, failure: OSError) -> LineError:
        reason = _REASONS.get(failure.errno or 0) or failure.strerror or str(failure)
        return LineError(self.port, reason)

    def hear(self, seconds: float) -> int:
        """Wait at most so long for bytes and hear them; how many came."""
        if not select.select([self._fd], [], [], seconds)[0]:
            return 0
        try:
            received = os.read(self._fd, _MOST)
        except BlockingIOError:
            return 0
        except OSError as failure:
            raise LineError(self.port, f"the port was lost ({failure.strerror})") from failure
        if not received:
            raise LineError(self.port, "the port was lost (hung up)")
        now_ns = time.time_ns()
        begun_ns = max(self._last_ns, now_ns - len(received) * self._character_ns)
        after_pause = begun_ns - self._last_ns >= self._pause_ns
        self.heard.put(received, begun_ns, after_pause=after_pause)
        self._last_ns = now_ns
        return len(received)

    def fileno(self) -> int:
        return self._fd

    def close(self) -> None:
        os.close(self._fd)

    def __enter__(self) -> Listener:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
