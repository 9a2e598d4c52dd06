"""Cut cables, with each gateway and node in its own namespace, judged by the lines' records."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from fleet_drills import FleetDrill, cut, drilled_in_network

pytestmark = [pytest.mark.slow, pytest.mark.long]

CUT = ("gateway cut off", "gateway does not hear the nodes", "node hears nobody")


@pytest.fixture(scope="module")
def cut_drill(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FleetDrill]:
    with drilled_in_network(tmp_path_factory.mktemp("cuts")) as found:
        yield found


@pytest.mark.parametrize("name", CUT)
def test_no_cut_makes_two_masters(cut_drill: FleetDrill, name: str) -> None:
    cut_drill.settle()
    cut_drill.judge(lambda: cut(cut_drill, name))
    assert cut_drill.hall.overlaps() == 0


def test_a_gateway_that_reaches_the_nodes_and_not_the_lines_hands_them_over(cut_drill: FleetDrill) -> None:
    cut_drill.settle()
    place, host = cut_drill.places["gw-a"], cut_drill.hall.host

    def gateway() -> dict[str, Any]:
        found: dict[str, Any] = cut_drill.status()["gateways"]["gw-a"]
        return found

    session = gateway()["session"]
    cut_drill.hall.reset()
    place.cut_to_here(host)
    try:
        cut_drill.wait(lambda: gateway()["says"]["lost"] != [], "status tells of lost ports")
        assert cut_drill.run("status").returncode == 1
        cut_drill.wait(lambda: cut_drill.hall.are_polled(1.0) and not gateway()["lines"], "handed over")
        found = cut_drill.run("status")
        assert "cannot be opened from here; another gateway polls it" in found.stdout
        assert found.returncode == 0
        assert gateway()["session"] == session
    finally:
        place.heal_to_here(host)
        cut_drill.gateways["gw-a"].kill()  # one that is started tries all lines at once
        cut_drill.gateways["gw-a"].wait()
    assert cut_drill.hall.overlaps() == 0
