"""Memory of a polling process, limited for small machines."""

from __future__ import annotations

import subprocess
import sys

import pytest

MOST_MB = 30.0
POLLER = """
import os, re, tempfile
from pathlib import Path
from multidrop import InnovertIBD, Plant, Poller, open_writer
from multidrop.plant.model import PlantLine, Polled, PolledDrive

_, slave = os.openpty()
drives = [InnovertIBD(address, name=f"drive-{address}") for address in range(1, 32)]
polled = tuple(PolledDrive(each, tuple(Polled(r, None) for r in each.readings())) for each in drives)
plant = Plant((PlantLine("hall", os.ttyname(slave), None, None, polled),), Path())
with tempfile.TemporaryDirectory() as folder, Poller(plant) as poller:
    with open_writer(Path(folder, "run.arrows"), plant.metadata()) as out:
        for batch in poller.batches(2.0):
            out.write(batch)
print(re.search(r"VmHWM:\\s+(\\d+) kB", Path("/proc/self/status").read_text())[1])
"""


@pytest.mark.long
@pytest.mark.uncounted
@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the kernel tells the memory")
def test_a_recording_poller_of_31_drives_takes_at_most_30_mb() -> None:
    ran = subprocess.run([sys.executable, "-c", POLLER], capture_output=True, text=True, check=True)
    assert 5.0 < int(ran.stdout) / 1024 <= MOST_MB
