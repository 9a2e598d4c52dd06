"""A bus whose line is replaced by simulated drives, on simulated time; starts and stops among its frames."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from batches import completed
from motors import MAKE, STARTS

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
from multidrop.drive import Condition, Direction, Drive, Script, State, read, write
from multidrop.drive.register import Kept, reading, setting
from multidrop.drive.verbs import verb
from multidrop.errors import BusError
from multidrop.families import InvtCHE
from multidrop.sim import MotorDrive, SimulatedDrive, simulated
from multidrop.transport import clock, drive_records

EXCHANGE_TIME = 0.02  # duration of an exchange in s
TIMEOUT = 0.3

READING = {1, 2, 3, 4}
# modules and names that a SimulatedBus replaces
REPLACED = [(bus, "Line"), (drive_records, "_former")]
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
    may_send = True  # always True: this bus needs no right to send

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
            exchange.c.drive.failures += 1
            return self._completion(int(Failure.NO_REPLY))
        self._note_answer(exchange)
        used, message = parse_reply(exchange.framing, reply, request)
        return self._completion(used or int(Failure.CUT_SHORT), message, reply, exchange.values)

    def _note_answer(self, exchange: Exchange) -> None:
        """Record the time of a reply, and that the drive is not silent, as the core does."""
        drive, at_ns = exchange.c.drive, round(self.seconds * 1e9)
        drive.failures = 0
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


# ---- starts and stops ----


STOPS: dict[str, Callable[[Message], bool]] = {  # by family: returns True for its documented stop
    "erman-er-g-220": lambda each: each.function == 5 and each.start == 1 and each.data != b"\0\0",
    "invt-che": lambda each: each.start == 0x1000 and each.data[-1] == 5,
    "innovert-ibd": lambda each: each.start == 0x2000 and each.data[-1] == 1,
    "delixi-modbus": lambda each: each.start == 0x2000 and each.data[-1] == 1,
    "delixi-native": lambda each: each.function == 2 and each.start == 1,
    "yd1000": lambda each: each.start == 0x1000 and each.data[0] == 0xC0,
}


class Own(Drive):
    """A user's drive whose stop is a setting that wears the EEPROM."""

    model = "own"
    title = "OWN 1"
    speed = reading(0x10, "rpm")
    run = setting(0x20, kept=Kept.EEPROM)
    ratio = setting(0x21, kept=Kept.RAM)

    @verb
    def start(self, direction: Direction | None = None) -> Script[None]:
        """Start the motor."""
        yield from read(self.speed)
        yield from write(self.run, 1)

    @verb
    def stop(self) -> Script[None]:
        """Stop the motor."""
        yield from write(self.run, 0)

    @verb
    def state(self) -> Script[State]:
        """Return the state that the drive reports."""
        speed = yield from read(self.speed)
        return State(Condition.RUNNING if speed else Condition.STOPPED)


def writes(line: SimulatedBus, begun: int = 0) -> list[Message]:
    return [request for request, _ in line.frames[begun:] if is_write(request)]


def starts(line: SimulatedBus, model: str) -> list[str]:
    """Return the frames sent so far that start a motor of this family."""
    return [frame for request, frame in line.frames if is_write(request) and STARTS[model](request)]


def all_stopped(line: SimulatedBus, sims: list[Any]) -> bool:
    """Return True if no motor turns."""
    for sim in sims:
        sim.pass_time(line.seconds)
    return not any(sim.motor.energised for sim in sims)


def first(line: SimulatedBus, begun: int, met: Callable[[Message], bool]) -> int | None:
    """Return how many frames from `begun` on precede the first write that `met` accepts, or None."""
    wanted = (at for at, (each, _) in enumerate(line.frames[begun:]) if is_write(each) and met(each))
    return next(wanted, None)


class Meanwhile:
    """After a number of further frames, lets another thread act, and waits for that thread."""

    def __init__(self, line: SimulatedBus, frames: int, act: Callable[[], object]) -> None:
        self.failure: BaseException | None = None
        self.has_come = False
        self._left = frames
        self._act = act
        self._carry_out = line.carry_out
        vars(line)["carry_out"] = self.carry_out

    def carry_out(self, exchange: Exchange, **times: Any) -> Completion:
        completion = self._carry_out(exchange, **times)
        self._left -= 1
        if self._left == 0:
            self.has_come = True
            thread = threading.Thread(target=self._run)
            thread.start()
            thread.join(120)
            assert not thread.is_alive()
        return completion

    def _run(self) -> None:
        try:
            self._act()
        except BaseException as failure:
            self.failure = failure


def che_drives(
    count: int = 1, *, hz: float = 20, runs_s: float | None = None
) -> tuple[SimulatedBus, list[Any], list[Any]]:
    """Return a simulated bus, its INVT CHE drives, whose setpoints are written, and their simulations.

    If `runs_s` is given, all motors have been running for this many seconds.
    """
    sims: list[Any] = [simulated(InvtCHE(address, maximum_frequency=50)) for address in range(1, count + 1)]
    line = SimulatedBus(*sims)
    drives: list[Any] = [line.attach(sim.drive) for sim in sims]
    for drive in drives:
        drive.set_frequency(hz)
        if runs_s is not None:
            drive.start()
    line.sleep(runs_s or 0)
    return line, drives, sims


def plain_stop(drive: Drive) -> tuple[Any, Any]:
    register = drive.registers.get("control") or drive.register("stop_coil")
    assert register.harmless
    return register, register.decode(register.harmless[-1])


def started_while(
    tmp_path: Path, model: str, frames: int, act: Callable[[SimulatedBus, Any], object]
) -> tuple[SimulatedBus, Any, Meanwhile, int, BaseException | None]:
    """Start a drive while another thread acts after `frames` frames.

    Returns the bus, the drive, the action, the number of frames before the start, and its error or None.
    """
    line, drive, _ = one(MAKE[model](1), ledger=tmp_path / f"wear-{frames}")
    drive.set_frequency(20)
    begun = len(line.frames)
    meanwhile = Meanwhile(line, frames, lambda: act(line, drive))
    failure = None
    try:
        drive.start()
    except BusError as error:
        failure = error
    return line, drive, meanwhile, begun, failure
