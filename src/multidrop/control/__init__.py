"""Control: everything that is written to a drive, and every stop."""

from multidrop.control.audit_log import AuditLog as AuditLog
from multidrop.control.audit_log import read_audit as read_audit
from multidrop.control.author import noted_first as noted_first
from multidrop.control.author import written_by as written_by
from multidrop.control.eeprom_ledger import Ledger as Ledger
from multidrop.control.outcome import Effect as Effect
from multidrop.control.ramp import start_staggered as start_staggered
from multidrop.control.repeated_stops import RepeatedStops as RepeatedStops
from multidrop.control.time_limit import written_before as written_before
