"""A user's own drive, whose start and stop are one plain setting."""

from __future__ import annotations

from enum import IntEnum

from multidrop.drive import Condition, Direction, Drive, Script, State, insist, read, write
from multidrop.drive.register import reading, setting
from multidrop.drive.verbs import verb


class Run(IntEnum):
    OFF = 0
    ON = 1


class Fan(Drive):
    """A fan controller of a user's own."""

    model = "fan"
    speed = reading(0x0010, "rpm", step=1)
    current = reading(0x0011, "A", step=0.01)
    run = setting(0x0030, Run)

    @verb
    def start(self, direction: Direction | None = None) -> Script[None]:
        yield from read(self.speed)
        yield from write(self.run, Run.ON)

    @verb
    def stop(self) -> Script[None]:
        yield from insist(self.run, Run.OFF)
        yield from self._stopped(self._stands, 5.0)

    def _stands(self) -> Script[bool]:
        return (yield from read(self.speed)) == 0

    @verb
    def state(self) -> Script[State]:
        turns = (yield from read(self.speed)) > 0
        return State(Condition.RUNNING if turns else Condition.STOPPED)
