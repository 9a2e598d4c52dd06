"""The table [serve.modbus] of a plant file, and the drives by the Modbus unit ids of its clients."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from ipaddress import ip_address, ip_network
from typing import Any, NamedTuple

from multidrop import Plant, PolledDrive, Register
from multidrop.drive import Carrier
from multidrop.gateway.commands import drives_of
from multidrop.gateway.http.rights import is_loopback
from multidrop.gateway.modbus_server.protocol import WriteRequest
from multidrop.gateway.modbus_server.words import (
    COMMON_LENGTH,
    ChannelBlock,
    CommonBlock,
    DriveWords,
    reading_function,
)
from multidrop.gateway.settings import refuse
from multidrop.printable import did_you_mean, is_whole
from multidrop.toml_check import ADDRESS, parse_address

EXAMPLE = 'listen = "127.0.0.1:1502"'
PASSING = ("off", "declared", "any")
ROLES = ("look", "stop", "write")
NETWORK = r"^([0-9.]+|[0-9A-Fa-f:.]*:[0-9A-Fa-f:.]*)(/[0-9.]+)?$"
MAIN = ""  # key of the TCP port that all lines without their own port share
UNITS = range(1, 248)  # valid unit ids of drives; 0 is a broadcast, 248 to 255 are reserved
LAST_UNIT = 255  # the reserved ids 248 to 255 are accepted too, because some devices use them
_WRITES = {Carrier.BIT: (0x05, 0x0F), Carrier.WORD: (0x06, 0x10)}
_STOPS = ("stop", "coast", "emergency_stop")


def _whole_numbers(least: int, most: int) -> dict[str, Any]:
    """Return the JSON Schema of a table whose values are whole numbers from `least` to `most`."""
    return {"additionalProperties": {"type": "integer", "minimum": least, "maximum": most}}


@dataclass(frozen=True)
class ModbusSettings:
    """The settings of the Modbus server. Raises ValueError with a line for each mistake."""

    listen: str = field(default="127.0.0.1:1502", metadata=ADDRESS)
    # Which reads are sent to the drive if polled values cannot answer them.
    passing: str = field(default="declared", metadata={"enum": [*PASSING]})
    # Unit ids by drive. The default is the drive's address.
    units: Mapping[str, int] = field(default_factory=dict, metadata=_whole_numbers(1, 255))
    # TCP ports by line. The default is the port of `listen`.
    ports: Mapping[str, int] = field(default_factory=dict, metadata=_whole_numbers(0, 65535))
    # The role of all Modbus clients, because Modbus has no tokens.
    may: str = field(default="look", metadata={"enum": [*ROLES]})
    # Addresses and networks from which clients may connect; empty: only from this computer.
    clients: Sequence[str] = field(default=(), metadata={"items": {"type": "string", "pattern": NETWORK}})
    # Address of the common block: state, fault, frequency and more, at the same addresses for every drive.
    common: int = field(default=0xF000, metadata={"minimum": 0, "maximum": 0x10000 - COMMON_LENGTH})
    # Address of the block with a drive's computed channels.
    channels: int = field(default=0xF100, metadata={"minimum": 0, "maximum": 0xFFFF})

    def __post_init__(self) -> None:
        refuse(self._mistakes())

    def check(self, plant: Plant) -> list[str]:
        """Return a sentence for each setting that does not fit the plant, such as a unit id of two drives."""
        try:
            Units(plant, self)
        except ValueError as mistakes:
            return str(mistakes).splitlines()
        return []

    @property
    def host(self) -> str:
        return parse_address(self.listen, EXAMPLE)[0]

    @property
    def port(self) -> int:
        """The TCP port that all lines without their own port share."""
        return parse_address(self.listen, EXAMPLE)[1]

    @property
    def addresses(self) -> dict[str, tuple[str, int]]:
        """The host and port of each listening socket, by the setting's key, such as "ports.hall"."""
        own = {f"ports.{line}": (self.host, number) for line, number in self.ports.items()}
        return {"listen": (self.host, self.port), **own}

    @property
    def common_addresses(self) -> range:
        return range(self.common, self.common + COMMON_LENGTH)

    def may_connect(self, address: str) -> bool:
        return is_allowed(address, self.clients)

    def _mistakes(self) -> Iterator[str]:
        yield from self._listening_mistakes()
        if self.passing not in PASSING:
            yield f"passing = {self.passing!r} is not one of {', '.join(PASSING)}"
        if self.may not in ROLES:
            yield f"may = {self.may!r} is not one of {', '.join(ROLES)}"
        for drive, unit in self.units.items():
            if not _is_whole(unit, 1, 255):
                yield f"units: {drive} = {unit!r} is not a unit id; write 1 to 247 (or up to 255)"
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
    """Return True if a client at this address may connect. If `clients` is empty, only this computer may."""
    host = ip_address(address.partition("%")[0])
    host = getattr(host, "ipv4_mapped", None) or host
    if not clients:
        return host.is_loopback
    return any(host in ip_network(network, strict=False) for network in clients)


