"""Adoption: change the lines of a poller to those of another plant, while the lines are polled.

All mistakes are found before anything changes. Then lines and drives are removed, kept lines are changed, and
new ports are opened. Lines without changes are not touched.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from multidrop.bus import Bus
from multidrop.control.exit_hook import exit_hook
from multidrop.drive.family import Drive
from multidrop.drive.line_settings import speaks_tcp
from multidrop.drive.link import check_own, check_readable
from multidrop.drive.register import Register
from multidrop.errors import LineError
from multidrop.plant.loader import PlantError
from multidrop.plant.model import Plant, PlantLine, PolledDrive
from multidrop.polling.line_set import MOST_LINES, LineSet
from multidrop.polling.polled_line import PolledLine


def check_plant(plant: Plant, *, is_free: Callable[[Drive], bool]) -> None:
    """Raise PlantError with all mistakes of a plant. The plant may come from a program instead of a plant
    file.

    `is_free` returns False for a drive that is on another bus. Each free drive takes the framing of its port.
    """
    found: list[str] = []
    names: dict[tuple[str, object], str] = {}

    def once(place: str, kind: str, value: object, sentence: str) -> None:
        first = names.setdefault((kind, value), place)
        if first is not place:
            found.append(f"{place}: {sentence.format(first=first)}")

    for line in plant.lines:
        where = f'line "{line.name}"'
        once(where, "line", line.name, "another line already has this name; each line needs its own")
        wire = line.port if speaks_tcp(line.port) else where
        if wire is where:
            once(
                where, "port", line.port, f"port {line.port} is already used by {{first}}; make them one line"
            )
        for polled in line.drives:
            drive, at = polled.drive, f'{where}, drive "{polled.drive.name}"'
            once(at, "drive", drive.name, "another drive already has this name; each drive needs its own")
            address = f"address {drive.address} is already used by {{first}}; give each drive its own"
            once(at, "address", (wire, drive.address), address)
            if not is_free(drive):
                found.append(
                    f"{at}: it is on another bus: detach it there first, or create another drive object"
                )
            else:
                framed = copy(drive) if drive.bus and drive.bus.is_open else drive
                found += _mistakes(at, partial(framed.take_framing_of, line.port))
            for poll in polled.polls:
                found += _mistakes(at, partial(_check_polled, drive, poll.register))
    if found:
        # without duplicates: several registers may cause the same mistake
        raise PlantError(tuple(dict.fromkeys(found)))


def _check_polled(drive: Drive, register: Register[Any]) -> None:
    check_own(drive, register)
    check_readable(drive, register)


def _mistakes(place: str, check: Callable[[], object]) -> list[str]:
    try:
        check()
    except ValueError as mistake:
        return [f"{place}: {mistake}"]
    return []


def _description(drive: Drive) -> tuple[object, ...]:
    """Return a key that is equal for two drive objects of the same class with the same options."""
    return (
        type(drive),
        drive.address,
        drive.name,
        drive.framing,
        drive.settings,
        drive.agreed_silence,
        drive.response_delay,
        drive.response_timeout,
        drive.option,
        drive.ram,
    )


GONE = "its line is no longer polled"


class KeptLine:
    """A line that keeps its open port, with its new description and the changes of its drives."""

    def __init__(self, line: PolledLine, wanted: PlantLine) -> None:
        self.line = line
        self.wanted = wanted
        self.joining: list[PolledDrive] = []
        self._repolled: list[PolledDrive] = []  # drives that stay, with other registers or rates
        left = list(line.polled)
        for polled in wanted.drives:
            description = _description(polled.drive)
            same = next((each for each in left if _description(each.drive) == description), None)
            if same is None:
                self.joining.append(polled)
                continue
            left.remove(same)
            if (same.polls, same.channels) != (polled.polls, polled.channels):
                self._repolled.append(PolledDrive(same.drive, polled.polls, channels=polled.channels))
        self.leaving = [polled.drive for polled in left]

    def await_stops(self) -> None:
        """Cancel the calls of the drives that leave the line, and wait for their stops.

        With `stop_on_exit`, the leaving drives are stopped first. A leaving drive is not stopped if a new
        drive gets its address: its stop could be a different command to the new drive. Drives are removed
        only after all stops have ended. Until then, every drive can be stopped again.
        """
        taken = {polled.drive.address for polled in self.joining}
        self.line.bus.part_with(self.leaving, [one for one in self.leaving if one.address not in taken])

    def let_leave(self, names: Collection[str]) -> None:
        """Remove the leaving drives; if a drive's name is in `names`, also wait for its last exchange."""
        for drive in self.leaving:
            self.line.remove(drive)
            self.line.forget(drive)
        for drive in self.leaving:
            if drive.name in names:
                self.line.await_gone(drive.address)

    def is_free(self, leaving: Mapping[str, KeptLine]) -> bool:
        """Return True if no drive on another line still has the name of a drive that this line gets."""
        return all(leaving.get(polled.drive.name, self) is self for polled in self.joining)

    def take_in(self) -> None:
        """Start polling the line's new drives, and change the polled registers and rates of the others.

        Raises LineError if the port does not support a drive's settings.
        """
        self.line.declared, self.line.switching = self.wanted, self.wanted.switching
        for polled in self._repolled:
            self.line.set_polls(polled)
        for polled in self.joining:
            self.line.add(polled)
        if self.joining:
            self.line.put_in_order()


@dataclass(frozen=True)
class NewLine:
    """A line to open; `before` is the poller's present line on the same port, or None."""

    wanted: PlantLine
    before: PolledLine | None


