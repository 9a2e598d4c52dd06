"""Poll, record and write in a forked process until killed, and report the rows and writes on disk.

Each line of standard input, PORT DIRECTORY LIFE NUMBER, forks such a process; its id and its exit status are
printed. It records into DIRECTORY/LIFE.arrows and .csv, and writes NUMBER and the following numbers to the
drive. As soon as a call has returned, it appends to DIRECTORY/LIFE.told:
    rows N      both recordings have N rows
    wrote N     the number N was written
All these processes share the EEPROM ledger and the audit log in DIRECTORY.
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
    """A drive that counts its reads, and has a writable register, `number`, not declared as RAM or EEPROM."""

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
    log = (directory / f"{life}.told").open("wb", buffering=0)
    drive = Counted(1, name=NAME)
    polled = PolledDrive(drive, (Polled(Counted.count, None),))
    plant = Plant((PlantLine("line", port, None, None, (polled,)),), directory / "plant.toml")
    writers = [open_writer(directory / f"{life}{suffix}", METADATA) for suffix in (".arrows", ".csv")]
    log.write(b"rows 0\n")
    with Poller(plant, ledger=ledger(directory), audit=audit(directory)) as poller:
        for at in count(number):
            while batch := poller.take():
                for writer in writers:
                    writer.write(batch)
                log.write(b"rows %d\n" % writers[0].rows)
            drive.write(Counted.number, at)
            log.write(b"wrote %d\n" % at)


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
