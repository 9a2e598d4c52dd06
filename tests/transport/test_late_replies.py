"""A late reply is never taken for the reply to another request.

If a late reply could be mistaken for a request's reply, the C core sends a proof first: a read whose reply no
late reply can resemble. The last tests reopen a port to which late replies come, in this process or after
another one.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from frames import words
from line_driver import LONGER, MS, OTHER, READ, WRITE, LineDriver, ask, drive, exchange, line, reply
from lines import PATIENCE, patient, plant, polled, rows_of, until
from lines import line as declared
from motors import LINES, of_one_variant
from stories import PathWire, bus_over, constant, read_truly
from tables import table
from toy import QuickToy, Toy

from multidrop import Bus, NoReply, Poller
from multidrop.core import Exchange, Failure, Framing, Message, Peer, build_reply, build_request
from multidrop.drive import Drive
from multidrop.planning.blocks import blocks
from multidrop.sim import EncodedDrive, Faults, SimulatedDrive, Simulator, Wire, simulated
from multidrop.transport import drive_records

__all__ = ["drive", "line"]  # fixtures

PROOF_REPLY = build_reply(Framing.RTU, Message(1, 3, data=words(4, 5)))
AGAIN = Message(1, 6, 9, data=words(1))


@pytest.fixture
def proof(line: LineDriver, drive: Peer) -> Exchange:
    """Let READ time out, and the time for its late reply pass. Return a proof, which reads more registers."""
    found = exchange(LONGER, drive)
    drive.prove_by([found])
    time_out(line, drive, READ)
    return found


def time_out(line: LineDriver, drive: Peer, request: Message) -> None:
    ask(line, drive, request)
    line.wait_until_done()
    assert line.completion.result == Failure.NO_REPLY
    line.now = drive.late_until_ns + MS


def is_barred(line: LineDriver, drive: Peer, request: Message) -> bool:
    line.begin(exchange(request, drive))
    return line.want == "done" and line.completion.result == Failure.LATE_ANSWER_DUE


@pytest.mark.usefixtures("proof")
def test_no_read_is_sent_while_a_late_reply_could_be_taken_for_its_reply(
    line: LineDriver, drive: Peer
) -> None:
    assert is_barred(line, drive, OTHER)
    ask(line, drive, Message(1, 4, 50, 1))  # a late reply to READ does not fit this request


@pytest.mark.usefixtures("proof")
def test_a_write_waits_for_the_reply_to_an_earlier_write(line: LineDriver, drive: Peer) -> None:
    """Otherwise a late exception to the first write would be taken for a refusal of the second."""
    time_out(line, drive, WRITE)
    assert is_barred(line, drive, AGAIN)


@pytest.mark.parametrize("late", [0, 1])
def test_an_answered_proof_ends_the_wait_for_late_replies(
    line: LineDriver, drive: Peer, proof: Exchange, late: int
) -> None:
    line.send(proof)
    for _ in range(late):  # a late reply comes first, and is skipped
        line.receive(reply(1111))
        assert line.listens
    assert drive.counters().late == late
    assert line.data_after(PROOF_REPLY) == words(4, 5)
    ask(line, drive, OTHER)
    assert line.data_after(reply(2222)) == words(2222)


def test_requests_still_wait_if_a_proof_is_unanswered(line: LineDriver, drive: Peer, proof: Exchange) -> None:
    line.send(proof)
    line.wait_until_done()
    assert line.completion.result == Failure.NO_REPLY
    line.now = drive.late_until_ns + MS
    assert is_barred(line, drive, OTHER)


def ask_in_vain(line: LineDriver, drive: Peer, proof: Exchange) -> None:
    """Let the drive answer another request, but neither READ nor the proof."""
    ask(line, drive, Message(1, 4, 50, 1))
    line.receive(build_reply(Framing.RTU, Message(1, 4, data=words(2222))))
    assert line.completion.result > 0
    time_out(line, drive, READ)
    line.send(proof)
    line.wait_until_done()
    assert line.completion.result == Failure.NO_REPLY
    line.now = drive.late_until_ns + MS


def test_requests_no_longer_wait_after_two_unanswered_proofs(
    line: LineDriver, drive: Peer, proof: Exchange
) -> None:
    """Some devices do not reply to reads of registers that they do not have."""
    ask_in_vain(line, drive, proof)
    assert is_barred(line, drive, OTHER)
    ask_in_vain(line, drive, proof)
    assert not is_barred(line, drive, OTHER)


@pytest.mark.parametrize("is_late", [True, False])
def test_requests_wait_for_a_proof_if_the_drive_answered_one_before(
    line: LineDriver, drive: Peer, proof: Exchange, is_late: bool
) -> None:
    if is_late:
        ask_in_vain(line, drive, proof)
    else:
        line.send(proof)
    line.receive(PROOF_REPLY)
    for _ in range(3):
        ask_in_vain(line, drive, proof)
    assert is_barred(line, drive, OTHER)


def test_requests_wait_for_a_proof_while_the_drive_is_silent(
    line: LineDriver, drive: Peer, proof: Exchange
) -> None:
    for _ in range(3):
        line.send(proof)
        line.wait_until_done()
        line.now = drive.late_until_ns + MS
    assert is_barred(line, drive, OTHER)


@pytest.mark.usefixtures("proof")
def test_a_stop_is_sent_without_a_proof(line: LineDriver, drive: Peer) -> None:
    time_out(line, drive, WRITE)
    stop = exchange(AGAIN, drive)
    stop.c.insists = 1
    line.send(stop)


@pytest.mark.usefixtures("proof")
def test_a_late_reply_is_recognised_after_the_port_is_reopened(line: LineDriver, drive: Peer) -> None:
    """The value may be the late reply to the first request, so a read by `Bus` is repeated."""
    line.lose(0)
    again = LineDriver()
    again.now = line.now
    ask(again, drive, READ)
    again.receive(reply(1111))
    assert (again.want, again.completion.result) == ("done", Failure.LATE_ANSWER_DUE)
    assert drive.counters().late == 1


@pytest.mark.usefixtures("proof")
def test_a_late_reply_is_counted_once(line: LineDriver, drive: Peer) -> None:
    """Noise comes after the late reply, before the next request is sent."""
    time_out(line, drive, LONGER)
    time_out(line, drive, LONGER)
    line.receive(PROOF_REPLY)
    assert drive.counters().late == 1
    line.receive(b"\x07")
    assert drive.counters().late == 1


@pytest.mark.usefixtures("proof")
def test_a_late_reply_is_skipped_while_a_request_is_being_sent(line: LineDriver, drive: Peer) -> None:
    """The port accepts the request in two parts, and the late reply arrives between them."""
    line.begin(exchange(Message(1, 4, 50, 1), drive))
    while line.want != "write":
        line.now += MS
    line.take(3)
    line.receive(reply(1111))
    assert drive.counters().late == 1
    line.take()
    assert line.data_after(build_reply(Framing.RTU, Message(1, 4, data=words(2222)))) == words(2222)


@pytest.mark.usefixtures("proof")
def test_noise_and_a_late_reply_are_skipped_before_a_request(line: LineDriver, drive: Peer) -> None:
    """The bytes of a late reply come after noise, before the request is sent."""
    line.begin(exchange(Message(1, 4, 50, 1), drive))
    while line.want != "write":
        line.receive(b"\x07")
        line.now += MS
    line.receive(reply(1111))
    assert drive.counters().late == 1
    line.take()
    assert line.data_after(build_reply(Framing.RTU, Message(1, 4, data=words(2222)))) == words(2222)


def has_sure_reply(line: LineDriver, drive: Peer) -> bool:
    ask(line, drive, READ)
    line.receive(reply(1))
    assert line.completion.result > 0
    return bool(line._line.is_answered)


def test_a_reply_is_not_trusted_if_it_may_answer_another_request(line: LineDriver, drive: Peer) -> None:
    assert has_sure_reply(line, drive)
    line.receive(b"\xff")  # a byte that may belong to another master's request
    assert not has_sure_reply(line, drive)
    assert has_sure_reply(line, drive)
    time_out(line, drive, WRITE)
    assert not line._line.is_answered
    assert not has_sure_reply(line, drive)


@pytest.mark.usefixtures("proof")
def test_a_reply_after_an_answered_proof_cannot_be_late(
    line: LineDriver, drive: Peer, proof: Exchange
) -> None:
    line.send(proof)
    line.receive(PROOF_REPLY)
    assert has_sure_reply(line, drive)


@pytest.fixture
def first(drive: Peer) -> Exchange:
    """Return the proof of a drive whose first reply may answer another process's READ."""
    found = exchange(LONGER, drive)
    drive.prove_by([found, exchange(Message(1, 3, 0, 3), drive)])
    drive.doubt_first_reply()
    return found


