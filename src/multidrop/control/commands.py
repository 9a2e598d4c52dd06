"""The command service of servers: carries out the verbs, writes and stops that many clients call.

Each command has a thread of its own, so that a stop waits for no other command. The thread inherits its
caller's context: the author (`written_by`) and the deadline (`written_before`). A command never raises; it
returns a CommandResult.
"""

from __future__ import annotations

import asyncio
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from math import isfinite
from typing import Any, NamedTuple, TypeVar

from multidrop.control.call import written_before
from multidrop.control.outcome import (
    Outcome,
    Seen,
    Stopped,
    result_of_failed_stop,
    result_of_failure,
    result_of_stop,
    result_of_write,
)
from multidrop.drive.family import Drive
from multidrop.drive.register import Register
from multidrop.drive.verbs import CommandOutcome, CommandResult
from multidrop.errors import NotAttached
from multidrop.supervisor import supervisor

COMMAND_S = 60.0  # a command that takes longer is reported as hanging (a stop may take 30 s)
TURN_S = 0.2  # s; how long each stop may block the event loop, if no thread can be started
AGAIN_S = 0.2  # s; pause between two such stops, so that the event loop can do other work
STOP_S = 30.0  # s; how long the event loop repeats stops, if no thread can be started
# Seconds. After a client's stop command, an unconfirmed stop is repeated for at least this time.
REPEATED_S = 30.0
MOST_STOPS = 8  # limit of concurrent stops of one drive that arrive over one interface
JOIN_S = 0.5  # s; delay of the one stop that replaces all stops above MOST_STOPS
BEGINNING_S = 0.25  # s; longest time from the call of a stop until `stops_under_way` lists it

R = TypeVar("R")
Results = dict[str, CommandResult]  # results by drive name
StopFuture = asyncio.Future[Results]
StopWork = Callable[[float | None], Results]  # argument: for how many s to repeat the stop (None: default)


# ---- on a drive ----


def carry_out_verb(drive: Drive, verb: str, arguments: Mapping[str, Any]) -> CommandResult:
    """Carry out a verb that may move the motor; return the result, never raise."""
    try:
        getattr(drive, verb)(**arguments)
    except Exception as failure:  # any failure: the result reports it to the caller
        return result_of_failure(failure)
    return CommandResult(CommandOutcome.DONE, f"{drive.name}: {verb} is done")


def write_register(drive: Drive, name: str, value: float | str) -> CommandResult:
    """Write a register and return the result; never raise.

    If the register has named values (choices), `value` is a choice's name or its raw count.
    """
    try:
        register = drive.register(name)
        typed = typed_value(register, value)
    except (ValueError, TypeError) as mistake:
        return result_of_failure(mistake)._replace(outcome=CommandOutcome.REFUSED)
    if drive.bus is None:
        return result_of_failure(NotAttached(f"{drive.name} is no longer on a line"))
    try:
        outcome: Outcome = drive.try_write(register, typed)
    except Exception as failure:  # any failure: the result reports it to the caller
        return result_of_failure(failure)
    return result_of_write(outcome)


def typed_value(register: Register[Any], value: float | str) -> Any:
    """Convert a value to the register's type. Raises ValueError if a choice's raw count is not whole."""
    if isinstance(value, str):
        return register.parse(value)
    if register.values is None:
        return value
    if isinstance(value, float) and (not isfinite(value) or value != int(value)):
        raise ValueError(f"{register.name} takes the name or the number of a choice, not {value!r}")
    return register.decode(value)


def stop_drive(drive: Drive, seconds: float | None, verb: str = "stop") -> Results:
    """Stop one drive, for example with the verb `coast`; return a dict that maps its name to the result."""
    if not drive.has_motor:
        return {drive.name: result_of_stop(Stopped(drive.name, Seen.NO_MOTOR, 0.0))}
    try:
        return {drive.name: getattr(drive, verb)(seconds=seconds)}
    except Exception as failure:  # any failure: the result reports it to the caller
        return {drive.name: result_of_failed_stop(failure)}


def stop_line(bus: Callable[[], Any], names: Sequence[str], seconds: float | None) -> Results:
    """Stop all drives on the bus that `bus()` returns; return the results of the drives in `names`."""
    try:
        found: Mapping[str, Stopped] = bus().stop_all(seconds=seconds)
    except Exception as failure:  # any failure: the results of all drives report it
        return dict.fromkeys(names, result_of_failed_stop(failure))
    gone = result_of_failure(NotAttached("it is no longer on its line"))
    return {name: result_of_stop(found[name]) if name in found else gone for name in names}


# ---- on threads ----


def in_thread(work: Callable[[], R]) -> asyncio.Future[R]:
    """Do work in a new thread; the work continues to its end even if its caller is cancelled.

    Raises RuntimeError or MemoryError if the system has no thread left.
    """
    return supervisor().thread("command", COMMAND_S, work)


