"""The state machines of 20 gateways with a thousand lines, in four processes.

bench.questions.fleet_scale has larger fleets.
"""

from __future__ import annotations

import pytest
from fleet_scale import groups, large_fleet, plant_of_fake_lines, until
from nats_clusters import Cluster

pytestmark = [pytest.mark.slow, pytest.mark.long]


def test_each_of_1000_lines_has_one_gateway_after_5_of_20_die_and_return(nats: Cluster) -> None:
    with large_fleet(nats, plant_of_fake_lines(1000)) as fleet:
        fleet.settled(fleet.start(*groups(20, 4)))
        fleet.check()
        until(lambda: 30 <= fleet.loads()[0] <= fleet.loads()[-1] <= 55, "each has its share")
        dead = fleet.processes[1]
        fleet.kill(dead)
        fleet.check()
        fleet.start(dead.gateways)
        until(lambda: fleet.loads()[0] >= 30, "those that come back have their share")
        fleet.check()
