"""Late replies to requests of another process that used the line before."""

from __future__ import annotations

import pytest
from stories import PathWire, bus_over, constant, read_truly
from tables import table
from variants import LINES, of_one_variant

from multidrop.core import build_request
from multidrop.drive import Drive
from multidrop.planning.blocks import blocks
from multidrop.sim import EncodedDrive, Faults

BEGIN = 1000.0  # s; the start of these lines' clock
DELAY = 0.1  # s, of the path


def answer_to_another(drive: Drive) -> bytes:
    """Return a drive's reply to a read of its second register."""
    wire = PathWire([EncodedDrive(drive)], Faults())
    wire.delay = constant(0.0)
    wire.open()
    (block,) = blocks(drive, [drive.readings()[1]])
    wire.advance(BEGIN)
    wire.receive(build_request(drive.framing, block.request), BEGIN, drive.settings.baudrate)
    said = b""
    for step in range(2000):
        said += wire.advance(BEGIN + step / 1000)
    assert said
    return said


@pytest.mark.long
@table("name", LINES)
def test_its_answer_is_taken_for_no_other_register_s(name: str) -> None:
    """Every value is the register's own, from the first on."""
    drives = of_one_variant(LINES[name])
    wire = PathWire([EncodedDrive(drive) for drive in drives], Faults())
    wire._path.append((BEGIN + DELAY / 2, answer_to_another(drives[0])))
    with pytest.MonkeyPatch.context() as patch:
        opened, line = bus_over(wire, constant(DELAY), [EncodedDrive(drive) for drive in drives], patch)
        read_truly(opened, line, drives)
