"""Staggered starts of several motors, and ramps of one motor's setpoint."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from contextvars import copy_context
from math import inf

from multidrop.control.call import Call
from multidrop.control.rules import conditions, raw_count, wears
from multidrop.core import PAUSE_NS
from multidrop.drive.family import Drive
from multidrop.drive.link import check_drive
from multidrop.drive.register import Kept, Register
from multidrop.drive.verbs import Direction, Script, Write, read, wait
from multidrop.errors import NotAttached, WriteForbidden
from multidrop.printable import is_number
from multidrop.transport import clock

# Seconds between reads of the drives that wait for their start. A drive that is silent for PAUSE_NS may have
# lost its power.
HEARD_S = PAUSE_NS / 2e9
# A start that comes later than planned expires. Delays up to these limits (s) do not count as late.
WAIT_SLACK_S, READ_S = 2.0, 5.0  # limits for one wait, and for the reads of one waiting drive


def start_staggered(drives: Sequence[Drive], gap: float, direction: Direction | None = None) -> None:
    """Start drives one after another, `gap` seconds apart.

    If a start fails, stop that drive and all started before it, and raise the failure. The failing drive gets
    no stop if its identity is not confirmed and nothing was sent to it: it may be of another family, and the
    stop of its declared family might start it. A drive whose stop is called on any thread during this call
    is not started. Drives that are not started yet are read regularly. After a silence, the setpoint of a
    drive that cannot report it is assumed lost, and its start raises WriteForbidden. Raises Expired if a
    start comes late because the computer slept or the process was suspended.
    """
    if not 0 <= gap < inf:
        raise ValueError(f"gap = {gap:g} s: it must be 0 or more")
    for drive in drives:
        drive.check_confirmed("start")
    calls = [drive.begin_call("start", drive.stops_called[0]) for drive in drives]
    unheard_s = 0.0
    for number, (drive, call) in enumerate(zip(drives, calls, strict=True)):
        try:
            if number:
                call = call and call.restarted()
                unheard_s = _await_turn(drives[number:], gap, unheard_s, call)
            drive.carry_out_move(drive.start.script(direction), call)
        except BaseException:
            _stop(drives[: number + _is_safe_to_stop(drive, call)])
            raise


def _is_safe_to_stop(drive: Drive, call: Call | None) -> bool:
    """Return False if no write was sent to the drive, and its present bus does not know its identity."""
    if call is None or call.sent:
        return True
    try:
        return bool(drive.bus and drive.bus.knows_identity(drive))
    except NotAttached:  # the drive was removed after `drive.bus` was read
        return False


def _await_turn(waiting: Sequence[Drive], gap: float, unheard_s: float, call: Call | None) -> float:
    """Wait for `gap` seconds. Every HEARD_S seconds of the wait, read the drives in `waiting`.

    `unheard_s` is the time in s since the drives' last read; return its new value after the wait. `call` is
    the start of the next drive. It can expire if the process is suspended during the wait.
    """

    def planned(seconds: float) -> AbstractContextManager[None]:
        return call.step(seconds) if call else nullcontext()

    while gap > 0:
        rest = min(gap, HEARD_S - unheard_s)
        with planned(rest + WAIT_SLACK_S):
            waiting[0].perform(wait(rest))
        gap, unheard_s = gap - rest, unheard_s + rest
        if unheard_s >= HEARD_S:
            unheard_s = 0.0
            for drive in waiting:
                # the later start of the drive will report the failure
                with suppress(Exception), planned(READ_S):
                    drive.identify()
    return unheard_s


def _stop(drives: Sequence[Drive]) -> None:
    """Stop all drives, each on a thread of its own, because a silent drive must not delay the others.

    If the system has no thread left, first send one stop to each remaining drive, without repetitions. Then
    stop one drive after another. If Ctrl-C interrupts this, send each drive one more stop.
    """

    def stop(drive: Drive, seconds: float | None = None) -> None:
        with suppress(Exception):  # whatever failed, the other drives must be stopped
            drive.stop(seconds=seconds)

    threads: list[threading.Thread] = []
    left = list(drives)
    try:
        with suppress(RuntimeError, MemoryError):
            while left:
                thread = threading.Thread(target=copy_context().run, args=[stop, left[0]])
                thread.start()
                threads.append(thread)
                del left[0]
        for seconds in (0.0, None):
            for drive in left:
                stop(drive, seconds)
    except BaseException:
        for drive in left:
            stop(drive, 0.0)
        raise
    for thread in threads:
        thread.join()


def ramp(drive: Drive, hz: float, *, rate: float | None = None, every: float = 0.5) -> None:
    """Change the setpoint to `hz` in steps, one every `every` seconds, at `rate` Hz/s.

    The default and highest rate is the drive's own: maximum frequency / acceleration time. Raises
    WriteForbidden if each step may be stored in EEPROM, or if the rate is unknown. If `hz` is not allowed,
    raises the error of `set_frequency` before the first step. Raises TypeError for a wrong argument.
    """
    check_drive(drive)
    if not is_number(every):
        raise TypeError(f"every = {every!r} is not a number of seconds")
    if not (rate is None or is_number(rate)):
        raise TypeError(f"rate = {rate!r} is not a number in Hz/s")
    drive.perform(_ramp(drive, hz, rate, every))


def _ramp(drive: Drive, hz: float, rate: float | None, every: float) -> Script[None]:
    if not every > 0:
        raise ValueError(f"every = {every:g} s is not above 0")
    drive.check_confirmed("set_frequency")
    register = drive.register(drive.setpoint_name)
    check_worn(drive, "a ramp")
    step = (yield from checked_rate(drive, rate)) * every
    at = yield from _present(drive, register)
    yield from check_setpoint(drive, hz)
    while at != hz:
        at = min(at + step, hz) if hz > at else max(at - step, hz)
        begun_ns = clock.now_ns()
        yield from drive.set_frequency.script(at)
        if at != hz:  # if a step took longer than `every`, later steps do not catch up
            yield from wait(max(0.0, every - (clock.now_ns() - begun_ns) / 1e9))


def checked_rate(drive: Drive, rate: float | None) -> Script[float]:
    """Return `rate` in Hz/s, or the rate of the drive's own ramp if `rate` is None.

    Raises WriteForbidden if neither is known. Raises ValueError if `rate` is not above 0, or is faster than
    the drive's own ramp.
    """
    own = yield from _own_rate(drive)
    if rate is None and own is None:
        raise WriteForbidden(f"the acceleration of {drive.name} cannot be read: pass rate in Hz/s")
    if rate is not None and not rate > 0:
        raise ValueError(f"rate = {rate:g} Hz/s is not above 0")
    if rate is not None and own is not None and rate > own:
        raise ValueError(f"rate = {rate:g} Hz/s is faster than {drive.name} itself can ramp, {own:g} Hz/s")
    return rate or own or 0.0


def check_worn(drive: Drive, what: str) -> None:
    """Raise WriteForbidden if the drive may store its setpoint in EEPROM; `what` describes the writes."""
    if wears(drive, drive.register(drive.setpoint_name)) is not Kept.RAM:
        raise WriteForbidden(
            f"the setpoint of {drive.name} may be kept in EEPROM, which {what} would wear out"
        )


def check_setpoint(drive: Drive, hz: float) -> Script[None]:
    """Raise if this setpoint is not allowed; without this check, a ramp would first run up to the limit."""
    script = drive.set_frequency.script(hz)
    try:
        step = next(script)
        while not isinstance(step, Write):
            step = script.send((yield step))
    except StopIteration:  # the script writes no setpoint
        return
    raw = raw_count(drive, step.register, step.value)
    yield from conditions(drive, step.register, step.register.decode(raw))


def _own_rate(drive: Drive) -> Script[float | None]:
    """Return the rate of the drive's own ramp in Hz/s; None if it is unknown."""
    most = drive.option.get("maximum_frequency")
    if most is None and "maximum_frequency" in drive.registers:
        most = yield from read(drive.register("maximum_frequency"))
    if most is None or "acceleration_time" not in drive.registers:
        return None
    seconds = yield from read(drive.register("acceleration_time"))
    return most / seconds if most and seconds else None


def _present(drive: Drive, register: Register[float]) -> Script[float]:
    """Return the drive's present setpoint, in Hz."""
    held = (yield from read(register)) if register.readable else drive.commanded
    if held is None:
        raise WriteForbidden(f"{drive.name} cannot report its setpoint: call set_frequency before a ramp")
    if register.unit != "%":
        return held
    most = drive.option.get("maximum_frequency")
    if most is None:
        raise WriteForbidden(
            f"{register.name} of {drive.name} is in %: for a ramp, declare maximum_frequency = HZ"
        )
    return held * most / 100
