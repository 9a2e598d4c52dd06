"""Predict a line's bus cycle, utilisation and rates before its port is opened, and suggest better settings.

The prediction assumes that every exchange succeeds at the first attempt, and that the host adds its usual
lateness. The order of exchanges comes from `Schedule`, run on a simulated clock.
"""

from __future__ import annotations

import copy
import math
from bisect import bisect_left
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import count
from typing import Any, NamedTuple

from multidrop.core import build_request, characters_on_wire, reply_length
from multidrop.drive.family import Drive
from multidrop.drive.register import COIL, DISCRETE, HOLDING, HOLDING_MULTIPLE, INPUT, Register, Table
from multidrop.drive.request import readable_addresses, stated_gaps
from multidrop.planning.blocks import Planned, planned, sending
from multidrop.planning.bus_time import gap, in_order, kind, silence, switches
from multidrop.planning.schedule import TURN_SHARE, Job, Schedule

LATENESS = 100e-6  # seconds that a typical computer adds to each exchange, to wake up and to write
ENOUGH = 0.97  # fraction of a wanted rate from which the rate counts as reached
LEAST_EXCHANGES = 1000  # least number of simulated exchanges
LEAST_ROUNDS = 3  # least number of simulated exchanges per job
FAR_NS = 1 << 62


@dataclass(frozen=True)
class Rate:
    """Registers of a drive that are polled every `every` s. None means as fast as the line allows."""

    drive: Drive
    every: float | None
    registers: tuple[Register[Any], ...]
    requests: int
    reached: float  # predicted reads per second

    @property
    def fits(self) -> bool:
        return self.every is None or self.reached * self.every >= ENOUGH


@dataclass(frozen=True)
class Prediction:
    """The predicted bus cycle, utilisation and rates of one line."""

    cycle: float  # duration in s of a bus cycle, in which each request of the line is sent once
    switches: int  # number of changes of baud rate or format in a bus cycle
    utilisation: float  # fraction of the line's time that the rates need; above 1, they cannot all be reached
    rates: tuple[Rate, ...]

    @property
    def fits(self) -> bool:
        return all(rate.fits for rate in self.rates)

    def requests(self, drive: Drive) -> int:
        """Return the number of requests to this drive in a bus cycle."""
        return sum(rate.requests for rate in self.rates if rate.drive is drive)

    def exchanges_per_second(self, drive: Drive) -> float:
        return sum(rate.requests * rate.reached for rate in self.rates if rate.drive is drive)


class _Done(NamedTuple):
    """The simulated exchanges of one job."""

    exchanges: int = 0
    skipped: int = 0
    first_ns: int = 0
    last_ns: int = 0
    taken: float = 0.0  # seconds of bus time, including the silence before each exchange


NOT_RUN = _Done()


@dataclass(eq=False)
class _PredictedJob:
    """A job, and the results of its simulated exchanges."""

    planned: Planned
    own: float  # seconds from the start of the request to the end of the reply, without silence
    done: _Done = NOT_RUN

    @property
    def cost(self) -> float:
        """The mean bus time of an exchange, in s."""
        done = self.done
        return done.taken / done.exchanges if done.exchanges else self.own + silence(self.planned.drive)

    @property
    def reached(self) -> float:
        """The simulated number of exchanges per second."""
        done = self.done
        if done.skipped == 0 and self.planned.every:
            return 1 / self.planned.every
        return (done.exchanges - 1) * 1e9 / (done.last_ns - done.first_ns) if done.exchanges > 1 else 0.0


def predict(
    exchanges: Sequence[Planned],
    delays: Mapping[Drive, float] | None = None,
    switching: float = 0.0,
    lateness: float = LATENESS,
) -> Prediction:
    """Return the bus cycle, utilisation and rates of a line with these exchanges.

    `delays` are measured response delays in s; other drives have their documented delay. `switching` is the
    measured time in s that the port takes to change baud rate or format. `lateness` is the time in s that the
    host adds to each exchange; 0 predicts the line alone.
    """
    jobs = _jobs(exchanges, delays or {}, switching, lateness)
    _run(jobs, switching)
    turn = [job for job in jobs if job.planned.every is None]
    load = sum(job.cost / job.planned.every for job in jobs if job.planned.every)
    turns = max(TURN_SHARE, 1 - load) / sum(job.cost for job in turn) if turn else 0.0
    # the line may be idle during a drive's least interval between requests
    has_intervals = any(job.planned.drive.least_interval for job in jobs)
    if has_intervals:
        load += sum(job.cost * job.reached for job in turn)
    groups: dict[tuple[Drive, float | None], list[_PredictedJob]] = {}
    cycle, switched, before = 0.0, 0, jobs[-1].planned.drive
    for job in jobs:
        drive = job.planned.drive
        cycle += job.own + gap(before, drive, switching)
        switched += switches(before, drive)
        before = drive
        groups.setdefault((drive, job.planned.every), []).append(job)
    if has_intervals:
        cycle = max(cycle, *_drive_cycles(jobs).values())
    rates = [
        Rate(
            drive,
            every,
            registers=tuple(register for job in group for register in job.planned.block.registers),
            requests=len(group),
            reached=turns if every is None and not has_intervals else min(job.reached for job in group),
        )
        for (drive, every), group in groups.items()
    ]
    utilisation = load if has_intervals or not turn else max(load, 1.0)
    return Prediction(cycle, switched, utilisation, tuple(rates))


