"""A bus whose line is replaced by simulated drives, in the same thread and on simulated time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from batches import completed

from multidrop import bus
from multidrop.core import (
    PAUSE_NS,
    Completion,
    Exchange,
    Failure,
    Message,
    Peer,
    RowLayout,
    build_reply,
    build_request,
    parse_reply,
)
from multidrop.drive import Drive
from multidrop.sim import MotorDrive, SimulatedDrive, simulated
from multidrop.transport import clock, peers

EXCHANGE_TIME = 0.02  # duration of an exchange in s
TIMEOUT = 0.3

READING = {1, 2, 3, 4}
# modules and names that a SimulatedBus replaces
REPLACED = [(bus, "Line"), (peers, "_former")]
REPLACED += [(clock, name) for name in ("sleep", "now_ns", "boottime_ns", "utc_minus_monotonic_ns")]

QUERYING = {3, 7}  # functions of Delixi's own protocol that only read


def text(frame: bytes) -> str:
    """Return the frame as documents print it: RTU in hex, text without its line end."""
    return frame.decode().strip() if frame.startswith(b":") else frame.hex(" ").upper()


@contextmanager
def real_clock() -> Iterator[None]:
    """Restore everything that a `SimulatedBus` replaces."""
    kept = [getattr(module, name) for module, name in REPLACED]
    yield
    for (module, name), value in zip(REPLACED, kept, strict=True):
        setattr(module, name, value)


class SimulatedBus:
    """Simulated drives and a `Bus` to them; every sent frame is recorded.

    If `loses(request)` is true, the reply is lost; if `deafens(request)` is true, the request is lost.
    It replaces the clock and the line of `Bus`; `real_clock` restores them.
    """

    def __init__(self, *sims: SimulatedDrive, **details: Any) -> None:
        self.sims = sims
        self.seconds = 1000.0
        self.slept = 0.0  # s of system suspend, which CLOCK_MONOTONIC does not count
        self.frames: list[tuple[Message, str]] = []
        self.loses: Callable[[Message], bool] = lambda request: False
        self.deafens: Callable[[Message], bool] = lambda request: False
        # returns a reply that replaces the drives' reply, or None
        self.answers: Callable[[Message], bytes | None] = lambda request: None
        # returns an error that ends the exchange, or None
        self.fails: Callable[[Message], BaseException | None] = lambda request: None
        # returns the code of an exception with which the drive refuses the request, or 0
        self.refuses: Callable[[Message], int] = lambda request: 0
        self.queue_time = 0.0  # s that each exchange waits for its turn
        self.queue = object()  # as long as this is not None, the port counts as open
        self.has_echo = False
        self.port = self.identity = "hall"
        replacements = (  # one for each name in REPLACED, in the same order
            lambda port, *facts: self,
            {},  # forget timing that was learnt on another clock
            self.sleep,
            lambda: round(self.seconds * 1e9),
            lambda: round((self.seconds + self.slept) * 1e9),
            lambda: 1_700_000_000 * 10**9,
        )
        for (module, name), replacement in zip(REPLACED, replacements, strict=True):
            setattr(module, name, replacement)
        self.bus = bus.Bus("hall", **details)

    def sleep(self, seconds: float) -> None:
        self.seconds += seconds

    is_lost = is_stalled = is_tcp = False
    why_closing = ""
    may_send = True  # True, because this bus has no mastership that could be lost

    def open(self) -> SimulatedBus:
        return self

    def close(self) -> None:
        pass

    def regain(self) -> None:
        """Reopen the port; tests replace this with failures."""

    def overruns(self) -> None:
        return None

    def counted_ns(self, now_ns: int) -> int:
        return now_ns

    def inherit(self, peer: Peer, before: Peer) -> None:
        peer.inherit(before)

    def carry_out(
        self,
        exchange: Exchange,
        *,
        not_before_ns: int = 0,
        expires_ns: int = 0,
        into: Completion | None = None,
    ) -> Completion:
        request = exchange.request
        self.seconds += self.queue_time
        is_overtaken = exchange.permit is not None and not exchange.permit.is_good
        if is_overtaken or (expires_ns and clock.boottime_ns() > expires_ns):
            return self._completion(int(Failure.EXPIRED))
        frame = build_request(exchange.framing, request)
        self.frames.append((request, text(frame)))
        self.seconds += EXCHANGE_TIME
        if failure := self.fails(request):
            raise failure
        reply = self.answers(request)
        if code := self.refuses(request):
            refusal = Message(request.address, request.function, request.start, exception=code)
            reply = build_reply(exchange.framing, refusal)
        if reply is None and not self.deafens(request):
            answers = [
                sim.answer(request, self.seconds)
                for sim in self.sims
                if sim.drive.framing is exchange.framing
            ]
            replies = [answer for answer in answers if answer is not None]
            assert len(replies) <= 1
            reply = build_reply(exchange.framing, replies[0]) if replies else None
        if request.address == 0:
            return self._completion(0)
        if reply is None or self.loses(request):
            self.seconds += TIMEOUT
            return self._completion(int(Failure.NO_REPLY))
        self._note_answer(exchange)
        used, message = parse_reply(exchange.framing, reply, request)
        return self._completion(used or int(Failure.CUT_SHORT), message, reply, exchange.values)

    def _note_answer(self, exchange: Exchange) -> None:
        """Record the time of a reply as the core does."""
        drive, at_ns = exchange.c.drive, round(self.seconds * 1e9)
        if drive.answered_ns and at_ns - drive.answered_ns >= PAUSE_NS:
            drive.history.pauses += 1
        drive.answered_ns = at_ns

    def _completion(
        self, result: int, reply: Message | None = None, raw: bytes = b"", values: RowLayout | None = None
    ) -> Completion:
        at = round(self.seconds * 1e9)
        return completed(result, reply or Message(0, 0), raw, values, at_ns=at)

    def attach(self, drive: Drive) -> Any:
        return self.bus.attach(drive)

    @property
    def written(self) -> list[str]:
        """Return the sent frames that are not reads."""
        return [frame for request, frame in self.frames if is_write(request)]


def is_write(request: Message) -> bool:
    if len(request.data) == 4:  # the request is in Delixi's own protocol
        return request.function not in QUERYING
    return request.function not in READING


def one(drive: Drive, **details: Any) -> tuple[SimulatedBus, Any, MotorDrive]:
    """Return a simulated bus with one drive, that drive, and its simulation."""
    sim = simulated(drive)
    assert isinstance(sim, MotorDrive)
    bus = SimulatedBus(sim, **details)
    return bus, bus.attach(drive), sim
