"""Wire: a simulated line with drives, and the time that each character takes.

A wire's input and output are bytes with times. A client reaches the wire by a pty or a TCP port.
"""

from __future__ import annotations

import bisect
import contextlib
import math
import os
import socket
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from urllib.parse import urlsplit

from multidrop.control.eeprom_ledger import default_ledger_path
from multidrop.core import Framing, build_reply, get_settings, set_settings
from multidrop.drive.line_settings import Settings
from multidrop.sim.drive import SimulatedDrive
from multidrop.sim.receiver import Frame, Receiver
from multidrop.transport.port_identity import SimulatedPort, is_simulated, of_address

CHUNK = 1e-3  # characters that end within this time, in s, are delivered together
ROUNDING = 1e-6  # rounding errors below this fraction of a character's time do not delay a byte
UNPACED_GAP = 20e-3  # seconds of silence that end a frame on an unpaced wire


@dataclass
class Transmission:
    """A reply that is being sent. Its n-th character ends n character times after `begin`."""

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
        """Return the characters that were sent by the time `now`, without those already returned."""
        if now < self.begin:
            return b""
        passed = len(self.data)
        if now < self.end:
            passed = math.floor((now - self.begin) / self.character + ROUNDING)
        taken = self.data[self.sent : passed]
        self.sent = max(self.sent, passed)
        return taken


class ReceiverGroup:
    """Drives with the same framing, settings and longest silence, which receive the same frames."""

    def __init__(self, receiver: Receiver, settings: Settings) -> None:
        self.receiver = receiver
        self.settings = settings
        self.drives: dict[int, SimulatedDrive] = {}

    def addressed(self, frame: Frame) -> Sequence[SimulatedDrive]:
        """Return the drives that a frame addresses; a broadcast addresses all."""
        if frame.address == 0 and self.receiver.framing is not Framing.TCP:
            return list(self.drives.values())
        return [self.drives[frame.address]] if frame.address in self.drives else []


class Wire:
    """One line with simulated drives.

    `port` is "pty", a path for a link to the pty, "socket://host:port" (port 0: any free port), or
    "tcp://host:port" for drives behind a Modbus TCP gateway. A client opens `path`. On an `unpaced` wire
    characters and response delays take no time.
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
        for sim in drives:
            sim.drive.take_framing_of(port)
        self.name = name
        self.where = port
        self.port: SimulatedEnd | None = None  # None while closed
        self._pace = 0.0 if unpaced else 1.0  # factor for all durations: 1, or 0 on an unpaced wire
        self._groups = self._group()
        self._outgoing: list[Transmission] = []  # replies that are not completely sent, ordered by start time
        self._quiet_since = -math.inf  # time in s at which the last reply ended, or -inf
        self._baudrate: int | None = None

    def _group(self) -> list[ReceiverGroup]:
        groups: dict[tuple[Framing, Settings, float], ReceiverGroup] = {}
        taken: dict[tuple[int, Framing, int], SimulatedDrive] = {}
        for sim in self.drives:
            drive = sim.drive
            other = taken.setdefault((drive.address, drive.framing, drive.settings.baudrate), sim)
            if other is not sim:
                raise ValueError(f"{self.name}: {other.drive.name} and {drive.name} have the same address")
            key = (drive.framing, drive.settings, sim.most_gap)
            if key not in groups:
                gap = sim.most_gap if self._pace else UNPACED_GAP
                character = drive.settings.character * self._pace
                groups[key] = ReceiverGroup(Receiver(drive.framing, character, gap), drive.settings)
            groups[key].drives[drive.address] = sim
        return list(groups.values())

    def __repr__(self) -> str:
        return f"<Wire {self.name} of {len(self.drives)} drives>"

    def receive(self, chunk: bytes, now: float, baudrate: int | None = None) -> None:
        """Receive bytes from the client at `now` s. `baudrate` is the client's; None if it is unknown."""
        if baudrate != self._baudrate:
            for group in self._groups:
                group.receiver.forget()
            self._baudrate = baudrate
        for group in self._groups:
            if baudrate is None or group.settings.baudrate == baudrate:
                self._deliver(group, group.receiver.feed(chunk, now))

    def advance(self, now: float) -> bytes:
        """Advance to the time `now` in s. Return the bytes that the client receives until then."""
        for group in self._groups:
            if frames := group.receiver.silence(now):
                self._deliver(group, frames)
        if not self._outgoing:
            return b""
        received = bytearray()
        while self._outgoing:
            received += self._outgoing[0].take(now)
            if now < self._outgoing[0].end:
                break
            self._quiet_since = self._outgoing.pop(0).end
            if self._outgoing:  # the next reply waits until this one has ended
                self._outgoing[0].begin = max(self._outgoing[0].begin, self._quiet_since)
        return bytes(received)

    @property
    def wake(self) -> float | None:
        """The time in s at which to call `advance` next; None if nothing is due until bytes are received."""
        times = [at for group in self._groups if (at := group.receiver.silent_at) is not None]
        if self._outgoing:
            times.append(self._outgoing[0].next_at)
        return min(times, default=None)

    def distort(self, reply: bytes) -> bytes:
        """Return the reply as it reaches the client. Tests override this to damage replies."""
        return reply

    def _deliver(self, group: ReceiverGroup, frames: Sequence[Frame]) -> None:
        for frame in frames:
            for sim in group.addressed(frame):
                if self._keeps_silence(sim, frame) and (reply := sim.receive(frame)) is not None:
                    if frame.transaction:  # only Modbus TCP has transaction ids
                        reply = replace(reply, transaction=frame.transaction)
                    begin = frame.end + sim.delay * self._pace
                    self._reply(sim, build_reply(sim.drive.framing, reply), begin, group.receiver.character)

    def _reply(self, sim: SimulatedDrive, data: bytes, begin: float, character: float) -> None:
        self._send(self.distort(data), begin, character)

    def _send(self, data: bytes, begin: float, character: float) -> None:
        bisect.insort(self._outgoing, Transmission(data, begin, character), key=lambda reply: reply.begin)

    def _keeps_silence(self, sim: SimulatedDrive, frame: Frame) -> bool:
        """Return True if the drive accepts the frame; count a frame that came too soon after a reply.

        The silence counts from the end of the simulator's own reply, whose time is known exactly. So a late
        wake-up of this process never makes a frame count as early.
        """
        replying = self._outgoing and self._outgoing[0].begin <= frame.begin
        silent_for = frame.begin - (self._outgoing[0].end if replying else self._quiet_since)
        bit = sim.drive.settings.bit * self._pace
        if silent_for >= sim.silence * self._pace - bit:
            return True
        sim.counters.early += 1
        return not sim.needs_silence and silent_for >= -bit

    @property
    def path(self) -> str:
        """The path that a client opens. It exists only while a simulator runs the wire."""
        if self.port is None:
            raise RuntimeError(f"{self.name} is not open: run it in a Simulator")
        return self.port.path

    def open(self) -> None:
        self.port = open_port(self.where, self.drives[0].drive.settings)

    def close(self) -> None:
        if self.port is not None:
            self.port.close()
            self.port = None


