"""Drives that obey the bits of their documents and nothing else: judges of files that were changed.

A file's own simulation would obey what the file says, and so find no mistake in it. These take their words
from the documents: any word with the bits of a start turns the motor at once, in whatever order it comes, and
one that resets a fault with such bits too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from multidrop.sim.declared import SimulatedDeclared
from multidrop.sim.memory import MemoryCell

STARTS: Mapping[str, Callable[[str, int], bool]] = {
    "abb": lambda name, word: name == "control" and word & 0x0409 == 0x0409,
    "fc": lambda name, word: name == "control" and bool(word & 0x0140) and word & 0x040C == 0x040C,
    "enum": lambda name, word: name == "control" and word in (1, 2, 3, 4),
    "coil": lambda name, word: name == "run" and word == 1,
}
STOPS: Mapping[str, Callable[[str, int], bool]] = {
    "abb": lambda name, word: name == "control" and bool(word & 0x0400) and word & 7 != 7,
    "fc": lambda name, word: name == "control" and bool(word & 0x0400) and not STARTS["fc"](name, word),
    "enum": lambda name, word: name == "control" and word in (5, 6, 8),
    "coil": lambda name, word: name == "run" and word == 0,
}
RESETS: Mapping[str, Callable[[str, int], bool]] = {
    "abb": lambda name, word: name == "control" and bool(word & 0x80),
    "fc": lambda name, word: name == "control" and bool(word & 0x80),
    "enum": lambda name, word: name == "control" and word == 7,
    "coil": lambda name, word: name == "reset" and word == 1,
}


class NastyDrive(SimulatedDeclared):
    """A drive of the unchanged file's class. `started` are the words that would have started it."""

    def judge(self, family: str) -> None:
        self._family = family
        self.started: list[int] = []

    def changed(self, cell: MemoryCell) -> None:
        super().changed(cell)
        register = cell.register
        if register is None or not hasattr(self, "_family"):
            return
        name, word, motor = register.name, cell.raw, self.motor
        if RESETS[self._family](name, word):
            motor.reset()
        if STARTS[self._family](name, word):
            self.started.append(word)
            motor.run(1)
        elif STOPS[self._family](name, word):
            motor.stop()

    def turn(self, hz: float) -> None:
        """Have it turn, as somebody else has started it."""
        self.motor.target = hz
        self.motor.run(1)
        self.motor.frequency = hz

    def stands(self) -> bool:
        return not self.motor.energised and self.motor.frequency == 0