class Adoption:
    """The change of a poller to another plant. Raises ValueError for a mistake in the plant."""

    def __init__(self, lines: LineSet, plant: Plant) -> None:
        self._lines = lines
        self._plant = plant
        buses = {line.bus for line in lines}
        check_plant(plant, is_free=lambda drive: _is_free(drive, buses))
        self._pair()
        self._check()

    def _pair(self) -> None:
        """Match each line of the new plant with a present line of the same name, or else of the same port."""
        named = {line.name: line for line in self._lines}
        found = {
            wanted.name: line
            for wanted in self._plant.lines
            if (line := named.get(wanted.name)) and _can_become(line, wanted)
        }
        taken = set(found.values())
        ported: dict[str, list[PolledLine]] = {}
        for line in self._lines:
            if line not in taken:
                ported.setdefault(line.declared.port, []).append(line)
        new: list[NewLine] = []
        for wanted in self._plant.lines:
            if wanted.name in found:
                continue
            others = ported.get(wanted.port, [])
            same = next((line for line in others if _can_become(line, wanted)), None)
            if same is not None:
                others.remove(same)
                found[wanted.name] = same
            else:
                new.append(NewLine(wanted, others[0] if others and not speaks_tcp(wanted.port) else None))
        self._kept = [
            KeptLine(found[wanted.name], wanted) for wanted in self._plant.lines if wanted.name in found
        ]
        self._new = new
        kept = set(found.values())
        self._removed = [line for line in self._lines if line not in kept]

    def _check(self) -> None:
        if len(self._plant.lines) > MOST_LINES:
            raise ValueError(
                f"{len(self._plant.lines)} lines are too many for one poller: {MOST_LINES} at most"
            )
        self._lines.names.check_room(self._plant.drives)
        for new in self._new:
            self._lines.check_port(new.wanted.port)
        if self._new:
            self._lines.check_audit()
        if self._new and self._lines.stops_on_exit:
            exit_hook().take_signals()

    # ---- carrying out the change ----

    def carry_out(self, *, start: bool) -> dict[str, LineError]:
        """Change the lines; with `start`, poll the new lines. Return the errors of ports, by line name."""
        self._let_go()
        # New ports are opened last, so that a slow port never delays the stop of a drive that is replaced.
        failures = self._change() | self._open(start)
        self._lines.put_in_order([line.name for line in self._plant.lines])
        return failures

    def _let_go(self) -> None:
        wanted = {new.before: new.wanted for new in self._new if new.before}
        for line in self._removed:
            for drive in line.bus.drives:
                if line in wanted and _is_another(drive, wanted[line]):
                    line.remove(drive)
        self._lines.let_go(self._removed, GONE)

    def _change(self) -> dict[str, LineError]:
        """Change the lines that keep their ports, one by one; return the errors of ports, by line name.

        If a drive's name moves from one line to another, the line that it leaves is changed first. Lines that
        wait for each other in a circle are changed together, after their stops have ended.
        """
        failures: dict[str, LineError] = {}
        names = {polled.drive.name for polled in self._plant.drives}
        left: list[KeptLine] = []
        for kept in self._kept:
            if kept.leaving or kept.joining:
                left.append(kept)
            else:
                kept.take_in()
        while left:
            leaving = {drive.name: kept for kept in left for drive in kept.leaving}
            free = next((kept for kept in left if kept.is_free(leaving)), None)
            together = [free] if free else left
            for kept in together:
                kept.await_stops()
            for kept in together:
                kept.let_leave(names)
            for kept in together:
                try:
                    kept.take_in()
                except LineError as failure:
                    failures[kept.wanted.name] = failure
            left = [kept for kept in left if kept not in together]
        return failures

    def _open(self, start: bool) -> dict[str, LineError]:
        """Open the new lines; return the errors of ports, by line name.

        A line whose port cannot be opened is added too. The poller opens the port later, like a lost port.
        """
        failures: dict[str, LineError] = {}
        for place, bus in self._lines.open([new.wanted for new in self._new]):
            new = self._new[place]
            if isinstance(bus, LineError):
                failures[new.wanted.name] = bus
                bus = self._lines.await_port(new.wanted)
            elif isinstance(bus, OSError):
                raise bus
            try:
                self._put(new, bus, start)
            except LineError as failure:
                failures[new.wanted.name] = failure
        return failures

    def _put(self, new: NewLine, bus: Bus, start: bool) -> None:
        """Add a line with this bus; if `start` is set, start to poll it.

        Raises LineError if the port does not support a drive's settings.
        """
        if new.before:
            bus.remember(new.before.bus)
        line = self._lines.add(replace(new.wanted, drives=()), bus)
        try:
            for polled in new.wanted.drives:
                line.add(polled)
        finally:
            if start:
                line.start()


def _is_free(drive: Drive, buses: set[Bus]) -> bool:
    return drive.bus is None or drive.bus in buses or not drive.bus.is_open


def _can_become(line: PolledLine, wanted: PlantLine) -> bool:
    """Return True if the line can become the line `wanted` without reopening its port."""
    facts, others = (
        (each.port, each.echo, each.transaction, each.rs485, each.settle) for each in (line.declared, wanted)
    )
    settings = line.bus.line.only_settings
    wanted_settings = {(at.baudrate, at.format) for at in (polled.drive.settings for polled in wanted.drives)}
    return facts == others and (settings is None or wanted_settings <= {settings})


def _is_another(drive: Drive, wanted: PlantLine) -> bool:
    """Return True if the new plant has a drive of another family at the drive's address."""
    others = [polled.drive for polled in wanted.drives if polled.drive.address == drive.address]
    return any(type(other) is not type(drive) for other in others)