def begin_command(
    work: Callable[[], CommandResult],
    limit_ns: Callable[[], float],
    why_not: Callable[[], CommandResult | None],
) -> asyncio.Future[CommandResult]:
    """Carry out a command in a thread; return a future for its result.

    `limit_ns` returns the time of CLOCK_MONOTONIC after which the command's first frame is not sent.
    `why_not` is called first in that thread; if it returns a result, the command is not carried out. If the
    system has no thread left, the result is NOT_SENT.
    """

    def checked() -> CommandResult:
        if (refusal := why_not()) is not None:
            return refusal
        with written_before(limit_ns):
            return work()

    try:
        return in_thread(checked)
    except (RuntimeError, MemoryError) as failure:
        future: asyncio.Future[CommandResult] = asyncio.get_running_loop().create_future()
        future.set_result(result_of_failure(failure)._replace(outcome=CommandOutcome.NOT_SENT))
        return future


def begin_stops(works: Sequence[StopWork]) -> list[asyncio.Future[Results]]:
    """Start stops, each in a thread of its own; return a future for each.

    If the system has no thread left, the remaining stops share one task in the event loop.
    """
    begun: list[asyncio.Future[Results]] = []
    try:
        for work in works:
            future = in_thread(partial(work, None))
            begun.append(future)
    except (RuntimeError, MemoryError):
        left = works[len(begun) :]
        rest = supervisor().start("stop", _stop_without_threads(left))
        # shielded: the task continues if its callers are cancelled
        begun += [asyncio.shield(rest) for _ in left]
    return begun


async def _stop_without_threads(works: Sequence[StopWork]) -> Results:
    """Send each stop once before waiting for any motor to stop; then repeat one stop after another.

    As soon as the system has a thread again, a stop continues in that thread. The event loop runs between the
    stops, because a gateway in a fleet must renew its right to send. Without this right it sends no stop.
    """
    loop = asyncio.get_running_loop()
    found: Results = {}
    for work in works:
        found |= work(0.0)
        await asyncio.sleep(0)
    left, waited = deque(works), []
    ends = loop.time() + STOP_S
    while left and loop.time() < ends:
        await asyncio.sleep(AGAIN_S)
        work = left.popleft()
        try:
            waited.append(in_thread(partial(work, None)))
        except (RuntimeError, MemoryError):
            results = work(TURN_S)
            found |= results
            if not all(result.ok for result in results.values()):
                left.append(work)
    for results in await asyncio.gather(*waited):
        found |= results
    return found


# ---- stops that many clients call ----


class LineStop(NamedTuple):
    """Drives of one line to stop. `whole` is a function that stops the whole line, or None."""

    drives: Sequence[Drive]
    whole: StopWork | None = None