def is_in_doubt(line: LineDriver) -> bool:
    return line.want == "done" and line.completion.result == Failure.LATE_ANSWER_DUE


def test_replies_are_accepted_after_an_answered_proof(line: LineDriver, drive: Peer, first: Exchange) -> None:
    ask(line, drive, READ)
    line.receive(reply(7777))  # the reply to another process's READ
    assert is_in_doubt(line)
    line.send(first)
    line.receive(reply(1111))  # the reply to this process's READ
    assert line.listens
    line.receive(PROOF_REPLY)
    ask(line, drive, READ)
    assert line.data_after(reply(1112)) == words(1112)
    assert drive.counters().late == 0  # this drive has answered each request in time


def test_value_after_a_first_exception_may_still_be_a_late_reply(
    line: LineDriver, drive: Peer, first: Exchange
) -> None:
    ask(line, drive, READ)
    line.receive(build_reply(Framing.RTU, Message(1, 3, exception=2)))
    assert (line.want, line.completion.reply.exception) == ("done", 2)
    ask(line, drive, OTHER)
    line.receive(reply(7777))
    assert is_in_doubt(line)


@pytest.mark.usefixtures("first")
def test_the_first_write_is_sent_only_after_a_reply_to_a_read(line: LineDriver, drive: Peer) -> None:
    assert is_barred(line, drive, WRITE)
    ask(line, drive, READ)
    line.receive(reply(7777))
    assert is_in_doubt(line)
    ask(line, drive, WRITE)


