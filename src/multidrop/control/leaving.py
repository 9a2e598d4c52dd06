"""Leaving: what happens to the motors when a bus is closed or the process exits."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence

from multidrop.control.exit_hook import LastAct, exit_hook
from multidrop.control.latches import Latches
from multidrop.control.outcome import Stopped
from multidrop.control.stops import Stopper
from multidrop.drive.family import Drive
from multidrop.transport.aside_log import log_aside

_log = logging.getLogger("multidrop.bus")


class Leaving:
    """Cancels all calls of a bus at its end, and stops its drives if `stop_on_exit` was called."""

    def __init__(
        self,
        latches: Latches,
        stopper: Stopper,
        stop_all: Callable[[], Mapping[str, Stopped]],
        drives: Callable[[], Sequence[Drive]],
    ) -> None:
        self._drives = drives
        self._latches = latches
        self._stopper = stopper
        self._stop_all = stop_all
        self._last_act: LastAct | None = None

    @property
    def stops(self) -> bool:
        """True once `stop_on_exit` was called."""
        return self._last_act is not None

    def stop_on_exit(self) -> None:
        """Stop all drives when the bus is closed or the process ends.

        The first call raises ValueError outside the main thread.
        """
        if self._last_act is None:
            self._last_act = exit_hook().add(
                self._latches.shut,
                lambda: _warn_of(self._stop_all()),
                lambda: [drive.name for drive in self._drives()],
            )

    def begin(self) -> None:
        """Cancel all calls; if `stop_on_exit` was called, start stopping the drives without waiting."""
        self._latches.shut()
        if self._last_act is not None:
            self._last_act.begin()

    def finish(self) -> None:
        """Do the same as `begin`, and wait for all unfinished stops."""
        self.begin()
        if self._last_act is not None:
            exit_hook().finish(self._last_act)
        if self._last_act is None or not self._last_act.is_cut_short:
            self._latches.await_stops()

    def part_with(self, drives: Sequence[Drive], to_stop: Sequence[Drive]) -> None:
        """Cancel the calls of drives that are about to be detached, and wait for their unfinished stops.

        If `stop_on_exit` was called, stop the drives `to_stop` before that wait.
        """
        self._latches.end(drives)  # before the stops: a start after them would not be stopped
        if to_stop and self.stops:
            run = self._stopper.stop_all(to_stop, lambda: False, None)
            try:
                run.carry_out()
            except BaseException as interruption:
                run.interrupted(interruption)
                raise
            _warn_of(run.found())
        self._latches.await_stops(drives)


def _warn_of(found: Mapping[str, Stopped]) -> None:
    """Log each drive that was not seen to stop."""
    for stopped in found.values():
        if not stopped.ok:
            log_aside(_log, logging.WARNING, "%s", stopped)
