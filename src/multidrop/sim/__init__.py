"""Drives that behave as their documents say, on ptys and TCP ports, at the pace of a real wire."""

from multidrop.sim.drive import DriveCounters, SimulatedDrive, Written
from multidrop.sim.encoded import EncodedDrive, encoded, proof
from multidrop.sim.families import simulated
from multidrop.sim.faults import Faults, load_faults
from multidrop.sim.faulty_wire import FaultyWire
from multidrop.sim.motor import Motor, Phase, Rating
from multidrop.sim.motor_drive import MotorDrive
from multidrop.sim.simulator import Simulator, serve
from multidrop.sim.wire import Wire

__all__ = [
    "DriveCounters",
    "EncodedDrive",
    "Faults",
    "FaultyWire",
    "Motor",
    "MotorDrive",
    "Phase",
    "Rating",
    "SimulatedDrive",
    "Simulator",
    "Wire",
    "Written",
    "encoded",
    "load_faults",
    "proof",
    "serve",
    "simulated",
]