def _drive_cycles(jobs: Iterable[_PredictedJob]) -> dict[Drive, float]:
    """Return the time in s to carry out each job of a drive once, with its least intervals, by drive."""
    found: dict[Drive, float] = {}
    for job in jobs:
        drive = job.planned.drive
        found[drive] = found.get(drive, 0.0) + max(silence(drive), drive.least_interval) + job.own
    return found


def _jobs(
    exchanges: Iterable[Planned], delays: Mapping[Drive, float], switching: float, lateness: float
) -> list[_PredictedJob]:
    of_drive: dict[Drive, list[Planned]] = {}
    for exchange in exchanges:
        of_drive.setdefault(exchange.drive, []).append(exchange)
    return [
        _PredictedJob(
            planned, lateness + sending(drive, planned.block) + delays.get(drive, drive.response_delay)
        )
        for drive in in_order(of_drive, switching)
        for planned in of_drive[drive]
    ]


class _Slots(NamedTuple):
    """The properties of a job that determine its schedule. They are a cache key."""

    drive: int
    kind: int
    silence_ns: int
    interval_ns: int
    period_ns: int | None
    duration_ns: int


def _run(jobs: Sequence[_PredictedJob], switching: float) -> None:
    """Simulate the jobs' exchanges on a clock, and store the results in the jobs."""
    # one drive stands for all drives of its kind, because the pause between two drives depends only on kinds
    ends = {kind(job.planned.drive): job.planned.drive for job in jobs}
    numbers = {kind: number for number, kind in enumerate(ends)}
    gaps = tuple(tuple(gap(before, after, switching) for after in ends.values()) for before in ends.values())
    slots = tuple(
        _Slots(
            drive.address,
            numbers[kind(drive)],
            silence_ns=round(silence(drive) * 1e9),
            interval_ns=round(drive.least_interval * 1e9),
            period_ns=None if job.planned.every is None else round(job.planned.every * 1e9),
            duration_ns=round((silence(drive) + job.own) * 1e9),
        )
        for job in jobs
        for drive in [job.planned.drive]
    )
    found = _carried_out(slots, tuple(job.own for job in jobs), gaps)
    for job, done in zip(jobs, found, strict=True):
        job.done = done


@lru_cache(64)  # a plant often has several equal lines, and is often predicted more than once
def _carried_out(
    slots: tuple[_Slots, ...], durations: tuple[float, ...], gaps: tuple[tuple[float, ...], ...]
) -> tuple[_Done, ...]:
    """Simulate the exchanges of jobs in the schedule's order; return the results of each job.

    `durations` are the times in s of the jobs, without silence. `gaps[a][b]` is the pause in s from a drive
    of kind a to a following drive of kind b.
    """
    schedule: Schedule[Job] = Schedule()
    jobs = [Job(**one._asdict()) for one in slots]
    for job in jobs:
        schedule.add(job, 0)
    of_job = {job: number for number, job in enumerate(jobs)}
    done = [NOT_RUN] * len(jobs)
    at, before = 0, slots[-1].kind
    ready_ns: dict[int, int] = {}
    timed = any(job.period_ns is not None or job.interval_ns for job in jobs)
    for _ in range(max(LEAST_EXCHANGES, LEAST_ROUNDS * len(jobs)) if timed else len(jobs)):
        ((job, not_before_ns, _),) = schedule.take(at, at, FAR_NS, 1)
        number = of_job[job]
        own, known = durations[number], done[number]
        silent = gaps[before][slots[number].kind]
        begin_ns = max(at + round(silent * 1e9), not_before_ns, ready_ns.get(job.drive, 0))
        first_ns = known.first_ns if known.exchanges else begin_ns
        done[number] = _Done(known.exchanges + 1, 0, first_ns, begin_ns, known.taken + (silent + own))
        at, before = begin_ns + round(own * 1e9), slots[number].kind
        ready_ns[job.drive] = at + job.interval_ns
    return tuple(one._replace(skipped=job.skipped) for one, job in zip(done, jobs, strict=True))


# ---- the prediction in a recording's metadata ----


