"""LineSet: the lines of a poller. Lines may be added and removed while the poller polls."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from queue import SimpleQueue

from multidrop.bus import Bus
from multidrop.control.eeprom_ledger import Ledger
from multidrop.control.records import AuditLog
from multidrop.core import Mastership, RowQueue
from multidrop.drive.family import Drive
from multidrop.plant.model import PlantLine
from multidrop.polling.jobs import RowNames
from multidrop.polling.polled_line import PolledLine
from multidrop.printable import did_you_mean
from multidrop.transport import clock
from multidrop.transport.open_port import check_port

OPENING = 32  # limit of ports that are opened concurrently
ENDING_NS = 1_000_000_000  # how long the end of polling waits for in-flight exchanges
NO_LINE = 0  # a number that no line has
MOST_LINES = (1 << 16) - 1  # limit of lines, because the core numbers them from 1 to this


class LineSet:
    """A poller's lines, each with its number for the core. Only one thread at a time may change the set."""

    def __init__(
        self,
        row_queue: RowQueue,
        ledger: Ledger | Path | str | None,
        audit: Path | str | None,
        mastership: Mastership | None,
    ) -> None:
        self.names = RowNames()
        self._row_queue = row_queue
        self._ledger = ledger
        self._audit = audit
        self._mastership = mastership
        self.stops_on_exit = False  # True if `stop_on_exit` applies, also to lines added later
        self._lines: tuple[PolledLine, ...] = ()  # replaced, never mutated: readers iterate without a lock
        self._numbered: dict[int, PolledLine] = {}
        self._free: list[int] = []  # line numbers for reuse, from removed lines

    def __iter__(self) -> Iterator[PolledLine]:
        return iter(self._lines)

    def __len__(self) -> int:
        return len(self._lines)

    def called(self, numbers: Iterable[int]) -> list[PolledLine]:
        """Return the lines with these numbers; ignore numbers of removed lines."""
        return [line for number in numbers if (line := self._numbered.get(number))]

    def find(self, name: str) -> PolledLine:
        for line in self._lines:
            if line.name == name:
                return line
        names = ", ".join(line.name for line in self._lines)
        raise ValueError(f"there is no line {name!r}; there are {names or 'none'}")

    def find_drive(self, drive: Drive | str) -> tuple[PolledLine, Drive]:
        """Return the line and the drive object of a drive that is given as an object or by name.

        Raises ValueError if the drive is not polled.
        """
        drives = {each.drive.name: (line, each.drive) for line in self._lines for each in line.polled}
        name = drive if isinstance(drive, str) else drive.name
        line, known = drives.get(name, (None, None))
        if line is None or known is None or drive not in (name, known):
            raise ValueError(f"this poller has no drive {name}; {did_you_mean(name, drives)}")
        return line, known

    # ---- opening and adding lines ----

    def fill(self, declared: Sequence[PlantLine]) -> None:
        """Open and add all these lines. If one cannot be opened, add none.

        Raises LineError if a port cannot be opened, ValueError for a drive that cannot be on its line. After
        any exception, no port is left open.
        """
        buses: dict[int, Bus] = {}
        failures: dict[int, OSError] = {}
        with ExitStack() as stack:
            for place, bus in self.open(declared):
                if isinstance(bus, OSError):
                    failures[place] = bus
                else:
                    buses[place] = bus
                    stack.callback(bus.close)  # closes the bus unless `pop_all` is reached
            if failures:
                raise failures[min(failures)]
            for place, line in enumerate(declared):
                self.add(line, buses[place])
            stack.pop_all()

    def open(self, declared: Sequence[PlantLine]) -> Iterator[tuple[int, Bus | OSError]]:
        """Open these lines' ports concurrently.

        Yields each line's index as soon as its port is open or has failed, with the line's bus or the
        failure. If the caller stops early, the buses that were not yielded are closed.
        """
        if len(declared) < 2:
            yield from enumerate(map(self._opened, declared))
            return
        left = deque(enumerate(declared))
        done: SimpleQueue[tuple[int, Future[Bus | OSError]]] = SimpleQueue()

        def work() -> None:
            with suppress(IndexError):  # raised when no line is left to open
                while True:
                    place, line = left.popleft()
                    done.put((place, _settled(partial(self._opened, line))))

        pool = ThreadPoolExecutor(OPENING, "multidrop opening")
        try:
            try:
                for _ in range(min(OPENING, len(declared))):
                    pool.submit(work)
            except RuntimeError:  # the system's thread limit is reached
                work()
            for _ in declared:
                place, opened = done.get()
                yield place, opened.result()
        finally:
            left.clear()
            pool.shutdown()
            while not done.empty():
                _, opened = done.get()
                if not opened.exception() and isinstance(bus := opened.result(), Bus):
                    bus.close()

    def _opened(self, line: PlantLine) -> Bus | OSError:
        try:
            # a line with a mastership is opened only while this process is the master
            if self._mastership and not self._mastership.holds:
                return self.await_port(line)
            return self._bus(Bus, line)
        except OSError as failure:  # an error of the port (LineError) or of the audit log
            return failure

    def await_port(self, line: PlantLine) -> Bus:
        """Return a bus whose port is not open yet."""
        return self._bus(Bus.awaiting, line)

    def _bus(self, make: Callable[..., Bus], line: PlantLine) -> Bus:
        return make(
            line.port,
            echo=line.echo,
            transaction=line.transaction,
            rs485=line.rs485,
            settle=line.settle,
            ledger=self._ledger,
            audit=self._audit,
            mastership=self._mastership,
        )

    def add(self, declared: PlantLine, bus: Bus) -> PolledLine:
        """Add a line without polling it yet. Raises ValueError for a drive that cannot be on the line."""
        number = self._free[-1] if self._free else len(self._lines) + 1
        line = PolledLine(declared, number, bus, self._row_queue, self.names)
        if self._free:
            self._free.pop()
        self._numbered[number] = line
        self._lines = (*self._lines, line)
        # Read after adding the line: another thread first sets this flag, then applies it to all added lines.
        if self.stops_on_exit:
            bus.stop_on_exit()
        return line

    def replace(self, before: PolledLine, wanted: PlantLine) -> PolledLine:
        """Put another line in the place of a paused one; its bus and its statistics continue."""
        bus, number, since_ns = before.bus, before.number, before.started_ns
        line = PolledLine(wanted, number, bus, self._row_queue, self.names, since_ns)
        self._numbered[number] = line
        self._lines = tuple(line if each is before else each for each in self._lines)
        return line

    def put_in_order(self, names: Sequence[str]) -> None:
        """Sort the lines into the order of `names`."""
        places = {name: place for place, name in enumerate(names)}
        self._lines = tuple(sorted(self._lines, key=lambda line: places[line.name]))

    def check_port(self, port: str) -> None:
        check_port(port, self._mastership)

    def check_audit(self) -> None:
        if self._audit:
            AuditLog(self._audit).close()

    # ---- closing and removing lines ----

    def end_polling(self) -> None:
        """Stop polling on all lines; commands are still carried out."""
        for line in self._lines:
            line.bus.line.end()

    def let_go(self, lines: Iterable[PolledLine], why: str) -> None:
        """Stop polling these lines, and remove them from the set."""
        going = set(lines)
        self.end(going, why)
        self._lines = tuple(line for line in self._lines if line not in going)
        for line in going:
            del self._numbered[line.number]
            self._free.append(line.number)

    def end(self, lines: Iterable[PolledLine], why: str) -> None:
        """End the exchanges of the lines and close their ports; waiting calls fail with the text `why`."""
        going = list(lines)
        with ExitStack() as stack:
            for line in reversed(going):
                stack.callback(line.close, why)  # called even if closing another line fails
            self.wind_down(going)

    def wind_down(self, lines: Sequence[PolledLine]) -> None:
        """Stop polling these lines, and wait for stops and exchanges in flight.

        Drives whose bus has `stop_on_exit` are stopped first. The wait for stops has no limit. The wait for
        exchanges in flight ends after ENDING_NS, or earlier when the mastership expires. If ports stay open
        too long after the expiry, a timer of the operating system kills the process; see Mastership.
        """
        for line in lines:
            line.bus.leave()  # starts the stops of all lines; the next loop waits for them
        for line in lines:
            line.leave()
        for line in lines:
            line.bus.part()  # waits for the stops, which need the open port
        self._await_exchanges(lines)

    def pause(self, lines: Sequence[PolledLine]) -> None:
        """Stop polling these lines, wait up to ENDING_NS for polls in flight, and drop the ports.

        Stops continue: a stop that needs the port opens it again.
        """
        for line in lines:
            line.leave()
        self._await_exchanges(lines)
        for line in lines:
            line.drop()

    def _await_exchanges(self, lines: Sequence[PolledLine]) -> None:
        given_up_ns = clock.now_ns() + self._patience_ns()
        while sum(line.end() for line in lines) and clock.now_ns() < given_up_ns:
            clock.sleep(0.001)

    def _patience_ns(self) -> int:
        until_ns = self._mastership.until_ns if self._mastership else 0
        return min(ENDING_NS, max(0, until_ns - clock.boottime_ns())) if until_ns else ENDING_NS


def _settled(work: Callable[[], Bus | OSError]) -> Future[Bus | OSError]:
    """Call `work`; return a future with its result or its exception."""
    future: Future[Bus | OSError] = Future()
    try:
        future.set_result(work())
    except BaseException as failure:
        future.set_exception(failure)
    return future
