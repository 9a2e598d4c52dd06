"""Run a client in a forked process that may be killed at any moment.

Each line of standard input forks such a process, which is fast, because everything is imported. Its id is
printed and, when it ends, its exit status. The lines are:
    poll PORT DIRECTORY LIFE NUMBER    poll, record into DIRECTORY/LIFE.arrows and .csv, and write NUMBER
                                       and the following numbers to the drive, until killed
    apply PORT FILE REPORT             apply a parameter file; record own and earlier writes in REPORT

As soon as a call has returned, a polling client appends to DIRECTORY/LIFE.told:
    rows N      both recordings have N rows
    wrote N     the number N was written
All polling clients share the EEPROM ledger and the audit log in DIRECTORY.
"""

from __future__ import annotations

import os
import sys
import time
import traceback
from itertools import count
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).parents[1] / "simulated"))

from patient import await_turns

from multidrop import Bus, BusError, DelixiNative, params
from multidrop.control.eeprom_ledger import Ledger
from multidrop.core import NumberFormat
from multidrop.drive import Drive, Framing
from multidrop.drive.register import HOLDING, reading, setting
from multidrop.plant.model import Plant, PlantLine, Polled, PolledDrive
from multidrop.poller import Poller
from multidrop.recording import open_writer

METADATA = {"plant": "counted.toml"}
NAME = "counted"
DRIVE: Any = {"address": 1, "baudrate": 38400}  # the drive to which parameters are applied
TRIES = 20  # attempts per call; a busy machine may miss replies


class Counted(Drive):
    """A drive that counts its reads; its register `number` is writable, but not declared as RAM or EEPROM."""

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


def poll(port: str, directory: Path, life: str, number: int) -> None:
    log = (directory / f"{life}.told").open("wb", buffering=0)
    drive = Counted(1, name=NAME)
    polled = PolledDrive(drive, (Polled(Counted.count, None),))
    plant = Plant((PlantLine("line", port, drives=(polled,)),), directory / "plant.toml")
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


def apply(port: str, file: str, report: str) -> None:
    reported: list[str] = []
    for _ in range(TRIES):
        try:
            with Bus(port, expiry=60) as bus:
                drive = bus.attach(DelixiNative, **DRIVE)
                result = params.apply(drive, params.load(file), commissioning=True)
        except BusError:
            time.sleep(0.1)
            continue
        reported += [*(change.parameter.code for change in result.written), *result.earlier]
        if result.ok:
            break
    else:
        raise SystemExit("the application does not end")
    Path(report).write_text("\n".join(reported))


def main() -> None:
    await_turns(setattr, dict.__setitem__)  # lets writes wait longer than 1 s, for busy machines
    for line in sys.stdin:
        process = os.fork()
        if process == 0:
            status = 1
            try:
                live(*line.split())
                status = 0
            except BaseException:
                traceback.print_exc()
            os._exit(status)
        print(process, flush=True)
        print(os.waitpid(process, 0)[1], flush=True)


def live(action: str, port: str, *words: str) -> None:
    if action == "apply":
        apply(port, *words)
    else:
        directory, life, number = words
        poll(port, Path(directory), life, int(number))


if __name__ == "__main__":
    main()
