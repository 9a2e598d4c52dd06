"""A client that polls, records and writes, and says what it has on disk, until it is killed.

A line of standard input is a life: PORT DIRECTORY LIFE NUMBER. Each is a process of its own, forked
from this one, which has imported everything; its id is printed, and what it died of. A life records
into DIRECTORY/LIFE.arrows and .csv, writes NUMBER and the numbers after it to the drive, and appends
to DIRECTORY/LIFE.told, each as soon as the call has returned:
    rows N      so many rows are in both recordings
    wrote N     the number N was written
Ledger and audit log are those of DIRECTORY, for all lives.
"""

from __future__ import annotations

import os
import sys
import traceback
from itertools import count
from pathlib import Path

from multidrop.control.eeprom_ledger import Ledger
from multidrop.core import NumberFormat
from multidrop.drive import Drive, Framing
from multidrop.drive.register import HOLDING, reading, setting
from multidrop.plant.model import Plant, PlantLine, Polled, PolledDrive
from multidrop.poller import Poller
from multidrop.recording import open_writer

METADATA = {"plant": "counted.toml"}
NAME = "counted"


class Counted(Drive):
    """A drive that counts how often it was read; nobody knows where it keeps the number."""

    framings = (Framing.RTU,)
    baudrates = (115_200,)
    most_registers = {HOLDING: 2}
    response_delay = 0.0
    response_timeout = 5.0

    number = setting(10)
    count = reading(0, number_format=NumberFormat.U32)


def ledger(directory: Path) -> Ledger:
    return Ledger(directory / "wear.sqlite", budget=10**9)


def audit(directory: Path) -> Path:
    return directory / "audit.jsonl"


def live(port: str, directory: Path, life: str, number: int) -> None:
    told = (directory / f"{life}.told").open("wb", buffering=0)
    drive = Counted(1, name=NAME)
    polled = PolledDrive(drive, (Polled(Counted.count, None),))
    plant = Plant((PlantLine("line", port, None, None, (polled,)),), directory / "plant.toml")
    writers = [open_writer(directory / f"{life}{suffix}", METADATA) for suffix in (".arrows", ".csv")]
    told.write(b"rows 0\n")
    with Poller(plant, ledger=ledger(directory), audit=audit(directory)) as poller:
        for at in count(number):
            while batch := poller.take():
                for writer in writers:
                    writer.write(batch)
                told.write(b"rows %d\n" % writers[0].rows)
            drive.write(Counted.number, at)
            told.write(b"wrote %d\n" % at)


def main() -> None:
    for line in sys.stdin:
        port, directory, life, number = line.split()
        process = os.fork()
        if process == 0:
            try:
                live(port, Path(directory), life, int(number))
            except BaseException:
                traceback.print_exc()
            os._exit(1)
        print(process, flush=True)
        print(os.waitpid(process, 0)[1], flush=True)


if __name__ == "__main__":
    main()
