"""Simulate drives on ptys and TCP ports. They behave as documented, with the timing of a serial line."""

from multidrop.sim.drive import DriveCounters as DriveCounters
from multidrop.sim.drive import EncodedDrive as EncodedDrive
from multidrop.sim.drive import SimulatedDrive as SimulatedDrive
from multidrop.sim.drive import Written as Written
from multidrop.sim.drive import encoded as encoded
from multidrop.sim.drive import proof as proof
from multidrop.sim.families import simulated as simulated
from multidrop.sim.faults import DriveFaults as DriveFaults
from multidrop.sim.faults import Faults as Faults
from multidrop.sim.faults import FaultyWire as FaultyWire
from multidrop.sim.faults import load_faults as load_faults
from multidrop.sim.motor import Motor as Motor
from multidrop.sim.motor import MotorDrive as MotorDrive
from multidrop.sim.motor import Phase as Phase
from multidrop.sim.motor import Rating as Rating
from multidrop.sim.simulator import Simulator as Simulator
from multidrop.sim.simulator import serve as serve
from multidrop.sim.wire import Wire as Wire
