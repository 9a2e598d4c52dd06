"""The documentation of the Modbus server: its plant files load, and its tables match the code."""

from __future__ import annotations

import re
from dataclasses import fields
from pathlib import Path

import pytest

from multidrop import Plant
from multidrop.gateway.modbus_server import clients as modbus_clients
from multidrop.gateway.modbus_server import common_block
from multidrop.gateway.modbus_server import line_share as passing
from multidrop.gateway.modbus_server.protocol import ModbusCode
from multidrop.gateway.modbus_server.settings import ModbusSettings
from multidrop.gateway.settings import read_settings

DOCS = Path(__file__).parents[3] / "docs"
HOWTO = (DOCS / "howto" / "modbus-server.md").read_text("utf-8")
REFERENCE = (DOCS / "reference" / "modbus-server.md").read_text("utf-8")
PLANTS = re.findall(r"```toml\n# ([\w-]+\.toml)\n(.*?)```", HOWTO, re.DOTALL)


@pytest.mark.parametrize(("name", "text"), PLANTS, ids=[name for name, _ in PLANTS])
def test_plant_files_of_the_page_load(tmp_path: Path, name: str, text: str) -> None:
    path = tmp_path / name
    path.write_text(text)
    assert isinstance(read_settings(Plant.load(path), {}).parts["modbus"], ModbusSettings)


def rows(heading: str) -> dict[str, str]:
    table = REFERENCE.partition(f"## {heading}\n")[2].partition("\n## ")[0]
    found = (line.strip("| ").split(" | ", 1) for line in re.findall(r"^\|.*\|$", table, re.MULTILINE)[2:])
    return {name.strip("` "): rest for name, rest in found}


def test_every_settings_key_has_a_row_in_the_page() -> None:
    assert list(rows("`[serve.modbus]`")) == [one.name for one in fields(ModbusSettings)]
    for name, rest in rows("`[serve.modbus]`").items():
        default = getattr(ModbusSettings(), name)
        if name in ("listen", "passing", "may"):
            assert f'"{default}"' in rest


def test_every_exception_code_has_a_row_in_the_page() -> None:
    assert set(rows("Exceptions")) == {f"{code:02X}" for code in ModbusCode} | {"others"}


def test_the_common_block_is_laid_out_as_the_page_says() -> None:
    offsets = [int(address.rstrip("H"), 16) - ModbusSettings().common for address in rows("The common block")]
    layout = common_block
    assert offsets == [
        *(layout.STATE, layout.FAULT, layout.FREQUENCY, layout.CURRENT, layout.SETPOINT),
        *(layout.AGE, layout.STOP, layout.STOP + 1),
    ]
    sizes = [int(rest.split(" | ")[0]) for rest in rows("The common block").values()]
    assert sum(sizes) == common_block.COMMON_LENGTH
    states = re.findall(r"(\d) (\w+)", next(iter(rows("The common block").values())).partition("state: ")[2])
    assert {name: int(number) for number, name in states} == common_block.STATES


def test_the_limits_of_clients_are_as_the_page_says() -> None:
    text = REFERENCE.partition("## Clients")[2]
    numbers = [int(number) for number in re.findall(r"\d+", text)]
    assert numbers == [
        *(modbus_clients.MOST_CLIENTS, modbus_clients.FORGETTABLE_S, modbus_clients.MOST_UNDER_WAY),
        *(passing.MOST_WAITING, modbus_clients.IDLE_S, modbus_clients.STALLED_S),
        *(modbus_clients.MOST_BEHIND // 1024, 6, modbus_clients.MOST_UNTAKEN // 1024),
    ]