def listen_mistakes(listen: str, example: str, clients: Sequence[str]) -> Iterator[str]:
    """Yield an error sentence if `listen` is invalid, or open to other machines without a list of `clients`.

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
    """Yield an error sentence for each entry that is neither an address nor a network."""
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


# ---- units ----


class StopWrite(NamedTuple):
    """A register, and the raw value that stops the motor when it is written to this register."""

    register: str
    raw: float


class Unit:
    """A drive as Modbus clients see it, with its readable and writable addresses."""

    def __init__(self, line: str, polled: PolledDrive) -> None:
        self.line = line
        self.drive = polled.drive
        self.words = DriveWords(polled)
        self.common = CommonBlock(polled)
        self.channels = ChannelBlock(polled)
        self.stops = frozenset(_stop_writes(polled.drive))
        # readable addresses, by the Modbus function code that reads them; 0: no standard function reads them
        self._readable: dict[int, set[int]] = {code: set() for code in range(5)}
        self._gaps: list[tuple[int, range]] = []
        self._writable: dict[tuple[Carrier, int], Register[Any]] = {}
        for register in self.drive.registers.values():
            self._declare(register)
        for text in self.drive.texts.values():
            self._readable[reading_function(text.table)].update(
                range(text.address, text.address + text.length)
            )
        for table, gap in self.drive.readable_gaps.items():
            self._gaps.append((reading_function(table), gap))

    def __repr__(self) -> str:
        return f"<Unit {self.drive.name} on {self.line}>"

    def _declare(self, register: Register[Any]) -> None:
        table, addresses = register.table, range(register.address, register.address + register.words)
        if register.readable:
            self._readable[reading_function(table)].update(addresses)
        if register.writable and table.write in _WRITES.get(table.carrier, ()):
            self._writable[table.carrier, register.address] = register

    def is_declared(self, function: int, addresses: range) -> bool:
        """Return True if the drive's manual declares all these addresses readable."""
        own = self._readable[function]
        gaps = [gap for code, gap in self._gaps if code == function]
        return all(at in own or any(at in gap for gap in gaps) for at in addresses)

    def writable(self, carrier: Carrier, address: int) -> Register[Any] | None:
        """Return the writable register that starts at this address; None if there is none."""
        return self._writable.get((carrier, address))

    def has_stop_in(self, written: WriteRequest, common_stop: int | None) -> bool:
        """Return True if a request stops the motor. Any number except 0 at `common_stop` is a stop."""
        carrier, start, size, data = written
        for at in range(size):
            if carrier is Carrier.WORD and start + at == common_stop and data[2 * at : 2 * at + 2] != b"\0\0":
                return True
            register = self.writable(carrier, start + at)
            if register is not None and at + register.words <= size:
                raw = register.coding.raw_in(data, at)
                if raw is not None and StopWrite(register.name, raw) in self.stops:
                    return True
        return False

    def holding_addresses(self) -> set[int]:
        """Return the addresses of all words that the drive's registers and texts use, for reads or writes."""
        written = {
            at
            for register in self.drive.registers.values()
            if register.table.carrier is Carrier.WORD
            for at in range(register.address, register.address + register.words)
        }
        return self._readable[3] | self._readable[4] | written


def _stop_writes(drive: Any) -> Iterator[StopWrite]:
    """Yield the writes that stop a drive's motor, as pairs of register and raw value.

    These are the first write of each stop verb of the drive's family, and the raw values that the family's
    declaration of the same register lists as harmless, such as YD1000's 8000H. A harmless 0 is left out,
    because it may mean "no command".
    """
    for name in _STOPS:
        try:
            script = getattr(drive, name).script()
            step = next(script, None)
            script.close()
            register, value = getattr(step, "register", None), getattr(step, "value", None)
            if isinstance(register, Register) and value is not None:
                counts = {register.encode(value), *filter(None, register.harmless or ())}
                yield from (StopWrite(register.name, raw) for raw in counts)
        except Exception:  # the family lacks this verb, or the verb's steps need a bus
            continue