def prediction_metadata(exchanges: Sequence[Planned], switching: float = 0.0) -> dict[str, Any]:
    """Return the prediction for a line and its drives' blocks as plain numbers, for a recording.

    A reader of the recording can compare the prediction with the measurement. The character counts are those
    on the wire if the reply is valid.
    """
    prediction = predict(exchanges, switching=switching)
    drives = dict.fromkeys(planned.drive for planned in exchanges)
    return {
        "utilisation": round(prediction.utilisation, 4),
        "cycle_ms": round(prediction.cycle * 1e3, 3),
        "drives": {
            drive.name: {
                "exchanges_per_second": round(prediction.exchanges_per_second(drive), 3),
                "silence_ms": round(silence(drive) * 1e3, 6),
                "character_ms": round(drive.settings.character * 1e3, 6),
                "response_delay_ms": drive.response_delay * 1e3,
                "blocks": [_block_metadata(planned) for planned in exchanges if planned.drive is drive],
            }
            for drive in drives
        },
    }


def _block_metadata(planned: Planned) -> dict[str, Any]:
    framing, request = planned.drive.framing, planned.block.request
    return {
        "registers": [register.name for register in planned.block.registers],
        "every_ms": None if planned.every is None else planned.every * 1e3,
        "request_characters": characters_on_wire(framing, len(build_request(framing, request))),
        "reply_characters": characters_on_wire(framing, reply_length(framing, request)),
    }


# ---- suggestions ----


WORTH_SAYING = 0.02  # least fraction of the reading time that a suggestion must save
_NAMES = {HOLDING: "HOLDING", HOLDING_MULTIPLE: "HOLDING", INPUT: "INPUT", COIL: "COIL", DISCRETE: "DISCRETE"}

SLOWER = 1.05  # factor between one period that is tried and the next


@dataclass(frozen=True)
class Suggestions:
    """Three changes to a line. Each change alone lets the line reach its rates.

    `baudrate` and `registers` are None if no value is enough.
    """

    every: tuple[tuple[float, float], ...]  # pairs of a wanted period and a period that can be reached, in s
    # lowest baud rate that is enough, and the drives that now have a lower one
    baudrate: tuple[int, tuple[Drive, ...]] | None
    # number of registers that the line can read per drive, for drives whose rates it does not reach now
    registers: int | None

    def __str__(self) -> str:
        pairs = (f'every = "{duration_text(new)}" instead of {duration_text(old)}' for old, new in self.every)
        found = [" and ".join(pairs)]
        if self.baudrate:
            found.append(
                f"baudrate = {self.baudrate[0]} for {', '.join(drive.name for drive in self.baudrate[1])}"
            )
        if self.registers:
            found.append(f"at most {self.registers} of these registers for each drive")
        return f"it would fit with {', or '.join(found)}"


def duration_text(seconds: float) -> str:
    """Return a duration in the notation of plant files, such as "50 ms"."""
    return f"{seconds:g} s" if seconds >= 1 else f"{seconds * 1e3:g} ms"


def suggest(exchanges: Sequence[Planned], prediction: Prediction, switching: float = 0.0) -> Suggestions:
    """Return changes that would make these exchanges reach their rates.

    `prediction` shows which rates they do not reach. `switching` is the time in s that the port takes to
    change baud rate or format.
    """
    tight = [rate for rate in prediction.rates if not rate.fits]
    return Suggestions(
        _every(exchanges, tight, max(1.0, prediction.utilisation), switching),
        _baudrate(exchanges, switching),
        _registers(exchanges, tight, switching),
    )


def _every(
    exchanges: Sequence[Planned], tight: Sequence[Rate], least: float, switching: float
) -> tuple[tuple[float, float], ...]:
    """Return longer periods for the rates `tight`, with which the line reaches all rates.

    Each pair is a wanted period and its longer period, in s. All wanted periods are multiplied by the same
    factor, which is `least` or greater. The search always ends: the other exchanges reach their rates
    already, and longer periods leave them more time.
    """
    hasty = {(rate.drive, rate.every) for rate in tight}
    wanted = sorted({rate.every for rate in tight if rate.every})
    for attempt in count():
        longer = {every: _rounded_up(least * every * SLOWER**attempt) for every in wanted}
        changed = [
            replace(planned, every=longer[planned.every])
            if planned.every and (planned.drive, planned.every) in hasty
            else planned
            for planned in exchanges
        ]
        if predict(changed, switching=switching).fits:
            break
    return tuple(longer.items())


def _rounded_up(seconds: float) -> float:
    """Round a duration up to two significant digits."""
    digit = 10.0 ** (math.floor(math.log10(seconds)) - 1)
    return round(math.ceil(seconds / digit - 1e-9) * digit, 9)


