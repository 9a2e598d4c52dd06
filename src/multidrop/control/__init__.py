"""Control: everything that is written to a drive, and every stop.

The command service of gateways is in `multidrop.control.commands`; it is not imported here, because it loads
asyncio.
"""

from multidrop.control.call import written_before as written_before
from multidrop.control.eeprom_ledger import Ledger as Ledger
from multidrop.control.outcome import Effect as Effect
from multidrop.control.outcome import Outcome as Outcome
from multidrop.control.outcome import Seen as Seen
from multidrop.control.outcome import result_of_failure as result_of_failure
from multidrop.control.outcome import with_name as with_name
from multidrop.control.ramp import start_staggered as start_staggered
from multidrop.control.records import AuditLog as AuditLog
from multidrop.control.records import noted_first as noted_first
from multidrop.control.records import read_audit as read_audit
from multidrop.control.records import written_by as written_by
from multidrop.drive.verbs import CommandOutcome as CommandOutcome
from multidrop.drive.verbs import CommandResult as CommandResult
from multidrop.errors import NotAttached as NotAttached
