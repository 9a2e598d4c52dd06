"""Standstill: refuse Modbus writes that may have waited while the gateway did not run.

The computer may have slept, for example. A Modbus request contains no time, so its age is unknown.
"""

from __future__ import annotations

from collections.abc import Callable

from multidrop import WriteForbidden
from multidrop.gateway.clock import boottime_ns
from multidrop.gateway.commands import MOST_AGE_S

SETTLE_S = 1.0  # how long writes are refused after a standstill, until the waiting requests are read
STOOD_STILL = "the gateway stood still"  # value of WriteForbidden.rule


class Standstill:
    """Detects that the gateway did not run for more than MOST_AGE_S; then refuses writes for SETTLE_S.

    `clock` returns CLOCK_BOOTTIME in ns.
    """

    def __init__(self, clock: Callable[[], int] = boottime_ns) -> None:
        self._clock = clock
        self._ran_ns = clock()
        self._until_ns = 0  # writes are refused until this time

    def note(self) -> None:
        """Note that the event loop runs. Call this at least once a second."""
        now_ns = self._clock()
        if now_ns - self._ran_ns > MOST_AGE_S * 1e9:
            self._until_ns = now_ns + round(SETTLE_S * 1e9)
        self._ran_ns = now_ns

    def admit(self, what: str) -> float:
        """Return the deadline for sending a write that is received now (CLOCK_BOOTTIME, ns).

        Raises WriteForbidden after a standstill.
        """
        self.note()
        if self._ran_ns < self._until_ns:
            reason = f"it may be older than {MOST_AGE_S:g} s, because {STOOD_STILL}"
            raise WriteForbidden(f"{what} was not sent: {reason}", rule=STOOD_STILL)
        return self._ran_ns + MOST_AGE_S * 1e9
