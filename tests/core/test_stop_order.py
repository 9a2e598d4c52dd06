"""The order of urgent requests while drives are stopped and some of them are silent, on simulated time."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise
from typing import Any

import pytest
from clocked_lines import NEVER, ClockedPort

from multidrop.core import Exchange, Framing, Message, Peer, build_reply, parse_request

MS = 1_000_000
REPLY, TIMEOUT = 20 * MS, 100 * MS  # delay of a reply, and of a timeout, in ns
SLACK = MS  # time of the frames and of the silences around them
SILENT = 50  # drives at this address and above are silent
# Registers: STOP stands for the first write of a stop, AGAIN for its repetitions, STATUS for its reads, OTHER
# for other requests. All are read here, because the reply to a write is a copy of it, which may also be the
# adapter's echo.
STOP, AGAIN, STATUS, OTHER = 0x1000, 0x1002, 0x1001, 0x2000

Request = tuple[int, int]  # address of the drive, address of the register


class Line:
    """A port on simulated time, and drives that answer after REPLY or are silent."""

    def __init__(self) -> None:
        self.now = 0
        self.sent: list[tuple[int, Request]] = []  # each request with the time at which it was sent
        self.port = ClockedPort(self)
        self._reply: tuple[int, bytes] | None = None
        self._peers: dict[int, Peer] = {}
        self._pending: list[tuple[Any, Request]] = []

    def send(self, request: bytes, baudrate: int) -> None:
        _, message = parse_request(Framing.RTU, request)
        assert message is not None
        self.sent.append((self.now, (message.address, message.start)))
        if message.address < SILENT:
            reply = Message(message.address, 3, count=1, data=b"\0\0")
            self._reply = self.now + REPLY, build_reply(Framing.RTU, reply)

    def ask(self, *requests: Request) -> None:
        """Add urgent requests to the queue, as if a thread were waiting for each."""
        for request in requests:
            self._pending.append((self.port.begin_urgent(self._exchange(*request)), request))

    def _exchange(self, address: int, register: int) -> Exchange:
        if address not in self._peers:
            self._peers[address] = Peer(least_timeout=TIMEOUT / 1e9, most_timeout=TIMEOUT / 1e9)
            self._peers[address].c.failures = address >= SILENT
        return Exchange(
            Framing.RTU,
            Message(address, 3, register, 1),
            self._peers[address],
            baudrate=115_200,
            format="8N1",
            character=1e-6,
            silence=1e-4,
            insists=register in (STOP, AGAIN),
            is_stop_read=register == STATUS,
            timeout=TIMEOUT / 1e9 if register == AGAIN else 0.0,
        )

    def run(self, until: int) -> Iterable[Request]:
        """Run the line until this time in ns; yield each request that has ended."""
        received = b""
        while True:
            wake = self.port.advance(received)
            received = b""
            for urgent, request in [*self._pending]:
                if urgent.is_done:
                    self._pending.remove((urgent, request))
                    yield request
            due = min(wake, self._reply[0] if self._reply else NEVER)
            self.now = max(self.now, min(due, until))
            if self.now >= until:
                return
            if self._reply and self._reply[0] <= self.now:
                received, self._reply = self._reply[1], None

    def order(self) -> list[Request]:
        return [request for _, request in self.sent]

    def longest_pause(self, address: int) -> int:
        """Return the longest time in ns between two requests to this drive."""
        times = [at for at, request in self.sent if request[0] == address]
        return max(later - earlier for earlier, later in pairwise(times))


SECONDS = 1_000_000_000


def test_stops_of_drives_that_answer_go_first_after_a_timeout() -> None:
    line = Line()
    line.ask((50, STOP), (51, STOP), (1, STOP), (2, STOP))
    list(line.run(10 * SECONDS))
    assert line.order() == [(50, STOP), (1, STOP), (2, STOP), (51, STOP)]


@pytest.mark.parametrize("silent", [1, 4, 30])
@pytest.mark.parametrize("answering", [1, 15])
def test_reads_of_a_stop_wait_for_one_silent_drive_and_not_for_all(answering: int, silent: int) -> None:
    """The drives are stopped from separate threads. Neither group leaves the other without its turns."""
    line = Line()
    addresses = [*range(1, 1 + answering), *range(SILENT, SILENT + silent)]
    line.ask(*((address, AGAIN) for address in addresses))
    for address, _ in line.run(60 * SECONDS):
        line.ask((address, AGAIN if address >= SILENT else STATUS))
    exchange = REPLY + SLACK
    reads = (TIMEOUT + SLACK) + (answering + 1) * exchange
    assert max(map(line.longest_pause, range(1, 1 + answering))) < 2 * reads
    turn = 2 * (TIMEOUT + SLACK) + exchange
    assert max(map(line.longest_pause, addresses[answering:])) < silent * turn


def test_first_stops_of_silent_drives_hardly_wait_for_reads_of_other_stops() -> None:
    """The reads never pause. A silent drive may be back, with a running motor."""
    line, silent, answering = Line(), range(SILENT, SILENT + 12), range(1, 16)
    line.ask(*((address, STOP) for address in (*silent, *answering)))
    for address, _ in line.run(10 * SECONDS):
        line.ask((address, AGAIN if address >= SILENT else STATUS))
    first = {request: at for at, request in reversed(line.sent)}
    exchange = REPLY + SLACK
    turn = 5 / 4 * (TIMEOUT + SLACK) + exchange
    assert max(first[address, STOP] for address in silent) < len(silent) * turn + len(answering) * exchange


def test_reads_precede_the_first_stop_of_a_silent_drive_for_a_quarter_of_a_timeout() -> None:
    line = Line()
    line.ask((50, STOP), (51, STOP), (1, STATUS), (2, STATUS), (3, STATUS))
    list(line.run(10 * SECONDS))
    assert line.order() == [(50, STOP), (1, STATUS), (2, STATUS), (51, STOP), (3, STATUS)]


def test_a_first_stop_behind_repeated_stops_precedes_reads() -> None:
    line = Line()
    line.ask((50, AGAIN), (51, AGAIN), (52, STOP), (1, STATUS), (2, STATUS), (3, STATUS))
    list(line.run(10 * SECONDS))
    first = [(50, AGAIN), (1, STATUS), (2, STATUS), (51, AGAIN)]
    assert line.order()[:4] == first
    assert line.order().index((52, STOP)) < 6


def test_stops_precede_the_first_stop_of_a_silent_drive_for_a_whole_timeout() -> None:
    line = Line()
    line.ask((50, STOP), (51, STOP), *((address, STOP) for address in (1, 2, 3, 4)))
    list(line.run(10 * SECONDS))
    assert [address for address, _ in line.order()] == [50, 1, 2, 3, 4, 51]


def test_a_new_stop_precedes_reads_of_other_stops() -> None:
    line = Line()
    line.ask((50, STOP), (1, STATUS), (2, STATUS), (3, STOP))
    list(line.run(10 * SECONDS))
    assert line.order() == [(50, STOP), (3, STOP), (1, STATUS), (2, STATUS)]


def test_only_reads_of_stops_precede_stops_of_silent_drives() -> None:
    line = Line()
    line.ask((50, STOP), (51, STOP), (1, OTHER), (2, STATUS))
    list(line.run(10 * SECONDS))
    assert line.order() == [(50, STOP), (2, STATUS), (51, STOP), (1, OTHER)]


def test_reads_without_replies_do_not_delay_other_stops_repeatedly() -> None:
    """A drive may become silent after it has answered its stop. Its reads then also time out."""
    line = Line()
    line.ask((50, STOP), (60, STATUS), (61, STATUS), (51, STOP), (52, STOP))
    list(line.run(10 * SECONDS))
    assert line.order() == [(50, STOP), (60, STATUS), (51, STOP), (61, STATUS), (52, STOP)]


def test_a_read_of_a_stop_that_listens_for_another_master_lets_stops_pass() -> None:
    """A read must not be sent before the port has listened; a stop may."""
    line = Line()
    line.port.listen_until(SECONDS)
    line.ask((50, STOP), (1, STATUS), (51, STOP))
    list(line.run(10 * SECONDS))
    assert line.order() == [(50, STOP), (51, STOP), (1, STATUS)]
    assert line.sent[-1][0] >= SECONDS
