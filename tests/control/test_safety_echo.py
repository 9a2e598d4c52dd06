"""An adapter that starts to echo when the drive dies: no write is reported as done."""

from __future__ import annotations

from pathlib import Path

import pytest
from simulated_bus import SimulatedBus, is_write, one

from multidrop.control.audit_log import read_audit
from multidrop.control.outcome import Effect
from multidrop.core import Message, build_request
from multidrop.drive import Drive
from multidrop.errors import Unconfirmed
from multidrop.families import YD1000, DelixiModbus, DelixiNative, ErmanERG220, InnovertIBD, InvtCHE

DRIVES = (
    ErmanERG220(1),
    InvtCHE(1, maximum_frequency=50),
    InnovertIBD(1),
    DelixiModbus(1),
    DelixiNative(1),
    YD1000(1),
)


def dies_and_echoes(line: SimulatedBus, drive: Drive) -> None:
    """From now on each write is answered by its echo, and reads are not answered."""
    line.deafens = lambda request: True
    line.answers = lambda request: build_request(drive.framing, request) if is_write(request) else None


@pytest.mark.parametrize("declared", DRIVES, ids=lambda drive: drive.model)
def test_a_plain_stop_that_may_be_an_echo_is_not_confirmed(
    monkeypatch: pytest.MonkeyPatch, declared: Drive
) -> None:
    line, drive, _ = one(monkeypatch, type(declared)(1, **declared.option))
    stop = next(register for register in drive.registers.values() if register.harmless)
    value = stop.decode(stop.harmless[-1])
    assert drive.try_write(stop, value).effect is Effect.DONE
    dies_and_echoes(line, drive)
    with pytest.raises(Unconfirmed, match="echo"):
        drive.write(stop, value)


@pytest.mark.parametrize("family", [InnovertIBD, DelixiNative])
def test_a_setpoint_that_may_be_an_echo_is_not_confirmed(
    monkeypatch: pytest.MonkeyPatch, family: type[Drive]
) -> None:
    """It cannot be read back."""
    line, drive, _ = one(monkeypatch, family(1))
    drive.set_frequency(20)
    dies_and_echoes(line, drive)
    for write in (lambda: drive.write(drive.frequency, 25.0), lambda: drive.set_frequency(25.0)):
        with pytest.raises(Unconfirmed, match="echo"):
            write()
        assert drive.commanded is None  # neither a start nor a ramp trusts it


def test_an_echo_that_shows_at_the_next_read_confirmed_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """The drive missed the write, and answers the read after it."""
    line, drive, _ = one(monkeypatch, InnovertIBD(1))
    drive.set_frequency(20)

    def echo(request: Message) -> bytes | None:
        line.has_echo |= not is_write(request)  # the core sees it before a reply that is no copy
        return build_request(drive.framing, request) if is_write(request) else None

    line.answers = echo
    outcome = drive.try_write(drive.frequency, 25.0)
    assert outcome.effect is Effect.UNCONFIRMED
    assert "the reply was the adapter's echo" in str(outcome.failure)


def test_a_raw_request_that_may_be_an_echo_is_not_confirmed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    line, drive, _ = one(monkeypatch, InnovertIBD(1), audit=tmp_path / "audit")
    drive.send_raw(6, 0x2001, b"\x07\xd0")
    dies_and_echoes(line, drive)
    with pytest.raises(Unconfirmed, match="echo"):
        drive.send_raw(6, 0x2001, b"\x07\xd0")
    line.bus.close()
    assert [entry["outcome"] for entry in read_audit(tmp_path / "audit")] == ["done", "unconfirmed"]


def test_confirmations_through_a_known_echo_are_believed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """There the core distinguishes the drive's copy from the adapter's."""
    line, drive, _ = one(monkeypatch, InnovertIBD(1))
    line.has_echo = True
    drive.set_frequency(20)
    line.loses = lambda request: not is_write(request)
    assert drive.try_write(drive.frequency, 25.0).effect is Effect.DONE
