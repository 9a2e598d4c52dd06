"""Polling: the requests that are sent to a line, their order, refused registers, and batches of rows."""

from multidrop.polling.batch import BatchColumns as BatchColumns
from multidrop.polling.batch import WideRows as WideRows
from multidrop.polling.batch import slot_rows as slot_rows
