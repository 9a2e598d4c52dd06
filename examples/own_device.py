"""Declare a device, simulate it, read it and write to it: `python examples/own_device.py`."""

from __future__ import annotations

from enum import IntFlag

from multidrop import Bus, Drive, reading, setting
from multidrop.sim import Simulator, Wire, simulated


class Alarm(IntFlag):
    HOT = 1
    FILTER = 2


class AirHandler(Drive):
    """Air handler AH-20: the holding registers of its manual, section 3.1."""

    title = "AH-20"
    response_delay = 0.01  # s

    temperature = reading(100, "degC", step=0.1, place="3.1.1")
    pressure = reading(101, "Pa", place="3.1.1")
    alarms = reading(102, Alarm, place="3.1.2")
    target = setting(110, "degC", step=0.5, span=(5, 30), place="3.1.4")


def main() -> None:
    handler = simulated(AirHandler(7))
    handler["temperature"], handler["pressure"], handler["alarms"] = 21.4, 180, Alarm.FILTER
    with Simulator([Wire([handler])]) as line, Bus(line.wires[0].path) as bus:
        device = bus.attach(AirHandler, address=7, name="roof")
        for name, value in device.read_many(device.readings()).items():
            print(f"{name:12} {device.register(name).format(value)}")
        print("target is now", device.write(device.target, 22.5))
        try:
            device.write(device.target, 60)
        except ValueError as mistake:
            print("refused:", mistake)


if __name__ == "__main__":
    main()
