"""Each family declared at the address of each simulated drive of another make."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from profile_families import ALL, MAKE, SHIPPED_AS
from simulated_bus import SimulatedBus

from multidrop.drive import ANOTHER_FAMILY, Drive
from multidrop.errors import BusError, WriteForbidden
from multidrop.families import YD1000, DelixiModbus, ErmanERG220, InnovertIBD, InvtCHE
from multidrop.sim import simulated

BUILT_IN: dict[str, Callable[[int], Drive]] = {
    "erman-er-g-220": ErmanERG220,
    "invt-che": lambda address: InvtCHE(address, maximum_frequency=50),
    "innovert-ibd": InnovertIBD,
    "delixi-modbus": DelixiModbus,
    "yd1000": YD1000,
}
DECLARED = {**BUILT_IN, **ALL}
THERE = {**BUILT_IN, **MAKE}
KIND = {**{name: name for name in DECLARED}, **{f"shipped {name}": kind for name, kind in SHIPPED_AS.items()}}
PAIRS = [(declared, there) for declared in DECLARED for there in THERE if KIND[declared] != there]
# Makes that are recognised by their registers, so that no frame of another family is sent to them.
RECOGNISED = {"invt-che", "yd1000"}
# The other make's status is invalid in the profile, and its `signature` is another one.
RECOGNISED_BY_STATUS = {("invt-goodrive", "delta-vfd-el")}
# Families whose stop, 0001H at 2000H, runs an INVT Goodrive, which shows no proof of its make.
STOP_RUNS_A_GOODRIVE = {"innovert-ibd", "delixi-modbus", "delta-vfd-el"}


@pytest.fixture(params=PAIRS, ids=" on ".join)
def pair(request: pytest.FixtureRequest) -> tuple[str, str]:
    found: tuple[str, str] = request.param
    return found


def attached(monkeypatch: pytest.MonkeyPatch, pair: tuple[str, str]) -> tuple[SimulatedBus, Any, Any]:
    """Return the bus, the drive as it is declared, and the simulated drive of the other make."""
    declared, there = pair
    sim: Any = simulated(THERE[there](1))
    bus = SimulatedBus(monkeypatch, sim)
    return bus, bus.attach(DECLARED[declared](1)), sim


def test_commands_never_reach_another_make(monkeypatch: pytest.MonkeyPatch, pair: tuple[str, str]) -> None:
    bus, drive, sim = attached(monkeypatch, pair)
    for call in (lambda: drive.set_frequency(20), drive.start, drive.reset_fault):
        with pytest.raises(BusError):
            call()
    assert bus.written == []
    assert not sim.motor.energised


def test_stop_is_withheld_only_from_a_recognised_make(
    monkeypatch: pytest.MonkeyPatch, pair: tuple[str, str]
) -> None:
    bus, drive, sim = attached(monkeypatch, pair)
    failure: BusError | None = None
    try:
        drive.stop(seconds=1)
    except BusError as raised:
        failure = raised
    is_withheld = isinstance(failure, WriteForbidden) and failure.rule == ANOTHER_FAMILY
    assert is_withheld == (bus.written == [])
    declared, there = pair
    if is_withheld:
        assert there in RECOGNISED or (KIND[declared], there) in RECOGNISED_BY_STATUS
    runs = KIND[declared] in STOP_RUNS_A_GOODRIVE and there == "invt-goodrive"
    assert sim.motor.energised == runs
