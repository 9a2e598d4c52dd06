"""Applying parameters: only what differs, only to a motor that stands, and never the line's own."""

from __future__ import annotations

from pathlib import Path
from random import Random

import pytest
from parameter_drives import factory_reset, raw_of, set_at_random, with_parameters, writable
from simulated_bus import SimulatedBus

from multidrop import YD1000, DelixiModbus, DelixiNative, Drive, ErmanERG220, params
from multidrop.sim import MotorDrive

EXTRA = {
    YD1000: ["F170", "F240", "F241", "F305"],
    DelixiModbus: ["P00.03", "P00.04", "P01.00", "P01.01"],
    DelixiNative: ["P00.03", "P00.04", "P01.00", "P01.01"],
    ErmanERG220: [],
}


@pytest.fixture(autouse=True)
def _state(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))


def attached(
    monkeypatch: pytest.MonkeyPatch, drive: Drive, extra: list[str]
) -> tuple[SimulatedBus, Drive, MotorDrive]:
    sim = with_parameters(drive, extra)
    line = SimulatedBus(monkeypatch, sim)
    return line, line.attach(drive), sim


@pytest.mark.parametrize("family", EXTRA)
def test_saved_parameters_are_restored_after_a_factory_reset(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, family: type[Drive]
) -> None:
    line, drive, sim = attached(monkeypatch, family(1), EXTRA[family])
    there = writable(drive, EXTRA[family])
    assert there
    set_at_random(sim, there, Random(7))
    before = [raw_of(sim, one) for one in there]
    params.save(params.read(drive), tmp_path / "drive.toml", family)
    factory_reset(sim, there)
    assert [raw_of(sim, one) for one in there] != before
    saved = params.load(tmp_path / "drive.toml")
    done = params.apply(drive, saved, commissioning=True)
    assert done.ok
    assert not done.plan.left
    assert [raw_of(sim, one) for one in there] == before
    assert params.compare(saved, params.read(drive, saved.values)) == []
    sent = len(line.written)
    again = params.apply(drive, saved)
    assert again.ok
    assert not again.written
    assert [frame for frame in line.written[sent:] if not is_stop(drive, frame)] == []


def is_stop(drive: Drive, frame: str) -> bool:
    return isinstance(drive, DelixiModbus) and frame == "01 06 20 00 00 01 43 CA"
