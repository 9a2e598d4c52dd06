"""Replies that are lost, damaged, doubled, merged, truncated or amid junk: no value is misattributed.

test_hostile_line.py has more kinds of faults. Here the far end is independent of the library: the drives'
registers, the checksums, and the check of sent frames. A seed reproduces the faults and their order; the port
and the time are real. A longer run:
`HOSTILE_SEEDS=50 pytest -m "" tests/control/test_hostile_responder.py`.
"""

from __future__ import annotations

import os
import random
import threading
from collections import Counter
from contextlib import suppress
from pathlib import Path

import checksums
import pytest
from examples import usually
from lines import line, plant, polled, rows_of, until
from motors import quick
from responder import Responder, ResponderLine
from responder_drives import KINDS, ResponderDrive
from variants import REASONS

from multidrop.drive import Drive
from multidrop.errors import BusError
from multidrop.plant.model import PolledDrive
from multidrop.poller import Poller
from multidrop.polling.batch import Row

SEEDS = range(int(os.environ.get("HOSTILE_SEEDS", "1")))
FRAMES = usually(60, 160)  # number of frames that the far end must receive
STRANGER = 99  # address of a drive that is not polled
MOTOR = "yd1000"
REGISTERS = 5  # limit of polled registers of each drive


class Hostile:
    """Distorts one reply in three, in a random way."""

    def __init__(self, seed: int) -> None:
        self.struck: Counter[str] = Counter()
        self._chance = random.Random(seed)
        self._kept = b""
        self._ways = {
            "lost": lambda said: b"",
            "damaged": self._damaged,
            "doubled": lambda said: said + said,
            "merged": self._merged,
            "cut": lambda said: said[: self._chance.randrange(len(said))],
            "foreign before": lambda said: self._foreign() + said,
            "foreign instead": lambda said: self._foreign(),
            "junk": lambda said: self._chance.randbytes(self._chance.randint(1, 40)) + said,
        }

    def mangle(self, said: bytes) -> bytes:
        kept, self._kept = self._kept, b""
        if said and self._chance.random() < 0.33:
            way = self._chance.choice(list(self._ways))
            self.struck[way] += 1
            said = self._ways[way](said)
        return kept + said

    def _damaged(self, said: bytes) -> bytes:
        at, bit = self._chance.randrange(len(said)), self._chance.randrange(8)
        return said[:at] + bytes([said[at] ^ 1 << bit]) + said[at + 1 :]

    def _merged(self, said: bytes) -> bytes:
        """Keep the reply, and send it together with the next one."""
        self._kept = said
        return b""

    def _foreign(self) -> bytes:
        """Return a valid frame of another master's exchange with the drive STRANGER."""
        count, value = self._chance.randint(1, 4), self._chance.randrange(0x10000)
        words = f"{value:04X}" * count
        return self._chance.choice(
            (
                checksums.rtu(f"{STRANGER:02X}03{2 * count:02X}{words}"),
                checksums.rtu(f"{STRANGER:02X}030010{count:04X}"),
                checksums.rtu(f"{STRANGER:02X}061000{value:04X}"),
                checksums.ascii(f"{STRANGER:02X}03{2 * count:02X}{words}"),
                checksums.delixi(f"{STRANGER:02X}0701F40000{value:04X}"),
            )
        )


def responder_drive(kind: str, drive: PolledDrive) -> ResponderDrive:
    """Return a drive with a different number in each polled register; no number occurs in two drives."""
    found = ResponderDrive(KINDS[kind], drive.drive.address)
    for register, (least, _) in drive.drive.known_counts().items():
        found.hold(register.address, least)
    for at, poll in enumerate(drive.polls):
        found.hold(poll.register.address, value(drive.drive.address, at))
    return found


def value(address: int, at: int) -> int:
    return 1000 * address + 100 * at + 7


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("frames", FRAMES)
def test_no_value_is_misattributed_and_no_motor_moves_without_a_call(frames: int, seed: int) -> None:
    drives: dict[str, Drive] = {
        kind: quick(kind)(address, name=kind, **KINDS[kind].makes) for address, kind in enumerate(KINDS, 1)
    }
    asked = {
        kind: polled(each, [reg for reg in each.readings() if reg.values is None][:REGISTERS])
        for kind, each in drives.items()
    }
    asked[MOTOR] = polled(drives[MOTOR], [])  # not polled: its values change with its motor
    responder_line = ResponderLine([responder_drive(kind, each) for kind, each in asked.items()])
    hostile = Hostile(seed)
    responder_line.mangle = hostile.mangle
    starts: list[str] = []
    over = threading.Event()

    def command() -> None:
        """Start and stop the motor repeatedly."""
        motor = drives[MOTOR]
        while not over.is_set():
            with suppress(BusError):
                motor.set_frequency(20)
            starts.append("called")
            for act in (motor.start, motor.stop):
                with suppress(BusError):
                    act()

    rows: list[Row] = []

    def is_enough() -> bool:
        """Return True if every drive has given a value and the far end has received enough frames."""
        rows.extend(rows_of(poller))
        heard = {row.drive for row in rows if row.value is not None}
        return len(responder_line.log) >= frames and heard == set(drives) - {MOTOR}

    with Responder([responder_line], Path(os.environ["XDG_STATE_HOME"])) as far:
        poller = Poller(plant(line(far.ports[0], *asked.values())))
        with poller:
            commander = threading.Thread(target=command)
            commander.start()
            until(is_enough, patience=120)
            over.set()
            commander.join()
    truth = {
        (kind, poll.register.name): value(each.drive.address, at) * poll.register.scale
        for kind, each in asked.items()
        for at, poll in enumerate(each.polls)
    }
    rows += rows_of(poller)
    samples = [row for row in rows if row.value is not None]
    assert len({*truth.values()}) > len(drives)
    assert [row for row in samples if row.value != float(truth[row.drive, row.register])] == []
    misses = {row.status for row in rows if row.value is None}
    assert {miss for miss in misses if not miss.startswith("exception ")} <= REASONS
    assert [str(each) for each in responder_line.log if each.what == "damaged"] == []
    moves = [str(each) for each in responder_line.log if each.what == "moves"]
    assert len(moves) <= len(starts), "a motor was started that nobody started, or twice"
    assert hostile.struck.total() > frames / 10
