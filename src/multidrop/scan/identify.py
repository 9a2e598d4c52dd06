"""Identify the family of a drive that answers: read what each family's document says it must have.

Only reads are sent. A family without an `identify` script must answer its first readings.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, TypeVar

from multidrop.core import Framing, Message
from multidrop.drive.family import Drive
from multidrop.drive.register import Register
from multidrop.drive.script import Read, Script, Step, carry_out
from multidrop.drive.text import Text
from multidrop.drive.timing import Settings
from multidrop.errors import BusError, NoValue, WriteForbidden
from multidrop.planning.blocks import blocks, text_blocks
from multidrop.scan.results import GUESS
from multidrop.scan.sweep import Sweep

R = TypeVar("R")
Ask = Callable[[Drive, Message], Message]  # sends a request; raises BusError without a good reply

MOST_READINGS = 3  # that a family without an `identify` script must answer


def identify(
    sweep: Sweep, address: int, families: Sequence[type[Drive]], ask: Ask
) -> tuple[list[Drive], str]:
    """Return drives of the families that fit best, and the doubt that is left.

    There are several where they fit equally well, and none where none fits.
    """
    found = [candidate(family, sweep.settings, sweep.framing, address) for family in families]
    drives = [drive for drive in found if drive is not None]
    scores: list[tuple[int, Drive]] = []
    for drive in drives:
        with suppress(BusError, ValueError):  # a register that it must have is missing
            scores.append((_score(drive, ask), drive))
    if scores:
        best = max(score for score, _ in scores)
        return [drive for score, drive in scores if score == best], ""
    alike = [drive for drive in drives if _resembles(drive, ask)]
    return alike, GUESS if alike else ""


def candidate(family: type[Drive], settings: Settings, framing: Framing, address: int) -> Drive | None:
    """Return a drive of the family with these settings; None where its document does not allow them.

    A drive with two stop bits, or on a pseudo-terminal with another parity, answers in the sweep's
    format too: it is given the family's usual one.
    """
    if not family.speaks(framing) or address not in family.addresses:
        return None
    if framing is Framing.TCP:  # the gateway knows the settings
        return family(address, framing=framing)
    if settings.baudrate not in family.baudrates:
        return None
    format = settings.format if settings.format in family.formats_in(framing) else None
    return family(address, framing=framing, baudrate=settings.baudrate, format=format)


def _score(drive: Drive, ask: Ask) -> int:
    """Return the number of checks that speak for the family. Raises where one speaks against it."""
    score = 0
    if type(drive).identify is not Drive.identify:
        _run(drive, drive.identify.script(), ask)
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
            raise WriteForbidden(f"{drive.name} holds {held:g} as its address")
        score += 1
    return score


def _resembles(drive: Drive, ask: Ask) -> bool:
    with suppress(BusError, ValueError):
        return bool(_run(drive, drive.resembles(), ask))
    return False


def _run(drive: Drive, script: Script[R], ask: Ask) -> R:
    """Carry a script out that only reads; return its result. Raises WriteForbidden for any other step."""

    def do(step: Step) -> Any:
        if not isinstance(step, Read):
            raise WriteForbidden(f"the look at {drive.title} does more than read")
        return _read(drive, step.register, ask)

    return carry_out(script, do)


def _read(drive: Drive, register: Register[Any] | Text, ask: Ask) -> Any:
    if isinstance(register, Text):
        found = text_blocks(drive, register)
        return register.decode(b"".join(ask(drive, block.request).data for block in found))
    (block,) = blocks(drive, [register])
    reply = ask(drive, block.request)
    value = register.value_in(reply.data, block.offset(register))
    if value is None:
        raise NoValue(drive.name, register.name)
    return value
