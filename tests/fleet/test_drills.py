"""Drills with real processes, judged by the lines' records: no overlap, and short silences.

`python -m bench.questions.fleet_drills --rounds 40` does more.
"""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Iterator

import pytest
from fleet_drills import DEEDS, PATIENCE_S, FleetDrill, drilled

pytestmark = [pytest.mark.slow, pytest.mark.long]

# One of each kind; the bench does them all. Suspended gateways have their own test below.
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
    assert max(gaps.values()) > 2.0  # it had lines, and they were taken over
    assert stopped[0].wait(PATIENCE_S) == -signal.SIGKILL
    assert drill.hall.overlaps() == 0


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])  # of a service; of a closed terminal
def test_a_drained_gateway_gives_all_its_lines_away(drill: FleetDrill, number: int) -> None:
    drill.settle()
    drill.hall.reset()
    drill.wait(lambda: "gw-b has 0 lines left" in drill.run("drain", "gw-b").stdout, "gw-b has no lines")
    drill.wait(lambda: drill.hall.are_polled(0.5), "all lines are polled")
    drill.gateways["gw-b"].send_signal(number)
    assert drill.gateways["gw-b"].wait(PATIENCE_S) == 0
    assert drill.hall.overlaps() == 0


@pytest.mark.long
@pytest.mark.parametrize("deed", DONE)
def test_no_deed_makes_two_masters(drill: FleetDrill, deed: str) -> None:
    drill.settle()
    drill.judge(lambda: DEEDS[deed](drill))
    assert drill.hall.overlaps() == 0
