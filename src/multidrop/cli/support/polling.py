"""A plant that is polled until a signal comes, with its rows handed to a recording and a screen."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import NamedTuple

from multidrop.cli.support.signals import Interruption, noting_signals
from multidrop.plant.model import Plant
from multidrop.poller import Poller
from multidrop.polling.batch import Rows
from multidrop.recording import open_writer
from multidrop.recording.format import Metadata, RecordingWriter
from multidrop.recording.segments import SegmentWriter


class PollingSession(NamedTuple):
    poller: Poller  # not started yet
    interruption: Interruption
    hand_out: Callable[[], None]  # hands the rows that have come to the recording and the consumers


class Rotation(NamedTuple):
    """A recording in segments: how long each is, in s, and how much of them is kept."""

    every: float
    keep: float | None = None  # s
    most: int | None = None  # bytes


def _open(out: Path, metadata: Metadata, rotation: Rotation | None) -> RecordingWriter:
    if rotation is None:
        return open_writer(out, metadata)
    return SegmentWriter(out, metadata, every=rotation.every, keep=rotation.keep, most=rotation.most)


@contextmanager
def polling_session(
    plant: Plant,
    out: Path | None,
    *consumers: Callable[[Rows], None],
    rotation: Rotation | None = None,
) -> Iterator[PollingSession]:
    """Open the plant's ports, and then its recording; close both when the block is left, with all rows."""
    takers = list(consumers)
    with ExitStack() as stack:
        interruption = stack.enter_context(noting_signals())
        poller = stack.enter_context(closing(Poller(plant)))  # first: without ports there is no recording
        if out:
            takers.append(stack.enter_context(_open(out, plant.metadata(), rotation)).write)

        def hand_out() -> None:
            while batch := poller.take():
                for take in takers:
                    take(batch)

        try:
            yield PollingSession(poller, interruption, hand_out)
        finally:
            hand_out()  # what came while the poller closed, also after a failure
