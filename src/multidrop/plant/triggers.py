"""Triggers: conditions such as "pump-1.output_current > 30", which become channels of a plant."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

from multidrop.channels import Channel, ChannelSet
from multidrop.channels.grammar import ExpressionError, ReferenceStep, parse
from multidrop.drive.known_state import FAULT
from multidrop.plant.model import Plant, PolledDrive, series_of

PRE_S, POST_S = 5.0, 10.0  # default seconds recorded before and after a trigger

TriggerSeries = tuple[str, str]  # drive, and name of a register or channel


class TriggerChannels(NamedTuple):
    """A plant with a channel for each condition. A trigger occurs when its channel is no longer 0."""

    plant: Plant
    texts: Mapping[TriggerSeries, str]  # text of the condition, by channel
    numbers: Mapping[TriggerSeries, int]  # index of the condition, by channel
    signals: Mapping[str, Sequence[TriggerSeries]]  # registers to show, by text of the condition


def with_triggers(plant: Plant, conditions: Collection[str]) -> TriggerChannels:
    """Return the plant with a channel for each condition.

    Raises ValueError with a line for each mistake in the conditions.
    """
    texts: dict[TriggerSeries, str] = {}
    numbers: dict[TriggerSeries, int] = {}
    signals: dict[str, Sequence[TriggerSeries]] = {}
    mistakes: dict[str, str] = {}  # error sentences by condition
    names = [polled.drive.name for polled in plant.drives]
    by_fault = _showing_faults(plant) if FAULT in conditions else []
    for number, condition in enumerate(conditions):
        channel = Channel(f"trigger_{number + 1}", condition, is_kept=False)
        # the channel belongs to the last drive, because a channel may only use channels declared before it
        own = {names[-1]: condition}
        if condition == FAULT:
            channel = replace(channel, value=f"{FAULT} != 0")
            own = {drive: f"fault of {drive}" for drive in by_fault}
            signals |= {text: _polled(plant, drive) for drive, text in own.items()}
        elif bare := next((name for drive, name in _references(condition) if not drive and names[1:]), ""):
            mistakes[condition] = f"the name {bare} needs a drive, such as {names[0]}.{bare}"
        else:
            signals[condition] = [(drive or names[0], name) for drive, name in _references(condition)]
        plant = _with_channel(plant, channel, own)
        texts |= {(drive, channel.name): text for drive, text in own.items()}
        numbers |= {(drive, channel.name): number for drive in own}
    for mistake in ChannelSet(series_of(plant)).mistakes:
        series = mistake.drive, mistake.channel
        if series in numbers:
            mistakes.setdefault([*conditions][numbers[series]], mistake.sentence.removeprefix("value: "))
    if mistakes:
        raise ValueError("\n".join(f"{condition}: {sentence}" for condition, sentence in mistakes.items()))
    return TriggerChannels(plant, texts, numbers, signals)


def _references(condition: str) -> list[TriggerSeries]:
    """Return the drives and names of the registers in a condition; the drive is "" if none is given."""
    try:
        return [(step.drive, step.name) for step in parse(condition) if isinstance(step, ReferenceStep)]
    except ExpressionError:  # the check of the channels reports this mistake
        return []


def _polled(plant: Plant, drive: str) -> list[TriggerSeries]:
    own = next(polled for polled in plant.drives if polled.drive.name == drive)
    return [(drive, poll.register.name) for poll in own.polls]


def _showing_faults(plant: Plant) -> list[str]:
    """Return the names of the drives whose register `fault` is polled. Raises ValueError if there is none."""
    found = [
        polled.drive.name for polled in plant.drives if FAULT in [poll.register.name for poll in polled.polls]
    ]
    if not found:
        raise ValueError(
            f"{FAULT}: no drive polls a register {FAULT!r}; give a condition as the trigger instead"
        )
    return found


def _with_channel(plant: Plant, channel: Channel, drives: Collection[str]) -> Plant:

    def extended(polled: PolledDrive) -> PolledDrive:
        more = [channel] if polled.drive.name in drives else []
        return PolledDrive(polled.drive, polled.polls, channels=(*polled.channels, *more))

    lines = [replace(line, drives=tuple(map(extended, line.drives))) for line in plant.lines]
    return replace(plant, lines=tuple(lines))
