"""Read parameters in blocks, and compare parameter sets."""

from __future__ import annotations

from typing import ClassVar

import pytest
from simulated_bus import SimulatedBus, one

from multidrop import YD1000, DelixiModbus, DelixiNative, Drive, InvtCHE, NoReply, Unsupported, params
from multidrop.core import Message
from multidrop.drive.parameters import ParameterGroup, ParameterSpace, parameters_of
from multidrop.drive.register import HOLDING
from multidrop.sim import SimulatedDrive


class Blocky(Drive):
    """A drive with two groups of parameters that can be read in blocks."""

    model = "blocky"
    parameter_space = ParameterSpace(
        groups=(ParameterGroup("P00.", 0x0000, range(16)), ParameterGroup("P01.", 0x0100, range(16)))
    )


CODES = [*parameters_of(Blocky)]


class Limited(SimulatedDrive):
    """A simulated drive that refuses reads of more than `longest` registers."""

    longest = 16

    def read(self, function: int, start: int, count: int) -> list[int]:
        self.most = {3: self.longest}
        return super().read(function, start, count)


def blocky(
    monkeypatch: pytest.MonkeyPatch, missing: set[str], longest: int = 16
) -> tuple[SimulatedBus, Drive]:
    sim = Limited(Blocky(1))
    sim.longest = longest
    for number, (code, parameter) in enumerate(parameters_of(Blocky).items()):
        if code not in missing:
            sim.memory.declare(parameter)
            sim.memory.set_raw(parameter, number)
    line = SimulatedBus(monkeypatch, sim)
    return line, line.attach(sim.drive)


def counts(line: SimulatedBus) -> list[int]:
    return [request.count for request, _ in line.frames]


def test_parameters_are_read_in_few_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive = blocky(monkeypatch, set())
    assert dict(params.read(drive).values) == {code: number for number, code in enumerate(CODES)}
    assert counts(line) == [16, 16]


def test_refused_block_does_not_prevent_reading_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive = blocky(monkeypatch, {"P00.05"})
    assert set(params.read(drive).values) == {*CODES} - {"P00.05"}
    assert counts(line) == [16, 8, 4, 4, 2, 1, 1, 2, 8, 16]


def test_longest_accepted_block_length_is_learnt(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive = blocky(monkeypatch, set(), longest=8)
    assert len(params.read(drive).values) == 32
    assert counts(line) == [16, 8, 8, 8, 8]


def test_read_with_codes_reads_only_these_parameters(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive = blocky(monkeypatch, set())
    assert dict(params.read(drive, ["P01.02"]).values) == {"P01.02": 18}
    assert counts(line) == [1]
    with pytest.raises(ValueError, match=r"has no parameter P09\.00"):
        params.read(drive, ["P09.00"])


def test_group_without_replies_is_abandoned(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, _ = one(monkeypatch, DelixiModbus(1))
    found = params.read(drive).values
    assert [*found] == ["P00.00", "P00.01", "P00.02", "P04.28", "P04.29", "P04.30"]
    assert len(line.frames) < 5 * 10 * 8


def test_silent_drive_raises_no_reply(monkeypatch: pytest.MonkeyPatch) -> None:
    line, drive, _ = one(monkeypatch, DelixiNative(1))
    asked: list[Message] = []
    line.deafens = lambda request: bool(asked.append(request)) or len(asked) > 20
    with pytest.raises(NoReply):
        params.read(drive)


def test_family_without_an_address_rule_raises_unsupported(monkeypatch: pytest.MonkeyPatch) -> None:
    _, drive, _ = one(monkeypatch, InvtCHE(1))
    with pytest.raises(Unsupported, match="follow no known rule"):
        params.read(drive)


def test_differences_show_names_and_units() -> None:
    first = params.ParameterSet("yd1000", {"0009": 100, "F240": 5}, source="a")
    second = params.ParameterSet("yd1000", {"0009": 150, "F240": 5, "F241": 1}, source="b")
    assert params.compare(first, second, YD1000) == [
        params.Difference("0009", "acceleration_time", 100, 150, "10.0 s", "15.0 s"),
        params.Difference("F241", "", None, 1, "-", "1"),
    ]
    assert params.compare(first, first, YD1000) == []


def test_factory_values_are_those_of_the_manual() -> None:
    assert params.defaults(YD1000).values["0011"] == 8000
    with pytest.raises(Unsupported, match="prints no factory values"):
        params.defaults(DelixiModbus)


def test_monitors_are_not_listed_as_parameters() -> None:
    assert not any(code.startswith("P05.") for code in parameters_of(DelixiModbus))


def test_declared_parameters_are_stored_despite_a_ram_address() -> None:
    from multidrop.drive.register import Kept, setting

    class WithAlias(Drive):
        parameter_space: ClassVar[ParameterSpace] = ParameterSpace(groups=(ParameterGroup("P", 0, range(2)),))
        ramp = setting(0x0001, "s", step=0.1, ram_address=0x8001)

    ramp = parameters_of(WithAlias)["P01"]
    assert (ramp.name, ramp.ram_address, ramp.kept, ramp.table) == ("ramp", None, Kept.EEPROM, HOLDING)
