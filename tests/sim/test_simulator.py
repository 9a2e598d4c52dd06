"""The simulator's thread: it ends on request, and a failing drive affects no other wire."""

from __future__ import annotations

import select
import signal
import threading
import time
from typing import Any

import pytest
from lines import Own, until
from toy import Toy

from multidrop import YD1000, Bus, NoReply
from multidrop.sim import EncodedDrive, Simulator, Wire, serve, simulated

PATIENCE = 60.0


def test_signal_ends_serve_even_if_its_handler_has_not_run() -> None:
    """Another thread gets the signal, so no handler runs, as for a signal just before the sleep."""

    def terminate() -> None:
        time.sleep(0.2)
        signal.pthread_kill(threading.get_ident(), signal.SIGTERM)

    def end_at_last() -> None:
        if not over.wait(PATIENCE):
            simulators[0].interrupt()

    over = threading.Event()
    simulators: list[Simulator] = []
    threads = [threading.Thread(target=each) for each in (terminate, end_at_last)]

    def begin(simulator: Simulator) -> None:
        simulators.append(simulator)
        for thread in threads:
            thread.start()

    begun = time.monotonic()
    serve([Wire([simulated(Own(1))])], begin)
    assert time.monotonic() - begun < PATIENCE
    over.set()
    for thread in threads:
        thread.join()


class Ill(Exception):
    """Raised by a simulated drive."""


class IllDrive(EncodedDrive):
    def receive(self, frame: Any) -> Any:
        raise Ill("of this drive")


def test_failing_drive_gives_no_reply_and_other_wires_continue(caplog: pytest.LogCaptureFixture) -> None:
    wires = [Wire([drive], unpaced=True) for drive in (IllDrive(Toy(1)), EncodedDrive(Toy(1)))]
    simulator = Simulator(wires)

    def ask() -> None:
        with simulator, Bus(wires[0].path) as ill, Bus(wires[1].path) as well:
            for _ in range(2):
                with pytest.raises(NoReply):
                    (ill.drives[0] if ill.drives else ill.attach(Toy, 1)).read(Toy.output_current)
                drive = well.drives[0] if well.drives else well.attach(Toy, 1)
                drive.read(Toy.output_current)
            assert isinstance(simulator.failure, Ill)

    with pytest.raises(Ill, match="of this drive"):
        ask()
    assert [record.name for record in caplog.records if record.levelname == "ERROR"] == ["multidrop.sim"]


def test_ended_simulator_thread_logs_its_failure(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    simulator = Simulator([Wire([EncodedDrive(Toy(1))])])

    def fail(*details: object) -> None:
        raise Ill("of select")

    monkeypatch.setattr(select, "select", fail)
    simulator.__enter__()
    until(lambda: isinstance(simulator.failure, Ill))
    with pytest.raises(Ill, match="of select"):
        simulator.__exit__()
    assert "no drive answers any more" in caplog.text


@pytest.mark.slow
def test_speed_makes_simulated_time_pass_faster() -> None:
    """With `speed=20` a motor's ramp of 10 s takes less than one second."""
    sim = simulated(YD1000(1))
    with Simulator([Wire([sim])], speed=20) as simulator, Bus(simulator.wires[0].path) as bus:
        fan = bus.attach(YD1000, 1)
        fan.set_frequency(50.0)
        fan.start()
        until(lambda: fan.read(fan.output_frequency) == 50.0)
        assert sim.now > 10 * time.monotonic()  # by the simulator's clock


@pytest.mark.parametrize("speed", [0, -1, float("inf"), float("nan")])
def test_speed_that_is_not_positive_is_refused(speed: float) -> None:
    with pytest.raises(ValueError, match="is not a positive number"):
        Simulator([], speed=speed)
