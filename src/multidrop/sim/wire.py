"""Wire: the pair of a line with its drives, and how long everything takes on it.

Bytes and times come in, bytes and times come out; the port at its end is port.py's business.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Sequence
from dataclasses import dataclass

from multidrop.core import Framing, build_reply
from multidrop.drive.timing import Settings
from multidrop.sim.drive import SimulatedDrive
from multidrop.sim.port import SimulatedEnd, open_port
from multidrop.sim.receiver import Frame, Receiver

CHUNK = 1e-3  # s; characters that end within it are handed over together
ROUNDING = 1e-6  # of a character, so that a wake finds the byte that it was for
UNPACED_GAP = 20e-3  # s of silence that end a frame where characters take no time


@dataclass
class Transmission:
    """A reply on its way: the last bit of its n-th character ends n characters after `begin`."""

    data: bytes
    begin: float
    character: float
    sent: int = 0

    @property
    def end(self) -> float:
        return self.begin + len(self.data) * self.character

    @property
    def next_at(self) -> float:
        group = max(1, int(CHUNK / self.character)) if self.character else len(self.data)
        return self.begin + min(len(self.data), self.sent + group) * self.character

    def take(self, now: float) -> bytes:
        """What has ended by now and was not taken yet."""
        if now < self.begin:
            return b""
        passed = len(self.data)
        if now < self.end:
            passed = math.floor((now - self.begin) / self.character + ROUNDING)
        taken = self.data[self.sent : passed]
        self.sent = max(self.sent, passed)
        return taken


class ReceiverGroup:
    """Drives that hear alike: of one framing and baud rate, with one idea of a frame's end."""

    def __init__(self, receiver: Receiver, settings: Settings) -> None:
        self.receiver = receiver
        self.settings = settings
        self.drives: dict[int, SimulatedDrive] = {}

    def listeners(self, frame: Frame) -> Sequence[SimulatedDrive]:
        if frame.address == 0:
            return list(self.drives.values())
        return [self.drives[frame.address]] if frame.address in self.drives else []


class Wire:
    """One line of simulated drives.

    `port` is "pty", a path at which a link to the pty is put, or "socket://host:port" (port 0: any
    free one). `path` is where a client opens it. An `unpaced` wire has no waits at all.
    """

    def __init__(
        self,
        drives: Sequence[SimulatedDrive],
        *,
        name: str = "line",
        port: str = "pty",
        unpaced: bool = False,
    ) -> None:
        if not drives:
            raise ValueError(f"{name}: a line needs at least one drive")
        self.drives = tuple(drives)
        self.name = name
        self.where = port
        self.port: SimulatedEnd | None = None  # there while it is open
        self._pace = 0.0 if unpaced else 1.0  # every duration is multiplied by it
        self._ears = self._group()
        self._outgoing: list[Transmission] = []  # by their begin
        self._quiet_since = -math.inf  # the end of the last reply
        self._baudrate: int | None = None

    def _group(self) -> list[ReceiverGroup]:
        groups: dict[tuple[Framing, Settings, float], ReceiverGroup] = {}
        taken: dict[tuple[int, Framing, int], SimulatedDrive] = {}
        for it in self.drives:
            drive = it.drive
            other = taken.setdefault((drive.address, drive.framing, drive.settings.baudrate), it)
            if other is not it:
                raise ValueError(f"{self.name}: {other.drive.name} and {drive.name} have the same address")
            key = (drive.framing, drive.settings, it.most_gap)
            if key not in groups:
                gap = it.most_gap if self._pace else UNPACED_GAP
                character = drive.settings.character * self._pace
                groups[key] = ReceiverGroup(Receiver(drive.framing, character, gap), drive.settings)
            groups[key].drives[drive.address] = it
        return list(groups.values())

    def __repr__(self) -> str:
        return f"<Wire {self.name} of {len(self.drives)} drives>"

    # ---- what happens on the pair ----

    def receive(self, chunk: bytes, now: float, baudrate: int | None = None) -> None:
        """Take what the client sent, at its baud rate where it can be seen."""
        if baudrate != self._baudrate:
            for ears in self._ears:
                ears.receiver.forget()
            self._baudrate = baudrate
        for ears in self._ears:
            if baudrate is None or ears.settings.baudrate == baudrate:
                self._deliver(ears, ears.receiver.feed(chunk, now))

    def advance(self, now: float) -> bytes:
        """Let time pass until `now`; what the client hears meanwhile."""
        for ears in self._ears:
            self._deliver(ears, ears.receiver.silence(now))
        heard = bytearray()
        while self._outgoing:
            heard += self._outgoing[0].take(now)
            if now < self._outgoing[0].end:
                break
            self._quiet_since = self._outgoing.pop(0).end
            if self._outgoing:  # two at once cannot be read: the second waits
                self._outgoing[0].begin = max(self._outgoing[0].begin, self._quiet_since)
        return bytes(heard)

    @property
    def wake(self) -> float | None:
        """When `advance` will have something to do; None: not before the next bytes come."""
        silences = [ears.receiver.silent_at for ears in self._ears]
        times = [at for at in silences if at is not None]
        if self._outgoing:
            times.append(self._outgoing[0].next_at)
        return min(times, default=None)

    def distort(self, reply: bytes) -> bytes:
        """What becomes of a reply on its way; a test of noise replaces it."""
        return reply

    def _deliver(self, ears: ReceiverGroup, frames: Sequence[Frame]) -> None:
        for frame in frames:
            for it in ears.listeners(frame):
                if self._may_hear(it, frame) and (reply := it.hear(frame)) is not None:
                    data = self.distort(build_reply(it.drive.framing, reply))
                    self._send(data, frame.end + it.delay * self._pace, ears.receiver.character)

    def _send(self, data: bytes, begin: float, character: float) -> None:
        bisect.insort(self._outgoing, Transmission(data, begin, character), key=lambda it: it.begin)

    def _may_hear(self, it: SimulatedDrive, frame: Frame) -> bool:
        """Count a frame that came before its silence was over, and say whether it is heard all the same.

        What begins within a reply is lost. Silence is counted from the end of a reply only: that is
        known here to the bit, so that a client that keeps the silence is never found guilty because
        this process woke late.
        """
        replying = self._outgoing and self._outgoing[0].begin <= frame.begin
        silent_for = frame.begin - (self._outgoing[0].end if replying else self._quiet_since)
        bit = it.drive.settings.bit * self._pace
        if silent_for >= it.silence * self._pace - bit:
            return True
        it.counters.early += 1
        return not it.needs_silence and silent_for >= -bit

    # ---- its port ----

    @property
    def path(self) -> str:
        """Where a client opens the line, while a simulator runs it."""
        if self.port is None:
            raise RuntimeError(f"{self.name} is not open: run it in a Simulator")
        return self.port.path

    def open(self) -> None:
        self.port = open_port(self.where, self.drives[0].drive.settings)

    def close(self) -> None:
        if self.port is not None:
            self.port.close()
            self.port = None
