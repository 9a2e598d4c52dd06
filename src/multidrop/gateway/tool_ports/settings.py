"""The table [serve.tool] of a plant file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from multidrop import Plant, PlantLine
from multidrop.core import Framing
from multidrop.gateway.modbus_server.settings import (
    NETWORK,
    ROLES,
    client_mistakes,
    is_allowed,
    listen_mistakes,
)
from multidrop.printable import did_you_mean
from multidrop.toml_check import ADDRESS, parse_address

RTU_EXAMPLE = 'rtu = { hall = "127.0.0.1:4001" }'
LEAST_TIMEOUT_S, MOST_TIMEOUT_S = 0.05, 10.0
_TEXT = {"type": "string", "minLength": 1}


@dataclass(frozen=True)
class ToolSettings:
    """The settings of the tool ports. Raises ValueError with a line for each mistake."""

    # Path of the link to the pseudo-terminal, by line.
    pty: Mapping[str, str] = field(default_factory=dict, metadata={"additionalProperties": _TEXT})
    # Address and port for RTU over TCP, by line.
    rtu: Mapping[str, str] = field(
        default_factory=dict, metadata={"additionalProperties": {**_TEXT, **ADDRESS}}
    )
    # The role of all tools.
    may: str = field(default="look", metadata={"enum": [*ROLES]})
    # Addresses and networks that may connect to `rtu`; empty: only this computer.
    clients: Sequence[str] = field(default=(), metadata={"items": {"type": "string", "pattern": NETWORK}})
    # Time limit in s for the answer to a request; should be less than the tool's own timeout.
    timeout: float = field(default=0.4, metadata={"minimum": LEAST_TIMEOUT_S, "maximum": MOST_TIMEOUT_S})

    def __post_init__(self) -> None:
        wrong = [*self._mistakes()]
        if wrong:
            raise ValueError("\n".join(wrong))

    def check(self, plant: Plant) -> list[str]:
        """Return a sentence for each line in `pty` or `rtu` that the plant lacks, or that has no Modbus."""
        lines = {line.name: line for line in plant.lines}
        return [*self._line_mistakes(lines)] if lines else []

    def may_connect(self, address: str) -> bool:
        """Return True if a tool at this address may connect."""
        return is_allowed(address, self.clients)

    @property
    def addresses(self) -> dict[str, tuple[str, int]]:
        """Host and port of each listening socket, by the key of its setting, such as "rtu.hall"."""
        return {f"rtu.{line}": parse_address(where, RTU_EXAMPLE) for line, where in self.rtu.items()}

    @property
    def lines(self) -> list[str]:
        """The names of all lines that have a tool port."""
        return [*dict.fromkeys((*self.pty, *self.rtu))]

    def _line_mistakes(self, lines: Mapping[str, PlantLine]) -> Iterator[str]:
        for key, given in (("pty", self.pty), ("rtu", self.rtu)):
            for name in given:
                line = lines.get(name)
                if line is None:
                    yield f"{key}: there is no line {name!r}; {did_you_mean(name, lines)}"
                elif all(polled.drive.framing is Framing.DELIXI for polled in line.drives):
                    yield f"{key}: all drives of line {name} speak Delixi's own protocol, and tools Modbus"

    def _mistakes(self) -> Iterator[str]:
        if not self.lines:
            yield 'pty and rtu are empty; write pty = { hall = "/run/multidrop/hall" } with a line\'s name'
        if self.may not in ROLES:
            yield f"may = {self.may!r} is not one of {', '.join(ROLES)}"
        if not LEAST_TIMEOUT_S <= self.timeout <= MOST_TIMEOUT_S:
            yield f"timeout = {self.timeout:g} is not from {LEAST_TIMEOUT_S} to {MOST_TIMEOUT_S:g} s"
        yield from client_mistakes(self.clients)
        for key, given in (("pty", self.pty), ("rtu", self.rtu)):
            owners: dict[str, str] = {}
            for line, where in given.items():
                if not isinstance(where, str) or not where:
                    yield f"{key}: {line} = {where!r} is not a text"
                    continue
                if key == "rtu":
                    yield from listen_mistakes(where, RTU_EXAMPLE, self.clients)
                if where in owners and not where.endswith(":0"):
                    yield f"{key}: {line} = {where!r} is in use by {owners[where]}"
                owners[where] = line
