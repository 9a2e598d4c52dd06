"""Machines with a gateway and a node each, in namespaces: one dies or is cut off with both."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from fleet_drills import MachineDrill, drilled_on_machines

pytestmark = [pytest.mark.slow, pytest.mark.long]


@pytest.fixture(scope="module")
def machine_drill(tmp_path_factory: pytest.TempPathFactory) -> Iterator[MachineDrill]:
    with drilled_on_machines(tmp_path_factory.mktemp("machines")) as found:
        yield found


def test_no_line_waits_for_an_election_where_a_gateway_dies_with_the_node_on_its_machine(
    machine_drill: MachineDrill,
) -> None:
    """All its lines' records have leaders on other machines: `settle` waits for that."""
    machine_drill.settle()
    before = machine_drill.status()["lines"]
    machine_drill.judge(machine_drill.kill_machine)
    assert machine_drill.hall.overlaps() == 0
    moved = [line for line, one in machine_drill.status()["lines"].items() if one != before[line]]
    assert moved


def test_no_cut_of_a_whole_machine_makes_two_masters(machine_drill: MachineDrill) -> None:
    machine_drill.settle()
    machine_drill.judge(machine_drill.cut_machine)
    assert machine_drill.hall.overlaps() == 0
