"""The Modbus address map: masters that know only its rows read the same values as /api/frame."""

from __future__ import annotations

import csv
import io
import json
import math
import random
import struct
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import pytest
from gateways import gateway_of, running
from lines import until
from modbus_tools import Libmodbus, Mbpoll, Pymodbus, PyModbusTcp
from tables import usually

from multidrop import Plant
from multidrop.cli import main
from multidrop.gateway.modbus_server import address_map
from multidrop.sim import SimulatedDrive, Simulator, Wire

FAMILY = """
[family]
title = "Mixed formats"
manual = "of this test"
counts_from = 0
[reading]
word = { at = 0, unit = "A", step = 0.1, offset = -5 }
signed = { at = 1, unit = "%", number_format = "I16" }
swapped = { at = 2, number_format = "U16", order = "BA" }
long = { at = 3, unit = "kWh", number_format = "U32", order = "CDAB", step = 0.01 }
negative = { at = 5, number_format = "I32", order = "DCBA", invalid = [2147483647] }
single = { at = 7, unit = "bar", number_format = "F32", order = "BADC" }
double = { at = 9, number_format = "F64", order = "CDAB" }
huge = { at = 13, number_format = "U64" }
digits = { at = 17, number_format = "BCD32" }
low = { at = 19, part = "0-3" }
high = { at = 19, part = "4-15", number_format = "I16" }
scaled = { at = 20, unit = "W", scale_register = "power_of_ten" }
power_of_ten = { at = 21, number_format = "I16" }
byte = { at = 22, number_format = "I8" }
input = { at = 0, unit = "V", table = "input", number_format = "F16" }
lamp = { at = 4, table = "coil" }
door = { at = 5, table = "discrete" }
[text]
serial = { at = 0x30, length = 4, order = "BA" }
"""
PLANT = """
[serve]
listen = "127.0.0.1:0"
[serve.may]
write = ["mill.setpoint"]
[serve.modbus]
listen = "127.0.0.1:0"
ports = {{ yard = 0 }}
units = {{ meter = 21 }}
may = "write"
passing = "{passing}"

[[line]]
name = "hall"
port = "{hall}"
[[line.drive]]
name = "mill"
model = "invt-che"
address = 1
every = "50 ms"
poll = ["status", "output_frequency", "output_current", "output_torque", "fault"]
[[line.drive.channel]]
name = "half"
value = "output_frequency / 2"
unit = "Hz"

[[line]]
name = "yard"
port = "{yard}"
[[line.drive]]
name = "meter"
model = "mixed.toml"
address = 1
every = "50 ms"
"""
STRUCT = {"u16": "H", "i16": "h", "u32": "I", "i32": "i", "u64": "Q", "f16": "e", "f32": "f", "f64": "d"}
# addresses of the drive "mill", and the word that stops it (CHE100 manual v1.4, p. 117)
SETPOINT, CONTROL, OUTPUT_VOLTAGE, STOP = 0x2000, 0x1000, 0x3003, 5
MASTERS: dict[str, Callable[[int, Path], Any]] = {
    "pymodbus": lambda port, built: Pymodbus(port, "SOCKET"),
    "mbpoll": lambda port, built: Mbpoll("127.0.0.1", "-m", "tcp", "-p", str(port)),
    "libmodbus": lambda port, built: Libmodbus(port, Path(mkdtemp(dir=built))),
    "pyModbusTCP": lambda port, built: PyModbusTcp(port),
}


