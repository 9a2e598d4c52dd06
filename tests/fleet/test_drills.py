"""Drills: gateways and servers are killed, suspended and cut off, and no line ever has two masters.

The simulated drives record all requests, and count overlaps of two masters on a line. `python -m
bench.questions.fleet.drills --rounds 40` runs more drills.
"""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Iterator
from functools import partial
from typing import Any

import pytest
from fleet_drills import (
    DEEDS,
    PATIENCE_S,
    SOON_S,
    FleetDrill,
    MachineDrill,
    cut,
    drilled,
    drilled_in_network,
    drilled_on_machines,
    judged_at_end,
)

pytestmark = [pytest.mark.slow, pytest.mark.long]

# one failure of each kind; a suspended gateway has its own test
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
    with judged_at_end(drilled(tmp_path_factory.mktemp("drill"))) as found:
        yield found


def test_other_gateways_take_over_the_lines_of_a_suspended_gateway(drill: FleetDrill) -> None:
    stopped: list[subprocess.Popen[str]] = []
    drill.settle()
    gaps = drill.judge(lambda: stopped.append(drill.stop_gateway()), seconds=1.0)
    # longer than a hand-over takes, so the suspended gateway had lines and other gateways took them over
    assert max(gaps.values()) > 2.0
    assert stopped[0].wait(PATIENCE_S) == -signal.SIGKILL
    assert drill.hall.overlaps() == 0


def is_drained(drill: FleetDrill, name: str) -> bool:
    return f"{name} has 0 lines left" in drill.run("drain", name).stdout


def test_a_gateway_can_give_up_all_lines_and_then_exit_on_a_signal(drill: FleetDrill) -> None:
    """A service manager sends SIGTERM, and a closed terminal sends SIGHUP."""
    drill.settle()
    for name, number in (("gw-b", signal.SIGTERM), ("gw-c", signal.SIGHUP)):
        drill.wait(partial(is_drained, drill, name), f"{name} has no lines")
        drill.wait(lambda: drill.hall.are_polled(0.5), "all lines are polled")
        drill.gateways[name].send_signal(number)
        assert drill.gateways[name].wait(PATIENCE_S) == 0
    assert drill.hall.overlaps() == 0


@pytest.mark.parametrize("deed", DONE)
def test_no_line_has_two_masters_while_gateways_or_servers_fail(drill: FleetDrill, deed: str) -> None:
    drill.settle()
    drill.judge(lambda: DEEDS[deed](drill), SOON_S)
    assert drill.hall.overlaps() == 0


# ---- in network namespaces: cables are cut, and whole machines die ----


@pytest.fixture(scope="module")
def cut_drill(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FleetDrill]:
    with judged_at_end(drilled_in_network(tmp_path_factory.mktemp("cuts"))) as found:
        yield found


@pytest.mark.parametrize("name", CUT)
def test_no_line_has_two_masters_while_cables_are_cut(cut_drill: FleetDrill, name: str) -> None:
    cut_drill.settle()
    cut_drill.judge(lambda: cut(cut_drill, name), SOON_S)
    assert cut_drill.hall.overlaps() == 0


def test_gateway_hands_over_lines_that_it_cannot_reach(cut_drill: FleetDrill) -> None:
    cut_drill.settle()
    place, host = cut_drill.places["gw-a"], cut_drill.hall.host

    def gateway() -> dict[str, Any]:
        found: dict[str, Any] = cut_drill.status()["gateways"]["gw-a"]
        return found

    session = gateway()["session"]
    cut_drill.hall.reset()
    place.cut_to_here(host)
    try:
        # `cut_drill.status` also checks that `fleet status` exits with 1 while a port is lost
        cut_drill.wait(lambda: gateway()["says"]["lost"] != [], "status tells of lost ports")
        cut_drill.wait(lambda: cut_drill.hall.are_polled(1.0) and not gateway()["lines"], "handed over")
        found = cut_drill.run("status")
        assert "cannot be opened from here; another gateway polls it" in found.stdout
        assert found.returncode == 0
        assert gateway()["session"] == session
    finally:
        place.heal_to_here(host)
        # a restarted gateway has reported no line, so it tries to open all its lines immediately
        cut_drill.gateways["gw-a"].kill()
        cut_drill.gateways["gw-a"].wait()
    assert cut_drill.hall.overlaps() == 0


@pytest.fixture(scope="module")
def machine_drill(tmp_path_factory: pytest.TempPathFactory) -> Iterator[MachineDrill]:
    with judged_at_end(drilled_on_machines(tmp_path_factory.mktemp("machines"))) as found:
        yield found


def test_the_lines_of_a_dead_machine_get_new_masters_without_an_election(
    machine_drill: MachineDrill,
) -> None:
    """The drill has waited until other machines lead the ownership buckets of the dead gateway's lines."""
    machine_drill.settle()
    before = machine_drill.status()["lines"]
    machine_drill.judge(machine_drill.kill_machine, SOON_S)
    assert machine_drill.hall.overlaps() == 0

    def has_moved() -> bool:
        return any(one != before[line] for line, one in machine_drill.status()["lines"].items())

    machine_drill.wait(has_moved, "lines of the dead machine have moved")


def test_no_line_has_two_masters_while_whole_machines_are_cut_off(machine_drill: MachineDrill) -> None:
    machine_drill.settle()
    machine_drill.judge(machine_drill.cut_machine, SOON_S)
    assert machine_drill.hall.overlaps() == 0
