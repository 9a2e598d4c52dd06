"""Standstill: refuse writes that may have waited while the gateway stood still, such as during a sleep of the
computer.

Requests over Modbus have no time of their own.
"""

from __future__ import annotations

from collections.abc import Callable

from multidrop import WriteForbidden
from multidrop.gateway.clock import boottime_ns
from multidrop.gateway.commands import MOST_AGE_S

SETTLE_S = 1.0  # after a standstill: how long writes are refused, until all waiting requests are received
STOOD_STILL = "the gateway stood still"  # value of WriteForbidden.rule


class Standstill:
    """The last time at which the gateway is known to have run, and the end of its last standstill.

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
