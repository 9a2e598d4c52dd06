"""The findings of a scan: drives, problems and progress. Make a plant file of the drives."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from multidrop.core import RS485, Framing
from multidrop.drive.family import Drive
from multidrop.drive.line_settings import Settings

GUESS = "only its registers look like this model: check its name plate"


def line_setting(settings: Settings, framing: Framing) -> str:
    """Return a line setting as text, without a baud rate for Modbus TCP."""
    return "Modbus TCP" if framing is Framing.TCP else f"{settings} {framing}"


@dataclass(frozen=True)
class Found:
    """A drive that answers; `models` are the equally likely families, empty if no family fits.

    The settings are the first at which the drive answered. The drive's own number of stop bits may differ,
    because a drive also answers requests with another number of stop bits.
    """

    address: int
    settings: Settings
    framing: Framing
    models: tuple[str, ...]
    response_delay: float  # in s
    doubt: str = ""


@dataclass(frozen=True)
class Crowd:
    """An address whose replies never match the request; probably several drives have this address.

    If a reply had a valid checksum, `reply` says why it does not match; else `reply` is empty.
    """

    address: int
    settings: Settings
    framing: Framing
    reply: str = ""


@dataclass(frozen=True)
class Noise:
    """A line setting at which so many addresses gave invalid bytes that these are probably noise."""

    settings: Settings
    framing: Framing
    garbled: int
    asked: int


@dataclass(frozen=True)
class Untried:
    """A line setting that was skipped because the port does not support it."""

    settings: Settings
    framing: Framing
    reason: str


@dataclass(frozen=True)
class Progress:
    """A report after each address. `left` is the scan's remaining time in s if no further drive answers."""

    settings: Settings
    framing: Framing
    address: int
    left: float


Finding = Found | Crowd | Noise | Untried | Progress


# ---- the plant file ----


def candidate(family: type[Drive], settings: Settings, framing: Framing, address: int) -> Drive | None:
    """Return a drive object of the family; None if its manual excludes this framing, address or baud rate.

    A format that the manual excludes is replaced by the family's usual format, because a drive also answers
    requests that have another number of stop bits.
    """
    if not family.speaks(framing) or address not in family.addresses:
        return None
    if framing is Framing.TCP:  # the serial settings are set in the Modbus gateway, not here
        return family(address, framing=framing)
    if settings.baudrate not in family.baudrates:
        return None
    format = settings.format if settings.format in family.formats_in(framing) else None
    return family(address, framing=framing, baudrate=settings.baudrate, format=format)


def plant_text(
    port: str,
    found: Sequence[Found],
    families: Mapping[str, type[Drive]],
    rs485: RS485 = RS485.OFF,
    settle: float = 0.0,
) -> str:
    """Return the text of a plant file with the found drives; doubts about a drive become comments.

    `families` maps each model name in the plant file to its class.
    Raises ValueError if the scan found no drive of a known family.
    """
    names = {family.model or family.__name__: name for name, family in families.items()}
    taken: dict[int, str] = {}
    switch = f'rs485 = "{rs485}"\n' if rs485 is not RS485.OFF else ""
    wait = f'settle = "{round(settle * 1e3, 3):g} ms"\n' if settle else ""
    tables = [f'[[line]]\nname = "line-1"\nport = {_text(port)}\n{switch}{wait}']
    for device in sorted(found, key=lambda device: (not device.models, device.address)):
        address = device.address
        if not device.models:
            unknown = f"an unknown Modbus device at {line_setting(device.settings, device.framing)}"
            tables.append(f"# address {address}: {unknown}\n")
            continue
        model = names[device.models[0]]
        lines = list(_drive(device, model, families[model]))
        if address in taken:
            reason = f"# {taken[address]} has this address too: give one of them another, then use this"
            lines = [reason, *(f"# {line}" for line in lines)]
        taken.setdefault(address, f"{device.models[0]}-{address}")
        tables.append("\n".join(lines) + "\n")
    if not taken:
        raise ValueError("no drive of a known family was found, so no plant file can be written")
    return "\n".join(tables)


def _drive(device: Found, model: str, family: type[Drive]) -> Iterator[str]:
    drive = candidate(family, device.settings, device.framing, device.address)
    assert drive is not None  # an identified drive always has settings that its family allows
    yield "[[line.drive]]"
    if device.doubt:
        yield f"# {device.doubt}"
    if len(device.models) > 1:
        yield f"# it may as well be {' or '.join(device.models[1:])}"
    yield f"name = {_text(f'{device.models[0]}-{device.address}')}"
    yield f"model = {_text(model)}"
    yield f"address = {device.address}"
    yield f'framing = "{device.framing}"'
    if device.framing is not Framing.TCP:
        yield f"baudrate = {drive.settings.baudrate}"
        yield f'format = "{drive.settings.format}"'
    if GUESS in device.doubt and "confirmed" in family.options:
        yield "# confirmed = 1  # once its name plate says so: before, nothing is written to it"


def _text(value: str) -> str:
    """Quote a path or name as a basic string of TOML. For these texts, JSON has the same syntax."""
    return json.dumps(value, ensure_ascii=False)
