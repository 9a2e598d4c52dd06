"""The simulator's thread: that it ends when it is told to."""

from __future__ import annotations

import signal
import threading
import time

from wire_time import Own

from multidrop.sim import Simulator, Wire, serve, simulated

PATIENCE = 60.0


def test_a_signal_ends_it_though_its_handler_is_not_called() -> None:
    """A signal may come just before it sleeps: here another thread has it, which runs no handler."""

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
