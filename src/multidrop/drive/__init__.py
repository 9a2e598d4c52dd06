"""Drives as their manuals describe them, without I/O: registers, facts of the line, verbs."""

from multidrop.core import Framing
from multidrop.drive.family import Drive
from multidrop.drive.options import Option
from multidrop.drive.script import Read, Script, Wait, carry_out, insist, read, until, wait, write
from multidrop.drive.state import Condition, Direction, State
from multidrop.drive.verbs import verb
from multidrop.errors import (
    ANOTHER_FAMILY,
    Advice,
    BusError,
    DriveException,
    NotVerified,
    Unconfirmed,
    Unsupported,
    WriteForbidden,
)

__all__ = [
    "ANOTHER_FAMILY",
    "Advice",
    "BusError",
    "Condition",
    "Direction",
    "Drive",
    "DriveException",
    "Framing",
    "NotVerified",
    "Option",
    "Read",
    "Script",
    "State",
    "Unconfirmed",
    "Unsupported",
    "Wait",
    "WriteForbidden",
    "carry_out",
    "insist",
    "read",
    "until",
    "verb",
    "wait",
    "write",
]