class RepeatedStops:
    """Repeats only one stop per drive at a time, however many clients of a server call stops.

    The stop of a silent drive is repeated for 30 s, and each time its line waits for the reply. If every
    client's stop were repeated, these waits would delay the stops of other drives, and all reads. `stop` is
    the function that stops one drive. Use this class only in the server's event loop.
    """

    def __init__(
        self,
        stop: Callable[[Drive, float | None], Results] = stop_drive,
        begin: Callable[[Sequence[StopWork]], list[StopFuture]] = begin_stops,
    ) -> None:
        self._stop = stop
        self._begin = begin
        # each drive's newest repeated stop, and when that stop was called
        self._repeated: dict[Drive, tuple[StopFuture, float]] = {}
        # `send_once` sends an extra stop: a stop that is not repeated.
        self._sent: dict[Drive, StopFuture] = {}  # extra stops in flight, by drive
        # extra stops that wait for the one in flight, by drive
        self._waiting: dict[Drive, StopFuture] = {}
        self._tasks: set[StopFuture] = set()

    def begin(self, lines: Iterable[LineStop]) -> list[StopFuture]:
        """Stop these drives in parallel; return the futures of the stops.

        If a drive's stop is already being repeated, send only one more stop to that drive.
        """
        works: list[StopWork] = []
        stopped: list[list[Drive]] = []
        once: list[Drive] = []
        for line in lines:
            new, others = self.divided(line.drives)
            once += others
            if line.whole is not None and new and not others:
                works.append(line.whole)
                stopped.append(new)
            else:
                works += [partial(self._stop, drive) for drive in new]
                stopped += [[drive] for drive in new]
        begun = self._begin(works)
        for future, drives in zip(begun, stopped, strict=True):
            self.note(drives, future)
        return [*begun, *(self.send_once(drive) for drive in once)]

    def note(self, drives: Iterable[Drive], future: StopFuture) -> None:
        """Record the future of a stop that is being repeated for these drives."""
        self._repeated = {drive: one for drive, one in self._repeated.items() if not one[0].done()}
        self._repeated |= dict.fromkeys(drives, (future, _now()))

    def of(self, drive: Drive) -> StopFuture | None:
        """Return the future of the stop that is being repeated for this drive; None if there is none.

        If that future stops a whole line, this drive's own stop may be over first. Then return None.
        """
        stops, called = self._repeated.get(drive, (None, 0.0))
        if stops is None or stops.done():
            return None
        bus = drive.bus
        goes_on = bus is not None and drive.name in bus.stops_under_way()
        return stops if goes_on or _now() - called < BEGINNING_S else None

    def divided(self, drives: Iterable[Drive]) -> tuple[list[Drive], list[Drive]]:
        """Divide the drives into those whose stop must be started, and those whose stop is being repeated."""
        drives = [*drives]
        again = [drive for drive in drives if self.of(drive) is not None]
        return [drive for drive in drives if drive not in again], again

    def send_once(self, drive: Drive) -> StopFuture:
        """Send one extra stop to a drive whose stop is already being repeated.

        Return a future for the result of the repeated stop. If the repeated stop gives up less than
        REPEATED_S after this call, another one is started.
        """
        task = asyncio.ensure_future(self._send_and_await(drive))
        self._tasks.add(task)  # the task continues if its caller is cancelled
        task.add_done_callback(self._tasks.discard)
        return asyncio.shield(task)

    async def _send_and_await(self, drive: Drive) -> Results:
        ends = _now() + REPEATED_S
        result = (await asyncio.shield(self._soon(drive)))[drive.name]
        if (repeated := self.of(drive)) is not None:
            result = (await asyncio.shield(repeated))[drive.name]
        if not result.ok and _now() < ends:
            if (repeated := self.of(drive)) is None:
                (repeated,) = self._begin([partial(self._stop, drive)])
                self.note([drive], repeated)
            result = (await asyncio.shield(repeated))[drive.name]
        return {drive.name: result}

    def _soon(self, drive: Drive) -> StopFuture:
        """Send a stop now. While one is in flight, queue one more, which serves all calls made meanwhile."""
        if drive not in self._sent:
            return self._send(drive)
        if drive not in self._waiting:
            self._waiting[drive] = asyncio.ensure_future(self._send_after(self._sent[drive], drive))
        return self._waiting[drive]

    def _send(self, drive: Drive) -> StopFuture:
        (sent,) = self._begin([lambda seconds: self._stop(drive, 0.0)])
        self._sent[drive] = sent
        sent.add_done_callback(partial(self._forget, drive))
        return sent

    async def _send_after(self, before: StopFuture, drive: Drive) -> Results:
        await asyncio.wait([before])
        # This stop is about to be sent, so later calls need another one.
        del self._waiting[drive]
        return await self._send(drive)

    def _forget(self, drive: Drive, sent: StopFuture) -> None:
        if self._sent.get(drive) is sent:
            del self._sent[drive]


def _now() -> float:
    return asyncio.get_running_loop().time()


class JoinedStops:
    """Starts the stops that arrive over one interface, so that a flood of stops delays no other stop.

    While MOST_STOPS stops of the same drives are in progress, further ones wait for JOIN_S seconds. Then one
    stop is started for all waiting callers.
    """

    def __init__(self) -> None:
        self._running: Counter[object] = Counter()  # numbers of unfinished stops, by the drives to stop
        self._joined: dict[object, asyncio.Future[Any]] = {}  # waiting stops, by the drives to stop

    def begin(self, drives: object, start: Callable[[], asyncio.Future[R]]) -> asyncio.Future[R]:
        """Start a stop, and return its future; several joined stops have the same future.

        `drives` says which drives it stops, and `start` starts it.
        """
        if not self.joins(drives):
            return self._start(drives, start)
        if drives not in self._joined:
            self._joined[drives] = supervisor().start("joined stops", self._start_joined(drives, start))
        return self._joined[drives]

    def joins(self, drives: object) -> bool:
        """Return True if a further stop of the drives would be joined with others."""
        return self._running[drives] >= MOST_STOPS

    async def _start_joined(self, drives: object, start: Callable[[], asyncio.Future[R]]) -> R:
        await asyncio.sleep(JOIN_S)
        del self._joined[drives]
        return await self._start(drives, start)

    def _start(self, drives: object, start: Callable[[], asyncio.Future[R]]) -> asyncio.Future[R]:
        stopping = start()
        self._running[drives] += 1
        stopping.add_done_callback(lambda _: self._end(drives))
        return stopping

    def _end(self, drives: object) -> None:
        self._running[drives] -= 1
        if not self._running[drives]:
            del self._running[drives]