class Client:
    """A Modbus master by another author on each TCP port of the map. It knows only the rows of the map."""

    def __init__(self, master: str, folder: Path) -> None:
        self._master, self._folder = master, folder
        self._masters: dict[int, Any] = {}
        self._opened = ExitStack()

    def close(self) -> None:
        self._opened.close()

    def of(self, row: dict[str, Any]) -> Any:
        """Return the master on the port of a row."""
        port = row["tcp_port"]
        if port not in self._masters:
            made = MASTERS[self._master](port, self._folder)
            self._masters[port] = self._opened.enter_context(closing(made))
        return self._masters[port]

    def words(self, row: dict[str, Any], function: int, address: int, count: int) -> list[int] | int:
        """Return the words or bits at an address of the row's unit id, or an exception code."""
        found: list[list[int] | int] = []

        def read() -> bool:
            found.append(self.of(row).read(row["unit_id"], function, address, count))
            return found[-1] not in (6, 11)  # 6: bus time used up, 11: reply lost on a busy machine

        until(read)
        return found[-1]

    def write(self, row: dict[str, Any]) -> int:
        """Write to a row the value that it has now; return 0 or an exception code."""
        words = self.words(row, row["function"], row["address"], row["words"])
        assert isinstance(words, list)
        return int(
            self.of(row).write(row["unit_id"], 5 if row["function"] == 1 else 16, row["address"], *words)
        )

    def number(self, row: dict[str, Any]) -> float:
        """Return the value of a row, in the unit of measurement of the row."""
        words = self.words(row, row["function"], row["address"], row["words"])
        assert isinstance(words, list), (row["name"], words)
        if row["format"] == "bit":
            return float(words[0])
        data = struct.pack(f">{len(words)}H", *words)
        found = decoded(bytes(byte for _, byte in sorted(zip(row["order"], data, strict=True))), row)
        power = 0
        if row["scale_address"] is not None:
            (word,) = self.words(row, row["function"], row["scale_address"], 1)  # type: ignore[misc]
            power = word - (word >> 15 << 16)
        return float(found * 10.0**power * row["step"] + row["offset"])


def decoded(data: bytes, row: dict[str, Any]) -> float:
    """Decode the bytes of a row, most significant byte first."""
    if row["format"].startswith("bcd"):
        return int(data.hex())
    if row["bits"]:
        low, high = map(int, row["bits"].split(" to "))
        part = int.from_bytes(data) >> low & ((1 << high - low + 1) - 1)
        return part - (part >> high - low << high - low + 1) * row["format"].startswith("i")
    (number,) = struct.unpack(f">{STRUCT[row['format']]}", data)
    return float(number)


@contextmanager
def served(folder: Path, passing: str = "declared") -> Iterator[tuple[Any, SimulatedDrive]]:
    """Run a gateway with two simulated drives whose registers hold random words; yield also "mill"."""
    (folder / "mixed.toml").write_text(FAMILY)
    path = folder / "plant.toml"
    path.write_text(PLANT.format(passing=passing, hall="/dev/a", yard="/dev/b"))
    chance, drives = random.Random(43), []
    for line in Plant.load(path).lines:
        drive = SimulatedDrive(line.drives[0].drive)
        for register in drive.drive.registers.values():
            for cell in drive.memory.of(register):
                # Use decimal digits only: then the word is also valid as BCD, and no float is infinite.
                cell.raw = (
                    chance.randint(0, 1) if register.is_bit else int(f"{chance.randint(1, 9999):d}", 16)
                )
        drives.append(drive)
    drives[0]["device"], drives[0]["status"], drives[0]["setpoint"] = 0x0101, 3, 50  # 3: the motor stands
    drives[1]["power_of_ten"] = -2
    drives[1]["huge"] = (1 << 53) - 1  # the largest integer that a row, which has a float, can hold exactly
    with Simulator([Wire([one], unpaced=True) for one in drives]) as simulator:
        hall, yard = (wire.path for wire in simulator.wires)
        path.write_text(PLANT.format(passing=passing, hall=hall, yard=yard))
        with running(gateway := gateway_of(path)):
            until(lambda: all(gateway.hub.last_answer(name) for name in ("mill", "meter")))
            yield gateway, drives[0]


def get(gateway: Any, path: str) -> Any:
    with urllib.request.urlopen(f"http://127.0.0.1:{gateway.port}{path}") as answer:
        text = answer.read().decode()
        return json.loads(text) if "json" in answer.headers["content-type"] else text


