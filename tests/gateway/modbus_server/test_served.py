"""The gateway's Modbus server and its ports for PC tools, as set up by a plant file."""

from __future__ import annotations

import re
import socket
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
from gateways import Served, gateway_of, running, served
from lines import until
from modbus_gateway import RawClient, RawReply, plant_of, request
from modbus_tools import Libmodbus, Mbpoll, Minimalmodbus, Pymodbus
from tables import table, usually

from multidrop import Drive, InvtCHE, Plant, PlantError, load_family, reading, setting, text
from multidrop.control import read_audit
from multidrop.drive import COIL, HOLDING, Carrier
from multidrop.families import MODELS, InnovertIBD
from multidrop.families.registry import find_model
from multidrop.gateway.modbus_server import clients as modbus_clients
from multidrop.gateway.modbus_server import passed_requests as passing
from multidrop.gateway.modbus_server import words
from multidrop.gateway.modbus_server.protocol import ModbusCode
from multidrop.gateway.modbus_server.settings import MAIN, ModbusSettings, StopWrite, Unit, Units
from multidrop.gateway.settings import read_settings
from multidrop.plant.model import PolledDrive
from multidrop.sim import SimulatedDrive, Simulator, Wire, simulated

PLANT = """
[serve]
listen = "127.0.0.1:0"
audit = "audit.jsonl"
[serve.may]
write = ["mill.setpoint"]
[serve.modbus]
listen = "127.0.0.1:0"
may = "write"
units = {{ mill = 21 }}

[[line]]
name = "hall"
port = "{port}"
[[line.drive]]
name = "mill"
model = "invt-che"
address = 1
every = "50 ms"
poll = ["output_voltage", "status"]
"""
# CHE100 manual v1.4, p. 117
SETPOINT, CONTROL, OUTPUT_VOLTAGE, OUTPUT_CURRENT = 0x2000, 0x1000, 0x3003, 0x3004


@contextmanager
def simulated_plant(folder: Path) -> Iterator[tuple[SimulatedDrive, Path]]:
    drive = simulated(InvtCHE(1))
    with Simulator([Wire([drive], unpaced=True)]) as line:
        path = folder / "plant.toml"
        path.write_text(PLANT.format(port=line.wires[0].path))
        yield drive, path


def reply_to(client: RawClient, *words: int) -> RawReply:
    """Return the reply to a request. Repeats the request if the line is busy or a reply was lost."""
    found: list[RawReply] = []

    def ask() -> bool:
        found.append(client.ask(21, *words))
        return found[-1].code not in (6, 11)

    until(ask)
    return found[-1]


@pytest.mark.slow
def test_modbus_clients_can_read_change_and_stop_drives_of_a_plant_file(tmp_path: Path) -> None:
    with simulated_plant(tmp_path) as (drive, path), running(gateway := gateway_of(path)):
        drive["output_voltage"] = 231
        server: Any = gateway.feeds["modbus"]
        with RawClient(server.ports[""]) as client:
            until(lambda: reply_to(client, 3, OUTPUT_VOLTAGE, 1).words == [231])
            # read from the drive, because this register is not polled
            assert reply_to(client, 3, OUTPUT_CURRENT, 1).words == [0]
            assert reply_to(client, 6, SETPOINT, 5000).code is None
            assert reply_to(client, 3, SETPOINT, 1).words == [5000]
            assert reply_to(client, 6, CONTROL, 1).code == 3
            assert client.ask(21, 6, CONTROL, 5).code in (None, 5)
            until(lambda: ("control", 5) in [(one.name, one.raw) for one in drive.counters.writes])
            client.send(request(1, 0, 6, SETPOINT, 0))
            assert client.receive() is None
        sent = [(one.name, one.raw) for one in drive.counters.writes]
        assert ("setpoint", 5000) in sent
        # 5 stops the motor; if the reply to it is late, the gateway also sends 8, which ends a jog
        assert {raw for name, raw in sent if name == "control"} in ({5}, {5, 8})
    audit = list(read_audit(tmp_path / "audit.jsonl"))
    assert any("modbus from 127.0.0.1" in str(entry) and "setpoint" in str(entry) for entry in audit)


