"""Toy, a family as a user would declare it, and a device that rejects or ignores some reads."""

from collections.abc import Collection, Iterable
from enum import IntEnum, IntFlag
from typing import Any

from multidrop.core import Message
from multidrop.drive import Condition, Direction, Drive, Framing, Script, State, read, write
from multidrop.drive.register import HOLDING, Kept, Option, command, reading, setting
from multidrop.drive.verbs import verb
from multidrop.sim import SimulatedDrive
from multidrop.sim.drive import Reason, Refusal


class Fault(IntEnum):
    NONE = 0
    OVERCURRENT = 1


class Status(IntFlag):
    RUNNING = 1
    REVERSE = 2


class Toy(Drive):
    """Toy; what its manual leaves open:

    - the scale of `mystery`.
    """

    model = "toy"
    title = "TOY T1"
    manual = "TOY T1 user's manual, chapter 5"
    framings = (Framing.RTU, Framing.ASCII)
    addresses = range(1, 32)
    baudrates = (9600, 19200)
    most_registers = {HOLDING: 10}
    options = {"rated_frequency": Option("Hz", (10, 400), "rated frequency of the motor")}

    output_frequency = reading(0x01, "Hz", step=0.1, place="table 3")
    output_current = reading(0x02, "A", step=0.01)
    mystery = reading(0x03, step=None, note="the manual gives no scale")
    fault = reading(0x04, Fault)
    status = reading(0x05, Status)
    acceleration_time = setting(0x0A, "s", step=0.1, span=(0.1, 600), kept=Kept.EEPROM, while_running=False)
    sealed = setting(0x0B, never="it is the maker's")
    control = command(0x14, Status)
    frequency = command(0x15, "Hz", step=0.01, span=(0, 50), moves=False)

    @verb
    def identify(self) -> Script[None]:
        """Accept any drive, because a test's line has only toys."""
        yield from ()

    @verb
    def start(self, direction: Direction | None = None) -> Script[None]:
        """Start the motor."""
        reverse = Status.REVERSE if direction is Direction.REVERSE else Status(0)
        yield from write(Toy.control, Status.RUNNING | reverse)

    @verb
    def stop(self) -> Script[None]:
        """Stop the motor."""
        yield from write(Toy.control, Status(0))

    @verb
    def set_frequency(self, hz: float) -> Script[None]:
        """Write the frequency setpoint in Hz."""
        yield from write(Toy.frequency, hz)

    @verb
    def state(self) -> Script[State]:
        """Return the state that the drive reports."""
        status = yield from read(Toy.status)
        return State(Condition.RUNNING if status & Status.RUNNING else Condition.STOPPED)


class PatientToy(Toy):
    """A toy with long timeouts for busy test machines, even after fast replies."""

    response_timeout = 60.0
    response_delay = 15.0  # s; a learned timeout is at least four times this delay


class QuickToy(Toy):
    """A toy with a short timeout."""

    response_timeout = 0.05


class Unsure(Toy):
    """A toy without an `identify` script."""

    identify = Drive.identify


def family(registers: int, **declared: Any) -> type[Drive]:
    """Return a drive class that declares only `registers` adjacent registers r0, r1, ..."""
    readings = {f"r{at}": reading(at) for at in range(registers)}
    return type("Plain", (Drive,), {"__doc__": "Of this test.", **readings, **declared})


def expected_values(addresses: Iterable[int]) -> dict[str, float]:
    """Return the values of a `Picky` device at these addresses, by register name."""
    return {f"r{at}": 100 + at for at in addresses}


class Picky(SimulatedDrive):
    """A device that rejects reads of some addresses, and rejects or ignores reads of too many registers."""

    def __init__(
        self, drive: Drive, refused: Collection[int] = (), most: int = 125, silent_beyond: int = 125
    ) -> None:
        super().__init__(drive)
        self.missing = set(refused)
        self.limit, self.silent_beyond = most, silent_beyond
        self.asked: list[tuple[int, int]] = []
        for at, name in enumerate(drive.registers):
            self[name] = 100 + at

    def answer(self, request: Message, now: float) -> Message | None:
        if request.address != self.drive.address or now < self.deaf_until:
            return None
        self.asked.append((request.start, request.count))
        if request.count > self.silent_beyond:
            return None
        return super().answer(request, now)

    def read(self, function: int, start: int, count: int) -> list[int]:
        if count > self.limit:
            raise Refusal(Reason.COUNT)
        if self.missing & set(range(start, start + count)):
            raise Refusal(Reason.READ_ADDRESS)
        return super().read(function, start, count)