class Units:
    """All units of a plant, by TCP port (MAIN, or a line's name) and unit id.

    Drives on a line with its own TCP port are reached only on that port. Raises ValueError with a line for
    each mistake, such as two drives with one unit id, or an unknown name in the settings.
    """

    def __init__(self, plant: Plant, settings: ModbusSettings) -> None:
        self._units: dict[tuple[str, int], Unit] = {}
        wrong = [*_unknown_names(plant, settings)]
        for port, found in _by_port(plant, settings).items():
            wrong += _clashes(port, found)
            for number, units in found.items():
                self._units[port, number] = units[0]
                for unit in units:
                    wrong += _overlap(unit, settings)
        refuse(wrong)

    def find(self, port: str, number: int) -> Unit | None:
        """Return the drive with this unit id on a TCP port; None if there is none."""
        return self._units.get((port, number))

    def __iter__(self) -> Iterator[tuple[str, int, Unit]]:
        return ((port, number, unit) for (port, number), unit in self._units.items())


def _by_port(plant: Plant, settings: ModbusSettings) -> Mapping[str, Mapping[int, list[Unit]]]:
    found: dict[str, dict[int, list[Unit]]] = defaultdict(lambda: defaultdict(list))
    for line in plant.lines:
        port = line.name if line.name in settings.ports else MAIN
        for polled in line.drives:
            number = settings.units.get(polled.drive.name, polled.drive.address)
            found[port][number].append(Unit(line.name, polled))
    return found


def _clashes(port: str, units: Mapping[int, list[Unit]]) -> Iterator[str]:
    """Yield an error for each duplicate or invalid unit id on a TCP port, and a sentence with free ids."""
    where = "" if port == MAIN else f" on the port of line {port}"
    wrong: list[str] = []  # names of the drives with an invalid unit id
    for number, found in sorted(units.items()):
        names = " and ".join(f"{unit.drive.name} (line {unit.line})" for unit in found)
        if not 1 <= number <= LAST_UNIT:
            yield f"{names} cannot be unit {number}{where}, but 1 to {LAST_UNIT}"
            wrong.append(found[-1].drive.name)
        elif len(found) > 1:
            yield f"unit {number}{where} would be {names}"
            wrong.append(found[-1].drive.name)
    if wrong:
        free = [number for number in UNITS if number not in units]
        example = f'units = {{ "{wrong[0]}" = {free[0] if free else 1} }}'
        yield (
            f"units gives a drive another number, such as {example}, and ports gives a line its own "
            f"port; free numbers{where}: {_ranges(free)}"
        )


def _ranges(numbers: Iterable[int]) -> str:
    """Return numbers as "3 to 20, 22"."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][-1] + 1:
            runs[-1][1:] = [number]
        else:
            runs.append([number])
    return ", ".join(" to ".join(str(end) for end in run) for run in runs) or "none"


def _overlap(unit: Unit, settings: ModbusSettings) -> Iterator[str]:
    """Yield an error if the common block, the channels and the drive's registers share an address."""
    channels = range(settings.channels, settings.channels + unit.channels.length)
    if channels.stop > 0x10000 or set(channels) & (unit.holding_addresses() | set(settings.common_addresses)):
        yield (
            f"{unit.drive.name}: the {unit.channels.length} words of its channels do not fit at "
            f"{settings.channels:04X}H: move them, such as channels = 0xE100"
        )
    own = sorted(unit.holding_addresses() & set(settings.common_addresses))
    if own:
        yield (
            f"{unit.drive.name} has registers at {own[0]:04X}H, in the range of the common block: move "
            f"the block, such as common = 0xE000"
        )


def _unknown_names(plant: Plant, settings: ModbusSettings) -> Iterator[str]:
    drives = drives_of(plant)
    lines = [line.name for line in plant.lines]
    for key, kind, given, known in (
        ("units", "drive", settings.units, drives),
        ("ports", "line", settings.ports, lines),
    ):
        for name in given:
            if known and name not in known:
                yield f"{key}: there is no {kind} {name!r}; {did_you_mean(name, known)}"