def test_a_tcp_port_in_use_is_reported_before_polling_starts(tmp_path: Path) -> None:
    with simulated_plant(tmp_path) as (drive, path), socket.create_server(("127.0.0.1", 0)) as taken:
        number = taken.getsockname()[1]
        path.write_text(path.read_text().replace(':0"\nmay', f':{number}"\nmay'))
        sentence = f"127.0.0.1:{number} cannot be opened: another program"
        with pytest.raises(ValueError, match=sentence), running(gateway_of(path)):
            pass
        assert drive.counters.requests == 0


def test_mistakes_in_the_modbus_settings_are_reported_with_their_place(tmp_path: Path) -> None:
    with simulated_plant(tmp_path) as (_, path):
        text = path.read_text()
        path.write_text(
            text.replace('may = "write"', 'may = "root"\npassing = 3').replace("mill = 21", "mil = 21")
        )
        with pytest.raises(PlantError) as mistakes:
            read_settings(Plant.load(path), {})
        shown = str(mistakes.value)
        assert "[serve.modbus]" in shown
        assert 'passing = 3 is not right; write passing = "declared"' in shown
        assert "may = 'root' is not one of look, stop, write" in shown
        path.write_text(text.replace("mill = 21", "mil = 21"))
        with pytest.raises(PlantError, match="units: there is no drive 'mil'; did you mean mill"):
            read_settings(Plant.load(path), {})


# ---- the table [serve.modbus]: its mistakes, and the clients that may connect ----


@table(
    ("settings", "sentence"),
    [
        ({"listen": "1502"}, '"1502" is not an address and port; write listen = "127.0.0.1:1502"'),
        ({"listen": "example.org:1502"}, "is open to other machines"),
        ({"listen": "127.0.0.1:70000"}, "is not an address and port"),
        ({"listen": "0.0.0.0:1502"}, "is open to other machines, and Modbus has no tokens"),
        ({"listen": "[::]:1502"}, "is open to other machines"),
        ({"passing": "all"}, "passing = 'all' is not one of off, declared, any"),
        ({"may": "root"}, "may = 'root' is not one of look, stop, write"),
        ({"units": {"pump": 0}}, "pump = 0 is not a unit id"),
        ({"units": {"pump": True}}, "pump = True is not a unit id"),
        ({"ports": {"hall": 1502}}, "hall = 1502 is in use by listen"),
        ({"ports": {"hall": "x"}}, "hall = 'x' is not a port"),
        ({"clients": ("10.0.0.0/33",)}, "'10.0.0.0/33' is neither an address nor a network"),
        ({"common": 0xFFF8}, "is not an address"),
    ],
)
def test_each_mistake_in_a_modbus_setting_is_reported(settings: dict[str, object], sentence: str) -> None:
    with pytest.raises(ValueError, match=r"^[\w\"]+") as mistake:
        ModbusSettings(**settings)  # type: ignore[arg-type]
    assert sentence in str(mistake.value)


def test_all_mistakes_in_the_modbus_settings_are_reported_together() -> None:
    with pytest.raises(ValueError, match="listen") as mistake:
        ModbusSettings(listen="x", passing="all", may="root", clients=("y",))
    assert len(str(mistake.value).splitlines()) == 4


def test_only_local_clients_may_connect_unless_others_are_listed() -> None:
    alone = ModbusSettings()
    assert [alone.may_connect(address) for address in ("127.0.0.1", "::1", "10.0.0.5")] == [True, True, False]
    named = ModbusSettings(listen="0.0.0.0:1502", clients=("10.0.0.0/24", "fe80::1"))
    for address, may in (
        ("10.0.0.5", True),
        ("::ffff:10.0.0.5", True),
        ("10.0.1.5", False),
        ("fe80::1%eth0", True),
        ("127.0.0.1", False),
    ):
        assert named.may_connect(address) is may


# ---- the documentation of the Modbus server: its plant files load, and its tables match the code ----


