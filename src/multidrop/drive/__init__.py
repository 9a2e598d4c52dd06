"""A drive as its manual describes it, without I/O: all names that a family's file needs."""

from multidrop.core import Framing
from multidrop.drive.family import LONGEST_SILENCE, START_TIME, Drive
from multidrop.drive.script import (
    Insist,
    Pulse,
    Read,
    Script,
    Step,
    Wait,
    Write,
    carry_out,
    insist,
    read,
    until,
    wait,
    write,
)
from multidrop.drive.state import Condition, Direction, State
from multidrop.drive.verbs import MOVING, STOPPING, VERBS, Option, verb
from multidrop.errors import Advice, BusError, DriveRefused, NotDone, Refused, Unconfirmed, Unsupported

__all__ = [
    "LONGEST_SILENCE",
    "MOVING",
    "START_TIME",
    "STOPPING",
    "VERBS",
    "Advice",
    "BusError",
    "Condition",
    "Direction",
    "Drive",
    "DriveRefused",
    "Framing",
    "Insist",
    "NotDone",
    "Option",
    "Pulse",
    "Read",
    "Refused",
    "Script",
    "State",
    "Step",
    "Unconfirmed",
    "Unsupported",
    "Wait",
    "Write",
    "carry_out",
    "insist",
    "read",
    "until",
    "verb",
    "wait",
    "write",
]
