"""The drives that paced_line.c plays, declared as a user declares a family of their own."""

from typing import Any

from multidrop.drive import Drive
from multidrop.register import HOLDING, reading
from multidrop.timing import Settings


class Played(Drive):
    """Register r of address a holds 256 * a + r."""

    model = "played"
    title = "Played by paced_line"
    baudrates = (9600, 19200, 38400, 57600, 115200)
    most_registers = {HOLDING: 125}
    response_delay = 2e-3

    r0, r1, r2, r3, r4, r5, r6, r7, r8, r9 = (reading(address) for address in range(10))


class NoTime(Settings):
    """Characters that take next to no time, so that few of them are still better than many."""

    @property
    def character(self) -> float:
        return 1e-9

    @property
    def bit(self) -> float:
        return 0.0


class Unpaced(Played):
    """The same on a line that has no waits: what is left is the host's own cost."""

    response_delay = 0.0

    def __init__(self, address: int, **details: Any) -> None:
        super().__init__(address, **details)
        self.settings = NoTime(self.settings.baudrate, self.settings.format)

    def needed_silence(self) -> float:
        return 0.0
