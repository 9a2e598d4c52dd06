"""UnopenedLines: lines whose port this gateway cannot open, so that other gateways may try. No I/O.

A gateway that is cut off from a line, but not from the servers, reports the line in its lease record after
some failures. The line is then assigned to a gateway that has not reported it. From time to time, a gateway
withdraws its report of one line, as a trial. The gateway then gets the line back, but cannot poll it if the
port still cannot be opened. So after each failed trial, the wait for the next trial is longer. If all
gateways have reported a line, no gateway polls it. Its trials then cost nothing, so they stay frequent.
"""

from __future__ import annotations

from collections.abc import Callable

from multidrop.fleet.leases.rules import SECOND

OPENINGS = 3  # number of failed attempts to open a line before the line is reported
LOST_NS = 6 * SECOND  # a lost port is reported this long after the last reply
REPLY_NS = 3 * SECOND  # a newest reply that is older than this does not show when the port was lost
FIRST_WAIT_NS, LAST_WAIT_NS = 120 * SECOND, 24 * 3600 * SECOND  # first and longest wait before a trial
TRIAL_NS = 60 * SECOND  # if the line does not come back within this time, its trial ends
MOST_BYTES = 8_000  # limit, in bytes, of all line names in a lease record


class UnopenedLines:
    """The lines that other gateways should take. `clock` returns ns.

    Only as many lines are reported as fit into a lease record. This gateway retries the others itself.
    """

    def __init__(self, clock: Callable[[], int]) -> None:
        self.hopeless: frozenset[str] = frozenset()  # lines that all gateways have reported
        self.home: frozenset[str] | None = None  # our share if all ports could be opened; None: unknown
        self._clock = clock
        self._failures: dict[str, int] = {}
        self._lost_since: dict[str, int] = {}
        self._named: dict[str, None] = {}  # reported lines, in the order in which they will be tried
        self._wait_ns = FIRST_WAIT_NS
        self._trial_at = 0
        self._tried = ""
        self._tried_since = 0

    def failed(self, line: str) -> None:
        """Count a failed attempt to open the line's port; report the line after OPENINGS failures."""
        self._failures[line] = self._failures.get(line, 0) + 1
        if self._failures[line] >= OPENINGS:
            self._name(line)

    def lost(self, line: str, silent_ns: int | None = None) -> None:
        """Note that the port of a polled line is lost; report the line when LOST_NS have passed.

        `silent_ns` is the age of the newest reply on the line. LOST_NS starts at that reply, because in a
        network that drops everything, writes and connection attempts fail only after seconds. If `silent_ns`
        is None or large, LOST_NS starts at the first call.
        """
        now = self._clock()
        since = now - silent_ns if silent_ns is not None and silent_ns <= REPLY_NS else now
        if now - self._lost_since.setdefault(line, since) >= LOST_NS:
            self._name(line)

    def opened(self, line: str) -> None:
        """Note that the line's port is open; withdraw its report."""
        self._failures.pop(line, None)
        self._lost_since.pop(line, None)
        self._named.pop(line, None)
        if line == self._tried:  # the network is back: try the other reported lines immediately
            self._tried, self._wait_ns, self._trial_at = "", FIRST_WAIT_NS, self._clock()
            for other in self._named.keys() - (self._named.keys() if self.home is None else self.home):
                # the other line is not assigned to us, so a trial would not return it to us
                del self._named[other]

    def gone(self, line: str) -> None:
        """Forget the line's failures, because it is no longer ours."""
        self._failures.pop(line, None)
        self._lost_since.pop(line, None)

    def named(self) -> frozenset[str]:
        """Return the lines that other gateways should take.

        Call this often, because each call may start a trial.
        """
        now = self._clock()
        if self._tried and now - self._tried_since >= TRIAL_NS:
            self._tried = ""
        hopeless = [line for line in self._named if line in self.hopeless]
        trial_at = min(self._trial_at, self._tried_since + FIRST_WAIT_NS) if hopeless else self._trial_at
        home = [line for line in self._named if self.home is None or line in self.home]
        if self._named and not self._tried and now >= trial_at:
            self._tried, self._tried_since = next(iter(hopeless or home or self._named)), now
            del self._named[self._tried]
            self._trial_at = now + self._wait_ns
        return frozenset(self._named)

    def _name(self, line: str) -> None:
        now = self._clock()
        if line in self._named or sum(len(one) + 4 for one in (*self._named, line)) > MOST_BYTES:
            return
        if line == self._tried:
            self._tried, self._wait_ns = "", min(2 * self._wait_ns, LAST_WAIT_NS)
            self._trial_at = now + self._wait_ns
        elif not self._named and not self._tried:
            self._trial_at, self._tried_since = now + self._wait_ns, now
        self._named[line] = None
