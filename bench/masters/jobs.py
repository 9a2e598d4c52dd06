"""The job that every master carries out, and the values of the drives' registers."""

from __future__ import annotations

from dataclasses import dataclass

REGISTERS = 10
TIMEOUT_S = 0.3
DELAY_S = 2e-3  # the drives' response delay
CHARACTER_BITS = 10


@dataclass(frozen=True)
class Job:
    """Read all registers of the addresses 1 to `drives` in turn, for `seconds`.

    With baud rate 0, the simulated line does not wait for the time that characters take on a wire."""

    port: str
    baudrate: int
    seconds: float
    drives: int = 16

    @property
    def wire(self) -> float:
        """The time in s from the start of a request to the end of its reply on the simulated line."""
        return (8 + 5 + 2 * REGISTERS) * self.character + DELAY_S

    @property
    def character(self) -> float:
        return CHARACTER_BITS / self.baudrate

    @property
    def port_baudrate(self) -> int:
        """The baud rate for libraries that need one: `baudrate`, or 115200 on a line without waits."""
        return self.baudrate or 115200


def expected(address: int) -> list[int]:
    """Return the register values that the simulated drive with this address has."""
    return [256 * address + register for register in range(REGISTERS)]
