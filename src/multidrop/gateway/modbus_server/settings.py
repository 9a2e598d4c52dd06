"""The table [serve.modbus] of a plant file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from ipaddress import ip_address, ip_network

from multidrop import Plant
from multidrop.gateway.http.rights import is_loopback
from multidrop.gateway.modbus_server.common_block import COMMON_LENGTH
from multidrop.gateway.modbus_server.unit_ids import Units

PASSING = ("off", "declared", "any")
ROLES = ("look", "stop", "write")


@dataclass(frozen=True)
class ModbusSettings:
    """The settings of the Modbus server. Raises ValueError with a line for each mistake."""

    listen: str = "127.0.0.1:1502"
    passing: str = "declared"  # which reads go to the drive if polled rows cannot answer them
    units: Mapping[str, int] = field(default_factory=dict)  # unit ids by drive; default: its address
    ports: Mapping[str, int] = field(default_factory=dict)  # TCP ports by line; default: the port of `listen`
    may: str = "look"  # the role of all clients, because Modbus has no tokens
    clients: Sequence[str] = ()  # allowed addresses and networks; empty: only this computer
    common: int = 0xF000  # address of the common block

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
        return self.listen.rpartition(":")[0].strip("[]")

    @property
    def port(self) -> int:
        """The TCP port of all lines that have no own port."""
        return int(self.listen.rpartition(":")[2])

    @property
    def common_addresses(self) -> range:
        """Addresses of the common block."""
        return range(self.common, self.common + COMMON_LENGTH)

    def may_connect(self, address: str) -> bool:
        """Return True if a client at this address may connect."""
        host = ip_address(address.partition("%")[0])
        host = getattr(host, "ipv4_mapped", None) or host
        if not self.clients:
            return host.is_loopback
        return any(host in ip_network(network, strict=False) for network in self.clients)

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
        for network in self.clients:
            if not _is_network(network):
                yield f"clients: {network!r} is neither an address nor a network such as 10.0.0.0/24"

    def _listening_mistakes(self) -> Iterator[str]:
        host, colon, port = self.listen.rpartition(":")
        host = host.strip("[]")
        is_host = host == "localhost" or _is_address(host)
        if not colon or not is_host or not port.isascii() or not port.isdigit():
            yield f"listen = {self.listen!r} is not ADDRESS:PORT, such as 127.0.0.1:1502"
            return
        if int(port) > 65535:
            yield f"listen = {self.listen!r}: a port is a number from 1 to 65535"
        if not is_loopback(host) and not self.clients:
            yield (
                f"listen = {self.listen!r} is open to other machines, and Modbus has no tokens: list the "
                'allowed clients, such as clients = ["10.0.0.5", "10.0.1.0/24"]'
            )
        owners = {int(port): "listen"} if int(port) else {}
        for line, number in self.ports.items():
            if not _is_whole(number, 0, 65535):
                yield f"ports: {line} = {number!r} is not a port from 1 to 65535"
            elif number in owners:
                yield f"ports: {line} = {number} is in use by {owners[number]}"
            elif number:
                owners[number] = line


def _is_whole(number: object, least: int, most: int) -> bool:
    return isinstance(number, int) and not isinstance(number, bool) and least <= number <= most


def _is_address(text: str) -> bool:
    try:
        ip_address(text)
    except ValueError:
        return False
    return True


def _is_network(text: object) -> bool:
    try:
        return isinstance(text, str) and bool(ip_network(text, strict=False))
    except ValueError:
        return False
