"""Drive classes as their manuals describe them: registers, line settings, timing and commands. No I/O."""

from multidrop.core import Framing
from multidrop.drive.declaration_check import DeclarationError as DeclarationError
from multidrop.drive.family import Drive
from multidrop.drive.family import verbs_of as verbs_of
from multidrop.drive.known_state import FAULT_RECORDS as FAULT_RECORDS
from multidrop.drive.known_state import StateReader as StateReader
from multidrop.drive.known_state import can_show_fault as can_show_fault
from multidrop.drive.number_format import SIGNED as SIGNED
from multidrop.drive.options import Option
from multidrop.drive.register import COIL as COIL
from multidrop.drive.register import DISCRETE as DISCRETE
from multidrop.drive.register import HOLDING as HOLDING
from multidrop.drive.register import HOLDING_MULTIPLE as HOLDING_MULTIPLE
from multidrop.drive.register import INPUT as INPUT
from multidrop.drive.register import Access as Access
from multidrop.drive.register import Carrier as Carrier
from multidrop.drive.register import Kept as Kept
from multidrop.drive.register import Table as Table
from multidrop.drive.register import chosen_language as chosen_language
from multidrop.drive.request import DEVICE_ID as DEVICE_ID
from multidrop.drive.request import MEI_DEVICE_ID as MEI_DEVICE_ID
from multidrop.drive.request import SERVER_ID as SERVER_ID
from multidrop.drive.request import STATUS as STATUS
from multidrop.drive.state import Condition, Direction, State
from multidrop.drive.text import Text as Text
from multidrop.drive.verbs import CommandOutcome as CommandOutcome
from multidrop.drive.verbs import CommandResult as CommandResult
from multidrop.drive.verbs import Read, Script, Wait, carry_out, insist, read, until, verb, wait, write
from multidrop.drive.verbs import verb_arguments as verb_arguments
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
    "COIL",
    "DISCRETE",
    "FAULT_RECORDS",
    "HOLDING",
    "HOLDING_MULTIPLE",
    "INPUT",
    "Access",
    "Advice",
    "BusError",
    "Carrier",
    "CommandOutcome",
    "CommandResult",
    "Condition",
    "DeclarationError",
    "Direction",
    "Drive",
    "DriveException",
    "Framing",
    "Kept",
    "NotVerified",
    "Option",
    "Read",
    "Script",
    "State",
    "StateReader",
    "Table",
    "Text",
    "Unconfirmed",
    "Unsupported",
    "Wait",
    "WriteForbidden",
    "can_show_fault",
    "carry_out",
    "insist",
    "read",
    "until",
    "verb",
    "verb_arguments",
    "verbs_of",
    "wait",
    "write",
]
