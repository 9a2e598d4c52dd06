"""Drills with real processes, judged by the lines' records: no overlap of masters, and only short silences.

Processes are killed or suspended. In network namespaces, cables are cut and whole machines die. `python -m
bench.questions.fleet_drills --rounds 40` does more drills.
"""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Iterator
from typing import Any

import pytest
from fleet_drills import (
    DEEDS,
    PATIENCE_S,
    FleetDrill,
    MachineDrill,
    cut,
    drilled,
    drilled_in_network,
    drilled_on_machines,
)

pytestmark = [pytest.mark.slow, pytest.mark.long]

# One drill of each kind; the bench does all. A suspended gateway has its own test below.
DONE = (
    "gateway killed",
    "gateway and node killed",
    "node stands still",
    "ownership leader killed",
    "all nodes killed",
)


@pytest.fixture(scope="module")
def drill(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FleetDrill]:
    with drilled(tmp_path_factory.mktemp("drill")) as found:
        found.settle()
        yield found


def test_a_suspended_gateway_is_killed_and_its_lines_are_taken_over(drill: FleetDrill) -> None:
    stopped: list[subprocess.Popen[str]] = []
    gaps = drill.judge(lambda: stopped.append(drill.stop_gateway()), seconds=1.0)
    assert max(gaps.values()) > 2.0  # the gateway had lines, and others took them over
    assert stopped[0].wait(PATIENCE_S) == -signal.SIGKILL
    assert drill.hall.overlaps() == 0


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])  # service manager, closed terminal
def test_a_drained_gateway_releases_all_its_lines(drill: FleetDrill, number: int) -> None:
    drill.settle()
    drill.hall.reset()
    drill.wait(lambda: "gw-b has 0 lines left" in drill.run("drain", "gw-b").stdout, "gw-b has no lines")
    drill.wait(lambda: drill.hall.are_polled(0.5), "all lines are polled")
    drill.gateways["gw-b"].send_signal(number)
    assert drill.gateways["gw-b"].wait(PATIENCE_S) == 0
    assert drill.hall.overlaps() == 0


@pytest.mark.parametrize("deed", DONE)
def test_no_drill_makes_two_masters(drill: FleetDrill, deed: str) -> None:
    drill.settle()
    drill.judge(lambda: DEEDS[deed](drill))
    assert drill.hall.overlaps() == 0


# ---- cut cables, with each gateway and each server in its own namespace ----

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


def test_a_gateway_cut_off_from_its_lines_hands_them_over(cut_drill: FleetDrill) -> None:
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
        cut_drill.gateways["gw-a"].kill()  # a restarted gateway tries to open all lines immediately
        cut_drill.gateways["gw-a"].wait()
    assert cut_drill.hall.overlaps() == 0


# ---- machines with one gateway and one server each ----


@pytest.fixture(scope="module")
def machine_drill(tmp_path_factory: pytest.TempPathFactory) -> Iterator[MachineDrill]:
    with drilled_on_machines(tmp_path_factory.mktemp("machines")) as found:
        yield found


def test_takeover_from_a_dead_machine_waits_for_no_election(
    machine_drill: MachineDrill,
) -> None:
    """The dead gateway's line records have leaders on other machines: `settle` waits for that."""
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
