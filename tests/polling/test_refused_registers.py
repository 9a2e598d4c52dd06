"""A refused register is found, set aside and reported, and its neighbours are still read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from clocked_lines import ClockedLines, ClockedWire
from lines import patient, polled
from toy import Toy

from multidrop.plant.model import Plant, PlantLine, Polled, PolledDrive
from multidrop.poller import Poller
from multidrop.polling import refusals
from multidrop.sim import Faults, SimulatedDrive, Simulator, Wire
from multidrop.sim.protocol import Reason, Refusal

POLLED = ("output_frequency", "output_current", "mystery", "fault", "status")
REFUSED = Toy.mystery


class Stubborn(SimulatedDrive):
    """Refuses every read that touches one of its registers."""

    def read(self, function: int, start: int, count: int) -> list[int]:
        if start <= REFUSED.address < start + count:
            raise Refusal(Reason.READ_ADDRESS)
        return super().read(function, start, count)


@pytest.mark.slow
@patient
def test_a_refused_register_is_set_aside_and_its_neighbours_are_read() -> None:
    with Simulator([Wire([Stubborn(Toy(1))], unpaced=True)]) as simulator:
        drive = Toy(1, name="pump-1")
        polls = tuple(Polled(drive.register(name), None) for name in POLLED)
        line = PlantLine("hall-1", simulator.wires[0].path, None, None, (PolledDrive(drive, polls),))
        seen: dict[str, int] = {}
        refused = 0
        with Poller(Plant((line,), Path("hall.toml"))) as poller:
            for batch in poller.batches():
                for row in batch:
                    if row.value is None:
                        assert row.status == "exception 02"
                        refused += 1
                    else:
                        seen[row.register] = seen.get(row.register, 0) + 1
                if len(seen) == len(POLLED) - 1 and min(seen.values()) > 10:
                    break
            told = poller.summary()["lines"]["hall-1"]
    assert set(seen) == set(POLLED) - {REFUSED.name}
    assert told["set_aside"] == ["pump-1.mystery"]
    queued_ahead = 256 * len(POLLED)
    assert refused <= 2 * queued_ahead  # only queued requests still read it


class Moody(SimulatedDrive):
    """Answers every read with an exception, as long as it has one."""

    says: Reason | None = None

    def read(self, function: int, start: int, count: int) -> list[int]:
        if self.says:
            raise Refusal(self.says)
        return super().read(function, start, count)


@pytest.mark.parametrize(
    ("says", "is_set_aside"), [(Reason.BUSY, False), (Reason.READ_ADDRESS, True)], ids=["busy", "refused"]
)
@pytest.mark.parametrize("registers", [[Toy.output_current, Toy.fault], [Toy.fault]], ids=["two", "one"])
def test_what_is_read_after_all_is_polled_as_before(
    says: Reason, is_set_aside: bool, registers: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(refusals, "SET_ASIDE_NS", 1_000_000_000)
    drive, moody = Toy(1, name="pump-1"), Moody(Toy(1))
    with ClockedLines(ClockedWire([moody], Faults()), [polled(drive, registers)]) as clocked:
        before = len(clocked.run(1.0))
        moody.says = says
        clocked.run(2.0)
        line = clocked.poller.summary()["lines"]["line"]
        assert bool(line["set_aside"]) is is_set_aside
        moody.says = None
        clocked.run(2.0)
        rows = clocked.run(1.0)
        assert clocked.poller.summary()["lines"]["line"]["set_aside"] == []
    assert {row.status for row in rows} == {"ok"}
    assert len(rows) > before / 4
