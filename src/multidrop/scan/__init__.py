"""Finding the drives on a line whose settings nobody knows, by reading and nothing else."""

from multidrop.scan.plant_writer import plant_text
from multidrop.scan.results import Crowd, Finding, Found, Noise, Progress, Untried
from multidrop.scan.scanner import scan
from multidrop.scan.sweep import ADDRESSES, Question, Sweep, one_of_each_framing, sweeps

__all__ = [
    "ADDRESSES",
    "Crowd",
    "Finding",
    "Found",
    "Noise",
    "Progress",
    "Question",
    "Sweep",
    "Untried",
    "one_of_each_framing",
    "plant_text",
    "scan",
    "sweeps",
]
