"""Ports, and exchanges on them: the only room of the library that talks to the operating system's ports."""

from multidrop.transport.statistics import Delays as Delays
from multidrop.transport.statistics import Diagnostics as Diagnostics
from multidrop.transport.statistics import LineStatistics as LineStatistics
from multidrop.transport.statistics import Statistics as Statistics
