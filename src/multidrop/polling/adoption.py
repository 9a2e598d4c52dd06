"""Adoption: change the lines of a poller to those of another plant, while the lines are polled.

All mistakes are found before anything changes. Then lines are removed, each changed line closes its port and
opens it again, and new lines are opened. Lines without changes are not touched.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import replace
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
    """Raise PlantError with all mistakes of a plant, which may come from a plant file or from a program.

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
        drive.own_settings,  # they decide which settings the drive has on another line
        drive.agreed_silence,
        drive.response_delay,
        drive.response_timeout,
        drive.option,
        drive.ram,
    )


GONE = "its line is no longer polled"


class ChangedLine:
    """A present line and its new description. Its bus stays, and so do its drives without changes."""

    def __init__(self, line: PolledLine, wanted: PlantLine) -> None:
        self.line = line
        there = {drive.address: drive for drive in line.bus.drives}

        def known(drive: Drive) -> Drive:
            same = there.get(drive.address, drive)
            return same if _description(same) == _description(drive) else drive

        drives = [PolledDrive(known(one.drive), one.polls, channels=one.channels) for one in wanted.drives]
        self.wanted = replace(wanted, drives=drives)
        staying, polled = ({one.drive for one in some} for some in (drives, line.polled))
        taken = {drive.address for drive in staying - {*line.bus.drives}}
        # a program's own drives on the bus stay there, unless their address is taken
        leaving = [drive for drive in there.values() if drive in polled or drive.address in taken]
        self.leaving = [drive for drive in leaving if drive not in staying]
        self._to_stop = [drive for drive in self.leaving if drive.address not in taken]

    def await_stops(self) -> None:
        """Cancel the calls of the drives that leave the line, and wait for their stops.

        With `stop_on_exit`, the leaving drives are stopped first. A leaving drive is not stopped if a new
        drive gets its address: its stop could be a different command to the new drive. Drives are removed
        only after all stops have ended. Until then, every drive can be stopped again.
        """
        self.line.bus.part_with(self.leaving, self._to_stop)

    def let_leave(self) -> None:
        for drive in self.leaving:
            self.line.remove(drive)


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
        taken, ported = {*found.values()}, dict[str, list[PolledLine]]()
        for line in self._lines:
            if line not in taken:
                ported.setdefault(line.declared.port, []).append(line)
        for wanted in self._plant.lines:
            others = [] if wanted.name in found else ported.get(wanted.port, [])
            if same := next((line for line in others if _can_become(line, wanted)), None):
                others.remove(same)
                found[wanted.name] = same
        self._new = [wanted for wanted in self._plant.lines if wanted.name not in found]
        kept = {*found.values()}
        self._removed = [line for line in self._lines if line not in kept]
        pairs = [(found[wanted.name], wanted) for wanted in self._plant.lines if wanted.name in found]
        self._changed = [ChangedLine(*pair) for pair in pairs if not _is_equal(*pair)]

    def _check(self) -> None:
        if len(self._plant.lines) > MOST_LINES:
            raise ValueError(
                f"{len(self._plant.lines)} lines are too many for one poller: {MOST_LINES} at most"
            )
        self._lines.names.check_room(self._plant.drives)
        for new in self._new:
            self._lines.check_port(new.port)
        if self._new:
            self._lines.check_audit()
        if self._new and self._lines.stops_on_exit:
            exit_hook().take_signals()

    # ---- carrying out the change ----

    def carry_out(self, *, start: bool) -> dict[str, LineError]:
        """Change the lines; with `start`, poll the new lines. Return the errors of ports, by line name."""
        self._let_go()
        # New ports are opened last, so that a slow port never delays the stop of a drive that is replaced.
        failures = self._change(start) | self._open(start)
        self._lines.put_in_order([line.name for line in self._plant.lines])
        return failures

    def _let_go(self) -> None:
        """Remove lines. With `stop_on_exit`, their drives are stopped, unless another family takes over."""
        wanted = {new.port: new for new in self._new if not speaks_tcp(new.port)}
        for line in self._removed:
            for drive in line.bus.drives:
                if (new := wanted.get(line.declared.port)) and _is_another(drive, new):
                    line.remove(drive)
        self._lines.let_go(self._removed, GONE)

    def _change(self, start: bool) -> dict[str, LineError]:
        """Close the ports of the changed lines and open them again; return the errors of ports, by line name.

        All leaving drives are removed first, because a drive's name may move from one line to another.
        """
        for changed in self._changed:
            changed.await_stops()
        for changed in self._changed:
            changed.let_leave()
        self._lines.pause([changed.line for changed in self._changed])
        lines = [self._lines.replace(changed.line, changed.wanted) for changed in self._changed]
        for line in lines:
            line.reopen()
            if start:
                line.start()
        return {line.name: failure for line in lines if (failure := line.await_reopening())}

    def _open(self, start: bool) -> dict[str, LineError]:
        """Open the new lines; return the errors of ports, by line name.

        A line whose port cannot be opened is added too. The poller opens the port later, like a lost port.
        """
        failures: dict[str, LineError] = {}
        for place, bus in self._lines.open(self._new):
            new = self._new[place]
            if isinstance(bus, LineError):
                failures[new.name] = bus
                bus = self._lines.await_port(new)
            elif isinstance(bus, OSError):
                raise bus
            line = self._lines.add(replace(new, drives=()), bus)
            try:
                for polled in new.drives:
                    line.add(polled)
            except LineError as failure:  # the port does not support a drive's settings
                failures[new.name] = failure
            if start:
                line.start()
        return failures


def _is_free(drive: Drive, buses: set[Bus]) -> bool:
    return drive.bus is None or drive.bus in buses or not drive.bus.is_open


def _is_equal(line: PolledLine, wanted: PlantLine) -> bool:
    """Return True if the new plant changes nothing on this line."""
    drives, others = (
        [(_description(each.drive), each.polls, each.channels) for each in some]
        for some in (line.polled, wanted.drives)
    )
    return drives == others and replace(line.declared, drives=()) == replace(wanted, drives=())


def _can_become(line: PolledLine, wanted: PlantLine) -> bool:
    """Return True if the line can become the line `wanted` with the same port and port options."""
    facts, others = (
        (each.port, each.echo, each.transaction, each.rs485, each.settle) for each in (line.declared, wanted)
    )
    settings = line.bus.line.only_settings
    wanted_settings = {
        polled.drive.settings_on(wanted.baudrate, wanted.format, None)[:2] for polled in wanted.drives
    }
    return facts == others and (settings is None or wanted_settings <= {settings})


def _is_another(drive: Drive, wanted: PlantLine) -> bool:
    """Return True if the new plant has a drive of another family at the drive's address."""
    others = [polled.drive for polled in wanted.drives if polled.drive.address == drive.address]
    return any(type(other) is not type(drive) for other in others)