DOCS = Path(__file__).parents[3] / "docs"
PAGE = (DOCS / "gateway" / "modbus-server.md").read_text("utf-8")
REFERENCE = (DOCS / "reference" / "modbus-server.md").read_text("utf-8")
PLANTS = re.findall(r"```toml\n# ([\w-]+\.toml)\n(.*?)```", PAGE, re.DOTALL)


@table(("name", "text"), PLANTS, ids=[name for name, _ in PLANTS])
def test_example_plant_files_in_the_modbus_documentation_are_valid(
    tmp_path: Path, name: str, text: str
) -> None:
    path = tmp_path / name
    path.write_text(text)
    assert isinstance(read_settings(Plant.load(path), {}).parts["modbus"], ModbusSettings)


def rows(heading: str) -> dict[str, str]:
    table = REFERENCE.partition(f"## {heading}\n")[2].partition("\n## ")[0]
    found = (line.strip("| ").split(" | ", 1) for line in re.findall(r"^\|.*\|$", table, re.MULTILINE)[2:])
    return {name.strip("` "): rest for name, rest in found}


def test_each_modbus_setting_is_in_a_table_of_the_documentation() -> None:
    assert list(rows("`[serve.modbus]`")) == [one.name for one in fields(ModbusSettings)]
    for name, rest in rows("`[serve.modbus]`").items():
        default = getattr(ModbusSettings(), name)
        if name in ("listen", "passing", "may"):
            assert f'"{default}"' in rest


def test_each_exception_code_is_in_a_table_of_the_documentation() -> None:
    assert set(rows("Exceptions")) == {f"{code:02X}" for code in ModbusCode} | {"others"}


def test_common_modbus_registers_have_the_documented_layout() -> None:
    offsets = [int(address.rstrip("H"), 16) - ModbusSettings().common for address in rows("The common block")]
    layout = words
    assert offsets == [
        *(layout.STATE, layout.FAULT, layout.FREQUENCY, layout.CURRENT, layout.SETPOINT),
        *(layout.AGE, layout.STOP, layout.STOP + 1),
    ]
    sizes = [int(rest.split(" | ")[0]) for rest in rows("The common block").values()]
    assert sum(sizes) == words.COMMON_LENGTH
    states = re.findall(r"(\d) (\w+)", next(iter(rows("The common block").values())).partition("state: ")[2])
    assert {name: int(number) for number, name in states} == words.STATES


