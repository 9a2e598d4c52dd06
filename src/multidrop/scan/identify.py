"""Which family an answering drive is of: its readings are asked for what each family's document says.

Only reads are sent. Families without a look of their own are the likelier the more of the documented
readings are there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

from multidrop.core import Framing, Message, raw_value
from multidrop.drive.family import Drive
from multidrop.drive.register import Register
from multidrop.drive.script import Read, Script
from multidrop.drive.timing import Settings
from multidrop.errors import BusError, Refused
from multidrop.planning.blocks import blocks
from multidrop.scan.results import GUESS
from multidrop.scan.sweep import Sweep

Ask = Callable[[Drive, Message], Message]  # raises BusError where nothing good comes

MOST_READINGS = 3  # that are looked at where a family has no look of its own


def recognise(
    sweep: Sweep, address: int, families: Sequence[type[Drive]], ask: Ask
) -> tuple[list[Drive], str]:
    """Drives of the families that fit best, and what is to be doubted.

    There are several where they fit alike, and none where none fits.
    """
    found = [candidate(family, sweep.settings, sweep.framing, address) for family in families]
    drives = [drive for drive in found if drive is not None]
    scores: list[tuple[int, Drive]] = []
    for drive in drives:
        with suppress(BusError, ValueError):  # what it must have is not there
            scores.append((_score(drive, ask), drive))
    if scores:
        best = max(score for score, _ in scores)
        return [drive for score, drive in scores if score == best], ""
    alike = [drive for drive in drives if _resembles(drive, ask)]
    return alike, GUESS if alike else ""


def candidate(family: type[Drive], settings: Settings, framing: Framing, address: int) -> Drive | None:
    """A drive of the family that would answer so; None where its document does not allow it.

    A drive with two stop bits, or with a parity that a pseudo-terminal does not show, answers in the
    format of the sweep too: then it has the family's usual one.
    """
    if framing not in family.framings or address not in family.addresses:
        return None
    if settings.baudrate not in family.baudrates:
        return None
    format = settings.format if settings.format in family.formats[framing] else None
    return family(address, framing=framing, baudrate=settings.baudrate, format=format)


def _score(drive: Drive, ask: Ask) -> int:
    """How much speaks for the family; raises where something speaks against it."""
    score = 0
    if type(drive).identify is not Drive.identify:
        _perform(drive, drive.identify.script(), ask)
        score += 1
    else:
        for register in drive.readings()[:MOST_READINGS]:
            _read(drive, register, ask)
    setting = drive.registers.get("address_setting")
    if setting is not None and setting.readable:
        try:
            held = _read(drive, setting, ask)
        except BusError:
            return score  # not every firmware has it
        if held != drive.address:
            raise Refused(f"{drive.name} holds {held:g} as its address")
        score += 1
    return score


def _resembles(drive: Drive, ask: Ask) -> bool:
    with suppress(BusError, ValueError):
        return bool(_perform(drive, drive.resembles(), ask))
    return False


def _perform(drive: Drive, script: Script[Any], ask: Ask) -> Any:
    """Carry a look out, which only reads; what it says."""
    try:
        step = next(script)
        while True:
            if not isinstance(step, Read):
                raise Refused(f"the look at {drive.title} does more than read")
            try:
                value = _read(drive, step.register, ask)
            except BusError as failure:
                step = script.throw(failure)
            else:
                step = script.send(value)
    except StopIteration as end:
        return end.value


def _read(drive: Drive, register: Register[Any], ask: Ask) -> Any:
    (block,) = blocks(drive, [register])
    reply = ask(drive, block.request)
    return register.decode(raw_value(reply.data, block.offset(register), register.number_format))
