"""`Drive.read_raw`: raw reads of any address, which never write."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import checksums
import pytest
from completions import completed
from lines import line, plant, polled, proofs, rows_of, until
from simulated_bus import SimulatedBus, one
from toy import Toy

from multidrop.control.audit_log import read_audit
from multidrop.core import Failure, Message
from multidrop.errors import BadReply, DriveException, Expired, NoReply, NotAttached
from multidrop.families import DelixiModbus, DelixiNative, InnovertIBD
from multidrop.poller import Poller
from multidrop.sim import EncodedDrive, SimulatedDrive, Simulator, Wire, proof


@pytest.fixture
def simulated(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[SimulatedBus]:
    toy = SimulatedDrive(Toy(7))
    toy["output_frequency"], toy["output_current"] = 12.3, 1.5
    bus = SimulatedBus(monkeypatch, toy, audit=tmp_path / "audit.jsonl")
    bus.attach(toy.drive)
    with bus.bus:
        yield bus


def test_read_raw_sends_and_parses_the_standards_example(simulated: SimulatedBus) -> None:
    """The request is that of the application protocol V1.1b3, 6.3; its CRC was calculated separately."""
    (toy,) = simulated.bus.drives
    assert toy.read_raw(3, 1, 2) == bytes.fromhex("007B 0096")
    assert [frame for _, frame in simulated.frames] == ["07 03 00 01 00 02 95 AD"]


def test_read_raw_is_not_treated_as_a_write(simulated: SimulatedBus, tmp_path: Path) -> None:
    """The read is not audited, retried or reported as unconfirmed, and no identity check precedes it."""
    (toy,) = simulated.bus.drives
    simulated.loses = lambda request: True
    with pytest.raises(NoReply):
        toy.read_raw(3, 1, 2)
    assert len(simulated.frames) == 1
    assert list(read_audit(tmp_path / "audit.jsonl")) == []


def test_read_raw_raises_drive_exception_for_an_exception(simulated: SimulatedBus) -> None:
    (toy,) = simulated.bus.drives
    with pytest.raises(DriveException) as refusal:
        toy.read_raw(3, 0x4000, 1)
    assert refusal.value.code == 2


def test_read_raw_raises_expired_if_it_cannot_start_in_time(simulated: SimulatedBus) -> None:
    (toy,) = simulated.bus.drives
    simulated.queue_time = 0.3
    with pytest.raises(Expired, match=r"a read of 2 from 1 by function 03H was not sent: .* within 0.2 s"):
        toy.read_raw(3, 1, 2, expiry=0.2)
    assert simulated.frames == []
    assert toy.read_raw(3, 1, 2, expiry=0.4) == bytes.fromhex("007B 0096")


def test_read_raw_waits_for_late_replies_only_until_it_expires(
    monkeypatch: pytest.MonkeyPatch, simulated: SimulatedBus
) -> None:
    (toy,) = simulated.bus.drives
    found = completed(int(Failure.LATE_ANSWER_DUE), Message(0, 0), b"", at_ns=0)
    found.c.late_until_ns = round((simulated.seconds + 60) * 1e9)
    monkeypatch.setattr(simulated, "carry_out", lambda exchange, **times: found)
    begun = simulated.seconds
    with pytest.raises(Expired, match=r"was not sent: .* within 0.2 s"):
        toy.read_raw(3, 1, 2, expiry=0.2)
    assert simulated.seconds - begun < 0.21


def test_a_copy_of_the_request_is_not_returned_as_a_raw_reply(simulated: SimulatedBus) -> None:
    """The reply to a read of 17 coils from 03xxH has its request's length and first three bytes."""
    (toy,) = simulated.bus.drives
    echo = checksums.rtu(bytes.fromhex("07 01 03 20 00 11"))
    simulated.answers = lambda request: echo
    with pytest.raises(BadReply, match="copy of the request"):
        toy.read_raw(1, 0x320, 17)
    assert simulated.frames[0][1] == echo.hex(" ").upper()
    simulated.has_echo = True  # on a line known to echo, a copy and a reply are distinguishable
    assert toy.read_raw(1, 0x320, 17) == bytes.fromhex("20 00 11")


