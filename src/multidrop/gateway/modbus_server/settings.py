"""The table [serve.modbus] of a plant file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from ipaddress import ip_address, ip_network
from typing import Any

from multidrop import Plant
from multidrop.gateway.http.rights import is_loopback
from multidrop.gateway.modbus_server.common_block import COMMON_LENGTH
from multidrop.gateway.modbus_server.unit_ids import Units
from multidrop.printable import is_whole
from multidrop.toml_check import ADDRESS, parse_address

EXAMPLE = 'listen = "127.0.0.1:1502"'
PASSING = ("off", "declared", "any")
ROLES = ("look", "stop", "write")
NETWORK = r"^([0-9.]+|[0-9A-Fa-f:.]*:[0-9A-Fa-f:.]*)(/[0-9.]+)?$"


def _whole_numbers(least: int, most: int) -> dict[str, Any]:
    """Return the JSON Schema of a table of whole numbers."""
    return {"additionalProperties": {"type": "integer", "minimum": least, "maximum": most}}


@dataclass(frozen=True)
class ModbusSettings:
    """The settings of the Modbus server. Raises ValueError with a line for each mistake."""

    listen: str = field(default="127.0.0.1:1502", metadata=ADDRESS)
    # Which reads go to the drive if polled rows cannot answer them.
    passing: str = field(default="declared", metadata={"enum": [*PASSING]})
    # Unit ids by drive; default: the drive's address.
    units: Mapping[str, int] = field(default_factory=dict, metadata=_whole_numbers(1, 255))
    # TCP ports by line; default: the port of `listen`.
    ports: Mapping[str, int] = field(default_factory=dict, metadata=_whole_numbers(0, 65535))
    # The role of all clients, because Modbus has no tokens.
    may: str = field(default="look", metadata={"enum": [*ROLES]})
    # Allowed addresses and networks; empty: only this computer.
    clients: Sequence[str] = field(default=(), metadata={"items": {"type": "string", "pattern": NETWORK}})
    # Address of the common block.
    common: int = field(default=0xF000, metadata={"minimum": 0, "maximum": 0x10000 - COMMON_LENGTH})
    # Address of the first computed channel of each drive.
    channels: int = field(default=0xF100, metadata={"minimum": 0, "maximum": 0xFFFF})

    def __post_init__(self) -> None:
        wrong = [*self._mistakes()]
        if wrong:
            raise ValueError("\n".join(wrong))

    def check(self, plant: Plant) -> list[str]:
        """Return a sentence for each conflict with the plant, such as two drives with the same unit id."""
        try:
            Units(plant, self)
        except ValueError as mistakes:
            return str(mistakes).splitlines()
        return []

    @property
    def host(self) -> str:
        """The address to listen on."""
        return parse_address(self.listen, EXAMPLE)[0]

    @property
    def port(self) -> int:
        """The TCP port of all lines that have no port of their own."""
        return parse_address(self.listen, EXAMPLE)[1]

    @property
    def addresses(self) -> dict[str, tuple[str, int]]:
        """Host and port of each listening socket, by the key of its setting, such as "ports.hall"."""
        own = {f"ports.{line}": (self.host, number) for line, number in self.ports.items()}
        return {"listen": (self.host, self.port), **own}

    @property
    def common_addresses(self) -> range:
        """Addresses of the common block."""
        return range(self.common, self.common + COMMON_LENGTH)

    def may_connect(self, address: str) -> bool:
        """Return True if a client at this address may connect."""
        return is_allowed(address, self.clients)

    def _mistakes(self) -> Iterator[str]:
        yield from self._listening_mistakes()
        if self.passing not in PASSING:
            yield f"passing = {self.passing!r} is not one of {', '.join(PASSING)}"
        if self.may not in ROLES:
            yield f"may = {self.may!r} is not one of {', '.join(ROLES)}"
        for drive, unit in self.units.items():
            if not _is_whole(unit, 1, 255):
                yield f"units: {drive} = {unit!r} is not a unit id from 1 to 247 (255 at most)"
        if not _is_whole(self.common, 0, 0x10000 - COMMON_LENGTH):
            yield f"common = {self.common!r} is not an address from 0 to {0x10000 - COMMON_LENGTH:#X}"
        if not _is_whole(self.channels, 0, 0xFFFF):
            yield f"channels = {self.channels!r} is not an address from 0 to 0xFFFF"
        yield from client_mistakes(self.clients)

    def _listening_mistakes(self) -> Iterator[str]:
        wrong = [*listen_mistakes(self.listen, EXAMPLE, self.clients)]
        yield from wrong
        owners = {} if wrong or not self.port else {self.port: "listen"}
        for line, number in self.ports.items():
            if not _is_whole(number, 0, 65535):
                yield f"ports: {line} = {number!r} is not a port from 1 to 65535"
            elif number in owners:
                yield f"ports: {line} = {number} is in use by {owners[number]}"
            elif number:
                owners[number] = line


def is_allowed(address: str, clients: Sequence[str]) -> bool:
    """Return True if a client at this address may connect; without `clients`, only this computer may."""
    host = ip_address(address.partition("%")[0])
    host = getattr(host, "ipv4_mapped", None) or host
    if not clients:
        return host.is_loopback
    return any(host in ip_network(network, strict=False) for network in clients)


def listen_mistakes(listen: str, example: str, clients: Sequence[str]) -> Iterator[str]:
    """Yield a sentence if `listen` is invalid, or open to other machines without a list of `clients`.

    `example` is a valid setting, which the sentence may quote.
    """
    key = example.partition(" ")[0]
    try:
        host, _ = parse_address(listen, example)
    except ValueError as mistake:
        yield f"{key}: {mistake}"
        return
    if not is_loopback(host) and not clients:
        yield (
            f'{key}: "{listen}" is open to other machines, and Modbus has no tokens: list the allowed '
            'clients, such as clients = ["10.0.0.5", "10.0.1.0/24"]'
        )


def client_mistakes(clients: Sequence[str]) -> Iterator[str]:
    """Yield a sentence for each entry that is neither an address nor a network."""
    for network in clients:
        if not _is_network(network):
            yield f"clients: {network!r} is neither an address nor a network such as 10.0.0.0/24"


def _is_whole(number: object, least: int, most: int) -> bool:
    return is_whole(number) and least <= number <= most


def _is_network(text: object) -> bool:
    try:
        return isinstance(text, str) and bool(ip_network(text, strict=False))
    except ValueError:
        return False
