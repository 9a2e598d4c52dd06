"""Plan a scan: its requests and their order. This module sends no request.

A sweep sends one request to many addresses at one setting.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from multidrop.core import MODBUS, Framing, Message, build_request
from multidrop.drive.family import Drive
from multidrop.drive.line_settings import Settings
from multidrop.drive.register import Access, Carrier, Register
from multidrop.drive.request import readable_addresses
from multidrop.planning.blocks import Block
from multidrop.planning.bus_time import silence
from multidrop.transport.drive_records import LEAST_TIMEOUT

Setting = tuple[Settings, Framing]

# maximum time in s that a Modbus TCP gateway takes to report that a drive does not answer
GATEWAY_PATIENCE = 1.0
ADDRESSES = range(1, 32)  # the addresses that a scan tries by default
_ILLEGAL_ADDRESS = 2  # code of the Modbus exception "illegal data address"
# Tables of Delixi's own protocol. A reply with the value 0 equals an echo of the request. So a scan reads
# other tables if possible, or the register with the drive's own address, which is never 0.
_ECHOED = (Carrier.LONG, Carrier.NUMBER)


@dataclass(frozen=True)
class ScanRequest:
    """A read request to which a drive address can be added."""

    function: int
    start: int
    count: int = 0
    data: bytes = b""

    def to(self, address: int) -> Message:
        return Message(address, self.function, self.start, self.count, self.data)


@dataclass(frozen=True)
class Sweep:
    """One request to many addresses; each reply must start within `patience` s."""

    settings: Settings
    framing: Framing
    families: tuple[type[Drive], ...]  # families whose manuals say that they answer this request
    request: ScanRequest
    addresses: tuple[int, ...]
    silence: float
    patience: float

    @property
    def each(self) -> float:
        """The time in s that an address without a drive takes: line silence, request, timeout."""
        request = len(build_request(self.framing, self.request.to(1)))
        return self.silence + request * self.settings.character + self.patience

    @property
    def needed(self) -> float:
        """The time in s that the sweep takes if no drive answers."""
        return len(self.addresses) * self.each


def sweeps(
    families: Sequence[type[Drive]],
    *,
    addresses: Sequence[int] = ADDRESSES,
    baudrates: Collection[int] = (),
    formats: Collection[str] = (),
) -> list[Sweep]:
    """Return sweeps of all line settings in these families' documents.

    They are sorted by the probability of finding a drive, divided by the time of the sweep.

    Every setting is swept twice: first with a timeout for usual response delays, then with a timeout for the
    longest delays that the documents allow. `baudrates` and `formats` restrict the settings; empty means all.
    Raises ValueError for a baud rate or format that is in no document, and if no sweep is left.
    """
    settings = _settings(families)
    _check("baud rate", baudrates, {setting.baudrate for setting, _ in settings})
    _check("format", formats, {setting.format for setting, _ in settings})
    found = [
        likely
        for setting, weights in settings.items()
        if (not baudrates or setting[0].baudrate in baudrates)
        and (not formats or setting[0].format in formats)
        for likely in _sweeps(setting, weights, addresses)
    ]
    if not found:
        raise ValueError(
            "no family allows any of these addresses with any of these baud rates and formats. "
            "Allow more addresses, baud rates or formats"
        )
    found.sort(key=lambda weighted: -weighted[0] / weighted[1].needed)
    brisk = [sweep for _, sweep in found]
    return brisk + [_patient(sweep) for sweep in brisk]


def one_of_each_framing(planned: Sequence[Sweep]) -> list[Sweep]:
    """Return the sweeps for a port whose baud rate and format cannot be changed.

    Each request of each framing is swept twice, with a short and with a long timeout.
    """
    brisk: dict[tuple[Framing, ScanRequest], Sweep] = {}
    patient: dict[tuple[Framing, ScanRequest], Sweep] = {}
    for sweep in planned:
        key = sweep.framing, sweep.request
        brisk.setdefault(key, sweep)
        if key not in patient or sweep.patience > patient[key].patience:
            patient[key] = sweep
    return [*brisk.values(), *patient.values()]


def over_tcp(planned: Sequence[Sweep]) -> list[Sweep]:
    """Return the sweeps for a Modbus TCP port: each request once, with the timeout that gateways need."""
    once: dict[ScanRequest, Sweep] = {}
    for sweep in planned:
        if sweep.framing in MODBUS:
            asked = replace(sweep, framing=Framing.TCP, silence=0.0, patience=GATEWAY_PATIENCE)
            once.setdefault(sweep.request, asked)
    return list(once.values())


def _check(what: str, given: Collection[Any], known: set[Any]) -> None:
    for one in given:
        if one not in known:
            choices = ", ".join(map(str, sorted(known)))
            raise ValueError(f"none of these families allows {what} {one}; they allow {choices}")


def _patient(sweep: Sweep) -> Sweep:
    timeouts = (family.response_timeout for family in sweep.families)
    return replace(sweep, patience=max(sweep.patience, *timeouts))


def _settings(families: Sequence[type[Drive]]) -> dict[Setting, dict[type[Drive], float]]:
    """Return, for each line setting, the likelihood that a drive of each family uses it.

    The first setting in a family's manual is the likeliest.
    """
    found: dict[Setting, dict[type[Drive], float]] = {}
    for family in families:
        for framing in family.framings:
            for nth_baudrate, baudrate in enumerate(family.baudrates, 1):
                for nth_format, format in enumerate(family.formats[framing], 1):
                    here = found.setdefault((Settings(baudrate, format), framing), {})
                    here[family] = 1 / nth_baudrate / nth_format
    return found


def _sweeps(
    setting: Setting, weights: dict[type[Drive], float], addresses: Sequence[int]
) -> Iterator[tuple[float, Sweep]]:
    """Yield sweeps, with their likelihoods, that together find drives of every family at this setting.

    Each sweep reads the register that drives of the most remaining families answer.
    """
    left = dict(weights)
    while left:
        register = _best(left)
        if register is None:
            return
        reached = tuple(family for family in left if _answers(family, register))
        weight = sum(left.pop(family) for family in reached)
        asked = tuple(one for one in addresses if any(one in family.addresses for family in reached))
        if asked:
            yield weight, _sweep(setting, reached, register, asked)


def _best(families: Collection[type[Drive]]) -> Register[Any] | None:
    """Return the register whose read is answered by drives of the most families.

    Of several such registers, return the one that the most families declare.
    """
    registers = (one for family in families for one in family.registers.values() if one.readable)
    return max(
        registers,
        key=lambda one: (
            sum(_answers(family, one) for family in families),
            sum(_has(family, one) for family in families),
            one.table.carrier not in _ECHOED or one.name == "address_setting",
            one.access is Access.READING,
            -one.address,
        ),
        default=None,
    )


def _has(family: Any, register: Register[Any]) -> bool:
    return register.address in readable_addresses(family, register.table)


def _answers(family: Any, register: Register[Any]) -> bool:
    """Return True if drives of the family answer a read of this register, even if only by an exception."""
    if _has(family, register):
        return True
    reads = bool(readable_addresses(family, register.table))
    return reads and family.exceptions is not Drive.exceptions and _ILLEGAL_ADDRESS in family.exceptions


def _sweep(
    setting: Setting, families: tuple[type[Drive], ...], register: Register[Any], addresses: tuple[int, ...]
) -> Sweep:
    settings, framing = setting
    drives = [
        family(family.addresses[0], framing=framing, baudrate=settings.baudrate, format=settings.format)
        for family in families
    ]
    request = Block.of(drives[0], [register]).request
    return Sweep(
        settings,
        framing,
        families,
        ScanRequest(request.function, request.start, request.count, request.data),
        addresses,
        silence=max(map(silence, drives)),
        patience=LEAST_TIMEOUT + 2 * max(drive.response_delay for drive in drives),
    )
