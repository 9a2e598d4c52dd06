"""What a scan asks, where, and in which order: worked out before anything is sent. Pure.

A sweep asks one question of many addresses at one setting.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any
from weakref import WeakKeyDictionary

from multidrop.core import Framing, Message, build_request
from multidrop.drive.family import Drive
from multidrop.drive.register import Access, Carrier, Register, Table
from multidrop.drive.timing import Settings
from multidrop.planning.blocks import Block
from multidrop.planning.bus_time import silence
from multidrop.transport.exchange import LEAST_TIMEOUT

Setting = tuple[Settings, Framing]

ADDRESSES = range(1, 32)  # asked unless the caller says otherwise
_ILLEGAL_ADDRESS = 2  # the exception code
# A reply of 0 is a copy of its request there, as an echo is; an address is never 0.
_ECHOED = (Carrier.LONG, Carrier.NUMBER)


@dataclass(frozen=True)
class Question:
    """A read, without the address that it goes to."""

    function: int
    start: int
    count: int = 0
    data: bytes = b""

    def to(self, address: int) -> Message:
        return Message(address, self.function, self.start, self.count, self.data)


@dataclass(frozen=True)
class Sweep:
    """One question to many addresses; `patience` s are waited for a reply's beginning."""

    settings: Settings
    framing: Framing
    families: tuple[type[Drive], ...]  # whose documents make the question harmless, and answered
    question: Question
    addresses: tuple[int, ...]
    silence: float
    patience: float

    @property
    def each(self) -> float:
        """Seconds for an address where nobody answers: silence, request, time-out."""
        request = len(build_request(self.framing, self.question.to(1)))
        return self.silence + request * self.settings.character + self.patience

    @property
    def needed(self) -> float:
        """Seconds where nobody answers at all."""
        return len(self.addresses) * self.each


def sweeps(
    families: Sequence[type[Drive]],
    *,
    addresses: Sequence[int] = ADDRESSES,
    baudrates: Collection[int] = (),
    formats: Collection[str] = (),
) -> list[Sweep]:
    """All that these families' documents make possible, most likelihood in the least time first.

    Every setting is swept with the patience that usual response delays need, and then again with all
    that the documents allow. Baud rates and formats: those given, or all that the documents have.
    Raises ValueError for one that they do not have, and where nothing is left to be asked.
    """
    settings = _settings(families)
    _check("baud rate", baudrates, {it.baudrate for it, _ in settings})
    _check("format", formats, {it.format for it, _ in settings})
    found = [
        likely
        for setting, weights in settings.items()
        if (not baudrates or setting[0].baudrate in baudrates)
        and (not formats or setting[0].format in formats)
        for likely in _questions(setting, weights, addresses)
    ]
    if not found:
        raise ValueError("no family has such an address together with this baud rate and format")
    found.sort(key=lambda it: -it[0] / it[1].needed)
    brisk = [sweep for _, sweep in found]
    return brisk + [replace(it, patience=max(_patience(it), it.patience)) for it in brisk]


def one_of_each_framing(planned: Sequence[Sweep]) -> list[Sweep]:
    """For a port whose format is its own: what would be the same bytes again is left out."""
    brisk: dict[tuple[Framing, Question], Sweep] = {}
    patient: dict[tuple[Framing, Question], Sweep] = {}
    for sweep in planned:
        key = sweep.framing, sweep.question
        brisk.setdefault(key, sweep)
        if key not in patient or sweep.patience > patient[key].patience:
            patient[key] = sweep
    return [*brisk.values(), *patient.values()]


def _check(what: str, given: Collection[Any], known: set[Any]) -> None:
    for one in given:
        if one not in known:
            choices = ", ".join(map(str, sorted(known)))
            raise ValueError(f"{what} {one} is none that these families have: {choices}")


def _patience(sweep: Sweep) -> float:
    return max(family.response_timeout for family in sweep.families)


def _settings(families: Sequence[type[Drive]]) -> dict[Setting, dict[type[Drive], float]]:
    """Who may be there at each setting, and how likely: documents name the usual one first."""
    found: dict[Setting, dict[type[Drive], float]] = {}
    for family in families:
        for framing in family.framings:
            for nth_baudrate, baudrate in enumerate(family.baudrates, 1):
                for nth_format, format in enumerate(family.formats[framing], 1):
                    here = found.setdefault((Settings(baudrate, format), framing), {})
                    here[family] = 1 / nth_baudrate / nth_format
    return found


def _questions(
    setting: Setting, weights: dict[type[Drive], float], addresses: Sequence[int]
) -> Iterator[tuple[float, Sweep]]:
    """As few questions as reach every family at this setting, each with its likelihood."""
    left = dict(weights)
    while left:
        register = _best(left)
        if register is None:
            return
        reached = tuple(family for family in left if _answers(family, register))
        weight = sum(left.pop(family) for family in reached)
        asked = tuple(it for it in addresses if any(it in family.addresses for family in reached))
        if asked:
            yield weight, _sweep(setting, reached, register, asked)


def _best(families: Collection[type[Drive]]) -> Register[Any] | None:
    """What most of them answer, and most of these with a value that they have."""
    registers = (it for family in families for it in family.registers.values() if it.readable)
    return max(
        registers,
        key=lambda it: (
            sum(_answers(family, it) for family in families),
            sum(_has(family, it) for family in families),
            it.table.carrier not in _ECHOED or it.name == "address_setting",
            it.access is Access.READING,
            -it.address,
        ),
        default=None,
    )


_known: WeakKeyDictionary[type[Drive], Mapping[Table, Collection[int]]] = WeakKeyDictionary()


def _addresses(family: type[Drive]) -> Mapping[Table, Collection[int]]:
    """The addresses that can be read of each table, found once for each family."""
    if family not in _known:
        found: dict[Table, set[int]] = {}
        for register in family.registers.values():
            if register.readable:
                found.setdefault(register.table, set()).add(register.address)
        _known[family] = found
    return _known[family]


def _has(family: type[Drive], register: Register[Any]) -> bool:
    return register.address in _addresses(family).get(register.table, ())


def _answers(family: type[Drive], register: Register[Any]) -> bool:
    """It has this register, or its own document has an exception for a register that it lacks."""
    if _has(family, register):
        return True
    reads = register.table in _addresses(family)
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
        Question(request.function, request.start, request.count, request.data),
        addresses,
        silence=max(map(silence, drives)),
        patience=LEAST_TIMEOUT + 2 * max(drive.response_delay for drive in drives),
    )
