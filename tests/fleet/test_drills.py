"""Drills with real processes that are killed or suspended: no line ever has two masters.

The simulated drives record all requests, and count overlaps of two masters on a line. `python -m
bench.questions.fleet.drills --rounds 40` runs more drills.
"""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Iterator
from functools import partial

import pytest
from fleet_drills import DEEDS, PATIENCE_S, SOON_S, FleetDrill, drilled, judged_at_end

pytestmark = [pytest.mark.slow, pytest.mark.long]

# one drill of each kind, except suspended gateways, which have their own test
DONE = (
    "gateway killed",
    "gateway and node killed",
    "node stands still",
    "ownership leader killed",
    "all nodes killed",
)


@pytest.fixture(scope="module")
def drill(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FleetDrill]:
    with judged_at_end(drilled(tmp_path_factory.mktemp("drill"))) as found:
        yield found


def test_a_suspended_gateway_is_killed_and_its_lines_are_taken_over(drill: FleetDrill) -> None:
    stopped: list[subprocess.Popen[str]] = []
    drill.settle()
    gaps = drill.judge(lambda: stopped.append(drill.stop_gateway()), seconds=1.0)
    # longer than a hand-over takes, so the suspended gateway had lines and other gateways took them over
    assert max(gaps.values()) > 2.0
    assert stopped[0].wait(PATIENCE_S) == -signal.SIGKILL
    assert drill.hall.overlaps() == 0


def is_drained(drill: FleetDrill, name: str) -> bool:
    return f"{name} has 0 lines left" in drill.run("drain", name).stdout


def test_a_drained_gateway_releases_all_its_lines_and_ends_at_a_signal(drill: FleetDrill) -> None:
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
