"""Line utilisation between any two readings of its statistics, on the test's own clock."""

from __future__ import annotations

import pytest
from clocked_lines import ClockedLines, ClockedWire
from lines import polled
from tables import table
from toy import Toy

from multidrop.sim import EncodedDrive, Faults

STEPS = 400


@pytest.mark.long
@table("seconds", [0.001, 0.003, 0.01, 0.03, 0.1])
def test_a_line_is_never_used_for_longer_than_there_is(seconds: float) -> None:
    """An exchange under way at a reading counts after it, with all its time."""
    pumps = [Toy(address, name=f"pump-{address}") for address in (1, 2)]
    wire = ClockedWire([EncodedDrive(pump) for pump in pumps], Faults())
    drives = [polled(pump, [Toy.output_frequency, Toy.acceleration_time]) for pump in pumps]
    with ClockedLines(wire, drives) as made:
        made.run(2)
        (before,) = made.poller.statistics().values()
        begun, found = before, []
        for _ in range(STEPS):
            made.run(seconds)
            (now,) = made.poller.statistics().values()
            found.append(now.since(before))
            before = now
        assert max(span.utilisation for span in found) <= 1 + 1e-6
        assert max(sum(each.utilisation for each in span.drives.values()) for span in found) <= 1 + 1e-6
        whole = before.since(begun)
        assert whole.utilisation > 0.9
        assert sum(span.used_s for span in found) == pytest.approx(whole.used_s)
        assert sum(span.counted_s or 0 for span in found) == pytest.approx(whole.counted_s, abs=STEPS * 1e-9)
