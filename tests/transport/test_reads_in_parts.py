"""Reads with `Bus` that a drive refuses or ignores as a whole are split, without losing a register."""

from __future__ import annotations

import itertools

import checksums
import pytest
from hypothesis import given
from hypothesis import strategies as st
from simulated_bus import SimulatedBus
from toy import Picky, expected_values, family

from multidrop.core import NumberFormat
from multidrop.drive.register import reading
from multidrop.errors import BadReply, DriveException, NoReply

WIDE = 24


def test_a_refused_block_is_read_in_parts_until_the_port_is_reopened(monkeypatch: pytest.MonkeyPatch) -> None:
    drive = family(WIDE)(1, name="pump-1")
    sim = Picky(drive, most=8)
    bus = SimulatedBus(monkeypatch, sim)
    bus.attach(drive)
    first = drive.read_many(drive.registers.values())
    assert first == expected_values(range(WIDE))
    assert [count for _, count in sim.asked] == [24, 12, 6, 6, 12, 6, 6]
    sim.asked.clear()
    assert drive.read_many(drive.registers.values()) == first
    assert [count for _, count in sim.asked] == [6] * 4
    bus.queue = object()  # as after the port is reopened
    sim.asked.clear()
    assert drive.read_many(drive.registers.values()) == first
    assert sim.asked[0] == (0, WIDE)


def test_the_error_for_a_refused_block_names_the_refused_register(monkeypatch: pytest.MonkeyPatch) -> None:
    drive = family(WIDE)(1, name="pump-1")
    sim = Picky(drive, refused={3})
    bus = SimulatedBus(monkeypatch, sim)
    bus.attach(drive)
    with pytest.raises(DriveException, match=r"^pump-1 refuses r3: ") as caught:
        drive.read_many(drive.registers.values())
    assert caught.value.register == "r3"
    assert sim.asked[-1] == (3, 1)
    assert len(sim.asked) <= 11
    sim.asked.clear()
    with pytest.raises(DriveException, match=r"^pump-1 refuses r3: "):
        drive.read_many(drive.registers.values())
    assert sim.asked == [(3, 1)]  # only the refused register is requested again
    sim.missing.clear()
    assert drive.read_many(drive.registers.values()) == expected_values(range(WIDE))
    others = [register for register in drive.registers.values() if register.address != 3]
    assert drive.read_many(others) == expected_values(set(range(WIDE)) - {3})


@given(st.sets(st.integers(0, 5), max_size=2), st.integers(1, 6), st.sets(st.integers(0, 5), min_size=1))
def test_a_read_is_complete_or_names_the_refused_register(
    refused: set[int], most: int, asked: set[int]
) -> None:
    drive = family(6)(1, name="pump-1")
    with pytest.MonkeyPatch.context() as monkeypatch:
        bus = SimulatedBus(monkeypatch, Picky(drive, refused, most)).bus
        bus.attach(drive)
        registers = [drive.register(f"r{at}") for at in sorted(asked)]
        for _ in range(2):  # the second time, the parts are known
            if not refused & asked:
                assert drive.read_many(registers) == expected_values(asked)
                continue
            with pytest.raises(DriveException) as caught:
                drive.read_many(registers)
            assert caught.value.register in {f"r{at}" for at in refused & asked}


@pytest.mark.parametrize("code", [1, 5, 6])
def test_a_block_refused_as_busy_is_not_split(code: int, monkeypatch: pytest.MonkeyPatch) -> None:
    drive = family(WIDE)(1, name="pump-1")
    bus = SimulatedBus(monkeypatch, sim := Picky(drive))
    bus.attach(drive)
    sim.limit = 0
    monkeypatch.setattr(sim, "_code", lambda reason: code)
    with pytest.raises(DriveException):
        drive.read_many(drive.registers.values())
    assert sim.asked == [(0, WIDE)]


def test_the_error_for_several_refused_registers_names_none(monkeypatch: pytest.MonkeyPatch) -> None:
    scaled = {"flow": reading(2, scale_register="power"), "power": reading(3, number_format=NumberFormat.I16)}
    drive = family(2, **scaled)(1, name="pump-1")
    bus = SimulatedBus(monkeypatch, sim := Picky(drive))
    bus.attach(drive)
    sim.limit = 0
    monkeypatch.setattr(sim, "_code", lambda reason: 6)
    with pytest.raises(DriveException, match=r"^pump-1 refuses: ") as caught:
        drive.read(drive.register("r1"), drive.register("flow"))
    assert caught.value.register is None


def test_a_long_request_without_a_reply_is_split(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drive = family(WIDE)(1, name="pump-1")
    bus = SimulatedBus(monkeypatch, sim := Picky(drive, silent_beyond=8))
    bus.attach(drive)
    assert drive.read_many(drive.registers.values()) == expected_values(range(WIDE))
    sim.asked.clear()
    assert drive.read_many(drive.registers.values()) == expected_values(range(WIDE))
    assert [count for _, count in sim.asked] == [6] * 4


def test_a_dead_drive_gets_only_one_additional_request(monkeypatch: pytest.MonkeyPatch) -> None:
    drive = family(WIDE)(1, name="pump-1")
    bus = SimulatedBus(monkeypatch, sim := Picky(drive, silent_beyond=0))
    bus.attach(drive)
    with pytest.raises(NoReply):
        drive.read_many(drive.registers.values())
    assert sim.asked == [(0, WIDE)] * 3 + [(0, 1)]
    sim.silent_beyond = 125
    assert drive.read_many(drive.registers.values()) == expected_values(range(WIDE))
    sim.asked.clear()
    sim.silent_beyond = 1  # perhaps noise, because the drive has answered the whole block
    with pytest.raises(NoReply):
        drive.read_many(drive.registers.values())
    assert sim.asked == [(0, WIDE)] * 3


@pytest.mark.parametrize("silent", [{1}, {1, 2}, {0, 2}])
def test_bytes_received_for_one_attempt_are_reported(
    monkeypatch: pytest.MonkeyPatch, silent: set[int]
) -> None:
    """The attempts in `silent` receive no bytes; the others receive a foreign reply, which is reported."""
    drive = family(2)(1, name="pump-1")
    bus = SimulatedBus(monkeypatch, Picky(drive))
    bus.attach(drive)
    attempts = itertools.count()
    foreign = checksums.rtu(bytes.fromhex("63 03 02 00 07"))
    bus.loses = lambda request: next(attempts) in silent
    bus.answers = lambda request: foreign
    with pytest.raises(BadReply, match="another address"):
        drive.read_many(drive.registers.values())
