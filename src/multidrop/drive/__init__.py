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
    DriveRefused,
    NotDone,
    Refused,
    Unconfirmed,
    Unsupported,
)

__all__ = [
    "ANOTHER_FAMILY",
    "Advice",
    "BusError",
    "Condition",
    "Direction",
    "Drive",
    "DriveRefused",
    "Framing",
    "NotDone",
    "Option",
    "Read",
    "Refused",
    "Script",
    "State",
    "Unconfirmed",
    "Unsupported",
    "Wait",
    "carry_out",
    "insist",
    "read",
    "until",
    "verb",
    "wait",
    "write",
]
