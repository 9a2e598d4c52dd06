"""The job that every master is given, and the values that the drives hold."""

from __future__ import annotations

from dataclasses import dataclass

REGISTERS = 10
TIMEOUT_S = 0.3
DELAY_S = 2e-3  # the drives' response delay
CHARACTER_BITS = 10


@dataclass(frozen=True)
class Job:
    """Read the registers of addresses 1 to `drives` in turn, for `seconds`; baud rate 0: no waits."""

    port: str
    baudrate: int
    seconds: float
    drives: int = 16

    @property
    def wire(self) -> float:
        """Seconds from the start of a request to the end of its reply on paced_line."""
        return (8 + 5 + 2 * REGISTERS) * self.character + DELAY_S

    @property
    def character(self) -> float:
        return CHARACTER_BITS / self.baudrate

    @property
    def port_baudrate(self) -> int:
        """The baud rate with which a rival opens the port; it computes its waits from it."""
        return self.baudrate or 115200


def expected(address: int) -> list[int]:
    """The values that paced_line's drive of this address holds."""
    return [256 * address + register for register in range(REGISTERS)]
