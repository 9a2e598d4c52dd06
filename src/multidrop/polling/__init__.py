"""Polling: jobs of a line, their turn on its port, registers that are refused, and batches of rows."""

from multidrop.polling.batch import BatchColumns as BatchColumns
from multidrop.polling.tables import WideRows as WideRows