def test_limits_of_modbus_clients_agree_with_the_documentation() -> None:
    text = REFERENCE.partition("## Clients")[2]
    numbers = [int(number) for number in re.findall(r"\d+", text)]
    assert numbers == [
        *(modbus_clients.IDLE_S, modbus_clients.STALLED_S),
        *(modbus_clients.MOST_CLIENTS, modbus_clients.FORGETTABLE_S, modbus_clients.MOST_UNDER_WAY),
        *(passing.MOST_WAITING, modbus_clients.MOST_BEHIND // 1024, 6, modbus_clients.MOST_UNTAKEN // 1024),
    ]


# ---- unit ids: a drive's address if it is unique; all clashes are reported at once ----


FAMILIES = Path(__file__).parents[3] / "src" / "multidrop" / "families" / "shipped"


def numbers(units: Units) -> dict[tuple[str, int], str]:
    return {(port, number): unit.drive.name for port, number, unit in units}


def test_the_unit_id_of_a_drive_is_its_address_by_default() -> None:
    units = Units(
        plant_of(("hall", InnovertIBD(1, name="pump")), ("yard", InvtCHE(9, name="mill"))), ModbusSettings()
    )
    assert numbers(units) == {(MAIN, 1): "pump", (MAIN, 9): "mill"}
    found = units.find(MAIN, 9)
    assert found is not None
    assert (found.drive.name, found.line) == ("mill", "yard")
    assert units.find(MAIN, 2) is None
    assert units.find("yard", 9) is None


def test_all_clashing_unit_ids_are_reported_with_free_unit_ids() -> None:
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


def test_a_configured_unit_id_or_port_avoids_a_clash_of_unit_ids() -> None:
    plant = plant_of(("hall", InnovertIBD(1, name="pump")), ("yard", InvtCHE(1, name="mill")))
    assert numbers(Units(plant, ModbusSettings(units={"mill": 21}))) == {
        (MAIN, 1): "pump",
        (MAIN, 21): "mill",
    }
    own = Units(plant, ModbusSettings(ports={"yard": 1503}))
    assert numbers(own) == {(MAIN, 1): "pump", ("yard", 1): "mill"}


def test_a_configured_unit_id_that_clashes_is_reported() -> None:
    plant = plant_of(("hall", InnovertIBD(1, name="pump")), ("yard", InvtCHE(9, name="mill")))
    with pytest.raises(ValueError, match=r"unit 1 would be pump .* and mill"):
        Units(plant, ModbusSettings(units={"mill": 1}))


def test_unknown_drives_and_lines_in_the_modbus_settings_are_reported() -> None:
    plant = plant_of(("hall", InnovertIBD(1, name="pump")))
    with pytest.raises(ValueError, match="units: there is no drive 'pumb'") as mistake:
        Units(plant, ModbusSettings(units={"pumb": 3}, ports={"hal": 1503}))
    assert str(mistake.value).splitlines()[1].endswith("there is no line 'hal'; did you mean hall?")


def test_address_0_is_reported_as_an_invalid_unit_id() -> None:
    class Behind(Drive):
        addresses = range(256)
        level = reading(0, "m")

    with pytest.raises(ValueError, match=r"meter \(line net\) cannot be unit 0, but 1 to 255"):
        Units(plant_of(("net", Behind(0, name="meter", framing="tcp"))), ModbusSettings())
    assert numbers(Units(plant_of(("net", Behind(255, name="meter", framing="tcp"))), ModbusSettings())) == {
        (MAIN, 255): "meter"
    }


def test_a_drive_register_at_an_address_of_common_registers_is_reported() -> None:
    class Parameters(Drive):
        frequency_source = setting(0xF003)

    plant = plant_of(("hall", Parameters(1, name="pump")))
    with pytest.raises(ValueError, match="pump has registers at F003H, in the range of the common block"):
        Units(plant, ModbusSettings())
    Units(plant, ModbusSettings(common=0xE000))


def test_no_drive_family_uses_the_addresses_of_the_common_registers() -> None:
    families = [find_model(name) for name in MODELS] + [load_family(path) for path in FAMILIES.glob("*.toml")]
    assert len(families) > 10
    common = set(ModbusSettings().common_addresses)
    for family in families:
        unit = Unit("hall", PolledDrive(family(family.addresses[0]), ()))
        assert not unit.holding_addresses() & common


@table(
    ("model", "register", "raw"),
    [  # values of the control register that stop, as printed in the manuals
        ("erman-er-g-220", "stop_coil", 1),
        ("invt-che", "control", 5),
        ("invt-che", "control", 6),  # coast
        ("innovert-ibd", "control", 1),
        ("delixi-modbus", "control", 1),
        ("invt-che", "control", 8),  # jog stop
        ("yd1000", "control", 0xC000),
        ("yd1000", "control", 0x8000),  # manual section 8.1
        ("optidrive-e3", "control", 0),
        ("delta-ms300", "control", 1),
    ],
)
def test_the_stop_values_of_each_drive_family_are_known(model: str, register: str, raw: int) -> None:
    unit = Unit("hall", PolledDrive(find_model(model)(1), ()))
    assert StopWrite(register, raw) in unit.stops


def test_the_control_value_for_no_command_is_not_a_stop() -> None:
    unit = Unit("hall", PolledDrive(InnovertIBD(1), ()))
    assert unit.stops == {StopWrite("control", 1)}  # not 0, which means "no command"


def test_declared_addresses_include_registers_texts_and_readable_gaps() -> None:
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


# ---- mbpoll, libmodbus, pymodbus and minimalmodbus on a tool port, which imitates a polled line ----

START, STOP = 1, 5
VOLTAGE = 231
TOOLS = {  # the tools, made from the path of the serial port, the TCP port and a folder for programs
    "mbpoll": lambda path, tcp, built: Mbpoll(path, "-m", "rtu", "-b", "19200"),
    "libmodbus": lambda path, tcp, built: Libmodbus(path, built),
    "pymodbus": lambda path, tcp, built: Pymodbus(path),
    "pymodbus tcp": lambda path, tcp, built: Pymodbus(tcp),
    "minimalmodbus": lambda path, tcp, built: Minimalmodbus(path),
}
SERVE = """
[serve]
audit = "audit.jsonl"
[serve.may]
write = ["pump-1.setpoint", "pump-1.control"]
verbs = ["pump-1.start"]
[serve.tool]
pty = { hall = "hall" }
rtu = { hall = "127.0.0.1:0" }
timeout = 9
"""


@contextmanager
def connected(name: str, folder: Path, serve: str) -> Iterator[tuple[Served, Any]]:
    """Yield a gateway with polled drives, and a tool that is connected to its tool port."""
    with ExitStack() as stack:
        gateway = stack.enter_context(served(folder, serve))
        gateway.sims["pump-1"]["output_voltage"] = VOLTAGE
        gateway.await_state("pump-1", "stands")
        ports = gateway.gateway.feeds["tool"]
        tcp = ports.ports["hall"]  # type: ignore[attr-defined]
        yield gateway, stack.enter_context(closing(TOOLS[name](str(folder / "hall"), tcp, folder)))


def read(tool: Any, start: int, count: int) -> list[int]:
    """Return words of pump-1. Repeats the request if a busy machine loses the reply."""
    found: list[list[int] | int] = []
    until(lambda: (found.append(tool.read(1, 3, start, count)), isinstance(found[-1], list))[1])
    assert isinstance(found[-1], list)
    return found[-1]


def writes(tool: Any, address: int, value: int) -> bool:
    """Write a word of pump-1; return True if the write was confirmed."""
    return bool(tool.write(1, 6, address, value) == 0)


@pytest.mark.slow
@pytest.mark.parametrize("name", usually(*TOOLS))
def test_each_known_modbus_tool_can_only_read_by_default(name: str, tmp_path: Path) -> None:
    with connected(name, tmp_path, SERVE) as (gateway, tool):
        sim, polled = gateway.sims["pump-1"], gateway.gateway.poller.statistics()  # type: ignore[union-attr]
        assert read(tool, OUTPUT_VOLTAGE, 2) == [VOLTAGE, 0]
        for value in range(500, 520):
            sim["output_voltage"] = value
            assert read(tool, OUTPUT_VOLTAGE, 1) == [value]
        before = len(sim.counters.writes)
        assert not writes(tool, CONTROL, START)
        assert not writes(tool, SETPOINT, 1000)
        assert len(sim.counters.writes) == before
        until(lambda: gateway.gateway.poller.statistics() != polled)  # type: ignore[union-attr]
        until(lambda: [each for each in read_audit(tmp_path / "audit.jsonl") if each["outcome"] == "refused"])
    refused = [each for each in read_audit(tmp_path / "audit.jsonl") if each["outcome"] == "refused"]
    assert "01 06 10 00 00 01" in refused[0]["write"]
    assert refused[0]["way"].startswith("tool from")


@pytest.mark.slow
@pytest.mark.parametrize("name", usually(*TOOLS))
def test_each_known_modbus_tool_can_stop_but_not_start_a_drive(name: str, tmp_path: Path) -> None:
    with connected(name, tmp_path, SERVE.replace("[serve.tool]", '[serve.tool]\nmay = "write"')) as (
        gateway,
        tool,
    ):
        sim = gateway.sims["pump-1"]
        until(lambda: writes(tool, SETPOINT, 5000))
        assert read(tool, SETPOINT, 1) == [5000]
        assert not writes(tool, CONTROL, START)
        writes(tool, CONTROL, STOP)
        until(lambda: ("control", STOP) in [(each.name, each.raw) for each in sim.counters.writes])
        assert {each.raw for each in sim.counters.writes if each.name == "control"} == {STOP}
