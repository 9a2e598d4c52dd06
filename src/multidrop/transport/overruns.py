"""Characters that came too fast for a serial port, as its driver counts them."""

from __future__ import annotations

import struct
import sys

# struct serial_icounter_struct of linux/serial.h
_TIOCGICOUNT = 0x545D
_ICOUNTER = struct.Struct("20i")
_OVERRUN, _BUF_OVERRUN = 7, 10


def overruns(fd: int) -> int:
    """Return how many since the driver was loaded; OSError where it does not count them."""
    if sys.platform != "linux":
        raise OSError("Linux alone counts them")
    import fcntl  # which Windows lacks

    counts = bytearray(_ICOUNTER.size)
    fcntl.ioctl(fd, _TIOCGICOUNT, counts)
    found = _ICOUNTER.unpack(counts)
    return int(found[_OVERRUN] + found[_BUF_OVERRUN])