# ---- the simulator's end of the line: a pty, or a TCP port that serves one client at a time ----

MOST_READ = 4096


def is_dead_link(link: Path) -> bool:
    """Return True if a killed simulator left this link: its pty is gone or is used by another program."""
    if not link.is_symlink():
        return False
    target = str(link.readlink())
    return target.startswith("/dev/pts/") and not (link.exists() and is_simulated(target))


class PtyPort:
    """A pty whose other end a client opens by its path.

    This object keeps the client's end open, so that the pty remains when a client closes it. Of a client's
    settings, only the baud rate has an effect, because a pty stores no parity.
    """

    def __init__(self, settings: Settings, link: Path | None) -> None:
        if not hasattr(os, "openpty"):
            raise OSError("this system has no pseudo-terminals: name ports such as socket://127.0.0.1:0")
        self._master, self._slave = os.openpty()
        self._simulated: SimulatedPort | None = None
        self._link = link
        try:
            os.set_blocking(self._master, False)
            set_settings(self._slave, settings.baudrate, settings.format)
            self.path = os.ttyname(self._slave)
            self._simulated = SimulatedPort(self.path, default_ledger_path().parent)
            if link is not None:
                if is_dead_link(link):
                    link.unlink()
                link.symlink_to(self.path)
                self.path = str(link)
        except OSError:
            self._link = None
            self.close()
            raise

    def fileno(self) -> int:
        return self._master

    def read(self) -> bytes:
        try:
            return os.read(self._master, MOST_READ)
        except BlockingIOError:
            return b""

    def write(self, data: bytes) -> None:
        # if no client reads, the bytes are lost, as on a real line
        with contextlib.suppress(BlockingIOError):
            os.write(self._master, data)

    def baudrate(self) -> int | None:
        return get_settings(self._slave)[0]

    def close(self) -> None:
        if self._link is not None:
            self._link.unlink(missing_ok=True)
        if self._simulated is not None:
            self._simulated.close()
        os.close(self._master)
        os.close(self._slave)


class TCPPort:
    """A listening socket; it accepts the next client when the current one has disconnected."""

    def __init__(self, url: str) -> None:
        parts = urlsplit(url)
        if parts.hostname is None or parts.port is None:
            kind = parts.scheme
            raise ValueError(f"{url!r} is not {kind}://host:port, such as {kind}://127.0.0.1:5020")
        self._listener = socket.create_server((parts.hostname, parts.port))
        self._listener.setblocking(False)
        self._client: socket.socket | None = None
        host, port, *_ = self._listener.getsockname()
        near = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
        self._simulated = SimulatedPort(of_address((near, port)), default_ledger_path().parent)
        self.path = f"{parts.scheme}://{parts.hostname}:{self._listener.getsockname()[1]}"

    def fileno(self) -> int:
        """Return the descriptor to poll; it changes when a client connects or disconnects."""
        return (self._client or self._listener).fileno()

    def read(self) -> bytes:
        if self._client is None:
            with contextlib.suppress(BlockingIOError, ConnectionError):  # the client has already disconnected
                self._client, _ = self._listener.accept()
                self._client.setblocking(False)
                self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            return b""
        try:
            chunk = self._client.recv(MOST_READ)
        except BlockingIOError:
            return b""
        except OSError:
            chunk = b""
        if not chunk:
            self._hang_up()
        return chunk

    def _hang_up(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None

    def write(self, data: bytes) -> None:
        if self._client is not None:
            with contextlib.suppress(OSError):  # reading detects a disconnected client
                self._client.send(data)

    def baudrate(self) -> None:
        """Return None, because a TCP client's baud rate is unknown."""

    def close(self) -> None:
        self._hang_up()
        self._simulated.close()
        self._listener.close()


SimulatedEnd = PtyPort | TCPPort  # both types have the same methods, which never block


def open_port(where: str, settings: Settings) -> SimulatedEnd:
    """Open the pty or TCP port named by `where`; see `Wire` for the forms of `where`."""
    if where.startswith(("socket://", "tcp://")):
        return TCPPort(where)
    return PtyPort(settings, None if where == "pty" else Path(where))
