"""Drives of every family in each of its framings, for one line."""

from __future__ import annotations

from multidrop.core import Framing, Status
from multidrop.drive import Drive
from multidrop.families import YD1000, DelixiModbus, DelixiNative, ErmanERG220, InnovertIBD, InvtCHE
from multidrop.sim import EncodedDrive, Wire

VARIANTS = (  # family, framing, and baud rate for `fast_drives`
    (ErmanERG220, Framing.RTU, 1_000_000),
    (InvtCHE, Framing.RTU, 500_000),
    (InnovertIBD, Framing.RTU, 500_000),
    (InnovertIBD, Framing.ASCII, 1_000_000),
    (DelixiModbus, Framing.RTU, 500_000),
    (DelixiModbus, Framing.ASCII, 1_000_000),
    (DelixiNative, Framing.DELIXI, 500_000),
    (YD1000, Framing.RTU, 1_000_000),
)
REASONS = {str(each) for each in Status} - {str(Status.OK)}
TIMEOUT = 0.02  # s, the shortest timeout; the client learns it, because these drives mostly reply immediately
LATEST = 3 * TIMEOUT


def real_drives() -> list[Drive]:
    return [
        family(address, name=f"{family.model} {framing}", framing=framing)
        for address, (family, framing, _) in enumerate(VARIANTS, 1)
    ]


def fast_drives() -> list[Drive]:
    """Return the drives with almost no character times and silences."""
    return [
        type(family.__name__, (family,), {"baudrates": (baudrate,), "needed_silence": lambda drive: 0.0})(
            address, name=f"{family.model} {framing}", framing=framing
        )
        for address, (family, framing, baudrate) in enumerate(VARIANTS, 1)
    ]


def real_wires() -> list[Wire]:
    return [Wire([EncodedDrive(drive) for drive in real_drives()])]


def of_one_variant(number: int) -> list[Drive]:
    """Return two drives of one family and framing."""
    family, framing, _ = VARIANTS[number]
    return [family(address, name=f"drive-{address}", framing=framing) for address in (1, 2)]


def of_all_variants() -> list[Drive]:
    return [
        family(address, name=f"drive-{address}", framing=framing)
        for address, (family, framing, _) in enumerate(VARIANTS, 1)
    ]


LINES = {f"{family.model} {framing}": number for number, (family, framing, _) in enumerate(VARIANTS)}
