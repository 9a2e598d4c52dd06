"""A register that a drive refuses costs its neighbours nothing: it is found, set aside and reported."""

from __future__ import annotations

from pathlib import Path

from toy import PatientToy, Toy

from multidrop.plant import Line, Plant, Polled, PolledDrive
from multidrop.poller import Poller
from multidrop.sim import SimulatedDrive, Simulator, Wire
from multidrop.sim.dialect import Reason, Refusal

POLLED = ("output_frequency", "output_current", "mystery", "fault", "status")
REFUSED = Toy.mystery


class Stubborn(SimulatedDrive):
    """Refuses every read that touches one of its registers."""

    def read(self, function: int, start: int, count: int) -> list[int]:
        if start <= REFUSED.address < start + count:
            raise Refusal(Reason.READ_ADDRESS)
        return super().read(function, start, count)


def test_a_refused_register_is_set_aside_and_its_neighbours_are_read() -> None:
    with Simulator([Wire([Stubborn(Toy(1))], unpaced=True)]) as simulator:
        drive = PatientToy(1, name="pump-1")
        polls = tuple(Polled(drive.register(name), None) for name in POLLED)
        line = Line("hall-1", simulator.wires[0].path, None, None, (PolledDrive(drive, polls),))
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
    assert refused <= 2 * queued_ahead  # it is no longer asked for, but for what was queued
