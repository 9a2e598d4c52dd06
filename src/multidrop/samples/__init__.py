"""Rows on their way from a poller to a store: messages, the spool on disk, and their tables in PostgreSQL."""

from multidrop.samples.message import ROWS as ROWS
from multidrop.samples.message import MessageError as MessageError
from multidrop.samples.message import PolledUnits as PolledUnits
from multidrop.samples.message import SinkError as SinkError
from multidrop.samples.message import unit_of as unit_of
from multidrop.samples.message import unpack as unpack
from multidrop.samples.spool import Spool as Spool
from multidrop.samples.spool import SpoolState as SpoolState
from multidrop.samples.spool import StoredMessage as StoredMessage