def _baudrate(exchanges: Sequence[Planned], switching: float) -> tuple[int, tuple[Drive, ...]] | None:
    """Return the lowest baud rate with which the line can poll at all rates, and the drives to change."""
    wanted: dict[Drive, list[tuple[Register[Any], float | None]]] = {}
    for each in exchanges:
        wanted.setdefault(each.drive, []).extend((register, each.every) for register in each.block.registers)
    for baudrate in sorted({baudrate for drive in wanted for baudrate in drive.baudrates}):
        slow = [d for d in wanted if d.settings.baudrate < baudrate and baudrate in d.baudrates]
        fast = {drive: _at(drive, baudrate) for drive in slow}
        changed = [
            each for drive, registers in wanted.items() for each in planned(fast.get(drive, drive), registers)
        ]
        if slow and predict(changed, switching=switching).fits:
            return baudrate, tuple(slow)
    return None


def _at(drive: Drive, baudrate: int) -> Drive:
    return type(drive)(
        drive.address,
        name=drive.name,
        framing=drive.framing,
        baudrate=baudrate,
        format=drive.settings.format,
        silence=drive.agreed_silence,
    )


def _registers(exchanges: Sequence[Planned], tight: Sequence[Rate], switching: float) -> int | None:
    """Return how many registers per drive the line can read at the wanted rates; None if not even one."""
    crowded = {(rate.drive, rate.every) for rate in tight}
    others = [each for each in exchanges if (each.drive, each.every) not in crowded]

    def is_too_many(count: int) -> bool:
        fewer = [
            each
            for rate in tight
            for each in planned(rate.drive, [(register, rate.every) for register in rate.registers[:count]])
        ]
        return not predict([*others, *fewer], switching=switching).fits

    most = max(len(rate.registers) for rate in tight)
    return bisect_left(range(1, most), True, key=is_too_many) or None


@dataclass(frozen=True)
class ReadingGain:
    """The bus time of a drive's reads now, and the time if its class declared readable gaps.

    A readable gap is a range of undeclared addresses that a request may include.
    """

    drive: Drive
    gaps: tuple[tuple[Table, range], ...]
    requests: int
    seconds: float
    requests_now: int
    seconds_now: float

    def __str__(self) -> str:
        requests = "request" if self.requests == 1 else "requests"
        return (
            f"{self.requests} {requests} with {self._declaration()} instead of {self.requests_now}: "
            f"{self.seconds:.3f} s instead of {self.seconds_now:.3f} s; "
            f"declare these gaps if the manual allows reads there"
        )

    def _declaration(self) -> str:
        """Return the text that declares these readable gaps in a family file or a class."""
        named = [(_NAMES.get(table, table.name), gap) for table, gap in self.gaps]
        if self.drive.declared_in:
            in_file = (f"{name.lower()} = [0x{gap[0]:X}, 0x{gap[-1]:X}]" for name, gap in named)
            return f"gaps = {{ {', '.join(in_file)} }}"
        in_class = (f"{name}: range(0x{gap.start:X}, 0x{gap.stop:X})" for name, gap in named)
        return f"readable_gaps = {{{', '.join(in_class)}}}"


def reading_gain(drive: Drive, wanted: Iterable[tuple[Register[Any], float | None]]) -> ReadingGain | None:
    """Return the gain if requests could also read the undeclared addresses between registers.

    Return None if the class already allows this (`readable_gaps`), or if the gain is too small.
    """
    wanted = list(wanted)
    before = planned(drive, wanted)
    unstated = {
        register.table.read_space: register.table
        for register, _ in wanted
        if not stated_gaps(drive, register.table)
    }
    freer = copy.copy(drive)
    everywhere = dict.fromkeys(unstated.values(), range(0x10000))
    freer.readable_gaps = {**drive.readable_gaps, **everywhere}  # type: ignore[misc]
    after = planned(freer, wanted)
    gaps = [(table, crossed) for table in everywhere if (crossed := _crossed(drive, table, after))]
    seconds, now = _seconds(after), _seconds(before)
    if not gaps or seconds > (1 - WORTH_SAYING) * now:
        return None
    return ReadingGain(drive, tuple(gaps), len(after), seconds, len(before), now)


def _crossed(drive: Drive, table: Table, found: Sequence[Planned]) -> range:
    """Return the range from the first to the last undeclared address in these requests to `table`."""
    family: Any = type(drive)
    readable = readable_addresses(family, table)
    blocks = [one.block for one in found if one.block.table.read_space == table.read_space]
    new = [at for one in blocks for at in range(one.start, one.start + one.count) if at not in readable]
    return range(min(new), max(new) + 1) if new else range(0)


def _seconds(found: Sequence[Planned]) -> float:
    return sum(silence(one.drive) + sending(one.drive, one.block) + one.drive.response_delay for one in found)
