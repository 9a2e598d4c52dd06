"""`Drive.read`, `write` and similar methods: registers, names and texts; attached and unattached drives."""

from __future__ import annotations

import pytest
from simulated_bus import SimulatedBus, one

from multidrop.drive import Drive
from multidrop.drive.register import COIL, DISCRETE, reading, setting
from multidrop.drive.text import text
from multidrop.errors import NotAttached
from multidrop.families import InnovertIBD
from multidrop.sim import SimulatedDrive


class Meter(Drive):
    """A device with two neighbouring readings, a setting, and a text."""

    level = reading(0, "m", step=0.1)
    flow = reading(1, "l/s")
    limit = setting(5, "m", step=0.1, span=(0, 100), moves=False)
    serial = text(20, 4)
    door = reading(3, table=DISCRETE)
    lamp = setting(4, table=COIL, moves=False)


@pytest.fixture
def meter(monkeypatch: pytest.MonkeyPatch) -> tuple[SimulatedBus, Meter]:
    sim = SimulatedDrive(Meter(1, name="tank"))
    sim["level"], sim["flow"], sim["limit"], sim["serial"] = 2.5, 7, 4.0, "AB12"
    line = SimulatedBus(monkeypatch, sim)
    return line, line.attach(Meter(1, name="tank"))


def test_reading_one_register_returns_its_value_and_several_a_dict(meter: tuple[SimulatedBus, Meter]) -> None:
    line, tank = meter
    assert tank.read(tank.level) == tank.read("level") == 2.5
    sent = len(line.frames)
    assert tank.read("level", tank.flow) == {"level": 2.5, "flow": 7}
    assert len(line.frames) == sent + 1
    assert tank.read("flow", "level") == {"flow": 7, "level": 2.5}
    assert list(tank.read("flow", "level")) == ["flow", "level"]
    assert tank.read_many(["level"]) == {"level": 2.5}
    assert tank.read_all() == {"level": 2.5, "flow": 7, "door": False}


def test_names_are_planned_once(meter: tuple[SimulatedBus, Meter], monkeypatch: pytest.MonkeyPatch) -> None:
    _, tank = meter
    tank.read("level", "flow")
    monkeypatch.delattr(Drive, "register")
    assert tank.read("level", "flow") == {"level": 2.5, "flow": 7}


def test_texts_are_read_like_registers(meter: tuple[SimulatedBus, Meter]) -> None:
    _, tank = meter
    assert tank.read(tank.serial) == tank.read("serial") == "AB12"
    assert tank.read("serial", tank.level) == {"serial": "AB12", "level": 2.5}


def test_coils_and_discrete_inputs_are_bool(meter: tuple[SimulatedBus, Meter]) -> None:
    line, tank = meter
    line.sims[0]["door"] = 1
    assert tank.read("door") is True
    assert tank.read("door", "lamp", "flow") == {"door": True, "lamp": False, "flow": 7}
    assert tank.read("lamp", "door")["lamp"] is False
    assert tank.write("lamp", True) is True
    assert line.sims[0]["lamp"] == 1


def test_a_setting_is_written_by_its_name(meter: tuple[SimulatedBus, Meter]) -> None:
    line, tank = meter
    assert tank.write("limit", 6.5) == tank.read(tank.limit) == line.sims[0]["limit"] == 6.5
    with pytest.raises(ValueError, match="has no register 'limits'; did you mean limit"):
        tank.write("limits", 6.5)


def test_calls_of_a_drive_that_is_not_attached_raise_not_attached(monkeypatch: pytest.MonkeyPatch) -> None:
    pump = InnovertIBD(1, name="pump-1")
    sentence = r"^pump-1 is not attached to a bus: use bus\.attach\(\.\.\.\)$"
    for call in (
        lambda: pump.read("output_current"),
        lambda: pump.read("output_current", "output_frequency"),
        pump.read_all,
        lambda: pump.write("acceleration_time", 5.0),
        lambda: pump.read_raw(3, 0, 1),
        lambda: pump.send_raw(6, 0, b"\0\1"),
        pump.start,
    ):
        with pytest.raises(NotAttached, match=sentence):
            call()
    line, attached, _ = one(monkeypatch, InnovertIBD(1, name="pump-1"))
    line.bus.detach(attached)
    with pytest.raises(NotAttached, match="pump-1 is not attached to this bus"):
        attached.read("output_current")
