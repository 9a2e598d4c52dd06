"""Run a pump for some seconds, and stop it however the program ends: `python examples/pump.py [SECONDS]`.

Try Ctrl-C: standard error names the pump that is being stopped. The program ends when the motor is at rest.
"""

from __future__ import annotations

import sys
from time import sleep

from multidrop import Bus, BusError, ErmanERG220
from multidrop.sim import Simulator, Wire, simulated


def run(port: str, seconds: float) -> None:
    """Start the pump with address 1 at this port, print its state, and stop it."""
    with Bus(port, audit="pump.jsonl", stop_on_exit=True) as bus:  # stops also on Ctrl-C and SIGTERM
        pump = bus.attach(ErmanERG220, address=1, name="pump")
        pump.set_frequency(30.0)
        pump.start()
        for _ in range(round(seconds)):
            print(pump.state(), pump.read(pump.output_frequency), "Hz")
            sleep(1.0)


def main(seconds: float) -> None:
    motor = simulated(ErmanERG220(1))
    with Simulator([Wire([motor])]) as line:
        try:
            run(line.wires[0].path, seconds)
        except BusError as failure:
            print("failed:", failure)
        except KeyboardInterrupt:  # raised after the stop
            print("interrupted")
        print("the output frequency is now", motor["output_frequency"], "Hz")


if __name__ == "__main__":
    main(float(sys.argv[1]) if sys.argv[1:] else 5.0)