WRONG = {
    (6, 1, 1): "function = 6 does not read; 1, 2, 3 and 4 do",
    (0, 1, 1): "function = 0 does not read",
    (3, -1, 1): "start = -1 is not an address from 0 to 65535",
    (3, 65536, 1): "start = 65536 is not an address",
    (3, 65535, 2): r"start \+ count = 65537: the last address is 65535",
    (3, 1, 0): "count = 0 is not from 1 to 10, which toy@7 reads in one request",
    (3, 1, 11): "count = 11 is not from 1 to 10",  # a limit of the family
    (4, 1, 126): "count = 126 is not from 1 to 125",
    (1, 1, 2001): "count = 2001 is not from 1 to 2000",
}


@pytest.mark.parametrize("asked", WRONG)
def test_an_impossible_raw_read_raises_before_any_frame_is_sent(
    simulated: SimulatedBus, asked: tuple[int, int, int]
) -> None:
    (toy,) = simulated.bus.drives
    with pytest.raises(ValueError, match=WRONG[asked]):
        toy.read_raw(*asked)
    assert simulated.frames == []


@pytest.mark.parametrize("asked", [(True, 1, 1), (3, 1.0, 1), (3, 1, "2")])
def test_a_raw_read_with_a_count_that_is_not_a_number_raises(
    simulated: SimulatedBus, asked: tuple[int, int, int]
) -> None:
    (toy,) = simulated.bus.drives
    with pytest.raises(TypeError, match="is not a whole number"):
        toy.read_raw(*asked)
    for expiry in (0, -1, float("nan"), float("inf"), True):
        with pytest.raises(ValueError, match="is not a number of s above 0"):
            toy.read_raw(3, 1, 1, expiry=expiry)
    assert simulated.frames == []


@pytest.mark.parametrize("function", [1, 2, 3, 4])
def test_send_raw_rejects_read_functions_before_sending(simulated: SimulatedBus, function: int) -> None:
    """A read sent as a write would wait so long that a late reply to an earlier read could be accepted."""
    (toy,) = simulated.bus.drives
    with pytest.raises(
        ValueError, match=rf"{function:02X}H is a read.*call drive.read_raw\({function}, 80, 2\)"
    ):
        toy.send_raw(function, 80, count=2)
    assert simulated.frames == []


def test_read_raw_is_limited_by_the_familys_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    _, native, _ = one(monkeypatch, DelixiNative(1))
    with pytest.raises(ValueError, match="speaks Delixi's own protocol"):
        native.read_raw(3, 1, 1)
    bus, modbus, _ = one(monkeypatch, DelixiModbus(1))
    with pytest.raises(ValueError, match="count = 2 is not from 1 to 1"):
        modbus.read_raw(3, 1, 2)
    with pytest.raises(NotAttached, match="fan is not attached to a bus: use bus"):
        InnovertIBD(1, name="fan").read_raw(3, 1, 1)
    assert bus.frames == []


@pytest.mark.slow
def test_read_raw_works_on_a_polled_line() -> None:
    """On a busy computer too, neither accepts a delayed reply to the other's request."""
    drive = polled(Toy(1), [Toy.output_frequency, Toy.mystery])
    expected = proofs(drive)
    status = int(proof(drive.drive, Toy.status)).to_bytes(2)
    answers = Counter[bytes]()
    with Simulator([Wire([EncodedDrive(Toy(1))], unpaced=True)]) as sim:
        with Poller(plant(line(sim.wires[0].path, drive))) as poller:

            def asked() -> bool:
                with suppress(NoReply, BadReply):
                    answers[drive.drive.read_raw(3, Toy.status.address, 1, expiry=60.0)] += 1
                return answers.total() >= 20

            until(asked)
            polls = poller.summary()["samples"]
            until(lambda: poller.summary()["samples"] > polls + 20)
        rows = rows_of(poller)
    assert set(answers) == {status}
    good = [row for row in rows if row.status == "ok"]
    assert {row.register: row.value for row in good} == {name: value for (_, name), value in expected.items()}
    assert all(row.value == expected[row.drive, row.register] for row in good)
