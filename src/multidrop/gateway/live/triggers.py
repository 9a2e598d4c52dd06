"""The gateway's part `trigger`: conditions over polled values, and when each last became true."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

from multidrop import Batch, Plant
from multidrop.channels import ChannelSet, DriveSeries
from multidrop.core import boottime_ns, now_ns
from multidrop.gateway.parts import PartContext
from multidrop.gateway.settings import parsing_mistakes, refuse
from multidrop.plant import FAULT, POST_S, PRE_S, TriggerSeries, series_of, with_triggers
from multidrop.polling import slot_rows
from multidrop.printable import iso_time
from multidrop.supervisor import supervisor
from multidrop.toml_check import DURATION, parse_duration

ADOPT_S = 30.0  # time limit, in s, for preparing the conditions after a reload of the plant file
LONGEST_NAME = 60  # limit of a trigger's name, in characters
EXAMPLE = 'conditions = { trip = "pump-1.output_current > 30" }'
TEXTS = {"additionalProperties": {"type": "string", "minLength": 1}, "minProperties": 1}

_log = logging.getLogger("multidrop.gateway")


@dataclass(frozen=True)
class TriggerSettings:
    """The settings in the table `[serve.trigger]`. Raises ValueError with a line for each mistake."""

    conditions: Mapping[str, str] = field(default_factory=dict, metadata=TEXTS)
    pre: str = field(default=f"{PRE_S:g} s", metadata=DURATION)
    post: str = field(default=f"{POST_S:g} s", metadata=DURATION)

    def __post_init__(self) -> None:
        mistakes = [] if self.conditions else [f"conditions is missing; add {EXAMPLE}"]
        mistakes += parsing_mistakes(self, pre=parse_duration, post=parse_duration)
        for name, condition in self.conditions.items():
            if not 0 < len(name) <= LONGEST_NAME or not name.isprintable():
                mistakes.append(
                    f"a trigger's name has 1 to {LONGEST_NAME} printable characters, not {name!r}"
                )
            if not isinstance(condition, str) or not condition:
                mistakes.append(f"{name} = {condition!r} is not a condition; write {EXAMPLE}")
        refuse(mistakes)

    def check(self, plant: Plant) -> list[str]:
        """Return an error sentence for each condition that does not fit the plant."""
        try:
            if plant.lines:
                with_triggers(plant, self.conditions.values())
        except ValueError as mistake:
            return str(mistake).splitlines()
        return []


def build(settings: TriggerSettings, context: PartContext) -> Triggers:
    """Return the triggers of a gateway. Call it in a thread: a large plant takes seconds."""
    return Triggers(settings, context.plant)


class Trigger(NamedTuple):
    """When a condition became true (UTC in ns), and the registers in the condition."""

    name: str
    condition: str
    time_ns: int
    signals: Sequence[TriggerSeries]


class Triggers:
    """Watches the plant file's conditions; `last` has the last trigger by name.

    Raises ValueError for a wrong condition.
    """

    def __init__(self, settings: TriggerSettings, plant: Plant) -> None:
        self._settings = settings
        self._plant = plant
        self._is_new = asyncio.Event()  # set when `adopt` was called with another plant
        self._conditions: _Conditions | None = _Conditions(plant, settings.conditions)
        self._around_ns = tuple(round(parse_duration(one) * 1e9) for one in (settings.pre, settings.post))
        self.last: dict[str, Trigger] = {}

    def take(self, batch: Batch) -> None:
        """Evaluate the conditions over the rows of their registers, within microseconds for each row."""
        for trigger in self._conditions.triggers(batch) if self._conditions else ():
            self.last[trigger.name] = trigger
            _log.info("trigger %s: %s", trigger.name, trigger.condition)

    def adopt(self, plant: Plant) -> None:
        """Use another plant. Conditions are not evaluated until `run` has prepared them for this plant."""
        self._plant, self._conditions = plant, None
        self._is_new.set()

    async def run(self) -> None:
        """Prepare the conditions after each call of `adopt`.

        Raises ValueError if a condition does not fit the plant.
        """
        while True:
            await self._is_new.wait()
            self._is_new.clear()
            plant = self._plant
            work = partial(_Conditions, plant, self._settings.conditions)
            found = await supervisor().within("triggers", ADOPT_S, work)
            if plant is self._plant:
                self._conditions = found

    async def close(self) -> None:
        """Return immediately, because triggers are only in memory."""

    def as_answer(self) -> list[dict[str, Any]]:
        """Return the last trigger of each name as JSON objects, the newest trigger first.

        `from` and `to` are the time range to show in a plot of the trigger.
        """
        pre_ns, post_ns = self._around_ns
        return [
            {
                "name": one.name,
                "condition": one.condition,
                "time": iso_time(one.time_ns // 1_000_000),
                "from": iso_time((one.time_ns - pre_ns) // 1_000_000),
                "to": iso_time((one.time_ns + post_ns) // 1_000_000),
                "signals": [{"drive": drive, "register": register} for drive, register in one.signals],
            }
            for one in sorted(self.last.values(), key=lambda one: -one.time_ns)
        ]


class _Conditions:
    """Conditions over a plant's polled values. Raises ValueError if a condition does not fit the plant."""

    def __init__(self, plant: Plant, conditions: Mapping[str, str]) -> None:
        self._names = [*conditions]
        self._found = found = with_triggers(plant, conditions.values())
        drives = series_of(found.plant)
        holds_s = ChannelSet(drives).holds_s
        self._channels = ChannelSet([_with_triggers_only(drive, found.texts, holds_s) for drive in drives])
        needed = {
            series
            for text, signals in found.signals.items()
            for series in signals
            # The signals of a fault's condition are all polled registers of the drive, but only the fault
            # register is needed to evaluate it.
            if text in conditions.values() or series[1] == FAULT
        }
        self._inputs = {series: slot for series, slot in self._channels.inputs.items() if series in needed}
        self._by_slot = {slot: name for name, slot in self._channels.slots.items()}
        # Number of a register among the inputs of `_channels`. The key is the register's drive code and
        # register code in a batch.
        self._slots: dict[tuple[int, int], int] = {}
        self._sizes = (0, 0)  # how many drive names and register names the newest batch has
        self._was: dict[int, bool] = {}  # whether each condition, by its index, was true before

    def triggers(self, batch: Batch) -> Iterator[Trigger]:
        """Yield a trigger for each condition that changes from false to true within this batch."""
        columns = batch.columns()
        if self._sizes != (sizes := (len(columns.drives), len(columns.registers))):
            self._sizes = sizes
            drives = {name: code for code, name in enumerate(columns.drives)}
            registers = {name: code for code, name in enumerate(columns.registers)}
            self._slots = {
                (drives[drive], registers[register]): slot
                for (drive, register), slot in self._inputs.items()
                if drive in drives and register in registers
            }
        # In a batch, computed channels follow the polled registers. The conditions need all rows in the order
        # of time.
        rows = sorted(
            slot_rows(columns, self._slots), key=lambda row: (row.monotonic_ns, self._by_slot[row.slot][0])
        )
        for row in self._channels.compute(rows, boottime_ns() - now_ns()):
            if row.status != 0:
                continue
            was, self._was[row.slot] = self._was.get(row.slot), bool(row.value)
            if row.value and was is False:
                series = self._by_slot[row.slot]
                text = self._found.texts[series]
                name = self._names[self._found.numbers[series]]
                yield Trigger(name, text, row.time_ns, self._found.signals[text])
        self._channels.outages.clear()


def _with_triggers_only(
    drive: DriveSeries, triggers: Container[TriggerSeries], holds_s: Mapping[TriggerSeries, float]
) -> DriveSeries:
    """Return a drive's series in which only the triggers are computed; its other channels are inputs.

    The poller has computed the values of the inputs already. For a total, such as kWh, this matters: the
    poller's total continues after a restart, but a total computed here would start at 0.
    """
    own = [channel for channel in drive.channels if (drive.name, channel.name) not in triggers]
    inputs = {channel.name: (channel.unit, holds_s[drive.name, channel.name]) for channel in own}
    computed = [channel for channel in drive.channels if (drive.name, channel.name) in triggers]
    return DriveSeries(drive.name, {**drive.polled, **inputs}, drive.known, computed)
