"""FaultyWire: a wire that loses, damages and delays frames, and whose drives fail.

Input and output are bytes with times. All random decisions derive from one seed.
"""

from __future__ import annotations

import math
import os
import random
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from multidrop.drive.family import Drive
from multidrop.sim.drive import SimulatedDrive
from multidrop.sim.faults import DriveFaults, Faults
from multidrop.sim.motor_drive import MotorDrive
from multidrop.sim.receiver import Frame
from multidrop.sim.wire import ReceiverGroup, Transmission, Wire

DAMAGES: Mapping[str, Callable[[bytes, int, int], bytes]] = {
    "drop": lambda frame, at, bit: frame[:at] + frame[at + 1 :],
    "flip": lambda frame, at, bit: frame[:at] + bytes([frame[at] ^ 1 << bit]) + frame[at + 1 :],
    "repeat": lambda frame, at, bit: frame[: at + 1] + frame[at:],
}
DRIFT_S = 20.0  # period of a drifting load, in s


class FaultyWire(Wire):
    """A wire with `faults`, which may be changed at any time; `struck` counts the faults that occurred.

    The fault `hang_up` removes the port. It needs a link to a pty or a TCP port, because a bare pty cannot be
    reopened under its name.
    """

    def __init__(
        self,
        drives: Sequence[SimulatedDrive],
        faults: Faults,
        *,
        name: str = "line",
        port: str = "pty",
        unpaced: bool = False,
    ) -> None:
        super().__init__(drives, name=name, port=port, unpaced=unpaced)
        if faults.hang_up and port == "pty":
            raise ValueError(
                f"{name}: a port that hangs up must be a link or a TCP port, so that it can come back under "
                f"its name"
            )
        self._by_name = {sim.drive.name: sim for sim in drives}
        for drive, own in faults.drives.items():
            sim = self._by_name.get(drive)
            if sim and (own.trip or own.drift) and not isinstance(sim, MotorDrive):
                raise ValueError(
                    f"{name}: {drive} has no simulated motor, so it takes no trip and no drift: remove them"
                )
        self.faults = faults
        self.struck: Counter[str] = Counter()
        self._random = random.Random(f"{faults.seed} {name}")
        self._stray: list[Transmission] = []  # noise and echoes in transmission to the client
        self._held: Transmission | None = None  # a reply that is delayed until the next reply
        # time at which the removed port returns; None while the port is there
        self._back_at: float | None = None
        self._due: dict[tuple[str, str], float] = {}  # (drive, event): time of its next silence or trip
        self._loads: dict[str, float] = {}  # mean load of each drive whose load drifts

    def _strikes(self, fault: str, of: Faults | DriveFaults | None = None) -> bool:
        rate: float = getattr(of or self.faults, fault)
        if rate <= 0 or self._random.random() >= rate:
            return False
        self.struck[fault] += 1
        return True

    def _damaged(self, frame: bytes) -> bytes:
        """Return the frame with at most one fault, because a checksum might miss several faults."""
        for fault, damage in DAMAGES.items():
            if self._strikes(fault):
                return damage(frame, self._random.randrange(len(frame)), self._random.randrange(8))
        return frame

    def receive(self, chunk: bytes, now: float, baudrate: int | None = None) -> None:
        if self._strikes("hang_up"):
            self._hang_up(now)
            return
        for name, faults in self.faults.drives.items():
            if name in self._by_name:
                self._pass_time(self._by_name[name], faults, now)
        character = next(
            (group.receiver.character for group in self._groups if group.settings.baudrate == baudrate),
            self._groups[0].receiver.character,
        )
        if self._strikes("noise"):
            self._make_noise(now, character)
        if self._strikes("echo"):
            self._stray.append(Transmission(chunk, now, character))
        super().receive(self._damaged(chunk), now, baudrate)

    def _pass_time(self, sim: SimulatedDrive, faults: DriveFaults, now: float) -> None:
        """Silence the drive, trip its motor and change its load if its `faults` are due."""
        name = sim.drive.name
        if self._is_due(name, "silence", faults, now):
            sim.deaf_until = max(sim.deaf_until, now + faults.silent_for)
        if not isinstance(sim, MotorDrive):
            return
        if self._is_due(name, "trip", faults, now) and sim.motor.energised:
            sim.trip(overload_code(sim.drive))
        if faults.drift:
            mean = self._loads.setdefault(name, sim.motor.load)
            sim.motor.load = mean + faults.drift * math.sin(now * math.tau / DRIFT_S + sim.drive.address)

    def _is_due(self, drive: str, event: str, faults: DriveFaults, now: float) -> bool:
        """Return True once per period of this event."""
        period: float | None = getattr(faults, event)
        if not period:
            return False
        key = drive, event
        if key not in self._due:
            self._due[key] = now + (self._up_to(period) if faults.first is None else faults.first)
        if now < self._due[key]:
            return False
        self._due[key] = now + period
        self.struck[event] += 1
        return True

    def _reply(self, sim: SimulatedDrive, data: bytes, begin: float, character: float) -> None:
        faults = self.faults.drives.get(sim.drive.name)
        if faults:
            if self._strikes("loss", faults):
                return
            if self._strikes("damage", faults):
                data = DAMAGES["flip"](data, self._random.randrange(len(data)), self._random.randrange(8))
            if self._strikes("delay", faults):
                begin += self._up_to(faults.late)
        super()._reply(sim, data, begin, character)

    def _deliver(self, group: ReceiverGroup, frames: Sequence[Frame]) -> None:
        if not frames:
            return
        if not self.faults.start_noise:
            super()._deliver(group, frames)
            return
        before = self._running()
        super()._deliver(group, frames)
        if self._running() - before and self._strikes("start_noise"):
            self._make_noise(frames[-1].end, group.receiver.character)

    def _running(self) -> set[SimulatedDrive]:
        return {sim for sim in self.drives if isinstance(sim, MotorDrive) and sim.motor.energised}

    def _make_noise(self, begin: float, character: float) -> None:
        """Add noise bytes, received by the client and by the drives."""
        noise = self._random.randbytes(self._random.randint(1, self.faults.burst))
        self._stray.append(Transmission(noise, begin, character))
        for group in self._groups:
            super()._deliver(group, group.receiver.feed(noise, begin))

    def _send(self, data: bytes, begin: float, character: float) -> None:
        data = self._damaged(data)
        if self._held:
            data = self._held.data + data
            self._held = None
        elif self._strikes("merge"):
            self._held = Transmission(data, begin + self._up_to(self.faults.late), character)
            return
        elif self._strikes("delay"):
            begin += self._up_to(self.faults.late)
        if self._strikes("twice"):
            data += data
        if len(data) > 1 and self._strikes("split"):
            at = self._random.randrange(1, len(data))
            super()._send(data[:at], begin, character)
            begin += at * character + self._up_to(self.faults.pause)
            data = data[at:]
        super()._send(data, begin, character)

    def _up_to(self, most: float) -> float:
        return self._random.uniform(0.0, most)

    def advance(self, now: float) -> bytes:
        if self._held and now >= self._held.begin:
            held, self._held = self._held, None
            super()._send(held.data, held.begin, held.character)
        data = super().advance(now)
        if self._stray:
            data += b"".join([stray.take(now) for stray in self._stray])
            self._stray = [stray for stray in self._stray if stray.end > now]
        if self._back_at is None:
            return data
        if now >= self._back_at:
            self._come_back()
        return b""  # the client is disconnected

    @property
    def wake(self) -> float | None:
        times = [stray.next_at for stray in self._stray]
        if self._held:
            times.append(self._held.begin)
        if self._back_at is not None:
            times.append(self._back_at)
        if (first := super().wake) is not None:
            times.append(first)
        return min(times, default=None)

    def _hang_up(self, now: float) -> None:
        self.where = self.path  # so that a TCP port is reopened under the same number
        self._name = os.path.realpath(self.path)  # the name of the pty to which the link leads
        self.close()
        self._back_at = now + self._up_to(self.faults.away)

    def _come_back(self) -> None:
        self._back_at = None
        # ptys that occupy the former name, so that the new pty gets another name
        taken = _ptys_up_to(self._name) if self._strikes("rename") else []
        try:
            self.open()
        finally:
            for fd in taken:
                os.close(fd)


def _ptys_up_to(name: str) -> list[int]:
    """Open ptys until one has this name; return their descriptors. A new pty gets the lowest free number."""
    taken: list[int] = []
    while name.startswith("/dev/pts/"):
        taken += os.openpty()
        if int(Path(os.ttyname(taken[-1])).name) >= int(Path(name).name):
            break
    return taken


def overload_code(drive: Drive) -> int:
    """Return the family's fault code for an overload, or else that of its first named fault, or else 1."""
    for name in ("fault", "last_fault", "fault_record_1"):
        register = drive.registers.get(name)
        if register is not None and register.values is not None:
            faults = [one for one in register.values if one]
            return int(next((one for one in faults if "OVERLOAD" in one.name), faults[0]))
    return 1
