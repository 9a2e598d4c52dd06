"""A bus whose line is simulated drives in this very thread, at a time that only the test lets pass."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from completions import completed

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

EXCHANGE_TIME = 0.02  # s
TIMEOUT = 0.3

READING = {1, 2, 3, 4}
QUERYING = {3, 7}  # of Delixi's own protocol


def text(frame: bytes) -> str:
    """Return the frame as documents print it."""
    return frame.decode().strip() if frame.startswith(b":") else frame.hex(" ").upper()


class SimulatedBus:
    """Drives that are simulated, and a bus to them; every frame that was sent is kept.

    `loses(request)` says whether the reply to it is lost, `deafens(request)` whether it never arrives.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *sims: SimulatedDrive, **details: Any) -> None:
        self.sims = sims
        self.seconds = 1000.0
        self.slept = 0.0  # s; the machine, and with it CLOCK_MONOTONIC
        self.frames: list[tuple[Message, str]] = []
        self.loses: Callable[[Message], bool] = lambda request: False
        self.deafens: Callable[[Message], bool] = lambda request: False
        self.answers: Callable[[Message], bytes | None] = lambda request: None  # instead of the drives
        self.queue_time = 0.0  # until an exchange's turn comes
        self.queue = object()  # the open port
        self.has_echo = False
        self.port = self.identity = "hall"
        monkeypatch.setattr(bus, "Line", lambda port, *facts: self)
        monkeypatch.setattr(peers, "_former", {})  # they are another clock's
        monkeypatch.setattr(clock, "sleep", self.sleep)
        monkeypatch.setattr(clock, "now_ns", lambda: round(self.seconds * 1e9))
        monkeypatch.setattr(clock, "boottime_ns", lambda: round((self.seconds + self.slept) * 1e9))
        monkeypatch.setattr(clock, "utc_minus_monotonic_ns", lambda: 1_700_000_000 * 10**9)
        self.bus = bus.Bus("hall", **details)

    def sleep(self, seconds: float) -> None:
        self.seconds += seconds

    is_lost = is_tcp = False
    why_closing = ""
    may_send = True  # it has no mastership

    def open(self) -> SimulatedBus:
        return self

    def close(self) -> None:
        pass

    def regain(self) -> None:
        """Whatever stands in the way of that is the test's."""

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
        reply = self.answers(request)
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
        """Note when the drive was heard, as the core does."""
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
        """The frames that were no reads."""
        return [frame for request, frame in self.frames if is_write(request)]


def is_write(request: Message) -> bool:
    if len(request.data) == 4:  # Delixi's own
        return request.function not in QUERYING
    return request.function not in READING


def one(
    monkeypatch: pytest.MonkeyPatch, drive: Drive, **details: Any
) -> tuple[SimulatedBus, Any, MotorDrive]:
    """Return a simulated bus, and its one drive with its simulation."""
    sim = simulated(drive)
    assert isinstance(sim, MotorDrive)
    bus = SimulatedBus(monkeypatch, sim, **details)
    return bus, bus.attach(drive), sim
