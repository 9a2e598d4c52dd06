"""Unit ids: a drive's address if it is unique; all clashes are reported at once."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest
from modbus_gateway import plant_of
from tables import table

from multidrop import Drive, load_family, reading, setting, text
from multidrop.drive import COIL, HOLDING, Carrier
from multidrop.families import MODELS, InnovertIBD, InvtCHE
from multidrop.families.registry import find_model
from multidrop.gateway.modbus_server.settings import ModbusSettings
from multidrop.gateway.modbus_server.unit_ids import MAIN, StopWrite, Unit, Units
from multidrop.plant.model import PolledDrive

FAMILIES = Path(__file__).parents[3] / "src" / "multidrop" / "families" / "shipped"


def numbers(units: Units) -> dict[tuple[str, int], str]:
    return {(port, number): unit.drive.name for port, number, unit in units}


def test_unit_id_is_the_drives_address() -> None:
    units = Units(
        plant_of(("hall", InnovertIBD(1, name="pump")), ("yard", InvtCHE(9, name="mill"))), ModbusSettings()
    )
    assert numbers(units) == {(MAIN, 1): "pump", (MAIN, 9): "mill"}
    found = units.find(MAIN, 9)
    assert found is not None
    assert (found.drive.name, found.line) == ("mill", "yard")
    assert units.find(MAIN, 2) is None
    assert units.find("yard", 9) is None


def test_all_clashing_unit_ids_are_reported_with_the_free_ones() -> None:
    plant = plant_of(
        ("hall", InnovertIBD(1, name="pump")),
        ("hall", InnovertIBD(2, name="fan")),
        ("yard", InvtCHE(1, name="mill")),
        ("yard", InvtCHE(2, name="saw")),
        ("yard", InvtCHE(5, name="belt")),
    )
    with pytest.raises(ValueError, match="unit 1 would be") as mistake:
        Units(plant, ModbusSettings())
    first, second, last = str(mistake.value).splitlines()
    assert first == "unit 1 would be pump (line hall) and mill (line yard)"
    assert second == "unit 2 would be fan (line hall) and saw (line yard)"
    assert 'such as units = { "mill" = 3 }' in last
    assert last.endswith("free numbers: 3 to 4, 6 to 247")


def test_configured_unit_id_or_port_resolves_a_clash() -> None:
    plant = plant_of(("hall", InnovertIBD(1, name="pump")), ("yard", InvtCHE(1, name="mill")))
    assert numbers(Units(plant, ModbusSettings(units={"mill": 21}))) == {
        (MAIN, 1): "pump",
        (MAIN, 21): "mill",
    }
    own = Units(plant, ModbusSettings(ports={"yard": 1503}))
    assert numbers(own) == {(MAIN, 1): "pump", ("yard", 1): "mill"}


def test_configured_unit_id_that_clashes_is_reported() -> None:
    plant = plant_of(("hall", InnovertIBD(1, name="pump")), ("yard", InvtCHE(9, name="mill")))
    with pytest.raises(ValueError, match=r"unit 1 would be pump .* and mill"):
        Units(plant, ModbusSettings(units={"mill": 1}))


def test_unknown_drives_and_lines_in_the_settings_are_reported() -> None:
    plant = plant_of(("hall", InnovertIBD(1, name="pump")))
    with pytest.raises(ValueError, match="units: there is no drive 'pumb'") as mistake:
        Units(plant, ModbusSettings(units={"pumb": 3}, ports={"hal": 1503}))
    assert str(mistake.value).splitlines()[1].endswith("there is no line 'hal'; did you mean hall?")


def test_drive_with_address_0_cannot_be_a_unit() -> None:
    class Behind(Drive):
        addresses = range(256)
        level = reading(0, "m")

    with pytest.raises(ValueError, match=r"meter \(line net\) cannot be unit 0, but 1 to 255"):
        Units(plant_of(("net", Behind(0, name="meter", framing="tcp"))), ModbusSettings())
    assert numbers(Units(plant_of(("net", Behind(255, name="meter", framing="tcp"))), ModbusSettings())) == {
        (MAIN, 255): "meter"
    }


def test_common_block_must_not_overlap_registers() -> None:
    class Parameters(Drive):
        frequency_source = setting(0xF003)

    plant = plant_of(("hall", Parameters(1, name="pump")))
    with pytest.raises(ValueError, match="pump has registers at F003H, in the range of the common block"):
        Units(plant, ModbusSettings())
    Units(plant, ModbusSettings(common=0xE000))


def test_no_family_has_registers_in_the_range_of_the_common_block() -> None:
    families = [find_model(name) for name in MODELS] + [load_family(path) for path in FAMILIES.glob("*.toml")]
    assert len(families) > 10
    common = set(ModbusSettings().common_addresses)
    for family in families:
        unit = Unit("hall", PolledDrive(family(family.addresses[0]), ()))
        assert not unit.holding_addresses() & common


# ---- units ----


@dataclass(frozen=True)
class Stop:
    model: str
    register: str
    raw: int


@table(
    "stop",
    [  # stop commands as the manuals print them
        Stop("erman-er-g-220", "stop_coil", 1),
        Stop("invt-che", "control", 5),
        Stop("invt-che", "control", 6),  # coast
        Stop("innovert-ibd", "control", 1),
        Stop("delixi-modbus", "control", 1),
        Stop("invt-che", "control", 8),  # jog stop
        Stop("yd1000", "control", 0xC000),
        Stop("yd1000", "control", 0x8000),  # manual section 8.1
        Stop("optidrive-e3", "control", 0),
        Stop("delta-ms300", "control", 1),
    ],
)
def test_unit_has_the_stop_writes_of_its_family(stop: Stop) -> None:
    family = find_model(stop.model)
    unit = Unit("hall", PolledDrive(family(1), ()))
    assert StopWrite(stop.register, stop.raw) in unit.stops


def test_raw_value_without_effect_is_not_a_stop() -> None:
    unit = Unit("hall", PolledDrive(InnovertIBD(1), ()))
    assert unit.stops == {StopWrite("control", 1)}  # and not 0, "no command"


def test_declared_addresses_are_registers_texts_and_gaps() -> None:
    class Meter(Drive):
        readable_gaps = {HOLDING: range(10, 20)}
        level = reading(9, "m")
        relay = setting(3, table=COIL)
        serial = text(20, 4)

    unit = Unit("hall", PolledDrive(Meter(1), ()))
    assert unit.is_declared(3, range(9, 24))
    assert not unit.is_declared(3, range(9, 25))
    assert not unit.is_declared(4, range(9, 10))
    assert unit.is_declared(1, range(3, 4))
    assert not unit.is_declared(2, range(3, 4))
    assert unit.writable(Carrier.BIT, 3) is Meter.relay
    assert unit.writable(Carrier.WORD, 9) is None
    assert unit.writable(Carrier.WORD, 3) is None


def test_settings_that_do_not_fit_the_plant_are_reported() -> None:
    plant = plant_of(("hall", InnovertIBD(1, name="pump")), ("yard", InvtCHE(1, name="mill")))
    first, _ = ModbusSettings().check(plant)
    assert first == "unit 1 would be pump (line hall) and mill (line yard)"
    assert ModbusSettings(units={"mill": 2}).check(plant) == []
