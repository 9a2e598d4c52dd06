"""What every master is given to do, and what the drives hold."""

from __future__ import annotations

from dataclasses import dataclass

REGISTERS = 10
TIMEOUT_S = 0.3


@dataclass(frozen=True)
class Job:
    """Read the registers of addresses 1 to `drives` in turn, for `seconds`; baud rate 0: no waits."""

    port: str
    baudrate: int
    seconds: float
    drives: int = 16

    @property
    def port_baudrate(self) -> int:
        """What a rival opens the port with; it takes its own waits from that."""
        return self.baudrate or 115200


def expected(address: int) -> list[int]:
    """The values that paced_line's drive of this address holds."""
    return [256 * address + register for register in range(REGISTERS)]
