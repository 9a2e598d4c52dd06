"""Back off from drives that stay silent, so that they cost the others little. Time comes in, in ns.

A silent drive rests longer each time. After each rest it gets its shortest request, in the others' spare
time or in the share of jobs without a period; all silent drives together cost a small part of the line. With
its first reply it is back, and the next silent one is tried at once: both may have been without power. A new
drive, which has never answered, gets one request, and no other before the outcome of that is known; without
a reply it rests at once. Once all new drives have had their request and few were silent, these get another.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

SILENT_AFTER = 2  # failures in a row
FIRST_REST_NS = 500_000_000
LONGEST_REST_NS = 2_000_000_000
SILENT_SHARE = 0.015  # of the line, for requests to silent drives
SECOND_COST_NS = 400_000_000  # at most, of a second request to new drives: a reply may have been lost


@dataclass
class Health:
    """One drive's failures and rest."""

    is_new: bool = False  # it has never answered
    is_pending: bool = False  # only of a new drive: its request has no outcome yet
    failures: int = 0
    late_until_ns: int = 0
    rest_ns: int = 0
    asleep_until_ns: int = 0
    cost_ns: int = 0  # of a request without a reply


@dataclass
class BackOff:
    """The health of all drives on a line, by address; `begin_rest` is called at the start of each rest."""

    begin_rest: Callable[[int, int], None]  # with drive and time
    health: dict[int, Health] = field(default_factory=dict)
    has_silent: bool = False  # or new drives
    _late_until_ns: int = 0  # of all drives

    def meet(self, drive: int) -> None:
        """Treat a drive as new: it may not be there."""
        self.health[drive].is_new = self.has_silent = True

    def forget(self, drive: int) -> None:
        """Forget a drive that has no job left."""
        self.health.pop(drive, None)

    def conclude(self, drive: int) -> None:
        """Note that a request to this drive has ended, with any outcome."""
        if drive in self.health:
            self.health[drive].is_pending = False

    def may_sleep(self, at_ns: int) -> bool:
        """Return True where any drive may be asleep."""
        return self.has_silent or at_ns < self._late_until_ns

    def is_asleep(self, drive: int, at_ns: int) -> bool:
        health = self.health[drive]
        return health.rest_ns > 0 or at_ns < max(health.asleep_until_ns, health.late_until_ns)

    def wake(self, at_ns: int) -> int | None:
        """Return a drive whose rest is over; it rests again until the outcome of its request is known."""
        for drive, health in self.health.items():
            if health.rest_ns and at_ns >= health.asleep_until_ns and not health.is_pending:
                health.asleep_until_ns = at_ns + health.rest_ns
                return drive
        return None

    def observe(
        self,
        drive: int,
        failures: int,
        now_ns: int,
        *,
        late_until_ns: int,
        cost_ns: int,
        has_answered: bool = True,
    ) -> None:
        """Note a drive's failures in a row, and the cost of its next request without a reply.

        Until `late_until_ns` its reply to an earlier request may come, so it gets none, even if it has
        answered since. When that reply has come, late as it is, the drive can be tried at once.
        """
        health = self.health[drive]
        has_answered_late = late_until_ns < health.late_until_ns
        has_changed = failures != health.failures
        health.failures, health.late_until_ns, health.cost_ns = failures, late_until_ns, cost_ns
        health.is_new &= not has_answered
        if has_changed and failures:
            self._rest(drive, now_ns)
        elif has_changed:
            if health.rest_ns:
                self._wake_next(drive, now_ns)
            health.rest_ns = health.asleep_until_ns = 0
        elif has_answered_late:
            health.asleep_until_ns = now_ns
        if self.has_silent:
            self._try_new_again(now_ns)
        self.has_silent = any(health.failures or health.is_new for health in self.health.values())
        self._late_until_ns = max(health.late_until_ns for health in self.health.values())

    def _rest(self, drive: int, now_ns: int) -> None:
        health = self.health[drive]
        if health.failures >= (1 if health.is_new else SILENT_AFTER):
            health.rest_ns = min(max(2 * health.rest_ns, FIRST_REST_NS), LONGEST_REST_NS)
        rest_ns = max(health.rest_ns, self._fair_rest_ns()) if health.rest_ns else 0
        health.asleep_until_ns = max(health.late_until_ns, now_ns + rest_ns)
        if rest_ns:
            self.begin_rest(drive, now_ns)

    def _fair_rest_ns(self) -> int:
        """Return the rest that keeps all silent drives together within their share."""
        return round(sum(health.cost_ns for health in self.health.values() if health.rest_ns) / SILENT_SHARE)

    def _wake_next(self, drive: int, now_ns: int) -> None:
        """End the rest of one more drive, because this one is back."""
        resting = [health for number, health in self.health.items() if health.rest_ns and number != drive]
        if resting:
            first = min(resting, key=lambda health: health.asleep_until_ns)
            first.asleep_until_ns = min(first.asleep_until_ns, max(now_ns, first.late_until_ns))

    def _try_new_again(self, now_ns: int) -> None:
        """End the rest of new drives once each has had its first request and few are silent."""
        new = [health for health in self.health.values() if health.is_new]
        silent = [health for health in new if health.failures == 1]
        if all(health.failures for health in new) and sum(each.cost_ns for each in silent) <= SECOND_COST_NS:
            for health in silent:
                health.asleep_until_ns = max(now_ns, health.late_until_ns)
