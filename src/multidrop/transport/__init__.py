"""Ports, and exchanges on them. This is the only package of the library that uses the system's ports."""

from multidrop.transport.aside_log import AsideThread as AsideThread
from multidrop.transport.statistics import Delays as Delays
from multidrop.transport.statistics import Diagnostics as Diagnostics
from multidrop.transport.statistics import LineStatistics as LineStatistics
from multidrop.transport.statistics import Statistics as Statistics
