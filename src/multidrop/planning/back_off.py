"""Back off from silent drives, so that other drives lose little time. Callers pass the time, in ns.

A silent drive rests (gets no request) for longer each time. After each rest it gets its shortest request, in
spare time or in the line time of jobs without a period. All silent drives together take only a small share of
the line. Only the first rest of a drive that has answered before is short in any case, because the drive may
have missed two requests by chance. When a silent drive replies, its rests end. The next silent drive is then
tried immediately, because both may have been without power. A new drive, which has never answered, gets one
request and no other until the outcome is known; without a reply it rests immediately. Once all new drives
have had their first request, the silent ones get a second request if they are few.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

SILENT_AFTER = 2  # number of consecutive failures after which a drive rests
FIRST_REST_NS = 500_000_000
LONGEST_REST_NS = 2_000_000_000
SILENT_SHARE = 0.015  # share of the line's time for requests to silent drives
SECOND_COST_NS = 400_000_000  # limit of the line time for second requests to all silent new drives


@dataclass
class Health:
    """A drive's failures, and its rest (the time in which it gets no request)."""

    is_new: bool = False  # the drive has never answered
    is_pending: bool = False  # the drive is new, and the outcome of its request is not known yet
    failures: int = 0
    late_until_ns: int = 0
    rest_ns: int = 0
    asleep_until_ns: int = 0
    cost_ns: int = 0  # line time of a request without a reply


@dataclass
class BackOff:
    """The health of all drives on a line, by address. `begin_rest` is called when a drive's rest starts."""

    begin_rest: Callable[[int, int], None]  # its arguments: the drive's address, and the time
    health: dict[int, Health] = field(default_factory=dict)
    has_silent: bool = False  # True if any drive is new, or did not answer its last request
    _late_until_ns: int = 0  # the latest `late_until_ns` of all drives

    def meet(self, drive: int) -> None:
        """Treat a drive as new: it may be absent, so it gets only one request until the outcome is known."""
        self.health[drive].is_new = self.has_silent = True

    def forget(self, drive: int) -> None:
        """Forget a drive that has no jobs left."""
        self.health.pop(drive, None)

    def conclude(self, drive: int) -> None:
        """Record that a request to this drive has ended, with any outcome."""
        if drive in self.health:
            self.health[drive].is_pending = False

    def may_sleep(self, at_ns: int) -> bool:
        """Return True if any drive may be asleep (gets no request now)."""
        return self.has_silent or at_ns < self._late_until_ns

    def is_asleep(self, drive: int, at_ns: int) -> bool:
        health = self.health[drive]
        return health.rest_ns > 0 or at_ns < max(health.asleep_until_ns, health.late_until_ns)

    def wake(self, at_ns: int) -> int | None:
        """Return a drive whose rest is over, and start its next rest; None if there is no such drive."""
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
        """Record a drive's number of consecutive failures.

        `cost_ns` is the line time of its next request if no reply comes. Until `late_until_ns` a reply to an
        earlier request may come. Until then the drive gets no request, even if it has answered another one.
        Once the late reply has come, the drive can be tried immediately.
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
        rest_ns = 0
        if health.failures >= (1 if health.is_new else SILENT_AFTER):
            is_first = not health.rest_ns and not health.is_new
            health.rest_ns = min(max(2 * health.rest_ns, FIRST_REST_NS), LONGEST_REST_NS)
            rest_ns = health.rest_ns if is_first else max(health.rest_ns, self._fair_rest_ns())
            self.begin_rest(drive, now_ns)
        health.asleep_until_ns = max(health.late_until_ns, now_ns + rest_ns)

    def _fair_rest_ns(self) -> int:
        """Return the pause, in ns, that keeps requests to all silent drives within SILENT_SHARE."""
        return round(sum(health.cost_ns for health in self.health.values() if health.rest_ns) / SILENT_SHARE)

    def _wake_next(self, drive: int, now_ns: int) -> None:
        """Retry the silent drive that is due next immediately, because this drive answers again."""
        resting = [health for number, health in self.health.items() if health.rest_ns and number != drive]
        if resting:
            first = min(resting, key=lambda health: health.asleep_until_ns)
            first.asleep_until_ns = min(first.asleep_until_ns, max(now_ns, first.late_until_ns))

    def _try_new_again(self, now_ns: int) -> None:
        """If all new drives have had a request and few of them were silent, retry the silent ones now."""
        new = [health for health in self.health.values() if health.is_new]
        silent = [health for health in new if health.failures == 1]
        if all(health.failures for health in new) and sum(each.cost_ns for each in silent) <= SECOND_COST_NS:
            for health in silent:
                health.asleep_until_ns = max(now_ns, health.late_until_ns)