@pytest.mark.slow
@pytest.mark.parametrize(
    ("passing", "master"), [("off", "pymodbus"), *usually(*(("declared", name) for name in MASTERS))]
)
def test_modbus_values_at_mapped_addresses_equal_those_of_the_web_page(
    tmp_path: Path, passing: str, master: str
) -> None:
    with served(tmp_path, passing) as (gateway, _), closing(Client(master, tmp_path)) as client:
        rows = get(gateway, "/api/modbus-map")
        until(lambda: None not in [one[0] for drive in values(gateway).values() for one in drive.values()])
        shown = values(gateway)
        read = [row for row in rows if "read" in row["access"] and row["format"] != "text"]
        names = {(row["drive"], row["name"]) for row in read}
        uncertain = {("meter", name) for name in ("low", "high", "scaled", "byte")}
        polled = {(drive, name) for drive, found in shown.items() for name in found}
        assert polled - names == (uncertain if passing == "off" else set())
        assert (("mill", "output_voltage") in names) is (passing == "declared")

        def wrong() -> list[str]:
            """Return the names of rows whose values differ from the web page; a cached value may be old."""
            pairs = [(row, shown[row["drive"]].get(row["name"])) for row in read]
            return [
                row["name"]
                for row, value in pairs
                if value and not math.isclose(client.number(row), value[0], rel_tol=1e-6)
            ]

        until(lambda: wrong() == [])
        check_common_block(rows, shown["mill"], client)
        texts = [row for row in rows if row["format"] == "text"]
        assert [row["name"] for row in texts] == (["serial"] if passing == "declared" else [])
        if passing == "off":
            assert client.words(rows[0], 3, OUTPUT_VOLTAGE, 1) == 2
            assert client.words(read[-1], 3, 19, 1) == 2


def values(gateway: Any) -> dict[str, dict[str, list[Any]]]:
    """Return the values on the web page by drive and register. Each is a list that starts with the number."""
    drives = get(gateway, "/api/frame")["drives"]
    return {name: drive["values"] for name, drive in drives.items()}


def check_common_block(rows: list[dict[str, Any]], shown: dict[str, list[Any]], client: Client) -> None:
    common = {row["name"]: row for row in rows if row["drive"] == "mill" and row["source"] == "gateway"}
    assert client.number(common["common_frequency"]) == pytest.approx(shown["output_frequency"][0])
    assert client.number(common["common_current"]) == pytest.approx(shown["output_current"][0])
    assert client.number(common["half"]) == pytest.approx(shown["output_frequency"][0] / 2, rel=1e-6)
    state = client.number(common["common_state"])
    assert {row["status_address"] for row in rows} == {common["common_state"]["address"]}
    assert f"{state:g} " in common["common_state"]["note"]
    unknown = client.words(common["common_setpoint"], 3, common["common_setpoint"]["address"], 2)
    assert isinstance(unknown, list)
    assert "{:04X}{:04X}H".format(*unknown) == common["common_setpoint"]["unknown"]


@pytest.mark.slow
def test_clients_can_write_only_rows_marked_writable_in_the_address_map(tmp_path: Path) -> None:
    with served(tmp_path) as (gateway, _), closing(Client("pymodbus", tmp_path)) as client:
        rows = get(gateway, "/api/modbus-map")
        assert [row["name"] for row in rows if "write" in row["access"]] == [
            *("common_stop", "setpoint", "common_stop")
        ]
        known = [row for row in rows if row["function"] in (1, 3) and row["format"] != "text"]
        refused = [row for row in known if client.write(row)]
        assert [row["name"] for row in known if row not in refused] == ["setpoint"]


