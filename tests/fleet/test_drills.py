"""Drills with real processes, judged by what the lines saw: no overlap, and how long a line was silent.

`python -m bench.questions.fleet_drills --rounds 40` does more of them.
"""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Iterator

import pytest
from fleet_cuts import MachineDrill, cut, drilled_in_network, drilled_on_machines
from fleet_drills import DEEDS, PATIENCE_S, FleetDrill, drilled
from peers import require_module

pytestmark = [pytest.mark.slow, pytest.mark.long]

# One of each kind; the bench does them all. A gateway that stands still has a test of its own below.
DONE = (
    "gateway killed",
    "gateway and node killed",
    "node stands still",
    "ownership leader killed",
    "all nodes killed",
)
CUT = ("gateway cut off", "gateway does not hear the nodes", "node hears nobody")


@pytest.fixture(scope="module")
def drill(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FleetDrill]:
    require_module("nats")
    require_module("pyarrow")
    with drilled(tmp_path_factory.mktemp("drill")) as found:
        found.settle()
        yield found


def test_a_gateway_that_stands_still_is_killed_and_its_lines_go_on(drill: FleetDrill) -> None:
    stopped: list[subprocess.Popen[str]] = []
    gaps = drill.judge(lambda: stopped.append(drill.stop_gateway()), seconds=1.0)
    assert max(gaps.values()) > 2.0  # it had lines, and they were taken over
    assert stopped[0].wait(PATIENCE_S) == -signal.SIGKILL
    assert drill.hall.overlaps() == 0


@pytest.mark.long
def test_a_drained_gateway_gives_all_its_lines_away(drill: FleetDrill) -> None:
    drill.settle()
    drill.hall.reset()
    drill.wait(lambda: "gw-b has 0 lines left" in drill.run("drain", "gw-b").stdout, "gw-b has no lines")
    drill.wait(lambda: drill.hall.are_polled(0.5), "all lines are polled")
    drill.gateways["gw-b"].send_signal(signal.SIGTERM)
    assert drill.gateways["gw-b"].wait(PATIENCE_S) == 0
    assert drill.hall.overlaps() == 0


@pytest.mark.long
@pytest.mark.parametrize("deed", DONE)
def test_no_deed_makes_two_masters(drill: FleetDrill, deed: str) -> None:
    drill.settle()
    drill.judge(lambda: DEEDS[deed](drill))
    assert drill.hall.overlaps() == 0


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


@pytest.fixture(scope="module")
def machine_drill(tmp_path_factory: pytest.TempPathFactory) -> Iterator[MachineDrill]:
    require_module("nats")
    require_module("pyarrow")
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