@pytest.mark.usefixtures("first")
def test_a_stop_accepts_a_first_reply_that_may_be_late(line: LineDriver, drive: Peer) -> None:
    for request, came in ((READ, reply(1)), (WRITE, build_reply(Framing.RTU, WRITE))):
        asked = exchange(request, drive)
        asked.c.insists = 1
        line.send(asked)
        line.receive(came)
        assert line.completion.result > 0


def test_the_first_reply_is_accepted_if_the_drive_has_no_proof(line: LineDriver, drive: Peer) -> None:
    drive.doubt_first_reply()
    ask(line, drive, READ)
    assert line.data_after(reply(1111)) == words(1111)


@pytest.mark.parametrize("least", [0, 1, 0xFFFF])
def test_proof_reply_is_accepted_only_with_the_known_value(line: LineDriver, drive: Peer, least: int) -> None:
    """The value can be 0, as that of Delixi's P04.28 is at 1200 baud."""
    known = exchange(READ, drive, answer=(least, least))
    drive.prove_by([known, exchange(OTHER, drive, answer=(7, 7))])
    time_out(line, drive, Message(1, 3, 90, 1))
    line.send(known)
    line.receive(reply(7))
    assert line.listens
    assert line.data_after(reply(least)) == words(least)


# ---- after a port was reopened ----


class Successor(QuickToy):
    """A drive of another family at the same address."""

    model = "successor"


class HoldingWire(Wire):
    """A line that, once `holds` is set, sends the next reply only together with the reply after it."""

    holds = False
    _kept = b""

    def distort(self, reply: bytes) -> bytes:
        if self.holds:
            self.holds = False
            self._kept = reply
            return b""
        kept, self._kept = self._kept, b""
        return kept + reply


@pytest.fixture
def sim() -> SimulatedDrive:
    sim = simulated(QuickToy(1))
    sim["output_current"], sim["mystery"] = 1.11, 7777
    return sim


@pytest.fixture
def wire(sim: SimulatedDrive) -> Iterator[HoldingWire]:
    wire = HoldingWire([sim], unpaced=True)
    with Simulator([wire]):
        yield wire


def leave_a_reply_behind(wire: HoldingWire, port: str) -> None:
    """Send a request whose reply is held back, and close the bus."""
    with Bus(port) as bus:
        pump = bus.attach(QuickToy, 1)
        assert pump.read(QuickToy.output_current) == 1.11
        wire.holds = True
        with pytest.raises(NoReply):
            bus._exchanges.values(pump, [QuickToy.mystery], 1)
        assert bus.peer(pump).owes