@pytest.mark.slow
@pytest.mark.parametrize("master", usually(*MASTERS))
def test_each_modbus_master_can_write_a_register_and_stop_a_drive(tmp_path: Path, master: str) -> None:
    with served(tmp_path) as (gateway, drive), closing(Client(master, tmp_path)) as client:
        rows = get(gateway, "/api/modbus-map")
        row = next(row for row in rows if row["drive"] == "mill")
        unit, stop = row["unit_id"], next(row for row in rows if row["name"] == "common_stop")["address"]

        def write(address: int, value: int) -> int:
            return int(client.of(row).write(unit, 6, address, value))

        until(lambda: write(SETPOINT, 3000) == 0)
        assert client.words(row, 3, SETPOINT, 1) == [3000]
        assert write(SETPOINT, 60000) == 3  # above the register's range
        assert write(CONTROL, 1) == 3  # FORWARD
        assert write(OUTPUT_VOLTAGE, 1) == 2  # the register is read-only
        assert client.of(row).read(99, 3, 0, 1) == 10
        for address, value in ((CONTROL, STOP), (stop, 1)):
            drive.counters.writes.clear()
            assert write(address, value) in (0, 5)  # 0: confirmed, 5: acknowledged and still in progress
            until(lambda: [(one.name, one.raw) for one in drive.counters.writes][-1:] == [("control", STOP)])


@pytest.mark.slow
def test_http_and_cli_give_the_same_address_map(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with served(tmp_path) as (gateway, _):
        rows = get(gateway, "/api/modbus-map")
        listed = [*csv.DictReader(io.StringIO(get(gateway, "/api/modbus-map?format=csv")))]
        with pytest.raises(urllib.error.HTTPError, match="400"):
            get(gateway, "/api/modbus-map?format=xml")
    as_text = [{key: "" if value is None else str(value) for key, value in row.items()} for row in rows]
    assert listed == as_text
    plant, path = str(tmp_path / "plant.toml"), tmp_path / "map.json"
    assert main(["serve", plant, "--modbus-map", str(path)]) == 0
    assert capsys.readouterr().out == f"{path}: {len(rows)} values of 2 drives\n"
    assert json.loads(path.read_text()) == [{**row, "tcp_port": 0} for row in rows]
    assert main(["serve", plant, "--modbus-map", str(path)]) == 2
    assert main(["serve", plant, "--modbus-map", "map.xls"]) == 2
    assert "map.xls: the name of an address map must end in .csv or .json" in capsys.readouterr().err


def test_the_address_map_lists_invalid_values_and_bits_of_registers(tmp_path: Path) -> None:
    (tmp_path / "mixed.toml").write_text(FAMILY)
    (tmp_path / "plant.toml").write_text(PLANT.format(passing="declared", hall="/dev/a", yard="/dev/b"))
    assert main(["serve", str(tmp_path / "plant.toml"), "--modbus-map", str(tmp_path / "map.json")]) == 0
    rows = {row["name"]: row for row in json.loads((tmp_path / "map.json").read_text())}
    assert rows["negative"]["unknown"] == "exception 0BH or 2147483647"
    assert (rows["byte"]["format"], rows["byte"]["bits"]) == ("i8", "0 to 7")


def test_rows_of_the_json_address_map_are_encoded_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """One call of json.dumps for all rows would block all other threads until it ends."""
    encoded: list[Any] = []

    def dumps(row: Any, **_: Any) -> str:
        encoded.append(row)
        return "{}"

    monkeypatch.setattr("json.dumps", dumps)
    row = address_map.AddressRow("a", "b", 502, 1, 0, "n", "n", "read", 3, None, 0, 1, "u16")
    assert json.loads(address_map.to_json([row] * 3)) == [{}] * 3
    assert encoded == [row._asdict()] * 3


def test_a_plant_without_a_modbus_server_has_no_address_map(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "plant.toml"
    path.write_text(
        '[[line]]\nname = "a"\nport = "/dev/a"\n[[line.drive]]\nname = "b"\naddress = 1\nmodel = "yd1000"\n'
    )
    assert main(["serve", str(path), "--modbus-map", str(tmp_path / "map.csv")]) == 2
    assert "plant.toml has no Modbus server: add [serve.modbus]" in capsys.readouterr().err
