"""Families of the drives that paced_line.c and responders.c simulate, declared as users declare theirs."""

from typing import Any

from multidrop.drive import Drive
from multidrop.drive.line_settings import Settings
from multidrop.drive.register import HOLDING, INPUT, reading


class Played(Drive):
    """A drive of paced_line.c: register r at address a has the value 256 * a + r."""

    model = "played"
    title = "Played by paced_line"
    baudrates = (9600, 19200, 38400, 57600, 115200)
    most_registers = {HOLDING: 125}
    response_delay = 2e-3

    r0, r1, r2, r3, r4, r5, r6, r7, r8, r9 = (reading(address) for address in range(10))


class NoTime(Settings):
    """Settings with characters that take almost no time; not 0, so that plans prefer fewer characters."""

    @property
    def character(self) -> float:
        return 1e-9

    @property
    def bit(self) -> float:
        return 0.0


class Unpaced(Played):
    """The drive `Played` on a line without waits, to measure only the host's own cost."""

    response_delay = 0.0

    def __init__(self, address: int, **details: Any) -> None:
        super().__init__(address, **details)
        self.settings = NoTime(self.settings.baudrate, self.settings.format)


class Unreliable(Unpaced):
    """A drive of responders.c with four blocks of equal length, whose replies differ only in their values."""

    model = "unreliable"
    title = "Played by responders"
    most_registers = {HOLDING: 10, INPUT: 10}
    response_timeout = 5e-3

    s0, s1, s2, s3, s4, s5, s6, s7, s8, s9 = (reading(address) for address in range(20, 30))
    t0, t1, t2, t3, t4, t5, t6, t7, t8, t9 = (reading(address) for address in range(40, 50))
    u0, u1, u2, u3, u4, u5, u6, u7, u8, u9 = (reading(address, table=INPUT) for address in range(10))

    def needed_silence(self) -> float:
        return 3e-4  # s; long enough for the second copy of a doubled reply

    @classmethod
    def held(cls, address: int, name: str) -> int:
        """Return the value that the register with this name has in the drive with this address."""
        register = cls.register(name)
        return 256 * address + register.address + (128 if register.table is INPUT else 0)
