"""Find the drives on a line whose settings nobody knows, by reading only."""

from multidrop.scan.plant_writer import plant_text
from multidrop.scan.results import Crowd, Finding, Found, Noise, Progress, Untried
from multidrop.scan.scanner import scan
from multidrop.scan.sweep import ADDRESSES, ScanRequest, Sweep, one_of_each_framing, sweeps

__all__ = [
    "ADDRESSES",
    "Crowd",
    "Finding",
    "Found",
    "Noise",
    "Progress",
    "ScanRequest",
    "Sweep",
    "Untried",
    "one_of_each_framing",
    "plant_text",
    "scan",
    "sweeps",
]