@pytest.mark.parametrize("family", [QuickToy, Successor])
def test_a_late_reply_on_a_reopened_port_is_not_read_as_another_register(
    wire: HoldingWire, family: type[Toy], monkeypatch: pytest.MonkeyPatch
) -> None:
    leave_a_reply_behind(wire, wire.path)
    monkeypatch.setattr(QuickToy, "response_timeout", PATIENCE)  # long enough for a busy computer
    with Bus(wire.path) as bus:
        pump = bus.attach(family, 1)
        assert bus.peer(pump).owes
        assert pump.read(family.output_current) == 1.11
        assert bus.peer(pump).late >= 1  # a busy computer may make another reply late


def test_no_polled_value_comes_from_a_late_reply_on_a_reopened_port(wire: HoldingWire) -> None:
    leave_a_reply_behind(wire, wire.path)
    drive = QuickToy(1, name="pump")
    values: set[float] = set()
    with Poller(plant(declared(wire.path, polled(drive, [QuickToy.output_current])))) as poller:
        until(lambda: values.update(row.value for row in rows_of(poller) if row.value is not None) or values)
    assert values == {1.11}


def test_late_replies_are_recognised_under_another_port_name(wire: HoldingWire, tmp_path: Path) -> None:
    link = tmp_path / "hall"
    link.symlink_to(wire.path)
    leave_a_reply_behind(wire, str(link))
    with Bus(wire.path) as bus:
        assert bus.peer(bus.attach(QuickToy, 1)).owes


def test_reused_pseudo_terminal_number_gets_a_new_identity() -> None:
    def made() -> set[str]:
        ours, theirs = os.openpty()
        try:
            return drive_records.identities_of(os.ttyname(theirs))
        finally:
            os.close(theirs)
            os.close(ours)

    first = made()
    until(lambda: made() != first)  # the creation times differ after some ms


@patient  # on a busy computer, the reply to the first attempt would come late
def test_drive_is_not_remembered_if_no_late_reply_is_expected(wire: HoldingWire) -> None:
    with Bus(wire.path) as bus:
        bus.attach(QuickToy, 1).read(QuickToy.output_current)
    assert not drive_records.identities_of(wire.path) & drive_records._former.keys()


def test_a_drive_is_remembered_exactly_as_long_as_late_replies_are_expected(
    wire: HoldingWire, monkeypatch: pytest.MonkeyPatch
) -> None:
    leave_a_reply_behind(wire, wire.path)
    names = drive_records.identities_of(wire.path)
    assert names <= drive_records._former.keys()
    now_ns = drive_records.clock.now_ns
    later: Callable[[], int] = lambda: now_ns() + drive_records.KEPT_NS  # noqa: E731
    monkeypatch.setattr(drive_records.clock, "now_ns", later)
    drive_records.remember_former_peers(["elsewhere"], [])
    assert not names & drive_records._former.keys()


BEGIN = 1000.0  # s; start of the simulated clock

DELAY = 0.1  # s; delay of the network between line and drive


def answer_to_another(drive: Drive) -> bytes:
    """Return a drive's reply to a read of its second register."""
    wire = PathWire([EncodedDrive(drive)], Faults())
    wire.delay = constant(0.0)
    wire.open()
    (block,) = blocks(drive, [drive.readings()[1]])
    wire.advance(BEGIN)
    wire.receive(build_request(drive.framing, block.request), BEGIN, drive.settings.baudrate)
    said = b""
    for step in range(2000):
        said += wire.advance(BEGIN + step / 1000)
    assert said
    return said


@pytest.mark.long
@table("name", LINES)
def test_a_late_reply_to_an_earlier_process_is_never_the_value_of_a_register(name: str) -> None:
    """Every value read belongs to its register, from the first read on."""
    drives = of_one_variant(LINES[name])
    wire = PathWire([EncodedDrive(drive) for drive in drives], Faults())
    wire._path.append((BEGIN + DELAY / 2, answer_to_another(drives[0])))
    with pytest.MonkeyPatch.context() as patch:
        opened, line = bus_over(wire, constant(DELAY), [EncodedDrive(drive) for drive in drives], patch)
        read_truly(opened, line, drives)
