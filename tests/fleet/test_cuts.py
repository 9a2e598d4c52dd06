"""Cuts of cables, each gateway and node in a namespace of its own, judged by what the lines saw."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from fleet_cuts import cut, drilled_in_network
from fleet_drills import FleetDrill
from peers import require_module

pytestmark = [pytest.mark.slow, pytest.mark.long]

CUT = ("gateway cut off", "gateway does not hear the nodes", "node hears nobody")


@pytest.fixture(scope="module")
def cut_drill(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FleetDrill]:
    require_module("nats")
    require_module("pyarrow")
    with drilled_in_network(tmp_path_factory.mktemp("cuts")) as found:
        yield found


@pytest.mark.parametrize("name", CUT)
def test_no_cut_makes_two_masters(cut_drill: FleetDrill, name: str) -> None:
    cut_drill.settle()
    cut_drill.judge(lambda: cut(cut_drill, name))
    assert cut_drill.hall.overlaps() == 0
